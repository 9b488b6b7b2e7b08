"""A path as a sequence of poses: routes, elastic bands, planners' answers."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.plan import Path, Steering

CUSP_REACHED: Final = 0.1
"""Distance to a cusp of its band below which the truck continues with the part after the cusp (m)."""


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
        """Return the path in a message; ``check_path`` checks the further requirements of a tracker.

        Raises:
            InputError: the message contains no valid path.
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
        """Return these poses followed by the other ones, without steering, clearance and speeds."""
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
        """Indices of the poses where the robot stops before the end."""
        return np.flatnonzero(stops(self.directions[1:], self.steering[1:])) + 1


def stops(directions: Array, steering: Sequence[Steering]) -> NDArray[np.bool_]:
    """Return whether the robot must come to rest between each two steps.

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
    """Whether the axles turn so far between two steering modes that the robot must stand meanwhile."""
    return "crab" in (before, after) and "hybrid" not in (before, after)


def pose_distance(a: Array, b: Array, reach: float = 0.3) -> Array:
    """Return the distance of poses (..., 3): metres plus ``reach`` times the angle between them."""
    away: Array = np.hypot(a[..., 0] - b[..., 0], a[..., 1] - b[..., 1])
    turned = np.abs(np.remainder(a[..., 2] - b[..., 2] + math.pi, math.tau) - math.pi)
    return np.asarray(away + reach * turned)


def nearest_pose(band: PosePath, pose: Array) -> int:
    """Return the band's pose nearest to the truck, not beyond a cusp that the truck has not reached."""
    for begin, end in direction_runs(band.directions):
        at = begin + int(np.argmin(pose_distance(band.poses[begin:end], pose)))
        last = band.poses[end - 1]
        if end == len(band.poses) or math.hypot(last[0] - pose[0], last[1] - pose[1]) > CUSP_REACHED:
            return at
    return 0


def direction_runs(directions: Array) -> Iterator[tuple[int, int]]:
    """Yield the index ranges of one direction; the pose at a cusp belongs to the ranges before and after it."""
    cuts = [*np.flatnonzero(np.diff(directions)).tolist(), len(directions) - 1]
    begin = 0
    for cut in cuts:
        yield begin, cut + 1
        begin = cut
