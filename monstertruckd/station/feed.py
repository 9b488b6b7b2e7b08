"""Messages from one robot, encoded once for all browsers that watch it."""

import asyncio
import logging
import zlib
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Final, Generic, TypeVar

from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import TruckError
from monstertruck_runtime.mailbox import Mailbox, fifo, latest
from monstertruck_schemas import topics
from monstertruck_schemas.base import Message
from monstertruck_schemas.event import Event
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.state import GateState, Grid
from monstertruck_schemas.topics import Topic
from monstertruckd.station import frames
from monstertruckd.station.address import RobotAddress
from monstertruckd.station.frames import Frame
from monstertruckd.station.plots import Sampler, Subscriptions
from monstertruckd.station.viewer import MOST_TILES, Place, Viewer, Viewers

log = logging.getLogger(__name__)

M = TypeVar("M", bound=Message)

FEED_PERIOD: Final = 0.05
"""Interval between checks for new messages (s)."""
PING: Final = 1.0
"""Interval between measurements of the round trip to the robot (s)."""


@dataclass(frozen=True, slots=True)
class Shown(Generic[M]):
    """Topic shown on the page, with its encoder and the minimum interval between frames (s)."""

    topic: Topic[M]
    kind: str
    encode: Callable[[M], Frame]
    period: float = 0.0
    budget: float | None = None
    """Bandwidth limit (bytes/s); a large message delays the next."""


def _whole(topic: Topic[M], kind: str, period: float = 0.0) -> Shown[M]:
    return Shown(topic, kind, partial(frames.message, kind), period)


# 300_000.0: bandwidth limit of camera images (bytes/s)
SHOWN: Final[tuple[Shown[Any], ...]] = (
    _whole(topics.GATE, "gate"),
    _whole(topics.STOP, "stop"),
    _whole(topics.EXPLORE, "explore", 0.5),
    _whole(topics.MISSION, "mission", 0.5),
    _whole(topics.CALIBRATION, "calibration"),
    Shown(topics.GROUND, "ground", frames.ground, 2.0, 20_000.0),  # bandwidth limit of ground images (bytes/s)
    Shown(topics.SCAN, "scan", frames.scan, 0.1),
    Shown(topics.SCAN_2, "scan_2", partial(frames.scan, kind="scan_2"), 0.1),
    Shown(topics.TRANSFORMS, "transforms", frames.transforms, 0.2),
    Shown(topics.PATH, "path", frames.path),
    _whole(topics.GOAL, "goal"),
    _whole(topics.TRACKER, "tracker", 0.5),
    _whole(topics.BEHAVIOUR, "behaviour", 0.5),
    _whole(topics.CMD_STEERING, "steering", 0.1),
    _whole(topics.DRIVE, "drive", 0.2),
    _whole(topics.COMPASS, "compass", 0.1),
    _whole(topics.BATTERY, "battery", 0.5),
    _whole(topics.STABILISER, "stabiliser", 0.2),
    _whole(topics.HEALTH, "health"),
    _whole(topics.LOOP, "loop"),
    _whole(topics.RECORDER, "recorder"),
    _whole(topics.LINK, "network"),
    _whole(topics.HOST, "host"),
    _whole(topics.SLAM, "slam", 0.5),
    _whole(topics.USB, "usb"),
    Shown(topics.CAMERA, "camera", frames.picture, 0.1, 300_000.0),
    _whole(topics.POINTS, "points", 0.5),
    _whole(topics.ZONES, "zones", 0.5),
)


@dataclass
class MapStore:
    """Latest full map of a robot and the tiles changed since then; browsers fetch the full map by URL."""

    version: int = 0
    grid: Grid | None = None
    tiles: dict[Place, bytes] = field(default_factory=dict)
    _packed: bytes | None = None

    def take(self, grid: Grid) -> str:
        """Store a full map; return the frame that announces it."""
        self.version += 1
        self.grid, self._packed = grid, None
        self.tiles.clear()
        return frames.text("map", version=self.version, **frames.grid_head(grid))

    def change(self, part: Grid) -> tuple[Place, bytes]:
        """Store a changed tile; return its place and its frame."""
        place, frame = (part.origin.x, part.origin.y), frames.tile(part, self.version)
        if place in self.tiles or len(self.tiles) < MOST_TILES:
            self.tiles[place] = frame
        return place, frame

    async def packed(self) -> bytes | None:
        """Return all cells, compressed (zlib); None before the first map."""
        grid = self.grid
        if grid is None:
            return None
        if self._packed is None:
            data = await asyncio.to_thread(zlib.compress, grid.cells.tobytes(), 1)
            if self.grid is not grid:
                return data
            self._packed = data
        return self._packed


class RobotFeed:
    """Follows one robot for all browsers; waits while the robot is absent.

    Args:
        address: address of the robot.
        clock: clock of the station.
    """

    def __init__(self, address: RobotAddress, clock: Clock) -> None:
        self.address = address
        self.map = MapStore()
        self.alive = False
        """Whether the robot answered the latest request."""
        self.round_trip: float | None = None
        """Latest round-trip time (s); None without an answer."""
        self.gate: GateState | None = None
        """Gate state in the robot's latest answer."""
        self.client: TruckClient | None = None
        """Client of the open session; None without a session."""
        self._clock = clock
        self._viewers = Viewers()
        self._watched = asyncio.Event()
        # Maximum number of past events sent to a browser that starts to watch a robot.
        self._events: deque[str] = deque(maxlen=200)
        self._facts: str | None = None
        self._known = False
        """Whether ``_facts`` describe the running robot."""
        self._link = frames.text("link", alive=False, round_trip=None, text="")
        self._runs = 0
        """Number of observed restarts of the robot's daemon."""

    # Browsers

    def attach(self, viewer: Viewer) -> None:
        """Show this robot in a browser, starting with everything known about the robot."""
        self._viewers.add(viewer)
        self._watched.set()
        self._send_all(viewer)

    def _send_all(self, viewer: Viewer) -> None:
        viewer.show("link", self._link)
        if self._facts is not None:
            viewer.show("facts", self._facts)
        for kind, frame in self._viewers.newest.items():
            viewer.show(kind, frame)
        for event in self._events:
            viewer.send(event)
        for place, part in self.map.tiles.items():
            viewer.patch(place, part)

    def detach(self, viewer: Viewer) -> None:
        """Stop showing this robot in a browser."""
        self._viewers.discard(viewer)
        if not self._viewers:
            self._watched.clear()

    # The robot

    async def run(self) -> None:
        """Follow until cancelled."""
        retry = 1.0  # interval between connection attempts, and timeout of each (s)
        while True:
            try:
                name, endpoint = self.address.name, self.address.endpoint
                async with TruckClient(name, endpoint, clock=self._clock, timeout=retry) as client:
                    self.client = client
                    try:
                        await self._follow(client)
                    finally:
                        self.client = None  # first, because closing the session takes a while
            except TruckError as error:
                self._set_link(None, str(error))
                await self._clock.sleep(retry)
            except Exception as bug:  # the feeds of the other robots must continue
                log.exception("robot %s cannot be followed", self.address.name)
                self._set_link(None, f"{type(bug).__name__}: {bug}")
                await self._clock.sleep(retry)

    async def _follow(self, client: TruckClient) -> None:
        jobs = [asyncio.create_task(job) for job in (self._ask(client), self._sample(client))]
        try:
            done, _ = await asyncio.wait(jobs, return_when=asyncio.FIRST_COMPLETED)
            for job in done:
                job.result()
        finally:
            for job in jobs:
                job.cancel()
            await asyncio.wait(jobs)

    async def _ask(self, client: TruckClient) -> None:
        """Measure the round-trip time; query the facts of a robot that appears."""
        self._known = False
        while True:
            sent = self._clock.now()
            try:
                gate = await client.get_retained(topics.GATE)
                if self.gate is not None and gate is not None and gate.nonce != self.gate.nonce:
                    self._begin_anew()
                self.gate = gate or self.gate
            except TruckError as error:
                self._known = False
                self._set_link(None, str(error))
            else:
                self._set_link((self._clock.now() - sent) / SECOND, "")
                self._known = self._known or await self._learn(client)
            await self._clock.sleep(PING)

    def _begin_anew(self) -> None:
        """Discard the state of the previous run after a restart of the daemon."""
        self._runs += 1
        self._known = False
        self._facts = None
        self._viewers.newest.clear()
        self.map.tiles.clear()
        for viewer in self._viewers:
            viewer.forget_states()
            viewer.send(frames.text("robot", name=self.address.name))
            self._send_all(viewer)

    async def _learn(self, client: TruckClient) -> bool:
        """Query the robot's facts; return whether it answered."""
        try:
            self._facts = frames.facts(await client.call("config"), await client.call("versions"))
        except (TruckError, KeyError, TypeError, AttributeError) as error:  # the robot runs another release
            log.warning("robot %s sent an invalid description: %r", self.address.name, error)
            return False
        for viewer in self._viewers:
            viewer.show("facts", self._facts)
        return True

    async def _sample(self, client: TruckClient) -> None:
        """Subscribe while a browser watches."""
        while True:
            await self._watched.wait()
            with ExitStack() as stack:
                boxes = [(shown, stack.enter_context(client.subscribe(shown.topic, latest()))) for shown in SHOWN]
                poses = [stack.enter_context(client.subscribe(t, latest())) for t in (topics.POSE, topics.ODOMETRY)]
                events = stack.enter_context(client.subscribe(topics.EVENT, fifo(64)))
                maps = stack.enter_context(client.subscribe(topics.MAP, latest()))
                tiles = stack.enter_context(client.subscribe(topics.MAP_TILES, fifo(MOST_TILES)))
                sampler = Sampler(Subscriptions(client.subscribe, stack).newest)
                taken: dict[str, tuple[Message, int]] = {}
                sampled = 0
                run = self._runs
                while self._viewers and run == self._runs:
                    now = self._clock.now()
                    for shown, box in boxes:
                        self._take(shown, box, taken, now)
                    pose = next((box for box in poses if box.latest is not None), poses[0])
                    self._take(POSE, pose, taken, now)
                    self._take_map(maps, tiles)
                    for event in events.drain():
                        self._take_event(event)
                    if now >= sampled:
                        # Interval between values of plots (s): every second check, for the checks come slightly early
                        # or late.
                        sampled = now + round(0.09 * SECOND)
                        sampler.sample(self._viewers)
                    await self._clock.sleep(FEED_PERIOD)
            # The next browser starts with messages published then, not with stale ones.
            self._viewers.newest.clear()

    def _take(self, shown: Shown[M], box: Mailbox[M], taken: dict[str, tuple[Message, int]], now: int) -> None:
        newest = box.latest
        before, due = taken.get(shown.kind, (None, now))
        # Half a tick of tolerance: the checks themselves come slightly early or late.
        if newest is None or newest is before or now < due - FEED_PERIOD / 2 * SECOND:
            return
        frame = shown.encode(newest)
        pause = max(shown.period, 0.0 if shown.budget is None else len(frame) / shown.budget)
        taken[shown.kind] = newest, now + round(pause * SECOND)
        self._viewers.show(shown.kind, frame)

    def _take_map(self, maps: Mailbox[Grid], tiles: Mailbox[Grid]) -> None:
        for grid in maps.drain():
            self._viewers.show("map", self.map.take(grid))
        for part in tiles.drain():
            self._viewers.patch(*self.map.change(part))

    def _take_event(self, event: Event) -> None:
        if event.reason is Reason.SETTING_CHANGED:
            self._known = False
        frame = frames.message("event", event)
        self._events.append(frame)
        self._viewers.send(frame)

    def _set_link(self, round_trip: float | None, text: str) -> None:
        self.alive, self.round_trip = round_trip is not None, round_trip
        if not self.alive:
            self._viewers.newest = {kind: frame for kind, frame in self._viewers.newest.items() if kind == "map"}
        self._link = frames.text("link", alive=self.alive, round_trip=round_trip, text=text)
        for viewer in self._viewers:
            viewer.show("link", self._link)


POSE: Final = Shown(topics.ODOMETRY, "pose", frames.pose)
