"""Seeded drills: many faults one after another on one truck, drawn at random, judged by an observer of its own.

A drill is cut into legs. Each leg is a truck of its own on a virtual clock and draws from its own stream of the
seed, so that legs can run side by side and still give the same report.
"""

import asyncio
import logging
from collections.abc import AsyncIterator, Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import asynccontextmanager
from dataclasses import asdict, dataclass
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np

from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.mailbox import fifo, latest
from monstertruck_schemas import topics
from monstertruck_schemas.event import Event, Severity
from monstertruck_schemas.health import HealthTable, ServiceState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Order
from monstertruck_schemas.state import GateMode, GateState
from monstertruck_sim.faults import Fault, Kind, Menu, Site, happen
from monstertruckd.tools.drill.observer import STOPS_WITHIN, Observer, Violation
from monstertruckd.tools.drill.stages import with_overlay
from monstertruckd.tools.simulation.config import SimulatedTruckConfig
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.rig import VirtualRig

LEG: Final = 25
"""Faults of one truck."""
PATIENCE: Final = 15.0
"""Seconds after which a service that is not back is stuck."""
RECOVERS_WITHIN: Final = 4.0
"""Seconds within which everything should be back: the goal of a lost hub."""
CRUISE: Final = 0.1
"""True speed of a truck that drives, m/s."""
QUIET: Final = frozenset({Reason.OK, Reason.DISARMED, Reason.CLIPPED, Reason.OBSTACLE_SLOW})
"""Reasons that explain nothing."""
FOR_GOOD: Final = frozenset({"recorder"})
"""Services that a fault may end for the rest of a run: driving goes on without."""
DEADMAN: Final[dict[str, Any]] = {
    "map": None,
    "devices": {"steering": {"driver": {"deadman_channel": 2}}},
    "sim": {"deadman_wired": True, "servo_timeout": 0.3},
}
"""The deadman line is wired: without it a truck whose drive cannot be reached drives on."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What one fault led to. Seconds count from the fault, ``recovered_s`` from its end; None: it did not happen."""

    fault: str
    kind: Kind
    must_stop: bool
    reason: Reason | None = None
    """First one that gate or services gave."""
    stop_bytes_s: float | None = None
    standstill_s: float | None = None
    metres: float = 0.0
    """Truly travelled to standstill, or until the fault's end."""
    recovered_s: float | None = None
    """All services ready, and the truck drives again when armed; 0: it never lacked anything."""
    stuck: tuple[str, ...] = ()
    """Services that did not come back, or what keeps the truck from driving."""
    blocked: bool = False
    """The truck is whole, but stands before something: it has to be set back by hand."""
    violations: tuple[Violation, ...] = ()

    @property
    def reaction(self) -> str:
        """In a word."""
        if self.violations:
            return "UNSAFE"
        if self.stuck:
            return "stuck"
        if self.blocked:
            return "blocked"
        return "drove on" if self.standstill_s is None else "stopped"

    @property
    def score(self) -> int:
        """100: safe and soon back; 80: safe, late; 50: safe, not back; 0: unsafe."""
        if self.violations:
            return 0
        if self.stuck or self.recovered_s is None:
            return 50
        return 100 if self.recovered_s <= RECOVERS_WITHIN else 80


@dataclass(frozen=True, slots=True)
class Report:
    """A whole drill."""

    seed: int
    outcomes: tuple[Outcome, ...]

    @property
    def unsafe(self) -> int:
        """Faults with unsafe motion."""
        return sum(bool(outcome.violations) for outcome in self.outcomes)

    @property
    def stuck(self) -> int:
        """Faults after which something did not come back."""
        return sum(bool(outcome.stuck) for outcome in self.outcomes)

    @property
    def score(self) -> float:
        """Mean, 0..100."""
        return float(np.mean([outcome.score for outcome in self.outcomes])) if self.outcomes else 0.0

    @property
    def blocked(self) -> int:
        """Faults after which the truck stood before something."""
        return sum(outcome.blocked for outcome in self.outcomes)

    def recovery(self, percent: float) -> float | None:
        """Percentile of the recoveries, s, of those faults after which anything had to recover."""
        times = [outcome.recovered_s for outcome in self.outcomes if outcome.recovered_s]
        return float(np.percentile(times, percent)) if times else None

    def as_json(self) -> dict[str, Any]:
        """Everything, for machines."""
        rows = [{**asdict(outcome), "reaction": outcome.reaction, "score": outcome.score} for outcome in self.outcomes]
        return {**self.figures(), "outcomes": rows}

    def figures(self) -> dict[str, Any]:
        """The sums."""
        return {
            "seed": self.seed,
            "faults": len(self.outcomes),
            "unsafe": self.unsafe,
            "stuck": self.stuck,
            "blocked": self.blocked,
            "score": round(self.score, 2),
            "recovery_p50_s": self.recovery(50),
            "recovery_p99_s": self.recovery(99),
        }


@dataclass(frozen=True, slots=True)
class Leg:
    """One truck's share of a drill; can be sent to another process."""

    config: dict[str, Any]
    """Of the simulated truck, as plain values."""
    seed: int
    number: int
    count: int


class Drill:
    """``count`` faults of one seed.

    Args:
        seed: everything random comes from it.
        count: how many faults.
        config: the simulated truck.
        leg: faults of one truck.
    """

    def __init__(self, seed: int, count: int, config: SimulatedTruckConfig, *, leg: int = LEG) -> None:
        self.seed = seed
        self.count = count
        self._config = config
        self._leg = leg

    def legs(self) -> list[Leg]:
        """The parts that can run side by side."""
        starts = range(0, self.count, self._leg)
        return [
            Leg(self._config.model_dump(), self.seed, number, min(self._leg, self.count - start))
            for number, start in enumerate(starts)
        ]

    def run(self, *, jobs: int = 1, tell: Callable[[list[Outcome]], None] = lambda _: None) -> Report:
        """Run all of it.

        Args:
            jobs: processes; 1 = this one alone.
            tell: gets the outcomes of each finished leg.
        """
        outcomes: list[Outcome] = []
        for part in self._parts(jobs):
            tell(part)
            outcomes += part
        return Report(self.seed, tuple(outcomes))

    def _parts(self, jobs: int) -> Iterator[list[Outcome]]:
        legs = self.legs()
        if jobs == 1:
            yield from map(run_leg, legs)
            return
        with ProcessPoolExecutor(min(jobs, max(1, len(legs)))) as pool:
            yield from pool.map(run_leg, legs)


def run_leg(leg: Leg) -> list[Outcome]:
    """All faults of one leg, on the virtual clock."""
    quiet = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    try:
        with TemporaryDirectory(prefix="monstertruck-") as folder:
            return run_virtual(lambda clock: _Driver(leg, clock, folder).run())
    finally:
        logging.disable(quiet)


class _Driver:
    """Drives, breaks, mends and drives again."""

    def __init__(self, leg: Leg, clock: VirtualClock, folder: str) -> None:
        self._clock = clock
        self._rng = np.random.default_rng([leg.seed, leg.number])
        base = with_overlay(SimulatedTruckConfig.model_validate(leg.config), DEADMAN)
        self._faults = _draw(Menu(base.devices, records=base.recorder is not None), leg.count, self._rng)
        records = any(fault.kind is Kind.DISK_FULL for fault in self._faults)
        recorder = base.recorder.model_copy(update={"directory": folder}) if records and base.recorder else None
        seed = int(self._rng.integers(2**31))
        self._config = base.model_copy(
            update={"recorder": recorder, "sim": base.sim.model_copy(update={"seed": seed, "drill": None})}
        )
        self._outcomes: list[Outcome] = []

    async def run(self) -> list[Outcome]:
        """A new truck wherever the last one got stuck."""
        left = self._faults
        while left:
            before = len(self._outcomes)
            async with _Truck.on_road(self._config, self._clock) as truck:
                for fault in left:
                    outcome = await truck.suffer(fault, float(self._rng.uniform(0.1, 0.7)))
                    if outcome is None:
                        break
                    self._outcomes.append(outcome)
                    if outcome.stuck or outcome.blocked:
                        break
            done = len(self._outcomes) - before
            if not done:  # a new truck cannot even be driven
                self._outcomes.append(Outcome(left[0].name, left[0].kind, left[0].stops, stuck=("drive",)))
                done = 1
            left = left[done:]
        return self._outcomes


def _draw(menu: Menu, count: int, rng: np.random.Generator) -> list[Fault]:
    """The faults of a leg; a disk fills up once."""
    faults: list[Fault] = []
    full = frozenset[Kind]()
    for _ in range(count):
        faults.append(menu.draw(rng, without=full))
        if faults[-1].kind is Kind.DISK_FULL:
            full = frozenset({Kind.DISK_FULL})
    return faults


class _Truck:
    """One rig, its operator, its observer."""

    def __init__(self, rig: VirtualRig) -> None:
        self.rig = rig
        self.observer = Observer(rig.config, rig.world, rig.ports, rig.clock)
        self.site = Site(rig.config.sim, rig.config.devices, rig.robot, rig.computer, rig.clock, rig.daemon.recorder)
        bus = rig.bus
        self.operator = LocalOperator(bus, rig.clock)
        self._told = [bus.subscribe(topic, fifo(1 << 16)) for topic in (topics.EVENT, topics.GATE, topics.HEALTH)]
        self._state = bus.subscribe(topics.GATE, latest())
        self._table = bus.subscribe(topics.HEALTH, latest())

    @classmethod
    @asynccontextmanager
    async def on_road(cls, config: SimulatedTruckConfig, clock: VirtualClock) -> AsyncIterator["_Truck"]:
        """A truck whose services are ready."""
        rig = VirtualRig(config, clock)
        truck = cls(rig)
        async with rig.running():
            watching = asyncio.create_task(truck.observer.run(), name="observer")
            try:
                await truck.waits(lambda: not truck.held(), PATIENCE)
                yield truck
            finally:
                watching.cancel()
                await asyncio.wait([watching])

    async def suffer(self, fault: Fault, cruise: float) -> Outcome | None:
        """Drive, have the fault, mend it, come back. None: the truck could not be driven before it."""
        clock, observer = self.rig.clock, self.observer
        if not await self._drive():
            return None
        await clock.sleep(cruise)
        self._reasons()
        observer.begin(stops=fault.stops)
        await happen(fault.start, self.site)
        await clock.sleep(fault.hold)
        stop_bytes, metres = observer.stop_bytes_after(), observer.metres()
        observer.end_fault()
        observer.disarm()
        await self._order(Order.DISARM)
        await clock.sleep(STOPS_WITHIN / 2)
        standstill = observer.standstill_after()
        reason = next((r for _, reasons in self._reasons() for r in reasons), None)
        mended = clock.now()
        await happen(fault.end, self.site)
        await self.waits(lambda: not self.held(), PATIENCE)
        recovered = (clock.now() - mended) / SECOND
        held = self.held()
        if not held and not await self._drive():
            held = tuple(self._state.latest.reasons) if self._state.latest is not None else ("gate",)
        blocked = Reason.OBSTACLE_STOP in held and self.observer.before_something()
        if blocked:
            held = ()
        lost = standstill is not None and standstill > fault.hold  # it stood only because it was disarmed
        return Outcome(
            fault.name,
            fault.kind,
            fault.stops,
            reason=reason,
            stop_bytes_s=None if lost else stop_bytes,
            standstill_s=None if lost else standstill,
            metres=metres,
            recovered_s=None if held else recovered,
            stuck=held,
            blocked=blocked,
            violations=observer.violations(),
        )

    # Conditions

    def held(self) -> tuple[str, ...]:
        """Services that are not ready and reasons that keep the truck from being armed."""
        table, state = self._table.latest, self._state.latest
        if table is None or state is None:
            return ("daemon",)
        down = [r.name for r in table.services if r.state is not ServiceState.READY and r.name not in FOR_GOOD]
        moving = state.mode is GateMode.DRIVING
        why = () if moving else tuple(reason for reason in state.reasons if reason is not Reason.DISARMED)
        return (*down, *why)

    async def waits(self, condition: Callable[[], bool], seconds: float, order: Order | None = None) -> bool:
        """Whether the condition comes true in time; gives the order again and again."""
        end = self.rig.clock.now() + round(seconds * SECOND)
        while self.rig.clock.now() < end and not self.rig.daemon_ended:
            if condition():
                return True
            if order is not None and self._state.latest is not None and not self._state.latest.mode.active:
                await self._order(order)
            await self.rig.clock.sleep(0.02)
        return condition()

    async def _drive(self) -> bool:
        """Arm and come to speed."""
        self.observer.arm()
        return await self.waits(lambda: abs(self.observer.speed) > CRUISE, PATIENCE, Order.ARM)

    async def _order(self, order: Order) -> None:
        if not self.rig.daemon_ended:
            await self.operator.order(order)

    def _reasons(self) -> list[tuple[int, tuple[Reason, ...]]]:
        """What gate, services and events named since the last call, in order."""
        told: list[tuple[int, tuple[Reason, ...]]] = []
        for queue in self._told:
            told += [(message.stamp, tuple(_named(message))) for message in queue.drain()]
        return sorted(told, key=lambda row: row[0])


def _named(message: Event | GateState | HealthTable) -> Iterator[Reason]:
    match message:
        case Event():
            named: Iterable[Reason] = (message.reason,) if message.severity is not Severity.INFO else ()
        case GateState():
            named = message.reasons
        case HealthTable():
            named = (row.reason for row in message.services if row.name not in FOR_GOOD)
    yield from (reason for reason in named if reason not in QUIET)
