"""Line plots as inline SVG: pure functions from numbers to markup.

A plot is stretched to any width: lines keep their width (``non-scaling-stroke``), and every label is HTML beside it,
placed in per cent, so that nothing shrinks on a phone.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from typing import Final

from monstertruck_runtime.clock import SECOND
from monstertruckd.tools.logs.trace import Bucket, Trace

WIDTH, HEIGHT = 1000.0, 100.0
"""View box of every plot."""

_TIME_STEPS: Final = (0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 14400)
_TIME_TICKS: Final = 9
_VALUE_TICKS: Final = 4


@dataclass(frozen=True, slots=True)
class Axis:
    """Range of values and its labelled numbers."""

    low: float
    high: float
    ticks: tuple[float, ...]

    def share(self, value: float) -> float:
        """0 at ``low``, 1 at ``high``."""
        return (value - self.low) / (self.high - self.low)

    def label(self, tick: float) -> str:
        """Number with as many decimals as the ticks need."""
        step = self.ticks[1] - self.ticks[0] if len(self.ticks) > 1 else 1.0
        decimals = max(0, -math.floor(math.log10(step) + 1e-9))
        return f"{tick:.{decimals}f}".replace("-", "−")


def value_axis(values: Iterable[float], span: float, *, zero: bool) -> Axis:
    """Axis with round ends round all ``values``, at least ``span`` wide, with zero if wanted."""
    shown = [*values, *([0.0] if zero else [])]
    low, high = min(shown), max(shown)
    if high - low < span:
        middle = (low + high) / 2
        below = span / 2 if not zero or low < 0 < high else (span if high <= 0 and low < 0 else 0.0)
        low, high = (middle - below, middle - below + span) if not zero or low < 0 < high else (-below, span - below)
    step = round_step((high - low) / _VALUE_TICKS)
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return Axis(first * step, last * step, tuple(n * step for n in range(first, last + 1)))


def round_step(about: float) -> float:
    """The nearest of 1, 2, 5 times a power of ten that is not smaller."""
    power = 10.0 ** math.floor(math.log10(about))
    return next(factor * power for factor in (1, 2, 5, 10) if factor * power >= about * (1 - 1e-9))


def time_ticks(seconds: float) -> list[float]:
    """Round instants of a run of ``seconds``."""
    step = next((s for s in _TIME_STEPS if seconds / s <= _TIME_TICKS), 86400.0)
    return [n * step for n in range(math.floor(seconds / step) + 1)]


def clock_text(seconds: float, decimals: int = 0) -> str:
    """``m:ss`` or ``h:mm:ss`` with that many decimals."""
    whole, fraction = divmod(round(seconds * 10**decimals), 10**decimals)
    hours, rest = divmod(whole, 3600)
    minutes, rest = divmod(rest, 60)
    tail = f".{fraction:0{decimals}d}" if decimals else ""
    return f"{hours}:{minutes:02d}:{rest:02d}{tail}" if hours else f"{minutes}:{rest:02d}{tail}"


def line(trace: Trace, axis: Axis, start: int, end: int) -> str:
    """SVG path data of a trace from ``start`` to ``end``, ns; intervals are drawn from extreme to extreme."""
    duration = max(end - start, 1)
    parts = []
    for piece in trace.pieces():
        points = [
            (WIDTH * (time - start) / duration, HEIGHT * (1.0 - axis.share(value)))
            for bucket in piece
            for time, value in _corners(bucket)
        ]
        parts.append("M" + "L".join(f"{_short(x)} {_short(y)}" for x, y in _bent(points)))
    return "".join(parts)


def _corners(bucket: Bucket) -> Sequence[tuple[int, float]]:
    if bucket.low == bucket.high:
        return (
            [(bucket.first, bucket.low)]
            if bucket.first == bucket.last
            else [
                (bucket.first, bucket.low),
                (bucket.last, bucket.low),
            ]
        )
    rising = bucket.newest - bucket.low > bucket.high - bucket.newest
    first, last = (bucket.low, bucket.high) if rising else (bucket.high, bucket.low)
    return [(bucket.first, first), (bucket.last, last)]


def _bent(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Without the points in the middle of level stretches; a single point becomes a short dash."""
    if len(points) == 1:
        x, y = points[0]
        return [(x, y), (x + 1.0, y)]
    return [
        here
        for before, here, after in zip([(-1.0, -1.0), *points], points, [*points[1:], (-1.0, -1.0)], strict=False)
        if not before[1] == here[1] == after[1]
    ]


def _short(number: float) -> str:
    return f"{number:.1f}".removesuffix(".0")


def plot(
    number: int, title: str, unit: str, lines: Sequence[tuple[str, Trace]], axis: Axis, span: tuple[int, int]
) -> str:
    """A captioned plot with grid, labels and legend.

    Args:
        number: of the plot on the page, for the cursor.
        title: text.
        unit: of the axis.
        lines: label and trace of every line.
        axis: of the values.
        span: first and last instant, ns.
    """
    start, end = span
    seconds = (end - start) / SECOND
    keys = "".join(
        f'<span class="key s{n}"><i></i>{escape(label)}<output></output></span>' for n, (label, _) in enumerate(lines)
    )
    paths = "".join(f'<path class="s{n}" d="{line(trace, axis, start, end)}"/>' for n, (_, trace) in enumerate(lines))
    grid = "".join(
        f'<line class="{"zero" if tick == 0 else "grid"}" x2="{WIDTH:g}" y1="{y}" y2="{y}"/>'
        for tick in axis.ticks
        for y in [_short(HEIGHT * (1 - axis.share(tick)))]
    )
    values = "".join(
        f'<span style="bottom:{100 * axis.share(tick):.2f}%">{axis.label(tick)}</span>' for tick in axis.ticks
    )
    return (
        f'<figure class="plot" data-plot="{number}"><figcaption><b>{escape(title)}</b> <small>{escape(unit)}</small>'
        f'{keys}</figcaption><div class="field"><div class="values">{values}</div>'
        f'<svg viewBox="0 0 {WIDTH:g} {HEIGHT:g}" preserveAspectRatio="none" aria-hidden="true">{grid}{paths}</svg>'
        f'<i class="cursor"></i></div>{time_labels(seconds)}</figure>'
    )


def time_labels(seconds: float) -> str:
    """The row of instants under a plot."""
    ticks = time_ticks(seconds)
    decimals = 1 if len(ticks) > 1 and ticks[1] < 1 else 0
    labels = "".join(
        f'<span style="left:{100 * tick / max(seconds, 1e-9):.3f}%">{clock_text(tick, decimals)}</span>'
        for tick in ticks
    )
    return f'<div class="times">{labels}</div>'
