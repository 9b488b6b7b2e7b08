"""Limits of the safety gate. Lengths m, angles rad, times s, speeds m/s."""

import math
from typing import Annotated, Any, Self

from pydantic import Field, model_validator

from monstertruck_schemas import topics
from monstertruck_schemas.base import Schema
from monstertruck_schemas.req import Role
from monstertruck_schemas.topics import Topic
from monstertruckd.gate.steering_check import SteeringCheckConfig

Positive = Annotated[float, Field(gt=0)]
Share = Annotated[float, Field(ge=0)]


class SensorLimit(Schema):
    """What one sensor's silence means."""

    stale_after: Positive
    """Seconds after the daemon received the newest good sample at which it no longer counts."""
    critical: bool = True
    """Silence stops the truck; otherwise the sensor's own limits merely lapse with it."""


def _limit(topic: Topic[Any], *, critical: bool = True) -> SensorLimit:
    """The topic table's limit, unless the configuration names another one."""
    return SensorLimit(stale_after=topic.fresh_for(), critical=critical)


class Leases(Schema):
    """Longest lease the gate grants each role, s, whatever the request asks for."""

    gamepad: Annotated[float, Field(gt=0, le=1)] = 0.25
    keyboard: Annotated[float, Field(gt=0, le=1)] = 0.25
    station: Annotated[float, Field(gt=0, le=1)] = 0.25
    tracker: Annotated[float, Field(gt=0, le=1)] = 0.25

    def of(self, role: Role) -> float:
        """Cap of a driving role, s."""
        cap: float = getattr(self, role.value)
        return cap


class TiltLimits(Schema):
    """Angle between the truck's z axis and the vertical, and what it allows."""

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


class ObstacleLimits(Schema):
    """How much room the truck keeps along the way it is about to sweep."""

    ahead: Share = 0.05
    """Left between the footprint and the obstacle after the stop, m."""
    beside: Share = 0.02
    """Kept to all sides while passing, m, on top of the footprint's padding."""
    deceleration: Positive = 0.15
    """Comfortable deceleration towards an obstacle, m/s^2: decides how early the truck slows down."""
    crawl: Positive = 0.02
    """An allowed speed below this one is a stop; going on needs twice as much, m/s."""


class GateConfig(Schema):
    """Everything the safety gate may be told."""

    rate: Annotated[float, Field(ge=10, le=200)] = 50.0
    """Control ticks per second."""

    speed: Positive = 0.21
    """Greatest speed of the wheels over ground, forward, m/s."""
    reverse_speed: Positive = 0.15
    """The same backwards, where the lidar does not look, m/s."""
    angle: Annotated[float, Field(gt=0, lt=1.0)] = 0.436
    """Greatest axle angle, rad."""
    acceleration: Positive = 0.5
    """Growth of the commanded speed, m/s^2."""
    deceleration: Positive = 1.0
    """Deceleration the drive controller's profile reaches at least, once it is told speed 0, m/s^2."""
    quick_deceleration: Positive = 1.2
    """The same for its quick stop, m/s^2."""
    steering_rate: Positive = 1.0
    """Greatest change of an axle angle, rad/s."""
    reaction: Share = 0.08
    """Seconds from a command leaving the gate to the truck beginning to obey."""
    standstill: Positive = 0.01
    """Measured speed below which the truck is at rest, m/s."""

    leases: Leases = Leases()
    max_request_age: Positive = 0.5
    """A request that may set the truck in motion counts only if its sender knew a gate state not older than this, s."""
    remote_trackers: Annotated[tuple[str, ...], Field(strict=False)] = ()
    """Sources outside the robot that may drive as trackers."""
    disarm_after: Positive = 1.5
    """Seconds without a driver whose requests can be carried out, after which the truck disarms."""

    scan: SensorLimit = _limit(topics.SCAN)
    scan_tilt: Annotated[float, Field(gt=0, le=math.pi / 2)] = 0.35
    """A scan whose plane was tilted more than this is no good sample: within the gate's reach of half a metre it looks
    0.2 m over or under what it should see, rad."""
    drive: SensorLimit = _limit(topics.DRIVE)
    steering: SensorLimit = _limit(topics.STEERING)
    attitude: SensorLimit = _limit(topics.COMPASS)
    battery: SensorLimit = _limit(topics.BATTERY, critical=False)
    max_latency: Positive = 0.4
    """Greatest distance between a sample's stamp and its arrival, s; beyond it the sample is not a good one."""
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
    """Seconds of punctual ticks that end such a stop."""

    tilt: TiltLimits = TiltLimits()
    turning: SteeringCheckConfig | None = SteeringCheckConfig()
    """Compass against steering: servos without supply are found; null = off."""
    battery_low_speed: Positive = 0.1
    """Speed limit with a low, or no longer measured, battery, m/s."""
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
