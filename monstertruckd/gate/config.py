"""Limits of the safety gate, and the physical limits of a body that no configuration may exceed.

A speed is possible if the motor reaches it and the body can stop from it on ground that has been seen. A time without
samples is possible if the body travels no further than its own length in that time. A tilt is possible up to the slope
at which the wheels slip. Units: lengths m, angles rad, times s, speeds m/s.
"""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal, Self

from pydantic import Field, model_validator

from monstertruck_schemas import topics
from monstertruck_schemas.base import LIVE, NotNegative, Positive, Schema
from monstertruck_schemas.req import Role
from monstertruck_schemas.roles import DeviceRole, ServiceName
from monstertruck_schemas.topics import Topic

LivePositive = Annotated[Positive, LIVE]
LiveNotNegative = Annotated[NotNegative, LIVE]
LiveTilt = Annotated[float, Field(gt=0, lt=math.pi / 2), LIVE]


class SensorLimit(Schema):
    """Staleness limit of one sensor, and its consequence."""

    stale_after: Annotated[float, Field(gt=0, le=60)]
    """Age of the latest valid sample above which the sensor is stale, s since the daemon received it."""
    critical: bool = True
    """Whether the stale sensor stops the truck; otherwise only the limits derived from it lapse."""


def _limit(topic: Topic[Any], *, critical: bool = True) -> SensorLimit:
    """Default limit from the topic table."""
    return SensorLimit(stale_after=topic.fresh_for(), critical=critical)


class Leases(Schema):
    """Maximum lease granted to each role (s); longer requested leases are shortened."""

    hand: Annotated[float, Field(gt=0, le=1)] = 0.25
    gamepad: Annotated[float, Field(gt=0, le=1)] = 0.25
    keyboard: Annotated[float, Field(gt=0, le=1)] = 0.25
    station: Annotated[float, Field(gt=0, le=1)] = 0.25
    tracker: Annotated[float, Field(gt=0, le=1)] = 0.25

    def of(self, role: Role) -> float:
        """Maximum lease of a driving role (s)."""
        cap: float = getattr(self, role.value)
        return cap


class TiltLimits(Schema):
    """Limits of the angle between the truck's z axis and the vertical."""

    slow: LiveTilt = 0.21
    """Minimum tilt that limits the speed to ``slow_speed``, rad."""
    stop: LiveTilt = 0.35
    """Minimum tilt that stops the truck, rad."""
    hysteresis: Annotated[float, Field(ge=0)] = 0.035
    """Hysteresis of both limits: a limit ends when the tilt is this far below its threshold, rad."""
    slow_speed: LivePositive = 0.08
    """Speed limit from the tilt ``slow`` on, m/s."""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if not self.hysteresis < self.slow < self.stop:
            msg = f"tilt: expected hysteresis < slow < stop, got {self.hysteresis}, {self.slow}, {self.stop} rad"
            raise ValueError(msg)
        return self


class SteeringCheckConfig(Schema):
    """Detection of measured yaw that contradicts the steering."""

    window: Annotated[float, Field(gt=0, le=5)] = 2.0
    """Window for the comparison of turns, s."""
    tolerance: Annotated[float, Field(gt=0, le=math.pi / 2)] = 0.14
    """Tolerated difference due to compass errors and servo lag, rad."""
    speed: Positive = 0.03
    """Minimum speed for the comparison, m/s: a slower truck may be turned by hand."""
    share: Annotated[float, Field(ge=0, lt=1)] = 0.3
    """Tolerated difference due to tyre slip and calibration, as a fraction of the larger turn."""


class AssistConfig(Schema):
    """Assisted driving: an operator's motion is steered to the nearest curvature whose swept ground is free."""

    on: Annotated[bool, LIVE] = False
    """Whether assisted driving steers around obstacles; it never increases the operator's speed"""
    horizon: LivePositive = 0.6
    """Distance kept free beyond the stopping distance, m."""


class ObstacleLimits(Schema):
    """Clearance kept along the swept path."""

    ahead: LiveNotNegative = 0.05
    """Distance between footprint and obstacle after the stop, m."""
    side_clearance: LiveNotNegative = 0.02
    """Clearance on all sides while passing, in addition to the footprint's padding, m."""
    deceleration: LivePositive = 0.15
    """Comfortable deceleration towards an obstacle, m/s^2: determines how early the truck slows down."""
    crawl: Positive = 0.02
    """Allowed speed below which the truck stops, m/s; it continues when twice this speed is allowed."""
    seen: Annotated[float, Field(gt=0, le=1)] = 0.5
    """Minimum fraction of the beams in each sector of travel (10 degrees) that have a range, or no return within the
    lidar's range. A recorded URG-04LX has 0.95 to 1.0, and less than half in one of 800 sectors.
    """
    unseen_speed: LivePositive = 0.1
    """Speed limit while a sector of travel is not seen, m/s; a sector not seen for ``scan.stale_after`` stops the
    truck. Also the limit for a body that turns on the spot or swings its tail onto ground not seen recently by any
    scan."""
    unseen: Literal["stop", "slow"] = "stop"
    """Reaction to ground not seen recently by any scan, in reverse, sideways and with a tail that swings towards
    something; slow: limit to ``unseen_speed``."""
    confirmed_speed: Annotated[float, Field(gt=0, le=0.05), LIVE] = 0.05
    """Speed limit into unseen ground while the operator holds the second control, m/s."""
    memory_time: Annotated[float, Field(gt=0, le=120)] = 30.0
    """Maximum age of remembered scans, s: people may step onto ground that was free."""
    memory_distance: NotNegative = 2.0
    """Distance travelled before points of earlier scans are forgotten, m; these points guard the truck outside the
    lidar's field of view."""
    memory_deviation: Annotated[float, Field(gt=0, le=0.5)] = 0.1
    """Standard deviation, by odometry, of an earlier scan's position relative to the robot above which the scan is
    ignored, m."""
    open_ground: bool = False
    """Whether a scan without any range means free ground; otherwise it is invalid."""


class DockingLimits(Schema):
    """Limits near a dock while a behaviour docks or undocks."""

    speed: Annotated[float, Field(gt=0, le=0.1), LIVE] = 0.05
    """Maximum speed, m/s."""
    across: Annotated[float, Field(gt=0, le=0.3)] = 0.15
    """Maximum distance from the axis of the dock, m."""
    turn: Annotated[float, Field(gt=0, le=0.5)] = 0.3
    """Maximum heading relative to that axis, rad."""
    beyond: Annotated[float, Field(ge=0, le=0.1)] = 0.02
    """Maximum distance past the docked pose, m."""


class SonarLimits(Schema):
    """Limits for the sonars of a robot without a lidar, and for rear sonars of a robot with a lidar."""

    stale_after: Annotated[float, Field(gt=0, le=1)] = topics.SONAR.fresh_for()
    """Age above which the latest round of pings, or the latest answer of a sonar, is stale, s."""
    core: Annotated[float, Field(gt=0, le=1)] = 0.2
    """Half angle of the cone that may contain the echoes of a sonar not facing the direction of travel, rad; without a
    lidar only."""
    unseen_speed: Positive = 0.1
    """Speed limit while a sonar does not answer, or no sonar faces the direction of travel, m/s; without a lidar
    only."""


class ShaftCheckConfig(Schema):
    """Detection of a driven shaft that does not turn when commanded."""

    within: Positive = 0.6
    """Time without turning that stops the truck, s."""
    speed: Positive = 0.03
    """Minimum commanded speed for the comparison, m/s."""
    share: Annotated[float, Field(gt=0, lt=1)] = 0.1
    """Fraction of the commanded speed below which a shaft does not turn."""


class ContactConfig(Schema):
    """Detection of contact while an operator drives into unseen ground, and how far the robot backs off."""

    rise: Annotated[float, Field(gt=0, le=10)] = 1.0
    """Rise of a motor's current above its rolling current that shows a contact, as a fraction of that current: less
    than half of the truck's rise until its clutch slips."""
    rolling: Annotated[float, Field(gt=0, le=2)] = 0.25
    """Assumed rolling current on unseen ground and near a dock until the robot has measured its own elsewhere, A. Raise
    it for motors that draw more than ``rolling`` and its ``rise`` while they roll."""
    share: Annotated[float, Field(gt=0, lt=1)] = 0.3
    """Fraction of the commanded speed below which shafts, free wheels and turns are held."""
    within: Annotated[float, Field(gt=0, le=0.3)] = 0.15
    """Minimum duration of such a low speed, s."""
    back_off: Annotated[float, Field(gt=0, le=0.2)] = 0.03
    """Distance backed off, m."""


class RunawayConfig(Schema):
    """Detection of uncommanded motion of a motor."""

    distance: Annotated[float, Field(gt=0, le=0.05)] = 0.01
    """Tolerated distance of a shaft beyond its orders and ramps, and of the body by motion proven by scans, m."""
    body_distance: Annotated[float, Field(gt=0, le=0.2)] = 0.03
    """Tolerated travel of free wheels or the turning body after all drives should be at rest, m: gears unwind."""
    idle_current: Annotated[float, Field(gt=0, le=0.5)] = 0.05
    """Motor current below which a power stage that is off turns nothing, A: the robot is pushed or rolls."""


class GateConfig(Schema):
    """Settings of the safety gate."""

    rate: Annotated[float, Field(ge=10, le=200)] = 50.0
    """Control rate, ticks per second."""

    speed: LivePositive = 0.21
    """Maximum wheel speed over ground, forward, m/s."""
    reverse_speed: LivePositive = 0.15
    """Maximum wheel speed in other motions (reverse, sideways, on the spot), m/s: the lidar does not cover all of
    them.
    """
    angle: Annotated[float, Field(gt=0, lt=1.0), LIVE] = 0.436
    """Maximum axle angle, rad; less if the servos' pulses reach less."""
    acceleration: LivePositive = 0.5
    """Maximum increase of the commanded speed of base and wheels, m/s^2."""
    yaw_acceleration: Annotated[float, Field(gt=0, le=20), LIVE] = 6.0
    """Maximum increase of the commanded yaw rate, rad/s^2."""
    deceleration: Positive = 1.0
    """Minimum deceleration of the drive controller's profile after a command of speed 0, m/s^2."""
    quick_deceleration: Positive = 1.2
    """Minimum deceleration of the drive controller's quick stop, m/s^2."""
    steering_rate: Annotated[float, Field(gt=0, le=12), LIVE] = 1.0
    """Maximum steering rate, rad/s; the fastest servos turn by 60 degrees in 0.09 s."""
    reaction: NotNegative = 0.08
    """Time from a command of the gate to the truck's response, s."""
    standstill: Positive = 0.01
    """Measured speed below which the truck is at rest, m/s."""

    leases: Leases = Leases()
    max_request_age: Positive = 0.5
    """Maximum age of the gate state whose stamp every request that may set the truck in motion must carry, s."""
    remote_trackers: Annotated[tuple[str, ...], Field(strict=False)] = ()
    """External sources that may drive as trackers."""
    disarm_after: Annotated[float, Field(gt=0, le=10)] = 1.5
    """Time without executable drive requests that disarms the truck, s: people may come near it."""

    scan: SensorLimit = _limit(topics.SCAN)
    scan_tilt: Annotated[float, Field(gt=0, le=math.pi / 4)] = 0.35
    """Maximum tilt of the plane of a valid scan, rad: half a metre ahead, the distance checked by the gate, a more
    tilted plane passes 0.2 m above or below an obstacle."""
    drive: SensorLimit = _limit(topics.DRIVE)
    steering: SensorLimit = _limit(topics.STEERING)
    attitude: SensorLimit | None = _limit(topics.COMPASS)
    """Attitude limit; null for a robot without a compass or tilt sensor: no tilt limits, no attitude expected."""
    battery: SensorLimit = _limit(topics.BATTERY, critical=False)
    max_latency: Positive = 0.4
    """Maximum time between a sample's stamp and its arrival, s; a later sample is invalid."""
    tolerated_failures: Annotated[tuple[str, ...], Field(strict=False)] = (
        ServiceName.RECORDER.value,
        DeviceRole.CAMERA.value,
        DeviceRole.LINK.value,
        DeviceRole.HOST.value,
        ServiceName.USB.value,
        ServiceName.STALLS.value,
    )
    """Services whose failure does not stop the truck."""

    tick_stall: Positive = 0.15
    """Pause between two ticks above which the truck stops, s."""
    stall_dwell: Positive = 0.5
    """Time of punctual ticks that ends such a stop, s."""

    tilt: TiltLimits = TiltLimits()
    turning: SteeringCheckConfig | None = SteeringCheckConfig()
    """Comparison of compass and steering, detects servos without supply; null disables it."""
    contact: ContactConfig | None = ContactConfig()
    """Detection of contact while an operator drives into unseen ground; null disables it."""
    blocked: ShaftCheckConfig | None = ShaftCheckConfig()
    """Comparison of commanded and measured speed of each driven shaft, detects blocked shafts; null disables it."""
    runaway: RunawayConfig | None = RunawayConfig()
    """Comparison of measured and commanded motion, detects motors that do not obey; null disables it."""
    short_faults: Annotated[int, Field(ge=2, le=10)] = 4
    """Number of stops for stale sensors within ``short_faults_within`` that disarms the truck."""
    short_faults_within: Positive = 10.0
    """Time window for ``short_faults``, s; at least one second for each of them."""
    battery_low_speed: LivePositive = 0.1
    """Speed limit with a low battery, or a stale battery voltage, m/s."""
    obstacle: ObstacleLimits = ObstacleLimits()
    assist: AssistConfig = AssistConfig()
    sonar: SonarLimits = SonarLimits()
    docking: DockingLimits = DockingLimits()
    unwitnessed: Annotated[float, Field(gt=0, le=1), LIVE] = 0.5
    """Fraction of the speed limits while no second, independent sensor measures the robot's motion."""
    event_interval: NotNegative = 1.0
    """Minimum time between two equal events, s."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.quick_deceleration < self.deceleration:
            msg = (
                f"quick_deceleration {self.quick_deceleration} m/s^2: expected at least the ordinary deceleration, "
                f"{self.deceleration} m/s^2"
            )
            raise ValueError(msg)
        if self.tick_stall <= 1.0 / self.rate:
            raise ValueError(f"tick_stall {self.tick_stall} s: expected more than one tick, {1.0 / self.rate:g} s")
        if self.standstill > self.obstacle.crawl:
            msg = f"standstill {self.standstill} m/s: expected at most obstacle.crawl, {self.obstacle.crawl} m/s"
            raise ValueError(msg)
        if self.obstacle.crawl >= self.speed:
            raise ValueError(f"obstacle.crawl {self.obstacle.crawl} m/s: expected less than speed, {self.speed} m/s")
        if self.short_faults_within < self.short_faults:
            msg = (
                f"short_faults_within {self.short_faults_within} s: expected at least one second for each of "
                f"{self.short_faults}"
            )
            raise ValueError(msg)
        if max(vars(self.leases).values()) >= self.disarm_after:
            raise ValueError(f"disarm_after {self.disarm_after} s: expected more than every lease")
        return self


class InForce:
    """Limits in force; the owner may replace ``config`` between two ticks.

    Args:
        config: initial limits.
    """

    def __init__(self, config: GateConfig) -> None:
        self.config = config


GRIP: Final = 0.6
"""Maximum friction coefficient of rubber wheels on a smooth floor."""
SLIPPING: Final = math.atan(GRIP)
"""Slope on which the wheels slip, rad."""


@dataclass(frozen=True, slots=True)
class BodyLimits:
    """Physical limits of one body."""

    length: float
    """Length of the body, m."""
    mass: float
    """Mass of the body, kg."""
    pull: float
    """Maximum total force of all driven shafts at the ground, N."""
    motor_speed: float | None
    """Wheel speed over ground at the maximum motor rate, m/s; None if unknown."""
    sight: float | None
    """Distance ahead of the body within which its lidar reliably sees an obstacle, m; None without a lidar."""

    @property
    def acceleration(self) -> float:
        """Maximum acceleration that motors and wheels can sustain (m/s^2)."""
        gravity = 9.81
        return min(self.pull / self.mass, GRIP * gravity)


def impossible_settings(config: GateConfig, body: BodyLimits, times: Iterable[tuple[str, float]] = ()) -> Iterator[str]:
    """Messages for settings that exceed the body's limits, each with the limit.

    Args:
        config: settings of the gate.
        body: physical limits.
        times: names and values (s) of other settings that let the truck continue unattended.
    """
    rounding = 1e-9
    for name in ("acceleration", "deceleration", "quick_deceleration"):
        if getattr(config, name) > body.acceleration + rounding:
            yield (
                f"gate.{name} {getattr(config, name):g} m/s^2: at most {body.acceleration:.2f}, the "
                f"acceleration by {body.pull:g} N and the grip of the wheels at {body.mass:g} kg"
            )
    if body.motor_speed is not None and config.speed > body.motor_speed + rounding:
        yield f"gate.speed {config.speed:g} m/s: at most {body.motor_speed:.3f}, the speed at the motor's maximum rate"
    if config.reverse_speed > config.speed:
        yield f"gate.reverse_speed {config.reverse_speed:g} m/s: at most gate.speed, {config.speed:g}"
    seen = body.length if body.sight is None else body.sight
    needed = stopping_distance(config)
    if needed > seen:
        whose = "its own length, as it has no lidar" if body.sight is None else "the lidar's reliable range"
        yield (
            f"gate.speed {config.speed:g} m/s: with gate.scan.stale_after, max_latency, reaction and "
            f"deceleration the robot stops within {needed:.3g} m: at most {seen:.2f} m, {whose}"
        )
    longest = body.length / config.speed
    for name, seconds in (*unattended(config), *times):
        if seconds > longest:
            yield f"{name} {seconds:g} s: at most {longest:.2f} s, the time to travel the robot's length at gate.speed"
    yield from _beyond_checks(config)


def _beyond_checks(config: GateConfig) -> Iterator[str]:
    """Messages for check settings that could never stop a truck."""
    if config.obstacle.deceleration > config.deceleration:
        yield (
            f"gate.obstacle.deceleration {config.obstacle.deceleration:g} m/s^2: at most gate.deceleration, "
            f"{config.deceleration:g}"
        )
    if config.tilt.stop > SLIPPING:
        yield f"gate.tilt.stop {config.tilt.stop:g} rad: at most {SLIPPING:.3f}, where the wheels slip"
    for name in ("turning", "blocked"):
        check: SteeringCheckConfig | ShaftCheckConfig | None = getattr(config, name)
        if check is not None and check.speed >= config.speed:
            yield f"gate.{name}.speed {check.speed:g} m/s: expected less than gate.speed, {config.speed:g}"


def stopping_distance(config: GateConfig) -> float:
    """Worst-case distance from the position of the latest scan to standstill (m)."""
    delay = config.scan.stale_after + config.max_latency + config.reaction
    speed = config.speed  # a product cannot raise OverflowError, a power can
    return config.obstacle.ahead + speed * delay + speed * speed / (2 * config.deceleration)


def required_sensors(config: GateConfig) -> dict[str, SensorLimit]:
    """Limits of the sensors that by default stop the truck when stale, by sensor key."""
    limits = ((name, limit) for name, limit in config if isinstance(limit, SensorLimit))
    return {name: limit for name, limit in limits if GateConfig.model_fields[name].default.critical}


def unattended(config: GateConfig) -> Iterator[tuple[str, float]]:
    """Settings that let the truck continue unattended, each with the time (s)."""
    for name, limit in required_sensors(config).items():
        yield f"gate.{name}.stale_after", limit.stale_after
    for name in ("max_latency", "reaction", "tick_stall", "max_request_age"):
        yield f"gate.{name}", getattr(config, name)
    for name, lease in vars(config.leases).items():
        yield f"gate.leases.{name}", lease
    if config.blocked is not None:
        yield "gate.blocked.within", config.blocked.within


WEAKER_ABOVE: Final = (
    "speed",
    "reverse_speed",
    "angle",
    "acceleration",
    "yaw_acceleration",
    "deceleration",
    "quick_deceleration",
    "steering_rate",
    "standstill",
    "leases.hand",
    "leases.gamepad",
    "leases.keyboard",
    "leases.station",
    "leases.tracker",
    "max_request_age",
    "disarm_after",
    "scan.stale_after",
    "drive.stale_after",
    "steering.stale_after",
    "attitude.stale_after",
    "battery.stale_after",
    "scan_tilt",
    "max_latency",
    "tick_stall",
    "tilt.slow",
    "tilt.stop",
    "tilt.slow_speed",
    "turning.window",
    "turning.tolerance",
    "turning.share",
    "turning.speed",
    "battery_low_speed",
    "obstacle.deceleration",
    "obstacle.unseen_speed",
    "obstacle.memory_time",
    "obstacle.memory_deviation",
    "docking.speed",
    "docking.across",
    "docking.turn",
    "docking.beyond",
    "sonar.stale_after",
    "sonar.unseen_speed",
    "unwitnessed",
    "blocked.within",
    "blocked.speed",
    "contact.rise",
    "contact.rolling",
    "contact.within",
    "runaway.distance",
    "runaway.body_distance",
    "runaway.idle_current",
    "short_faults",
)
"""Gate settings that weaken the gate when increased."""

WEAKER_BELOW: Final = (
    "rate",
    "reaction",
    "stall_dwell",
    "tilt.hysteresis",
    "obstacle.ahead",
    "obstacle.side_clearance",
    "obstacle.crawl",
    "obstacle.memory_distance",
    "obstacle.seen",
    "sonar.core",
    "blocked.share",
    "contact.share",
    "contact.back_off",
    "short_faults_within",
)
"""Gate settings that weaken the gate when decreased."""


def weakened(config: GateConfig) -> tuple[str, ...]:
    """Messages for gate settings weaker than the defaults, each with its value and the default."""
    default = GateConfig()
    texts = [*weaker("gate", config, default, WEAKER_ABOVE, WEAKER_BELOW)]
    texts += [
        f"gate.{name}.critical false: a silent sensor does not stop the robot"
        for name, limit in required_sensors(config).items()
        if not limit.critical
    ]
    if config.attitude is None:
        texts.append("gate.attitude null: no slope stops the robot, and servos without supply are not noticed")
    if config.turning is None:
        texts.append("gate.turning null: servos without supply are not noticed")
    if config.blocked is None:
        texts.append("gate.blocked null: a blocked shaft is not noticed")
    if config.contact is None:
        texts.append("gate.contact null: a contact in unseen ground is not noticed")
    if config.runaway is None:
        texts.append("gate.runaway null: a motor that does not obey is not noticed")
    if config.obstacle.unseen == "slow":
        texts.append("gate.obstacle.unseen slow: the robot drives into ground that no sensor has seen")
    if config.obstacle.open_ground:
        texts.append("gate.obstacle.open_ground true: a scan without any range is treated as free ground")
    if more := sorted(set(config.tolerated_failures) - set(default.tolerated_failures)):
        texts.append(f"gate.tolerated_failures: {', '.join(more)} may fail while the robot drives")
    if config.remote_trackers:
        texts.append(f"gate.remote_trackers: {', '.join(config.remote_trackers)} may drive from outside")
    return tuple(texts)


def weaker(section: str, config: Schema, usual: Schema, above: Iterable[str], below: Iterable[str]) -> Iterator[str]:
    """Messages for settings weaker than the usual ones, each with its value and the usual value.

    Args:
        section: section name for the messages.
        config: settings.
        usual: usual settings.
        above: dotted names of settings that weaken when increased; a value of None is not compared.
        below: dotted names of settings that weaken when decreased.
    """
    for names, sign in ((above, 1), (below, -1)):
        for name in names:
            value, default = _value(config, name), _value(usual, name)
            if value is not None and default is not None and sign * (value - default) > 0:
                yield f"{section}.{name} {value:g}, default {default:g}"


def _value(config: Schema, name: str) -> Any:
    """Return a setting by its dotted name; None if its section is off."""
    found: Any = config
    for part in name.split("."):
        found = None if found is None else getattr(found, part)
    return found
