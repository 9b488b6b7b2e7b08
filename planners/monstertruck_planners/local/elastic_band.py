"""Elastic band: poses of a path move away from obstacles and towards each other. Loads numba.

A bubble is a pose with the distance that every part of the footprint may move from there. Forces and refinement follow
S. Quinlan and O. Khatib, "Elastic bands: connecting path planning and control", 1993, with the parameters of the
published planner; differences are listed at ``BandParameters``.
"""

import math
from dataclasses import dataclass
from math import atan2, cos, hypot, pi, sin, sqrt
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_planners.collision import DiscFootprint, DistanceField, Footprint
from monstertruck_planners.collision_kernels import FieldData
from monstertruck_planners.local.config import BandConfig
from monstertruck_planners.pose_path import PosePath

BoolArray = NDArray[np.bool_]

MAX_BUBBLES = 400
"""Maximum number of bubbles in a band."""


class CoveringDiscs(NamedTuple):
    """Discs that tightly cover a footprint."""

    x: Array
    y: Array
    """Centres relative to the pose (m)."""
    radius: Array
    """Radii (m)."""
    reach: float
    """Maximum distance of a centre from the pose (m)."""


class BandParameters(NamedTuple):
    """Parameters of the band's forces."""

    overlap: float
    internal: float
    external: float
    iterations: int
    depth: int
    overshoot: float
    significant: float
    tiny: float
    largest: float
    """Maximum radius (m)."""
    scale: float
    """Ratio of a bubble's radius to its clearance: 1; 0.5 in the published planner."""
    reach: float
    """Distance equivalent to a heading difference (m/rad); 0 in the published planner."""
    spacing: float
    """Maximum distance between neighbours (m)."""
    published: bool
    """Whether to move by a whole radius, with a previous force that uses x twice and y never."""


@njit(cache=True)
def distance_and_gradient(field: FieldData, x: float, y: float) -> tuple[float, float, float]:
    """Return the distance of a point from the nearest occupied square (m), and its gradient; bilinear, 0 outside."""
    dx, dy = x - field.x, y - field.y
    px = (dx * field.cos + dy * field.sin) / field.resolution - 0.5
    py = (dy * field.cos - dx * field.sin) / field.resolution - 0.5
    rows, columns = field.distance.shape
    if not (0.0 <= px <= columns - 1.0 and 0.0 <= py <= rows - 1.0):
        return 0.0, 0.0, 0.0
    c, r = min(int(px), columns - 2), min(int(py), rows - 2)
    u, v = px - c, py - r
    a, b = field.distance[r, c], field.distance[r, c + 1]
    d, e = field.distance[r + 1, c], field.distance[r + 1, c + 1]
    value = (a * (1 - u) + b * u) * (1 - v) + (d * (1 - u) + e * u) * v - 0.5 * field.resolution
    gx = ((b - a) * (1 - v) + (e - d) * v) / field.resolution
    gy = ((d - a) * (1 - u) + (e - b) * u) / field.resolution
    return value, gx * field.cos - gy * field.sin, gx * field.sin + gy * field.cos


@njit(cache=True)
def clearance(field: FieldData, cover: CoveringDiscs, x: float, y: float, yaw: float) -> float:
    """Return the distance of the footprint's discs from occupied cells (m), negative inside, and its gradient."""
    least = 1e9
    c, s = cos(yaw), sin(yaw)
    for k in range(len(cover.x)):
        px, py = x + cover.x[k] * c - cover.y[k] * s, y + cover.x[k] * s + cover.y[k] * c
        value, _, _ = distance_and_gradient(field, px, py)
        least = min(least, value - cover.radius[k])
    return least


@njit(cache=True)
def _radius(
    field: FieldData, cover: CoveringDiscs, parameters: BandParameters, x: float, y: float, yaw: float
) -> float:
    return float(min(parameters.scale * clearance(field, cover, x, y, yaw), parameters.largest))


@njit(cache=True)
def _apart(parameters: BandParameters, band: Array, i: int, j: int) -> float:
    turned = abs((band[i, 2] - band[j, 2] + pi) % (2 * pi) - pi)
    return float(hypot(band[i, 0] - band[j, 0], band[i, 1] - band[j, 1]) + parameters.reach * turned)


@njit(cache=True)
def _touch(parameters: BandParameters, band: Array, i: int, j: int) -> bool:
    return bool(_apart(parameters, band, i, j) < parameters.overlap * (band[i, 3] + band[j, 3]))


@njit(cache=True)
def _insert(band: Array, fixed: BoolArray, count: int, i: int) -> None:
    """Insert a bubble half-way between i - 1 and i, at index i, with the direction of the later one."""
    for k in range(count, i, -1):
        for m in range(6):
            band[k, m] = band[k - 1, m]
        fixed[k] = fixed[k - 1]
    turned = (band[i + 1, 2] - band[i - 1, 2] + pi) % (2 * pi) - pi
    band[i, 0], band[i, 1] = 0.5 * (band[i - 1, 0] + band[i + 1, 0]), 0.5 * (band[i - 1, 1] + band[i + 1, 1])
    band[i, 2] = band[i - 1, 2] + 0.5 * turned
    band[i, 4] = band[i + 1, 4]
    band[i, 5] = band[i + 1, 5]
    fixed[i] = False


@njit(cache=True)
def _refine(
    field: FieldData, cover: CoveringDiscs, parameters: BandParameters, band: Array, fixed: BoolArray, count: int
) -> tuple[int, bool]:
    """Fill gaps between bubbles and remove redundant ones.

    Args:
        field: distance field of the obstacles.
        cover: footprint.
        parameters: parameters of the band.
        band: shape (MAX_BUBBLES, 6): x, y, yaw, radius, direction, sideslip; changed in place.
        fixed: shape (MAX_BUBBLES,): bubbles that do not move.
        count: number of bubbles.

    Returns:
        Number of bubbles, and whether the band is connected.
    """
    i, deep = 1, 0
    while i < count:
        if _touch(parameters, band, i - 1, i) and hypot(band[i, 0] - band[i - 1, 0], band[i, 1] - band[i - 1, 1]) <= (
            parameters.spacing
        ):
            i, deep = i + 1, 0
            continue
        if (
            count >= MAX_BUBBLES
            or deep > 2 * parameters.depth
            or _apart(parameters, band, i - 1, i) < 0.5 * parameters.tiny
        ):
            return count, False
        _insert(band, fixed, count, i)
        count, deep = count + 1, deep + 1
        band[i, 3] = _radius(field, cover, parameters, band[i, 0], band[i, 1], band[i, 2])
        if band[i, 3] <= parameters.tiny:
            return count, False
    i = 1
    while i < count - 1:
        near = hypot(band[i + 1, 0] - band[i - 1, 0], band[i + 1, 1] - band[i - 1, 1]) <= parameters.spacing
        if not fixed[i] and near and _touch(parameters, band, i - 1, i + 1):
            for k in range(i, count - 1):
                for m in range(6):
                    band[k, m] = band[k + 1, m]
                fixed[k] = fixed[k + 1]
            count -= 1
        else:
            i += 1
    return count, True


@njit(cache=True)
def _force(
    field: FieldData, cover: CoveringDiscs, parameters: BandParameters, before: Array, here: Array, after: Array
) -> tuple[float, float]:
    """Return the force on a bubble across the band: attraction of both neighbours and repulsion of obstacles."""
    fx, fy = 0.0, 0.0
    for other in (before, after):
        dx, dy = other[0] - here[0], other[1] - here[1]
        away = hypot(dx, dy)
        if away > parameters.tiny:
            fx += parameters.internal * dx / away
            fy += parameters.internal * dy / away
    if here[3] < parameters.largest:
        h = max(here[3], 0.5 * field.resolution)
        x, y, yaw = here[0], here[1], here[2]
        right, left = _radius(field, cover, parameters, x + h, y, yaw), _radius(field, cover, parameters, x - h, y, yaw)
        up, down = _radius(field, cover, parameters, x, y + h, yaw), _radius(field, cover, parameters, x, y - h, yaw)
        fx += parameters.external * (right - left) / (2 * h)
        fy += parameters.external * (up - down) / (2 * h)
    tx, ty = before[0] - after[0], before[1] - after[1]
    along = tx * tx + ty * ty
    if along > 1e-12:
        part = (fx * tx + fy * ty) / along
        fx -= part * tx
        fy -= part * ty
    return fx, fy


@njit(cache=True)
def _move(field: FieldData, cover: CoveringDiscs, parameters: BandParameters, band: Array, i: int) -> None:
    """Move one bubble along its force while it stays free and close to its neighbours."""
    before, here, after = band[i - 1], band[i], band[i + 1]
    fx, fy = _force(field, cover, parameters, before, here, after)
    gain = max(here[3], parameters.tiny)
    if not parameters.published:
        # A step of a whole radius overshoots if the neighbours are closer than that.
        near = min(hypot(here[0] - before[0], here[1] - before[1]), hypot(here[0] - after[0], here[1] - after[1]))
        gain = min(gain, 0.5 * near)
    trial = here.copy()
    step = 1.0
    for _ in range(parameters.depth + 1):
        trial[0], trial[1] = here[0] + step * gain * fx, here[1] + step * gain * fy
        trial[3] = _radius(field, cover, parameters, trial[0], trial[1], trial[2])
        if trial[3] <= parameters.tiny:
            step *= 0.5
            continue
        gx, gy = _force(field, cover, parameters, before, trial, after)
        new = hypot(gx, gy)
        old = sqrt(2.0) * abs(fx) if parameters.published else hypot(fx, fy)
        if gx * fx + gy * fy < 0.0 and new > parameters.overshoot * old and new > parameters.significant:
            step *= 0.5
            continue
        break
    if trial[3] <= parameters.tiny:
        return
    for other in (before, after):
        far = hypot(other[0] - trial[0], other[1] - trial[1])
        if far >= parameters.overlap * (other[3] + trial[3]):
            middle = _radius(
                field, cover, parameters, 0.5 * (other[0] + trial[0]), 0.5 * (other[1] + trial[1]), trial[2]
            )
            if middle <= parameters.tiny:
                return
    here[0], here[1], here[3] = trial[0], trial[1], trial[3]


@njit(cache=True)
def _align_headings(
    field: FieldData, cover: CoveringDiscs, parameters: BandParameters, band: Array, fixed: BoolArray, count: int
) -> None:
    """Turn every bubble along the band, minus its sideslip, unless it is fixed or would touch an obstacle."""
    for i in range(1, count - 1):
        if fixed[i]:
            continue
        dx, dy = band[i + 1, 0] - band[i - 1, 0], band[i + 1, 1] - band[i - 1, 1]
        if hypot(dx, dy) > 1e-6:
            course = atan2(dy, dx) + (0.0 if band[i, 4] > 0.0 else pi)
            yaw = band[i, 2] + (course - band[i, 5] - band[i, 2] + pi) % (2 * pi) - pi
            if _radius(field, cover, parameters, band[i, 0], band[i, 1], yaw) > parameters.tiny:
                band[i, 2] = yaw


@njit(cache=True)
def update_radii(field: FieldData, cover: CoveringDiscs, parameters: BandParameters, band: Array, count: int) -> int:
    """Compute all radii.

    Returns:
        Index of the first bubble that is too small, or ``count``.
    """
    broken = count
    for i in range(count - 1, -1, -1):
        band[i, 3] = _radius(field, cover, parameters, band[i, 0], band[i, 1], band[i, 2])
        if band[i, 3] <= parameters.tiny:
            broken = i
    return broken


@njit(cache=True)
def _relax(
    field: FieldData, cover: CoveringDiscs, parameters: BandParameters, band: Array, fixed: BoolArray, count: int
) -> tuple[int, bool]:
    """Move a connected band to its equilibrium; ends and cusps stay in place.

    Returns:
        Number of bubbles, and whether the band is still connected; if not, its state is undefined.
    """
    for _ in range(parameters.iterations):
        for k in range(2 * (count - 2)):
            i = k + 1 if k < count - 2 else 2 * (count - 2) - k
            if not fixed[i]:
                _move(field, cover, parameters, band, i)
        if not parameters.published:
            _align_headings(field, cover, parameters, band, fixed, count)
        if update_radii(field, cover, parameters, band, count) < count:
            return count, False
        count, holds = _refine(field, cover, parameters, band, fixed, count)
        if not holds:
            return count, False
    return count, True


@dataclass(frozen=True)
class BandResult:
    """Result of a relaxation."""

    path: PosePath | None
    """Path of the band; None if it is broken."""
    broken: int
    """Number of bubbles before the first one in contact; the total number if none is."""
    radii: Array
    """Radii at the path's poses, shape (n,) (m)."""


def cover_footprint(footprint: Footprint | DiscFootprint) -> CoveringDiscs:
    """Return discs that cover a footprint: for a rectangle small ones along the outline and large ones inside."""
    if isinstance(footprint, DiscFootprint):
        x = np.array(footprint.centres)
        return _discs(x, np.zeros(len(x)), np.full(len(x), footprint.radius))
    disc_depth = 0.035  # depth of the outline's disc centres inside it, m; the discs protrude by 0.4 of it
    length, width = footprint.half_length - disc_depth, footprint.half_width - disc_depth
    along = np.linspace(-length, length, math.ceil(length / disc_depth) + 1)
    across = np.linspace(-width, width, math.ceil(width / disc_depth) + 1)[1:-1]
    inner = np.linspace(-max(length - width, 0.0), max(length - width, 0.0), 3)
    x = np.concatenate((along, along, np.full(len(across), length), np.full(len(across), -length), inner))
    sides = (np.full(len(along), width), np.full(len(along), -width))
    y = np.concatenate((*sides, across, across, np.zeros(len(inner))))
    radius = np.full(len(x), disc_depth * math.sqrt(2.0))
    radius[-len(inner) :] = width
    return _discs(x + footprint.offset, y, radius)


def _discs(x: Array, y: Array, radius: Array) -> CoveringDiscs:
    return CoveringDiscs(x, y, radius, float(np.hypot(x, y).max()))


def band_parameters(config: BandConfig, cover: CoveringDiscs) -> BandParameters:
    """Return the parameters of the corrected band."""
    return BandParameters(
        config.overlap, config.internal_gain, config.external_gain, config.iterations, config.depth,
        config.overshoot, config.significant, config.tiny, config.largest,
        1.0, 0.5 * cover.reach, 0.2, False,  # maximum distance of bubbles, m
    )  # fmt: skip


def relax_band(
    path: PosePath, obstacles: DistanceField, cover: CoveringDiscs, parameters: BandParameters
) -> BandResult:
    """Relax an elastic band: first and last pose and cusps stay, the others keep clear of obstacles.

    Args:
        path: poses of the reference point, fewer than ``MAX_BUBBLES``.
        obstacles: obstacles in the window.
        cover: footprint, see ``cover_footprint``.
        parameters: parameters of the forces.
    """
    count = len(path.poses)
    band, fixed = np.zeros((MAX_BUBBLES, 6)), np.zeros(MAX_BUBBLES, np.bool_)
    if count > MAX_BUBBLES // 2:
        keep = np.unique(
            np.concatenate((np.linspace(0, count - 1, MAX_BUBBLES // 2).round().astype(int), _cusps(path)))
        )
        path = PosePath(path.poses[keep], path.directions[keep])
        count = len(keep)
    band[:count, :3] = path.poses
    band[:count, 2] = np.unwrap(path.poses[:, 2])
    band[:count, 4] = path.directions
    band[:count, 5] = 0.0 if parameters.published else _sideslips(path)
    fixed[[0, count - 1]] = True
    fixed[_cusps(path)] = True
    field = obstacles.data()
    broken = int(update_radii(field, cover, parameters, band, count))
    if broken < count:
        return BandResult(None, broken, band[:count, 3].copy())
    count, holds = _refine(field, cover, parameters, band, fixed, count)
    if not holds:
        return BandResult(None, broken, band[:count, 3].copy())
    moved, pinned = band.copy(), fixed.copy()
    more, settled = _relax(field, cover, parameters, moved, pinned, count)
    if settled:
        band, count = moved, more
    result = PosePath(band[:count, :3].copy(), band[:count, 4].copy())
    return BandResult(result, count, band[:count, 3].copy())


def _cusps(path: PosePath) -> NDArray[np.int64]:
    """Return the indices of the poses with a change of direction."""
    return np.asarray(np.flatnonzero(np.diff(path.directions)))


def _sideslips(path: PosePath) -> Array:
    """Return the angle from heading to course of every pose (rad); small angles are corners, not crabbing."""
    steps = np.diff(path.poses[:, :2], axis=0)
    if not len(steps):
        return np.zeros(len(path.poses))
    course = np.arctan2(steps[:, 1], steps[:, 0]) + np.where(path.directions[1:] > 0, 0.0, math.pi)
    middle = 0.5 * (path.poses[1:, 2] + path.poses[:-1, 2])
    slip = np.remainder(course - middle + math.pi, math.tau) - math.pi
    slip[(np.hypot(*steps.T) < 1e-6) | (np.abs(slip) > 0.5) | (np.abs(slip) < 0.1)] = 0.0
    return np.concatenate((slip[:1], slip))
