"""What the report plots: one row per figure, one per curve."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from monstertruck_schemas import topics as t
from monstertruck_schemas.base import Message
from monstertruck_schemas.topics import Topic

Value = Callable[[Any], float | None]
"""From a decoded message to the number that is plotted, in the figure's unit; None = no sample."""


@dataclass(frozen=True, slots=True)
class Curve:
    """One line of a figure."""

    label: str
    topic: Topic[Any]
    value: Value
    turns: bool = False
    """An angle in degrees that goes round: drawn without its jumps."""


@dataclass(frozen=True, slots=True)
class Figure:
    """Curves that share an axis; figures without samples are left out."""

    title: str
    unit: str
    span: float
    """The axis covers at least this much, so that noise stays small."""
    curves: tuple[Curve, ...]
    zero: bool = False
    """The axis shows zero."""


def _degrees(name: str) -> Value:
    def value(message: Message) -> float | None:
        angle = getattr(message, name)
        return None if angle is None else math.degrees(angle)

    return value


def _scaled(name: str, factor: float = 1.0) -> Value:
    def value(message: Message) -> float | None:
        number = getattr(message, name)
        return None if number is None else number * factor

    return value


FIGURES: Final = (
    Figure(
        "Speed",
        "m/s",
        0.2,
        (
            Curve("asked by tracker", t.PLAN_DRIVE, _scaled("speed")),
            Curve("asked from outside", t.REQ_DRIVE, _scaled("speed")),
            Curve("commanded", t.CMD_DRIVE, _scaled("speed")),
            Curve("measured", t.ODOMETRY, lambda m: m.twist.vx),
        ),
        zero=True,
    ),
    Figure(
        "Steering commanded",
        "°",
        5,
        (Curve("front axle", t.CMD_STEERING, _degrees("front")), Curve("rear axle", t.CMD_STEERING, _degrees("rear"))),
        zero=True,
    ),
    Figure(
        "Cross-track error", "cm", 2, (Curve("left positive", t.TRACKER, _scaled("cross_track", 100.0)),), zero=True
    ),
    Figure("Yaw", "°", 10, (Curve("in odom", t.ODOMETRY, lambda m: math.degrees(m.pose.yaw), turns=True),)),
    Figure(
        "Tilt of the body",
        "°",
        4,
        (
            Curve("roll", t.COMPASS, lambda m: math.degrees(m.roll) if m.tilt_valid else None),
            Curve("pitch", t.COMPASS, lambda m: math.degrees(m.pitch) if m.tilt_valid else None),
        ),
        zero=True,
    ),
    Figure(
        "Lidar mount",
        "°",
        4,
        (Curve("pitch", t.STABILISER, _degrees("pitch")), Curve("roll", t.STABILISER, _degrees("roll"))),
        zero=True,
    ),
    Figure(
        "Battery",
        "V",
        1,
        (
            Curve("sample", t.BATTERY, _scaled("raw_voltage")),
            Curve("filtered", t.BATTERY, _scaled("voltage")),
            Curve("at rest", t.BATTERY, _scaled("rest_voltage")),
        ),
    ),
    Figure(
        "Motor current", "A", 0.5, tuple(Curve(f"shaft {n}", x, _scaled("current")) for n, x in enumerate(t.DRIVES, 1))
    ),
    Figure(
        "Lateness of the control tick",
        "ms",
        2,
        (
            Curve("median", t.LOOP, _scaled("lateness_p50", 1e3)),
            Curve("99th percentile", t.LOOP, _scaled("lateness_p99", 1e3)),
            Curve("worst", t.LOOP, _scaled("lateness_max", 1e3)),
        ),
        zero=True,
    ),
    Figure("Processor", "%", 20, (Curve("busy", t.HOST, _scaled("cpu", 100.0)),), zero=True),
    Figure("Temperature", "°C", 10, (Curve("hottest zone", t.HOST, _scaled("temperature")),)),
    Figure("Memory of the daemon", "MB", 20, (Curve("resident", t.HOST, _scaled("daemon_memory", 1e-6)),)),
    Figure("Network signal", "dBm", 20, (Curve("smoothed", t.LINK, _scaled("signal")),)),
)
"""In the order of the page."""
