"""The services of a robot that compute from sensors, assembled without its devices."""

import asyncio
from bisect import bisect_left
from collections import Counter, deque
from collections.abc import AsyncIterator, Iterable, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager, suppress
from typing import Any, Final

from monstertruck_estimation.odometry import OdometryConfig
from monstertruck_estimation.scan_tilt import TiltStamper
from monstertruck_planners.goals.config import PlannerConfig
from monstertruck_planners.goals.service import GoalService
from monstertruck_planners.track.paths import PathService
from monstertruck_runtime import wire
from monstertruck_runtime.actors.actor import use_delivery
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError, NotFoundError, RequestRefusedError, TruckError, first_of
from monstertruck_runtime.ports import Publisher
from monstertruck_runtime.service import Service
from monstertruck_schemas import topics
from monstertruck_schemas.base import Message
from monstertruck_schemas.health import SlamHealth
from monstertruck_schemas.plan import Path
from monstertruck_schemas.req import GoalControl, GoalRequest
from monstertruck_schemas.roles import DeviceRole
from monstertruck_schemas.sensor import LaserScan
from monstertruck_schemas.topics import Topic
from monstertruckd.assembly.devices import scan_publisher
from monstertruckd.assembly.estimation import Body, build_estimation, build_slam
from monstertruckd.assembly.planning import build_planners
from monstertruckd.bus.local import Bus
from monstertruckd.config.truck import PlacementConfig, TruckConfig
from monstertruckd.recorder.reader import LogMessage
from monstertruckd.tools.replay_check.answers import ComputedPaths, ReplayedActors
from monstertruckd.tools.replay_check.goals import TOGETHER, GoalRecord, RecordedCall, asks_standstill, is_deformed
from monstertruckd.tools.replay_check.pace import Pace, PacedClock, RecordedTurns
from monstertruckd.tools.replay_check.recorded import Survey

TICKS: Final[Mapping[str, tuple[str, ...]]] = {
    "transforms": (topics.TRANSFORMS.name,),
    "odometry": (topics.ODOMETRY.name, topics.FUSION.name),
    "levelling": (topics.PLAN_STABILISER.name,),
    "tracker": (topics.PLAN_DRIVE.name, topics.TRACKER.name),
    "goals": (topics.GOAL.name,),
}
"""Services that read and publish without waiting in between, and the outputs that show when they did."""
SERVICES: Final = {topic: service for service, names in TICKS.items() for topic in names}

WORKER: Final = (topics.SLAM.name, topics.SCAN_MOTION.name, topics.MAP.name, topics.MAP_TILES.name)
"""Outputs of the estimation worker, which come when it is done."""

LINKS: Final = 16
"""Iterations of the event loop that suffice to deliver a worker's answer."""

GIVEN: Final = frozenset({topics.PATH.name, topics.GATE.name})
"""Not computed again, but read by the tracker."""
ASKED: Final = frozenset(
    topic.name
    for topic in (
        topics.GATE, topics.SEEN, topics.GROUND, topics.ZONES,
        topics.REQ_GOAL, topics.REQ_GOAL_CONTROL, topics.REQ_PATH,
    )
)  # fmt: skip
"""Not computed again, but read by planner and tracker where the robot drives to goals, whose paths are computed. Ground
and goals have their turns at the same instants, in either order."""


def replayable(config: TruckConfig) -> TruckConfig:
    """Return the part of a configuration that is recomputed: nothing is saved, drawn or sent elsewhere.

    Raises:
        NotFoundError: the saved map used for localisation is missing.
        InputError: an external program localised the robot.
    """
    slam = config.slam
    if slam is not None and slam.mode == "ros2":
        raise InputError("slam.mode ros2: the pose came from outside and cannot be recomputed")
    if slam is not None:
        if slam.mode == "localisation" and (slam.map is None or not slam.map.is_dir()):
            raise NotFoundError(f"slam.map: {slam.map}: no such folder, and the log does not contain it")
        slam = slam.model_copy(update={"save": None})
    return config.model_copy(
        update={
            "slam": slam,
            "path": None,
            "map": None,
            "behaviours": {},
            "explorer": None,
            "ground": None,
            "points": None,
            "placement": PlacementConfig(),
        }
    )


def outputs_of(config: TruckConfig) -> frozenset[str]:
    """Return the topics recomputed by a replay of this configuration."""
    config, devices = replayable(config), config.devices
    names = {topics.TRANSFORMS.name}
    if config.missing_actuators() is None:
        names |= {topics.ODOMETRY.name, topics.POSE.name}
        if not isinstance(config.odometry, OdometryConfig):
            names.add(topics.FUSION.name)
    if config.slam is not None:
        names |= {topics.POSE.name, *WORKER}
    if devices.compass is not None and devices.lidar is not None:
        names.add(topics.SCAN.name)
    if devices.compass is not None and devices.stabiliser is not None:
        names.add(topics.PLAN_STABILISER.name)
    if config.tracker is not None:
        names |= set(TICKS["tracker"])
        if config.own_planner is not None:
            names |= {topics.GOAL.name, topics.PATH.name}
    return frozenset(names)


def why_no_goals(own: TruckConfig, used: TruckConfig, log: GoalRecord) -> str | None:
    """Return why the planner of a robot cannot be replayed; None if it can, or there is none."""
    if own.own_planner is None or used.own_planner is None:
        return None if own.own_planner is used.own_planner else "only one of the two configurations has a planner"
    if not log.reports:
        return "the log contains no state of goals"
    if used.slam is None and used.own_planner.map is not None and not used.own_planner.map.is_file():
        return f"planner.map: {used.own_planner.map}: no such file, and the log does not contain it"
    if log.unknown_waypoints(period_of(own.own_planner)):
        return "waypoints came by remote call, which logs do not contain"
    return None


def without_goals(config: TruckConfig) -> TruckConfig:
    """Return a configuration without planner, and without the tracker that drives to its goals."""
    return config.model_copy(update={"planner": None, "tracker": None})


def period_of(planner: PlannerConfig) -> int:
    """Return the period of the goal service's ticks (ns)."""
    return round(SECOND / planner.rate)


def unseen_ticks(config: TruckConfig, log: Survey) -> list[tuple[int, str]]:
    """Return the ticks that left nothing in the log, in order: time (ns) and service."""
    early = [(instant, "odometry") for instant in _early_ticks(config, log)]
    if config.own_planner is None or not log.goals.reports:
        return early
    return sorted(early + [(instant, "goals") for instant in log.goals.unseen_ticks(period_of(config.own_planner))])


def _early_ticks(config: TruckConfig, log: Survey) -> Iterable[int]:
    """Return the ticks of odometry before its first output: its schedule, extrapolated back.

    It publishes from its first tick after the first reading of every shaft, however late a busy computer executed that
    tick: there was none in between.
    """
    first = log.first.get(topics.ODOMETRY.name)
    if first is None:
        return ()
    started = log.first.get(topics.TRANSFORMS.name)
    begin = log.start if started is None else started.stamp
    period = round(SECOND / config.odometry.rate)
    shafts = [log.first.get(topic.name) for topic in topics.DRIVES[: len(config.devices.shafts())]]
    read = max((reading.log_time for reading in shafts if reading is not None), default=first.stamp)
    return (tick for tick in range(first.stamp - period, begin - period // 4, -period) if tick <= read)


class Chain:
    """Processes the messages of a log in order.

    Args:
        config: configuration of the robot; see ``replayable``.
        clock: clock of the running replay.
        unseen: ticks that were not recorded, see ``unseen_ticks``.
        log: data read from the log beforehand.
    """

    def __init__(self, config: TruckConfig, clock: PacedClock, unseen: Iterable[tuple[int, str]], log: Survey) -> None:
        config = replayable(config)
        self._clock = clock
        self._ready = log.ready
        self._goal_record, self._book = log.goals, ComputedPaths()
        self._calls = {} if config.own_planner is None else log.goals.calls(period_of(config.own_planner))
        self._goal_ticks = [] if config.own_planner is None else log.goals.ticks(period_of(config.own_planner))
        self._called = [one.state.stamp for one in log.goals.reports if one.sequence in self._calls]
        self._asked: Counter[str] = Counter()
        """Latest number of a request for goals, by source."""
        self._turns = RecordedTurns() if topics.SLAM.name in log.counts else None
        if self._turns is not None:
            use_delivery(clock, self._turns)
        self._answering = False
        self._answers = 0
        self.bus = Bus(clock)
        self._scans: Publisher[LaserScan] = scan_publisher(DeviceRole.LIDAR, config, self.bus)
        self._services = list(self._build(config))
        self.bus.listen(topics.SLAM, self._count_answer)
        self._paces = {service.name: Pace() for service in self._services if service.name in TICKS}
        self._unseen = deque(one for one in unseen if one[1] in self._paces)
        self._goals = next((service for service in self._services if isinstance(service, GoalService)), None)
        sensors = {topic.name for topic in topics.topics_of("sensor")}
        given = GIVEN if self._goals is None else ASKED
        self._inputs = sensors if config.tracker is None else sensors | given

    @asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Run the services while the context is open.

        Raises:
            TruckError: a service failed.
        """
        try:
            async with asyncio.TaskGroup() as tasks:
                running = [tasks.create_task(self._run(service)) for service in self._services]
                try:
                    yield
                finally:
                    if self._turns is not None:
                        self._turns.open()  # a service that ends awaits its worker
                    for task in running:
                        task.cancel()
        except* TruckError as group:
            raise first_of(group, BaseException) or group from None

    async def take(self, topic: Topic[Message], message: Message, log_time: int) -> None:
        """Deliver an input recorded at ``log_time`` (ns)."""
        await self._catch_up(log_time)
        if topic is topics.SCAN:
            assert isinstance(message, LaserScan)
            self._scans.put(message.model_copy(update={"tilt": None}) if self.stamps_tilt else message)
        else:
            if isinstance(message, GoalRequest | GoalControl):
                self._asked[message.source] = max(self._asked[message.source], message.seq)
            self.bus.hand_over(topic, message)
        await asyncio.sleep(0)  # who waits for it goes first

    async def tick(self, outputs: Sequence[LogMessage]) -> None:
        """Execute the tick that wrote ``outputs``, recorded in a row; their readers did not run in between."""
        await self._catch_up(outputs[0].log_time)
        for output in outputs:
            await self._take_unseen_turns(output.log_time)
            if output.topic == topics.GOAL.name:
                self._goal_record.replayed = output.sequence
            if (call := self._calls.get(output.sequence)) is not None and output.topic == topics.GOAL.name:
                await self._call(call, output.stamp)
            elif (service := self._writer_of(output)) in self._paces and not self._is_start(output):
                await self._paces[service].release(self._turn_of(service, output))
        await asyncio.sleep(0)
        for output in outputs:
            if output.topic == topics.PATH.name:
                await self._lead(output)

    async def answer(self, output: LogMessage) -> None:
        """Deliver the worker's result, whose first output this is; its last one states the fit of the scan."""
        await self._catch_up(output.log_time)
        if self._turns is None:
            return
        if not self._answering:
            before = self._answers
            self._turns.next()
            for _ in range(LINKS):
                if self._answers != before:
                    break
                await asyncio.sleep(0)
        self._answering = output.topic != topics.SLAM.name

    async def finish(self, end: int) -> None:
        """Let workers run until ``end`` (ns)."""
        await self._catch_up(end)

    @property
    def stamps_tilt(self) -> bool:
        """Whether scans receive the tilt of their plane here."""
        return isinstance(self._scans, TiltStamper)

    def ticks(self, output: LogMessage) -> bool:
        """Return whether a recorded message reveals a tick of a service."""
        called = output.topic == topics.PATH.name and _near(self._called, output.stamp) is not None
        return called or self._writer_of(output) in self._paces

    def takes(self, topic: str) -> bool:
        """Return whether a recorded message is an input."""
        return topic in self._inputs

    def as_computed(self, topic: Topic[Message], message: Message, payload: bytes) -> bytes:
        """Return an output's bytes as they would be if the computed path had been driven."""
        if not isinstance(message, Path):
            return payload
        computed = self._book.as_computed(message)
        return payload if computed is message else wire.encode(topic, computed)

    def _writer_of(self, output: LogMessage) -> str:
        """Return the service whose tick wrote ``output``; its topic if no tick is awaited."""
        if output.topic == topics.PATH.name and _near(self._goal_ticks, output.stamp) is not None:
            return output.topic if is_deformed(output) else GoalService.name
        if output.topic == topics.PLAN_DRIVE.name and self._goals is not None and asks_standstill(output):
            return GoalService.name
        return SERVICES.get(output.topic, output.topic)

    def _is_start(self, output: LogMessage) -> bool:
        """Return whether it is the goal service's first report, sent before its first tick."""
        return output.topic == topics.GOAL.name and output.stamp == self._goal_record.start

    def _turn_of(self, service: str, output: LogMessage) -> int:
        """Return the time of that tick (ns); on the wall clock its messages have several stamps."""
        near = _near(self._goal_ticks, output.stamp) if service == GoalService.name else None
        return output.stamp if near is None else near

    async def _call(self, call: RecordedCall, instant: int) -> None:
        """Deliver a request to the goal service at ``instant`` (ns), after all earlier ticks."""
        await asyncio.sleep(0)
        gate = self.bus.newest(topics.GATE)
        if self._goals is None or gate is None:
            return
        self._asked[call.source] += 1
        request = call.request(gate, instant, self._asked[call.source])
        with Pace().borrowed(instant), suppress(RequestRefusedError):
            self._goals.tasks.take(request)

    async def _lead(self, output: LogMessage) -> None:
        """Deliver a recorded path that was not computed, because the truck drove it."""
        for _ in range(LINKS):
            if (newest := self.bus.newest(topics.PATH)) is not None and newest.stamp >= output.stamp:
                return
            await asyncio.sleep(0)
        with suppress(TruckError):
            path: Any = output.decode()
            self.bus.hand_over(topics.PATH, path)

    def _count_answer(self, _: SlamHealth) -> None:
        self._answers += 1

    async def _catch_up(self, instant: int) -> None:
        await self._take_unseen_turns(instant)
        await self._clock.reach(instant)

    async def _take_unseen_turns(self, instant: int) -> None:
        """Execute the unseen ticks up to ``instant`` (ns); at that instant, before everything recorded."""
        while self._unseen and self._unseen[0][0] <= instant:
            due, service = self._unseen.popleft()
            await self._clock.reach(due)
            await self._paces[service].release(due)
            await asyncio.sleep(0)

    def _build(self, config: TruckConfig) -> Iterator[Service]:
        body = Body.of(config)
        places = ReplayedActors(self._clock, self._goal_record, self._book)
        compared = config.model_copy(update={"consistency": None})  # its results depend on no other output
        yield from build_estimation(
            compared, self.bus, self._clock, body, places, build_slam(compared, self.bus, self._clock)
        )
        planners = build_planners(config, self.bus, self._clock, body, places)
        wanted = TICKS.keys() if config.own_planner is None else {*TICKS, PathService.name}
        yield from (service for service in planners if service.name in wanted)

    async def _run(self, service: Service) -> None:
        pace = self._paces.get(service.name)
        if pace is not None:
            if service is self._goals and (start := self._goal_record.start) is not None:
                await self._clock.reach(start)
                pace.instant = start
            pace.adopt()
        elif (ready := self._ready.get(service.name)) is not None:
            await self._clock.reach(ready)
        await service.run(_nothing)


def _near(instants: Sequence[int], stamp: int) -> int | None:
    """Return the instant, of an increasing sequence, that a stamp belongs to (ns)."""
    at = bisect_left(instants, stamp - TOGETHER)
    return instants[at] if at < len(instants) and instants[at] <= stamp + TOGETHER else None


def _nothing() -> None:
    """Ignore readiness."""
