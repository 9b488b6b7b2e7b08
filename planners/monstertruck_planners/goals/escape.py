"""Backing out of a tight place, as by car_maneuver_recovery (G. Kouros), with its errors corrected.

The rule is its own: of the footprint's four sides those are found that are not free. With both ends blocked there is no
path out; else the truck drives forward if it can, backward otherwise, steering away from the side that is blocked.
Three things differ. Speeds follow from the axle angles by the truck's kinematics, where the package's forward speed had
sqrt(1 / (1 + tan b)) for cos b. A side is the whole side, not three points of it. And the path is checked as a whole.
"""

from dataclasses import dataclass, replace

import numpy as np

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.collision import Footprint, first_contact, swept_poses
from monstertruck_planners.goals.config import EscapeConfig
from monstertruck_schemas.plan import Steering

ESCAPE_POSE_STEP = 0.02
"""Metres between two poses of the path."""


@dataclass(frozen=True, slots=True)
class Sides:
    """Which sides of the footprint have something within reach."""

    front: bool
    rear: bool
    left: bool
    right: bool

    @property
    def any(self) -> bool:
        """Whether one of them has."""
        return self.front or self.rear or self.left or self.right


@dataclass(frozen=True)
class Escape:
    """An escape motion."""

    poses: Array
    """Shape (n, 3): of the base, in the frame of the truck at its start."""
    direction: int
    """+1 or -1."""
    steering: Steering


def blocked_sides(footprint: Footprint, points: Array, room: float) -> Sides:
    """Sides with a point nearer than ``room``, m; points have shape (n, 2) and are in the base frame."""
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
    """The escape motion, or None if both ends are blocked or it is too short.

    Args:
        config: distances and angle.
        geometry: the truck's.
        footprint: its outline.
        points: shape (n, 2), obstacles in the base frame, m.
        crab: the vehicle can set both axles alike.
        rear: the rear axle steers.
        unseen: shape (n, 2), ground in the base frame onto which it must not back, m.
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
    """A motion up to the pose before a contact; None if that is too short."""
    poses = motion.poses[:contact]
    # 0.04: least length of an escape motion, m
    return replace(motion, poses=poses) if (len(poses) - 1) * ESCAPE_POSE_STEP >= 0.04 else None
