"""Line plots as inline SVG: pure functions from numbers to markup.

A plot scales to any width. Lines keep their width (``non-scaling-stroke``), and labels are HTML elements positioned in
per cent, so that they do not shrink on a phone.
"""

import base64
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from itertools import chain

from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.event import Event, Severity
from monstertruck_schemas.topics import BY_NAME
from monstertruckd.recorder.occupancy import Area
from monstertruckd.tools.logs.report.collect import RunSummary
from monstertruckd.tools.logs.report.signals import FIGURES, Bucket, Trace
from monstertruckd.tools.logs.report.states import StateTrack, Tone, merged_spans

WIDTH, HEIGHT = 1000.0, 100.0
"""View box of every plot."""


@dataclass(frozen=True, slots=True)
class Axis:
    """Range of values and its ticks."""

    low: float
    high: float
    ticks: tuple[float, ...]

    def share(self, value: float) -> float:
        """Return the relative position of a value: 0 at ``low``, 1 at ``high``."""
        return (value - self.low) / (self.high - self.low)

    def label(self, tick: float) -> str:
        """Format a number with as many decimals as the ticks need."""
        step = self.ticks[1] - self.ticks[0] if len(self.ticks) > 1 else 1.0
        decimals = max(0, -math.floor(math.log10(step) + 1e-9))
        return f"{tick:.{decimals}f}".replace("-", "−")


def value_axis(values: Iterable[float], span: float, *, zero: bool) -> Axis:
    """Return an axis with rounded limits around ``values``, at least ``span`` wide, optionally including zero."""
    shown = [*values, *([0.0] if zero else [])]
    low, high = min(shown), max(shown)
    if high - low < span:
        middle = (low + high) / 2
        below = span / 2 if not zero or low < 0 < high else (span if high <= 0 and low < 0 else 0.0)
        low, high = (middle - below, middle - below + span) if not zero or low < 0 < high else (-below, span - below)
    step = round_step((high - low) / 4)  # ticks of a value's axis
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return Axis(first * step, last * step, tuple(n * step for n in range(first, last + 1)))


def round_step(about: float) -> float:
    """Round up to 1, 2 or 5 times a power of ten."""
    power = 10.0 ** math.floor(math.log10(about))
    return next(factor * power for factor in (1, 2, 5, 10) if factor * power >= about * (1 - 1e-9))


def time_ticks(seconds: float) -> list[float]:
    """Return round tick times for a run of ``seconds``."""
    time_steps = (0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 14400)
    step = next((s for s in time_steps if seconds / s <= 9), 86400.0)  # maximum number of ticks on the time axis
    return [n * step for n in range(math.floor(seconds / step) + 1)]


def clock_text(seconds: float, decimals: int = 0) -> str:
    """Format a time as ``m:ss`` or ``h:mm:ss`` with that many decimals."""
    whole, fraction = divmod(round(seconds * 10**decimals), 10**decimals)
    hours, rest = divmod(whole, 3600)
    minutes, rest = divmod(rest, 60)
    tail = f".{fraction:0{decimals}d}" if decimals else ""
    return f"{hours}:{minutes:02d}:{rest:02d}{tail}" if hours else f"{minutes}:{rest:02d}{tail}"


def line(trace: Trace, axis: Axis, start: int, end: int) -> str:
    """Return the SVG path of a trace from ``start`` to ``end`` (ns); intervals are drawn from minimum to maximum."""
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
    """Remove the inner points of level stretches; a single point becomes a short dash."""
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
    """Return a plot with caption, grid, labels and legend.

    Args:
        number: number of the plot on the page, for the cursor.
        title: text.
        unit: unit of the axis.
        lines: label and trace of every line.
        axis: axis of the values.
        span: first and last instant (ns).
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
    """Return the row of time labels under a plot."""
    ticks = time_ticks(seconds)
    decimals = 1 if len(ticks) > 1 and ticks[1] < 1 else 0
    labels = "".join(
        f'<span style="left:{100 * tick / max(seconds, 1e-9):.3f}%">{clock_text(tick, decimals)}</span>'
        for tick in ticks
    )
    return f'<div class="times">{labels}</div>'


SEVERITY_TONE = {Severity.INFO: Tone.CALM, Severity.WARNING: Tone.WARNING, Severity.ERROR: Tone.BAD}

Lines = list[tuple[str, Trace]]


def plotted(run: RunSummary) -> list[tuple[str, str, float, bool, Lines]]:
    """Return title, unit, minimum span, zero and lines of every plot that has samples."""
    plots = []
    for figure in FIGURES:
        lines = [(curve.label, run.traces[curve]) for curve in figure.curves if run.traces[curve].count]
        if lines:
            plots.append((figure.title, figure.unit, figure.span, figure.zero, lines))
    rates = [
        (f"{name.removeprefix('sensor/')} ({topic.rate:g} Hz)", run.traffic[name].rate)
        for name, topic in BY_NAME.items()
        if topic.group == "sensor" and topic.rate and name in run.traffic and run.traffic[name].rate.count
    ]
    if rates:
        plots.append(("Rates of the devices", "% of nominal", 100.0, True, rates))
    return plots


def plots(run: RunSummary, chosen: list[tuple[str, str, float, bool, Lines]]) -> str:
    """Return all plots, stacked on a common time axis."""
    drawings = []
    for number, (title, unit, span, zero, lines) in enumerate(chosen):
        extremes = [value for _, trace in lines for value in (trace.low, trace.high) if value is not None]
        axis = value_axis(extremes, span, zero=zero)
        drawings.append(plot(number, title, unit, lines, axis, (run.start, run.end)))
    return "".join(drawings)


def timeline(run: RunSummary) -> str:
    """Return bars for the states and marks for warnings and errors."""
    states = run.states
    rows = [track for track in states.main if track.worst is not Tone.NONE]
    steady: list[StateTrack] = []
    moving: list[StateTrack] = []
    for track in states.services.values():
        (steady if _always_ready(track) else moving).append(track)
    rows += moving + [track for track in states.usb.values() if track.worst > Tone.GOOD]
    marks = [event for event in run.events if event.severity is not Severity.INFO]
    names = ["events"] * bool(marks) + [track.name for track in rows]
    lanes = [_marks(run, marks)] * bool(marks) + [_bars(run, track) for track in rows]
    note = f"Ready throughout: {', '.join(track.name for track in steady)}." if steady else ""
    return (
        f'<div class="timeline"><div class="names">{"".join(f"<span>{escape(n)}</span>" for n in names)}</div>'
        f'<div class="lanes">{"".join(lanes)}<i class="cursor"></i>{time_labels(run.duration)}</div></div>'
        f'<p class="note">{escape(note)}</p>'
    )


def _always_ready(track: StateTrack) -> bool:
    """Return whether a service started, was ready, and ended with the daemon; its row is not shown."""
    return track.worst is not Tone.NONE and [s.text for s in track.spans if s.text not in {"starting", "stopped"}] in (
        ["ready"],
        [],
    )


def _share(run: RunSummary, time: int) -> float:
    return min(max((time - run.start) / max(run.end - run.start, 1), 0.0), 1.0)


def _bars(run: RunSummary, track: StateTrack) -> str:
    bars = []
    # 1000: approximate maximum number of bars in a row of the timeline
    for span in merged_spans(track.spans, (run.end - run.start) // 1000):
        left, width = _share(run, span.start), _share(run, span.end) - _share(run, span.start)
        when = f"{clock_text((span.start - run.start) / SECOND, 1)}, {span.seconds:.1f} s"
        title = ": ".join(filter(None, (f"{span.text} at {when}", span.detail)))
        wide = width > 0.055  # minimum width of a bar with text, as a fraction of the row
        bars.append(
            f'<i class="{span.tone.name.lower()}{"" if wide else " thin"}" style="left:{100 * left:.3f}%;'
            f'width:{100 * width:.3f}%" title="{escape(title)}">{escape(span.text) if wide else ""}</i>'
        )
    return f'<div class="bar">{"".join(bars)}</div>'


def _marks(run: RunSummary, events: list[Event]) -> str:
    return f'<div class="bar">{"".join(_mark(run, event) for event in events)}</div>'


def _mark(run: RunSummary, event: Event) -> str:
    title = escape(f"{event.source}: {event.text or event.reason.text}")
    tone, left = SEVERITY_TONE[event.severity].name.lower(), 100 * _share(run, event.stamp)
    return f'<i class="mark {tone}" style="left:{left:.3f}%" title="{title}"></i>'


def scene(run: RunSummary) -> str:
    """Return the path over the lidar map; empty if the log has neither."""
    picture = run.map.picture()
    planned = [] if run.path_plan is None else [(x, y) for x, y, _ in run.path_plan.poses.reshape(-1, 3).tolist()]
    driven = [(x, y) for _, x, y in run.way.points]
    if picture is None and not planned and not driven:
        return ""
    zones = [] if run.zones is None else [zone for zone in run.zones.zones if zone.corners]
    outlines = [[(x, y) for x, y in zone.corners] for zone in zones]
    area = _around([*planned, *driven, *chain(*outlines)], None if picture is None else picture.area)
    width, height = area.x1 - area.x0, area.y1 - area.y0
    parts = []
    if picture is not None:
        code, box = base64.b64encode(picture.png).decode(), picture.area
        parts.append(
            f'<image x="{box.x0:.3f}" y="{-box.y1:.3f}" width="{box.x1 - box.x0:.3f}" height="{box.y1 - box.y0:.3f}" '
            f'preserveAspectRatio="none" href="data:image/png;base64,{code}"/>'
        )
    step = round_step(max(width, height) / 12)
    parts += [_grid(area, step)]
    parts += [
        f'<path class="{zone.kind}" d="{_polyline(outline)}Z"><title>{escape(zone.name)}</title></path>'
        for zone, outline in zip(zones, outlines, strict=True)
    ]
    parts += [
        f'<path class="{name}" d="{_polyline(way)}"/>'
        for name, way in (("planned", planned), ("driven", driven))
        if way
    ]
    radius = max(width, height) / 110
    if driven:
        (bx, by), (ex, ey) = driven[0], driven[-1]
        parts.append(f'<circle class="end" cx="{ex:.3f}" cy="{-ey:.3f}" r="{0.8 * radius:.3f}"/>')
        parts.append(f'<circle class="begin" cx="{bx:.3f}" cy="{-by:.3f}" r="{radius:.3f}"/>')
        parts.append(f'<circle class="here" r="{1.2 * radius:.3f}" style="display:none"/>')
    legend = "".join(
        f'<span><svg viewBox="0 0 30 8" class="map"><path class="{name}" d="M0 4H30"/></svg>{text}</span>'
        for name, text, shown in (
            ("planned", "planned", planned),
            ("driven", "driven (estimated)", driven),
            *((kind, f"{kind} zone", True) for kind in dict.fromkeys(zone.kind for zone in zones)),
        )
        if shown
    )
    return (
        f'<svg viewBox="{area.x0:.3f} {-area.y1:.3f} {width:.3f} {height:.3f}" role="img" aria-label="map">'
        f'{"".join(parts)}</svg><div class="legend">{legend}<span>grid {step:g} m</span></div>'
    )


def _around(points: list[tuple[float, float]], area: Area | None) -> Area:
    xs, ys = [x for x, _ in points], [y for _, y in points]
    if area is not None:
        xs, ys = [*xs, area.x0, area.x1], [*ys, area.y0, area.y1]
    margin = 0.35  # margin around the content of the map, m
    return Area(min(xs) - margin, min(ys) - margin, max(xs) + margin, max(ys) + margin)


def _grid(area: Area, step: float) -> str:
    xs = [n * step for n in range(int(area.x0 // step) + 1, int(area.x1 // step) + 1)]
    ys = [n * step for n in range(int(area.y0 // step) + 1, int(area.y1 // step) + 1)]
    across = "".join(f"M{x:g} {-area.y1:.3f}V{-area.y0:.3f}" for x in xs)
    return f'<path class="metre" d="{across}{"".join(f"M{area.x0:.3f} {-y:g}H{area.x1:.3f}" for y in ys)}"/>'


def _polyline(points: list[tuple[float, float]]) -> str:
    return "M" + "L".join(f"{x:.3f} {-y:.3f}" for x, y in points)
