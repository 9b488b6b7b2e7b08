"""One pass over a log that collects all data of the report in bounded memory."""

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
from monstertruck_schemas.zones import Zones
from monstertruckd.recorder.reader import LogMessage, LogReader
from monstertruckd.tools.logs.messages import Progress, first_offset
from monstertruckd.tools.logs.report.scan_map import ScanMap
from monstertruckd.tools.logs.report.signals import FIGURES, Curve, DrivenPath, Trace
from monstertruckd.tools.logs.report.states import StateTimeline


@dataclass(slots=True)
class Traffic:
    """Statistics of one topic of the log."""

    name: str
    messages: int = 0
    bytes: int = 0
    first: int = 0
    last: int = 0
    lost: int = 0
    """Number of messages that were counted by the recorder but are not in the log."""
    undecodable: int = 0
    silences: int = 0
    longest_silence: float = 0.0
    """Longest time between two messages (s); 0 for topics without a nominal rate."""
    rate: Trace = field(default_factory=Trace)
    """Message rate of each whole second, in per cent of the nominal rate."""
    _sequence: int | None = None
    _second: int = 0
    _in_second: int = 0

    @property
    def nominal(self) -> float | None:
        """Rate of the topic table (Hz)."""
        topic = BY_NAME.get(self.name)
        return None if topic is None else topic.rate

    @property
    def mean_rate(self) -> float | None:
        """Measured rate between first and last message (Hz)."""
        return (self.messages - 1) * SECOND / (self.last - self.first) if self.last > self.first else None

    def take(self, message: LogMessage) -> None:
        """Add a message."""
        now = message.log_time
        if self.messages == 0:
            self.first = self.last = now
            self._second = now // SECOND
        self._count_lost(message.sequence)
        if self.nominal is not None:
            self._watch(now, self.nominal)
        self.messages += 1
        self.bytes += len(message.payload)
        self.last = max(self.last, now)

    def _count_lost(self, sequence: int) -> None:
        sequences = 1 << 32
        if self._sequence is not None:
            skipped = (sequence - self._sequence - 1) % sequences
            self.lost += skipped if skipped < sequences // 2 else 0  # else the sequence restarted
        self._sequence = sequence

    def _watch(self, now: int, nominal: float) -> None:
        silence = (now - self.last) / SECOND
        self.longest_silence = max(self.longest_silence, silence)
        # 5: minimum length of a silence, in nominal periods, if the topic names no staleness limit
        limit = BY_NAME[self.name].stale_after or 5 / nominal
        self.silences += silence > limit
        self.count_to(now)
        self._in_second += 1

    def count_to(self, now: int) -> None:
        """Count every second that has ended at ``now``."""
        while self.nominal is not None and self._second < now // SECOND:
            if self._second > self.first // SECOND:  # the first one is incomplete
                self.rate.add(self._second * SECOND + SECOND // 2, 100.0 * self._in_second / self.nominal)
            self._second += 1
            self._in_second = 0


_PERIODS: Final = {t.ODOMETRY.name: SECOND // 20, t.POSE.name: SECOND // 20, t.TRANSFORMS.name: SECOND}
"""Topics of high rate that are decoded no more often than this (ns)."""
_EVENTS: Final = 400
"""Number of events kept per severity."""


@dataclass(slots=True)
class RunSummary:
    """All data of the report."""

    path: Path
    size: int
    start: int = 0
    """First and last log time (ns)."""
    end: int = 0
    messages: int = 0
    damage: str | None = None
    library: str = ""
    attachments: dict[str, Any] = field(default_factory=dict)
    metadata: dict[str, str] = field(default_factory=dict)
    """Metadata of the run in the log."""
    offset: int | None = None
    """Real minus daemon time (ns), by the latest message."""
    traces: dict[Curve, Trace] = field(default_factory=dict)
    traffic: dict[str, Traffic] = field(default_factory=dict)
    states: StateTimeline = field(default_factory=StateTimeline)
    events: list[Event] = field(default_factory=list)
    event_counts: dict[Severity, int] = field(default_factory=lambda: dict.fromkeys(Severity, 0))
    journal: list[LogRecord] = field(default_factory=list)
    """First log records of severity warning or above."""
    journal_count: int = 0
    """Number of log records of severity warning or above."""
    stops: dict[int, Stop] = field(default_factory=dict)
    """Stops by number, each as published last."""
    drops: int = 0
    """Number of messages lost in the daemon's bounded queues, by its last count."""
    way: DrivenPath = field(default_factory=DrivenPath)
    """Driven path, in the map frame if the log has poses there, else in odom."""
    odometry: DrivenPath = field(default_factory=DrivenPath)
    path_plan: TruckPath | None = None
    zones: Zones | None = None
    tracker: TrackerState | None = None
    top_speed: float = 0.0
    cross_track_square: float = 0.0
    cross_track_count: int = 0
    map: ScanMap = field(default_factory=ScanMap)

    @property
    def duration(self) -> float:
        """Time from the first to the last message (s)."""
        return (self.end - self.start) / SECOND

    @property
    def distance(self) -> float:
        """Distance travelled by odometry, or by the poses in the map if there is none (m)."""
        return self.odometry.distance or self.way.distance

    @property
    def cross_track_rms(self) -> float | None:
        """RMS cross-track error while tracking a path (m)."""
        return math.sqrt(self.cross_track_square / self.cross_track_count) if self.cross_track_count else None

    @property
    def is_black_box(self) -> bool:
        """Whether the log is a black box, in which pictures are sampled and the metadata counts lost messages."""
        return "stopped_at_ns" in self.metadata

    @property
    def lost(self) -> int:
        """Number of messages that were published but are not in the log."""
        if self.is_black_box:
            return int(self.metadata.get("lost", 0))
        return sum(row.lost for row in self.traffic.values())


class Collector:
    """Collects messages in log order."""

    def __init__(self, run: RunSummary) -> None:
        self._run = run
        self._due: dict[str, int] = {}
        self._handlers: dict[str, list[Callable[[int, Any], None]]] = {}
        for figure in FIGURES:
            for curve in figure.curves:
                trace = run.traces[curve] = Trace()
                self._on(curve.topic.name, _plotter(curve, trace))
        handlers: tuple[tuple[Topic[Any], Callable[[int, Any], None]], ...] = (
            (t.EVENT, self._event),
            (t.LOG, self._record),
            (t.STOP, self._stop),
            (t.CLOCK, self._clock),
            (t.ODOMETRY, self._odometry),
            (t.POSE, self._pose),
            (t.PATH, self._path),
            (t.ZONES, self._zones),
            (t.TRACKER, self._tracker),
            (t.TRANSFORMS, lambda _, m: run.map.scans.transforms(m)),
            (t.MAP, lambda _, m: run.map.grid(m)),
            (t.SCAN, lambda _, m: run.map.scan(m)),
            (t.LOOP, self._loop),
            *run.states.handlers(),
        )
        for topic, handler in handlers:
            self._on(topic.name, handler)

    def _on(self, topic: str, handler: Callable[[int, Any], None]) -> None:
        self._handlers.setdefault(topic, []).append(handler)

    def take(self, entry: LogMessage) -> None:
        """Add one message; undecodable ones are counted."""
        run, now = self._run, entry.log_time
        run.start = now if run.messages == 0 else min(run.start, now)
        run.end = max(run.end, now)
        run.messages += 1
        traffic = run.traffic.setdefault(entry.topic, Traffic(entry.topic))
        traffic.take(entry)
        handlers = self._handlers.get(entry.topic)
        if handlers is None or now < self._due.get(entry.topic, now):
            return
        if (period := _PERIODS.get(entry.topic)) is not None:
            self._due[entry.topic] = now + period
        message = _decoded(entry)
        if message is None:
            traffic.undecodable += 1
            return
        for handler in handlers:
            handler(now, message)

    def _event(self, _: int, event: Event) -> None:
        counts = self._run.event_counts
        counts[event.severity] += 1
        if counts[event.severity] <= _EVENTS:
            self._run.events.append(event)

    def _record(self, _: int, record: LogRecord) -> None:
        if record.level in {LogLevel.DEBUG, LogLevel.INFO}:
            return
        self._run.journal_count += 1
        if len(self._run.journal) < 400:  # warnings and worse kept of the journal
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
            self._run.map.scans.pose(odometry)

    def _pose(self, now: int, odometry: Odometry) -> None:
        self._run.way.take(now, odometry.pose.x, odometry.pose.y)
        self._run.map.scans.pose(odometry)

    def _path(self, _: int, path: TruckPath) -> None:
        self._run.path_plan = path

    def _zones(self, _: int, zones: Zones) -> None:
        self._run.zones = zones

    def _tracker(self, _: int, tracker: TrackerState) -> None:
        self._run.tracker = tracker
        if tracker.outcome is Reason.DRIVING and tracker.along > 0.0:
            self._run.cross_track_square += tracker.cross_track**2
            self._run.cross_track_count += 1


def collect(path: str | Path, progress: Progress | None = None) -> RunSummary:
    """Read a log, finished or not, up to its end or the first damage.

    Args:
        path: the log.
        progress: called with the bytes read so far.

    Raises:
        NotFoundError: no such log.
        InputError: not a log, or it has no messages.
    """
    reader = LogReader(Path(path))
    run = RunSummary(Path(path), reader.size)
    collector = Collector(run)
    for number, entry in enumerate(reader):
        collector.take(entry)
        if progress is not None and number % 2000 == 0:
            progress(reader.position)
    if run.messages == 0:
        msg = f"{path}: contains no messages" + (f"; {reader.damage}" if reader.damage else "")
        raise InputError(msg)
    run.damage = reader.fault
    _describe(run, reader)
    for traffic in run.traffic.values():
        traffic.count_to(run.end)
    run.states.close(run.end)
    if not run.way.points:
        run.way = run.odometry
    return run


def _describe(run: RunSummary, reader: LogReader) -> None:
    """Read attachments, library and clock offset from the records before the first message."""
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
