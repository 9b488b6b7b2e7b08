"""What the sensors and services say about driving: things that stop the truck, and things that slow it down."""

import math
from dataclasses import dataclass
from typing import Final

from monstertruck_kinematics.chassis import Chassis
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.ports import Value
from monstertruck_schemas.base import Message
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

MEASURED: Final = frozenset(BatteryLevel) - {BatteryLevel.UNKNOWN, BatteryLevel.SENSOR_FAULT}


@dataclass(frozen=True, slots=True)
class Judgement:
    """Verdict of one tick."""

    blocks: tuple[Reason, ...]
    """Reasons to stand still, worst first."""
    limits: dict[Reason, float]
    """Reasons to go slowly, with the speed each allows, m/s."""
    values: dict[str, Value]
    """Measurements behind the verdict, for the event."""


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
        self._drives: list[DriveFeedback | None] = [None] * len(chassis.shafts)
        self.steering: SteeringFeedback | None = None
        self._attitude: Attitude | None = None
        self._battery: Battery | None = None
        self._failed: tuple[str, ...] = ()
        self._lost: dict[Reason, int] = {}
        self._tilt = _Tilt(config.tilt)

    def observe_scan(self, scan: LaserScan) -> bool:
        """Take a scan; False if it is not a good sample, by its age or by the tilt of its plane."""
        if self._good(scan) and (scan.tilt is None or scan.tilt <= self._config.scan_tilt):
            self.scan = scan
        return self.scan is scan

    def observe_drive(self, feedback: DriveFeedback, shaft: int = 0) -> None:
        """Take feedback of a driven shaft."""
        if self._good(feedback):
            self._drives[shaft] = feedback

    def observe_steering(self, feedback: SteeringFeedback) -> None:
        """Take steering feedback; what the servo controller does not vouch for is no good sample."""
        if self._good(feedback) and feedback.trusted:
            self.steering = feedback

    def observe_attitude(self, attitude: Attitude) -> None:
        """Take an attitude; without a valid tilt it is no good sample."""
        if self._good(attitude) and attitude.tilt_valid:
            self._attitude = attitude
            self._tilt.update(math.acos(math.cos(attitude.roll) * math.cos(attitude.pitch)))

    def observe_battery(self, battery: Battery) -> None:
        """Take a battery reading; without a judged voltage it is no good sample."""
        if self._good(battery) and battery.level in MEASURED:
            self._battery = battery

    def observe_health(self, table: HealthTable) -> None:
        """Take the services' health: samples from before a service was lost no longer count."""
        for row in table.services:
            if row.state is not ServiceState.READY and (stale := SENSOR_SERVICES.get(row.name)) is not None:
                self._lost[stale] = max(row.since, self._lost.get(stale, -1))
        self._failed = tuple(
            row.name
            for row in table.services
            if row.state is ServiceState.FAILED and row.name not in self._config.tolerated_failures
        )

    def _good(self, message: Message) -> bool:
        return abs(message.received - message.stamp) <= self._config.max_latency * SECOND

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
        drives = self._fresh_drives(now)
        if not drives:
            return None
        return self._chassis.travel(tuple(self._chassis.drivetrain.speed(drive.velocity) for drive in drives))

    def _fresh_drives(self, now: int) -> tuple[DriveFeedback, ...]:
        """Feedback of all shafts; none of it unless all of it counts."""
        drives = tuple(drive for drive in self._drives if drive is not None)
        fresh = all(self._fresh(drive, self._config.drive, now, Reason.DRIVE_STALE) for drive in self._drives)
        return drives if fresh else ()

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
        for drive in self._drives:
            if drive is not None and drive.mode is DriveMode.FAULT:
                values["drive_fault_code"] = drive.fault_code
        if "drive_fault_code" in values:
            blocks.append(Reason.DRIVE_FAULT)
        if self._failed:
            blocks.append(Reason.SERVICE_FAILED)
        steered = self._chassis.linkage is not None
        for message, limit, reason in (
            *((drive, config.drive, Reason.DRIVE_STALE) for drive in self._drives),
            *(((self.steering, config.steering, Reason.STEERING_STALE),) if steered else ()),
            (self.scan, config.scan, Reason.SCAN_STALE),
            (self._attitude, config.attitude, Reason.ATTITUDE_STALE),
            (self._battery, config.battery, Reason.BATTERY_STALE),
        ):
            if limit.critical and not self._fresh(message, limit, now, reason):
                blocks.append(reason)
        if self._fresh(self._attitude, config.attitude, now, Reason.ATTITUDE_STALE):
            values["tilt"] = self._tilt.angle
            if self._tilt.stop:
                blocks.append(Reason.TILT_STOP)
            elif self._tilt.slow:
                limits[Reason.TILT_SLOW] = config.tilt.slow_speed
        self._judge_battery(now, blocks, limits, values)
        return Judgement(tuple(dict.fromkeys(blocks)), limits, values)

    def _judge_battery(
        self, now: int, blocks: list[Reason], limits: dict[Reason, float], values: dict[str, Value]
    ) -> None:
        battery = self._battery
        if battery is None:
            return
        values["battery_voltage"] = battery.voltage
        # A pack that was critical stays so when its sensor falls silent.
        if battery.level is BatteryLevel.CRITICAL:
            blocks.append(Reason.BATTERY_CRITICAL)
        elif battery.level is BatteryLevel.LOW:
            limits[Reason.BATTERY_LOW] = self._config.battery_low_speed
        if not self._config.battery.critical and not self._fresh(
            battery, self._config.battery, now, Reason.BATTERY_STALE
        ):
            limits[Reason.BATTERY_STALE] = self._config.battery_low_speed

    @property
    def failed(self) -> tuple[str, ...]:
        """Names of the services whose failure stops the truck."""
        return self._failed


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
