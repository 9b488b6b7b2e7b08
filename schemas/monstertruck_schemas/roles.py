"""Names shared by the whole robot: roles of devices, other services, and roles of request sources."""

from enum import StrEnum
from typing import Final


class DeviceRole(StrEnum):
    """Purpose of a device: its key in the configuration, the name of its service, its measuring frame.

    Devices of other packages have their own role names; nothing in the daemon refers to them by name.
    """

    LIDAR = "lidar"
    LIDAR_2 = "lidar_2"
    DRIVE = "drive"
    DRIVE_2 = "drive_2"
    DRIVE_3 = "drive_3"
    DRIVE_4 = "drive_4"
    WHEELS = "wheels"
    ACTUATORS = "actuators"
    STEERING = "steering"
    COMPASS = "compass"
    STABILISER = "stabiliser"
    CAMERA = "camera"
    SONAR = "sonar"
    IMU = "imu"
    ENCODERS = "encoders"
    HAND = "hand"
    BATTERY = "battery"
    LINK = "link"
    HOST = "host"


SHAFTS: Final = (DeviceRole.DRIVE, DeviceRole.DRIVE_2, DeviceRole.DRIVE_3, DeviceRole.DRIVE_4)
"""Driven shafts in the body's order; each has a controller of this role, or ``WHEELS`` or
``ACTUATORS`` controls them all."""


class ServiceName(StrEnum):
    """Names of services without a device. A device role of another package must not use one of them."""

    BEHAVIOURS = "behaviours"
    BLACKBOX = "blackbox"
    CALIBRATION = "calibration"
    CLOCK = "clock"
    CONSISTENCY = "consistency"
    EXPLORER = "explorer"
    GATE = "gate"
    GOALS = "goals"
    GROUND = "ground"
    HAND_DRIVE = "hand_drive"
    HEALTH = "health"
    KNOWN_MAP = "known_map"
    LEVELLING = "levelling"
    LIDAR_SONARS = "lidar_sonars"
    MAP = "map"
    METER = "meter"
    MISSIONS = "missions"
    NOTIFY = "notify"
    ODOMETRY = "odometry"
    PATH = "path"
    PEERS = "peers"
    POINTS = "points"
    RECORDER = "recorder"
    SLAM = "slam"
    STALLS = "stalls"
    TRACKER = "tracker"
    TRANSFORMS = "transforms"
    USB = "usb"
    ZENOH = "zenoh"
    ZONES = "zones"


class AccessRole(StrEnum):
    """Permissions of a source; each role includes the roles before it."""

    OBSERVER = "observer"
    """See everything, and order an emergency stop."""
    PILOT = "pilot"
    """Drive, give orders and goals."""
    ENGINEER = "engineer"
    """Save and undo calibrations, and drive by shaft speeds, open loop."""

    def covers(self, needed: "AccessRole") -> bool:
        """Whether this role includes ``needed``."""
        roles = list(AccessRole)
        return roles.index(self) >= roles.index(needed)
