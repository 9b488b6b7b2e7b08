"""Elastic band of bubbles, compiled.

A bubble is a pose and how far every part of the footprint may move from there. Forces and refinement after S. Quinlan
and O. Khatib, "Elastic bands: connecting path planning and control", 1993, with the rules and parameters of the
published planner; what is different there is named at ``Rules``.
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
from monstertruck_planners.local.api import Guide
from monstertruck_planners.local.config import BandConfig

BoolArray = NDArray[np.bool_]

MOST = 400
"""Bubbles in a band."""


class Cover(NamedTuple):
    """Discs that together cover a footprint, and hardly more."""

    x: Array
    y: Array
    """Centres, m, seen from the pose."""
    radius: Array
    """m."""
    reach: float
    """Greatest distance of a centre from the pose, m."""


class Rules(NamedTuple):
    """How a band moves."""

    overlap: float
    internal: float
    external: float
    iterations: int
    depth: int
    overshoot: float
    significant: float
    tiny: float
    largest: float
    """Largest radius, m."""
    scale: float
    """Of radii: 1; the published weights make them half of the clearance."""
    reach: float
    """Metres that a radian between two headings counts; 0 in the published planner."""
    spacing: float
    """Largest distance of neighbours, m."""
    published: bool
    """Steps of a whole radius, and a force before that counts its x twice and its y never."""


@njit(cache=True)
def distance(field: FieldData, x: float, y: float) -> tuple[float, float, float]:
    """Distance of a point from the nearest occupied square, m, and its gradient; bilinear, 0 outside."""
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
def clearance(field: FieldData, cover: Cover, x: float, y: float, yaw: float) -> float:
    """Least distance of the footprint's discs from what is occupied, m; negative where they overlap it."""
    least = 1e9
    c, s = cos(yaw), sin(yaw)
    for k in range(len(cover.x)):
        px, py = x + cover.x[k] * c - cover.y[k] * s, y + cover.x[k] * s + cover.y[k] * c
        value, _, _ = distance(field, px, py)
        least = min(least, value - cover.radius[k])
    return least


@njit(cache=True)
def _radius(field: FieldData, cover: Cover, rules: Rules, x: float, y: float, yaw: float) -> float:
    return float(min(rules.scale * clearance(field, cover, x, y, yaw), rules.largest))


@njit(cache=True)
def _apart(rules: Rules, band: Array, i: int, j: int) -> float:
    turned = abs((band[i, 2] - band[j, 2] + pi) % (2 * pi) - pi)
    return float(hypot(band[i, 0] - band[j, 0], band[i, 1] - band[j, 1]) + rules.reach * turned)


@njit(cache=True)
def _touch(rules: Rules, band: Array, i: int, j: int) -> bool:
    return bool(_apart(rules, band, i, j) < rules.overlap * (band[i, 3] + band[j, 3]))


@njit(cache=True)
def _insert(band: Array, fixed: BoolArray, count: int, i: int) -> None:
    """A bubble half-way between i - 1 and i, at index i; it takes the direction of the later one."""
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
def refine(field: FieldData, cover: Cover, rules: Rules, band: Array, fixed: BoolArray, count: int) -> tuple[int, bool]:
    """Fill gaps between bubbles and take out those that are not needed.

    Args:
        field: obstacles.
        cover: footprint.
        rules: of the band.
        band: shape (MOST, 6): x, y, yaw, radius, direction, sideslip; changed in place.
        fixed: shape (MOST,): bubbles that stay.
        count: of bubbles.

    Returns:
        Number of bubbles, and whether the band holds.
    """
    i, deep = 1, 0
    while i < count:
        if _touch(rules, band, i - 1, i) and hypot(band[i, 0] - band[i - 1, 0], band[i, 1] - band[i - 1, 1]) <= (
            rules.spacing
        ):
            i, deep = i + 1, 0
            continue
        if count >= MOST or deep > 2 * rules.depth or _apart(rules, band, i - 1, i) < 0.5 * rules.tiny:
            return count, False
        _insert(band, fixed, count, i)
        count, deep = count + 1, deep + 1
        band[i, 3] = _radius(field, cover, rules, band[i, 0], band[i, 1], band[i, 2])
        if band[i, 3] <= rules.tiny:
            return count, False
    i = 1
    while i < count - 1:
        near = hypot(band[i + 1, 0] - band[i - 1, 0], band[i + 1, 1] - band[i - 1, 1]) <= rules.spacing
        if not fixed[i] and near and _touch(rules, band, i - 1, i + 1):
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
    field: FieldData, cover: Cover, rules: Rules, before: Array, here: Array, after: Array
) -> tuple[float, float]:
    """Pull of both neighbours and push of obstacles on a bubble, across the band."""
    fx, fy = 0.0, 0.0
    for other in (before, after):
        dx, dy = other[0] - here[0], other[1] - here[1]
        away = hypot(dx, dy)
        if away > rules.tiny:
            fx += rules.internal * dx / away
            fy += rules.internal * dy / away
    if here[3] < rules.largest:
        h = max(here[3], 0.5 * field.resolution)
        x, y, yaw = here[0], here[1], here[2]
        right, left = _radius(field, cover, rules, x + h, y, yaw), _radius(field, cover, rules, x - h, y, yaw)
        up, down = _radius(field, cover, rules, x, y + h, yaw), _radius(field, cover, rules, x, y - h, yaw)
        fx += rules.external * (right - left) / (2 * h)
        fy += rules.external * (up - down) / (2 * h)
    tx, ty = before[0] - after[0], before[1] - after[1]
    along = tx * tx + ty * ty
    if along > 1e-12:
        part = (fx * tx + fy * ty) / along
        fx -= part * tx
        fy -= part * ty
    return fx, fy


@njit(cache=True)
def _move(field: FieldData, cover: Cover, rules: Rules, band: Array, i: int) -> None:
    """Let one bubble go where its force pushes it, as long as it stays free and near its neighbours."""
    before, here, after = band[i - 1], band[i], band[i + 1]
    fx, fy = _force(field, cover, rules, before, here, after)
    gain = max(here[3], rules.tiny)
    if not rules.published:
        # A whole radius overshoots where neighbours are nearer than that.
        near = min(hypot(here[0] - before[0], here[1] - before[1]), hypot(here[0] - after[0], here[1] - after[1]))
        gain = min(gain, 0.5 * near)
    trial = here.copy()
    step = 1.0
    for _ in range(rules.depth + 1):
        trial[0], trial[1] = here[0] + step * gain * fx, here[1] + step * gain * fy
        trial[3] = _radius(field, cover, rules, trial[0], trial[1], trial[2])
        if trial[3] <= rules.tiny:
            step *= 0.5
            continue
        gx, gy = _force(field, cover, rules, before, trial, after)
        new = hypot(gx, gy)
        old = sqrt(2.0) * abs(fx) if rules.published else hypot(fx, fy)
        if gx * fx + gy * fy < 0.0 and new > rules.overshoot * old and new > rules.significant:
            step *= 0.5
            continue
        break
    if trial[3] <= rules.tiny:
        return
    for other in (before, after):
        far = hypot(other[0] - trial[0], other[1] - trial[1])
        if far >= rules.overlap * (other[3] + trial[3]):
            middle = _radius(field, cover, rules, 0.5 * (other[0] + trial[0]), 0.5 * (other[1] + trial[1]), trial[2])
            if middle <= rules.tiny:
                return
    here[0], here[1], here[3] = trial[0], trial[1], trial[3]


@njit(cache=True)
def face(field: FieldData, cover: Cover, rules: Rules, band: Array, fixed: BoolArray, count: int) -> None:
    """Turn every bubble along the band, by its sideslip beside it, unless it is fixed or would touch something."""
    for i in range(1, count - 1):
        if fixed[i]:
            continue
        dx, dy = band[i + 1, 0] - band[i - 1, 0], band[i + 1, 1] - band[i - 1, 1]
        if hypot(dx, dy) > 1e-6:
            course = atan2(dy, dx) + (0.0 if band[i, 4] > 0.0 else pi)
            yaw = band[i, 2] + (course - band[i, 5] - band[i, 2] + pi) % (2 * pi) - pi
            if _radius(field, cover, rules, band[i, 0], band[i, 1], yaw) > rules.tiny:
                band[i, 2] = yaw


@njit(cache=True)
def measure(field: FieldData, cover: Cover, rules: Rules, band: Array, count: int) -> int:
    """Take all radii anew.

    Returns:
        Index of the first bubble that is too small, or ``count``.
    """
    broken = count
    for i in range(count - 1, -1, -1):
        band[i, 3] = _radius(field, cover, rules, band[i, 0], band[i, 1], band[i, 2])
        if band[i, 3] <= rules.tiny:
            broken = i
    return broken


@njit(cache=True)
def optimise(
    field: FieldData, cover: Cover, rules: Rules, band: Array, fixed: BoolArray, count: int
) -> tuple[int, bool]:
    """Move a band that holds to its equilibrium; ends and cusps stay.

    Returns:
        Number of bubbles, and whether the band still holds; if not, it is in an unfinished state.
    """
    for _ in range(rules.iterations):
        for k in range(2 * (count - 2)):
            i = k + 1 if k < count - 2 else 2 * (count - 2) - k
            if not fixed[i]:
                _move(field, cover, rules, band, i)
        if not rules.published:
            face(field, cover, rules, band, fixed, count)
        if measure(field, cover, rules, band, count) < count:
            return count, False
        count, holds = refine(field, cover, rules, band, fixed, count)
        if not holds:
            return count, False
    return count, True


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


def cover_of(footprint: Footprint | DiscFootprint) -> Cover:
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


def _cover(x: Array, y: Array, radius: Array) -> Cover:
    return Cover(x, y, radius, float(np.hypot(x, y).max()))


def rules_of(config: BandConfig, cover: Cover) -> Rules:
    """The corrected rules."""
    return Rules(
        config.overlap, config.internal_gain, config.external_gain, config.iterations, config.depth,
        config.overshoot, config.significant, config.tiny, config.largest,
        1.0, 0.5 * cover.reach, SPACING, False,
    )  # fmt: skip


def stretch(guide: Guide, surroundings: DistanceField, cover: Cover, rules: Rules) -> Band:
    """Let an elastic band go: first and last pose and cusps stay, what is between keeps clear of obstacles.

    Args:
        guide: poses of the reference point, fewer than ``MOST``.
        surroundings: obstacles.
        cover: footprint, see ``cover_of``.
        rules: of the forces.
    """
    count = len(guide.poses)
    band, fixed = np.zeros((MOST, 6)), np.zeros(MOST, np.bool_)
    if count > MOST // 2:
        keep = np.unique(np.concatenate((np.linspace(0, count - 1, MOST // 2).round().astype(int), _cusps(guide))))
        guide = Guide(guide.poses[keep], guide.directions[keep])
        count = len(keep)
    band[:count, :3] = guide.poses
    band[:count, 2] = np.unwrap(guide.poses[:, 2])
    band[:count, 4] = guide.directions
    band[:count, 5] = 0.0 if rules.published else _sideslips(guide)
    fixed[[0, count - 1]] = True
    fixed[_cusps(guide)] = True
    field = surroundings.data()
    broken = int(measure(field, cover, rules, band, count))
    if broken < count:
        return Band(None, broken, band[:count, 3].copy())
    count, holds = refine(field, cover, rules, band, fixed, count)
    if not holds:
        return Band(None, broken, band[:count, 3].copy())
    moved, pinned = band.copy(), fixed.copy()
    more, settled = optimise(field, cover, rules, moved, pinned, count)
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
