"""Search for similar places along the direction that a match constrains least, within the prediction's covariance.

A pillar in a corridor also fits the next pillar, and a wall ahead also fits every recess. The information matrix of a
match does not show this ambiguity, because it is based on the current pairs of points.
"""

import math
from typing import NamedTuple

import numpy as np

from monstertruck_estimation.slam.correlation import RESOLUTION, LikelihoodGrid
from monstertruck_estimation.slam.scan_matcher import ScanMatch
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import transform


class LinePeak(NamedTuple):
    """Best pose on the line."""

    pose: Array
    """Pose of base in map, shape (3,)."""
    apart: bool
    """Whether it is at a different place than the match."""
    only: bool
    """Whether all other places fit clearly worse."""


def best_along(
    grid: LikelihoodGrid, points: Array, match: ScanMatch, guess: Array, covariance: Array
) -> LinePeak | None:
    """Return where ``points`` fit best along the weak direction of ``match``.

    Args:
        grid: likelihoods of surfaces in map.
        points: ends of beams in base, shape (n, 2) (m).
        match: an accepted match.
        guess: predicted pose, shape (3,).
        covariance: covariance of ``guess``, shape (3, 3); it limits the search to three standard deviations.

    Returns:
        None if the prediction allows no other place.
    """
    direction = np.array((math.cos(match.direction), math.sin(match.direction)))
    half = 3.0 * math.sqrt(float(direction @ covariance[:2, :2] @ direction))
    same_place = 0.25  # three standard deviations of the likelihood around a surface, m
    if half <= same_place:
        return None
    middle = float(direction @ (guess - match.pose)[:2])
    count = math.floor(half / RESOLUTION)
    offsets = np.append(middle + RESOLUTION * np.arange(-count, count + 1), 0.0)
    likelihoods = _likelihoods(grid, transform(match.pose, points), offsets[:, None] * direction)
    sums = likelihoods.sum(axis=1)
    best = -1 if sums[-1] >= sums.max() else int(sums.argmax())
    gains = likelihoods[best] - likelihoods
    # Gain of the best place in standard deviations, with independent errors of the points.
    sigmas = gains.sum(axis=1) / np.maximum(np.sqrt(np.square(gains).sum(axis=1)), 1e-9)
    others = np.abs(offsets - offsets[best]) > same_place
    sure = 3.0  # standard deviations
    pose = match.pose + offsets[best] * np.array((*direction, 0.0))
    return LinePeak(pose, bool(abs(offsets[best]) > same_place), bool((sigmas[others] >= sure).all()))


def _likelihoods(grid: LikelihoodGrid, ends: Array, shifts: Array) -> Array:
    """Return the likelihoods, 0..1, shape (m, n), of ``ends``, (n, 2) (m), moved by each of ``shifts``, (m, 2)."""
    level = grid.levels[0]
    cells = np.floor((ends[None] + shifts[:, None] - grid.origin) / RESOLUTION).astype(np.int64)
    columns, rows = cells[..., 0], cells[..., 1]
    inside = (columns >= 0) & (columns < level.shape[1]) & (rows >= 0) & (rows < level.shape[0])
    return np.where(inside, level[np.where(inside, rows, 0), np.where(inside, columns, 0)] / 255.0, 0.0)
