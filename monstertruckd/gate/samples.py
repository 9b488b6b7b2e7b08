"""Latest valid sample of every sensor, and its freshness."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

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
    **dict.fromkeys(topics.SCANS, Reason.SCAN_STALE),
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
    source: DeviceRole
    """The stale sensor; of several, the one with the oldest sample."""


class _Sample(NamedTuple):
    """Latest valid sample of one sensor."""

    lidar: DeviceRole | None
    """The lidar, of a robot with several; None for every other sensor."""
    topic: Topic[Any]
    sample: Message | None


class Samples:
    """Latest valid sample of every sensor.

    Args:
        limits: limits in force.
        chassis: kinematics of the body.
        services: staleness reason that applies at once when a service reports its loss, by service name.
        lidars: number of lidars.
    """

    def __init__(self, limits: InForce, chassis: Chassis, services: Mapping[str, Reason], lidars: int = 1) -> None:
        self._limits = limits
        self._services = services
        self._chassis = chassis
        self.scans: list[LaserScan | None] = [None] * lidars
        self._lidars = (DeviceRole.LIDAR, DeviceRole.LIDAR_2)[:lidars] if lidars > 1 else (None,)
        self.drives: list[DriveFeedback | None] = [None] * len(chassis.shafts)
        self.steering: SteeringFeedback | None = None
        self.attitude: Attitude | None = None
        self.tilt = 0.0
        """Angle between the robot's z axis and the vertical by the latest valid attitude, rad."""
        self._shaken: Attitude | None = None
        """Latest attitude whose tilt is hidden by an acceleration."""
        self.battery: Battery | None = None
        self._lost: dict[str, int] = {}
        """Latest loss of every service, ns."""
        self._refused: dict[Topic[Any], Measurement] = {}
        self._speed: tuple[int, float | None] | None = None
        """Time (ns) and cached result of ``speed``, valid until the next sample."""
        self.angles = chassis.straight
        """Steering angles by the latest steering feedback, rad."""

    def observe(self, message: Message, topic: Topic[Any]) -> None:
        """Take a message of a topic."""
        match message:
            case LaserScan():
                self._take_scan(message, topic)
            case DriveFeedback():
                if self._valid(message, topic):
                    self.drives[topics.DRIVES.index(topic)] = message
                    self._speed = None
            case SteeringFeedback():
                if self._valid(message, topic) and message.trusted:
                    self.steering = message
                    self.angles = self._chassis.steering(*message.servos)
            case Attitude():
                if not self._valid(message, topic):
                    return
                if message.tilt_valid:
                    self.attitude = message
                    self.tilt = math.acos(math.cos(message.roll) * math.cos(message.pitch))
                else:
                    self._shaken = message
            case Battery():
                if self._valid(message, topic) and message.level in MEASURED:
                    self.battery = message
            case HealthTable():
                self._lose(message)

    def _take_scan(self, scan: LaserScan, topic: Topic[Any]) -> None:
        """Take a scan unless its latency, the tilt of its plane or the lack of any range makes it invalid."""
        if not self._valid(scan, topic):
            return
        config = self._limits.config
        if not (config.obstacle.open_ground or (scan.codes == VALID_BEAM).any()):
            self._refused[topic] = Measurement(name="beams with a range", value=0.0, limit=1.0)
        elif scan.tilt is not None and scan.tilt > config.scan_tilt:
            self._refused[topic] = Measurement(
                name="scan plane tilt", value=scan.tilt, unit="rad", limit=config.scan_tilt
            )
        else:
            self.scans[topics.SCANS.index(topic)] = scan

    def _lose(self, table: HealthTable) -> None:
        """Mark samples from before the loss of a service as stale."""
        for service in table.services:
            if service.state is not ServiceState.READY and service.name in self._services:
                self._lost[service.name] = max(service.since, self._lost.get(service.name, service.since))
                self._speed = None

    def _loss(self, stale: Reason, lidar: DeviceRole | None) -> int | None:
        """Latest loss of a sensor behind ``stale``, of several lidars of this one (ns)."""
        services = [name for name, reason in self._services.items() if reason is stale and lidar in (None, name)]
        return max((self._lost[name] for name in services if name in self._lost), default=None)

    def gives(self, service: str) -> Reason | None:
        """Staleness reason of the sensor that is lost with a service."""
        return self._services.get(service)

    def _valid(self, message: Message, topic: Topic[Any]) -> bool:
        latency = abs(message.received - message.stamp) / SECOND
        if latency <= self._limits.config.max_latency:
            self._refused.pop(topic, None)
            return True
        limit = self._limits.config.max_latency
        self._refused[topic] = Measurement(name="latency", value=latency, unit="s", limit=limit)
        return False

    def _fresh(
        self,
        message: Message | None,
        limit: SensorLimit | None,
        now: int,
        stale: Reason,
        lidar: DeviceRole | None = None,
    ) -> bool:
        """Return whether a sample is fresh; False for a sensor that the robot does not have (no limit)."""
        if limit is None or message is None:
            return False
        lost = self._loss(stale, lidar)
        if lost is not None and message.received <= lost:
            return False
        return now - message.received <= limit.stale_after * SECOND

    def scan_fresh(self, now: int) -> bool:
        """Return whether the scans of all lidars are fresh."""
        limit = self._limits.config.scan
        rows = zip(self._lidars, self.scans, strict=True)
        return all(self._fresh(scan, limit, now, Reason.SCAN_STALE, lidar) for lidar, scan in rows)

    def steering_fresh(self, now: int) -> bool:
        """Return whether the steering feedback is fresh."""
        return self._fresh(self.steering, self._limits.config.steering, now, Reason.STEERING_STALE)

    def attitude_fresh(self, now: int) -> bool:
        """Return whether the attitude is fresh."""
        return self._fresh(self.attitude, self._limits.config.attitude, now, Reason.ATTITUDE_STALE)

    def tips(self, now: int) -> bool:
        """Return whether the robot falls over or slides down at ``now`` (ns), by the last measured tilt.

        While it falls, its acceleration hides the tilt from the sensor.
        """
        shaken = self._fresh(self._shaken, self._limits.config.attitude, now, Reason.ATTITUDE_STALE)
        return (shaken or self.attitude_fresh(now)) and self.tilt >= self._limits.config.tilt.stop

    def battery_fresh(self, now: int) -> bool:
        """Return whether the battery voltage is fresh."""
        return self._fresh(self.battery, self._limits.config.battery, now, Reason.BATTERY_STALE)

    @property
    def faults(self) -> list[DriveFeedback]:
        """Latest feedback of every drive that reports a fault."""
        return [drive for drive in self.drives if drive is not None and drive.mode is DriveMode.FAULT]

    def values(self, now: int) -> dict[str, Value]:
        """Measurements for events at ``now`` (ns)."""
        values: dict[str, Value] = {}
        if faults := self.faults:
            values["drive_fault_code"] = faults[-1].fault_code
        if self.attitude_fresh(now):
            values["tilt"] = self.tilt
        if self.battery is not None:
            values["battery_voltage"] = self.battery.voltage
        return values

    def speed(self, now: int) -> float | None:
        """Measured speed of the fastest wheel over ground (m/s); None without fresh feedback from every shaft."""
        if self._speed is None or self._speed[0] != now:
            rolling = self.shaft_speeds(now)
            self._speed = now, self._chassis.fastest_wheel_speed(rolling) if rolling else None
        return self._speed[1]

    def shaft_speeds(self, now: int) -> Speeds:
        """Measured wheel speed over ground of every driven shaft (m/s); empty unless all shafts have fresh feedback."""
        return tuple([self._chassis.drivetrain.speed(drive.velocity) for drive in self._fresh_drives(now)])

    def twist(self, now: int) -> Twist2 | None:
        """Velocity of the base, from measured shaft speeds and the latest steering angles; None if not fresh."""
        rolling, angles = self.shaft_speeds(now), self.angles
        return self._chassis.twist(self._chassis.input_speeds(rolling, *angles), *angles) if rolling else None

    def turn_rate(self, now: int) -> float:
        """Yaw rate of ``twist`` (rad/s); 0 if the twist is unknown."""
        twist = self.twist(now)
        return 0.0 if twist is None else twist[2]

    def _fresh_drives(self, now: int) -> list[DriveFeedback]:
        """Feedback from all shafts; empty unless all of it is fresh."""
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
        """Return whether each sensor is fresh, by its staleness reason."""
        return {
            Reason.DRIVE_STALE: bool(self._fresh_drives(now)),
            Reason.STEERING_STALE: self.steering_fresh(now),
            Reason.SCAN_STALE: self.scan_fresh(now),
            Reason.ATTITUDE_STALE: self.attitude_fresh(now),
            Reason.BATTERY_STALE: self.battery_fresh(now),
        }

    def at_rest(self, now: int, since: int = 0) -> bool:
        """Return whether a sample not older than ``since`` (ns) shows that the truck is at rest.

        A truck without a critical drive counts as at rest.
        """
        speed = self.speed(now)
        if speed is None:
            return not self._limits.config.drive.critical
        sampled = min(drive.stamp for drive in self._fresh_drives(now))
        return sampled >= since and abs(speed) < self._limits.config.standstill

    def staleness(self, stale: Reason, now: int) -> Staleness:
        """Details of the stale sensor behind ``stale``; among several lidars or shafts, of the oldest stale sample."""
        limit, rows = self.sensor_limits()[stale], self._samples(stale)
        late = [row for row in rows if not self._fresh(row.sample, limit, now, stale, row.lidar)] or rows
        lidar, topic, sample = min(late, key=lambda row: -1 if row.sample is None else row.sample.received)
        lost, refused, source = self._loss(stale, lidar), self._refused.get(topic), lidar or STALE_SENSORS[stale]
        if sample is None:
            return Staleness(lost, None, limit.stale_after, refused, source)
        since = min(now, sample.received + round(limit.stale_after * SECOND))
        if lost is not None and lost >= sample.received:
            since = min(since, lost)
        return Staleness(since, (now - sample.received) / SECOND, limit.stale_after, refused, source)

    def _samples(self, stale: Reason) -> list[_Sample]:
        """Latest samples of the sensors behind ``stale``."""
        match stale:
            case Reason.SCAN_STALE:
                return list(map(_Sample, self._lidars, topics.SCANS, self.scans))
            case Reason.DRIVE_STALE:
                return [_Sample(None, topic, drive) for topic, drive in zip(topics.DRIVES, self.drives, strict=False)]
            case Reason.STEERING_STALE:
                return [_Sample(None, topics.STEERING, self.steering)]
            case Reason.ATTITUDE_STALE:
                return [_Sample(None, topics.COMPASS, self.attitude)]
            case _:
                return [_Sample(None, topics.BATTERY, self.battery)]


def age(message: Message | None, now: int) -> float | None:
    """Age of a message, s; None without a message."""
    return None if message is None else (now - message.received) / SECOND
