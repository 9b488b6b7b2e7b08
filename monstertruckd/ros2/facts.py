"""Parts of the robot's configuration for ROS 2: description, outline, lens and joints."""

import math
import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from monstertruck_kinematics.chassis import Chassis
from monstertruck_schemas.body import LensConfig
from monstertruck_schemas.sensor import DriveFeedback, SteeringFeedback

WHEELS: Final = {
    "front_left": (1, 1),
    "front_right": (1, -1),
    "rear_left": (-1, 1),
    "rear_right": (-1, -1),
}
"""Wheels of a body with two axles, with the signs of their x and y in base."""


@dataclass(frozen=True, slots=True)
class RobotFacts:
    """Data of the robot's configuration that the ROS 2 node needs."""

    length: float
    """Length of the footprint (m)."""
    width: float
    """Width of the footprint (m)."""
    lens: LensConfig | None = None
    description: str | None = None
    """URDF with the robot's own frame names; None if its body has none."""
    joints: "WheelJoints | None" = None
    localised: bool = True
    """Whether the robot localises itself; False if ROS 2 provides map to odom."""
    mapped: bool = True
    """Whether the robot builds its own map; False if ROS 2 provides ``map``."""
    plans: bool = True
    """Whether the robot's own planner serves goals; False if Nav2 plans and drives by ``cmd_vel``."""


@dataclass(frozen=True, slots=True)
class WheelJoints:
    """Joint angles of the wheels of a body with two axles and one driven shaft."""

    chassis: Chassis
    track: float
    """Distance between left and right wheels (m)."""
    ratio: float
    """Motor turns per wheel turn."""

    def angles(self, steering: SteeringFeedback | None, drive: DriveFeedback) -> Mapping[str, float]:
        """Return steering angle and rotation (rad) by joint of the description; all wheels have the same angle."""
        found = {f"{wheel}_spin": drive.position / self.ratio for wheel in WHEELS}
        if steering is None or not self.chassis.steered:
            return found
        bicycle = self.chassis.bicycle
        vx, vy, wz = bicycle.body_twist(1.0, *self.chassis.steering(*steering.servos))
        for wheel, (front, left) in WHEELS.items():
            x, y = bicycle.l_f if front > 0 else -bicycle.l_r, left * self.track / 2.0
            found[f"{wheel}_steer"] = math.atan2(vy + wz * x, vx - wz * y)
        return found


def renamed_links(urdf: str, name: Callable[[str], str]) -> str:
    """Return the description with the links renamed to their ROS frames; joints keep their names."""
    robot = ET.fromstring(urdf)  # noqa: S314 - our own text
    for element in (*robot.iter("link"), *robot.iter("parent"), *robot.iter("child")):
        attribute = "name" if element.tag == "link" else "link"
        element.set(attribute, name(element.get(attribute, "")))
    return '<?xml version="1.0"?>\n' + ET.tostring(robot, encoding="unicode") + "\n"
