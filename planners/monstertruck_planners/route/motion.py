"""The path object that all planners share: exact pieces of constant curvature, and sampled poses. Loads numba.

A path belongs to a reference point of the truck: front-steered motions are those of the rear axle's middle, all others
those of the base. ``base_poses`` and ``message`` speak of the base.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import ceil, cos, sin
from typing import Literal

import numpy as np
from numba import njit
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.plan import Path, Steering


@njit(cache=True)
def advance(
    x: float, y: float, yaw: float, length: float, curvature: float, sideslip: float
) -> tuple[float, float, float]:
    """Pose after ``length`` metres of one row."""
    half = 0.5 * curvature * length
    chord = length if abs(half) < 1e-7 else length * sin(half) / half
    course = yaw + sideslip + half
    return x + chord * cos(course), y + chord * sin(course), yaw + 2.0 * half


@njit(cache=True)
def _pose_along(pose: Array, row: Array, travelled: float) -> Array:
    """Pose (3,) reached from ``pose`` after ``travelled`` metres (not below 0) of the row."""
    length = travelled if row[0] > 0.0 else -travelled
    x, y, yaw = advance(pose[0], pose[1], pose[2], length, row[1], row[2])
    return np.array([x, y, yaw])


@njit(cache=True)
def _end_poses(start: Array, rows: Array) -> Array:
    """Pose before the first row and after each, shape (n + 1, 3)."""
    poses = np.empty((len(rows) + 1, 3))
    x, y, yaw = start[0], start[1], start[2]
    poses[0, 0], poses[0, 1], poses[0, 2] = x, y, yaw
    for i in range(len(rows)):
        x, y, yaw = advance(x, y, yaw, rows[i, 0], rows[i, 1], rows[i, 2])
        poses[i + 1, 0], poses[i + 1, 1], poses[i + 1, 2] = x, y, yaw
    return poses


@njit(cache=True)
def _sample_poses(start: Array, rows: Array, step: float) -> tuple[Array, NDArray[np.int64]]:
    """Poses at most ``step`` metres apart, the _end_poses of all rows among them.

    Returns:
        Shape (m, 4): x, y, yaw and metres travelled; and shape (m,), the row that leads to each pose (0 for the first).
    """
    total = 1
    for i in range(len(rows)):
        total += max(ceil(abs(rows[i, 0]) / step - 1e-9), 1)
    poses, index = np.empty((total, 4)), np.empty(total, np.int64)
    x, y, yaw, travelled = start[0], start[1], start[2], 0.0
    poses[0, 0], poses[0, 1], poses[0, 2], poses[0, 3], index[0] = x, y, yaw, 0.0, 0
    k = 1
    for i in range(len(rows)):
        length, curvature, sideslip = rows[i, 0], rows[i, 1], rows[i, 2]
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
class Segment:
    """A piece of constant curvature and sideslip."""

    length: float
    """Travelled by the reference point, m, above 0."""
    direction: int
    """+1 forward, -1 backward."""
    curvature: float
    """1/m, positive if the turning centre lies to the left."""
    sideslip: float
    """From the heading to the path's tangent, rad; not 0 for crab."""
    steering: Steering

    @property
    def kind(self) -> Literal["line", "arc", "crab"]:
        """What the piece looks like."""
        if self.curvature != 0.0:
            return "arc"
        return "crab" if self.sideslip != 0.0 else "line"


@dataclass(frozen=True, slots=True)
class Samples:
    """Points along a path; a value is that of the segment leading to the point (to the first: the first segment)."""

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
    """A drivable path.

    Args:
        start: pose (x, y, yaw) of the reference point, shape (3,).
        rows: shape (n, 3): signed length m (negative: backward), curvature 1/m, sideslip rad. No length is 0.
        steering: how each row's wheels are set, n of them, or one for all rows (those with sideslip become "crab").
        reference: x of the reference point in base, m: minus half a wheelbase for the rear axle.

    Raises:
        InputError: shapes or numbers that are no path.
    """

    start: Array
    rows: Array
    steering: tuple[Steering, ...] | Steering = "counter"
    reference: float = 0.0

    def __post_init__(self) -> None:
        start = np.array(self.start, dtype=np.float64)
        rows = np.array(self.rows, dtype=np.float64).reshape(-1, 3)
        if start.shape != (3,) or not (np.isfinite(start).all() and np.isfinite(rows).all()):
            raise InputError("motion path: expected a start (x, y, yaw) and rows of three finite numbers")
        rows = rows[rows[:, 0] != 0.0]
        steering = self.steering
        if isinstance(steering, str):
            steering = tuple("crab" if slip != 0.0 and not turn else steering for _, turn, slip in rows.tolist())
        if len(steering) != len(rows):
            raise InputError(f"motion path: {len(steering)} ways of steering for {len(rows)} rows")
        start.flags.writeable = rows.flags.writeable = False
        for name, value in (("start", start), ("rows", rows), ("steering", steering)):
            object.__setattr__(self, name, value)

    @property
    def segments(self) -> tuple[Segment, ...]:
        """The pieces in the order driven."""
        return tuple(
            Segment(abs(length), 1 if length > 0 else -1, curvature, sideslip, steering)  # type: ignore[arg-type]
            for (length, curvature, sideslip), steering in zip(self.rows.tolist(), self.steering, strict=True)
        )

    @property
    def length(self) -> float:
        """Metres travelled by the reference point."""
        return float(np.abs(self.rows[:, 0]).sum())

    @property
    def backward(self) -> float:
        """Of these, metres backward."""
        return float(np.maximum(-self.rows[:, 0], 0.0).sum())

    @property
    def cusps(self) -> int:
        """Changes between forward and backward."""
        return int(np.count_nonzero(np.diff(np.sign(self.rows[:, 0]))))

    @property
    def greatest_curvature(self) -> float:
        """1/m, 0 for an empty path."""
        return float(np.abs(self.rows[:, 1]).max(initial=0.0))

    @cached_property
    def ends(self) -> Array:
        """Pose of the reference point before the first segment and after each, shape (n + 1, 3)."""
        return np.asarray(_end_poses(self.start, self.rows))

    @property
    def end(self) -> Array:
        """Last pose of the reference point, shape (3,)."""
        return np.asarray(self.ends[-1])

    def sample(self, step: float) -> Samples:
        """Points at most ``step`` metres apart; the end of each segment is among them.

        Raises:
            InputError: step not above 0.
        """
        if not step > 0.0:
            raise InputError(f"sampling step {step} m: expected above 0")
        poses, index = _sample_poses(self.start, self.rows, step)
        rows = self.rows[index] if len(self.rows) else np.array([[1.0, 0.0, 0.0]])
        return Samples(poses[:, :3], poses[:, 3], rows[:, 1], rows[:, 2], np.sign(rows[:, 0]), index)

    def base_poses(self, step: float) -> Array:
        """Poses of the base at the sampled points, shape (m, 3)."""
        return moved(self.sample(step).poses, -self.reference)

    def then(self, other: "MotionPath") -> "MotionPath":
        """This path and then the other one, which has to start where this one ends.

        Raises:
            InputError: another reference point, or a gap of more than a millimetre or milliradian.
        """
        gap = np.abs(other.start - self.end)
        gap[2] = abs(np.remainder(gap[2] + np.pi, 2 * np.pi) - np.pi)
        if other.reference != self.reference or gap.max() > 1e-3:
            raise InputError("motion paths: expected the second one to start where the first one ends")
        return replace(self, rows=np.vstack((self.rows, other.rows)), steering=(*self.steering, *other.steering))

    def part(self, begin: float, end: float) -> "MotionPath":
        """The piece between two distances from the start, m; both are kept within the path."""
        before = np.concatenate(([0.0], np.cumsum(np.abs(self.rows[:, 0]))))
        begin, end = (min(max(v, 0.0), float(before[-1])) for v in (begin, end))
        first = np.clip(begin - before[:-1], 0.0, np.diff(before))
        last = np.clip(end - before[:-1], 0.0, np.diff(before))
        rows = self.rows.copy()
        rows[:, 0] = np.sign(rows[:, 0]) * (last - first)
        keep = last - first > 1e-9
        i = min(int(np.searchsorted(before, begin, side="right")) - 1, max(len(rows) - 1, 0))
        start = self.start
        if len(rows):
            start = _pose_along(self.ends[i], self.rows[i], begin - before[i])
        steering = tuple(s for s, kept in zip(self.steering, keep.tolist(), strict=True) if kept)
        return MotionPath(start, rows[keep], steering, self.reference)  # type: ignore[arg-type]

    def message(self, *, stamp: int, seq: int = 0, frame: str = "map", name: str = "", step: float = 0.05) -> Path:
        """The path of the base as a ``plan/path`` message, sampled every ``step`` metres."""
        samples, segments = self.sample(step), self.segments
        return Path(
            stamp=stamp,
            received=stamp,
            seq=seq,
            frame=frame,
            poses=moved(samples.poses, -self.reference).ravel(),
            directions=samples.direction,
            steering=tuple(segments[i].steering for i in samples.segment.tolist()) if segments else (),
            name=name,
        )


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
