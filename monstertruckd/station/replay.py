"""Replay of a recording on the page, with a time bar: browsers get the same frames as from a robot, read from a log."""

import bisect
import logging
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, Final, Protocol

from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import InputError, TruckError
from monstertruck_schemas import topics
from monstertruck_schemas.base import Message
from monstertruckd.station import frames
from monstertruckd.station.feed import FEED_PERIOD, POSE, SHOWN, MapStore
from monstertruckd.station.frames import Frame
from monstertruckd.station.plots import Sampler
from monstertruckd.station.viewer import Viewer, Viewers

log = logging.getLogger(__name__)

AGAIN_KINDS: Final = ("gate", "pose", "scan")


class Recorded(Protocol):
    """Message of a log."""

    topic: str
    log_time: int

    def decode(self) -> Message:
        """Return the typed message."""


class RecordedLog(Iterable[Any], Protocol):
    """A log file: iterates over its messages."""

    def config(self) -> dict[str, Any]:
        """Return the robot's configuration at the time of the recording."""

    @property
    def fault(self) -> str | None:
        """Fault found by iterating to the end, as text that follows the log's name; None for an intact log."""


LogOpener = Callable[[Path], RecordedLog]


class RecordedTopic:
    """Messages of one topic, ordered by time."""

    def __init__(self) -> None:
        self.times: list[int] = []
        self.messages: list[Recorded] = []
        self.index = 0
        """Number of messages before the current time."""
        self._last: tuple[int, Message | None] = -1, None

    def up_to(self, at: int) -> Iterator[Message]:
        """Return the messages since the last call, up to ``at``; skip undecodable ones."""
        end = bisect.bisect_right(self.times, at)
        begin, self.index = self.index, end
        yield from _decoded(self.messages[begin:end])

    def newest(self, at: int) -> Message | None:
        """Return the latest message since the last call, up to ``at``, or None."""
        end = bisect.bisect_right(self.times, at)
        if end == self.index:
            return None
        self.index = end - 1
        return next(self.up_to(at), None)

    def last(self, at: int) -> Message | None:
        """Return the latest message up to ``at``, or None; the same object until there is a later message."""
        place = bisect.bisect_right(self.times, at) - 1
        if place != self._last[0]:
            self._last = place, next(_decoded(self.messages[place : place + 1]), None) if place >= 0 else None
        return self._last[1]


def _decoded(rows: Iterable[Recorded]) -> Iterator[Message]:
    """Decode messages; skip undecodable ones."""
    for row in rows:
        try:
            yield row.decode()
        except TruckError as error:
            log.debug("message skipped: %s", error)


class ReplayFeed:
    """Recording shown to all its browsers at the same time.

    Args:
        name: name in the page's list of robots.
        file: log file.
        open_log: function that opens logs.
        clock: clock of the station.
        growing: whether the robot was still writing the log, so that the log may lack its end without being damaged.

    Raises:
        InputError: the file is not a log, contains nothing to show, or is too large.
    """

    def __init__(self, name: str, file: Path, open_log: LogOpener, clock: Clock, growing: bool = False) -> None:
        self.name = name
        self.robot = name.partition(" ")[0]
        self.map = MapStore()
        self._clock = clock
        self._viewers = Viewers()
        shown = (*SHOWN, POSE)
        ways = (topics.POSE, topics.MAP, topics.MAP_TILES, topics.EVENT)
        self._tracks = {topic.name: RecordedTopic() for topic in (*(row.topic for row in shown), *ways)}
        self._plotted = {topic.name: self._tracks.get(topic.name, RecordedTopic()) for topic in topics.TOPICS}
        """Messages of all topics: each has numbers to plot."""
        self._sampler = Sampler(lambda topic: self._plotted[topic].last(self._at))
        reader = open_log(file)
        self._begin, self._end = self._fill(reader, file)
        self._fault = None if growing else reader.fault
        self._growing = growing
        pose = topics.POSE if self._tracks[topics.POSE.name].times else topics.ODOMETRY
        self._shown = [*((row.topic.name, row) for row in SHOWN), (pose.name, POSE)]
        self._facts = _facts(reader)
        self._at = self._begin
        self._playing = True
        self._rate = 1.0
        self._seek(self._begin)

    def _fill(self, reader: RecordedLog, file: Path) -> tuple[int, int]:
        size = 0
        most_bytes = 400_000_000  # maximum payload of a recording kept in memory (bytes)
        for row in reader:
            track = self._plotted.get(row.topic)
            if track is None:
                continue
            size += len(row.payload)
            if size > most_bytes:
                raise InputError(
                    f"{file.name}: more than {most_bytes / 1e6:.0f} MB, too large for the page; use "
                    "`monstertruckd replay`"
                )
            track.times.append(max(row.log_time, track.times[-1] if track.times else row.log_time))
            track.messages.append(row)
        filled = [track.times for track in self._tracks.values() if track.times]
        if not filled:
            raise InputError(f"{file.name}: contains no topic that the page shows")
        return min(times[0] for times in filled), max(times[-1] for times in filled)

    # Browsers

    @property
    def watched(self) -> bool:
        """Whether any browser shows the recording."""
        return bool(self._viewers)

    def attach(self, viewer: Viewer) -> None:
        """Show the recording in a browser."""
        self._viewers.add(viewer)
        self._send_all(viewer)

    def detach(self, viewer: Viewer) -> None:
        """Stop showing the recording in a browser."""
        self._viewers.discard(viewer)

    def control(self, at: float | None, playing: bool | None, rate: float | None) -> None:
        """Seek (s since the start), play or pause, or change the rate."""
        if rate is not None:
            self._rate = min(max(rate, 0.1), 20.0)
        if playing is not None:
            self._playing = playing
            if playing and self._at >= self._end and at is None:
                at = 0.0
        if at is not None:
            self._seek(min(max(self._begin + round(at * SECOND), self._begin), self._end))
            for viewer in self._viewers:
                viewer.forget_states()
                viewer.send(frames.text("robot", name=self.name))
                self._send_all(viewer)
        self._send_state()

    def holds(self, stamp: int) -> bool:
        """Return whether the recording covers a stamp of the robot's clock (ns)."""
        return self._begin <= stamp <= self._end

    def show_moment(self, stamp: int) -> None:
        """Show the moment of a stamp of the robot's clock (ns), and pause there.

        Raises:
            InputError: the recording does not contain this moment.
        """
        if not self.holds(stamp):
            raise InputError(f"{self.name}: does not contain this time")
        self.control((stamp - self._begin) / SECOND, playing=False, rate=None)

    def _send_all(self, viewer: Viewer) -> None:
        viewer.show("facts", self._facts)
        viewer.show("link", frames.text("link", alive=True, round_trip=0.0, text=""))
        for kind, frame in self._viewers.newest.items():
            viewer.show(kind, frame)
        for place, part in self.map.tiles.items():
            viewer.patch(place, part)
        for event in self._events():
            viewer.send(event)
        viewer.show("replay", self._state())

    def _events(self) -> Iterator[Frame]:
        track = self._tracks[topics.EVENT.name]
        # 50: number of events shown from before the chosen time
        for event in _decoded(track.messages[max(track.index - 50, 0) : track.index]):
            yield frames.message("event", event)

    # Time

    async def run(self) -> None:
        """Play until cancelled."""
        before = self._clock.now()
        due = 0
        while True:
            await self._clock.sleep(FEED_PERIOD)
            now = self._clock.now()
            if self._viewers and self._playing:
                self._play(min(self._at + round((now - before) * self._rate), self._end))
            before = now
            self._sampler.sample(self._viewers)
            if self._viewers and now >= due:
                # 0.4: interval for repeating unchanged frames (s): pages detect a silent robot by their absence
                due = now + round(0.4 * SECOND)
                for kind in AGAIN_KINDS:
                    if kind in self._viewers.newest:
                        self._viewers.show(kind, self._viewers.newest[kind])
                self._send_state()

    def _play(self, at: int) -> None:
        self._at = at
        self._playing = at < self._end
        self._look(at)
        for event in self._tracks[topics.EVENT.name].up_to(at):
            self._viewers.send(frames.message("event", event))

    def _seek(self, at: int) -> None:
        self._at = at
        self._viewers.newest.clear()
        version, self.map = self.map.version, MapStore()
        self.map.version = version
        for track in self._tracks.values():
            track.index = 0
        maps, tiles, events = (self._tracks[t.name] for t in (topics.MAP, topics.MAP_TILES, topics.EVENT))
        events.index = bisect.bisect_right(events.times, at)
        newest = bisect.bisect_right(maps.times, at) - 1
        tiles.index = bisect.bisect_left(tiles.times, maps.times[newest]) if newest >= 0 else 0
        self._look(at)

    def _look(self, at: int) -> None:
        """Show the messages up to ``at``."""
        for name, row in self._shown:
            if (message := self._tracks[name].newest(at)) is not None:
                self._viewers.show(row.kind, row.encode(message))
        if (grid := self._tracks[topics.MAP.name].newest(at)) is not None:
            self._viewers.show("map", self.map.take(grid))  # type: ignore[arg-type]  # the topic's model
        for part in self._tracks[topics.MAP_TILES.name].up_to(at):
            self._viewers.patch(*self.map.change(part))  # type: ignore[arg-type]

    def _state(self) -> str:
        return frames.text(
            "replay",
            at=round((self._at - self._begin) / SECOND, 2),
            length=round((self._end - self._begin) / SECOND, 2),
            playing=self._playing,
            rate=self._rate,
            fault=self._fault,
            growing=self._growing,
        )

    def _send_state(self) -> None:
        for viewer in self._viewers:
            viewer.show("replay", self._state())


def _facts(reader: RecordedLog) -> str:
    """Return the facts of the recorded robot; empty facts if the log does not contain them."""
    try:
        return frames.facts(reader.config(), {})
    except (TruckError, KeyError, TypeError, AttributeError):
        nothing = {"robot": None, "gate": dict.fromkeys(("speed", "reverse_speed", "angle", "tilt", "leases"), 0.0)}
        return frames.facts(nothing, {})
