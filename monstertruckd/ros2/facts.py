"""The robot's configuration as ROS 2 needs it: description, outline, lens and joints."""

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
    """m."""
    width: float
    """m."""
    lens: LensConfig | None = None
    description: str | None = None
    """URDF with the robot's own names of frames; None: its body has none."""
    joints: "WheelJoints | None" = None
    localised: bool = True
    """Whether the robot finds its place by itself; False where it takes map to odom from ROS 2."""
    mapped: bool = True
    """Whether the map is the robot's own; False where it takes ``map`` from ROS 2."""
    plans: bool = True
    """Whether the robot's own planner serves goals; False where Nav2 does and drives by ``cmd_vel``."""


@dataclass(frozen=True, slots=True)
class WheelJoints:
    """Angles of the wheels of a body with two axles and one driven shaft."""

    chassis: Chassis
    track: float
    """Distance between left and right wheels (m)."""
    ratio: float
    """Turns of the motor for one of the wheels."""

    def angles(self, steering: SteeringFeedback | None, drive: DriveFeedback) -> Mapping[str, float]:
        """Steering angle and rotation, rad, by joint of the description; all wheels are shown at the same angle."""
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
    """The description with the frames of its links as ROS 2 has them; joints keep their names."""
    robot = ET.fromstring(urdf)  # noqa: S314 - our own text
    for element in (*robot.iter("link"), *robot.iter("parent"), *robot.iter("child")):
        attribute = "name" if element.tag == "link" else "link"
        element.set(attribute, name(element.get(attribute, "")))
    return '<?xml version="1.0"?>\n' + ET.tostring(robot, encoding="unicode") + "\n"
