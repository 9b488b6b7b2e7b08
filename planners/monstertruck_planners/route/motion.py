"""Drivable paths as exact motion segments, and poses sampled from them. Loads numba.

A segment is (signed length m, curvature 1/m, sideslip rad): a reference point of the vehicle travels ``length`` metres
(negative: backward) along an arc or line of constant curvature, at ``sideslip`` from the heading. With front steering
the reference point is the middle of the rear axle, otherwise it is the base point.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import ceil, cos, sin

import numpy as np
from numba import njit
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_planners.pose_path import PosePath
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.plan import Path, Steering


@njit(cache=True)
def advance(
    x: float, y: float, yaw: float, length: float, curvature: float, sideslip: float
) -> tuple[float, float, float]:
    """Return the pose after ``length`` metres of a segment."""
    half = 0.5 * curvature * length
    chord = length if abs(half) < 1e-7 else length * sin(half) / half
    course = yaw + sideslip + half
    return x + chord * cos(course), y + chord * sin(course), yaw + 2.0 * half


@njit(cache=True)
def _pose_along(pose: Array, segment: Array, travelled: float) -> Array:
    """Return the pose, (3,), after ``travelled`` metres (not negative) of a segment from ``pose``."""
    length = travelled if segment[0] > 0.0 else -travelled
    x, y, yaw = advance(pose[0], pose[1], pose[2], length, segment[1], segment[2])
    return np.array([x, y, yaw])


@njit(cache=True)
def _end_poses(start: Array, segments: Array) -> Array:
    """Return the poses before the first segment and after each, shape (n + 1, 3)."""
    poses = np.empty((len(segments) + 1, 3))
    x, y, yaw = start[0], start[1], start[2]
    poses[0, 0], poses[0, 1], poses[0, 2] = x, y, yaw
    for i in range(len(segments)):
        x, y, yaw = advance(x, y, yaw, segments[i, 0], segments[i, 1], segments[i, 2])
        poses[i + 1, 0], poses[i + 1, 1], poses[i + 1, 2] = x, y, yaw
    return poses


@njit(cache=True)
def _sample_poses(start: Array, segments: Array, step: float) -> tuple[Array, NDArray[np.int64]]:
    """Return poses at most ``step`` metres apart, including the ends of all segments.

    Returns:
        x, y, yaw and distance travelled (m), shape (m, 4); and the segment that leads to each pose (0 for the first),
        shape (m,).
    """
    total = 1
    for i in range(len(segments)):
        total += max(ceil(abs(segments[i, 0]) / step - 1e-9), 1)
    poses, index = np.empty((total, 4)), np.empty(total, np.int64)
    x, y, yaw, travelled = start[0], start[1], start[2], 0.0
    poses[0, 0], poses[0, 1], poses[0, 2], poses[0, 3], index[0] = x, y, yaw, 0.0, 0
    k = 1
    for i in range(len(segments)):
        length, curvature, sideslip = segments[i, 0], segments[i, 1], segments[i, 2]
        count = max(ceil(abs(length) / step - 1e-9), 1)
        for j in range(1, count + 1):
            share = length * j / count
            px, py, pyaw = advance(x, y, yaw, share, curvature, sideslip)
            poses[k, 0], poses[k, 1], poses[k, 2], poses[k, 3], index[k] = px, py, pyaw, travelled + abs(share), i
            k += 1
        x, y, yaw = poses[k - 1, 0], poses[k - 1, 1], poses[k - 1, 2]
        travelled += abs(length)
    return poses, index


@dataclass(frozen=True, slots=True)
class MotionSamples:
    """Points along a path; each value belongs to the segment before the point (for the first: the first segment)."""

    poses: Array
    """x, y, yaw of the reference point, yaw continuous, shape (m, 3)."""
    travelled: Array
    """Distance from the start, shape (m,) (m)."""
    curvature: Array
    """Curvature, shape (m,) (1/m)."""
    sideslip: Array
    """Sideslip, shape (m,) (rad)."""
    direction: Array
    """Direction, shape (m,): +1 or -1."""
    segment: NDArray[np.int64]
    """Index of the segment, shape (m,)."""


@dataclass(frozen=True)
class MotionPath:
    """A drivable path of a reference point of the vehicle.

    Args:
        start: pose (x, y, yaw) of the reference point, shape (3,).
        segments: signed length (m), curvature (1/m) and sideslip (rad), shape (n, 3); segments of length 0 are dropped.
        steering: steering mode of each of the n segments, or one for all (segments with sideslip become "crab").
        reference: x of the reference point in base (m): minus half a wheelbase for the rear axle.

    Raises:
        InputError: the arrays have wrong shapes or invalid numbers.
    """

    start: Array
    segments: Array
    steering: tuple[Steering, ...] | Steering = "counter"
    reference: float = 0.0

    def __post_init__(self) -> None:
        start = np.array(self.start, dtype=np.float64)
        segments = np.array(self.segments, dtype=np.float64).reshape(-1, 3)
        if start.shape != (3,) or not (np.isfinite(start).all() and np.isfinite(segments).all()):
            raise InputError("motion path: expected a start (x, y, yaw) and segments of three finite numbers")
        segments = segments[segments[:, 0] != 0.0]
        steering = self.steering
        if isinstance(steering, str):
            crab = (segments[:, 2] != 0.0) & (segments[:, 1] == 0.0)
            steering = tuple("crab" if c else steering for c in crab.tolist())
        if len(steering) != len(segments):
            raise InputError(f"motion path: {len(steering)} steering modes for {len(segments)} segments")
        start.flags.writeable = segments.flags.writeable = False
        for name, value in (("start", start), ("segments", segments), ("steering", steering)):
            object.__setattr__(self, name, value)

    @property
    def length(self) -> float:
        """Distance travelled by the reference point (m)."""
        return float(np.abs(self.segments[:, 0]).sum())

    @property
    def backward(self) -> float:
        """Distance travelled backward (m)."""
        return float(np.maximum(-self.segments[:, 0], 0.0).sum())

    @property
    def cusps(self) -> int:
        """Number of changes between forward and backward."""
        return cusps_of(self.segments)

    def copied(self) -> tuple[Array, Array]:
        """Start and segments as writable arrays, the only kind accepted by the compiled searches."""
        return self.start.copy(), self.segments.copy()

    @property
    def greatest_curvature(self) -> float:
        """Maximum curvature (1/m), 0 for an empty path."""
        return float(np.abs(self.segments[:, 1]).max(initial=0.0))

    @cached_property
    def ends(self) -> Array:
        """Pose of the reference point before the first segment and after each, shape (n + 1, 3)."""
        return np.asarray(_end_poses(self.start, self.segments))

    @property
    def end(self) -> Array:
        """Last pose of the reference point, shape (3,)."""
        return np.asarray(self.ends[-1])

    def sample(self, step: float) -> MotionSamples:
        """Return points at most ``step`` metres apart, including the end of each segment.

        Raises:
            InputError: ``step`` is not positive.
        """
        if not step > 0.0:
            raise InputError(f"sampling step {step} m: expected above 0")
        poses, index = _sample_poses(self.start, self.segments, step)
        segments = self.segments[index] if len(self.segments) else np.array([[1.0, 0.0, 0.0]])
        return MotionSamples(poses[:, :3], poses[:, 3], segments[:, 1], segments[:, 2], np.sign(segments[:, 0]), index)

    def along(self, step: float = 0.08) -> PosePath:
        """Return the poses of the reference point, one every ``step`` metres."""
        samples = self.sample(step)
        return PosePath(samples.poses, samples.direction)

    def base_path(self, step: float = 0.05) -> PosePath:
        """Return the poses of the base, one every ``step`` metres, with their steering modes."""
        samples = self.sample(step)
        steering = tuple(self.steering[i] for i in samples.segment.tolist()) if self.steering else ()
        return PosePath(moved(samples.poses, -self.reference), samples.direction, steering)  # type: ignore[arg-type]

    def base_poses(self, step: float) -> Array:
        """Return the poses of the base at the sampled points, shape (m, 3)."""
        return moved(self.sample(step).poses, -self.reference)

    def then(self, other: "MotionPath") -> "MotionPath":
        """Return this path followed by ``other``, which must start at its end.

        Raises:
            InputError: the reference points differ, or the gap exceeds a millimetre or milliradian.
        """
        gap = np.abs(other.start - self.end)
        gap[2] = abs(np.remainder(gap[2] + np.pi, 2 * np.pi) - np.pi)
        if other.reference != self.reference or gap.max() > 1e-3:
            raise InputError("motion paths: expected the second to start at the end of the first")
        return replace(
            self, segments=np.vstack((self.segments, other.segments)), steering=(*self.steering, *other.steering)
        )

    def part(self, begin: float, end: float) -> "MotionPath":
        """Return the part between two distances from the start (m), both clamped to the path."""
        before = np.concatenate(([0.0], np.cumsum(np.abs(self.segments[:, 0]))))
        begin, end = (min(max(v, 0.0), float(before[-1])) for v in (begin, end))
        first = np.clip(begin - before[:-1], 0.0, np.diff(before))
        last = np.clip(end - before[:-1], 0.0, np.diff(before))
        segments = self.segments.copy()
        segments[:, 0] = np.sign(segments[:, 0]) * (last - first)
        keep = last - first > 1e-9
        i = min(int(np.searchsorted(before, begin, side="right")) - 1, max(len(segments) - 1, 0))
        start = self.start
        if len(segments):
            start = _pose_along(self.ends[i], self.segments[i], begin - before[i])
        steering = tuple(s for s, kept in zip(self.steering, keep.tolist(), strict=True) if kept)
        return MotionPath(start, segments[keep], steering, self.reference)  # type: ignore[arg-type]

    def message(self, *, stamp: int, seq: int = 0, frame: str = "map", name: str = "", step: float = 0.05) -> Path:
        """Return the path of the base as a ``plan/path`` message, sampled every ``step`` metres."""
        path = self.base_path(step)
        return Path(
            stamp=stamp,
            received=stamp,
            seq=seq,
            frame=frame,
            poses=path.poses.ravel(),
            directions=path.directions,
            steering=path.steering,
            name=name,
        )


def cusps_of(segments: Array) -> int:
    """Return the number of changes of direction in segments, shape (n, 3), all with a length."""
    return int(np.count_nonzero(np.diff(np.sign(segments[:, 0]))))


def moved(poses: Array, ahead: float) -> Array:
    """Return the poses (m, 3) of the point ``ahead`` metres in front of the given ones."""
    result = np.array(poses, dtype=np.float64)
    result[..., 0] += ahead * np.cos(poses[..., 2])
    result[..., 1] += ahead * np.sin(poses[..., 2])
    return result


def joined(paths: Sequence[MotionPath]) -> MotionPath:
    """Join several paths, at least one, see ``MotionPath.then``."""
    result = paths[0]
    for path in paths[1:]:
        result = result.then(path)
    return result
