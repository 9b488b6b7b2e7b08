"""Grades and validity of calibrations, and the service that monitors them.

Values based on an expired calibration are marked ``degraded``; the truck can still drive. A calibration expires by
time, by the distance travelled since the calibration, or when the measured device was replaced (detected by its serial
number, if USB provides one) or is on another port.
"""

import itertools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Final

import numpy as np
from pydantic import Field

from monstertruck_kinematics.truck import DriveTrain
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import InputError, disk_reason
from monstertruck_runtime.mailbox import latest
from monstertruck_runtime.outside import contents_if_present, reading
from monstertruck_runtime.ports import EventSink, Ready
from monstertruck_runtime.small_files import make_folder, put_aside, replace_file
from monstertruck_runtime.threads import Offload
from monstertruck_schemas.base import Schema
from monstertruck_schemas.event import Severity
from monstertruck_schemas.health import CalibrationHealth, CalibrationState
from monstertruck_schemas.plan import TrackerState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.roles import ServiceName
from monstertruck_schemas.topics import (
    CALIBRATION,
    DRIVE,
    TRACKER,
    USB,
    Writer,
)
from monstertruck_schemas.usb import UsbTree
from monstertruckd.bus.local import Bus
from monstertruckd.config.calibration import Estimate, Grade, Result, ValidUntil, WizardName, utc
from monstertruckd.config.proposal import SteeringProposal
from monstertruckd.config.truck import TruckConfig
from monstertruckd.config.wizards import WIZARDS

DAY: Final = 86_400 * SECOND
"""Period between two messages, ns."""


_UNKNOWN: Final[Mapping[str, str]] = MappingProxyType({})


def grade(wizard: WizardName, estimate: Estimate) -> Grade | None:
    """Grade of an interval: A: as narrow as intended; B: at most twice as wide; C: wider; None: no target width."""
    goals = WIZARDS[wizard].goals
    goal = goals.get(estimate.name, goals.get(f"*_{estimate.name.rpartition('_')[2]}"))
    if goal is None or estimate.low is None or estimate.high is None:
        return None
    half = (estimate.high - estimate.low) / 2
    meant = goal.half * abs(estimate.value) if goal.share else goal.half
    share = half / meant if meant else np.inf
    return "A" if share <= 1.0 else "B" if share <= 2.0 else "C"


def part_of(config: TruckConfig, role: str) -> str:
    """Device of a role and its port; empty if there is no such device."""
    device = config.devices.present().get(role)
    if device is None:
        return ""
    port = device.port.model_dump(mode="json", exclude={"baud"}, exclude_none=True)
    serial = getattr(device.driver, "serial_number", None)
    return " ".join((device.kind.name, *map(str, port.values()), *((serial,) if serial else ())))


def serials_of(tree: UsbTree) -> dict[str, str]:
    """Serial numbers, by role, of the devices configured by hub and port."""
    return {node.role: node.serial for node in tree.nodes if node.role is not None and node.serial is not None}


def stamped(
    result: Result, config: TruckConfig, real_ns: int, odometer: float, serials: Mapping[str, str] = _UNKNOWN
) -> Result:
    """Return a result with grades and validity of its estimates, as saved now; ``serials`` where known."""
    life = WIZARDS[result.wizard].lifetime
    until = ValidUntil(
        date=utc(real_ns + life.days * DAY),
        odometer=None if life.metres is None else odometer + life.metres,
        part=part_of(config, life.role),
        serial=serials.get(life.role, ""),
    )
    estimates = tuple(
        e.model_copy(update={"grade": grade(result.wizard, e), "valid_until": until}) for e in result.estimates
    )
    return result.model_copy(update={"estimates": estimates})


def worst(result: Result) -> Grade:
    """Grade of a result: the worst grade among its estimates; C if no estimate has a grade."""
    grades = [g for e in result.estimates if (g := e.grade or grade(result.wizard, e)) is not None]
    return max(grades, default="C")


def state_of(
    result: Result, config: TruckConfig, real_ns: int, odometer: float, serials: Mapping[str, str] = _UNKNOWN
) -> CalibrationState:
    """Grade and validity of a result now; ``serials`` where known."""
    ends = [e.valid_until for e in result.estimates if e.valid_until is not None]
    life = WIZARDS[result.wizard].lifetime
    until = min((end.date for end in ends), default=_later(result.date, life.days))
    ways = [end.odometer for end in ends if end.odometer is not None]
    left = min(ways) - odometer if ways else None
    now, part = utc(real_ns), part_of(config, life.role)
    before = next((end.part for end in ends if end.part and end.part != part), None)
    serial = serials.get(life.role, "")
    other = next((end.serial for end in ends if end.serial and serial and end.serial != serial), None)
    expired = ""
    if before is not None:
        expired = f"{life.role} was {before}, it is {part or 'gone'}"
    elif other is not None:
        expired = f"{life.role} was the device with serial number {other}, it is {serial}"
    elif now > until:
        expired = f"measured {result.date[:10]}, valid until {until[:10]}"
    elif left is not None and left < 0.0:
        expired = f"distance driven exceeds its validity by {-left / 1000:.1f} km"
    return CalibrationState(
        wizard=result.wizard, grade=worst(result), date=result.date, until=until, metres_left=left, expired=expired
    )


def _later(date: str, days: int) -> str:
    return f"{np.datetime64(date.rstrip('Z'), 's') + np.timedelta64(days, 'D')}Z" if date else ""


class _Distance(Schema):
    """Content of the file of the distance travelled."""

    metres: Annotated[float, Field(ge=0.0, allow_inf_nan=False)]


@dataclass
class DistanceCounter:
    """Total distance travelled (m), kept across restarts.

    Args:
        file: file for the distance; None if it is not saved.
    """

    file: Path | None
    metres: float = 0.0
    written: float = 0.0

    def load(self) -> str:
        """Read the file; the distance starts at 0 if it is missing, unreadable or damaged.

        Returns:
            Fault of the file; empty if it is intact or missing.
        """
        self.metres = self.written = 0.0
        if self.file is None:
            return ""
        expected = "the distance driven"
        try:
            data = contents_if_present(self.file, expected, 1000)  # maximum size of the file, bytes
            if data is not None:
                with reading(self.file, expected):
                    self.metres = self.written = _Distance.model_validate_json(data).metres
        except InputError as error:
            return str(error)
        return ""

    def save(self) -> None:
        """Write the file atomically.

        Raises:
            OSError: the file cannot be written.
        """
        if self.file is None:
            return
        make_folder(self.file.parent)
        replace_file(self.file, _Distance(metres=round(self.metres, 1)).model_dump_json())
        self.written = self.metres


class CalibrationWatch:
    """Counts the distance travelled, publishes the state of every calibration, and marks values based on expired ones.

    Args:
        config: running configuration.
        results: results of the calibration in use.
        bus: bus whose messages are marked.
        clock: time source.
        events: receives events, one for each expiry.
        offload: runs file writes.
        odometer: total distance travelled.
        proposal: store for the trackers' proposal; None without one.
    """

    name = ServiceName.CALIBRATION.value

    def __init__(
        self,
        config: TruckConfig,
        results: Mapping[WizardName, Result],
        bus: Bus,
        clock: Clock,
        events: EventSink,
        offload: Offload,
        odometer: DistanceCounter,
        proposal: SteeringProposal | None = None,
    ) -> None:
        self._config = config
        self._results = dict(results)
        self._bus = bus
        self._clock = clock
        self._events = events
        self._offload = offload
        self.odometer = odometer
        self.proposal = proposal
        self._train = DriveTrain(config.geometry.drive_ratio, config.geometry.wheel_radius)
        self._out = bus.publisher(CALIBRATION, Writer.DAEMON)
        self._expired: frozenset[str] = frozenset()
        self._serials: dict[str, str] = {}

    async def _begin(self) -> None:
        """Read the distance; a damaged file is kept next to the new file."""
        wrong, file = await self._offload(self.odometer.load), self.odometer.file
        if wrong and file is not None:
            where = await self._offload(lambda: put_aside(file))
            text = f"{wrong}: the distance driven restarts at 0, so calibrations expire later; {where}"
            self._events(Reason.FILE_DAMAGED, Severity.WARNING, self.name, text)
        proposal = self.proposal
        if proposal is not None and (wrong := await self._offload(proposal.load)):
            where = await self._offload(proposal.put_aside)
            text = f"{wrong}: the proposed calibration is lost and must be learnt again; {where}"
            self._events(Reason.FILE_DAMAGED, Severity.WARNING, self.name, text)

    async def consider(self, state: TrackerState) -> None:
        """Propose a tracker's estimate of the steering if it is new."""
        proposal = self.proposal
        if proposal is None or not proposal.consider(state, utc(self._real())):
            return
        self._look()
        if proposal.result is not None:
            text = f"{proposal.result.measured}; `calibrate accept` saves it"
            self._events(Reason.OK, Severity.INFO, self.name, text)
        await self._keep_proposal(proposal)

    async def close_proposal(self) -> None:
        """Drop the proposal because the steering was calibrated, or its calibration was undone."""
        if self.proposal is not None:
            self.proposal.close()
            self._look()
            await self._keep_proposal(self.proposal)

    async def _keep_proposal(self, proposal: SteeringProposal) -> None:
        try:
            await self._offload(proposal.save)
        except OSError as error:
            text = f"{proposal.file}: the proposed calibration cannot be saved: {error.strerror}"
            self._events(disk_reason(error), Severity.WARNING, self.name, text)

    def stamped(self, result: Result) -> Result:
        """Calibration as saved now."""
        return stamped(result, self._config, self._real(), self.odometer.metres, self._serials)

    def states(self) -> list[CalibrationState]:
        """Validity of every wizard's current result."""
        now, way = self._real(), self.odometer.metres
        return [state_of(r, self._config, now, way, self._serials) for r in self._results.values()]

    async def run(self, ready: Ready) -> None:
        """Run until cancelled; the distance is saved at the end."""
        await self._begin()
        self._expired = frozenset()
        self._look()
        ready()
        publish = 60  # periods between two messages, and between two writings of the odometer
        with (
            self._bus.subscribe(DRIVE, latest()) as drive,
            self._bus.subscribe(USB, latest()) as usb,
            self._bus.subscribe(TRACKER, latest()) as tracker,
        ):
            before: float | None = None
            try:
                # Seconds between two checks of the drive's position: at a reversal at most half of the travel in this
                # time is missed.
                drive_check_period = 1.0
                for count in itertools.count(1):
                    await self._clock.sleep(drive_check_period)
                    if drive.latest is not None:
                        here = drive.latest.position
                        if before is not None:
                            self.odometer.metres += abs(float(self._train.distance(here - before)))
                        before = here
                    if tracker.latest is not None:
                        await self.consider(tracker.latest)
                    serials = self._serials if usb.latest is None else self._serials | serials_of(usb.latest)
                    replaced, self._serials = serials != self._serials, serials
                    if replaced or count % publish == 0:
                        self._look()
                    if count % publish == 0:
                        await self._keep()
            finally:
                await self._keep()

    async def _keep(self) -> None:
        odometer = self.odometer
        # 1.0: minimum distance that is written, m, to spare the memory card
        if odometer.file is None or abs(odometer.metres - odometer.written) < 1.0:
            return
        try:
            await self._offload(odometer.save)
        except OSError as error:
            text = f"{odometer.file}: the distance driven cannot be saved: {error.strerror}"
            self._events(disk_reason(error), Severity.WARNING, self.name, text)

    def _look(self) -> None:
        now = self._clock.now()
        states = self.states()
        expired = {state.wizard: state.expired for state in states if state.expired}
        for wizard in expired.keys() - self._expired:
            self._events(Reason.CALIBRATION_EXPIRED, Severity.WARNING, self.name, f"{wizard}: {expired[wizard]}")
        self._expired = frozenset(expired)
        self._bus.degraded = degraded_topics(expired)
        self._out.put(
            CalibrationHealth(
                stamp=now,
                received=now,
                seq=self._out.next_seq(),
                wizards=tuple(states),
                odometer=round(self.odometer.metres, 1),
                proposed="" if self.proposal is None or self.proposal.result is None else self.proposal.result.measured,
            )
        )

    def _real(self) -> int:
        return self._clock.now() + self._clock.real_offset()


def degraded_topics(expired: Iterable[str]) -> frozenset[str]:
    """Topics that depend on expired results."""
    return frozenset(topic for name in expired for topic in WIZARDS[name].lifetime.topics)
