"""What two scans say about each other's free space: a wall that the other looked through is not where it seems."""

import math
from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from monstertruck_estimation.slam.scans import Scan
from monstertruck_estimation.slam.se2 import between, inverse, transform

Array = NDArray[np.float64]

SECTORS: Final = 180
"""Sectors of a scan's view all round."""
MARGIN: Final = 0.25
"""Points this much in front of what was seen behind them were looked through, m."""
SLACK: Final = 0.04
"""And this share of their range: for the yaw's error."""


def contradiction(one: list[Scan], poses: Array, others: list[Scan], other_poses: Array) -> float:
    """Share of the points in view of the opposite scans, 0..1, that those looked through; 0 if none is in view.

    Args:
        one: scans, points in base.
        poses: shape (n, 3), of ``one``.
        others: the scans they are held against.
        other_poses: shape (m, 3), in the same frame.
    """
    through, judged = 0, 0
    for viewers, at, seen, seen_at in ((one, poses, others, other_poses), (others, other_poses, one, poses)):
        for viewer, pose in zip(viewers, at, strict=True):
            view = _view(viewer.points)
            for scan, place in zip(seen, seen_at, strict=True):
                counts = _looked_through(view, transform(between(pose, place), scan.points))
                through += counts[0]
                judged += counts[1]
    return through / judged if judged else 0.0


def in_view(viewers: list[Scan], poses: Array, points: Array) -> NDArray[np.bool_]:
    """Which of ``points``, shape (n, 2), at least one of the scans would have seen: no nearer wall hides them.

    Args:
        viewers: scans, points in base.
        poses: shape (m, 3), of ``viewers``, in the frame of ``points``.
        points: shape (n, 2), m.
    """
    seen = np.zeros(len(points), bool)
    for viewer, pose in zip(viewers, poses, strict=True):
        _mark_seen(_view(viewer.points), transform(inverse(pose), points), seen)
    return seen


@njit(cache=True)
def _sector(x, y):  # type: ignore[no-untyped-def] # noqa: ANN001, ANN202
    return int((math.atan2(y, x) + math.pi) / (2 * math.pi) * SECTORS) % SECTORS


@njit(cache=True)
def _view(points):  # type: ignore[no-untyped-def] # noqa: ANN001, ANN202
    """Least range per sector and its neighbours, m; 0 where any of the three saw nothing."""
    nearest = np.full(SECTORS, np.inf)
    for i in range(points.shape[0]):
        k = _sector(points[i, 0], points[i, 1])
        nearest[k] = min(nearest[k], math.hypot(points[i, 0], points[i, 1]))
    view = np.zeros(SECTORS)
    for k in range(SECTORS):
        a, b, c = nearest[k - 1], nearest[k], nearest[(k + 1) % SECTORS]
        if math.isfinite(a + b + c):
            view[k] = min(a, b, c)
    return view


@njit(cache=True)
def _looked_through(view, points):  # type: ignore[no-untyped-def] # noqa: ANN001, ANN202
    through, judged = 0, 0
    for i in range(points.shape[0]):
        limit = view[_sector(points[i, 0], points[i, 1])]
        r = math.hypot(points[i, 0], points[i, 1])
        gap = MARGIN + SLACK * r
        if limit > 0 and r < limit + gap:
            judged += 1
            if r < limit - gap:
                through += 1
    return through, judged


@njit(cache=True)
def _mark_seen(view, points, seen):  # type: ignore[no-untyped-def] # noqa: ANN001, ANN202
    for i in range(points.shape[0]):
        limit = view[_sector(points[i, 0], points[i, 1])]
        r = math.hypot(points[i, 0], points[i, 1])
        if limit > 0 and r < limit + MARGIN + SLACK * r:
            seen[i] = True
