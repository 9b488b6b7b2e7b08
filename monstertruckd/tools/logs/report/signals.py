"""Signals of the report: plots, traces of any length in bounded memory, and the driven path."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from statistics import fmean
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_estimation.scan_tilt import NO_TILT
from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas import topics as t
from monstertruck_schemas.base import Message
from monstertruck_schemas.topics import Topic

_SHORTEST_GAP = SECOND
"""Shorter intervals without samples are never drawn as gaps (ns)."""


@dataclass(slots=True)
class Bucket:
    """All samples of one interval."""

    first: int
    last: int
    low: float
    high: float
    newest: float

    def take(self, other: "Bucket") -> None:
        """Add the samples of a later bucket."""
        self.last = other.last
        self.low = min(self.low, other.low)
        self.high = max(self.high, other.high)
        self.newest = other.newest


class Trace:
    """Samples in time order; more than ``limit`` of them are aggregated to at least ``limit / 2`` intervals.

    Extremes are kept, so that a single-sample spike is visible in an hour of data.

    Args:
        limit: maximum number of intervals kept.
    """

    def __init__(self, limit: int = 1000) -> None:
        self._limit = limit
        self._width = 0
        self.buckets: list[Bucket] = []
        self.count = 0

    def add(self, time: int, value: float) -> None:
        """Append a sample at ``time`` (ns)."""
        self.count += 1
        self._append(Bucket(time, time, value, value, value))
        if len(self.buckets) > self._limit:
            self._width = max(2 * self._width, 2 * (time - self.buckets[0].first) // self._limit)
            finer, self.buckets = self.buckets, []
            for bucket in finer:
                self._append(bucket)

    def _append(self, bucket: Bucket) -> None:
        if self.buckets and bucket.last - self.buckets[-1].first < self._width:
            self.buckets[-1].take(bucket)
        else:
            self.buckets.append(bucket)

    @property
    def low(self) -> float | None:
        """Minimum; None without samples."""
        return min((bucket.low for bucket in self.buckets), default=None)

    @property
    def high(self) -> float | None:
        """Maximum; None without samples."""
        return max((bucket.high for bucket in self.buckets), default=None)

    def pieces(self) -> list[list[Bucket]]:
        """Return the intervals, split where samples are missing for longer than five mean periods and one second."""
        if not self.buckets:
            return []
        period = (self.buckets[-1].last - self.buckets[0].first) / max(self.count - 1, 1)
        gap = max(_SHORTEST_GAP, 5 * period)  # minimum length of a gap, in mean periods
        pieces = [[self.buckets[0]]]
        for bucket in self.buckets[1:]:
            if bucket.first - pieces[-1][-1].last > gap:
                pieces.append([])
            pieces[-1].append(bucket)
        return pieces

    def middle(self) -> tuple[NDArray[np.int64], Array]:
        """Return times (ns) and mid values of the intervals, both of shape (n,)."""
        times = np.array([(bucket.first + bucket.last) // 2 for bucket in self.buckets], np.int64)
        return times, np.array([fmean((bucket.low, bucket.high)) for bucket in self.buckets], np.float64)


Value = Callable[[Any], float | None]
"""Converts a decoded message to the number that is plotted, in the figure's unit; None: no sample."""


@dataclass(frozen=True, slots=True)
class Curve:
    """One curve of a figure."""

    label: str
    topic: Topic[Any]
    value: Value
    turns: bool = False
    """Whether the value is an angle in degrees, drawn without jumps of 360."""


@dataclass(frozen=True, slots=True)
class Figure:
    """Curves with a common axis; figures without samples are omitted."""

    title: str
    unit: str
    span: float
    """Minimum span of the axis, so that noise stays small."""
    curves: tuple[Curve, ...]
    zero: bool = False
    """Whether the axis includes zero."""


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
            Curve("asked by tracker", t.PLAN_DRIVE, _scaled("pace")),
            Curve("asked from outside", t.REQ_DRIVE, _scaled("pace")),
            Curve("commanded", t.CMD_DRIVE, _scaled("speed")),
            Curve("measured", t.ODOMETRY, lambda m: m.twist.vx),
        ),
        zero=True,
    ),
    Figure(
        "Sideways speed",
        "m/s",
        0.2,
        (
            Curve("asked from outside", t.REQ_DRIVE, lambda m: None if m.twist is None else m.twist.vy),
            Curve("commanded", t.GATE, lambda m: None if m.twist is None else m.twist.vy),
            Curve("measured", t.ODOMETRY, lambda m: m.twist.vy),
        ),
        zero=True,
    ),
    Figure(
        "Yaw rate",
        "°/s",
        10,
        (
            Curve(
                "asked from outside",
                t.REQ_DRIVE,
                lambda m: None if m.twist is None else math.degrees(m.twist.wz),
            ),
            Curve("commanded", t.GATE, lambda m: None if m.twist is None else math.degrees(m.twist.wz)),
            Curve("measured", t.ODOMETRY, lambda m: math.degrees(m.twist.wz)),
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
        "Tilt of the lidar's plane",
        "°",
        4,
        (
            Curve(
                "off the level", t.SCAN, lambda m: None if m.tilt is None or m.tilt >= NO_TILT else math.degrees(m.tilt)
            ),
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
"""Signals in the order of the page."""


_LEAST_STEP: Final = 0.02
"""Minimum distance between two positions (m); smaller ones are noise at standstill."""


@dataclass(slots=True)
class DrivenPath:
    """Driven positions, sampled to a bounded number, and the distance along all of them."""

    points: list[tuple[int, float, float]] = field(default_factory=list)
    """Time (ns), x and y (m)."""
    distance: float = 0.0
    _last: tuple[float, float] | None = None
    _spacing: float = _LEAST_STEP

    def take(self, time: int, x: float, y: float) -> None:
        """Add the truck's position."""
        if self._last is None:
            self._last = x, y
            self.points.append((time, x, y))
            return
        step = math.dist(self._last, (x, y))
        if step < _LEAST_STEP:
            return
        self.distance += step
        self._last = x, y
        if math.dist(self.points[-1][1:], (x, y)) >= self._spacing:
            self.points.append((time, x, y))
            if len(self.points) > 1500:
                self.points = self.points[::2]
                self._spacing *= 2
