"""The services of a robot that compute from sensors, put together once more without its devices."""

import asyncio
from collections.abc import AsyncIterator, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Any, Final

from monstertruck_estimation.odometry import OdometryConfig
from monstertruck_estimation.scan_tilt import TiltStamper
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import NotFoundError, TruckError
from monstertruck_runtime.ports import Publisher
from monstertruck_runtime.service import Service
from monstertruck_schemas import topics
from monstertruck_schemas.base import Message
from monstertruck_schemas.health import SlamHealth
from monstertruck_schemas.sensor import LaserScan
from monstertruck_schemas.topics import Topic
from monstertruckd.autonomy import Body, build_estimation, build_planners
from monstertruckd.bus.local import Bus
from monstertruckd.config.truck import PlacementConfig, TruckConfig
from monstertruckd.devices import scan_publisher
from monstertruckd.logs import LogMessage
from monstertruckd.replay_check.pace import Pace, PacedClock, RecordedTurns
from monstertruckd.replay_check.recorded import Survey
from monstertruckd.workers.agenda import use_agenda
from monstertruckd.workers.placement import Places
from monstertruckd.workers.remote import RemoteDesk

TICKS: Final[Mapping[str, tuple[str, ...]]] = {
    "transforms": (topics.TRANSFORMS.name,),
    "odometry": (topics.ODOMETRY.name, topics.FUSION.name),
    "levelling": (topics.PLAN_STABILISER.name,),
    "tracker": (topics.PLAN_DRIVE.name, topics.TRACKER.name),
}
"""Services that read and publish without waiting in between, and the outputs that show when they did."""

WORKER: Final = (topics.SLAM.name, topics.SCAN_MOTION.name, topics.MAP.name, topics.MAP_TILES.name)
"""Outputs of the estimation worker, which come when it is done."""

LINKS: Final = 16
"""Turns of the loop after which a worker's answer has certainly been told."""

GIVEN: Final = frozenset({topics.PATH.name, topics.GATE.name})
"""Not computed again, but read by what is."""


def replayable(config: TruckConfig) -> TruckConfig:
    """The part of a configuration that is computed again: nothing is saved, drawn, planned or sent elsewhere.

    Raises:
        NotFoundError: the saved map it localises in is not there.
    """
    slam = config.slam
    if slam is not None:
        if slam.mode == "localisation" and (slam.map is None or not slam.map.is_dir()):
            raise NotFoundError(f"slam.map: {slam.map}: no such folder; the log does not hold it")
        slam = slam.model_copy(update={"save": None})
    return config.model_copy(
        update={
            "slam": slam,
            "path": None,
            "map": None,
            "planner": None,
            "tracker": None if config.planner is not None else config.tracker,
            "placement": PlacementConfig(),
        }
    )


def outputs_of(config: TruckConfig) -> frozenset[str]:
    """Topics a replay of this configuration computes again."""
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
    return frozenset(names)


@dataclass(frozen=True, slots=True)
class Early:
    """Ticks before a service's first output: it reads already, but has nothing to tell yet."""

    service: str
    instants: tuple[int, ...]


def early_ticks(config: TruckConfig, log: Survey) -> Early:
    """Of odometry: its grid, continued back from its first output to the start of the services."""
    first = log.first.get(topics.ODOMETRY.name)
    if first is None:
        return Early("odometry", ())
    started = log.first.get(topics.TRANSFORMS.name)
    begin = log.start if started is None else started.stamp
    period = round(SECOND / config.odometry.rate)
    back = range(first.stamp - period, begin - period // 4, -period)
    return Early("odometry", tuple(reversed(back)))


class Chain:
    """Takes the messages of a log in their order.

    Args:
        config: of the robot; see ``replayable``.
        clock: of the running replay.
        early: ticks nobody recorded.
        log: what the log told beforehand.
    """

    def __init__(self, config: TruckConfig, clock: PacedClock, early: Early, log: Survey) -> None:
        config = replayable(config)
        self._clock = clock
        self._ready = log.ready
        self._turns = RecordedTurns() if topics.SLAM.name in log.counts else None
        if self._turns is not None:
            use_agenda(clock, self._turns)
        self._answering = False
        self._answers = 0
        self.bus = Bus(clock)
        self._scans: Publisher[LaserScan] = scan_publisher(config, self.bus)
        self._services = list(self._build(config))
        self.bus.listen(topics.SLAM, self._count_answer)
        self._paces = {service.name: Pace() for service in self._services if service.name in TICKS}
        self._by_topic = {name: self._paces[service] for service in self._paces for name in TICKS[service]}
        self._early = list(reversed(early.instants)) if early.service in self._paces else []
        self._early_pace = self._paces.get(early.service)
        sensors = {topic.name for topic in topics.topics_of("sensor")}
        self._inputs = sensors if config.tracker is None else sensors | GIVEN

    @asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """The services run while the context lasts.

        Raises:
            TruckError: a service failed.
        """
        try:
            async with asyncio.TaskGroup() as tasks:
                running = [tasks.create_task(self._run(service)) for service in self._services]
                yield
                if self._turns is not None:
                    self._turns.open()  # a service that ends awaits its worker
                for task in running:
                    task.cancel()
        except* TruckError as group:
            raise _first(group) from None

    async def take(self, topic: Topic[Message], message: Message, log_time: int) -> None:
        """Hand over an input, recorded at ``log_time``, ns."""
        await self._catch_up(log_time)
        if topic is topics.SCAN:
            assert isinstance(message, LaserScan)
            self._scans.put(message.model_copy(update={"tilt": None}) if self.stamps_tilt else message)
        else:
            self.bus.hand_over(topic, message)
        await asyncio.sleep(0)  # who waits for it goes first

    async def tick(self, outputs: Sequence[LogMessage]) -> None:
        """Whoever wrote ``outputs``, recorded in a row, had its turn then; who reads them did not come in between."""
        await self._catch_up(outputs[0].log_time)
        for output in outputs:
            if (pace := self._by_topic.get(output.topic)) is not None:
                await pace.release(output.stamp)
        await asyncio.sleep(0)

    async def answer(self, output: LogMessage) -> None:
        """The worker's result counted now, as its first output shows; its last one is how well the scan fitted."""
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
        """Let workers go on until ``end``, ns."""
        await self._catch_up(end)

    @property
    def stamps_tilt(self) -> bool:
        """Whether scans get the tilt of their plane here."""
        return isinstance(self._scans, TiltStamper)

    def ticks(self, topic: str) -> bool:
        """Whether a recorded message shows when a service had its turn."""
        return topic in self._by_topic

    def takes(self, topic: str) -> bool:
        """Whether a recorded message is an input."""
        return topic in self._inputs

    def _count_answer(self, _: SlamHealth) -> None:
        self._answers += 1

    async def _catch_up(self, instant: int) -> None:
        while self._early and self._early[-1] < instant and self._early_pace is not None:
            await self._clock.reach(self._early[-1])
            await self._early_pace.release(self._early.pop())
            await asyncio.sleep(0)
        await self._clock.reach(instant)

    def _build(self, config: TruckConfig) -> Iterator[Service]:
        body = Body.of(config)
        yield from build_estimation(config, self.bus, self._clock, body)
        places = Places(self._clock, RemoteDesk())
        planners = build_planners(config, self.bus, self._clock, body, places)
        yield from (service for service in planners if service.name in TICKS)

    async def _run(self, service: Service) -> None:
        pace = self._paces.get(service.name)
        if pace is not None:
            pace.adopt()
        elif (ready := self._ready.get(service.name)) is not None:
            await self._clock.reach(ready)
        await service.run(_nothing)


def _nothing() -> None:
    """Nobody waits for a service to be ready."""


def _first(group: BaseExceptionGroup[Any]) -> BaseException:
    error: BaseException = group
    while isinstance(error, BaseExceptionGroup):
        error = error.exceptions[0]
    return error
