"""A path as poses in the order in which they are driven: routes, elastic bands, planners' answers."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.plan import Path, Steering


@dataclass(frozen=True)
class PosePath:
    """Poses to be driven in order, of the base or of another point of the robot.

    Args:
        poses: shape (n, 3), x, y (m), yaw (rad), n at least 1.
        directions: shape (n,), +1 where the robot arrives forward, -1 backward.
        steering: n of them, how the axles steer where the robot arrives; none: the tracker's own.
        clearance: shape (n,), distance from the footprint to the nearest obstacle, m; None if not known.
        speeds: shape (n,), greatest speed, m/s; None if the path sets none.

    Raises:
        InputError: shapes or numbers do not describe a path.
    """

    poses: Array
    directions: Array
    steering: tuple[Steering, ...] = ()
    clearance: Array | None = None
    speeds: Array | None = None

    def __post_init__(self) -> None:
        poses, directions = np.asarray(self.poses, dtype=np.float64), np.asarray(self.directions, dtype=np.float64)
        if poses.ndim != 2 or poses.shape[1] != 3 or not len(poses) or directions.shape != (len(poses),):
            raise InputError(f"path of {poses.shape} poses, {directions.shape} directions: expected (n, 3) and (n,)")
        if not np.isfinite(poses).all() or not (np.abs(directions) == 1.0).all():
            raise InputError("path of poses: expected finite poses and directions of +1 or -1")
        if len(self.steering) not in (0, len(poses)):
            raise InputError(f"path of {len(poses)} poses, {len(self.steering)} steering modes: expected one for each")
        object.__setattr__(self, "poses", poses)
        object.__setattr__(self, "directions", directions)

    @classmethod
    def of(cls, message: Path) -> "PosePath":
        """Return the path in a message; ``check_path`` has the further demands of a tracker.

        Raises:
            InputError: it is none.
        """
        if len(message.poses) % 3:
            raise InputError(f"path of {len(message.poses)} numbers: expected rows of x, y, yaw")
        poses = message.poses.reshape(-1, 3)
        directions = message.directions if len(message.directions) else np.ones(len(poses))
        clearance, speeds = (row if len(row) else None for row in (message.clearance, message.speeds))
        return cls(poses, directions, message.steering, clearance, speeds)

    def part(self, begin: int, end: int) -> "PosePath":
        """Poses begin to end - 1."""
        return PosePath(
            self.poses[begin:end],
            self.directions[begin:end],
            self.steering[begin:end],
            None if self.clearance is None else self.clearance[begin:end],
            None if self.speeds is None else self.speeds[begin:end],
        )

    def at(self, index: NDArray[np.intp]) -> "PosePath":
        """Return the poses of these indices, in this order."""
        return PosePath(
            self.poses[index],
            self.directions[index],
            tuple(self.steering[i] for i in index.tolist()) if self.steering else (),
            None if self.clearance is None else self.clearance[index],
            None if self.speeds is None else self.speeds[index],
        )

    def then(self, other: "PosePath") -> "PosePath":
        """These poses and then the other ones; steering, clearance and speeds are left out."""
        return PosePath(np.vstack((self.poses, other.poses)), np.concatenate((self.directions, other.directions)))

    @cached_property
    def travelled(self) -> Array:
        """Metres from the first pose to each, shape (n,)."""
        steps = np.hypot(*np.diff(self.poses[:, :2], axis=0).T)
        return np.concatenate(([0.0], np.cumsum(steps)))

    @property
    def length(self) -> float:
        """Metres from the first pose to the last."""
        return float(np.hypot(*np.diff(self.poses[:, :2], axis=0).T).sum())

    @property
    def stops(self) -> NDArray[np.intp]:
        """Indices of the poses at which the robot stops before the end."""
        return np.flatnonzero(stops(self.directions[1:], self.steering[1:])) + 1


def stops(directions: Array, steering: Sequence[Steering]) -> NDArray[np.bool_]:
    """Whether the robot has to come to rest between each two steps.

    Args:
        directions: shape (n,), +1 or -1 of each step.
        steering: steering of each step, or empty.

    Returns:
        Shape (n - 1,).
    """
    at_rest: NDArray[np.bool_] = np.diff(directions) != 0.0
    if len(at_rest):
        for i, (before, after) in enumerate(pairwise(steering)):
            if before != after and _must_stand(before, after):
                at_rest[i] = True
    return at_rest


def _must_stand(before: Steering, after: Steering) -> bool:
    """Whether the axles turn so far between two different ways of steering that the robot has to stand meanwhile."""
    return "crab" in (before, after) and "hybrid" not in (before, after)
