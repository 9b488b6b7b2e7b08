"""One runaway in a whole daemon on the virtual clock, judged by the simulated world alone."""

import asyncio
import math
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from functools import cache
from typing import Any, Final, NamedTuple

from benchmarks import ROOT
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import RequestRefusedError, TruckError
from monstertruck_runtime.mailbox import fifo
from monstertruck_schemas import topics
from monstertruck_schemas.event import Event, Stop
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import DriveRequest, Order
from monstertruck_schemas.state import GateMode, GateState
from monstertruckd.config.load import load_config
from monstertruckd.tools.drill.random_drill import wired
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

CONFIGS: Final = ROOT / "configs"
CRUISE: Final = 1.2
"""Seconds of driving before a fault."""
WATCHED: Final = 3.0
"""Seconds watched after it."""
STILL: Final = 0.01
"""Speed below which a robot stands, m/s."""
STEP: Final = 0.01
"""Seconds between two looks at the world."""
QUIET: Final[dict[str, Any]] = {"map": None, "slam": None, "monitors": {}, "path": None}
"""What these trials do without."""


class Moment(StrEnum):
    """Event that ends, or does not end, the robot's motion."""

    DRIVING = "while it drives"
    ARMED = "armed, at rest"
    DISARMED = "disarmed"
    ESTOP = "emergency stop"
    STOP = "stop"
    DISARM = "disarm"
    LEASE = "lease lost"
    END = "end of the daemon"


@dataclass(frozen=True, slots=True)
class Robot:
    """A robot of the trials.

    Args:
        config: file below ``configs``, without its suffix.
        role: role of the disobeying controller.
        speed: speed before the fault, m/s.
        creep: motor speed when creeping forward, rpm with the controller's sign.
        run: motor speed when running away, likewise.
        overlay: changes of the configuration.
    """

    config: str
    role: str = "drive"
    speed: float = 0.15
    creep: float = -8000.0
    run: float = -17_000.0
    overlay: tuple[tuple[str, Any], ...] = ()


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of one trial; seconds and metres count from ``Trial.began``."""

    speed: float
    """True speed when the fault began, m/s."""
    event: float | None
    """When ``uncommanded_motion`` was reported, s; None = never."""
    boxed: float | None
    """When its stop with a black box was published, s."""
    safe: float | None
    """When the world showed standstill for good, or all power stages off, s."""
    travelled: float
    """Distance travelled until the world showed standstill, m."""
    mode: GateMode
    stopping: tuple[float, ...]
    """When ``state/gate`` showed ``stopping`` first and last, s."""
    answer: str
    """How the order was answered, and after how many seconds."""
    powered: bool
    """A power stage is on at the end."""


@cache
def _base(name: str) -> SimulatedTruckConfig:
    return load_config(CONFIGS / f"{name}.yaml", SimulatedTruckConfig)[0]


def configured(robot: Robot, *, line: bool = False, seed: int = 0) -> SimulatedTruckConfig:
    """Return the configuration of a trial."""
    base = _base(robot.config)
    known = {name: value for name, value in QUIET.items() if hasattr(base, name)}
    config = with_overlay(base, {**known, "recorder": None, "sim": {"seed": seed}})
    for key, value in robot.overlay:
        config = with_overlay(config, {key: value})
    return wired(config) if line else config


class Look(NamedTuple):
    """State of the world at one instant."""

    at: float
    """S since the beginning."""
    x: float
    """M."""
    y: float
    """M."""
    speed: float
    """M/s."""
    powered: bool
    """A motor has its power stage on."""


class Trial:
    """A driving robot with a fault.

    Args:
        rig: the robot.
        robot: its description.
    """

    def __init__(self, rig: VirtualRig, robot: Robot) -> None:
        self.rig, self.robot = rig, robot
        self.clock: VirtualClock = rig.clock
        self.operator = LocalOperator(rig.daemon, rig.clock)
        self.states: list[GateState] = []
        self.events: list[Event] = []
        self.stops: list[Stop] = []
        bus = rig.bus
        self._gates = bus.subscribe(topics.GATE, fifo(8192))
        self._reports = bus.subscribe(topics.EVENT, fifo(8192))
        self._trips = bus.subscribe(topics.STOP, fifo(512))
        self._requests: asyncio.Task[None] | None = None
        self.path: list[Look] = []

    def listen(self) -> None:
        """Process received messages."""
        self.states += self._gates.drain()
        self.events += self._reports.drain()
        self.stops += self._trips.drain()

    def forget(self) -> None:
        """Discard received messages."""
        self.listen()
        for kept in (self.states, self.events, self.stops):
            kept.clear()  # type: ignore[attr-defined]

    async def arm(self) -> None:
        """Arm as soon as possible.

        Raises:
            TimeoutError: not possible within 20 s.
        """
        async with self.clock.deadline(20.0):
            while True:
                with suppress(RequestRefusedError):
                    await self.operator.order(Order.ARM, hold=True)
                    return
                await self.clock.sleep(0.1)

    async def drive(self, speed: float) -> None:
        """Drive straight ahead from now on; 0: stay armed at rest."""
        self._requests = asyncio.create_task(self._request(speed))
        await self.clock.sleep(CRUISE)

    async def let_go(self) -> None:
        """Stop sending requests."""
        if self._requests is not None:
            self._requests.cancel()
            await asyncio.wait([self._requests])
            self._requests = None

    async def _request(self, speed: float) -> None:
        while True:
            header = await self.operator.header(0.25)
            self.rig.bus.inject(topics.REQ_DRIVE, DriveRequest(**header, speed=speed, front=0.0))
            await self.clock.sleep(0.05)

    async def order(self, order: Order) -> str:
        """Send an order; return the answer."""
        began = self.clock.now()
        try:
            state = await self.operator.order(order)
            answer = state.mode_text
        except TruckError as error:
            answer = str(error)
        return f"{answer} after {(self.clock.now() - began) / SECOND:.1f} s"

    async def watch(self, seconds: float, began: int) -> None:
        """Observe the world for a while."""
        end = self.clock.now() + round(seconds * SECOND)
        while self.clock.now() < end:
            truth = self.rig.world.truth(self.clock.now())
            powered = any(self.rig.world.powered(self.clock.now()))
            self.path.append(Look((self.clock.now() - began) / SECOND, truth.x, truth.y, truth.v, powered))
            await self.clock.sleep(STEP)


async def _run(clock: VirtualClock, robot: Robot, fault: str, moment: Moment, *, line: bool, seed: int) -> Outcome:
    rig = VirtualRig(configured(robot, line=line, seed=seed), clock)
    async with rig.running():
        trial = Trial(rig, robot)
        await trial.arm()
        await clock.sleep(0.01 * (seed % 7))
        if moment is Moment.DISARMED:
            await trial.order(Order.DISARM)
        else:
            await trial.drive(0.0 if moment is Moment.ARMED else robot.speed)
        trial.forget()
        began = clock.now()
        for one in fault.split("; "):
            rig.context.command(robot.role, one)
        answering: asyncio.Task[str] | None = None
        order = {Moment.ESTOP: Order.ESTOP, Moment.STOP: Order.STOP, Moment.DISARM: Order.DISARM}.get(moment)
        if order is not None:
            await trial.let_go()
            answering = asyncio.create_task(trial.order(order))
        elif moment is Moment.LEASE:
            await trial.let_go()
        elif moment is Moment.END:
            await trial.let_go()
            await asyncio.wait(
                [asyncio.create_task(rig.end_daemon()), asyncio.create_task(trial.watch(WATCHED, began))]
            )
        if moment is not Moment.END:
            await trial.watch(WATCHED, began)
        await trial.let_go()
        answer = "" if answering is None else await answering
        trial.listen()
        return _outcome(trial, began, answer)


def _outcome(trial: Trial, began: int, answer: str) -> Outcome:
    def since(stamp: int) -> float:
        return (stamp - began) / SECOND

    events = [since(event.stamp) for event in trial.events if event.reason is Reason.UNCOMMANDED_MOTION]
    boxes = [since(stop.stamp) for stop in trial.stops if stop.reason is Reason.UNCOMMANDED_MOTION]
    moving = [i for i, look in enumerate(trial.path) if abs(look.speed) > STILL]
    driven = [i for i in moving if trial.path[i].powered]
    last, over = (indices[-1] + 1 if indices else 0 for indices in (moving, driven))
    safe = trial.path[over].at if over < len(trial.path) else None
    travelled = sum(
        math.hypot(there.x - here.x, there.y - here.y)
        for here, there in zip(trial.path[:last], trial.path[1 : last + 1], strict=False)
    )
    shown = [since(state.stamp) for state in trial.states if state.stopping]
    return Outcome(
        speed=trial.path[0].speed if trial.path else 0.0,
        event=min(events, default=None),
        boxed=min(boxes, default=None),
        safe=safe,
        travelled=travelled,
        mode=trial.states[-1].mode if trial.states else GateMode.DISARMED,
        stopping=(shown[0], shown[-1]) if shown else (),
        answer=answer,
        powered=any(trial.rig.world.powered(trial.clock.now())),
    )


def run(robot: Robot, fault: str, moment: Moment, *, line: bool = False, seed: int = 0) -> Outcome:
    """Run one trial.

    Args:
        robot: robot of the trial.
        fault: console commands to its controller, joined by "; ".
        moment: event at the time of the fault.
        line: whether the deadman line is wired.
        seed: seed of the simulation's noise.
    """
    return run_virtual(lambda clock: _run(clock, robot, fault, moment, line=line, seed=seed))


def with_speeds(robot: Robot, fault: str) -> str:
    """Replace ``CREEP``, ``RUN`` and ``BACK`` in a fault by the robot's motor speeds."""
    speeds = {"CREEP": robot.creep, "RUN": robot.run, "BACK": -robot.creep}
    return " ".join(f"{speeds[word]:g}" if word in speeds else word for word in fault.split(" "))
