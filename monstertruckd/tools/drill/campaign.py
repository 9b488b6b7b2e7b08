"""A drill of families: any signal of a device may be falsified, any command ignored; judged by the world.

An operator drives at random, in both directions and with all ways to steer, or a tracker follows its path. A trial has
one fault, or two, the second while the robot recovers from the first. Faults are drawn from the families that the
robot's own devices have (``monstertruck_sim.families``) and from the catalog of what is known to happen.

As in ``random_drill`` a drill consists of legs, each with a truck, a clock and a stream of the seed of its own.
"""

import asyncio
import math
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
from pydantic import TypeAdapter

from monstertruck_planners.steps import TRACKING
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Order
from monstertruck_sim.families import families
from monstertruck_sim.faults import Fault, FaultCatalog, FaultKind, SimContext, apply
from monstertruckd.config.device_safety import packs
from monstertruckd.tools.drill.legs import DrillLeg, check_version, leg_alone, run_legs, truck_of_leg
from monstertruckd.tools.drill.observer import Violation
from monstertruckd.tools.drill.random_drill import (
    OBSTACLE,
    QUIET,
    RECOVERY_LIMIT,
    TRACKER_IN_WORKER,
    check_drivable,
    reasons_of,
    unguarded,
    wired,
)
from monstertruckd.tools.drill.truck import DrillTruck, Wanderer
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay

LEG: Final = 20
"""Trials of one truck."""
MOVES: Final = 0.03
"""True speed of a robot that drives, m/s; slower than it backs into ground that it knows little of."""
BY_HAND: Final[dict[str, Any]] = {
    "explorer": None,
    "planner": None,
    "tracker": None,
    "path": None,
}
"""Overlay of a truck that an operator drives."""


@dataclass(frozen=True, slots=True)
class Trial:
    """What is to be tried: one fault, or two."""

    faults: tuple[Fault[SimContext], ...]
    families: tuple[str, ...]
    """Of the faults: names without their drawn numbers."""
    backwards: bool
    """The operator begins in reverse."""
    between: float
    """Seconds from the end of the first to the second."""


@dataclass(frozen=True, slots=True)
class TrialOutcome:
    """What came of one trial; seconds count from the first fault unless said otherwise."""

    number: int
    """In the drill, from 0 on."""
    faults: tuple[str, ...]
    families: tuple[str, ...]
    followed: bool
    """The tracker drove."""
    reverse: bool
    """It drove backwards when the first fault began."""
    reason: Reason | None = None
    """First one that gate, services or events gave for it."""
    reason_s: float | None = None
    travelled: float = 0.0
    """m, from the order to disarm or stop on."""
    standstill_s: float | None = None
    """From that order."""
    recovered_s: float | None = None
    """From the end of the last fault until everything is ready."""
    stuck: tuple[str, ...] = ()
    """Services that did not recover, or reasons that keep it from driving."""
    violations: tuple[Violation, ...] = ()
    confirmed_contacts: int = 0
    """Contacts while the operator confirmed unseen ground."""

    @property
    def unsafe(self) -> bool:
        """Whether the judge found anything."""
        return bool(self.violations)

    @property
    def contact(self) -> bool:
        """Whether it ran into something."""
        return any(violation.rule == "contact" for violation in self.violations)


OUTCOMES: Final = TypeAdapter(list[TrialOutcome])


@dataclass(frozen=True, slots=True)
class CampaignReport:
    """A drill of families, or a part of one."""

    seed: int
    outcomes: tuple[TrialOutcome, ...]

    @property
    def unsafe(self) -> int:
        """Trials with unsafe motion."""
        return sum(outcome.unsafe for outcome in self.outcomes)

    @property
    def stuck(self) -> int:
        """Trials after which the robot did not recover."""
        return sum(bool(outcome.stuck) for outcome in self.outcomes)

    def figures(self) -> dict[str, Any]:
        """The totals."""
        recovered = [o.recovered_s for o in self.outcomes if o.recovered_s]
        return {
            "seed": self.seed,
            "trials": len(self.outcomes),
            "pairs": sum(len(o.faults) > 1 for o in self.outcomes),
            "reverse": sum(o.reverse for o in self.outcomes),
            "families": len({family for o in self.outcomes for family in o.families}),
            "unsafe": self.unsafe,
            "contacts": sum(o.contact for o in self.outcomes),
            "confirmed_contacts": sum(o.confirmed_contacts for o in self.outcomes),
            "stuck": self.stuck,
            "recovery_p50_s": float(np.percentile(recovered, 50)) if recovered else None,
            "recovery_p99_s": float(np.percentile(recovered, 99)) if recovered else None,
            "travelled_max_m": max((o.travelled for o in self.outcomes), default=0.0),
        }

    def as_json(self) -> dict[str, Any]:
        """Figures and outcomes as plain data."""
        return self.figures() | {"outcomes": [asdict(outcome) for outcome in self.outcomes]}


class Campaign:
    """A drill of families.

    Args:
        seed: everything random comes from it.
        count: of trials, those before ``first`` included.
        config: the simulated robot.
        first: trials before it are left out; a multiple of ``LEG``.

    Raises:
        InputError: nothing drives the robot, or ``first`` is no beginning of a leg.
    """

    def __init__(self, seed: int, count: int, config: SimulatedTruckConfig, *, first: int = 0) -> None:
        check_drivable(config)
        if first % LEG or not 0 <= first < count:
            raise InputError(f"from trial {first}: expected a multiple of {LEG} below {count}")
        self.seed = seed
        self.count = count
        self._first = first
        self._config = config

    def legs(self) -> list[DrillLeg]:
        """The parts that can run in parallel."""
        config = self._config.model_dump()
        starts = range(self._first, self.count, LEG)
        return [DrillLeg(config, self.seed, start // LEG, min(LEG, self.count - start)) for start in starts]

    def run(
        self,
        *,
        jobs: int = 1,
        cluster: str | None = None,
        resume: Path | None = None,
        report: Callable[[list[TrialOutcome]], None] = lambda _: None,
    ) -> CampaignReport:
        """Run all of it; arguments and errors as of ``run_legs``. Files of several parts add up when joined."""
        return CampaignReport(self.seed, run_legs(self.legs(), run_trials, OUTCOMES, jobs, cluster, resume, report))


def run_trials(leg: DrillLeg) -> list[TrialOutcome]:
    """All trials of one leg, on the virtual clock.

    Raises:
        InputError: it comes from another version of the program.
    """
    check_version(leg)
    with leg_alone(), TemporaryDirectory(prefix="monstertruck-") as folder:
        return run_virtual(lambda clock: _Leg(leg, clock, folder).run())


class _Leg:
    """Trial by trial on one truck; one that is stuck or has run into something is replaced by a new one."""

    def __init__(self, leg: DrillLeg, clock: VirtualClock, folder: str) -> None:
        self._leg = leg
        self._clock = clock
        self._rng = np.random.default_rng([leg.seed, leg.number, 1])
        base = wired(SimulatedTruckConfig.model_validate(leg.config))
        driven = base.tracker is not None and (base.path is not None or base.planner is not None)
        # of so many trucks one is driven by its tracker, along its path or to goals of its planner, where it has one
        follows = 4
        self._follows = driven and leg.number % follows == follows - 1
        self._workers: tuple[str, ...] = ()
        if not self._follows:
            base = with_overlay(base, BY_HAND)
        elif leg.number // follows % 2:
            base, self._workers = with_overlay(base, TRACKER_IN_WORKER), (TRACKING,)
        records = None if leg.number % 5 else folder  # one of so many trucks records, and its disk may become full
        self._config = truck_of_leg(base, int(self._rng.integers(2**31)), records)
        self._outcomes: list[TrialOutcome] = []

    async def run(self) -> list[TrialOutcome]:
        """All trials."""
        while len(self._outcomes) < self._leg.count:
            before = len(self._outcomes)
            wander, by_hand = self._rng.spawn(1)[0], not self._follows
            async with DrillTruck.running(
                self._config, self._clock, wander=wander, judged=True, by_hand=by_hand
            ) as truck:
                await self._drive_on(truck)
            if len(self._outcomes) == before:  # a new truck cannot be driven either
                self._outcomes.append(TrialOutcome(self._number, (), (), self._follows, False, stuck=("drive",)))
        return self._outcomes

    @property
    def _number(self) -> int:
        return self._leg.number * LEG + len(self._outcomes)

    async def _drive_on(self, truck: DrillTruck) -> None:
        """Trials of one truck."""
        if not await truck.until(lambda: not truck.blockers(), RECOVERY_LIMIT) or not await _arm(truck):
            return
        usual = set(
            QUIET | OBSTACLE | {Reason.ESTOP_REQUESTED, Reason.ESTOPPED, Reason.LEASE_EXPIRED}
        )  # what is said while nothing is wrong
        draw = _Draw(truck, self._rng, self._workers)
        while len(self._outcomes) < self._leg.count:
            if truck.by_hand is self._follows or not await _arm(truck):
                return
            usual |= {reason for report in truck.reports() for reason in reasons_of(report)}
            outcome = await _try(truck, draw(), self._rng, usual, self._number)
            self._outcomes.append(outcome)
            if outcome.stuck or outcome.violations:
                return


class _Draw:
    """Draws trials for a truck that has driven: its devices' signals are known then."""

    def __init__(self, truck: DrillTruck, rng: np.random.Generator, workers: tuple[str, ...]) -> None:
        config = truck.rig.config
        self._rng = rng
        self._backwards = truck.by_hand
        self._by_role: dict[str, list[Any]] = {}
        for family in families(truck.rig.robot, used=True):
            self._by_role.setdefault(family.role, []).append(family)
        self._catalog = FaultCatalog(
            config.devices,
            config.monitors.present(),
            records=config.recorder is not None,
            restarts=True,
            workers=workers,
            unguarded=unguarded(config),
        )
        self._without = frozenset[FaultKind]()

    def __call__(self) -> Trial:
        count = 2 if self._rng.random() < 0.45 else 1  # share of trials with two faults
        drawn = [self._fault() for _ in range(count)]
        backwards = self._backwards and bool(self._rng.random() < 0.5)
        names, faults = tuple(name for name, _ in drawn), tuple(fault for _, fault in drawn)
        # (0.0, 1.0): seconds from the end of the first fault of a pair to the second
        return Trial(faults, names, backwards, float(self._rng.uniform(0.0, 1.0)))

    def _fault(self) -> tuple[str, Fault[SimContext]]:
        if self._rng.random() < 0.35:  # share of faults that are drawn from the catalog
            fault = self._catalog.draw(self._rng, without=self._without)
            if fault.kind is FaultKind.DISK_FULL:  # a disk becomes full once
                self._without = frozenset({FaultKind.DISK_FULL})
            return fault.kind.value, fault
        roles = sorted(self._by_role)
        of_role = self._by_role[roles[self._rng.integers(len(roles))]]
        family = of_role[self._rng.integers(len(of_role))]
        # (1.0, 4.0): seconds for which a signal is falsified
        return family.name, family.draw(self._rng, float(self._rng.uniform(1.0, 4.0)))


async def _arm(truck: DrillTruck) -> bool:
    """Arm; whether it sets off."""
    assert truck.judge is not None
    truck.judge.arm()
    return await truck.until(lambda: abs(truck.speed) > MOVES, RECOVERY_LIMIT, Order.ARM)


async def drives_again(truck: DrillTruck) -> bool:
    """Whether it sets off; an operator takes over where something is in the way of a tracker."""
    if await _arm(truck):
        return True
    if truck.by_hand or not _blocked(truck):
        return False
    truck.by_hand = True
    return await _arm(truck)


async def _turn(truck: DrillTruck, trial: Trial) -> None:
    """Let the operator drive in the direction of the trial, if it can."""
    station, judge = truck.station, truck.judge
    assert judge is not None
    if not truck.by_hand or not isinstance(station, Wanderer):
        return
    run_up_time = 6.0  # seconds after which it reverses without
    if trial.backwards:
        station.run_up(run_up_time)
        begin = judge.place
        # 0.7: distance that the operator drives straight ahead before it reverses, m: a robot that has just been armed
        # knows nothing of the ground behind it
        await truck.until(lambda: math.dist(judge.place, begin) > 0.7 or _blocked(truck), run_up_time, Order.ARM)
    station.choose(backwards=trial.backwards)
    # 2.0: seconds in which the operator tries to drive in the direction of the trial
    await truck.until(lambda: abs(truck.speed) > MOVES and (truck.speed < 0) is trial.backwards, 2.0, Order.ARM)
    station.backwards = None


def _blocked(truck: DrillTruck) -> bool:
    return truck.gate is not None and Reason.OBSTACLE_STOP in truck.gate.reasons


async def _try(
    truck: DrillTruck, trial: Trial, rng: np.random.Generator, usual: Iterable[Reason], number: int
) -> TrialOutcome:
    """Drive, have the faults, give an order that stops while the last one lasts, end it, recover, drive again."""
    clock, judge = truck.clock, truck.judge
    assert judge is not None
    await _turn(truck, trial)
    followed = not truck.by_hand
    await clock.sleep(float(rng.uniform(0.1, 0.7)))  # seconds of driving before the first fault
    truck.reports()
    judge.begin()
    began, reverse = clock.now(), judge.speed < 0
    # 5: every so many trials end with an emergency stop, the others with a disarm order
    order = Order.DISARM if (number + 1) % 5 else Order.ESTOP
    for fault in trial.faults:
        context = truck.rig.context  # of the present daemon
        await apply(fault.start, context)
        await clock.sleep(fault.hold)
        if fault is trial.faults[-1]:
            judge.forbid()
            stopping = asyncio.create_task(truck.order(order), name="stopping")
            assert truck.station is not None
            truck.station.silent = True
            # 1.5: seconds from the order that stops to the end of the faults; more than the judge lets a robot move
            await clock.sleep(1.5)
            travelled, standstill = judge.travelled, judge.standstill
        await apply(fault.end, context)
        truck.listen()
        if fault is not trial.faults[-1]:
            await clock.sleep(trial.between)
    ended = clock.now()
    await stopping
    reason, reason_s = _first_reason(truck, set(usual), began)
    recovered = await recovers(truck)
    seconds = (clock.now() - ended) / SECOND
    judge.look()
    judge.check_left()
    stuck = truck.blockers() or ("daemon",) if not recovered else ()
    if not stuck and not judge.violations and not await drives_again(truck):
        stuck = tuple(truck.gate.reasons) if truck.gate is not None else ("gate",)
        stuck = stuck or ("stands",)
    return TrialOutcome(
        number,
        tuple(fault.name for fault in trial.faults),
        trial.families,
        followed,
        reverse,
        reason,
        reason_s,
        travelled,
        standstill,
        None if stuck else seconds,
        stuck,
        judge.violations,
        judge.confirmed_contacts,
    )


async def recovers(truck: DrillTruck) -> bool:
    """Whether the robot can be driven again; the operator resets what the gate has stopped.

    A pack that once was critical, if only by a false reading, has to be better for ``clear_after``.
    """
    if await truck.until(lambda: not truck.blockers(), RECOVERY_LIMIT, Order.RESET):
        return True
    config, waits = truck.rig.config, Reason.BATTERY_CRITICAL in truck.blockers()
    clear_after = max((pack.clear_after for _, pack in packs(config.devices, config.monitors)), default=0.0)
    return waits and await truck.until(lambda: not truck.blockers(), clear_after, Order.RESET)


def _first_reason(truck: DrillTruck, usual: set[Reason], began: int) -> tuple[Reason | None, float | None]:
    """The first reason since ``began``, ns, that is not usual, and after how many seconds."""
    for report in truck.reports():
        if report.stamp >= began:
            for reason in reasons_of(report):
                if reason not in usual:
                    return reason, (report.stamp - began) / SECOND
    return None, None
