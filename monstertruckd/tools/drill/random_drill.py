"""Random drills: seeded faults of the catalog, one after another, on a driving truck; judged by the observer.

A drill consists of legs. Each leg has its own truck and virtual clock, and draws from its own stream of the seed, so
that legs can run in parallel and still give the same report.
"""

import asyncio
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
from pydantic import TypeAdapter

from monstertruck_drivers.config import kind_of
from monstertruck_drivers.maestro.protocol import CHANNELS
from monstertruck_drivers.pca9685.config import Pca9685EscConfig
from monstertruck_planners.steps import TRACKING
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.event import Event, Severity
from monstertruck_schemas.health import HealthTable
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Order
from monstertruck_schemas.roles import SHAFTS
from monstertruck_schemas.state import GateState
from monstertruck_sim.faults import CatalogFault, FaultCatalog, FaultKind, apply
from monstertruckd.tools.drill.legs import DrillLeg, run_legs, truck_of_leg, without_log
from monstertruckd.tools.drill.observer import EPOS, MAESTRO, STOPS_WITHIN, Violation
from monstertruckd.tools.drill.truck import OPTIONAL, DrillTruck
from monstertruckd.tools.simulation.config import DEADMAN_LINE, SimulatedTruckConfig, with_overlay

RECOVERY_LIMIT: Final = 15.0
"""Maximum recovery time before a service is stuck (s)."""
QUIET: Final = frozenset(
    {
        Reason.OK,
        Reason.DISARMED,
        Reason.CLIPPED,
        Reason.SERVO_LIMIT,
        Reason.OBSTACLE_SLOW,
        Reason.NOT_ARMED_SPEED,  # refusal of the order to arm a truck that has not stopped yet
    }
)
"""Reasons that do not explain a stop."""
OBSTACLE: Final = frozenset({Reason.OBSTACLE_STOP, Reason.OBSTACLE_SLOW})
"""Reasons for stopping or creeping in front of an obstacle."""
TRACKER_IN_WORKER: Final[dict[str, Any]] = {"placement": {"tracker": "worker"}}
"""Overlay of every second truck: the tracker runs in a worker."""


def wired(config: SimulatedTruckConfig) -> SimulatedTruckConfig:
    """Return the robot without a map, with the deadman line if a servo controller has an output for it."""
    plain, steering = with_overlay(config, {"map": None}), config.devices.steering
    if (
        steering is None
        or kind_of(steering.driver).name != MAESTRO
        or not config.devices.present().keys() & set(SHAFTS)
    ):
        return plain
    servos = steering.driver
    used = {servo.channel for servo in servos.servos} | ({servos.battery.channel} if servos.battery else set())
    asked = DEADMAN_LINE["devices"]["steering"]["driver"]["deadman_channel"]
    channel = next((c for c in (servos.deadman_channel, asked, *range(CHANNELS)) if c not in {None, *used}), None)
    line = {"devices": {"steering": {"driver": {"deadman_channel": channel}}}}
    return plain if channel is None else with_overlay(plain, {**DEADMAN_LINE, **line})


def unguarded(config: SimulatedTruckConfig) -> tuple[str, ...]:
    """Return the motor controllers that nothing stops while they are unreachable.

    The EPOS has no watchdog on RS232: without the deadman line it keeps its last speed; the same is assumed of unknown
    kinds. Controllers of all shafts have a watchdog; a PCA9685 has none and repeats its last pulses.
    """
    devices = config.devices.present()
    drives = {role.value: devices[role].driver.kind for role in SHAFTS if role in devices}
    wired_to = {EPOS} if config.sim.deadman_wired else set()
    repeating = tuple(role for role, device in devices.items() if isinstance(device.driver, Pca9685EscConfig))
    return tuple(role for role, kind in drives.items() if kind not in wired_to) + repeating


@dataclass(frozen=True, slots=True)
class FaultOutcome:
    """Outcome of one fault. Seconds count from the fault, ``recovered_s`` from its end; None: it did not occur."""

    fault: str
    kind: FaultKind
    must_stop: bool
    reason: Reason | None = None
    """First reason that gate, services or events reported."""
    stop_bytes_s: float | None = None
    standstill_s: float | None = None
    metres: float = 0.0
    """True distance travelled until standstill or the fault's end (m)."""
    recovered_s: float | None = None
    """Time until all services are ready and the truck drives when armed (s); 0: nothing was lost."""
    stuck: tuple[str, ...] = ()
    """Services that did not recover, or reasons that prevent driving."""
    blocked: bool = False
    """Whether the truck works but has stopped in front of an obstacle: it has to be moved by hand."""
    violations: tuple[Violation, ...] = ()

    @property
    def reaction(self) -> str:
        """Return the outcome in one word."""
        if self.violations:
            return "UNSAFE"
        if self.stuck:
            return "stuck"
        if self.blocked:
            return "blocked"
        return "drove on" if self.standstill_s is None else "stopped"

    @property
    def score(self) -> int:
        """Score: 100: safe, recovered in time; 80: safe, late; 50: safe, not recovered; 0: unsafe."""
        if self.violations:
            return 0
        if self.stuck or self.recovered_s is None:
            return 50
        # 4.0: recovery time that counts as in time (s): the goal for a lost hub
        return 100 if self.recovered_s <= 4.0 else 80


@dataclass(frozen=True, slots=True)
class DrillReport:
    """Report of a whole drill."""

    seed: int
    outcomes: tuple[FaultOutcome, ...]

    @property
    def unsafe(self) -> int:
        """Number of faults with unsafe motion."""
        return sum(bool(outcome.violations) for outcome in self.outcomes)

    @property
    def stuck(self) -> int:
        """Number of faults without recovery."""
        return sum(bool(outcome.stuck) for outcome in self.outcomes)

    @property
    def score(self) -> float:
        """Mean score, 0..100."""
        return float(np.mean([outcome.score for outcome in self.outcomes])) if self.outcomes else 0.0

    @property
    def blocked(self) -> int:
        """Faults that left the truck in front of an obstacle."""
        return sum(outcome.blocked for outcome in self.outcomes)

    def recovery(self, percent: float) -> float | None:
        """Return a percentile of the recovery times (s) of faults with a recovery."""
        times = [outcome.recovered_s for outcome in self.outcomes if outcome.recovered_s]
        return float(np.percentile(times, percent)) if times else None

    def as_json(self) -> dict[str, Any]:
        """Figures and outcomes as plain data."""
        outcomes = [
            {**asdict(outcome), "reaction": outcome.reaction, "score": outcome.score} for outcome in self.outcomes
        ]
        return {**self.figures(), "outcomes": outcomes}

    def figures(self) -> dict[str, Any]:
        """The totals."""
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


def check_drivable(config: SimulatedTruckConfig) -> None:
    """Reject a robot without motors.

    Raises:
        InputError: the body lacks motors or steering.
    """
    if (lack := config.missing_actuators()) is not None:
        raise InputError(f"{config.robot} cannot drive: its body needs {lack}")


class Drill:
    """Drill of ``count`` faults from one seed.

    Args:
        seed: source of all randomness.
        count: number of faults.
        config: the simulated truck.
        leg: number of faults per truck.
        faults: kinds of faults to draw; empty: all that the robot can have.

    Raises:
        InputError: nothing drives the robot, its tracker has no path, or it cannot have one of the ``faults``.
    """

    # 25: number of faults per truck
    def __init__(
        self, seed: int, count: int, config: SimulatedTruckConfig, *, leg: int = 25, faults: Iterable[FaultKind] = ()
    ) -> None:
        check_drivable(config)
        if config.tracker is not None and config.path is None:
            raise InputError(f"path: {config.robot} has none: expected one that its tracker follows; or no tracker")
        self.seed = seed
        self.count = count
        self.unguarded = unguarded(wired(config))
        """Motor controllers that no fault disconnects, because nothing would stop them."""
        self._config = config
        self._leg = leg
        self._faults = tuple(dict.fromkeys(faults))
        known = _catalog(wired(config)).kinds
        if missing := [kind for kind in self._faults if kind not in known]:
            raise InputError(f"fault {missing[0]}: expected one that {config.robot} can have: {', '.join(known)}")

    def legs(self) -> list[DrillLeg]:
        """Return the parts that can run in parallel."""
        starts = range(0, self.count, self._leg)
        return [
            DrillLeg(self._config.model_dump(), self.seed, number, min(self._leg, self.count - start), self._faults)
            for number, start in enumerate(starts)
        ]

    def run(
        self,
        *,
        jobs: int = 1,
        resume: Path | None = None,
        report: Callable[[list[FaultOutcome]], None] = lambda _: None,
    ) -> DrillReport:
        """Run the whole drill; arguments and errors as for ``run_legs``."""
        return DrillReport(self.seed, run_legs(self.legs(), run_leg, _OUTCOMES, jobs, resume, report))


_OUTCOMES: Final = TypeAdapter(list[FaultOutcome])


def run_leg(leg: DrillLeg) -> list[FaultOutcome]:
    """Run all faults of one leg on the virtual clock."""
    with without_log(), TemporaryDirectory(prefix="monstertruck-") as folder:
        return run_virtual(lambda clock: _LegRun(leg, clock, folder).run())


class _LegRun:
    """Drives, injects a fault, ends it and drives again, fault by fault."""

    def __init__(self, leg: DrillLeg, clock: VirtualClock, folder: str) -> None:
        self._clock = clock
        self._rng = np.random.default_rng([leg.seed, leg.number])
        base = wired(SimulatedTruckConfig.model_validate(leg.config))
        workers: tuple[str, ...] = ()
        if base.tracker is not None and leg.number % 2:
            base, workers = with_overlay(base, TRACKER_IN_WORKER), (TRACKING,)
        catalog = _catalog(base, workers)
        wanted = frozenset(map(FaultKind, leg.faults or catalog.kinds))
        self._faults = _draw(catalog, leg.count, self._rng, frozenset(catalog.kinds) - wanted)
        records = any(fault.kind is FaultKind.DISK_FULL for fault in self._faults)
        self._config = truck_of_leg(base, int(self._rng.integers(2**31)), folder if records else None)
        self._outcomes: list[FaultOutcome] = []

    async def run(self) -> list[FaultOutcome]:
        """Run all faults; a truck that is stuck is replaced by a new one."""
        left = self._faults
        while left:
            before = len(self._outcomes)
            by_station = self._config.tracker is None
            async with DrillTruck.running(self._config, self._clock, by_station=by_station) as truck:
                await truck.until(lambda: not truck.blockers(), RECOVERY_LIMIT)  # called within this turn only
                for fault in left:
                    # 5: every fifth fault is followed by an emergency stop, the others by a disarm order
                    order = Order.DISARM if (len(self._outcomes) + 1) % 5 else Order.ESTOP
                    outcome = await _react(truck, fault, float(self._rng.uniform(0.1, 0.7)), order)
                    if outcome is None:
                        break
                    self._outcomes.append(outcome)
                    if outcome.stuck or outcome.blocked:
                        break
            done = len(self._outcomes) - before
            if not done:  # a new truck cannot be driven either
                self._outcomes.append(FaultOutcome(left[0].name, left[0].kind, left[0].must_stop, stuck=("drive",)))
                done = 1
            left = left[done:]
        return self._outcomes


def _catalog(config: SimulatedTruckConfig, workers: tuple[str, ...] = ()) -> FaultCatalog:
    """Return the faults of a robot whose daemon has these worker processes."""
    return FaultCatalog(
        config.devices,
        config.monitors.present(),
        records=config.recorder is not None,
        restarts=True,
        workers=workers,
        unguarded=unguarded(config),
    )


def _draw(
    catalog: FaultCatalog, count: int, rng: np.random.Generator, without: frozenset[FaultKind]
) -> list[CatalogFault]:
    """Draw the faults of a leg, except the kinds ``without``; a disk becomes full once, unless only that is drawn."""
    faults: list[CatalogFault] = []
    for _ in range(count):
        faults.append(catalog.draw(rng, without=without))
        if faults[-1].kind is FaultKind.DISK_FULL and len(without) < len(catalog.kinds) - 1:
            without |= {FaultKind.DISK_FULL}
    return faults


async def _react(truck: DrillTruck, fault: CatalogFault, cruise: float, order: Order) -> FaultOutcome | None:
    """Drive for ``cruise`` seconds, inject the fault, send a stopping order, end the fault, recover.

    Return None if the truck could not be driven before the fault.
    """
    clock, observer, context = truck.clock, truck.observer, truck.rig.context
    if not await _drive(truck):
        return None
    await clock.sleep(cruise)
    truck.reports()
    observer.begin(stops=fault.must_stop, disarms=fault.disarms)
    await apply(fault.start, context)
    await clock.sleep(fault.hold)
    stop_bytes, metres = observer.stop_bytes_after(), observer.metres()
    observer.end_fault()
    if order is Order.ESTOP:
        observer.estop()
    else:
        observer.disarm()
    stopping = asyncio.create_task(truck.order(order), name="stopping")
    await clock.sleep(STOPS_WITHIN / 10)
    if abs(observer.speed) > 0.05:  # true speed above which a truck must not be armed, m/s
        await truck.order(Order.ARM)  # must be refused
    await stopping
    await clock.sleep(STOPS_WITHIN / 2)
    standstill = observer.standstill_after()
    reason = next((reason for report in truck.reports() for reason in reasons_of(report)), None)
    ended = clock.now()
    await apply(fault.end, context)
    truck.listen()
    await truck.until(lambda: not truck.blockers(), RECOVERY_LIMIT, Order.RESET if order is Order.ESTOP else None)
    observer.reset()
    recovered = (clock.now() - ended) / SECOND
    blockers = truck.blockers()
    if not blockers and not await _drive(truck):
        blockers = tuple(truck.gate.reasons) if truck.gate is not None else ("gate",)
    blocked = not OBSTACLE.isdisjoint(blockers) and observer.before_something()
    if blocked:
        blockers = ()
    drove_on = standstill is not None and standstill > fault.hold  # the truck stood only because it was disarmed
    backs_off = reason is Reason.CONTACT  # after a contact the robot stays armed, and moves again to leave the obstacle
    return FaultOutcome(
        fault.name,
        fault.kind,
        fault.must_stop,
        reason=reason,
        stop_bytes_s=None if drove_on else stop_bytes,
        standstill_s=None if drove_on else standstill,
        metres=metres,
        recovered_s=None if blockers else recovered,
        stuck=blockers,
        blocked=blocked,
        violations=tuple(one for one in observer.violations() if not (backs_off and one.rule == "unarmed")),
    )


async def _drive(truck: DrillTruck) -> bool:
    """Arm and accelerate to speed."""
    truck.observer.arm()
    return await truck.until(truck.drives, RECOVERY_LIMIT, Order.ARM)


def reasons_of(report: Event | GateState | HealthTable) -> Iterator[Reason]:
    """Yield the reasons that explain a stop."""
    match report:
        case Event():
            named: Iterable[Reason] = (report.reason,) if report.severity is not Severity.INFO else ()
        case GateState():
            named = report.reasons
        case HealthTable():
            named = (service.reason for service in report.services if service.name not in OPTIONAL)
    yield from (reason for reason in named if reason not in QUIET)
