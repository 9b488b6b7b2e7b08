"""Scripted faults on the whole daemon while it drives: execution, required reaction, judgement.

Times come from three independent sources: the bytes on the drive controller's wire, the world's truth, and the
messages on the bus.
"""

import asyncio
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Final, cast

from monstertruck_drivers.catalog import COMPASS, DRIVE, LIDAR, STEERING
from monstertruck_drivers.epos import objects as od
from monstertruck_drivers.epos.protocol import Control
from monstertruck_runtime.clock import SECOND, VirtualClock
from monstertruck_runtime.errors import NoAnswerError
from monstertruck_runtime.mailbox import fifo
from monstertruck_schemas.base import Message
from monstertruck_schemas.event import Event
from monstertruck_schemas.health import HealthTable, ServiceHealth, ServiceState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Order
from monstertruck_schemas.roles import DeviceRole
from monstertruck_schemas.state import GateMode, GateState
from monstertruck_schemas.topics import Topic
from monstertruck_sim.faults import Fault, SimContext, apply
from monstertruckd.bus.local import Bus
from monstertruckd.tools.drill.observer import STANDING_SPEED, STOP_CONTROLS, Violation, WireTap, written
from monstertruckd.tools.drill.truck import DaemonReport, DrillTruck, DrivingStation
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay

SENSORS: Final[Mapping[str, Topic[Any]]] = {role.name: role.topic for role in (LIDAR, COMPASS, DRIVE, STEERING)}
TIMEOUT: Final = 10.0
"""Seconds in which a sound truck is ready, and drives when it is armed."""
ALL: Final = 1 << 20
"""Depth of queues that must not lose anything."""
STOP_AFTER_DETECTION: Final = 0.05
"""Seconds from a detected loss to the stop bytes on the wire."""
STOP_AFTER_SAMPLE: Final = 0.3
"""Seconds from the last good sample to the stop bytes."""
STANDSTILL: Final = 0.3
"""Seconds to standstill from the stop bytes, or from the fault if that came later."""
STANDSTILL_AGAIN: Final = 1.2
"""Seconds from the moment the drive controller can be reached again to standstill."""
STANDSTILL_BY_LINE: Final = 0.6
"""Seconds from the loss of the drive controller to standstill by the deadman line."""
GOALS: Final = {
    "stop_after_detection_s": STOP_AFTER_DETECTION,
    "stop_after_sample_s": STOP_AFTER_SAMPLE,
    "standstill_after_stop_s": STANDSTILL,
    "standstill_after_return_s": STANDSTILL_AGAIN,
    "standstill_by_line_s": STANDSTILL_BY_LINE,
    "back_after_replug_s": 2.0,
}
COLUMNS: Final = ("fault", "detected", "stop bytes", "standstill", "metres", "reason", "back")


@dataclass(frozen=True, slots=True, kw_only=True)
class ScenarioContext(SimContext):
    """The simulated side, and the targets of scripted faults only.

    Args:
        bus: bus of the daemon, for bugs in its services.
        station: drives by requests.
        began: start of the world, ns.
    """

    bus: Bus
    station: DrivingStation
    began: int

    def poison(self, topic: Topic[Any]) -> None:
        """Send the readers of ``topic`` an unreadable message, as a bug would."""
        self.bus.hand_over(topic, cast("Message", object()))


class Expect(StrEnum):
    """Required reaction of the daemon."""

    STOP = "stop"
    """The daemon stops the truck, in time."""
    STOP_AHEAD = "stop ahead"
    """It stops by its usual limits, before it gets there; no time is set."""
    STOP_AGAIN = "stop again"
    """The motor cannot be reached; it stops soon after it can be."""
    STOP_BY_LINE = "stop by line"
    """The motor cannot be reached; the deadman line stops it."""
    GO_ON = "go on"
    """Driving is not affected."""
    ENDURE = "endure"
    """Driving may go on; if it does not, the truck stops in time."""
    SLOW_DOWN = "slow down"
    """The daemon limits the speed."""
    REFUSE = "refuse"
    """The truck stood, and cannot be armed."""
    EXIT = "exit"
    """The daemon ends itself, neutral first."""


@dataclass(frozen=True, slots=True)
class Scenario:
    """A fault and the required reaction.

    Args:
        fault: the fault.
        expect: required reaction of the daemon.
        seen: reasons that the gate's state or events must name, in this order; the last one stops the truck.
        down: services that must be reported lost, and why.
        lead: seconds until an operator tries to arm, if the truck stands at first.
        device: role whose samples are lost or corrupted.
        recovers: whether the truck can be driven again afterwards.
        resumes: whether the truck continues by itself afterwards, by the gate's rule for short faults.
        by_station: whether a station drives, instead of the tracker.
        overlay: required configuration.
        timeout: time limit of the recovery, s; 2 s for a replugged device.
    """

    fault: Fault[ScenarioContext]
    expect: Expect
    seen: tuple[Reason, ...] = ()
    down: Mapping[str, Reason] = field(default_factory=dict)
    device: str | None = None
    lead: float = 0.0
    recovers: bool = True
    resumes: bool = False
    by_station: bool = False
    overlay: Mapping[str, Any] = field(default_factory=dict)
    timeout: float = 2.0

    @property
    def name(self) -> str:
        """Name of the fault."""
        return self.fault.name


@dataclass(frozen=True, slots=True)
class Reaction:
    """Measured reaction; seconds count from the fault, ``recovered_after_s`` from its end. None: it did not occur."""

    fault: str
    detected_after_s: float | None = None
    """A service is reported lost, or the gate stops."""
    stop_bytes_after_s: float | None = None
    """Until the stop bytes are on the drive controller's wire."""
    stop_bytes_after_sample_s: float | None = None
    """The same, from the arrival of the last good sample of the device."""
    standstill_after_s: float | None = None
    """Until the simulated truck stands still."""
    metres: float = 0.0
    """Distance truly travelled, to standstill or to the end of the fault."""
    reason: Reason | None = None
    """First reason for which the gate stopped the truck."""
    seen: tuple[Reason, ...] = ()
    """What the gate's state and events named during the fault, in order."""
    down: Mapping[str, tuple[Reason, ...]] = field(default_factory=dict)
    """Services that were lost during the fault, and why."""
    top_speed: float = 0.0
    """Greatest true speed during the fault, m/s."""
    ended_after_s: float = 0.0
    recovered_after_s: float | None = None
    """All services ready, and nothing but an order missing to drive."""
    moved_by_itself: bool = False
    """After the fault, before anybody armed the truck again."""
    drove_again: bool = False
    resets: int = 0
    """Fault resets the drive controller was sent."""
    violations: tuple[Violation, ...] = ()
    """Invariants that the observer saw broken."""
    exited: bool = False


async def measure(
    scenario: Scenario, config: SimulatedTruckConfig, clock: VirtualClock, driven: float = 3.0
) -> Reaction:
    """Run one scenario.

    Args:
        scenario: scenario to run.
        config: configuration of the truck; recorder and map are left out unless the scenario's overlay has them.
        clock: clock of the running virtual loop.
        driven: seconds at speed before the fault; shifts it against ticks and exchanges.

    Raises:
        NoAnswerError: the truck did not drive before the fault.
    """
    plain = with_overlay(config, {"recorder": None, "map": None})
    reaction = None
    try:
        async with DrillTruck.running(with_overlay(plain, scenario.overlay), clock) as truck:
            reaction = await _ScenarioRun(scenario, truck, driven).run()
    except BaseExceptionGroup:
        if reaction is None or not reaction.exited:
            raise
    return reaction


class _ScenarioRun:
    """One run of one scenario."""

    def __init__(self, scenario: Scenario, truck: DrillTruck, driven: float) -> None:
        rig = truck.rig
        self.scenario = scenario
        self.truck = truck
        self.driven = driven
        self.clock = truck.clock
        self.observer = truck.observer
        self.station = DrivingStation(rig.bus, truck.clock)
        self.context = ScenarioContext(
            config=rig.context.config,
            devices=rig.context.devices,
            robot=rig.robot,
            computer=rig.computer,
            clock=rig.clock,
            disk=rig.context.disk,
            bus=rig.bus,
            station=self.station,
            began=rig.began,
        )
        device = scenario.device
        self.samples = None if device is None else rig.bus.subscribe(SENSORS[device], fifo(ALL))
        self.started = 0
        self.ended = 0
        self.metres = 0.0
        self.top_speed = 0.0
        self.stands = scenario.expect is Expect.REFUSE

    async def run(self) -> Reaction:
        """Drive, cause the fault, end it, drive again."""
        scenario, fault = self.scenario, self.scenario.fault
        async with self._station():
            await self._require(self._drivable, "the truck to be ready")
            if not self.stands:
                await self.drive()
                await self.clock.sleep(self.driven)
            self.truck.reports()
            self.started = self.clock.now()
            self.observer.begin(stops=False)
            await apply(fault.start, self.context)
            await self.clock.sleep(scenario.lead)
            await self.truck.until(lambda: False, fault.hold - scenario.lead, Order.ARM if self.stands else None)
            await self.clock.sleep_until(self.started + round(fault.hold * SECOND))
            self.ended = self.clock.now()
            self.metres, self.top_speed = self.observer.metres(), self.observer.top_speed
            if self.truck.rig.daemon_ended:
                return self._reaction(exited=True)
            await apply(fault.end, self.context)
            recovered = await self.truck.until(self._drivable, scenario.timeout)
            after = (self.clock.now() - self.ended) / SECOND if recovered else None
            await self.clock.sleep(0.5)
            moved = abs(self.observer.speed) > STANDING_SPEED
            again = recovered and await self._drives_again()
            return self._reaction(recovered_after_s=after, moved_by_itself=moved, drove_again=again)

    async def drive(self) -> None:
        """Arm and reach the speed.

        Raises:
            NoAnswerError: it takes too long.
        """
        truck = self.truck
        self.station.silent = True  # arming needs a stick at rest
        await self._require(
            lambda: truck.gate is not None and truck.gate.mode.active, "the truck to be armed", Order.ARM
        )
        self.station.silent = not self.scenario.by_station
        await self._require(truck.drives, "the truck to drive")

    async def _drives_again(self) -> bool:
        try:
            await self.drive()
        except NoAnswerError:
            return False
        return True

    def _drivable(self) -> bool:
        return not self.truck.blockers()

    async def _require(self, condition: Callable[[], bool], what: str, order: Order | None = None) -> None:
        if not await self.truck.until(condition, TIMEOUT, order):
            blockers = ", ".join(self.truck.blockers()) or "nothing"
            raise NoAnswerError(f"{self.scenario.name}: waited for {what}; blocked by {blockers}")

    @asynccontextmanager
    async def _station(self) -> AsyncIterator[None]:
        sending = asyncio.create_task(self.station.run(), name="station")
        try:
            yield
        finally:
            sending.cancel()
            await asyncio.wait([sending])

    # Figures

    def _reaction(self, **more: Any) -> Reaction:
        observer, reports = self.observer, self.truck.reports()
        during = [report for report in reports if report.stamp <= self.ended]
        stopped = self._gate_stop(reports)
        lost = next((r.stamp for r in during if isinstance(r, HealthTable) and _unready(r)), None)
        stop_at = None if self.stands else stop_bytes(observer.drive, self.started)
        standstill = None if self.stands else observer.standstill_after()
        return Reaction(
            fault=self.scenario.name,
            detected_after_s=self._since(min((t for t in (lost, stopped and stopped[0]) if t), default=None)),
            stop_bytes_after_s=self._since(stop_at),
            stop_bytes_after_sample_s=self._after_sample(stop_at),
            standstill_after_s=standstill,
            metres=self.metres if standstill is None else observer.metres(),
            reason=stopped[1] if stopped else None,
            seen=tuple(dict.fromkeys(reason for report in during for reason in _named(report))),
            down=_down(during),
            top_speed=self.top_speed,
            ended_after_s=(self.ended - self.started) / SECOND,
            resets=sum(control == Control.FAULT_RESET for control in self._controls()),
            violations=observer.violations(),
            **more,
        )

    def _controls(self) -> list[int]:
        during = (row for row in written(self.observer.drive, self.started) if row[0] <= self.ended)
        return [value for _, index, value in during if index == od.CONTROLWORD.index]

    def _since(self, instant: int | None) -> float | None:
        return None if instant is None else (instant - self.started) / SECOND

    def _gate_stop(self, reports: Iterable[DaemonReport]) -> tuple[int, Reason | None] | None:
        """Return the time and reason of the gate's stop; a limit of 0 is a stop too."""
        for state in reports:
            if isinstance(state, GateState) and (state.mode is not GateMode.DRIVING or state.speed_limit == 0):
                expected = [reason for reason in self.scenario.seen[-1:] if reason in state.reasons]
                return state.stamp, next(iter((*expected, *state.reasons)), None)
        return None

    def _after_sample(self, instant: int | None) -> float | None:
        """Return the seconds from the last valid sample of the affected device to an instant."""
        if instant is None or self.samples is None:
            return None
        arrivals = [m.received for m in self.samples.drain() if m.received - m.stamp < 0.4 * SECOND]
        before = [received for received in arrivals if received < instant]
        return (instant - before[-1]) / SECOND if before else None


def _unready(table: HealthTable) -> list[ServiceHealth]:
    return [service for service in table.services if service.state is not ServiceState.READY]


def _down(reports: Iterable[DaemonReport]) -> dict[str, tuple[Reason, ...]]:
    """Return the lost services and the reasons."""
    down: dict[str, dict[Reason, None]] = {}
    for table in reports:
        for service in _unready(table) if isinstance(table, HealthTable) else ():
            if service.reason is not Reason.OK:
                down.setdefault(service.name, {})[service.reason] = None
    return {name: tuple(reasons) for name, reasons in down.items()}


def _named(report: DaemonReport) -> tuple[Reason, ...]:
    match report:
        case Event():
            return (report.reason,)
        case GateState():
            return report.reasons
        case HealthTable():
            return ()


def shortcomings(scenario: Scenario, reaction: Reaction) -> list[str]:
    """Return all violated goals of a reaction; empty if all are met."""
    return [*_reaction(scenario, reaction), *_account(scenario, reaction), *_afterwards(scenario, reaction)]


def _reaction(scenario: Scenario, got: Reaction) -> Iterator[str]:
    for violation in got.violations:
        yield f"unsafe after {violation.seconds:.2f} s: {violation.rule}: {violation.text}"
    match scenario.expect:
        case Expect.STOP:
            yield from _stops_in_time(got)
        case Expect.STOP_AHEAD if got.standstill_after_s is None:
            yield "did not stop"
        case Expect.STOP_AGAIN:
            yield from _late(got.standstill_after_s, got.ended_after_s + STANDSTILL_AGAIN, "standstill")
        case Expect.STOP_BY_LINE:
            yield from _late(got.standstill_after_s, STANDSTILL_BY_LINE, "standstill")
        case Expect.ENDURE if got.reason is not None:
            limit = STANDSTILL_AGAIN if scenario.device == DeviceRole.DRIVE else STOP_AFTER_SAMPLE + STANDSTILL
            if got.moved_by_itself and got.stop_bytes_after_s is not None:  # driving went on until this stop
                limit = max(limit, got.stop_bytes_after_s + STANDSTILL)
            yield from _late(got.standstill_after_s, limit, "standstill")
        case Expect.GO_ON | Expect.SLOW_DOWN if got.reason is not None or got.standstill_after_s is not None:
            yield f"stopped: {got.reason}"
        case Expect.REFUSE if got.top_speed > STANDING_SPEED:
            yield f"moved at {got.top_speed:.2f} m/s"
        case Expect.EXIT:
            yield from _stops_in_time(got)
            if not got.exited:
                yield "the daemon did not exit"


def _stops_in_time(got: Reaction) -> Iterator[str]:
    if got.stop_bytes_after_s is None or got.detected_after_s is None:
        yield "no stop on the wire"
        return
    yield from _late(got.stop_bytes_after_s, got.detected_after_s + STOP_AFTER_DETECTION, "stop bytes")
    if got.stop_bytes_after_sample_s is not None:
        yield from _late(got.stop_bytes_after_sample_s, STOP_AFTER_SAMPLE, "stop bytes, from the last sample,")
    began = max(got.stop_bytes_after_s, got.detected_after_s)
    yield from _late(got.standstill_after_s, began + STANDSTILL, "standstill")


def _late(seconds: float | None, limit: float, what: str) -> Iterator[str]:
    if seconds is None or seconds > limit:
        yield f"{what} after {seconds} s: at most {limit:.3f} s"


def _account(scenario: Scenario, got: Reaction) -> Iterator[str]:
    """Yield the violations in reported reasons and services."""
    places = [got.seen.index(reason) if reason in got.seen else -1 for reason in scenario.seen]
    if -1 in places or places != sorted(places):
        yield f"reported {', '.join(got.seen)}: expected {', '.join(scenario.seen)}"
    stopping = scenario.expect in (Expect.STOP, Expect.STOP_AHEAD, Expect.STOP_AGAIN, Expect.STOP_BY_LINE)
    if stopping and scenario.seen and got.reason is not scenario.seen[-1]:
        yield f"stopped for {got.reason}: expected {scenario.seen[-1]}"
    for service, reason in scenario.down.items():
        if reason not in got.down.get(service, ()):
            yield f"{service} down for {', '.join(got.down.get(service, ()))}: expected {reason}"
    allowed = {*scenario.down, *((scenario.device,) if scenario.device else ())}
    if scenario.expect is not Expect.EXIT and (others := got.down.keys() - allowed):
        yield f"{', '.join(sorted(others))} down too"


def _afterwards(scenario: Scenario, got: Reaction) -> Iterator[str]:
    if scenario.expect is Expect.EXIT:
        return
    if scenario.recovers and got.recovered_after_s is None:
        yield f"not recovered within {scenario.timeout:g} s"
    if scenario.recovers and not got.drove_again:
        yield "cannot be driven again"
    if scenario.expect is not Expect.ENDURE and got.moved_by_itself is not scenario.resumes:
        yield "moved by itself" if got.moved_by_itself else "did not go on by itself"


def cells(scenario: Scenario, reaction: Reaction) -> tuple[str, ...]:
    """Return one row of the table: seconds from the fault (``back``: from its end), metres."""
    reasons: list[str] = [*scenario.seen[-1:]] or sorted(set(scenario.down.values())) or [reaction.reason or "-"]
    return (
        reaction.fault,
        _seconds(reaction.detected_after_s),
        _seconds(reaction.stop_bytes_after_s),
        _seconds(reaction.standstill_after_s),
        f"{reaction.metres:.3f}",
        ", ".join(reasons),
        _seconds(reaction.recovered_after_s),
    )


def stop_bytes(tap: WireTap, since: int) -> int | None:
    """Return the time when the first stopping write reached an EPOS: target 0, quick stop, halt, off."""
    for instant, index, value in written(tap, since):
        target = index == od.TARGET_VELOCITY.index and value == 0
        if target or (index == od.CONTROLWORD.index and value in STOP_CONTROLS):
            return instant
    return None


def _seconds(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"
