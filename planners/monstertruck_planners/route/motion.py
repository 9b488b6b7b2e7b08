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
    """Pose after ``length`` metres of a segment."""
    half = 0.5 * curvature * length
    chord = length if abs(half) < 1e-7 else length * sin(half) / half
    course = yaw + sideslip + half
    return x + chord * cos(course), y + chord * sin(course), yaw + 2.0 * half


@njit(cache=True)
def _pose_along(pose: Array, segment: Array, travelled: float) -> Array:
    """Pose (3,) reached from ``pose`` after ``travelled`` metres (not below 0) of a segment."""
    length = travelled if segment[0] > 0.0 else -travelled
    x, y, yaw = advance(pose[0], pose[1], pose[2], length, segment[1], segment[2])
    return np.array([x, y, yaw])


@njit(cache=True)
def _end_poses(start: Array, segments: Array) -> Array:
    """Pose before the first segment and after each, shape (n + 1, 3)."""
    poses = np.empty((len(segments) + 1, 3))
    x, y, yaw = start[0], start[1], start[2]
    poses[0, 0], poses[0, 1], poses[0, 2] = x, y, yaw
    for i in range(len(segments)):
        x, y, yaw = advance(x, y, yaw, segments[i, 0], segments[i, 1], segments[i, 2])
        poses[i + 1, 0], poses[i + 1, 1], poses[i + 1, 2] = x, y, yaw
    return poses


@njit(cache=True)
def _sample_poses(start: Array, segments: Array, step: float) -> tuple[Array, NDArray[np.int64]]:
    """Poses at most ``step`` metres apart, the ends of all segments among them.

    Returns:
        Shape (m, 4): x, y, yaw and metres travelled; and shape (m,), the segment that leads to each pose (0
        for the first).
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
    """Points along a path; a value belongs to the segment leading to the point (to the first: the first segment)."""

    poses: Array
    """Shape (m, 3): x, y, yaw of the reference point, yaw continuous."""
    travelled: Array
    """Shape (m,), m from the start."""
    curvature: Array
    """Shape (m,), 1/m."""
    sideslip: Array
    """Shape (m,), rad."""
    direction: Array
    """Shape (m,), +1 or -1."""
    segment: NDArray[np.int64]
    """Shape (m,), index."""


@dataclass(frozen=True)
class MotionPath:
    """A drivable path of a reference point of the vehicle.

    Args:
        start: pose (x, y, yaw) of the reference point, shape (3,).
        segments: shape (n, 3): signed length m, curvature 1/m, sideslip rad; segments of length 0 are dropped.
        steering: how each segment is steered, n of them, or one for all (those with sideslip become "crab").
        reference: x of the reference point in base, m: minus half a wheelbase for the rear axle.

    Raises:
        InputError: shapes or numbers that do not form a path.
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
        """Metres travelled by the reference point."""
        return float(np.abs(self.segments[:, 0]).sum())

    @property
    def backward(self) -> float:
        """Metres travelled backward."""
        return float(np.maximum(-self.segments[:, 0], 0.0).sum())

    @property
    def cusps(self) -> int:
        """Changes between forward and backward."""
        return cusps_of(self.segments)

    def copied(self) -> tuple[Array, Array]:
        """Start and segments as arrays that may be written to, the only kind that the searches are compiled for."""
        return self.start.copy(), self.segments.copy()

    @property
    def greatest_curvature(self) -> float:
        """1/m, 0 for an empty path."""
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
        """Points at most ``step`` metres apart; the end of each segment is among them.

        Raises:
            InputError: step not above 0.
        """
        if not step > 0.0:
            raise InputError(f"sampling step {step} m: expected above 0")
        poses, index = _sample_poses(self.start, self.segments, step)
        segments = self.segments[index] if len(self.segments) else np.array([[1.0, 0.0, 0.0]])
        return MotionSamples(poses[:, :3], poses[:, 3], segments[:, 1], segments[:, 2], np.sign(segments[:, 0]), index)

    def along(self, step: float = 0.08) -> PosePath:
        """Poses of the reference point, one every ``step`` metres."""
        samples = self.sample(step)
        return PosePath(samples.poses, samples.direction)

    def base_path(self, step: float = 0.05) -> PosePath:
        """Poses of the base, one every ``step`` metres, with the ways of steering."""
        samples = self.sample(step)
        steering = tuple(self.steering[i] for i in samples.segment.tolist()) if self.steering else ()
        return PosePath(moved(samples.poses, -self.reference), samples.direction, steering)  # type: ignore[arg-type]

    def base_poses(self, step: float) -> Array:
        """Poses of the base at the sampled points, shape (m, 3)."""
        return moved(self.sample(step).poses, -self.reference)

    def then(self, other: "MotionPath") -> "MotionPath":
        """This path followed by ``other``, which has to start where this one ends.

        Raises:
            InputError: another reference point, or a gap of more than a millimetre or milliradian.
        """
        gap = np.abs(other.start - self.end)
        gap[2] = abs(np.remainder(gap[2] + np.pi, 2 * np.pi) - np.pi)
        if other.reference != self.reference or gap.max() > 1e-3:
            raise InputError("motion paths: expected the second to start at the end of the first")
        return replace(
            self, segments=np.vstack((self.segments, other.segments)), steering=(*self.steering, *other.steering)
        )

    def part(self, begin: float, end: float) -> "MotionPath":
        """The piece between two distances from the start, m; both are kept within the path."""
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
        """The path of the base as a ``plan/path`` message, sampled every ``step`` metres."""
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
    """Changes between forward and backward in segments, shape (n, 3), all with a length."""
    return int(np.count_nonzero(np.diff(np.sign(segments[:, 0]))))


def moved(poses: Array, ahead: float) -> Array:
    """Poses (m, 3) of the point ``ahead`` metres in front of the given ones."""
    result = np.array(poses, dtype=np.float64)
    result[..., 0] += ahead * np.cos(poses[..., 2])
    result[..., 1] += ahead * np.sin(poses[..., 2])
    return result


def joined(paths: Sequence[MotionPath]) -> MotionPath:
    """Several paths as one, see ``MotionPath.then``; at least one is needed."""
    result = paths[0]
    for path in paths[1:]:
        result = result.then(path)
    return result
