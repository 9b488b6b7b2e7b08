"""Kinematics of a tracked vehicle (Martinez et al., IJRR 2005: turning centres of the tracks are constant)."""

from monstertruck_kinematics.chassis import Chassis, Dimensions, FamilyChassis
from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_kinematics.unsteered import SkidSteer


def tracked_chassis(size: Dimensions, steering_ratio: float) -> Chassis:
    """Two tracks.

    Args:
        size: the robot's.
        steering_ratio: see ``TrackedBody``.
    """
    radius, centre = size.drivetrain.wheel_radius, steering_ratio * size.track / 2
    family = SkidSteer(radius, centre, -centre)
    bicycle = FourWheelSteering(size.wheelbase, size.track, cg_split=1.0)
    return FamilyChassis(bicycle, size.drivetrain, ("left", "right"), "front", None, family, 1.0 / radius)
