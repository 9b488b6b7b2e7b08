"""The parts of the report that show time and place: plots, timeline, map."""

import base64
from html import escape

from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.event import Event, Severity
from monstertruck_schemas.topics import BY_NAME
from monstertruckd.recorder.occupancy import Area
from monstertruckd.tools.logs.report.collect import Run
from monstertruckd.tools.logs.report.curves import FIGURES
from monstertruckd.tools.logs.report.spans import Tone, Track, drawn
from monstertruckd.tools.logs.report.svg import clock_text, plot, round_step, time_labels, value_axis
from monstertruckd.tools.logs.trace import Trace

SEVERITY_TONE = {Severity.INFO: Tone.CALM, Severity.WARNING: Tone.WARNING, Severity.ERROR: Tone.BAD}
_BARS = 1000
"""Greatest number of bars in a row of the timeline, about."""
_LABELLED = 0.055
"""Bars at least this share of the row carry their text."""
_MARGIN = 0.35
"""Metres shown round everything on the map."""

Lines = list[tuple[str, Trace]]


def plotted(run: Run) -> list[tuple[str, str, float, bool, Lines]]:
    """Title, unit, least span, zero and lines of every plot that has samples."""
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


def plots(run: Run, chosen: list[tuple[str, str, float, bool, Lines]]) -> str:
    """All plots, one under the other on one axis of time."""
    drawings = []
    for number, (title, unit, span, zero, lines) in enumerate(chosen):
        extremes = [value for _, trace in lines for value in (trace.low, trace.high) if value is not None]
        axis = value_axis(extremes, span, zero=zero)
        drawings.append(plot(number, title, unit, lines, axis, (run.start, run.end)))
    return "".join(drawings)


def timeline(run: Run) -> str:
    """Bars of the states, marks of warnings and errors."""
    states = run.states
    rows = [track for track in states.main if track.worst is not Tone.NONE]
    steady: list[Track] = []
    moving: list[Track] = []
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


def _always_ready(track: Track) -> bool:
    """Began, was ready, and ended with the daemon: nothing to tell."""
    return track.worst is not Tone.NONE and [s.text for s in track.spans if s.text not in {"starting", "stopped"}] in (
        ["ready"],
        [],
    )


def _share(run: Run, time: int) -> float:
    return min(max((time - run.start) / max(run.end - run.start, 1), 0.0), 1.0)


def _bars(run: Run, track: Track) -> str:
    bars = []
    for span in drawn(track.spans, (run.end - run.start) // _BARS):
        left, width = _share(run, span.start), _share(run, span.end) - _share(run, span.start)
        when = f"{clock_text((span.start - run.start) / SECOND, 1)}, {span.seconds:.1f} s"
        title = ": ".join(filter(None, (f"{span.text} at {when}", span.detail)))
        wide = width > _LABELLED
        bars.append(
            f'<i class="{span.tone.name.lower()}{"" if wide else " thin"}" style="left:{100 * left:.3f}%;'
            f'width:{100 * width:.3f}%" title="{escape(title)}">{escape(span.text) if wide else ""}</i>'
        )
    return f'<div class="bar">{"".join(bars)}</div>'


def _marks(run: Run, events: list[Event]) -> str:
    return f'<div class="bar">{"".join(_mark(run, event) for event in events)}</div>'


def _mark(run: Run, event: Event) -> str:
    title = escape(f"{event.source}: {event.text or event.reason.text}")
    tone, left = SEVERITY_TONE[event.severity].name.lower(), 100 * _share(run, event.stamp)
    return f'<i class="mark {tone}" style="left:{left:.3f}%" title="{title}"></i>'


def scene(run: Run) -> str:
    """The way over what the lidar saw; empty if the log has neither."""
    picture = run.map.picture()
    planned = [] if run.path_plan is None else [(x, y) for x, y, _ in run.path_plan.poses.reshape(-1, 3).tolist()]
    driven = [(x, y) for _, x, y in run.way.points]
    if picture is None and not planned and not driven:
        return ""
    area = _around([*planned, *driven], None if picture is None else picture.area)
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
        for name, text, way in (("planned", "planned", planned), ("driven", "driven (estimated)", driven))
        if way
    )
    return (
        f'<svg viewBox="{area.x0:.3f} {-area.y1:.3f} {width:.3f} {height:.3f}" role="img" aria-label="map">'
        f'{"".join(parts)}</svg><div class="legend">{legend}<span>grid {step:g} m</span></div>'
    )


def _around(points: list[tuple[float, float]], area: Area | None) -> Area:
    xs, ys = [x for x, _ in points], [y for _, y in points]
    if area is not None:
        xs, ys = [*xs, area.x0, area.x1], [*ys, area.y0, area.y1]
    return Area(min(xs) - _MARGIN, min(ys) - _MARGIN, max(xs) + _MARGIN, max(ys) + _MARGIN)


def _grid(area: Area, step: float) -> str:
    xs = [n * step for n in range(int(area.x0 // step) + 1, int(area.x1 // step) + 1)]
    ys = [n * step for n in range(int(area.y0 // step) + 1, int(area.y1 // step) + 1)]
    across = "".join(f"M{x:g} {-area.y1:.3f}V{-area.y0:.3f}" for x in xs)
    return f'<path class="metre" d="{across}{"".join(f"M{area.x0:.3f} {-y:g}H{area.x1:.3f}" for y in ys)}"/>'


def _polyline(points: list[tuple[float, float]]) -> str:
    return "M" + "L".join(f"{x:.3f} {-y:.3f}" for x, y in points)
