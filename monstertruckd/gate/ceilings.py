"""What a body can do at most, whatever its configuration says, and where a configuration is weaker than the defaults.

A speed is possible if the motor reaches it and the body can stop from it on ground that was seen. A time without
samples is possible if the body travels no further than its own length meanwhile.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

from monstertruckd.gate.config import GateConfig, SensorLimit

SIGHT: Final = 4.0
"""Distance at which the scanner is sure to see an obstacle, m (URG-04LX, data sheet)."""

GRAVITY: Final = 9.81
GRIP: Final = 0.6
"""Friction of rubber wheels on a smooth floor, at most."""

ROUNDING: Final = 1e-9


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
        return min(self.pull / self.mass, GRIP * GRAVITY)


def beyond(config: GateConfig, body: BodyLimits) -> Iterator[str]:
    """Every setting that asks for more than the body can do, with what it can."""
    for name in ("acceleration", "deceleration", "quick_deceleration"):
        if getattr(config, name) > body.acceleration + ROUNDING:
            yield (
                f"gate.{name} {getattr(config, name):g} m/s^2: at most {body.acceleration:.2f}, what {body.pull:g} N "
                f"and the grip of the wheels do to {body.mass:g} kg"
            )
    if body.motor_speed is not None and config.speed > body.motor_speed + ROUNDING:
        yield f"gate.speed {config.speed:g} m/s: at most {body.motor_speed:.3f}, the speed at the motor's greatest rate"
    if config.reverse_speed > config.speed:
        yield f"gate.reverse_speed {config.reverse_speed:g} m/s: at most gate.speed, {config.speed:g}"
    seen = body.length if body.sight is None else body.sight
    needed = stopping_distance(config)
    if needed > seen:
        whose = "its own length, as it has no lidar" if body.sight is None else "what the lidar is sure to see"
        yield (
            f"gate.speed {config.speed:g} m/s: with gate.scan.stale_after, max_latency, reaction and deceleration the "
            f"truck stands after {needed:.3g} m: at most {seen:.2f} m, {whose}"
        )
    longest = body.length / config.speed
    for name, seconds in _times(config):
        if seconds > longest:
            yield (
                f"gate.{name} {seconds:g} s: at most {longest:.2f} s, in which the truck travels its own length at "
                f"gate.speed"
            )


def stopping_distance(config: GateConfig) -> float:
    """Distance from where the newest scan was taken to standstill, at worst, m."""
    delay = config.scan.stale_after + config.max_latency + config.reaction
    return config.obstacle.ahead + config.speed * delay + config.speed**2 / (2 * config.deceleration)


def _times(config: GateConfig) -> Iterator[tuple[str, float]]:
    """Times in which the truck drives on whatever happens, s."""
    for name in ("scan", "drive", "steering", "attitude"):
        limit: SensorLimit = getattr(config, name)
        yield f"{name}.stale_after", limit.stale_after
    for name in ("max_latency", "reaction", "tick_stall", "max_request_age"):
        yield name, getattr(config, name)


WEAKER_ABOVE: Final = (
    "speed",
    "reverse_speed",
    "angle",
    "acceleration",
    "deceleration",
    "quick_deceleration",
    "standstill",
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
    "blocked.within",
    "blocked.speed",
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
    "obstacle.seen",
    "blocked.share",
    "short_faults_within",
)
"""Settings of the gate that are weaker the less they are."""


def weakened(config: GateConfig) -> tuple[str, ...]:
    """Settings of the gate that are weaker than the defaults, each with its value and the default."""
    default = GateConfig()
    found = [
        (name, value, usual)
        for names, sign in ((WEAKER_ABOVE, 1), (WEAKER_BELOW, -1))
        for name in names
        if (value := _value(config, name)) is not None
        and (usual := _value(default, name)) is not None
        and sign * (value - usual) > 0
    ]
    texts = [f"gate.{name} {value:g}, default {usual:g}" for name, value, usual in found]
    texts += [
        f"gate.{name}.critical false: a silent sensor does not stop the truck"
        for name in ("scan", "drive", "steering", "attitude")
        if not getattr(config, name).critical
    ]
    if config.turning is None:
        texts.append("gate.turning null: servos without supply are not noticed")
    if config.blocked is None:
        texts.append("gate.blocked null: a blocked shaft is not noticed")
    if config.obstacle.open_ground:
        texts.append("gate.obstacle.open_ground true: a scan without any range counts as free ground")
    if more := sorted(set(config.tolerated_failures) - set(default.tolerated_failures)):
        texts.append(f"gate.tolerated_failures: {', '.join(more)} may fail while the truck drives")
    if config.remote_trackers:
        texts.append(f"gate.remote_trackers: {', '.join(config.remote_trackers)} may drive from outside")
    return tuple(texts)


def _value(config: GateConfig, name: str) -> Any:
    """A setting by its dotted name; None if its section is off."""
    found: Any = config
    for part in name.split("."):
        found = None if found is None else getattr(found, part)
    return found
