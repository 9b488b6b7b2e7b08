"""Random drills: seeded faults of the catalog, one after another, on a truck that drives; judged by the observer.

A drill consists of legs. Each leg has a truck and a virtual clock of its own and draws from its own stream of the
seed, so that legs can run in parallel, here or on a cluster, and still give the same report.
"""

import asyncio
import hashlib
import importlib.util
import json
import logging
import os
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, Generic, TypeVar

import numpy as np
from pydantic import TypeAdapter

from monstertruck_drivers.maestro.protocol import CHANNELS
from monstertruck_planners.steps import TRACKING
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import InputError, NoAnswerError, WorkerError
from monstertruck_schemas.event import Event, Severity
from monstertruck_schemas.health import HealthTable
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Order
from monstertruck_schemas.roles import SHAFTS
from monstertruck_schemas.state import GateState
from monstertruck_sim.faults import CatalogFault, FaultCatalog, FaultKind, apply
from monstertruckd import __version__
from monstertruckd.tools.drill.observer import STOPS_WITHIN, Violation
from monstertruckd.tools.drill.truck import OPTIONAL, DrillTruck
from monstertruckd.tools.simulation.config import DEADMAN_LINE, SimulatedTruckConfig, with_overlay

T = TypeVar("T")
U = TypeVar("U")
Outcome = TypeVar("Outcome")

CONNECT: Final = 10.0
"""Seconds in which the scheduler of a cluster must answer."""
LEG: Final = 25
"""Faults of one truck."""
TIMEOUT: Final = 15.0
"""Seconds after which a service that has not recovered is stuck."""
RECOVERS_WITHIN: Final = 4.0
"""Seconds within which everything should be back: the goal of a lost hub."""
ESTOPS: Final = 5
"""Every so many faults are followed by an emergency stop, the others by a disarm order."""
QUIET: Final = frozenset(
    {
        Reason.OK,
        Reason.DISARMED,
        Reason.CLIPPED,
        Reason.SERVO_LIMIT,
        Reason.OBSTACLE_SLOW,
        Reason.NOT_ARMED_SPEED,  # of the order to arm a truck that still stops
    }
)
"""Reasons that explain nothing."""
OBSTACLE: Final = frozenset({Reason.OBSTACLE_STOP, Reason.OBSTACLE_SLOW})
"""Reasons of a truck that stands, or creeps, before something."""
DEADMAN: Final[dict[str, Any]] = {"map": None, **DEADMAN_LINE}
"""Overlay of a truck: the deadman line, and no map; see ``wired``."""
TRACKER_IN_WORKER: Final[dict[str, Any]] = {"placement": {"tracker": "worker"}}
"""Overlay of every second truck."""
SERVOS: Final = "maestro"
"""Kind of servo controller whose wire the observer reads."""
STILL_STOPS: Final = 0.05
"""True speed of a truck that may not be armed yet, m/s."""


def wired(config: SimulatedTruckConfig) -> SimulatedTruckConfig:
    """The robot without a map, with the deadman line where a servo controller has an output for it."""
    plain, steering = with_overlay(config, {"map": None}), config.devices.steering
    if steering is None or not config.devices.present().keys() & set(SHAFTS):
        return plain
    servos = steering.driver
    used = {servo.channel for servo in servos.servos} | ({servos.battery.channel} if servos.battery else set())
    asked = DEADMAN_LINE["devices"]["steering"]["driver"]["deadman_channel"]
    channel = next((c for c in (servos.deadman_channel, asked, *range(CHANNELS)) if c not in {None, *used}), None)
    line = {"devices": {"steering": {"driver": {"deadman_channel": channel}}}}
    return plain if channel is None else with_overlay(plain, {**DEADMAN_LINE, **line})


def unguarded(config: SimulatedTruckConfig) -> tuple[str, ...]:
    """Motor controllers that nothing stops while they cannot be reached.

    The EPOS has no watchdog on RS232: without the deadman line it keeps its last speed. Steppers have one.
    """
    roles = config.devices.present()
    return () if config.sim.deadman_wired else tuple(role.value for role in SHAFTS if role in roles)


def default_jobs() -> int:
    """Processes of a drill: one core is left for whoever works on the computer."""
    return max(len(os.sched_getaffinity(0)) - 1, 1)


@dataclass(frozen=True, slots=True)
class FaultOutcome:
    """What one fault led to. Seconds count from the fault, ``recovered_s`` from its end; None: it did not happen."""

    fault: str
    kind: FaultKind
    must_stop: bool
    reason: Reason | None = None
    """First one that gate, services or events gave."""
    stop_bytes_s: float | None = None
    standstill_s: float | None = None
    metres: float = 0.0
    """Truly travelled to standstill, or until the fault's end."""
    recovered_s: float | None = None
    """All services ready, and the truck drives again when armed; 0: nothing was lost."""
    stuck: tuple[str, ...] = ()
    """Services that did not recover, or reasons that keep the truck from driving."""
    blocked: bool = False
    """The truck works, but stands before an obstacle: it has to be moved by hand."""
    violations: tuple[Violation, ...] = ()

    @property
    def reaction(self) -> str:
        """In one word."""
        if self.violations:
            return "UNSAFE"
        if self.stuck:
            return "stuck"
        if self.blocked:
            return "blocked"
        return "drove on" if self.standstill_s is None else "stopped"

    @property
    def score(self) -> int:
        """100: safe, recovered in time; 80: safe, late; 50: safe, not recovered; 0: unsafe."""
        if self.violations:
            return 0
        if self.stuck or self.recovered_s is None:
            return 50
        return 100 if self.recovered_s <= RECOVERS_WITHIN else 80


@dataclass(frozen=True, slots=True)
class DrillReport:
    """A whole drill."""

    seed: int
    outcomes: tuple[FaultOutcome, ...]

    @property
    def unsafe(self) -> int:
        """Faults with unsafe motion."""
        return sum(bool(outcome.violations) for outcome in self.outcomes)

    @property
    def stuck(self) -> int:
        """Faults after which something did not recover."""
        return sum(bool(outcome.stuck) for outcome in self.outcomes)

    @property
    def score(self) -> float:
        """Mean, 0..100."""
        return float(np.mean([outcome.score for outcome in self.outcomes])) if self.outcomes else 0.0

    @property
    def blocked(self) -> int:
        """Faults after which the truck stood before an obstacle."""
        return sum(outcome.blocked for outcome in self.outcomes)

    def recovery(self, percent: float) -> float | None:
        """Percentile of the recoveries, s, of those faults after which anything had to recover."""
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


@dataclass(frozen=True, slots=True)
class DrillLeg:
    """One truck's share of a drill; can be sent to another process."""

    config: dict[str, Any]
    """Configuration of the simulated truck, as plain values."""
    seed: int
    number: int
    count: int
    version: str = __version__
    """Version of the program; another one would give another report."""


def check_drivable(config: SimulatedTruckConfig) -> None:
    """Refuse a robot without motors.

    Raises:
        InputError: its body lacks what drives or steers it.
    """
    if (lack := config.missing_actuators()) is not None:
        raise InputError(f"{config.robot} cannot drive: its body needs {lack}")


class Drill:
    """``count`` faults of one seed.

    Args:
        seed: everything random comes from it.
        count: how many faults.
        config: the simulated truck.
        leg: faults of one truck.

    Raises:
        InputError: nothing drives the robot, or the observer does not know its devices.
    """

    def __init__(self, seed: int, count: int, config: SimulatedTruckConfig, *, leg: int = LEG) -> None:
        check_drivable(config)
        steering = config.devices.steering
        if steering is not None and steering.driver.kind != SERVOS:
            raise InputError(
                f"devices.steering: the observer reads the wire of {SERVOS}, not of {steering.driver.kind}"
            )
        if config.tracker is not None and config.path is None:
            raise InputError(f"path: {config.robot} has none: expected one that its tracker follows; or no tracker")
        self.seed = seed
        self.count = count
        self.unguarded = unguarded(wired(config))
        """Motor controllers that no fault cuts off, for nothing would stop them."""
        self._config = config
        self._leg = leg

    def legs(self) -> list[DrillLeg]:
        """The parts that can run in parallel."""
        starts = range(0, self.count, self._leg)
        return [
            DrillLeg(self._config.model_dump(), self.seed, number, min(self._leg, self.count - start))
            for number, start in enumerate(starts)
        ]

    def run(
        self,
        *,
        jobs: int = 1,
        cluster: str | None = None,
        resume: Path | None = None,
        report: Callable[[list[FaultOutcome]], None] = lambda _: None,
    ) -> DrillReport:
        """Run all of it.

        Args:
            jobs: processes; 1 = this one alone.
            cluster: address of a dask scheduler, whose workers run it instead.
            resume: file of the outcomes: legs that are in it are not run again, the others are added.
            report: called with the outcomes of each leg, in the order of their numbers.

        Raises:
            InputError: see ``LegFile`` and ``on_cluster``.
            NoAnswerError, WorkerError: see ``on_cluster``.
        """
        legs = self.legs()
        file = None if resume is None else LegFile(resume, legs[0], _OUTCOMES)
        known = {} if file is None else {leg.number: found for leg in legs if (found := file.outcomes(leg))}
        outcomes: list[FaultOutcome] = []
        with self._parts([leg for leg in legs if leg.number not in known], jobs, cluster) as parts:
            for leg in legs:
                part = known.get(leg.number)
                if part is None:
                    part = next(parts)
                    if file is not None:
                        file.add(leg, part)
                report(part)
                outcomes += part
        return DrillReport(self.seed, tuple(outcomes))

    @contextmanager
    def _parts(self, legs: list[DrillLeg], jobs: int, cluster: str | None) -> Iterator[Iterator[list[FaultOutcome]]]:
        if cluster is not None:
            with on_cluster(cluster, run_leg, legs) as parts:
                yield parts
        elif jobs == 1:
            yield map(run_leg, legs)
        else:
            with ProcessPoolExecutor(min(jobs, max(1, len(legs)))) as pool:
                yield pool.map(run_leg, legs)


class LegFile(Generic[Outcome]):
    """Outcomes of the finished legs of a drill, one JSON object a line, so that an interrupted drill goes on.

    Args:
        path: the file; made where there is none.
        leg: any one of the drill.
        adapter: of a leg's outcomes.

    Raises:
        InputError: it cannot be read or written, or is of another drill or program.
    """

    def __init__(self, path: Path, leg: DrillLeg, adapter: TypeAdapter[list[Outcome]]) -> None:
        self._adapter = adapter
        self._path = path
        self._header = {"seed": leg.seed, "program": _digest(leg.config)}
        self._found: dict[tuple[int, int], list[Outcome]] = {}
        self._end = 0
        """Bytes of whole lines: an interrupted program leaves part of one."""
        try:
            with path.open("a+b") as file:  # before the first leg, not after it: it must be possible to write
                file.seek(0)
                data = file.read()
        except OSError as error:
            raise InputError(f"{path}: {error.strerror}") from error
        self._end = data.rfind(b"\n") + 1
        for number, line in enumerate(data[: self._end].splitlines(), 1):
            self._read(line, number)

    def _read(self, line: bytes, number: int) -> None:
        try:
            row = json.loads(line)
            header = {key: row[key] for key in self._header}
            outcomes = self._adapter.validate_python(row["outcomes"], strict=False)
            leg = int(row["leg"]), int(row["count"])
        except (ValueError, TypeError, KeyError) as error:
            raise InputError(f"{self._path}: line {number} is no leg of a drill") from error
        if header != self._header:
            text = f"{self._path}: line {number} is of seed {header['seed']}, or of another program or configuration"
            raise InputError(f"{text}: expected seed {self._header['seed']} and the same program")
        self._found[leg] = outcomes

    def outcomes(self, leg: DrillLeg) -> list[Outcome] | None:
        """Those of a finished leg; None if it has to be run."""
        return self._found.get((leg.number, leg.count))

    def add(self, leg: DrillLeg, outcomes: list[Outcome]) -> None:
        """Append a finished leg.

        Raises:
            InputError: the file cannot be written.
        """
        row = {**self._header, "leg": leg.number, "count": leg.count}
        line = json.dumps(row | {"outcomes": self._adapter.dump_python(outcomes, mode="json")}).encode() + b"\n"
        try:
            with self._path.open("r+b") as file:
                file.seek(self._end)
                file.write(line)
                file.truncate()
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise InputError(f"{self._path}: {error.strerror}") from error
        self._end += len(line)


_OUTCOMES: Final = TypeAdapter(list[FaultOutcome])
PACKAGES: Final = (
    "monstertruck_schemas",
    "monstertruck_runtime",
    "monstertruck_kinematics",
    "monstertruck_estimation",
    "monstertruck_planners",
    "monstertruck_drivers",
    "monstertruck_sim",
    "monstertruckd",
)


def _digest(config: dict[str, Any]) -> str:
    """Of everything that decides the outcome of a leg but seed and number: the configuration and our sources."""
    digest = hashlib.blake2b(repr(config).encode(), digest_size=12)
    for package in PACKAGES:
        spec = importlib.util.find_spec(package)
        assert spec is not None
        for folder in spec.submodule_search_locations or ():
            for source in sorted(Path(folder).rglob("*.py")):
                digest.update(source.read_bytes())
    return digest.hexdigest()


_ALONE: Final = threading.Lock()
"""A leg silences the log of its process; a worker of a cluster may have several threads."""


@contextmanager
def leg_alone() -> Iterator[None]:
    """One leg at a time in this process, without its log."""
    with _ALONE:
        quiet = logging.root.manager.disable
        logging.disable(logging.CRITICAL)
        try:
            yield
        finally:
            logging.disable(quiet)


def check_version(leg: DrillLeg) -> None:
    """Refuse a leg of another version of the program.

    Raises:
        InputError: another version made it.
    """
    if leg.version != __version__:
        raise InputError(f"a drill of version {leg.version} was sent to a worker with version {__version__}")


def run_leg(leg: DrillLeg) -> list[FaultOutcome]:
    """All faults of one leg, on the virtual clock.

    Raises:
        InputError: it comes from another version of the program.
    """
    check_version(leg)
    with leg_alone(), TemporaryDirectory(prefix="monstertruck-") as folder:
        return run_virtual(lambda clock: _LegRun(leg, clock, folder).run())


class _LegRun:
    """Drives, starts a fault, ends it and drives again, fault by fault."""

    def __init__(self, leg: DrillLeg, clock: VirtualClock, folder: str) -> None:
        self._clock = clock
        self._rng = np.random.default_rng([leg.seed, leg.number])
        base = wired(SimulatedTruckConfig.model_validate(leg.config))
        workers: tuple[str, ...] = ()
        if base.tracker is not None and leg.number % 2:
            base, workers = with_overlay(base, TRACKER_IN_WORKER), (TRACKING,)
        monitors, records = base.monitors.present(), base.recorder is not None
        catalog = FaultCatalog(
            base.devices, monitors, records=records, restarts=True, workers=workers, unguarded=unguarded(base)
        )
        self._faults = _draw(catalog, leg.count, self._rng)
        records = any(fault.kind is FaultKind.DISK_FULL for fault in self._faults)
        recorder = base.recorder.model_copy(update={"directory": folder}) if records and base.recorder else None
        seed = int(self._rng.integers(2**31))
        self._config = base.model_copy(
            update={"recorder": recorder, "sim": base.sim.model_copy(update={"seed": seed, "drill": None})}
        )
        self._outcomes: list[FaultOutcome] = []

    async def run(self) -> list[FaultOutcome]:
        """All faults; a truck that is stuck is replaced by a new one."""
        left = self._faults
        while left:
            before = len(self._outcomes)
            by_station = self._config.tracker is None
            async with DrillTruck.running(self._config, self._clock, by_station=by_station) as truck:
                await truck.until(lambda: not truck.blockers(), TIMEOUT)  # called within this turn only
                for fault in left:
                    order = Order.DISARM if (len(self._outcomes) + 1) % ESTOPS else Order.ESTOP
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


def _draw(catalog: FaultCatalog, count: int, rng: np.random.Generator) -> list[CatalogFault]:
    """The faults of a leg; a disk becomes full once."""
    faults: list[CatalogFault] = []
    full = frozenset[FaultKind]()
    for _ in range(count):
        faults.append(catalog.draw(rng, without=full))
        if faults[-1].kind is FaultKind.DISK_FULL:
            full = frozenset({FaultKind.DISK_FULL})
    return faults


async def _react(truck: DrillTruck, fault: CatalogFault, cruise: float, order: Order) -> FaultOutcome | None:
    """Drive for ``cruise`` seconds, have the fault, give an order that stops, end the fault, recover.

    None: the truck could not be driven before it.
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
    if abs(observer.speed) > STILL_STOPS:
        await truck.order(Order.ARM)  # must be refused
    await stopping
    await clock.sleep(STOPS_WITHIN / 2)
    standstill = observer.standstill_after()
    reason = next((reason for report in truck.reports() for reason in reasons_of(report)), None)
    ended = clock.now()
    await apply(fault.end, context)
    truck.listen()
    await truck.until(lambda: not truck.blockers(), TIMEOUT, Order.RESET if order is Order.ESTOP else None)
    observer.reset()
    recovered = (clock.now() - ended) / SECOND
    blockers = truck.blockers()
    if not blockers and not await _drive(truck):
        blockers = tuple(truck.gate.reasons) if truck.gate is not None else ("gate",)
    blocked = not OBSTACLE.isdisjoint(blockers) and observer.before_something()
    if blocked:
        blockers = ()
    drove_on = standstill is not None and standstill > fault.hold  # it stood only because it was disarmed
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
        violations=observer.violations(),
    )


async def _drive(truck: DrillTruck) -> bool:
    """Arm and come to speed."""
    truck.observer.arm()
    return await truck.until(truck.drives, TIMEOUT, Order.ARM)


def reasons_of(report: Event | GateState | HealthTable) -> Iterator[Reason]:
    """Return the reasons that explain a stop."""
    match report:
        case Event():
            named: Iterable[Reason] = (report.reason,) if report.severity is not Severity.INFO else ()
        case GateState():
            named = report.reasons
        case HealthTable():
            named = (service.reason for service in report.services if service.name not in OPTIONAL)
    yield from (reason for reason in named if reason not in QUIET)


@contextmanager
def on_cluster(address: str, step: Callable[[T], U], inputs: Sequence[T]) -> Iterator[Iterator[U]]:
    """Results of ``step`` in the order of ``inputs``; those of a worker that dies are computed by another one.

    Args:
        address: of the scheduler, ``tcp://HOST:PORT``.
        step: importable on the workers.
        inputs: one each.

    Raises:
        InputError: dask.distributed is not installed.
        NoAnswerError: no scheduler answers.
        WorkerError: workers died of one input three times in a row.
        Exception: what ``step`` raised.
    """
    try:
        from distributed import Client, KilledWorker  # noqa: PLC0415  # an extra
    except ImportError as error:
        raise InputError("--cluster needs dask.distributed: install monstertruckd[cluster]") from error
    try:
        client = Client(address, timeout=CONNECT)
    except (OSError, ValueError) as error:
        raise NoAnswerError(f"{address}: no dask scheduler answers: {error}") from error
    with client:
        futures = client.map(step, inputs, pure=False)

        def results() -> Iterator[U]:
            try:
                for future in futures:
                    yield future.result()
            except KilledWorker as error:
                raise WorkerError(f"{address}: {error}") from error

        yield results()
