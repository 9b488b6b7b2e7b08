"""Elastic band as a pure step: a guide goes in, one that keeps away from obstacles comes out. Compiled."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from monstertruck_planners.collision import DiscFootprint, DistanceField, Footprint
from monstertruck_planners.local import bubbles
from monstertruck_planners.local.api import Guide
from monstertruck_planners.local.config import BandConfig

Array = NDArray[np.float64]

LAYER = 0.035
"""Depth of the outline's discs below it, m: they stand out by 0.4 of it."""

SPACING = 0.2
"""Largest distance of bubbles, m."""


@dataclass(frozen=True)
class Band:
    """What became of a band."""

    guide: Guide | None
    """None: it does not hold."""
    broken: int
    """Bubbles before the first one that touches something; their number if none does."""
    radii: Array
    """Shape (n,), m; of the guide's poses."""


def cover_of(footprint: Footprint | DiscFootprint) -> bubbles.Cover:
    """Discs that cover a footprint: of a rectangle small ones along the outline and large ones inside."""
    if isinstance(footprint, DiscFootprint):
        x = np.array(footprint.centres)
        return _cover(x, np.zeros(len(x)), np.full(len(x), footprint.radius))
    length, width = footprint.half_length - LAYER, footprint.half_width - LAYER
    along = np.linspace(-length, length, math.ceil(length / LAYER) + 1)
    across = np.linspace(-width, width, math.ceil(width / LAYER) + 1)[1:-1]
    inner = np.linspace(-max(length - width, 0.0), max(length - width, 0.0), 3)
    x = np.concatenate((along, along, np.full(len(across), length), np.full(len(across), -length), inner))
    sides = (np.full(len(along), width), np.full(len(along), -width))
    y = np.concatenate((*sides, across, across, np.zeros(len(inner))))
    radius = np.full(len(x), LAYER * math.sqrt(2.0))
    radius[-len(inner) :] = width
    return _cover(x + footprint.offset, y, radius)


def _cover(x: Array, y: Array, radius: Array) -> bubbles.Cover:
    return bubbles.Cover(x, y, radius, float(np.hypot(x, y).max()))


def rules_of(config: BandConfig, cover: bubbles.Cover) -> bubbles.Rules:
    """The corrected rules."""
    return bubbles.Rules(
        config.overlap, config.internal_gain, config.external_gain, config.iterations, config.depth,
        config.overshoot, config.significant, config.tiny, config.largest,
        1.0, 0.5 * cover.reach, SPACING, False,
    )  # fmt: skip


def stretch(guide: Guide, surroundings: DistanceField, cover: bubbles.Cover, rules: bubbles.Rules) -> Band:
    """Let an elastic band go: first and last pose and cusps stay, what is between keeps clear of obstacles.

    Args:
        guide: poses of the reference point, fewer than ``bubbles.MOST``.
        surroundings: obstacles.
        cover: footprint, see ``cover_of``.
        rules: of the forces.
    """
    count = len(guide.poses)
    band, fixed = np.zeros((bubbles.MOST, 6)), np.zeros(bubbles.MOST, np.bool_)
    if count > bubbles.MOST // 2:
        keep = np.unique(
            np.concatenate((np.linspace(0, count - 1, bubbles.MOST // 2).round().astype(int), _cusps(guide)))
        )
        guide = Guide(guide.poses[keep], guide.directions[keep])
        count = len(keep)
    band[:count, :3] = guide.poses
    band[:count, 2] = np.unwrap(guide.poses[:, 2])
    band[:count, 4] = guide.directions
    band[:count, 5] = 0.0 if rules.published else _sideslips(guide)
    fixed[[0, count - 1]] = True
    fixed[_cusps(guide)] = True
    field = surroundings.data()
    broken = int(bubbles.measure(field, cover, rules, band, count))
    if broken < count:
        return Band(None, broken, band[:count, 3].copy())
    count, holds = bubbles.refine(field, cover, rules, band, fixed, count)
    if not holds:
        return Band(None, broken, band[:count, 3].copy())
    moved, pinned = band.copy(), fixed.copy()
    more, settled = bubbles.optimise(field, cover, rules, moved, pinned, count)
    if settled:
        band, count = moved, more
    result = Guide(band[:count, :3].copy(), band[:count, 4].copy())
    return Band(result, count, band[:count, 3].copy())


def _cusps(guide: Guide) -> NDArray[np.int64]:
    """Indices of the poses at which the direction changes."""
    return np.asarray(np.flatnonzero(np.diff(guide.directions)))


def _sideslips(guide: Guide) -> Array:
    """From the heading to the way driven, rad, for every pose; small ones are corners of the guide, not crab."""
    steps = np.diff(guide.poses[:, :2], axis=0)
    if not len(steps):
        return np.zeros(len(guide.poses))
    course = np.arctan2(steps[:, 1], steps[:, 0]) + np.where(guide.directions[1:] > 0, 0.0, math.pi)
    middle = 0.5 * (guide.poses[1:, 2] + guide.poses[:-1, 2])
    slip = np.remainder(course - middle + math.pi, math.tau) - math.pi
    slip[(np.hypot(*steps.T) < 1e-6) | (np.abs(slip) > 0.5) | (np.abs(slip) < 0.1)] = 0.0
    return np.concatenate((slip[:1], slip))
