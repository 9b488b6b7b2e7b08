"""Fault-family drill: any device signal may be falsified, any command ignored; the world's true state is the judge.

An operator drives at random, in both directions and all steering modes, or a tracker follows its path. A trial has
one fault, or two, the second while the robot recovers from the first. Faults are drawn from the families of the
robot's devices (``monstertruck_sim.families``) and from the catalog of known faults.

As in ``random_drill``, a drill consists of legs, each with its own truck, clock and random stream of the seed.
"""

import asyncio
import math
from collections.abc import Callable
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
from monstertruckd.tools.drill.legs import DrillLeg, run_legs, truck_of_leg, without_log
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
"""Trials per truck."""
MOVES: Final = 0.03
"""Minimum true speed of a driving robot (m/s); below its reverse speed into scarcely known ground."""
UNSEEN: Final = frozenset({Reason.UNSEEN_STOP, Reason.UNSEEN_DRIVE, Reason.UNSEEN_SLOW})
USUAL: Final = QUIET | OBSTACLE | UNSEEN | {Reason.ESTOP_REQUESTED, Reason.ESTOPPED, Reason.LEASE_EXPIRED}
"""Reasons reported without a fault."""
BY_HAND: Final[dict[str, Any]] = {
    "explorer": None,
    "planner": None,
    "tracker": None,
    "path": None,
}
"""Overlay for an operator-driven truck."""


@dataclass(frozen=True, slots=True)
class Trial:
    """One or two faults to inject."""

    faults: tuple[Fault[SimContext], ...]
    families: tuple[str, ...]
    """Fault families: fault names without their drawn numbers."""
    backwards: bool
    """The operator starts in reverse."""
    between: float
    """Time from the end of the first fault to the second (s)."""


@dataclass(frozen=True, slots=True)
class TrialOutcome:
    """Outcome of one trial; times are measured from the first fault unless stated otherwise."""

    number: int
    """Index in the drill, from 0."""
    faults: tuple[str, ...]
    families: tuple[str, ...]
    followed: bool
    """The tracker drove."""
    reverse: bool
    """The robot drove backwards at the start of the first fault."""
    reason: Reason | None = None
    """First reason that gate, services or events reported."""
    reason_s: float | None = None
    travelled: float = 0.0
    """Distance travelled after the disarm or stop order (m)."""
    standstill_s: float | None = None
    """Time to standstill after the disarm or stop order (s)."""
    recovered_s: float | None = None
    """Time from the end of the last fault until everything is ready (s)."""
    stuck: tuple[str, ...] = ()
    """Services that did not recover, or reasons that still prevent driving."""
    violations: tuple[Violation, ...] = ()
    confirmed_contacts: int = 0
    """Contacts while the operator confirmed unseen ground."""

    @property
    def unsafe(self) -> bool:
        """Whether the judge found a violation."""
        return bool(self.violations)

    @property
    def contact(self) -> bool:
        """Whether the robot hit something."""
        return any(violation.rule == "contact" for violation in self.violations)


OUTCOMES: Final = TypeAdapter(list[TrialOutcome])


@dataclass(frozen=True, slots=True)
class CampaignReport:
    """Report of a fault-family drill, or of a part of one."""

    seed: int
    outcomes: tuple[TrialOutcome, ...]

    @property
    def unsafe(self) -> int:
        """Trials with unsafe motion."""
        return sum(outcome.unsafe for outcome in self.outcomes)

    @property
    def stuck(self) -> int:
        """Trials without recovery of the robot."""
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
    """Fault-family drill.

    Args:
        seed: source of all randomness.
        count: number of trials, including those before ``first``.
        config: the simulated robot.
        first: index of the first trial to run; a multiple of ``LEG``.

    Raises:
        InputError: nothing drives the robot, or ``first`` is not the start of a leg.
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
        """Return the parts that can run in parallel."""
        config = self._config.model_dump()
        starts = range(self._first, self.count, LEG)
        return [DrillLeg(config, self.seed, start // LEG, min(LEG, self.count - start)) for start in starts]

    def run(
        self,
        *,
        jobs: int = 1,
        resume: Path | None = None,
        report: Callable[[list[TrialOutcome]], None] = lambda _: None,
    ) -> CampaignReport:
        """Run the whole drill; arguments and errors as in ``run_legs``. Files of several parts can be concatenated."""
        return CampaignReport(self.seed, run_legs(self.legs(), run_trials, OUTCOMES, jobs, resume, report))


def run_trials(leg: DrillLeg) -> list[TrialOutcome]:
    """Run all trials of one leg on the virtual clock."""
    with without_log(), TemporaryDirectory(prefix="monstertruck-") as folder:
        return run_virtual(lambda clock: _Leg(leg, clock, folder).run())


class _Leg:
    """Runs trial after trial on one truck; replaces a truck that is stuck or has hit something."""

    def __init__(self, leg: DrillLeg, clock: VirtualClock, folder: str) -> None:
        self._leg = leg
        self._clock = clock
        self._rng = np.random.default_rng([leg.seed, leg.number, 1])
        base = wired(SimulatedTruckConfig.model_validate(leg.config))
        driven = base.tracker is not None and (base.path is not None or base.own_planner is not None)
        # one truck in this many is driven by its tracker, along its path or to goals of its planner if it has one
        follows = 4
        self._follows = driven and leg.number % follows == follows - 1
        self._workers: tuple[str, ...] = ()
        if not self._follows:
            base = with_overlay(base, BY_HAND)
        elif leg.number // follows % 2:
            base, self._workers = with_overlay(base, TRACKER_IN_WORKER), (TRACKING,)
        records = None if leg.number % 5 else folder  # one truck in this many records, and its disk may become full
        self._config = truck_of_leg(base, int(self._rng.integers(2**31)), records)
        self._outcomes: list[TrialOutcome] = []

    async def run(self) -> list[TrialOutcome]:
        """Run all trials."""
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
        """Run the trials of one truck."""
        if not await truck.until(lambda: not truck.blockers(), RECOVERY_LIMIT) or not await _arm(truck):
            return
        usual = set(USUAL)
        draw = _Draw(truck, self._rng, self._workers)
        while len(self._outcomes) < self._leg.count:
            if truck.by_hand is self._follows or not await _arm(truck):
                return
            truck.reports()  # of the start, or of the latest fault
            outcome = await _try(truck, draw(), self._rng, usual, self._number)
            self._outcomes.append(outcome)
            if outcome.stuck or outcome.violations:
                return


class _Draw:
    """Draws trials for a truck that has driven, so that the signals of its devices are known."""

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
        count = 2 if self._rng.random() < 0.45 else 1  # fraction of trials with two faults
        drawn = [self._fault() for _ in range(count)]
        backwards = self._backwards and bool(self._rng.random() < 0.5)
        names, faults = tuple(name for name, _ in drawn), tuple(fault for _, fault in drawn)
        # (0.0, 1.0): time from the end of the first fault of a pair to the second (s)
        return Trial(faults, names, backwards, float(self._rng.uniform(0.0, 1.0)))

    def _fault(self) -> tuple[str, Fault[SimContext]]:
        if self._rng.random() < 0.35:  # fraction of faults drawn from the catalog
            fault = self._catalog.draw(self._rng, without=self._without)
            if fault.kind is FaultKind.DISK_FULL:  # a disk becomes full only once
                self._without = frozenset({FaultKind.DISK_FULL})
            return fault.kind.value, fault
        roles = sorted(self._by_role)
        of_role = self._by_role[roles[self._rng.integers(len(roles))]]
        family = of_role[self._rng.integers(len(of_role))]
        # (1.0, 4.0): duration of a falsified signal (s)
        return family.name, family.draw(self._rng, float(self._rng.uniform(1.0, 4.0)))


async def _arm(truck: DrillTruck) -> bool:
    """Arm the truck; return whether it starts to move."""
    assert truck.judge is not None
    truck.judge.arm()
    return await truck.until(lambda: abs(truck.speed) > MOVES, RECOVERY_LIMIT, Order.ARM)


async def drives_again(truck: DrillTruck) -> bool:
    """Return whether the truck starts to move; an operator takes over if the tracker's path is blocked."""
    if await _arm(truck):
        return True
    if truck.by_hand or not _blocked(truck):
        return False
    truck.by_hand = True
    return await _arm(truck)


async def _turn(truck: DrillTruck, trial: Trial) -> None:
    """Let the operator drive in the direction of the trial, if possible."""
    station, judge = truck.station, truck.judge
    assert judge is not None
    if not truck.by_hand or not isinstance(station, Wanderer):
        return
    run_up_time = 6.0  # maximum wait of the operator for that run-up before reversing (s)
    if trial.backwards:
        station.run_up(run_up_time)
        begin = judge.place
        # 0.7: distance that the operator drives straight ahead before reversing (m): a robot that has just been armed
        # knows nothing of the ground behind it
        await truck.until(lambda: math.dist(judge.place, begin) > 0.7 or _blocked(truck), run_up_time, Order.ARM)
    station.choose(backwards=trial.backwards)
    # 2.0: time limit for driving in the direction of the trial (s)
    await truck.until(lambda: abs(truck.speed) > MOVES and (truck.speed < 0) is trial.backwards, 2.0, Order.ARM)
    station.backwards = None


def _blocked(truck: DrillTruck) -> bool:
    return truck.gate is not None and Reason.OBSTACLE_STOP in truck.gate.reasons


async def _try(
    truck: DrillTruck, trial: Trial, rng: np.random.Generator, usual: set[Reason], number: int
) -> TrialOutcome:
    """Drive, inject the faults, give a stop order during the last one, end it, recover, drive again.

    Reasons reported while the truck drives without a fault are added to ``usual``.
    """
    clock, judge = truck.clock, truck.judge
    assert judge is not None
    await _turn(truck, trial)
    followed = not truck.by_hand
    await clock.sleep(float(rng.uniform(0.1, 0.7)))  # driving time before the first fault (s)
    usual |= {reason for report in truck.reports() for reason in reasons_of(report)}
    judge.begin()
    began, reverse = clock.now(), judge.speed < 0
    # 5: every fifth trial ends with an emergency stop, the others with a disarm order
    order = Order.DISARM if (number + 1) % 5 else Order.ESTOP
    for fault in trial.faults:
        context = truck.rig.context  # context of the current daemon
        await apply(fault.start, context)
        await clock.sleep(fault.hold)
        if fault is trial.faults[-1]:
            judge.forbid()
            stopping = asyncio.create_task(truck.order(order), name="stopping")
            assert truck.station is not None
            truck.station.silent = True
            # 1.5: time from the stop order to the end of the faults (s); longer than the judge lets a robot move
            await clock.sleep(1.5)
            travelled, standstill = judge.travelled, judge.standstill
        await apply(fault.end, context)
        truck.listen()
        if fault is not trial.faults[-1]:
            await clock.sleep(trial.between)
    ended = clock.now()
    await stopping
    reason, reason_s = _first_reason(truck, usual, began)
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
    """Return whether the robot can be driven again; the operator resets the gate's stops.

    A pack that was critical, even by a false reading, must read better for ``clear_after``.
    """
    if await truck.until(lambda: not truck.blockers(), RECOVERY_LIMIT, Order.RESET):
        return True
    config, waits = truck.rig.config, Reason.BATTERY_CRITICAL in truck.blockers()
    clear_after = max((pack.clear_after for _, pack in packs(config.devices, config.monitors)), default=0.0)
    return waits and await truck.until(lambda: not truck.blockers(), clear_after, Order.RESET)


def _first_reason(truck: DrillTruck, usual: set[Reason], began: int) -> tuple[Reason | None, float | None]:
    """Return the first unusual reason since ``began`` (ns), and the time to it (s)."""
    for report in truck.reports():
        if report.stamp >= began:
            for reason in reasons_of(report):
                if reason not in usual:
                    return reason, (report.stamp - began) / SECOND
    return None, None
