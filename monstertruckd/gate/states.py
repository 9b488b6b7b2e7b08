"""The gate's state machine, and the events that its transitions and refusals emit."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final

from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.ports import Value
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.state import GateMode
from monstertruckd.gate.sources import Key, Source

MAX_KEYS: Final = 64
"""Different events (reason and source) within one interval: sources may invent any number of names."""

MODE_REASONS: Final = {GateMode.ESTOPPED: (Reason.ESTOPPED,), GateMode.DISARMED: (Reason.DISARMED,)}
"""Why the truck does not drive in these modes."""


@dataclass(frozen=True, slots=True)
class GateEvent:
    """One decision, refusal or transition."""

    reason: Reason
    severity: Severity
    text: str
    values: dict[str, Value]


class EventLog:
    """Collects events between two ticks.

    Args:
        interval: least seconds between two events of one reason and source; those in between are counted.
    """

    def __init__(self, interval: float) -> None:
        self._interval = round(interval * SECOND)
        self._events: list[GateEvent] = []
        self._emitted: dict[tuple[Reason, str], tuple[int, int]] = {}
        """When each was emitted last, ns, and how many were suppressed since."""

    def emit(
        self,
        now: int,
        reason: Reason,
        severity: Severity,
        text: str = "",
        values: Mapping[str, Value] | None = None,
        *,
        source: str = "",
        always: bool = False,
    ) -> None:
        """Add an event; repetitions within the interval only raise the next one's ``repeated``.

        Args:
            now: ns.
            reason: what happened.
            severity: how bad it is.
            text: default: the reason's own.
            values: measurements behind it.
            source: program or person it is about.
            always: never suppressed, as for transitions.
        """
        key = (reason, source)
        if key not in self._emitted and len(self._emitted) >= MAX_KEYS:
            self._emitted = {other: at for other, at in self._emitted.items() if now - at[0] < self._interval}
            if len(self._emitted) >= MAX_KEYS and not always:
                return
        last, repeated = self._emitted.get(key, (now - self._interval, 0))
        if not always and now - last < self._interval:
            self._emitted[key] = (last, repeated + 1)
            return
        self._emitted[key] = (now, 0)
        fields: dict[str, Value] = {**(values or {})}
        if source:
            fields["by"] = source
        if repeated:
            fields["repeated"] = repeated
        self._events.append(GateEvent(reason, severity, text or reason.text, fields))

    def drain(self) -> tuple[GateEvent, ...]:
        """Events since the last call."""
        events = tuple(self._events)
        self._events.clear()
        return events


class GateStateMachine:
    """Disarmed > armed > driving > stopping > (armed | disarmed); an emergency stop from any state latches.

    Args:
        events: receives the transitions.
        latched: whether it begins with the emergency stop latched.
    """

    def __init__(self, events: EventLog, *, latched: bool) -> None:
        self._events = events
        self.mode = GateMode.ESTOPPED if latched else GateMode.DISARMED
        self.since = 0
        """When this mode was entered, ns."""
        self.holder: Source | None = None
        """The driving source; None in every mode but driving."""
        self.driven = 0
        """When a source last drove, or the truck was armed, ns."""
        self.disarm_at_rest = False
        """Disarm as soon as the truck is at rest."""
        self._stopped_by: tuple[Reason, ...] = ()

    @property
    def active(self) -> bool:
        """Whether the truck is armed, drives, or is being stopped."""
        return self.mode.active

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """Why the truck does not drive in the present mode."""
        return MODE_REASONS.get(self.mode, self._stopped_by)

    @property
    def holder_key(self) -> Key | None:
        """Key of the driving source."""
        return None if self.holder is None else self.holder.key

    @property
    def holder_name(self) -> str | None:
        """Name of the driving source."""
        return None if self.holder is None else self.holder.request.source

    def arm(self, now: int, by: str) -> None:
        """Arm; on an armed truck this restarts the time until it disarms by itself."""
        self.driven = now
        if self.mode is GateMode.DISARMED:
            self._enter(GateMode.ARMED, now)
            self.disarm_at_rest = False
            self._events.emit(now, Reason.ARMED, Severity.INFO, source=by, always=True)

    def drive(self, now: int, driver: Source) -> None:
        """``driver`` begins or continues to drive."""
        if self.mode is not GateMode.DRIVING:
            self._enter(GateMode.DRIVING, now)
        if self.holder_key != driver.key:
            request = driver.request
            values = {"role": request.role.value}
            self._events.emit(now, Reason.DRIVING, Severity.INFO, "", values, source=request.source, always=True)
        self.holder, self.driven = driver, now

    def stop(self, now: int, reasons: Iterable[Reason]) -> None:
        """Begin to stop."""
        self._enter(GateMode.STOPPING, now)
        self._stopped_by = tuple(dict.fromkeys(reasons))

    def release(self, now: int) -> None:
        """The driver ended its requests while the truck was at rest."""
        text = f"{self.holder_name} released control"
        self._enter(GateMode.ARMED, now)
        self._events.emit(now, Reason.STOPPED, Severity.INFO, text)

    def rest(self, now: int) -> None:
        """The stopped truck is at rest."""
        self._enter(GateMode.ARMED, now)
        self._events.emit(now, Reason.STOPPED, Severity.INFO, always=True)

    def disarm(self, now: int, text: str) -> None:
        """Disarm; ``text`` says why."""
        self._enter(GateMode.DISARMED, now)
        self.disarm_at_rest = False
        self._events.emit(now, Reason.DISARMED, Severity.INFO, text, always=True)

    def latch(self, now: int) -> None:
        """Latch the emergency stop."""
        self._enter(GateMode.ESTOPPED, now)

    def _enter(self, mode: GateMode, now: int) -> None:
        self.mode, self.since, self.holder, self._stopped_by = mode, now, None, ()
