"""Backing out of a tight place, as in car_maneuver_recovery (G. Kouros), with its errors corrected.

The rule is unchanged: find the blocked sides of the footprint. With both ends blocked there is no path out. Otherwise
the truck drives forward if it can, else backward, steering away from the blocked side. There are three differences.
Speeds follow from the axle angles by the truck kinematics; the package used sqrt(1 / (1 + tan b)) instead of cos b in
the forward speed. A side is the whole side, not three points of it. The path is checked as a whole.
"""

from dataclasses import dataclass, replace

import numpy as np

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.collision import Footprint, first_contact, swept_poses
from monstertruck_planners.goals.config import EscapeConfig
from monstertruck_schemas.plan import Steering

ESCAPE_POSE_STEP = 0.02
"""Spacing of the poses of the path (m)."""


@dataclass(frozen=True, slots=True)
class Sides:
    """Blocked sides of the footprint."""

    front: bool
    rear: bool
    left: bool
    right: bool

    @property
    def any(self) -> bool:
        """Whether any side is blocked."""
        return self.front or self.rear or self.left or self.right


@dataclass(frozen=True)
class Escape:
    """Escape motion."""

    poses: Array
    """Poses of the base in the frame of the truck at the start, shape (n, 3)."""
    direction: int
    """+1 or -1."""
    steering: Steering


def blocked_sides(footprint: Footprint, points: Array, room: float) -> Sides:
    """Return the sides with a point nearer than ``room`` (m); points (n, 2) in the base frame."""
    x, y = points[:, 0] - footprint.offset, points[:, 1]
    length, width = footprint.half_length, footprint.half_width
    within, along = np.abs(y) <= width, np.abs(x) <= length
    return Sides(
        front=bool((within & (x > 0) & (x - length < room)).any()),
        rear=bool((within & (x < 0) & (-x - length < room)).any()),
        left=bool((along & (y > 0) & (y - width < room)).any()),
        right=bool((along & (y < 0) & (-y - width < room)).any()),
    )


def escape(
    config: EscapeConfig, geometry: FourWheelSteering, footprint: Footprint, points: Array, *, crab: bool, rear: bool,
    unseen: Array | None = None,
) -> Escape | None:  # fmt: skip
    """Return the escape motion, or None if both ends are blocked or the motion is too short.

    Args:
        config: distances and angle.
        geometry: steering geometry of the truck.
        footprint: footprint of the truck.
        points: obstacles in the base frame (m), shape (n, 2).
        crab: whether the vehicle can set both axles to the same angle.
        rear: whether the rear axle steers.
        unseen: unseen ground in the base frame (m), shape (n, 2); the truck must not back onto it.
    """
    sides = blocked_sides(footprint, points, config.room)
    ahead, behind = not sides.front, not sides.rear
    away = 0.0 if sides.left == sides.right else (-config.angle if sides.left else config.angle)
    directions = ([1] if ahead else []) + ([-1] if behind else [])
    if sides.front and not sides.rear:
        directions = [-1]
    for direction in directions:
        for angle in dict.fromkeys((away, 0.0)):
            found = _motion(config, geometry, footprint, points, direction, angle, crab=crab and config.crab, rear=rear)
            if found is not None and direction < 0 and unseen is not None:
                found = _before(found, first_contact(footprint, found.poses, unseen, -footprint.padding))
            if found is not None:
                return found
    return None


def _motion(
    config: EscapeConfig, geometry: FourWheelSteering, footprint: Footprint, points: Array, direction: int,
    away: float, *, crab: bool, rear: bool,
) -> Escape | None:  # fmt: skip
    front = direction * away
    behind = front if crab else (-front if rear else 0.0)
    steering: Steering = "crab" if crab else ("counter" if rear else "front")
    distances = direction * np.arange(0.0, config.distance + ESCAPE_POSE_STEP / 2, ESCAPE_POSE_STEP)
    poses = swept_poses(geometry.body_twist(1.0, front, behind), distances)
    contact = first_contact(footprint, poses, points, config.margin)
    return _before(Escape(poses, direction, steering), contact)


def _before(motion: Escape, contact: int | None) -> Escape | None:
    """Return a motion up to the pose before a contact; None if that is too short."""
    poses = motion.poses[:contact]
    # 0.04: minimum length of an escape motion (m)
    return replace(motion, poses=poses) if (len(poses) - 1) * ESCAPE_POSE_STEP >= 0.04 else None
