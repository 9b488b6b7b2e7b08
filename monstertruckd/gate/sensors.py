"""Sensor monitoring: freshness and plausibility of every sensor, judged at each tick.

``SteeringCheck`` finds servos without supply. Hobby servos report nothing, and a servo controller on USB power keeps
answering when the servos' own supply is lost; but then the compass heading departs from the one that follows from
speed and commanded axle angles.
"""

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

from monstertruck_kinematics.chassis import Chassis, Speeds
from monstertruck_kinematics.drive import Twist
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
from monstertruckd.gate.config import GateConfig, SensorLimit, ShaftCheckConfig, SteeringCheckConfig, TiltLimits

STALE_TOPICS: Final[Mapping[Topic[Any], Reason]] = {
    topics.SCAN: Reason.SCAN_STALE,
    topics.COMPASS: Reason.ATTITUDE_STALE,
    **dict.fromkeys(topics.DRIVES, Reason.DRIVE_STALE),
    topics.STEERING: Reason.STEERING_STALE,
}
"""Topics whose samples are stale as soon as the service that writes them reports its loss."""

STALE_SENSORS: Final = {
    Reason.SCAN_STALE: DeviceRole.LIDAR,
    Reason.ATTITUDE_STALE: DeviceRole.COMPASS,
    Reason.DRIVE_STALE: DeviceRole.DRIVE,
    Reason.STEERING_STALE: DeviceRole.STEERING,
    Reason.BATTERY_STALE: DeviceRole.BATTERY,
}
"""Which sensor is stale, by reason."""

DRIVE_LOSSES: Final = (Reason.DEVICE_RESTARTED, Reason.DEVICE_STOPPED)
"""Why a drive's service may have ended that makes arming necessary, however short the loss."""

MEASURED: Final = frozenset(BatteryLevel) - {BatteryLevel.UNKNOWN, BatteryLevel.SENSOR_FAULT}


ENABLED_WITHIN: Final = 1.5
"""Seconds in which a drive controller that is commanded to turn its shaft is enabled: it takes 0.6."""

JUMP: Final = 1.5
"""A heading that changes faster than this, rad/s, is a disturbed compass, not a turn."""

GAP: Final = SECOND // 2
"""Headings further apart than this are not compared, ns."""


class Assessment(NamedTuple):
    """What the sensors allow at one tick."""

    blocks: tuple[Reason, ...]
    """Reasons to stand still, worst first."""
    limits: dict[Reason, float]
    """Reasons to go slowly, with the speed each allows, m/s."""
    values: dict[str, Value]
    """Measurements behind it, for the event."""


@dataclass(frozen=True, slots=True)
class Staleness:
    """A sensor without a valid sample."""

    since: int | None
    """When its newest valid sample became stale, ns; None = there never was one."""
    age: float | None
    """Of its newest valid sample, s."""
    limit: float
    """S."""
    refused: Measurement | None
    """Why its newest sample since was not valid."""


class SensorMonitor:
    """Newest valid sample of every sensor, assessed at each tick.

    Args:
        config: limits.
        chassis: kinematics of the body.
        services: what is stale at once when a service reports its loss.
        battery_measured: something is there to measure the battery.
    """

    def __init__(
        self, config: GateConfig, chassis: Chassis, services: Mapping[str, Reason], *, battery_measured: bool
    ) -> None:
        self._config = config
        self._battery_measured = battery_measured
        self._services = services
        self._chassis = chassis
        self.scan: LaserScan | None = None
        self.drives: list[DriveFeedback | None] = [None] * len(chassis.shafts)
        self.steering: SteeringFeedback | None = None
        self.attitude: Attitude | None = None
        self.battery: Battery | None = None
        self._failed: tuple[str, ...] = ()
        self._drive_losses: set[Reason] = set()
        """Losses of ``DRIVE_LOSSES`` for which a drive's service is down."""
        self._unjudged_losses: set[Reason] = set()
        """Losses of ``DRIVE_LOSSES`` reported since the last tick."""
        self._lost: dict[Reason, int] = {}
        self._refused: dict[Reason, Measurement] = {}
        self._critical = _critical(config, steered=chassis.steered)
        self._tilt = _Tilt(config.tilt)
        self._speed: tuple[int, float | None] | None = None
        """Time (ns) and result of the newest ``speed``, until the next sample."""
        self.angles = chassis.straight
        """Steering angles by the newest steering feedback, rad."""

    def configure(self, config: GateConfig) -> None:
        """Take other limits, between two ticks."""
        self._config = config
        self._tilt.limits = config.tilt

    def observe_scan(self, scan: LaserScan) -> bool:
        """Take a scan; False if it is not valid: by its age, the tilt of its plane, or without a single range."""
        valid = self._valid(scan, Reason.SCAN_STALE)
        if valid and not (self._config.obstacle.open_ground or (scan.codes == VALID_BEAM).any()):
            valid = False
            self._refused[Reason.SCAN_STALE] = Measurement(name="beams with a range", value=0.0, limit=1.0)
        if valid and scan.tilt is not None and scan.tilt > self._config.scan_tilt:
            valid = False
            self._refused[Reason.SCAN_STALE] = Measurement(
                name="scan plane tilt", value=scan.tilt, unit="rad", limit=self._config.scan_tilt
            )
        if valid:
            self.scan = scan
        return valid

    def observe_drive(self, feedback: DriveFeedback, shaft: int = 0) -> None:
        """Take feedback of a driven shaft."""
        if self._valid(feedback, Reason.DRIVE_STALE):
            self.drives[shaft] = feedback
            self._speed = None

    def observe_steering(self, feedback: SteeringFeedback) -> None:
        """Take steering feedback; not valid unless the servo controller trusts it."""
        if self._valid(feedback, Reason.STEERING_STALE) and feedback.trusted:
            self.steering = feedback
            self.angles = self._chassis.steering(*feedback.servos)

    def observe_attitude(self, attitude: Attitude) -> None:
        """Take an attitude; not valid without a valid tilt."""
        if self._valid(attitude, Reason.ATTITUDE_STALE) and attitude.tilt_valid:
            self.attitude = attitude
            self._tilt.update(math.acos(math.cos(attitude.roll) * math.cos(attitude.pitch)))

    def observe_battery(self, battery: Battery) -> None:
        """Take a battery reading; not valid without a level."""
        if self._valid(battery, Reason.BATTERY_STALE) and battery.level in MEASURED:
            self.battery = battery

    def observe_health(self, table: HealthTable) -> None:
        """Take the services' health: samples from before the loss of a service become stale."""
        for service in table.services:
            if service.state is not ServiceState.READY and (stale := self._services.get(service.name)) is not None:
                self._lost[stale] = max(service.since, self._lost.get(stale, service.since))
                self._speed = None
        self._drive_losses = {
            service.reason
            for service in table.services
            if service.reason in DRIVE_LOSSES and self._services.get(service.name) is Reason.DRIVE_STALE
        }
        self._unjudged_losses |= self._drive_losses
        self._failed = tuple(
            service.name
            for service in table.services
            if service.state is ServiceState.FAILED and service.name not in self._config.tolerated_failures
        )

    def _valid(self, message: Message, stale: Reason) -> bool:
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
        """Whether the scan is fresh."""
        return self._fresh(self.scan, self._config.scan, now, Reason.SCAN_STALE)

    def steering_fresh(self, now: int) -> bool:
        """Whether the steering feedback is fresh."""
        return self._fresh(self.steering, self._config.steering, now, Reason.STEERING_STALE)

    def speed(self, now: int) -> float | None:
        """Measured speed of the fastest wheel over ground, m/s; None without fresh feedback of every shaft."""
        if self._speed is None or self._speed[0] != now:
            rolling = self.shaft_speeds(now)
            self._speed = now, self._chassis.fastest_wheel_speed(rolling) if rolling else None
        return self._speed[1]

    def shaft_speeds(self, now: int) -> Speeds:
        """Measured wheel speed over ground of every driven shaft, m/s; empty without fresh feedback of all of them."""
        return tuple([self._chassis.drivetrain.speed(drive.velocity) for drive in self._fresh_drives(now)])

    def twist(self, now: int) -> Twist[float] | None:
        """Velocity of the base by the measured shaft speeds and the newest steering angles; None without the former."""
        rolling, angles = self.shaft_speeds(now), self.angles
        return self._chassis.twist(self._chassis.input_speeds(rolling, *angles), *angles) if rolling else None

    def turn_rate(self, now: int) -> float:
        """Yaw rate of ``twist``, rad/s; 0 without it."""
        twist = self.twist(now)
        return 0.0 if twist is None else twist[2]

    def _fresh_drives(self, now: int) -> list[DriveFeedback]:
        """Feedback of all shafts; empty unless all of it is fresh."""
        limit = self._config.drive
        drives = [d for d in self.drives if d is not None and self._fresh(d, limit, now, Reason.DRIVE_STALE)]
        return drives if len(drives) == len(self.drives) else []

    def _all_fresh(self, now: int) -> dict[Reason, bool]:
        """Which sensors are fresh, by the reason of the stale ones."""
        config = self._config
        return {
            Reason.DRIVE_STALE: bool(self._fresh_drives(now)),
            Reason.STEERING_STALE: self.steering_fresh(now),
            Reason.SCAN_STALE: self.scan_fresh(now),
            Reason.ATTITUDE_STALE: self._fresh(self.attitude, config.attitude, now, Reason.ATTITUDE_STALE),
            Reason.BATTERY_STALE: self._fresh(self.battery, config.battery, now, Reason.BATTERY_STALE),
        }

    def at_rest(self, now: int, since: int = 0) -> bool:
        """Whether the truck is known to be at rest, by a sample not older than ``since``, ns.

        A truck without a critical drive counts as at rest.
        """
        speed = self.speed(now)
        if speed is None:
            return not self._config.drive.critical
        sampled = min(drive.stamp for drive in self._fresh_drives(now))
        return sampled >= since and abs(speed) < self._config.standstill

    def assess(self, now: int) -> Assessment:
        """What stops or slows the truck at ``now``, ns."""
        config = self._config
        blocks: list[Reason] = []
        limits: dict[Reason, float] = {}
        values: dict[str, Value] = {}
        for drive in self.drives:
            if drive is not None and drive.mode is DriveMode.FAULT:
                values["drive_fault_code"] = drive.fault_code
        if values:
            blocks.append(Reason.DRIVE_FAULT)
        blocks += [reason for reason in DRIVE_LOSSES if reason in self._drive_losses | self._unjudged_losses]
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
        self._assess_battery(fresh[Reason.BATTERY_STALE], blocks, limits, values)
        return Assessment(tuple(blocks), limits, values)

    def judged(self) -> None:
        """A tick has acted on the assessment: what was reported and taken back since the tick before is forgotten."""
        self._unjudged_losses.clear()

    def _assess_battery(
        self, fresh: bool, blocks: list[Reason], limits: dict[Reason, float], values: dict[str, Value]
    ) -> None:
        battery = self.battery
        if battery is not None:
            values["battery_voltage"] = battery.voltage
            # A pack that was critical stays so when its sensor becomes stale.
            if battery.level is BatteryLevel.CRITICAL:
                blocks.append(Reason.BATTERY_CRITICAL)
            elif battery.level is BatteryLevel.LOW:
                limits[Reason.BATTERY_LOW] = self._config.battery_low_speed
        known = self._battery_measured or battery is not None
        if known and not fresh and not self._config.battery.critical:
            limits[Reason.BATTERY_STALE] = self._config.battery_low_speed

    def staleness(self, stale: Reason, now: int) -> Staleness:
        """Details of the stale sensor behind the reason ``stale``; with several shafts, of the oldest sample."""
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
            return Staleness(lost, None, limit.stale_after, refused)
        oldest = min(received)
        since = min(now, oldest + round(limit.stale_after * SECOND))
        if lost is not None and lost >= oldest:
            since = min(since, lost)
        return Staleness(since, (now - oldest) / SECOND, limit.stale_after, refused)

    @property
    def tilt(self) -> float:
        """Angle between the truck's z axis and the vertical, rad, by the newest valid attitude."""
        return self._tilt.angle

    @property
    def failed(self) -> tuple[str, ...]:
        """Names of the services whose failure stops the truck."""
        return self._failed


def _critical(config: GateConfig, *, steered: bool) -> tuple[Reason, ...]:
    """Sensors whose staleness stops the truck, worst first."""
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
        self.limits = limits
        self.angle = 0.0
        self.slow = False
        self.stop = False

    def update(self, angle: float) -> None:
        """Take a tilt angle, rad."""
        self.angle = angle
        limits = self.limits
        self.slow = angle >= limits.slow - (limits.hysteresis if self.slow else 0.0)
        self.stop = angle >= limits.stop - (limits.hysteresis if self.stop else 0.0)


class SteeringCheck:
    """Compares the turn commanded with the turn measured over a sliding window; ``dead`` stays until ``reset``.

    Args:
        config: window and tolerance.
    """

    def __init__(self, config: SteeringCheckConfig) -> None:
        self.config = config
        self._window: deque[tuple[int, float, float]] = deque()
        """(ns, turn by the commands, turn by the compass) since a common origin, rad, left positive."""
        self._heading = 0.0
        self.dead = False
        """The steering does not follow its commands."""
        self.difference = 0.0
        """Turn measured less turn commanded over the window, rad."""

    def reset(self) -> None:
        """Start over."""
        self._window.clear()
        self.dead = False
        self.difference = 0.0

    def observe(self, stamp: int, heading: float | None, speed: float | None, rate: float) -> None:
        """Take a heading, and what wheels and steering say at that time.

        Args:
            stamp: of the measurement, ns.
            heading: clockwise, rad; None = the compass is disturbed.
            speed: of the wheels over ground, m/s; None = not known.
            rate: yaw rate that follows from the wheels' speeds and the commanded steering angles, rad/s, left positive.
        """
        if heading is None or speed is None or abs(speed) < self.config.speed:
            self._window.clear()
            return
        if not self._window or stamp - self._window[-1][0] > GAP:
            self._begin(stamp, heading)
            return
        before, commanded, measured = self._window[-1]
        dt = (stamp - before) / SECOND
        turned = -math.remainder(heading - self._heading, 2 * math.pi)
        if abs(turned) > JUMP * dt:
            self._begin(stamp, heading)
            return
        commanded += rate * dt
        self._window.append((stamp, commanded, measured + turned))
        self._heading = heading
        while self._window[-1][0] - self._window[0][0] > self.config.window * SECOND:
            self._window.popleft()
        self._compare()

    def _begin(self, stamp: int, heading: float) -> None:
        self._window.clear()
        self._window.append((stamp, 0.0, 0.0))
        self._heading = heading

    def _compare(self) -> None:
        _, commanded_then, measured_then = self._window[0]
        _, commanded_now, measured_now = self._window[-1]
        commanded, measured = commanded_now - commanded_then, measured_now - measured_then
        self.difference = measured - commanded
        allowed = self.config.tolerance + self.config.share * max(abs(commanded), abs(measured))
        self.dead |= abs(self.difference) > allowed


class ShaftCheck:
    """Compares each driven shaft's speed with its command; ``blocked`` stays until ``reset``.

    A blocked shaft draws current up to the controller's limit and heats motor and clutch, and the controller reports
    no fault.

    Args:
        config: time and tolerance.
    """

    def __init__(self, config: ShaftCheckConfig) -> None:
        self._config = config
        self._since: dict[tuple[int, bool], int] = {}
        """Since when each shaft has not turned, and its controller been enabled or not, ns."""
        self._current: dict[int, float] = {}
        """Newest measured current of each, A."""
        self.blocked: int | None = None
        """The shaft that does not turn."""

    def reset(self) -> None:
        """Start over."""
        self._since.clear()
        self.blocked = None

    def observe(self, feedback: DriveFeedback, shaft: int, commanded: float, measured: float) -> None:
        """Take feedback of a shaft.

        Args:
            feedback: the message.
            shaft: which.
            commanded: wheel speed over ground, m/s.
            measured: same.
        """
        if feedback.current is not None:
            self._current[shaft] = feedback.current
        limits = self._config
        enabled = feedback.mode is DriveMode.ENABLED
        self._since.pop((shaft, not enabled), None)
        asked = feedback.mode is not DriveMode.FAULT and abs(commanded) >= limits.speed
        if not asked or measured * math.copysign(1.0, commanded) >= limits.share * abs(commanded):
            self._since.pop((shaft, enabled), None)
            return
        since = self._since.setdefault((shaft, enabled), feedback.received)
        within = limits.within if enabled else ENABLED_WITHIN
        if self.blocked is None and feedback.received - since >= within * SECOND:
            self.blocked = shaft

    @property
    def current(self) -> float | None:
        """Newest measured current of the blocked shaft, A."""
        return None if self.blocked is None else self._current.get(self.blocked)
