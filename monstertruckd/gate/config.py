"""Limits of the safety gate. Lengths m, angles rad, times s, speeds m/s."""

import math
from typing import Annotated, Any, Self

from pydantic import Field, model_validator

from monstertruck_schemas import topics
from monstertruck_schemas.base import Schema
from monstertruck_schemas.req import Role
from monstertruck_schemas.topics import Topic

Positive = Annotated[float, Field(gt=0)]
Share = Annotated[float, Field(ge=0)]


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

    slow: Annotated[float, Field(gt=0, lt=math.pi / 2)] = 0.21
    """From this tilt on the speed is limited to ``slow_speed``, rad."""
    stop: Annotated[float, Field(gt=0, lt=math.pi / 2)] = 0.35
    """From this tilt on the truck stops, rad."""
    hysteresis: Annotated[float, Field(ge=0)] = 0.035
    """A limit ends when the tilt is this much below where it began, rad."""
    slow_speed: Positive = 0.08

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if not self.hysteresis < self.slow < self.stop:
            msg = f"tilt: expected hysteresis < slow < stop, got {self.hysteresis}, {self.slow}, {self.stop} rad"
            raise ValueError(msg)
        return self


class SteeringCheckConfig(Schema):
    """When the measured yaw contradicts the steering."""

    window: Positive = 2.0
    """Seconds over which turns are compared."""
    tolerance: Positive = 0.14
    """Tolerated difference: compass errors and the servos' lag, rad."""
    speed: Positive = 0.03
    """Below this speed nothing is compared: the truck may be turned by hand, m/s."""
    share: Annotated[float, Field(ge=0, lt=1)] = 0.3
    """Tolerated difference as a share of the larger turn: tyre slip and calibration."""


class ObstacleLimits(Schema):
    """Clearance kept along the swept path."""

    ahead: Share = 0.05
    """Distance between footprint and obstacle after the stop, m."""
    side_clearance: Share = 0.02
    """Clearance to all sides while passing, m, added to the footprint's padding."""
    deceleration: Positive = 0.15
    """Comfortable deceleration towards an obstacle, m/s^2: decides how early the truck slows down."""
    crawl: Positive = 0.02
    """An allowed speed below this is a stop; driving on needs twice as much, m/s."""
    seen: Annotated[float, Field(gt=0, le=1)] = 0.5
    """Share of the beams in each sector of travel (10 degrees) that must see: measure a range, or meet nothing within
    the lidar's range. A recorded URG-04LX has 0.95 to 1.0 of them, and less than half in one of 800 sectors."""
    unseen_speed: Positive = 0.1
    """Speed limit while a sector of travel is not seen, m/s; one not seen for ``scan.stale_after`` stops the truck."""
    open_ground: bool = False
    """Whether a scan without any range is believed: otherwise it counts as none, whatever its beams say."""


class ShaftCheckConfig(Schema):
    """When a driven shaft does not turn although it is commanded to."""

    within: Positive = 0.6
    """Seconds of it after which the truck stops."""
    speed: Positive = 0.03
    """Slower commands are not compared, m/s."""
    share: Annotated[float, Field(gt=0, lt=1)] = 0.1
    """A shaft slower than this share of its command does not turn."""


class GateConfig(Schema):
    """Settings of the safety gate."""

    rate: Annotated[float, Field(ge=10, le=200)] = 50.0
    """Control ticks per second."""

    speed: Positive = 0.21
    """Greatest wheel speed over ground, forward, m/s."""
    reverse_speed: Positive = 0.15
    """Greatest wheel speed in other motions (reverse, sideways, on the spot): the lidar does not see it all, m/s."""
    angle: Annotated[float, Field(gt=0, lt=1.0)] = 0.436
    """Greatest axle angle, rad; less where the servos' pulses reach less."""
    acceleration: Positive = 0.5
    """Growth of the commanded speed of base and wheels, m/s^2."""
    deceleration: Positive = 1.0
    """Least deceleration of the drive controller's profile after a command of speed 0, m/s^2."""
    quick_deceleration: Positive = 1.2
    """Least deceleration of its quick stop, m/s^2."""
    steering_rate: Positive = 1.0
    """Greatest change of a steering angle, rad/s."""
    reaction: Share = 0.08
    """Seconds from a command leaving the gate to the truck's response."""
    standstill: Positive = 0.01
    """Measured speed below which the truck is at rest, m/s."""

    leases: Leases = Leases()
    max_request_age: Positive = 0.5
    """A request that may set the truck in motion must carry the stamp of a gate state not older than this, s."""
    remote_trackers: Annotated[tuple[str, ...], Field(strict=False)] = ()
    """Sources outside the robot that may drive as trackers."""
    disarm_after: Positive = 1.5
    """Seconds without a driver whose requests can be carried out, after which the truck disarms."""

    scan: SensorLimit = _limit(topics.SCAN)
    scan_tilt: Annotated[float, Field(gt=0, le=math.pi / 2)] = 0.35
    """A scan whose plane was tilted more than this is not valid, rad: half a metre ahead, as far as the gate checks, it
    passes 0.2 m above or below an obstacle."""
    drive: SensorLimit = _limit(topics.DRIVE)
    steering: SensorLimit = _limit(topics.STEERING)
    attitude: SensorLimit = _limit(topics.COMPASS)
    battery: SensorLimit = _limit(topics.BATTERY, critical=False)
    max_latency: Positive = 0.4
    """Greatest time between a sample's stamp and its arrival, s; a later sample is not valid."""
    tolerated_failures: Annotated[tuple[str, ...], Field(strict=False)] = (
        "recorder",
        "camera",
        "link",
        "host",
        "usb",
        "stalls",
    )
    """Services whose failure does not stop the truck."""

    tick_stall: Positive = 0.15
    """A longer pause between two ticks stops the truck, s."""
    stall_dwell: Positive = 0.5
    """Seconds of punctual ticks after which such a stop ends."""

    tilt: TiltLimits = TiltLimits()
    turning: SteeringCheckConfig | None = SteeringCheckConfig()
    """Compass against steering, finds servos without supply; null = off."""
    blocked: ShaftCheckConfig | None = ShaftCheckConfig()
    """Commanded against measured speed of each driven shaft, finds blocked ones; null = off."""
    short_faults: Annotated[int, Field(ge=2)] = 4
    """So many stops for stale sensors within ``short_faults_within`` disarm: the fault is no short one."""
    short_faults_within: Positive = 10.0
    """Seconds."""
    battery_low_speed: Positive = 0.1
    """Speed limit with a low battery, or a stale battery voltage, m/s."""
    obstacle: ObstacleLimits = ObstacleLimits()
    event_interval: Share = 1.0
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
            msg = f"tick_stall {self.tick_stall} s: expected more than one tick, {1.0 / self.rate:g} s"
            raise ValueError(msg)
        if self.standstill >= self.speed:
            msg = f"standstill {self.standstill} m/s: expected less than speed, {self.speed} m/s"
            raise ValueError(msg)
        if max(vars(self.leases).values()) >= self.disarm_after:
            msg = f"disarm_after {self.disarm_after} s: expected more than every lease"
            raise ValueError(msg)
        return self
