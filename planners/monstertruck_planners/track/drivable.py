"""Check whether a body can drive a drawn path: minimum deviation of a drive with bounded curvature (m).

The angle at a vertex is not decisive, because a tracker rounds the corners of a coarse polyline. Where the heading of a
path changes faster than the body turns, an ideal body follows points ahead of it with several look-ahead distances; the
smallest deviation is used.
"""

import math
from collections.abc import Iterator
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.pose_path import PosePath
from monstertruck_planners.track.config import TrackerConfig
from monstertruck_planners.track.segments import LEAST_STEP
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.plan import Path, Steering

LOOK_AHEADS: Final = (0.75, 1.0, 0.5, 0.3, 1.5)
"""Look-ahead distances of the ideal body, in turning radii."""
STEPS: Final = 20
"""Steps of the ideal body per turning radius travelled."""


class Bend(NamedTuple):
    """Part of a run with a faster turn than the body can make."""

    first: int
    """Index of the last pose before the bend."""
    last: int
    """Index of the first pose after the bend."""
    turn: float
    """Change of the heading (rad), positive to the left."""
    length: float
    """Distance travelled in the bend (m)."""
    deviation: float
    """Minimum deviation of the body from the path (m); +inf if it does not return to the path."""


def require_drivable(path: Path, config: TrackerConfig, geometry: FourWheelSteering) -> None:
    """Refuse a path that the body can follow only with larger deviations than ``path_tolerance``.

    Args:
        path: see ``check_path``.
        config: tolerance, axle angle and steering mode of the tracker.
        geometry: geometry of the body.

    Raises:
        InputError: names the first such place, its turning radius and the limit of the body.
    """
    tolerance = config.path_tolerance
    jump = _jump(path, tolerance)
    if jump is not None:
        index, aside = jump
        raise InputError(
            f"path {path.name!r}, {_place(path, index)}: the path jumps {aside:.2f} m to the side, which "
            "no arc can follow"
        )
    for bend, radius in bends(path, config, geometry):
        found = f"turns by {abs(math.degrees(bend.turn)):.0f} degrees in {bend.length:.2f} m"
        if bend.length > LEAST_STEP:
            found += f" (radius {bend.length / abs(bend.turn):.2f} m)"
        leaves = "does not return to it" if math.isinf(bend.deviation) else f"leaves it by {bend.deviation:.2f} m"
        raise InputError(
            f"path {path.name!r}, {_place(path, bend.first)}: the path {found}; the robot, with a minimum "
            f"radius of {radius:.2f} m, {leaves} (tolerance {tolerance:.2f} m). Draw a change of "
            "direction there, or use `track --repair`"
        )


def bends(path: Path, config: TrackerConfig, geometry: FourWheelSteering) -> Iterator[tuple[Bend, float]]:
    """Yield the places where the body leaves a path by more than the tolerance, each with the minimum radius (m)."""
    poses = PosePath.of(path)
    count = len(poses.poses)
    if path.closed:
        poses = poses.at(np.append(np.arange(count), 0))
    cuts = [0, *poses.stops.tolist(), len(poses.poses) - 1]
    for begin, end in pairwise(cuts):
        modes = poses.steering[begin + 1 : end + 1]
        radius = min(least_radius(mode, config.angle, geometry) for mode in set(modes) or {config.steering})
        points = poses.poses[begin : end + 1, :2]
        lap = path.closed and len(cuts) == 2
        if lap and math.isfinite(radius):
            points = np.concatenate((points, points[1 : 2 + _within(points, _lead(radius))]))
        for bend in _run_bends(points, radius, config.path_tolerance) if math.isfinite(radius) else ():
            yield bend._replace(first=(bend.first + begin) % count, last=(bend.last + begin) % count), radius


def least_radius(steering: Steering, angle: float, geometry: FourWheelSteering) -> float:
    """Return the minimum turning radius (m); +inf for a body that translates, whose path may bend without a turn."""
    return geometry.minimum_radius("counter" if steering == "hybrid" else steering, angle)


def _lead(radius: float) -> float:
    """Distance before and after a bend where the body may deviate for it (m)."""
    return 4.0 * radius


def _within(points: Array, distance: float) -> int:
    """Number of steps that cover a distance, or all."""
    travelled = np.cumsum(np.hypot(*np.diff(points, axis=0).T))
    return int(np.searchsorted(travelled, distance))


def _run_bends(points: Array, radius: float, tolerance: float) -> Iterator[Bend]:
    """Yield the bends of a run of one direction, shape (n, 2), that the body misses by more than the tolerance."""
    kept = np.concatenate(([True], np.hypot(*np.diff(points, axis=0).T) > LEAST_STEP))
    index = np.flatnonzero(kept)
    points = points[kept]
    if len(points) < 3:
        return
    steps = np.diff(points, axis=0)
    s = np.concatenate(([0.0], np.cumsum(np.hypot(*steps.T))))
    heading = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    excess = _excess(heading, s, radius)
    # 0.2: a turn this much too fast (rad) moves a body by less than a hundredth of its radius
    steep = np.flatnonzero(excess > 0.2)
    lead = _lead(radius)
    # 20.0: longest stretch, in leads, that is driven at a time
    apart = (np.diff(s[steep]) > lead) | (np.diff(s[steep] // (20.0 * lead)) > 0)
    for group in np.split(steep, np.flatnonzero(apart) + 1) if len(steep) else ():
        low, high = s[group[0]] - lead, s[group[-1]] + lead
        first, last = max(int(s.searchsorted(low)) - 1, 0), min(int(s.searchsorted(high)), len(s) - 1)
        deviation = _deviation(_cut(points[first : last + 1], s[first : last + 1], low, high), radius, tolerance)
        if deviation > tolerance:
            worst = int(group[np.argmax(excess[group])])
            over = np.abs(heading[worst] - heading[:worst]) - (s[worst] - s[1 : worst + 1]) / radius
            before = int(np.argmax(over))
            yield Bend(
                int(index[before + 1]),
                int(index[worst]),
                float(heading[worst] - heading[before]),
                float(s[worst] - s[before + 1]),
                deviation,
            )


def _excess(heading: Array, s: Array, radius: float) -> Array:
    """Return the turn of each step beyond what the body can turn between any earlier step and this one (rad)."""
    excess = np.zeros(len(heading))
    for side in (heading, -heading):
        earlier = np.minimum.accumulate(side[:-1] - s[1:-1] / radius)
        excess[1:] = np.maximum(excess[1:], side[1:] - s[1:-1] / radius - earlier)
    return excess


def _cut(points: Array, s: Array, low: float, high: float) -> Array:
    """Return the points between two distances, which may lie beyond the ends."""
    low, high = max(low, float(s[0])), min(high, float(s[-1]))
    at = np.concatenate(([low], s[(s > low) & (s < high)], [high]))
    return np.column_stack([np.interp(at, s, column) for column in points.T])


def _deviation(points: Array, radius: float, enough: float) -> float:
    """Return the minimum deviation among the look-ahead distances (m), or the first that is small enough."""
    s = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))))
    step = radius / STEPS
    at = np.linspace(0.0, s[-1], max(math.ceil(s[-1] / step), 2) + 1)
    dense = np.column_stack([np.interp(at, s, column) for column in points.T])
    least = math.inf
    for share in LOOK_AHEADS:
        least = min(least, _chase(dense, radius, step, max(round(share * STEPS), 1), least))
        if least <= enough:
            break
    return least


def _chase(points: Array, radius: float, step: float, ahead: int, most: float) -> float:
    """Drive along dense points at bounded curvature towards the point ``ahead`` of the nearest.

    Returns:
        The maximum distance from the points (m); +inf if it exceeds ``most`` or the body does not return to them.
    """
    xs, ys = points.T.tolist()
    last, most = len(xs) - 1, most * most
    for line in (xs, ys):
        line += [line[last] + i * (line[last] - line[last - 1]) for i in range(1, ahead + 1)]
    x, y, yaw = xs[0], ys[0], math.atan2(ys[1] - ys[0], xs[1] - xs[0])
    reached, farthest, tightest = 0, 0.0, 1.0 / radius
    for _ in range(3 * last):
        nearest = (xs[reached] - x) ** 2 + (ys[reached] - y) ** 2
        # 4: points that the body may pass in one step, more than it travels: it cannot skip a part of the path
        for i in range(reached + 1, min(reached + 4, last) + 1):
            square = (xs[i] - x) ** 2 + (ys[i] - y) ** 2
            if square < nearest:
                nearest, reached = square, i
        if nearest > farthest:
            farthest = nearest
            if farthest > most:
                break
        if reached == last:
            return math.sqrt(farthest)
        dx, dy = xs[reached + ahead] - x, ys[reached + ahead] - y
        c, s = math.cos(yaw), math.sin(yaw)
        aside = c * dy - s * dx
        if c * dx + s * dy < 0.0:
            curvature = math.copysign(tightest, aside)
        else:
            curvature = min(max(2.0 * aside / max(dx * dx + dy * dy, LEAST_STEP), -tightest), tightest)
        turn = step * curvature
        x, y, yaw = x + step * math.cos(yaw + turn / 2), y + step * math.sin(yaw + turn / 2), yaw + turn
    return math.inf


def _jump(path: Path, tolerance: float) -> tuple[int, float] | None:
    """Return the first step that moves further sideways (m) than its headings allow, and the pose before it.

    An arc from pose to pose has the mean direction of both headings. In a path with positions only, the headings
    disagree with that direction in every bend, and are meaningless.
    """
    poses = PosePath.of(path)
    steps, yaw = np.diff(poses.poses[:, :2], axis=0), np.unwrap(poses.poses[:, 2])
    length, course = np.hypot(*steps.T), np.arctan2(steps[:, 1], steps[:, 0])
    headings = (yaw[:-1], yaw[1:], 0.5 * (yaw[:-1] + yaw[1:]))
    aside = np.min([length * np.abs(np.sin(course - heading)) for heading in headings], axis=0)
    # 0.1: sine of the angle between a step and the headings, and share of such steps in a path that has headings
    if np.mean(aside > 0.1 * length) > 0.1:
        return None
    translates: NDArray[np.bool_] = np.array([mode in ("crab", "hybrid") for mode in poses.steering[1:]], np.bool_)
    if len(translates):
        aside[translates] = 0.0
    wrong = np.flatnonzero(aside > tolerance)
    return (int(wrong[0]), float(aside[wrong[0]])) if len(wrong) else None


def _place(path: Path, index: int) -> str:
    x, y = path.poses.reshape(-1, 3)[index % (len(path.poses) // 3), :2]
    return f"pose {index} at {x:.2f}, {y:.2f} m"
