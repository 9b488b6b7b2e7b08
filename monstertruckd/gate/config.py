"""Limits of the safety gate, and what a body can do at most, whatever its configuration says.

A speed is possible if the motor reaches it and the body can stop from it on ground that was seen. A time without
samples is possible if the body travels no further than its own length meanwhile. A tilt is possible up to where the
wheels slip. Lengths m, angles rad, times s, speeds m/s.
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
    """When one sensor is stale, and what that means."""

    stale_after: Annotated[float, Field(gt=0, le=60)]
    """Age of the newest valid sample, s since the daemon received it, from which on the sensor is stale."""
    critical: bool = True
    """A stale sensor stops the truck; otherwise only the limits derived from it lapse."""


def _limit(topic: Topic[Any], *, critical: bool = True) -> SensorLimit:
    """The topic table's limit, unless the configuration names another one."""
    return SensorLimit(stale_after=topic.fresh_for(), critical=critical)


class Leases(Schema):
    """Longest lease granted to each role, s, whatever the request asks for."""

    hand: Annotated[float, Field(gt=0, le=1)] = 0.25
    gamepad: Annotated[float, Field(gt=0, le=1)] = 0.25
    keyboard: Annotated[float, Field(gt=0, le=1)] = 0.25
    station: Annotated[float, Field(gt=0, le=1)] = 0.25
    tracker: Annotated[float, Field(gt=0, le=1)] = 0.25

    def of(self, role: Role) -> float:
        """Cap of a driving role, s."""
        cap: float = getattr(self, role.value)
        return cap


class TiltLimits(Schema):
    """Limits of the angle between the truck's z axis and the vertical."""

    slow: LiveTilt = 0.21
    """From this tilt on the speed is limited to ``slow_speed``, rad."""
    stop: LiveTilt = 0.35
    """From this tilt on the truck stops, rad."""
    hysteresis: Annotated[float, Field(ge=0)] = 0.035
    """A limit ends when the tilt is this much below where it began, rad."""
    slow_speed: LivePositive = 0.08
    """Speed limit from there on, m/s."""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if not self.hysteresis < self.slow < self.stop:
            msg = f"tilt: expected hysteresis < slow < stop, got {self.hysteresis}, {self.slow}, {self.stop} rad"
            raise ValueError(msg)
        return self


class SteeringCheckConfig(Schema):
    """When the measured yaw contradicts the steering."""

    window: Annotated[float, Field(gt=0, le=5)] = 2.0
    """Seconds over which turns are compared."""
    tolerance: Annotated[float, Field(gt=0, le=math.pi / 2)] = 0.14
    """Tolerated difference: compass errors and the servos' lag, rad."""
    speed: Positive = 0.03
    """Below this speed nothing is compared: the truck may be turned by hand, m/s."""
    share: Annotated[float, Field(ge=0, lt=1)] = 0.3
    """Tolerated difference as a share of the larger turn: tyre slip and calibration."""


class ObstacleLimits(Schema):
    """Clearance kept along the swept path."""

    ahead: LiveNotNegative = 0.05
    """Distance between footprint and obstacle after the stop, m."""
    side_clearance: LiveNotNegative = 0.02
    """Clearance to all sides while passing, m, added to the footprint's padding."""
    deceleration: LivePositive = 0.15
    """Comfortable deceleration towards an obstacle, m/s^2: decides how early the truck slows down."""
    crawl: Positive = 0.02
    """An allowed speed below this is a stop; driving on needs twice as much, m/s."""
    seen: Annotated[float, Field(gt=0, le=1)] = 0.5
    """Share of the beams in each sector of travel (10 degrees) that must measure a range, or meet nothing within the
    lidar's range. A recorded URG-04LX has 0.95 to 1.0, and less than half in one of 800 sectors."""
    unseen_speed: LivePositive = 0.1
    """Speed limit while a sector of travel is not seen, m/s; one not seen for ``scan.stale_after`` stops the truck.
    Also the limit for a body that moves sideways, turns on the spot or swings its tail onto ground that no scan has
    seen lately."""
    unseen: Literal["stop", "slow"] = "stop"
    """What to do before ground that no scan has seen lately, in reverse and with a tail that swings towards something;
    slow: ``unseen_speed``."""
    confirmed_speed: Annotated[float, Field(gt=0, le=0.05), LIVE] = 0.05
    """Speed limit into such ground for an operator who holds the second control, m/s."""
    memory_time: Annotated[float, Field(gt=0, le=120)] = 30.0
    """Age up to which earlier scans count, s: people may step onto ground that was free."""
    memory_distance: NotNegative = 2.0
    """Travelled distance for which the points of earlier scans guard the truck where its lidar does not look, m."""
    memory_deviation: Annotated[float, Field(gt=0, le=0.5)] = 0.1
    """Growth of the odometry's standard deviation from which on earlier scans no longer count, m: their places are that
    much less certain."""
    open_ground: bool = False
    """Whether a scan without any range counts as free ground; otherwise it is not valid."""


class SonarLimits(Schema):
    """Limits for the sonars of a robot without a lidar, and for those that look backwards on a robot with one."""

    stale_after: Annotated[float, Field(gt=0, le=1)] = topics.SONAR.fresh_for()
    """Age from which on the newest round of pings, or the newest answer of a sonar, is stale, s."""
    core: Annotated[float, Field(gt=0, le=1)] = 0.2
    """Half angle of the cone of a sonar that does not look in the direction of travel, rad: where its echoes may be.
    Without a lidar only."""
    unseen_speed: Positive = 0.1
    """Speed limit where a sonar does not answer, or no sonar looks in the direction of travel, m/s; without a lidar
    only."""


class ShaftCheckConfig(Schema):
    """When a driven shaft does not turn although it is commanded to."""

    within: Positive = 0.6
    """Seconds after which the truck stops."""
    speed: Positive = 0.03
    """Slower commands are not compared, m/s."""
    share: Annotated[float, Field(gt=0, lt=1)] = 0.1
    """A shaft slower than this share of its command does not turn."""


class ContactConfig(Schema):
    """Detection of contact while an operator drives into unseen ground, and how far the robot backs off."""

    current: Annotated[float, Field(gt=0, le=1)] = 0.15
    """Rise of a motor's current above the rolling current that shows a contact, A: less than half of its rise until the
    clutch slips."""
    rolling: Annotated[float, Field(gt=0, le=2)] = 0.25
    """Rolling current until the robot has measured its own, A. Raise it for motors that draw more than ``rolling`` plus
    ``current`` while they roll: such currents are taken for contact, and never learned."""
    share: Annotated[float, Field(gt=0, lt=1)] = 0.3
    """Shafts, free wheels and turns below this fraction of the commanded speed are held."""
    within: Annotated[float, Field(gt=0, le=0.3)] = 0.15
    """Time for which they must be that slow, s."""
    back_off: Annotated[float, Field(gt=0, le=0.2)] = 0.03
    """Distance backed off, m."""


class RunawayConfig(Schema):
    """When a motor turns as nobody commanded."""

    distance: Annotated[float, Field(gt=0, le=0.05)] = 0.01
    """Tolerated distance of a shaft beyond its orders and ramps, and of the body by proven motion of the scans, m."""
    body_distance: Annotated[float, Field(gt=0, le=0.2)] = 0.03
    """Distance that free wheels or the turning body may move after all drives were to rest, m: gears unwind."""
    idle_current: Annotated[float, Field(gt=0, le=0.5)] = 0.05
    """Motor current below which a power stage that is off turns nothing, A: the robot is pushed, or it rolls."""


class GateConfig(Schema):
    """Settings of the safety gate."""

    rate: Annotated[float, Field(ge=10, le=200)] = 50.0
    """Control ticks per second."""

    speed: LivePositive = 0.21
    """Greatest wheel speed over ground, forward, m/s."""
    reverse_speed: LivePositive = 0.15
    """Greatest wheel speed in other motions (reverse, sideways, on the spot): the lidar does not see it all, m/s."""
    angle: Annotated[float, Field(gt=0, lt=1.0), LIVE] = 0.436
    """Greatest axle angle, rad; less where the servos' pulses reach less."""
    acceleration: LivePositive = 0.5
    """Growth of the commanded speed of base and wheels, m/s^2."""
    yaw_acceleration: Annotated[float, Field(gt=0, le=20), LIVE] = 6.0
    """Growth of the commanded yaw rate, rad/s^2."""
    deceleration: Positive = 1.0
    """Least deceleration of the drive controller's profile after a command of speed 0, m/s^2."""
    quick_deceleration: Positive = 1.2
    """Least deceleration of its quick stop, m/s^2."""
    steering_rate: Annotated[float, Field(gt=0, le=12), LIVE] = 1.0
    """Greatest change of a steering angle, rad/s; the quickest servos turn by 60 degrees in 0.09 s."""
    reaction: NotNegative = 0.08
    """Seconds from a command leaving the gate to the truck's response."""
    standstill: Positive = 0.01
    """Measured speed below which the truck is at rest, m/s."""

    leases: Leases = Leases()
    max_request_age: Positive = 0.5
    """A request that may set the truck in motion must carry the stamp of a gate state not older than this, s."""
    remote_trackers: Annotated[tuple[str, ...], Field(strict=False)] = ()
    """Sources outside the robot that may drive as trackers."""
    disarm_after: Annotated[float, Field(gt=0, le=10)] = 1.5
    """Seconds without executable drive requests after which the truck disarms: people may come near it."""

    scan: SensorLimit = _limit(topics.SCAN)
    scan_tilt: Annotated[float, Field(gt=0, le=math.pi / 4)] = 0.35
    """A scan whose plane was tilted more than this is not valid, rad: half a metre ahead, as far as the gate checks, it
    passes 0.2 m above or below an obstacle."""
    drive: SensorLimit = _limit(topics.DRIVE)
    steering: SensorLimit = _limit(topics.STEERING)
    attitude: SensorLimit | None = _limit(topics.COMPASS)
    """Null for a robot without a compass or tilt sensor: no tilt limits, and no attitude is expected."""
    battery: SensorLimit = _limit(topics.BATTERY, critical=False)
    max_latency: Positive = 0.4
    """Greatest time between a sample's stamp and its arrival, s; a later sample is not valid."""
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
    """A longer pause between two ticks stops the truck, s."""
    stall_dwell: Positive = 0.5
    """Seconds of punctual ticks after which such a stop ends."""

    tilt: TiltLimits = TiltLimits()
    turning: SteeringCheckConfig | None = SteeringCheckConfig()
    """Compass against steering, finds servos without supply; null = off."""
    contact: ContactConfig | None = ContactConfig()
    """Contact while an operator drives into unseen ground; null = off."""
    blocked: ShaftCheckConfig | None = ShaftCheckConfig()
    """Commanded against measured speed of each driven shaft, finds blocked ones; null = off."""
    runaway: RunawayConfig | None = RunawayConfig()
    """Measured against commanded motion, finds motors that do not obey; null = off."""
    short_faults: Annotated[int, Field(ge=2, le=10)] = 4
    """Stops for stale sensors within ``short_faults_within`` after which the truck disarms."""
    short_faults_within: Positive = 10.0
    """Seconds; at least one for each of ``short_faults``."""
    battery_low_speed: LivePositive = 0.1
    """Speed limit with a low battery, or a stale battery voltage, m/s."""
    obstacle: ObstacleLimits = ObstacleLimits()
    sonar: SonarLimits = SonarLimits()
    unwitnessed: Annotated[float, Field(gt=0, le=1), LIVE] = 0.5
    """Share of the speed limits that holds while no second, independent sensor measures the robot's motion."""
    event_interval: NotNegative = 1.0
    """Least seconds between two equal events."""

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
            msg = f"short_faults_within {self.short_faults_within} s: expected a second for each of {self.short_faults}"
            raise ValueError(msg)
        if max(vars(self.leases).values()) >= self.disarm_after:
            raise ValueError(f"disarm_after {self.disarm_after} s: expected more than every lease")
        return self


class InForce:
    """The limits in force: whoever may set them replaces ``config`` between two ticks.

    Args:
        config: the first ones.
    """

    def __init__(self, config: GateConfig) -> None:
        self.config = config


GRIP: Final = 0.6
"""Friction of rubber wheels on a smooth floor, at most."""
SLIPPING: Final = math.atan(GRIP)
"""Slope on which the wheels slip, rad."""


@dataclass(frozen=True, slots=True)
class BodyLimits:
    """What bounds the motion of one body."""

    length: float
    """M."""
    mass: float
    """Kg."""
    pull: float
    """Greatest force of all driven shafts together at the ground, N."""
    motor_speed: float | None
    """Wheel speed over ground at the greatest motor rate, m/s; None = not known."""
    sight: float | None
    """Distance ahead of the body on which its lidar is sure to see an obstacle, m; None = no lidar."""

    @property
    def acceleration(self) -> float:
        """Greatest change of speed that motors and wheels hold, m/s^2."""
        gravity = 9.81
        return min(self.pull / self.mass, GRIP * gravity)


def impossible_settings(config: GateConfig, body: BodyLimits, times: Iterable[tuple[str, float]] = ()) -> Iterator[str]:
    """Every setting that asks for more than the body can do, with what it can.

    Args:
        config: the gate's.
        body: which.
        times: names and values (s) of other settings during which the truck may drive on unattended.
    """
    rounding = 1e-9
    for name in ("acceleration", "deceleration", "quick_deceleration"):
        if getattr(config, name) > body.acceleration + rounding:
            yield (
                f"gate.{name} {getattr(config, name):g} m/s^2: at most {body.acceleration:.2f}, what {body.pull:g} N "
                f"and the grip of the wheels do to {body.mass:g} kg"
            )
    if body.motor_speed is not None and config.speed > body.motor_speed + rounding:
        yield f"gate.speed {config.speed:g} m/s: at most {body.motor_speed:.3f}, the speed at the motor's greatest rate"
    if config.reverse_speed > config.speed:
        yield f"gate.reverse_speed {config.reverse_speed:g} m/s: at most gate.speed, {config.speed:g}"
    seen = body.length if body.sight is None else body.sight
    needed = stopping_distance(config)
    if needed > seen:
        whose = "its own length, as it has no lidar" if body.sight is None else "what the lidar is sure to see"
        yield (
            f"gate.speed {config.speed:g} m/s: with gate.scan.stale_after, max_latency, reaction and deceleration the "
            f"robot stands after {needed:.3g} m: at most {seen:.2f} m, {whose}"
        )
    longest = body.length / config.speed
    for name, seconds in (*_times(config), *times):
        if seconds > longest:
            yield f"{name} {seconds:g} s: at most {longest:.2f} s, as long as its own length takes at gate.speed"
    yield from _beyond_checks(config)


def _beyond_checks(config: GateConfig) -> Iterator[str]:
    """Settings of checks that could never stop a truck."""
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
    """Distance from where the newest scan was taken to standstill, at worst, m."""
    delay = config.scan.stale_after + config.max_latency + config.reaction
    speed = config.speed  # a product of any numbers is one, while a power may raise OverflowError
    return config.obstacle.ahead + speed * delay + speed * speed / (2 * config.deceleration)


def required_sensors(config: GateConfig) -> dict[str, SensorLimit]:
    """Limits of the sensors that stop the truck by default when they are stale, by their key."""
    limits = ((name, limit) for name, limit in config if isinstance(limit, SensorLimit))
    return {name: limit for name, limit in limits if GateConfig.model_fields[name].default.critical}


def _times(config: GateConfig) -> Iterator[tuple[str, float]]:
    """Settings during which the truck may drive on unattended, s."""
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
    "sonar.stale_after",
    "sonar.unseen_speed",
    "unwitnessed",
    "blocked.within",
    "blocked.speed",
    "contact.current",
    "contact.rolling",
    "contact.within",
    "runaway.distance",
    "runaway.body_distance",
    "runaway.idle_current",
    "short_faults",
)
"""Settings of the gate that are weaker the greater they are."""

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
"""Settings of the gate that are weaker the less they are."""


def weakened(config: GateConfig) -> tuple[str, ...]:
    """Settings of the gate that are weaker than the defaults, each with its value and the default."""
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
        texts.append("gate.obstacle.open_ground true: a scan without any range counts as free ground")
    if more := sorted(set(config.tolerated_failures) - set(default.tolerated_failures)):
        texts.append(f"gate.tolerated_failures: {', '.join(more)} may fail while the robot drives")
    if config.remote_trackers:
        texts.append(f"gate.remote_trackers: {', '.join(config.remote_trackers)} may drive from outside")
    return tuple(texts)


def weaker(section: str, config: Schema, usual: Schema, above: Iterable[str], below: Iterable[str]) -> Iterator[str]:
    """Every setting that is weaker than usual, with its value and the usual one.

    Args:
        section: where they are, for the texts.
        config: the settings.
        usual: likewise.
        above: dotted names of those that are weaker the greater they are; what is None is not compared.
        below: the less they are.
    """
    for names, sign in ((above, 1), (below, -1)):
        for name in names:
            value, default = _value(config, name), _value(usual, name)
            if value is not None and default is not None and sign * (value - default) > 0:
                yield f"{section}.{name} {value:g}, default {default:g}"


def _value(config: Schema, name: str) -> Any:
    """A setting by its dotted name; None if its section is off."""
    found: Any = config
    for part in name.split("."):
        found = None if found is None else getattr(found, part)
    return found
