"""Buffer for changing the segments of a drivable path in place. Loads numba."""

from typing import NamedTuple

import numpy as np
from numba import njit

from monstertruck_kinematics.elementary import Array
from monstertruck_planners.route.motion import advance
from monstertruck_planners.route.search import IntArray

MIN_SEGMENT = 1e-9
"""Minimum length of a segment (m); shorter ones are dropped."""


class SegmentBuffer(NamedTuple):
    """Segments of a ``MotionPath`` with their poses, changed in place, with room for more."""

    segments: Array
    """Segments, shape (n, 3); the first ``used[0]`` rows are in use."""
    poses: Array
    """Poses before each segment and after the last, shape (n + 1, 3)."""
    travelled: Array
    """Distances from the start to these poses, shape (n + 1,) (m)."""
    used: IntArray


@njit(cache=True)
def _update_poses(path: SegmentBuffer, first: int) -> None:
    """Compute poses and lengths from segment ``first`` on."""
    if first == 0:
        path.travelled[0] = 0.0
    for i in range(first, path.used[0]):
        length = path.segments[i, 0]
        x, y, yaw = advance(
            path.poses[i, 0], path.poses[i, 1], path.poses[i, 2], length, path.segments[i, 1], path.segments[i, 2]
        )
        path.poses[i + 1, 0], path.poses[i + 1, 1], path.poses[i + 1, 2] = x, y, yaw
        path.travelled[i + 1] = path.travelled[i] + abs(length)


@njit(cache=True)
def segment_at(path: SegmentBuffer, s: float) -> int:
    """Return the index of the segment at ``s`` metres."""
    low, high = 0, path.used[0] - 1
    while low < high:
        middle = (low + high) >> 1
        if path.travelled[middle + 1] > s:
            high = middle
        else:
            low = middle + 1
    return low


@njit(cache=True)
def pose_at(path: SegmentBuffer, i: int, s: float, out: Array) -> None:
    """Write the pose at ``s`` metres, in segment ``i``, into ``out``, shape (3,)."""
    part = min(s - path.travelled[i], abs(path.segments[i, 0]))
    if path.segments[i, 0] < 0.0:
        part = -part
    x, y, yaw = advance(
        path.poses[i, 0], path.poses[i, 1], path.poses[i, 2], part, path.segments[i, 1], path.segments[i, 2]
    )
    out[0], out[1], out[2] = x, y, yaw


@njit(cache=True)
def _append(out: Array, used: int, length: float, curvature: float, sideslip: float) -> int:
    """Add a segment, or extend the last one if it continues it."""
    if abs(length) < MIN_SEGMENT:
        return used
    if used > 0:
        k = used - 1
        same = abs(out[k, 1] - curvature) < 1e-12 and abs(out[k, 2] - sideslip) < 1e-12
        if same and out[k, 0] * length > 0.0:
            out[k, 0] += length
            return used
    out[used, 0], out[used, 1], out[used, 2] = length, curvature, sideslip
    return used + 1


@njit(cache=True)
def _merge_alike(path: SegmentBuffer) -> None:
    """Join segments that continue each other, and compute all poses."""
    used = 0
    for k in range(path.used[0]):
        used = _append(path.segments, used, path.segments[k, 0], path.segments[k, 1], path.segments[k, 2])
    path.used[0] = used
    _update_poses(path, 0)


def editable(start: Array, segments: Array) -> SegmentBuffer:
    """Return a buffer with these segments and room for more."""
    room = len(segments) + 400
    path = SegmentBuffer(np.empty((room, 3)), np.empty((room + 1, 3)), np.empty(room + 1), np.array([len(segments)]))
    path.segments[: len(segments)] = segments
    path.poses[0] = start
    _merge_alike(path)
    return path


def current_segments(path: SegmentBuffer) -> Array:
    """Return the segments in use, shape (n, 3), without a copy."""
    return path.segments[: path.used[0]]


@njit(cache=True)
def splice(
    path: SegmentBuffer, begin: float, i: int, end: float, j: int, middle: Array, many: int, spare: Array
) -> None:
    """Replace the stretch from ``begin`` (in segment i) to ``end`` (in segment j)."""
    used = 0
    first = max(i - 1, 0)
    # Segments before the stretch stay; the last of them may grow.
    for k in range(first, i):
        used = _append(spare, used, path.segments[k, 0], path.segments[k, 1], path.segments[k, 2])
    sign = 1.0 if path.segments[i, 0] > 0.0 else -1.0
    used = _append(spare, used, sign * (begin - path.travelled[i]), path.segments[i, 1], path.segments[i, 2])
    for k in range(many):
        used = _append(spare, used, middle[k, 0], middle[k, 1], middle[k, 2])
    sign = 1.0 if path.segments[j, 0] > 0.0 else -1.0
    used = _append(spare, used, sign * (path.travelled[j + 1] - end), path.segments[j, 1], path.segments[j, 2])
    for k in range(j + 1, path.used[0]):
        used = _append(spare, used, path.segments[k, 0], path.segments[k, 1], path.segments[k, 2])
    if first + used > len(path.segments):
        return
    for k in range(used):
        path.segments[first + k, 0] = spare[k, 0]
        path.segments[first + k, 1] = spare[k, 1]
        path.segments[first + k, 2] = spare[k, 2]
    path.used[0] = first + used
    _update_poses(path, first)


@njit(cache=True)
def stretch_segments(path: SegmentBuffer, begin: float, i: int, end: float, j: int, out: Array) -> int:
    """Copy the segments of a stretch; return their number."""
    used = 0
    for k in range(i, j + 1):
        low, high = max(begin - path.travelled[k], 0.0), min(end, path.travelled[k + 1]) - path.travelled[k]
        sign = 1.0 if path.segments[k, 0] > 0.0 else -1.0
        used = _append(out, used, sign * (high - low), path.segments[k, 1], path.segments[k, 2])
    return used


@njit(cache=True)
def restore(path: SegmentBuffer, segments: Array, used: int) -> None:
    """Restore the segments from before a trial."""
    path.segments[:used] = segments[:used]
    path.used[0] = used
    _update_poses(path, 0)
