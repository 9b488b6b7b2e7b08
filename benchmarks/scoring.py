"""Errors of estimates, paths and deadlines against the world's truth, shared by all benchmarks.

Poses are (x, y, yaw) in metres and radians; only the simulated world knows the truth.
"""

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from monstertruck_kinematics.elementary import Array
from monstertruck_planners.collision import DistanceField, Footprint


def rms(values: Array) -> float:
    """Return the root of the mean square; 0 without values."""
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else 0.0


def at(stamps: Array, poses: Array, instants: Array) -> Array:
    """Return poses (m, 3) at instants (s), linear between those of a trajectory (n, 3), with the yaw unwrapped."""
    yaw = np.unwrap(poses[:, 2])
    return np.column_stack([np.interp(instants, stamps, column) for column in (poses[:, 0], poses[:, 1], yaw)])


def trajectory(estimate: Array, truth: Array) -> dict[str, float]:
    """Return the absolute errors of poses (n, 3) against the true ones of the same instants, without alignment."""
    off = np.hypot(*(estimate - truth)[:, :2].T)
    turned = np.abs(np.remainder(estimate[:, 2] - truth[:, 2] + math.pi, math.tau) - math.pi)
    return {
        "ate_m": rms(off),
        "max_m": float(off.max()),
        "end_m": float(off[-1]),
        "end_rad": float(turned[-1]),
        "driven_m": length(truth),
    }


def relative(stamps: Array, estimate: Array, truth: Array, seconds: float) -> float:
    """Return the RMS error of the motion over a duration, m (RPE), of each pose (n, 3) with a later one.

    Args:
        stamps: increasing, s.
        estimate: estimated poses at those instants.
        truth: true poses at those instants.
        seconds: duration.
    """
    later = np.searchsorted(stamps, stamps + seconds)
    first = np.flatnonzero(later < len(stamps))
    moves = []
    for poses in (estimate, truth):
        begin, step = poses[first], poses[later[first], :2] - poses[first, :2]
        cos, sin = np.cos(begin[:, 2]), np.sin(begin[:, 2])
        moves.append(np.column_stack((cos * step[:, 0] + sin * step[:, 1], cos * step[:, 1] - sin * step[:, 0])))
    return rms(np.hypot(*(moves[0] - moves[1]).T))


def length(poses: Array) -> float:
    """Return the length along poses (n, >= 2), m."""
    return float(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum())


def sharpest(points: Array) -> float:
    """Return the maximum curvature of a polyline (n, >= 2), 1/m: turn at a point over half the adjacent pieces."""
    step = np.diff(points[:, :2], axis=0)
    step = step[np.hypot(*step.T) > 1e-6]
    long, turn = np.hypot(*step.T), np.diff(np.unwrap(np.arctan2(step[:, 1], step[:, 0])))
    return float((np.abs(turn) / (0.5 * (long[1:] + long[:-1]))).max()) if len(turn) else 0.0


def distance(places: Array, points: Array) -> Array:
    """Return the distances (m,) of places (m, 2) from a polyline (n, 2), m."""
    begin, step = points[:-1], np.diff(points, axis=0)
    square = (step**2).sum(axis=1)
    result = np.empty(len(places))
    for i in range(0, len(places), 500):
        to = places[i : i + 500, None] - begin
        share = np.clip((to * step).sum(axis=2) / square, 0.0, 1.0)
        result[i : i + 500] = np.hypot(*np.moveaxis(to - share[..., None] * step, 2, 0)).min(axis=1)
    return result


def clearance(truth: DistanceField, footprint: Footprint, poses: Array, most: float = 1.0) -> float:
    """Return the minimum distance of the footprint at poses (n, 3) from occupied cells, m, at most ``most``."""
    return float(truth.clearance(footprint, poses, most).min())


def wall_distances(
    cells: NDArray[np.int8], origin: tuple[float, float], resolution: float, truth: DistanceField
) -> Array:
    """Return the distance of every occupied cell of a grid (rows, columns) from the nearest true wall, m."""
    rows, columns = np.nonzero(cells >= 65)
    middle: Array = (np.column_stack((columns, rows)) + 0.5) * resolution + origin
    return truth.lookup(middle)


def map_error(
    cells: NDArray[np.int8], origin: tuple[float, float], resolution: float, truth: DistanceField
) -> dict[str, float]:
    """Compare a grid (rows, columns; 100 occupied, 0 free, -1 unknown) with the world.

    Walls: distance of occupied cells from the nearest true wall, m. ``occupied_free``: share of the free cells that lie
    within a wall by more than a cell.
    """
    off = wall_distances(cells, origin, resolution, truth)
    rows, columns = np.nonzero((cells >= 0) & (cells < 50))
    middle: Array = (np.column_stack((columns, rows)) + 0.5) * resolution + origin
    through = truth.lookup(middle) < 0.25 * resolution
    return {
        "wall_mean_m": float(off.mean()) if len(off) else math.inf,
        "wall_p95_m": float(np.percentile(off, 95)) if len(off) else math.inf,
        "false_free_share": float(through.mean()) if len(through) else 0.0,
        "known_m2": float((cells >= 0).sum()) * resolution**2,
    }


def wall_iou(
    cells: NDArray[np.int8], origin: tuple[float, float], resolution: float, truth: DistanceField, within: float
) -> float:
    """Return the intersection over union of the walls of grid and world, both widened by ``within`` m.

    Unknown cells of the grid do not count.
    """
    rows, columns = np.indices(cells.shape)
    middle: Array = (np.column_stack((columns.ravel(), rows.ravel())) + 0.5) * resolution + origin
    true = truth.lookup(middle).reshape(cells.shape) <= within
    mine = distance_transform_edt(cells < 65) * resolution <= within
    known = cells >= 0
    return float((true & mine & known).sum() / max(((true | mine) & known).sum(), 1))


def percentiles(values: Array, unit: str = "ms") -> dict[str, float]:
    """Return median, 99th percentile and maximum."""
    if not len(values):
        return {f"p50_{unit}": 0.0, f"p99_{unit}": 0.0, f"max_{unit}": 0.0}
    p50, p99 = np.percentile(values, (50, 99))
    return {f"p50_{unit}": float(p50), f"p99_{unit}": float(p99), f"max_{unit}": float(np.max(values))}


def missed(instants: Sequence[float], begin: float, end: float, period: float) -> float:
    """Return the share of the whole periods from ``begin`` to ``end`` (s) without any of the instants."""
    edges = begin + period * np.arange(math.floor((end - begin) / period + 1e-9) + 1)
    return float((np.histogram(instants, edges)[0] == 0).mean())


def first_miss(share: Callable[[float], float], factors: Sequence[float], allowed: float, ratio: float) -> float:
    """Return the factor from which on more than ``allowed`` is missed; inf if none.

    Args:
        share: missed share at a factor.
        factors: increasing; the first that misses is searched among them, then between it and the previous one.
        allowed: share that may be missed.
        ratio: greater than 1, between the factor that misses and the largest tried one that does not.
    """
    keeps = None
    for factor in factors:
        if share(factor) > allowed:
            break
        keeps = factor
    else:
        return math.inf
    while keeps is not None and factor / keeps > ratio:
        middle = math.sqrt(keeps * factor)
        if share(middle) > allowed:
            factor = middle
        else:
            keeps = middle
    return factor
