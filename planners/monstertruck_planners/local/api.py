"""What goes into a deformer and what comes out. Compiled.

Poses belong to the vehicle's reference point, as in the route planners: the rear axle's middle with front steering.
"""

import math
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from monstertruck_kinematics.elementary import Array
from monstertruck_planners.collision import DistanceField
from monstertruck_planners.route.api import Vehicle
from monstertruck_planners.route.motion import MotionPath, moved
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.plan import Path
from monstertruck_schemas.reasons import Reason


@dataclass(frozen=True)
class Guide:
    """Poses to be driven in order: a route before its deformation, or a band after it.

    Args:
        poses: shape (n, 3), x, y, yaw of the reference point, n at least 1.
        directions: shape (n,), +1 where the truck arrives forward, -1 backward.

    Raises:
        InputError: shapes or numbers that are none.
    """

    poses: Array
    directions: Array

    def __post_init__(self) -> None:
        poses, directions = np.asarray(self.poses, dtype=np.float64), np.asarray(self.directions, dtype=np.float64)
        if poses.ndim != 2 or poses.shape[1] != 3 or not len(poses) or directions.shape != (len(poses),):
            raise InputError(f"guide: {poses.shape} poses, {directions.shape} directions: expected (n, 3) and (n,)")
        if not np.isfinite(poses).all() or not (np.abs(directions) == 1.0).all():
            raise InputError("guide: expected finite poses and directions of +1 or -1")
        object.__setattr__(self, "poses", poses)
        object.__setattr__(self, "directions", directions)

    @classmethod
    def from_motion(cls, path: MotionPath, step: float = 0.08) -> "Guide":
        """Guide along a drivable path, a pose every ``step`` metres."""
        samples = path.sample(step)
        return cls(samples.poses, samples.direction)

    @classmethod
    def from_message(cls, path: Path, vehicle: Vehicle) -> "Guide":
        """Guide of a ``plan/path`` message, whose poses are those of the base."""
        poses = path.poses.reshape(-1, 3)
        directions = path.directions if len(path.directions) else np.ones(len(poses))
        return cls(moved(poses, vehicle.reference), np.array(directions))

    def part(self, begin: int, end: int) -> "Guide":
        """Poses begin to end - 1."""
        return Guide(self.poses[begin:end], self.directions[begin:end])

    def then(self, other: "Guide") -> "Guide":
        """These poses and then the other ones."""
        return Guide(np.vstack((self.poses, other.poses)), np.concatenate((self.directions, other.directions)))

    @property
    def travelled(self) -> Array:
        """Metres from the first pose to each."""
        steps = np.hypot(*np.diff(self.poses[:, :2], axis=0).T)
        return np.concatenate(([0.0], np.cumsum(steps)))


@dataclass(frozen=True, slots=True)
class Memory:
    """What a deformer keeps from one cycle to the next."""

    guide: Guide | None = None
    """The route that the rest belongs to."""
    band: Guide | None = None
    """The band of the last cycle."""
    entered: int = 0
    """Poses of the guide that are in the band, or behind."""
    path: MotionPath | None = None
    """The result of the last cycle."""
    failed: int = 0
    """Local searches in a row that found nothing: the next one takes another heading at its goal."""
    turning: tuple[float, ...] = ()
    """Of a turn on the spot: start x, y, yaw and wanted yaw."""


@dataclass(frozen=True)
class DeformResult:
    """A drivable path round the obstacles, or why there is none."""

    reason: Reason
    """OK; PATH_PARTIAL: only a part is free, and is given; else there is no path."""
    memory: Memory
    """For the next cycle."""
    path: MotionPath | None = None
    """Begins at the truck, ends at the end of the route or before."""
    complete: bool = False
    """Whether the path ends at the end of the route."""
    text: str = ""
    """What exactly was wrong."""
    statistics: dict[str, float] = field(default_factory=dict)

    @property
    def valid_length(self) -> float:
        """Metres that may be driven."""
        return self.path.length if self.path is not None else 0.0

    @property
    def ok(self) -> bool:
        """Whether there is something to drive."""
        return self.path is not None


class Deformer(Protocol):
    """Pure: equal arguments give equal results."""

    vehicle: Vehicle

    def deform(self, guide: Guide, surroundings: DistanceField, pose: ArrayLike, memory: Memory) -> DeformResult:
        """Drivable path along a guide, round what stands on it now.

        Args:
            guide: the route.
            surroundings: obstacles in a window round the truck.
            pose: x, y, yaw of the reference point, in the frame of both.
            memory: of the cycle before, ``Memory()`` at first.
        """
        ...


class Session:
    """A deformer with its memory: one call for every scan.

    Args:
        deformer: does the work.
    """

    def __init__(self, deformer: Deformer) -> None:
        self.deformer = deformer
        self.memory = Memory()

    def step(self, guide: Guide, surroundings: DistanceField, pose: ArrayLike) -> DeformResult:
        """One cycle, see ``Deformer.deform``; another guide than before starts afresh."""
        result = self.deformer.deform(guide, surroundings, pose, self.memory)
        self.memory = result.memory
        return result


def apart(a: Array, b: Array, reach: float = 0.3) -> Array:
    """Distance of poses (..., 3): metres plus ``reach`` times the angle between them."""
    away: Array = np.hypot(a[..., 0] - b[..., 0], a[..., 1] - b[..., 1])
    turned = np.abs(np.remainder(a[..., 2] - b[..., 2] + math.pi, math.tau) - math.pi)
    return np.asarray(away + reach * turned)
