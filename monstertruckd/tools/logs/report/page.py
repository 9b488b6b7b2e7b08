"""The report as one self-contained HTML page, which makes no network requests."""

import json
from collections.abc import Iterable
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any

from monstertruck_runtime.clock import SECOND, is_date
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.small_files import replace_file
from monstertruck_schemas.event import Cause, Event, LogLevel, Severity, Stop
from monstertruck_schemas.health import ServiceState
from monstertruckd.recorder.reader import spare_log
from monstertruckd.tools.logs.messages import Progress, utc
from monstertruckd.tools.logs.report.collect import RunSummary, collect
from monstertruckd.tools.logs.report.drawing import SEVERITY_TONE, Lines, clock_text, plots, plotted, scene, timeline
from monstertruckd.tools.logs.report.states import Tone

_POLICY = "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; img-src data:"
"""Content security policy: the page may load nothing."""


@dataclass(frozen=True, slots=True)
class RunReport:
    """A written report."""

    file: Path
    run: RunSummary

    def figures(self) -> dict[str, Any]:
        """Figures at the top of the page, as plain data."""
        run = self.run
        return {
            "file": str(self.file),
            "robot": robot(run),
            "started": began(run),
            "duration_s": run.duration,
            "distance_m": run.distance,
            "top_speed_m_s": run.top_speed,
            "cross_track_rms_m": run.cross_track_rms,
            "driving_s": run.states.gate.seconds("driving"),
            "messages": run.messages,
            "lost": run.lost,
            "events": {severity.value: count for severity, count in run.event_counts.items()},
            "damage": run.damage,
        }


def report(log: str | Path, output: str | Path | None = None, progress: Progress | None = None) -> RunReport:
    """Write the report of a log.

    Args:
        log: MCAP file, finished or not.
        output: HTML file; default: next to the log.
        progress: called with the bytes read so far.

    Raises:
        NotFoundError: no such log.
        InputError: not a log, no messages, or the page cannot be written or would overwrite a log.
    """
    file = Path(log).with_suffix(".html") if output is None else Path(output)
    run = collect(log, progress)
    try:
        spare_log(file)
        file.parent.mkdir(parents=True, exist_ok=True)
        replace_file(file, page(run))
    except OSError as error:
        raise InputError(f"{file}: cannot be written: {error.strerror}") from None
    return RunReport(file, run)


def robot(run: RunSummary) -> str:
    """Return the robot's name from its configuration."""
    return str(run.attachments.get("config", {}).get("robot") or run.metadata.get("robot", "unknown robot"))


def began(run: RunSummary) -> str | None:
    """Return the date of the first message (UTC); None if the log has no date."""
    real = run.start + (run.offset or 0)
    return utc(real) if is_date(real) else None


def page(run: RunSummary) -> str:
    """Return the whole page."""
    here = files(__package__)
    chosen = plotted(run)
    title = f"{robot(run)}, {began(run) or run.path.name}"
    body = "".join(
        (
            _head(run),
            _tiles(run),
            '<div class="pair">',
            f'<div><h2>Way</h2><div class="card map">{scene(run) or "No poses and no scans in this log."}</div></div>',
            f'<div><h2>Events</h2><div class="card events">{_events(run)}</div></div></div>',
            _stops(run),
            _journal(run),
            f'<h2>States</h2><div class="card">{timeline(run)}</div>',
            f'<h2>Signals</h2><div class="card plots">{plots(run, chosen)}</div>' if chosen else "",
            _services(run),
            _traffic(run),
            _details(run),
        )
    )
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<style>{(here / 'page.css').read_text()}</style></head><body><main>{body}"
        f"<footer>{escape(run.path.name)}, recorded by {escape(run.library or 'an unknown recorder')}. Times count "
        "from the first message; point at a plot to read its values.</footer></main>"
        f'<script type="application/json" id="data">{_data(run, chosen)}</script>'
        f"<script>{(here / 'page.js').read_text()}</script></body></html>\n"
    )


def _head(run: RunSummary) -> str:
    date = began(run)
    when = f"{date} UTC" if date else "date unknown (virtual clock, or a clock that was never set)"
    badges = [
        _badge(run.event_counts[Severity.ERROR], "error", Tone.BAD),
        _badge(run.event_counts[Severity.WARNING], "warning", Tone.WARNING),
        ("log is intact", Tone.GOOD) if run.damage is None else (f"log {run.damage}", Tone.BAD),
        ("no message lost", Tone.GOOD) if not run.lost else (f"{run.lost} messages lost", Tone.BAD),
    ]
    if run.drops:
        badges.append((f"{run.drops} messages dropped in the daemon", Tone.WARNING))
    badges += _calibration_badges(run)
    shown = "".join(f'<span class="badge {tone.name.lower()}">{escape(text)}</span>' for text, tone in badges)
    return (
        f'<div class="over">{"Black box" if run.is_black_box else "Run report"}</div><h1>{escape(robot(run))}</h1>'
        f'<div class="under">{escape(when)} · {escape(run.path.name)}</div><div class="badges">{shown}</div>'
    )


def _calibration_badges(run: RunSummary) -> Iterable[tuple[str, Tone]]:
    """Yield the grades of the calibration at the start of the daemon, and its expired parts; none in older logs."""
    rows = run.attachments.get("calibration", {}).get("wizards", ())
    if counting := [f"{row['wizard']} {row['grade']}" for row in rows if not row["expired"]]:
        yield f"calibration: {', '.join(counting)}", Tone.GOOD
    for row in rows:
        if row["expired"]:
            yield f"calibration of {row['wizard']} expired: {row['expired']}", Tone.WARNING


def _badge(count: int, name: str, tone: Tone) -> tuple[str, Tone]:
    return (f"{count} {name}{'' if count == 1 else 's'}", tone) if count else (f"no {name}", Tone.GOOD)


def _tiles(run: RunSummary) -> str:
    rms = run.cross_track_rms
    lateness = next((trace for curve, trace in run.traces.items() if curve.label == "worst" and trace.count), None)
    rows = [
        (clock_text(run.duration), "", "duration"),
        (f"{run.distance:.2f}", "m", "distance by odometry"),
        (f"{run.top_speed:.2f}", "m/s", "top speed"),
        (clock_text(run.states.gate.seconds("driving")), "", "driving"),
        *([] if rms is None else [(f"{100 * rms:.2f}", "cm", "cross-track RMS")]),
        *([] if lateness is None else [(f"{lateness.high or 0.0:.1f}", "ms", "worst tick lateness")]),
        (f"{run.messages:,}".replace(",", "\u2009"), "", "messages"),
        (f"{run.size / 1e6:.1f}", "MB", "log"),
    ]
    tiles = "".join(
        f'<div class="tile"><b>{a} <small>{unit}</small></b><span>{name}</span></div>' for a, unit, name in rows
    )
    return f'<div class="tiles">{tiles}</div>'


def _events(run: RunSummary) -> str:
    rows = "".join(_event(run, event) for event in run.events)
    left_out = sum(run.event_counts.values()) - len(run.events)
    note = f'<p class="note">&emsp;{left_out} more events are in the log.</p>' if left_out else ""
    return f"<ol>{rows}</ol>{note}" if rows else '<p class="note">&emsp;None.</p>'


def _event(run: RunSummary, event: Event) -> str:
    seconds = max(event.stamp - run.start, 0) / SECOND
    values = (f"{key}={_short(value)}" for key, value in event.values.items())
    return (
        f'<li data-at="{1e3 * seconds:.0f}"><time>{clock_text(seconds, 2)}</time><div>'
        f'<span class="dot {SEVERITY_TONE[event.severity].name.lower()}"></span><b>{escape(event.source)}</b> '
        f"{escape(event.text or event.reason.text)} <code>{escape(' '.join((event.reason.value, *values)))}</code>"
        "</div></li>"
    )


def _short(value: float | str | bool | None) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _stops(run: RunSummary) -> str:
    """Return every stop with its chain of causes."""
    rows = "".join(_stop(run, stop) for stop in run.stops.values())
    return f'<h2>Stops</h2><div class="card stops">{rows}</div>' if rows else ""


def _stop(run: RunSummary, stop: Stop) -> str:
    tone = Tone.CALM if stop.ordered else Tone.BAD
    seconds = max(stop.stamp - run.start, 0) / SECOND
    speed = "" if stop.speed is None else f" at {stop.speed:.2f} m/s"
    facts = [f"{'quick stop' if stop.quick else 'ramp'}{speed}", f"{stop.stopping_distance:.2f} m to go"]
    if stop.black_box is not None:
        facts.append(stop.black_box)
    causes = "".join(f"<li>{_cause(run, cause)}</li>" for cause in stop.causes)
    return (
        f'<div data-at="{1e3 * seconds:.0f}"><time>{clock_text(seconds, 2)}</time>'
        f'<span class="dot {tone.name.lower()}"></span><b>{escape(stop.text)}</b> '
        f"<small>{escape(', '.join(facts))}</small><ol>{causes}</ol></div>"
    )


def _cause(run: RunSummary, cause: Cause) -> str:
    since = clock_text(max(cause.since - run.start, 0) / SECOND, 2)
    measured = ", ".join(
        f"{m.name} {'unknown' if m.value is None else f'{m.value:.4g}'}"
        + (f" (limit {m.limit:.4g})" if m.limit is not None else "")
        + (f" {m.unit}" if m.unit else "")
        for m in cause.measurements
    )
    behind = "" if cause.because is None else f" because of {cause.because + 1}"
    return (
        f"{escape(cause.source)}: {escape(cause.text)} <code>{escape(cause.reason.value)} since {since}"
        f"{behind}</code>" + (f" <small>{escape(measured)}</small>" if measured else "")
    )


def _journal(run: RunSummary) -> str:
    """Return the warnings and errors of the journal."""
    rows = "".join(
        f'<li data-at="{1e3 * (seconds := max(record.stamp - run.start, 0) / SECOND):.0f}">'
        f"<time>{clock_text(seconds, 2)}</time><div>"
        f'<span class="dot {(Tone.WARNING if record.level is LogLevel.WARNING else Tone.BAD).name.lower()}"></span>'
        f"<b>{escape(record.name)}</b> {escape(record.text)}</div></li>"
        for record in run.journal
    )
    left_out = run.journal_count - len(run.journal)
    note = f'<p class="note">&emsp;{left_out} more warnings are in the log.</p>' if left_out else ""
    return f'<h2>Journal</h2><div class="card events"><ol>{rows}</ol>{note}</div>' if rows else ""


def _services(run: RunSummary) -> str:
    rows = []
    for name, track in run.states.services.items():
        row, ready = run.states.health[name], track.seconds("ready")
        tone = Tone.BAD if row.state is ServiceState.FAILED else Tone.WARNING if row.restarts else Tone.GOOD
        rows.append(
            [
                f'<span class="dot {tone.name.lower()}"></span>{escape(name)}',
                row.state.value,
                str(row.restarts),
                f"{ready:.1f} s",
                escape(row.detail),
            ]
        )
    table = _table(("service", "state", "restarts", "ready for", "last error"), rows, right={2, 3}, wide=4)
    return f'<h2>Health</h2><div class="card scroll">{table}</div>' if rows else ""


def _traffic(run: RunSummary) -> str:
    rows = []
    for name, row in sorted(run.traffic.items()):
        nominal, rate = row.nominal, row.mean_rate
        rows.append(
            [
                escape(name),
                str(row.messages),
                "" if rate is None or nominal is None else f"{rate:.1f}",
                "" if nominal is None else f"{nominal:g}",
                str(row.lost),
                "" if nominal is None else str(row.silences),
                "" if nominal is None else f"{row.longest_silence:.2f}",
                f"{row.bytes / 1e3:.0f}",
            ]
        )
    missing = "left out" if run.is_black_box else "lost"
    heads = ("topic", "messages", "Hz", "nominal", missing, "silences", "longest, s", "kB")
    note = (
        f"{missing.capitalize()}: published, but not in this log. "
        "Silence: longer than the topic's staleness limit without a message. "
        + (f"{sum(row.undecodable for row in run.traffic.values())} messages could not be decoded. ")
        * any(row.undecodable for row in run.traffic.values())
    )
    table = _table(heads, rows, right=set(range(1, 8)), alarm=set() if run.is_black_box else {4})
    return f'<h2>Messages</h2><div class="card scroll">{table}<p class="note">{note}</p></div>'


def _table(
    heads: Iterable[str],
    rows: list[list[str]],
    *,
    right: set[int],
    wide: int | None = None,
    alarm: set[int] = frozenset(),  # type: ignore[assignment]
) -> str:
    """Return an HTML table; values other than 0 in columns ``alarm`` are highlighted."""
    top = "".join(f"<th{' class=n' if n in right else ''}>{escape(head)}</th>" for n, head in enumerate(heads))

    def cell(n: int, text: str) -> str:
        names = ["n"] * (n in right) + ["wide"] * (n == wide) + ["alarm"] * (n in alarm and text != "0")
        return f'<td class="{" ".join(names)}">{text}</td>'

    body = "".join(f"<tr>{''.join(cell(n, text) for n, text in enumerate(row))}</tr>" for row in rows)
    return f"<table><tr>{top}</tr>{body}</table>"


def _details(run: RunSummary) -> str:
    """Return the attachments of the log, collapsed."""
    versions = run.attachments.get("versions", {})
    text = ", ".join(f"{name} {version}" for name, version in sorted(versions.items()))
    blocks = "".join(
        f"<details><summary>{escape(name)}</summary><pre>{escape(json.dumps(value, indent=1))}</pre></details>"
        for name, value in run.attachments.items()
        if name in {"config", "calibration"}
    )
    return (
        f'<h2>Configuration</h2><div class="card"><p class="note">{escape(text)}</p>{blocks}</div>'
        if text or blocks
        else ""
    )


def _data(run: RunSummary, chosen: list[tuple[str, str, float, bool, Lines]]) -> str:
    """Return the values for the cursor; times in ms since the start."""

    def milliseconds(times: Iterable[int]) -> list[int]:
        return [int(time - run.start) // 1_000_000 for time in times]

    lines = [
        [[milliseconds(times.tolist()), [float(f"{v:.4g}") for v in values.tolist()]] for times, values in middles]
        for middles in ([trace.middle() for _, trace in lines] for *_, lines in chosen)
    ]
    times, xs, ys = zip(*run.way.points, strict=True) if run.way.points else ((), (), ())
    way = [milliseconds(times), [round(x, 3) for x in xs], [round(y, 3) for y in ys]]
    data = {"milliseconds": max((run.end - run.start) // 1_000_000, 1), "plots": lines, "way": way}
    return json.dumps(data, separators=(",", ":"))
