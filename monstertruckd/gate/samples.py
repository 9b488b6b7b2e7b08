"""Latest valid sample of every sensor, and its freshness."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from monstertruck_kinematics.chassis import Chassis, Speeds
from monstertruck_kinematics.se2 import Twist2
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.ports import Value
from monstertruck_schemas import topics
from monstertruck_schemas.base import Message
from monstertruck_schemas.event import Measurement
from monstertruck_schemas.health import HealthTable, ServiceState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.roles import DeviceRole
from monstertruck_schemas.sensor import (
    VALID_BEAM,
    Attitude,
    Battery,
    BatteryLevel,
    DriveFeedback,
    DriveMode,
    LaserScan,
    SteeringFeedback,
)
from monstertruck_schemas.topics import Topic
from monstertruckd.gate.config import InForce, SensorLimit

STALE_TOPICS: Final[Mapping[Topic[Any], Reason]] = {
    topics.SCAN: Reason.SCAN_STALE,
    topics.COMPASS: Reason.ATTITUDE_STALE,
    **dict.fromkeys(topics.DRIVES, Reason.DRIVE_STALE),
    topics.STEERING: Reason.STEERING_STALE,
}
"""Topics whose samples become stale as soon as their writing service reports its loss."""

STALE_SENSORS: Final = {
    Reason.SCAN_STALE: DeviceRole.LIDAR,
    Reason.ATTITUDE_STALE: DeviceRole.COMPASS,
    Reason.DRIVE_STALE: DeviceRole.DRIVE,
    Reason.STEERING_STALE: DeviceRole.STEERING,
    Reason.BATTERY_STALE: DeviceRole.BATTERY,
}
"""Stale sensor by reason."""

MEASURED: Final = frozenset(BatteryLevel) - {BatteryLevel.UNKNOWN, BatteryLevel.SENSOR_FAULT}
"""Levels of a valid battery reading."""


@dataclass(frozen=True, slots=True)
class Staleness:
    """A sensor without a valid sample."""

    since: int | None
    """Time when the latest valid sample became stale, ns; None if there never was a valid sample."""
    age: float | None
    """Age of the latest valid sample, s; None if a valid sample is missing."""
    limit: float
    """Maximum age, s."""
    refused: Measurement | None
    """Why a later sample was rejected."""


class Samples:
    """Latest valid sample of every sensor.

    Args:
        limits: limits in force.
        chassis: kinematics of the body.
        services: staleness reason that applies at once when a service reports its loss, by service name.
    """

    def __init__(self, limits: InForce, chassis: Chassis, services: Mapping[str, Reason]) -> None:
        self._limits = limits
        self._services = services
        self._chassis = chassis
        self.scan: LaserScan | None = None
        self.drives: list[DriveFeedback | None] = [None] * len(chassis.shafts)
        self.steering: SteeringFeedback | None = None
        self.attitude: Attitude | None = None
        self.tilt = 0.0
        """Angle between the robot's z axis and the vertical by the latest valid attitude, rad."""
        self._shaken: Attitude | None = None
        """Latest attitude whose tilt is hidden by an acceleration."""
        self.battery: Battery | None = None
        self._lost: dict[Reason, int] = {}
        self._refused: dict[Reason, Measurement] = {}
        self._speed: tuple[int, float | None] | None = None
        """Time (ns) and cached result of ``speed``, valid until the next sample."""
        self.angles = chassis.straight
        """Steering angles by the latest steering feedback, rad."""

    def observe(self, message: Message, topic: Topic[Any]) -> None:
        """Take a message of a topic."""
        match message:
            case LaserScan():
                self._take_scan(message)
            case DriveFeedback():
                if self._valid(message, Reason.DRIVE_STALE):
                    self.drives[topics.DRIVES.index(topic)] = message
                    self._speed = None
            case SteeringFeedback():
                if self._valid(message, Reason.STEERING_STALE) and message.trusted:
                    self.steering = message
                    self.angles = self._chassis.steering(*message.servos)
            case Attitude():
                if not self._valid(message, Reason.ATTITUDE_STALE):
                    return
                if message.tilt_valid:
                    self.attitude = message
                    self.tilt = math.acos(math.cos(message.roll) * math.cos(message.pitch))
                else:
                    self._shaken = message
            case Battery():
                if self._valid(message, Reason.BATTERY_STALE) and message.level in MEASURED:
                    self.battery = message
            case HealthTable():
                self._lose(message)

    def _take_scan(self, scan: LaserScan) -> None:
        """Take a scan unless its latency, the tilt of its plane or the lack of any range makes it invalid."""
        if not self._valid(scan, Reason.SCAN_STALE):
            return
        config = self._limits.config
        if not (config.obstacle.open_ground or (scan.codes == VALID_BEAM).any()):
            self._refused[Reason.SCAN_STALE] = Measurement(name="beams with a range", value=0.0, limit=1.0)
        elif scan.tilt is not None and scan.tilt > config.scan_tilt:
            self._refused[Reason.SCAN_STALE] = Measurement(
                name="scan plane tilt", value=scan.tilt, unit="rad", limit=config.scan_tilt
            )
        else:
            self.scan = scan

    def _lose(self, table: HealthTable) -> None:
        """Mark samples from before the loss of a service as stale."""
        for service in table.services:
            if service.state is not ServiceState.READY and (stale := self._services.get(service.name)) is not None:
                self._lost[stale] = max(service.since, self._lost.get(stale, service.since))
                self._speed = None

    def gives(self, service: str) -> Reason | None:
        """Staleness reason of the sensor that is lost with a service."""
        return self._services.get(service)

    def _valid(self, message: Message, stale: Reason) -> bool:
        latency = abs(message.received - message.stamp) / SECOND
        if latency <= self._limits.config.max_latency:
            self._refused.pop(stale, None)
            return True
        limit = self._limits.config.max_latency
        self._refused[stale] = Measurement(name="latency", value=latency, unit="s", limit=limit)
        return False

    def _fresh(self, message: Message | None, limit: SensorLimit | None, now: int, stale: Reason) -> bool:
        """Whether a sample is fresh; False for a sensor that the robot does not have (no limit)."""
        if limit is None or message is None or message.received <= self._lost.get(stale, -1):
            return False
        return now - message.received <= limit.stale_after * SECOND

    def scan_fresh(self, now: int) -> bool:
        """Whether the scan is fresh."""
        return self._fresh(self.scan, self._limits.config.scan, now, Reason.SCAN_STALE)

    def steering_fresh(self, now: int) -> bool:
        """Whether the steering feedback is fresh."""
        return self._fresh(self.steering, self._limits.config.steering, now, Reason.STEERING_STALE)

    def attitude_fresh(self, now: int) -> bool:
        """Whether the attitude is fresh."""
        return self._fresh(self.attitude, self._limits.config.attitude, now, Reason.ATTITUDE_STALE)

    def tips(self, now: int) -> bool:
        """Whether the robot falls over or slides down at ``now`` (ns), by the last measured tilt.

        While it falls, its acceleration hides the tilt from the sensor.
        """
        shaken = self._fresh(self._shaken, self._limits.config.attitude, now, Reason.ATTITUDE_STALE)
        return (shaken or self.attitude_fresh(now)) and self.tilt >= self._limits.config.tilt.stop

    def battery_fresh(self, now: int) -> bool:
        """Whether the battery voltage is fresh."""
        return self._fresh(self.battery, self._limits.config.battery, now, Reason.BATTERY_STALE)

    @property
    def faults(self) -> list[DriveFeedback]:
        """Latest feedback of every drive that reports a fault."""
        return [drive for drive in self.drives if drive is not None and drive.mode is DriveMode.FAULT]

    def values(self, now: int) -> dict[str, Value]:
        """Measurements for events at ``now``, ns."""
        values: dict[str, Value] = {}
        if faults := self.faults:
            values["drive_fault_code"] = faults[-1].fault_code
        if self.attitude_fresh(now):
            values["tilt"] = self.tilt
        if self.battery is not None:
            values["battery_voltage"] = self.battery.voltage
        return values

    def speed(self, now: int) -> float | None:
        """Measured speed of the fastest wheel over ground, m/s; None without fresh feedback of every shaft."""
        if self._speed is None or self._speed[0] != now:
            rolling = self.shaft_speeds(now)
            self._speed = now, self._chassis.fastest_wheel_speed(rolling) if rolling else None
        return self._speed[1]

    def shaft_speeds(self, now: int) -> Speeds:
        """Measured wheel speed over ground of every driven shaft, m/s; empty without fresh feedback of all of them."""
        return tuple([self._chassis.drivetrain.speed(drive.velocity) for drive in self._fresh_drives(now)])

    def twist(self, now: int) -> Twist2 | None:
        """Velocity of the base by measured shaft speeds and latest steering angles; None without fresh shaft speeds."""
        rolling, angles = self.shaft_speeds(now), self.angles
        return self._chassis.twist(self._chassis.input_speeds(rolling, *angles), *angles) if rolling else None

    def turn_rate(self, now: int) -> float:
        """Yaw rate of ``twist``, rad/s; 0 if the twist is unknown."""
        twist = self.twist(now)
        return 0.0 if twist is None else twist[2]

    def _fresh_drives(self, now: int) -> list[DriveFeedback]:
        """Feedback of all shafts; empty unless all are fresh."""
        limit = self._limits.config.drive
        drives = [d for d in self.drives if d is not None and self._fresh(d, limit, now, Reason.DRIVE_STALE)]
        return drives if len(drives) == len(self.drives) else []

    def sensor_limits(self) -> dict[Reason, SensorLimit]:
        """Limits of the robot's sensors by staleness reason, worst first."""
        config = self._limits.config
        limits = {
            Reason.DRIVE_STALE: config.drive,
            Reason.STEERING_STALE: config.steering,
            Reason.SCAN_STALE: config.scan,
            Reason.ATTITUDE_STALE: config.attitude,
            Reason.BATTERY_STALE: config.battery,
        }
        return {reason: limit for reason, limit in limits.items() if limit is not None}

    def fresh(self, now: int) -> dict[Reason, bool]:
        """Whether each sensor is fresh, by its staleness reason."""
        return {
            Reason.DRIVE_STALE: bool(self._fresh_drives(now)),
            Reason.STEERING_STALE: self.steering_fresh(now),
            Reason.SCAN_STALE: self.scan_fresh(now),
            Reason.ATTITUDE_STALE: self.attitude_fresh(now),
            Reason.BATTERY_STALE: self.battery_fresh(now),
        }

    def at_rest(self, now: int, since: int = 0) -> bool:
        """Whether the truck is known to be at rest, by a sample not older than ``since``, ns.

        A truck without a critical drive counts as at rest.
        """
        speed = self.speed(now)
        if speed is None:
            return not self._limits.config.drive.critical
        sampled = min(drive.stamp for drive in self._fresh_drives(now))
        return sampled >= since and abs(speed) < self._limits.config.standstill

    def staleness(self, stale: Reason, now: int) -> Staleness:
        """Details of the stale sensor behind ``stale``; with several shafts, of the oldest sample."""
        samples: tuple[Message | None, ...] = {
            Reason.SCAN_STALE: (self.scan,),
            Reason.ATTITUDE_STALE: (self.attitude,),
            Reason.DRIVE_STALE: tuple(self.drives),
            Reason.STEERING_STALE: (self.steering,),
            Reason.BATTERY_STALE: (self.battery,),
        }[stale]
        limit = self.sensor_limits()[stale]
        received = [sample.received for sample in samples if sample is not None]
        lost = self._lost.get(stale)
        refused = self._refused.get(stale)
        if len(received) < len(samples):
            return Staleness(lost, None, limit.stale_after, refused)
        oldest = min(received)
        since = min(now, oldest + round(limit.stale_after * SECOND))
        if lost is not None and lost >= oldest:
            since = min(since, lost)
        return Staleness(since, (now - oldest) / SECOND, limit.stale_after, refused)


def age(message: Message | None, now: int) -> float | None:
    """Age of a message, s; None without a message."""
    return None if message is None else (now - message.received) / SECOND
