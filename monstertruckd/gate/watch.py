"""What the sensors and services say about driving: things that stop the truck, and things that slow it down."""

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

from monstertruck_kinematics.chassis import Chassis
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.ports import Value
from monstertruck_schemas.base import Message
from monstertruck_schemas.event import Measurement
from monstertruck_schemas.health import HealthTable, ServiceState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import (
    Attitude,
    Battery,
    BatteryLevel,
    DriveFeedback,
    DriveMode,
    LaserScan,
    SteeringFeedback,
)
from monstertruckd.gate.config import GateConfig, SensorLimit, TiltLimits

SENSOR_SERVICES: Final = {
    "lidar": Reason.SCAN_STALE,
    "compass": Reason.ATTITUDE_STALE,
    "drive": Reason.DRIVE_STALE,
    "drive_2": Reason.DRIVE_STALE,
    "drive_3": Reason.DRIVE_STALE,
    "drive_4": Reason.DRIVE_STALE,
    "steering": Reason.STEERING_STALE,
}
"""Services whose reported loss ends the worth of their samples at once."""

STALE_SENSORS: Final = {
    Reason.SCAN_STALE: "lidar",
    Reason.ATTITUDE_STALE: "compass",
    Reason.DRIVE_STALE: "drive",
    Reason.STEERING_STALE: "steering",
    Reason.BATTERY_STALE: "battery",
}
"""Who is silent, by the reason its silence gives."""

MEASURED: Final = frozenset(BatteryLevel) - {BatteryLevel.UNKNOWN, BatteryLevel.SENSOR_FAULT}


class Judgement(NamedTuple):
    """Verdict of one tick."""

    blocks: tuple[Reason, ...]
    """Reasons to stand still, worst first."""
    limits: dict[Reason, float]
    """Reasons to go slowly, with the speed each allows, m/s."""
    values: dict[str, Value]
    """Measurements behind the verdict, for the event."""


@dataclass(frozen=True, slots=True)
class Silence:
    """A sensor without a good sample. Seconds."""

    since: int | None
    """When its newest sample stopped counting, ns; None = there never was one."""
    age: float | None
    limit: float
    refused: Measurement | None
    """Why its newest sample since was no good one."""


class Watch:
    """Newest good sample of every sensor, judged at each tick.

    Args:
        config: limits.
        chassis: what moves.
    """

    def __init__(self, config: GateConfig, chassis: Chassis) -> None:
        self._config = config
        self._chassis = chassis
        self.scan: LaserScan | None = None
        self.drives: list[DriveFeedback | None] = [None] * len(chassis.shafts)
        self.steering: SteeringFeedback | None = None
        self.attitude: Attitude | None = None
        self.battery: Battery | None = None
        self._failed: tuple[str, ...] = ()
        self._lost: dict[Reason, int] = {}
        self._refused: dict[Reason, Measurement] = {}
        self._critical = _critical(config, steered=chassis.linkage is not None)
        self._tilt = _Tilt(config.tilt)
        self._speed: tuple[int, float | None] | None = None
        """Instant (ns) and speed of the newest look, while the samples are those of then."""
        self.axles = (0.0, 0.0)
        """Axle angles by the newest steering feedback, rad."""

    def observe_scan(self, scan: LaserScan) -> bool:
        """Take a scan; False if it is not a good sample, by its age or by the tilt of its plane."""
        good = self._good(scan, Reason.SCAN_STALE)
        if good and scan.tilt is not None and scan.tilt > self._config.scan_tilt:
            good = False
            self._refused[Reason.SCAN_STALE] = Measurement(
                name="tilt of its plane", value=scan.tilt, unit="rad", limit=self._config.scan_tilt
            )
        if good:
            self.scan = scan
        return good

    def observe_drive(self, feedback: DriveFeedback, shaft: int = 0) -> None:
        """Take feedback of a driven shaft."""
        if self._good(feedback, Reason.DRIVE_STALE):
            self.drives[shaft] = feedback
            self._speed = None

    def observe_steering(self, feedback: SteeringFeedback) -> None:
        """Take steering feedback; what the servo controller does not vouch for is no good sample."""
        if self._good(feedback, Reason.STEERING_STALE) and feedback.trusted:
            self.steering = feedback
            self.axles = self._chassis.axles(feedback.front, feedback.rear)

    def observe_attitude(self, attitude: Attitude) -> None:
        """Take an attitude; without a valid tilt it is no good sample."""
        if self._good(attitude, Reason.ATTITUDE_STALE) and attitude.tilt_valid:
            self.attitude = attitude
            self._tilt.update(math.acos(math.cos(attitude.roll) * math.cos(attitude.pitch)))

    def observe_battery(self, battery: Battery) -> None:
        """Take a battery reading; without a judged voltage it is no good sample."""
        if self._good(battery, Reason.BATTERY_STALE) and battery.level in MEASURED:
            self.battery = battery

    def observe_health(self, table: HealthTable) -> None:
        """Take the services' health: samples from before a service was lost no longer count."""
        for row in table.services:
            if row.state is not ServiceState.READY and (stale := SENSOR_SERVICES.get(row.name)) is not None:
                self._lost[stale] = max(row.since, self._lost.get(stale, -1))
                self._speed = None
        self._failed = tuple(
            row.name
            for row in table.services
            if row.state is ServiceState.FAILED and row.name not in self._config.tolerated_failures
        )

    def _good(self, message: Message, stale: Reason) -> bool:
        latency = abs(message.received - message.stamp) / SECOND
        if latency <= self._config.max_latency:
            self._refused.pop(stale, None)
            return True
        self._refused[stale] = Measurement(name="latency", value=latency, unit="s", limit=self._config.max_latency)
        return False

    def _fresh(self, message: Message | None, limit: SensorLimit, now: int, stale: Reason) -> bool:
        if message is None or message.received <= self._lost.get(stale, -1):
            return False
        return now - message.received <= limit.stale_after * SECOND

    def scan_fresh(self, now: int) -> bool:
        """Whether the scan still counts."""
        return self._fresh(self.scan, self._config.scan, now, Reason.SCAN_STALE)

    def steering_fresh(self, now: int) -> bool:
        """Whether the steering feedback still counts."""
        return self._fresh(self.steering, self._config.steering, now, Reason.STEERING_STALE)

    def speed(self, now: int) -> float | None:
        """Measured speed of the fastest wheel over ground, m/s; None without fresh feedback of every shaft."""
        if self._speed is None or self._speed[0] != now:
            drives = self._fresh_drives(now)
            rolling = tuple([self._chassis.drivetrain.speed(drive.velocity) for drive in drives])
            self._speed = now, self._chassis.travel(rolling) if rolling else None
        return self._speed[1]

    def _fresh_drives(self, now: int) -> list[DriveFeedback]:
        """Feedback of all shafts; none of it unless all of it counts."""
        limit = self._config.drive
        drives = [d for d in self.drives if d is not None and self._fresh(d, limit, now, Reason.DRIVE_STALE)]
        return drives if len(drives) == len(self.drives) else []

    def _all_fresh(self, now: int) -> dict[Reason, bool]:
        """Which sensors still count, by the reason their silence gives."""
        config = self._config
        return {
            Reason.DRIVE_STALE: bool(self._fresh_drives(now)),
            Reason.STEERING_STALE: self.steering_fresh(now),
            Reason.SCAN_STALE: self.scan_fresh(now),
            Reason.ATTITUDE_STALE: self._fresh(self.attitude, config.attitude, now, Reason.ATTITUDE_STALE),
            Reason.BATTERY_STALE: self._fresh(self.battery, config.battery, now, Reason.BATTERY_STALE),
        }

    def at_rest(self, now: int, since: int = 0) -> bool:
        """Whether the truck is known to stand still, by a sample not older than ``since``.

        A truck without a critical drive counts as standing.
        """
        speed = self.speed(now)
        if speed is None:
            return not self._config.drive.critical
        sampled = min(drive.stamp for drive in self._fresh_drives(now))
        return sampled >= since and abs(speed) < self._config.standstill

    def judge(self, now: int) -> Judgement:
        """Verdict at ``now``."""
        config = self._config
        blocks: list[Reason] = []
        limits: dict[Reason, float] = {}
        values: dict[str, Value] = {}
        for drive in self.drives:
            if drive is not None and drive.mode is DriveMode.FAULT:
                values["drive_fault_code"] = drive.fault_code
        if values:
            blocks.append(Reason.DRIVE_FAULT)
        if self._failed:
            blocks.append(Reason.SERVICE_FAILED)
        fresh = self._all_fresh(now)
        blocks += [reason for reason in self._critical if not fresh[reason]]
        if fresh[Reason.ATTITUDE_STALE]:
            values["tilt"] = self._tilt.angle
            if self._tilt.stop:
                blocks.append(Reason.TILT_STOP)
            elif self._tilt.slow:
                limits[Reason.TILT_SLOW] = config.tilt.slow_speed
        self._judge_battery(fresh[Reason.BATTERY_STALE], blocks, limits, values)
        return Judgement(tuple(blocks), limits, values)

    def _judge_battery(
        self, fresh: bool, blocks: list[Reason], limits: dict[Reason, float], values: dict[str, Value]
    ) -> None:
        battery = self.battery
        if battery is None:
            return
        values["battery_voltage"] = battery.voltage
        # A pack that was critical stays so when its sensor falls silent.
        if battery.level is BatteryLevel.CRITICAL:
            blocks.append(Reason.BATTERY_CRITICAL)
        elif battery.level is BatteryLevel.LOW:
            limits[Reason.BATTERY_LOW] = self._config.battery_low_speed
        if not fresh and not self._config.battery.critical:
            limits[Reason.BATTERY_STALE] = self._config.battery_low_speed

    def silence(self, stale: Reason, now: int) -> Silence:
        """What is known of a sensor whose silence gives the reason ``stale``; of several shafts of the worst one."""
        samples: tuple[Message | None, ...]
        samples, limit = {
            Reason.SCAN_STALE: ((self.scan,), self._config.scan),
            Reason.ATTITUDE_STALE: ((self.attitude,), self._config.attitude),
            Reason.DRIVE_STALE: (tuple(self.drives), self._config.drive),
            Reason.STEERING_STALE: ((self.steering,), self._config.steering),
            Reason.BATTERY_STALE: ((self.battery,), self._config.battery),
        }[stale]
        received = [sample.received for sample in samples if sample is not None]
        lost = self._lost.get(stale)
        refused = self._refused.get(stale)
        if len(received) < len(samples):
            return Silence(lost, None, limit.stale_after, refused)
        oldest = min(received)
        since = min(now, oldest + round(limit.stale_after * SECOND))
        if lost is not None and lost >= oldest:
            since = min(since, lost)
        return Silence(since, (now - oldest) / SECOND, limit.stale_after, refused)

    @property
    def tilt(self) -> float:
        """Angle between the truck's z axis and the vertical, rad, by the newest good attitude."""
        return self._tilt.angle

    @property
    def failed(self) -> tuple[str, ...]:
        """Names of the services whose failure stops the truck."""
        return self._failed


def _critical(config: GateConfig, *, steered: bool) -> tuple[Reason, ...]:
    """Whose silence stops the truck, worst first."""
    limits = {
        Reason.DRIVE_STALE: config.drive,
        Reason.STEERING_STALE: config.steering,
        Reason.SCAN_STALE: config.scan,
        Reason.ATTITUDE_STALE: config.attitude,
        Reason.BATTERY_STALE: config.battery,
    }
    return tuple(r for r, limit in limits.items() if limit.critical and (steered or r is not Reason.STEERING_STALE))


class _Tilt:
    """Tilt limits with hysteresis."""

    def __init__(self, limits: TiltLimits) -> None:
        self._limits = limits
        self.angle = 0.0
        self.slow = False
        self.stop = False

    def update(self, angle: float) -> None:
        """Judge a tilt angle, rad."""
        self.angle = angle
        limits = self._limits
        self.slow = angle >= limits.slow - (limits.hysteresis if self.slow else 0.0)
        self.stop = angle >= limits.stop - (limits.hysteresis if self.stop else 0.0)
