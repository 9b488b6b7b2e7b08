"""One pass over a log: everything the report shows, in bounded memory."""

import json
import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from mcap.records import Attachment, Header, Metadata

from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError, TruckError
from monstertruck_schemas import topics as t
from monstertruck_schemas.base import Message
from monstertruck_schemas.event import Event, LogLevel, LogRecord, Severity, Stop
from monstertruck_schemas.plan import Path as TruckPath
from monstertruck_schemas.plan import TrackerState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.state import ClockOffset, Odometry
from monstertruck_schemas.topics import BY_NAME, Topic
from monstertruckd.recorder.reader import LogMessage, LogReader
from monstertruckd.tools.logs.report.curves import FIGURES, Curve
from monstertruckd.tools.logs.report.scan_map import ScanMap
from monstertruckd.tools.logs.report.states import States
from monstertruckd.tools.logs.report.traffic import Traffic
from monstertruckd.tools.logs.report.way import Way
from monstertruckd.tools.logs.selection import Progress
from monstertruckd.tools.logs.trace import Trace
from monstertruckd.tools.logs.wall_time import first_offset

_PERIODS: Final = {t.ODOMETRY.name: SECOND // 20, t.POSE.name: SECOND // 20, t.TRANSFORMS.name: SECOND}
"""Topics that are decoded no more often than this, ns: they come thick and cost most of the time."""
_EVENTS: Final = 400
"""Events kept of each severity."""
_JOURNAL: Final = 400
"""Warnings and worse kept of the journal."""


@dataclass(slots=True)
class Run:
    """A log, digested."""

    path: Path
    size: int
    start: int = 0
    """First and last log time, ns."""
    end: int = 0
    messages: int = 0
    damage: str | None = None
    library: str = ""
    attachments: dict[str, Any] = field(default_factory=dict)
    metadata: dict[str, str] = field(default_factory=dict)
    """What the log says of its run."""
    offset: int | None = None
    """Real minus daemon time, ns, as the log last knew it."""
    traces: dict[Curve, Trace] = field(default_factory=dict)
    traffic: dict[str, Traffic] = field(default_factory=dict)
    states: States = field(default_factory=States)
    events: list[Event] = field(default_factory=list)
    event_counts: dict[Severity, int] = field(default_factory=lambda: dict.fromkeys(Severity, 0))
    journal: list[LogRecord] = field(default_factory=list)
    """The first warnings and worse."""
    journal_count: int = 0
    """All of them."""
    stops: dict[int, Stop] = field(default_factory=dict)
    """By number, each as it was told last."""
    drops: int = 0
    """Messages lost in the daemon's bounded queues, as it last counted them."""
    way: Way = field(default_factory=Way)
    """In the map frame if the log has poses there, else in odom."""
    odometry: Way = field(default_factory=Way)
    path_plan: TruckPath | None = None
    tracker: TrackerState | None = None
    top_speed: float = 0.0
    cross_track_square: float = 0.0
    cross_track_count: int = 0
    map: ScanMap = field(default_factory=ScanMap)

    @property
    def duration(self) -> float:
        """Seconds from first to last message."""
        return (self.end - self.start) / SECOND

    @property
    def distance(self) -> float:
        """Metres driven by odometry; by the poses in the map where there is none."""
        return self.odometry.distance or self.way.distance

    @property
    def cross_track_rms(self) -> float | None:
        """Metres, while a path was being tracked."""
        return math.sqrt(self.cross_track_square / self.cross_track_count) if self.cross_track_count else None

    @property
    def is_black_box(self) -> bool:
        """Pictures are thinned out on purpose, and the file counts its losses itself."""
        return "stopped_at_ns" in self.metadata

    @property
    def lost(self) -> int:
        """Messages that were published but are not in the log."""
        if self.is_black_box:
            return int(self.metadata.get("lost", 0))
        return sum(row.lost for row in self.traffic.values())


class Collector:
    """Takes messages in the order of the log."""

    def __init__(self, run: Run) -> None:
        self._run = run
        self._due: dict[str, int] = {}
        self._takers: dict[str, list[Callable[[int, Any], None]]] = {}
        for figure in FIGURES:
            for curve in figure.curves:
                trace = run.traces[curve] = Trace()
                self._on(curve.topic.name, _plotter(curve, trace))
        takers: tuple[tuple[Topic[Any], Callable[[int, Any], None]], ...] = (
            (t.EVENT, self._event),
            (t.LOG, self._record),
            (t.STOP, self._stop),
            (t.CLOCK, self._clock),
            (t.ODOMETRY, self._odometry),
            (t.POSE, self._pose),
            (t.PATH, self._path),
            (t.TRACKER, self._tracker),
            (t.TRANSFORMS, lambda _, m: run.map.transforms(m)),
            (t.MAP, lambda _, m: run.map.grid(m)),
            (t.SCAN, lambda _, m: run.map.scan(m)),
            (t.LOOP, self._loop),
            *run.states.takers(),
        )
        for topic, taker in takers:
            self._on(topic.name, taker)

    def _on(self, topic: str, taker: Callable[[int, Any], None]) -> None:
        self._takers.setdefault(topic, []).append(taker)

    def take(self, entry: LogMessage) -> None:
        """Digest one message; what cannot be decoded is counted."""
        run, now = self._run, entry.log_time
        run.start = now if run.messages == 0 else min(run.start, now)
        run.end = max(run.end, now)
        run.messages += 1
        traffic = run.traffic.setdefault(entry.topic, Traffic(entry.topic))
        traffic.take(entry)
        takers = self._takers.get(entry.topic)
        if takers is None or now < self._due.get(entry.topic, now):
            return
        if (period := _PERIODS.get(entry.topic)) is not None:
            self._due[entry.topic] = now + period
        message = _decoded(entry)
        if message is None:
            traffic.undecodable += 1
            return
        for taker in takers:
            taker(now, message)

    def _event(self, _: int, event: Event) -> None:
        counts = self._run.event_counts
        counts[event.severity] += 1
        if counts[event.severity] <= _EVENTS:
            self._run.events.append(event)

    def _record(self, _: int, record: LogRecord) -> None:
        if record.level in {LogLevel.DEBUG, LogLevel.INFO}:
            return
        self._run.journal_count += 1
        if len(self._run.journal) < _JOURNAL:
            self._run.journal.append(record)

    def _stop(self, _: int, stop: Stop) -> None:
        if stop.number in self._run.stops or len(self._run.stops) < _EVENTS:
            self._run.stops[stop.number] = stop

    def _clock(self, _: int, clock: ClockOffset) -> None:
        self._run.offset = clock.offset

    def _loop(self, _: int, loop: Any) -> None:
        self._run.drops = loop.drops

    def _odometry(self, now: int, odometry: Odometry) -> None:
        self._run.odometry.take(now, odometry.pose.x, odometry.pose.y)
        self._run.top_speed = max(self._run.top_speed, abs(odometry.twist.vx))
        if t.POSE.name not in self._run.traffic:
            self._run.map.pose(odometry)

    def _pose(self, now: int, odometry: Odometry) -> None:
        self._run.way.take(now, odometry.pose.x, odometry.pose.y)
        self._run.map.pose(odometry)

    def _path(self, _: int, path: TruckPath) -> None:
        self._run.path_plan = path

    def _tracker(self, _: int, tracker: TrackerState) -> None:
        self._run.tracker = tracker
        if tracker.outcome is Reason.DRIVING and tracker.along > 0.0:
            self._run.cross_track_square += tracker.cross_track**2
            self._run.cross_track_count += 1


def collect(path: str | Path, progress: Progress | None = None) -> Run:
    """Digest a log, finished or not, up to its end or its first damage.

    Args:
        path: the log.
        progress: called with the bytes read so far, now and then.

    Raises:
        NotFoundError: no such log.
        InputError: not a log, or it holds no message.
    """
    reader = LogReader(Path(path))
    run = Run(Path(path), reader.size)
    collector = Collector(run)
    for number, entry in enumerate(reader):
        collector.take(entry)
        if progress is not None and number % 2000 == 0:
            progress(reader.position)
    if run.messages == 0:
        msg = f"{path}: holds no messages" + (f"; {reader.damage}" if reader.damage else "")
        raise InputError(msg)
    run.damage = reader.fault
    _describe(run, reader)
    for traffic in run.traffic.values():
        traffic.count_to(run.end)
    run.states.close(run.end)
    if not run.way.points:
        run.way = run.odometry
    return run


def _describe(run: Run, reader: LogReader) -> None:
    """What stands before the first message: attachments, library, and the offset the run began with."""
    for record in reader.preamble():
        match record:
            case Header():
                run.library = record.library
            case Attachment() if record.media_type == "application/json":
                with suppress(ValueError):
                    run.attachments[record.name.removesuffix(".json")] = json.loads(record.data)
            case Metadata(name="run"):
                run.metadata = dict(record.metadata)
    if run.offset is None:
        run.offset = first_offset(reader.path, run.metadata)


def _decoded(entry: LogMessage) -> Message | None:
    if entry.topic not in BY_NAME:
        return None
    try:
        return entry.decode()
    except TruckError:
        return None


def _plotter(curve: Curve, trace: Trace) -> Callable[[int, Any], None]:
    before = 0.0

    def take(now: int, message: Message) -> None:
        nonlocal before
        value = curve.value(message)
        if value is not None and math.isfinite(value):
            if curve.turns and trace.count:
                value = before + math.remainder(value - before, 360.0)
            before = value
            trace.add(now, value)

    return take
