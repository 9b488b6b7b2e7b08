"""One browser's control of one robot: a separate source of requests, so that the robot can distinguish two tabs.

Nothing here repeats a request. Each heartbeat from the browser becomes one request with a short lease, or no request if
it was delayed, because a delayed input is not the current one.
"""

import asyncio
import json
import math
from collections import deque
from collections.abc import Callable, Coroutine, Sequence
from contextlib import suppress
from pathlib import Path as FilePath
from typing import Any, Final

import numpy as np
from pydantic import ValidationError
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError
from ruamel.yaml.events import AliasEvent

from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.drives import named, send_path
from monstertruck_runtime.errors import InputError, NoAnswerError, NotFoundError, RequestRefusedError, TruckError
from monstertruck_runtime.mailbox import latest
from monstertruck_runtime.path_files import has_waypoints, mission_from, path_from
from monstertruck_runtime.threads import in_thread
from monstertruck_schemas.base import first_mistake
from monstertruck_schemas.mission import Mission
from monstertruck_schemas.plan import Path
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import UNCONDITIONAL, MissionOrder
from monstertruck_schemas.topics import PATH
from monstertruckd.station import frames
from monstertruckd.station.address import RobotAddress
from monstertruckd.station.commands import (
    Acknowledge,
    Asked,
    AskToDrive,
    Behave,
    ChangeGoal,
    ChangePoint,
    ChangeSetting,
    ChangeZone,
    DeleteRecording,
    DoMission,
    Explore,
    GiveOrder,
    HandOver,
    Heartbeat,
    ListRecordings,
    ListSettings,
    SetGoal,
    StartPath,
    Track,
    TrackFile,
)
from monstertruckd.station.viewer import Viewer

LEASE: Final = 0.25
"""Validity of a heartbeat (s)."""
MOST_ASKED: Final = 16
"""Maximum number of pending commands of one browser."""
SHORTEST: Final = 0.3
"""Minimum length of a drawn path (m)."""
LONGEST_DRAWN_PATH: Final = 200.0
"""Maximum length of a drawn path (m): it is computed in one piece, in about 2 ms."""


class DelayWatch:
    """Detects delayed heartbeats, from the station's latest message that the browser received. Times are in seconds.

    The browser reports the last station time it received, and the time that passed until it read its input. The
    remaining time is the latency of both messages, so no two clocks are compared.
    """

    def __init__(self) -> None:
        # Number of latest heartbeats to find the quickest among.
        self._ways: deque[float] = deque(maxlen=200)

    def late(self, heard: float, since: float, now: float) -> float | None:
        """Return the lateness of a heartbeat, or None if it is on time.

        ``heard`` and ``now`` are times of the station's clock.
        """
        way = now - heard - max(since, 0.0)
        self._ways.append(way)
        late = way - min(self._ways)
        # A round trip of 1.5 s is too long however slow the others were; 0.2 s beyond the quickest is late.
        return way if way > 1.5 else late if late > 0.2 else None


class Pilot:
    """Orders and heartbeats from one browser to one robot.

    Args:
        address: address of the robot.
        name: name of the browser, appended to the station's name.
        viewer: outbox for answers.
        clock: clock of the station.
        spare: returns another session with the robot, if any, for stops while this browser has no session.
    """

    def __init__(
        self,
        address: RobotAddress,
        name: str,
        viewer: Viewer,
        clock: Clock,
        spare: Callable[[], TruckClient | None] = lambda: None,
    ) -> None:
        self._address = address
        self._spare = spare
        self._name = name
        self._client: TruckClient | None = None
        """Client while the robot's endpoint answers; otherwise None."""
        self._ready = False
        """Whether a heartbeat can be forwarded at once."""
        self._viewer = viewer
        self._clock = clock
        self._lateness = DelayWatch()
        self._said_late = -math.inf
        self._driving: asyncio.Task[None] | None = None
        self._answers: set[asyncio.Task[None]] = set()

    async def run(self) -> None:
        """Keep the session open until cancelled; wait while the robot is absent."""
        retry = 1.0  # interval between connection attempts to the robot, and timeout of each (s)
        try:
            while True:
                with suppress(TruckError):  # the feed reports the error
                    async with self._address.session(self._name, self._clock, retry) as client:
                        self._client = client
                        self._viewer.send(frames.text("pilot", source=client.source))
                        while not self._ready:
                            with suppress(NoAnswerError):
                                await client.ready()
                                self._ready = True
                        await asyncio.Event().wait()
                await self._clock.sleep(retry)
        finally:
            self._client = None
            tasks = [*self._answers, *([] if self._driving is None else [self._driving])]
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    def drive(self, motion: Heartbeat) -> None:
        """Forward one heartbeat unless it is late or would have to wait for the robot."""
        now = self._clock.now() / SECOND
        late = self._lateness.late(motion.heard / 1e3, motion.since / 1e3, now)
        if late is not None:
            if now - self._said_late > 1.0:  # minimum interval between reports of late heartbeats (s)
                self._said_late = now
                self._viewer.send(frames.text("late", seconds=round(late, 3)))
            return
        if self._client is not None and self._ready and (self._driving is None or self._driving.done()):
            self._driving = asyncio.create_task(self._request(self._client, motion))

    async def _request(self, client: TruckClient, motion: Heartbeat) -> None:
        client.role = motion.role
        try:
            if motion.twist is None:
                await client.drive(motion.speed, motion.front, motion.rear, lease=LEASE, unseen=motion.unseen)
            else:
                await client.drive_twist(*motion.twist, lease=LEASE, unseen=motion.unseen)
        except TruckError as error:
            self._viewer.send(frames.text("trouble", text=str(error)))

    def ask(self, command: Asked) -> None:
        """Execute a command, and send its outcome to the browser; an emergency stop is sent before this returns."""
        stops = isinstance(command, GiveOrder) and command.order in UNCONDITIONAL
        client = self._client or (self._spare() if stops else None)
        if client is None:
            self._viewer.send(frames.refusal(command.id, NotFoundError("no link to the robot")))
            return
        if len(self._answers) >= MOST_ASKED and not stops:
            why = f"{MOST_ASKED} commands of this browser are pending: wait for an answer"
            self._viewer.send(frames.refusal(command.id, RequestRefusedError(Reason.BUSY, why)))
            return
        task = asyncio.create_task(self._outcome(command.id, _call(client, command, self._clock)))
        self._answers.add(task)
        task.add_done_callback(self._answers.discard)

    async def _outcome(self, number: int, call: Coroutine[Any, Any, Any]) -> None:
        try:
            value = await call
        except TruckError as error:
            self._viewer.send(frames.refusal(number, error))
        else:
            more = {"value": value} if isinstance(value, dict) else {}
            self._viewer.send(frames.text("answer", id=number, ok=True, **more))


def _call(client: TruckClient, command: Asked, clock: Clock) -> Coroutine[Any, Any, Any]:
    match command:
        case GiveOrder():
            return client.order(command.order, hold=command.hold)
        case SetGoal():
            return client.goal(command.goal, via=command.via)
        case ChangeGoal():
            return client.goal_control(command.order)
        case Behave():
            return client.behave(command.order, command.behaviour)
        case Explore():
            return client.explore(command.order)
        case DoMission():
            return _mission(client, command)
        case Track():
            return _track(client, lambda: drawn_path(command.points), clock)
        case TrackFile():
            file = FilePath(FilePath(command.name).name)
            return _track(client, lambda: path_from(command.text, file, closed=command.closed, frame="map"), clock)
        case StartPath():
            return client.start_path(command.path)
        case _:
            return _other_call(client, command)


def _other_call(client: TruckClient, command: Asked) -> Coroutine[Any, Any, Any]:
    """Return the call for a command that moves nothing."""
    match command:
        case AskToDrive():
            return client.ask_to_drive()
        case HandOver():
            return client.hand_over(command.to)
        case ChangeZone():
            return client.zone(command.order, command.name, command.area, command.seconds)
        case ChangePoint():
            return client.point(command.order, command.name, command.place, command.yaw)
        case Acknowledge():
            return client.call("acknowledge", {"text": command.text})
        case ListSettings():
            return client.call("settings")
        case ChangeSetting():
            return client.call("set", {"values": {command.key: command.value}, "save": command.save})
        case ListRecordings():
            return client.call("recordings")
        case DeleteRecording():
            return client.call("recording_delete", {"name": command.name})
        case _:
            raise AssertionError(command)


async def _track(client: TruckClient, make: Callable[[], Path], clock: Clock) -> None:
    path = await in_thread(make)
    with client.subscribe(PATH, latest()) as present:
        await send_path(client, clock, named(path, clock), present)


async def _mission(client: TruckClient, command: DoMission) -> dict[str, Any]:
    mission = None
    if command.order is MissionOrder.START:
        mission = await in_thread(lambda: read_mission(command.text))
    return await client.mission(command.order, mission, moved=command.moved)


def read_mission(text: str) -> Mission:
    """Return the mission in a file's text, or a mission that drives to each waypoint in the text.

    Raises:
        InputError: the text is not a mission, or has aliases (a few lines of them can expand to gigabytes); the message
            names the first mistake.
    """
    if has_waypoints(text):
        return mission_from(text, FilePath("mission.yaml"))
    try:
        if any(isinstance(event, AliasEvent) for event in YAML(typ="safe", pure=True).parse(text)):
            raise InputError("mission: contains an alias (*name): expected every value written out")
        return Mission.model_validate_json(json.dumps(YAML(typ="safe", pure=True).load(text)))
    except ValidationError as error:
        raise InputError(f"mission: {first_mistake(error)}") from error
    except (YAMLError, TypeError, ValueError, RecursionError) as error:
        raise InputError(f"mission: not valid YAML: {' '.join(str(error).split())[:160]}") from error


def drawn_path(points: Sequence[tuple[float, float]]) -> Path:
    """Convert a drawn line to a path in the map (m), driven forward: resample it to 5 cm and smooth it.

    Raises:
        InputError: the line is too short or too long to be driven.
    """
    line = np.array(points)
    steps = np.hypot(*np.diff(line, axis=0).T)
    line = line[np.concatenate(([True], steps > 1e-6))]
    along = np.concatenate(([0.0], np.cumsum(steps[steps > 1e-6])))
    if along[-1] < SHORTEST:
        raise InputError(f"path: drawn length {along[-1]:.2f} m, expected at least {SHORTEST} m")
    if along[-1] > LONGEST_DRAWN_PATH:
        raise InputError(f"path: drawn length {along[-1]:.4g} m, expected at most {LONGEST_DRAWN_PATH:g} m")
    drawn_spacing = 0.05  # distance between poses of a drawn path (m)
    places = np.linspace(0.0, along[-1], max(math.ceil(along[-1] / drawn_spacing), 2) + 1)
    even = np.column_stack([np.interp(places, along, line[:, i]) for i in (0, 1)])
    smoothing = 0.12  # standard deviation of the smoothing weights (m): hands tremble
    # Mirror the line at its ends, which stay in place.
    more = min(math.ceil(3 * smoothing / drawn_spacing), len(even) - 1)
    mirrored = np.concatenate((2 * even[0] - even[more:0:-1], even, 2 * even[-1] - even[-2 : -2 - more : -1]))
    weights = np.exp(-0.5 * (np.arange(-more, more + 1) * drawn_spacing / smoothing) ** 2)
    smooth = np.column_stack([np.convolve(mirrored[:, i], weights / weights.sum(), "valid") for i in (0, 1)])
    turns = np.gradient(smooth, axis=0)
    poses = np.column_stack((smooth, np.arctan2(turns[:, 1], turns[:, 0])))
    header: dict[str, Any] = {"stamp": 0, "received": 0, "seq": 0, "frame": "map"}
    return Path(**header, poses=poses.ravel(), directions=np.ones(len(poses)), name="drawn")
