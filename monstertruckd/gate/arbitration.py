"""Who may drive: sources of requests, their leases, the choice of the driver, and the gate's state machine.

Rules:

- A request is valid only with this run's nonce and a sequence number above the newest one of its source and kind.
- While the lease of a source runs, no other program takes over its name.
- A request that may set the truck in motion must carry the stamp of a recent gate state: it cannot have waited long in
  a queue then. The stamp is of the robot's own clock, so no other clock has to be trusted.
- Operators send from outside, the tracker from inside; a tracker on another machine only if the configuration names it.
- The source of the highest role with a valid lease drives; among equal roles the one that drives already, but of the
  robot's own planners one that requests motion before one that requests standstill.
- Control passes to a higher role at once, to a lower one only after a new ARM order: once a role has driven, or has
  ordered a stop, lower roles are refused until the truck is armed again. So a tracker never continues by itself after
  an operator has released the stick.
- After a STOP order every source must send a neutral request before it may drive again, until the truck is armed again;
  for one that was driving, none for its lease is as good. A source that is new after the stop is no exception.
- An ARM order with ``hold`` keeps planners out until one without.
- An operator who drives may hand over to one who has asked. For a moment nobody else of their priority may drive, and
  the former driver not before a neutral request.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final

from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.ports import Value
from monstertruck_runtime.requests import OPERATORS, Sequences, crowded, freshness
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import STARTING, ControlRequest, DriveRequest, Role
from monstertruck_schemas.state import GateMode
from monstertruckd.gate.config import GateConfig

PRIORITY: Final = {role: rank for rank, role in enumerate(reversed(Role))}
"""The greater number wins."""

Key = tuple[bool, str]


ASKING: Final = 20 * SECOND
"""An operator who asks for the drive is forgotten after this, ns."""

MODE_REASONS: Final = {GateMode.ESTOPPED: (Reason.ESTOPPED,), GateMode.DISARMED: (Reason.DISARMED,)}
"""Why the truck does not drive in these modes."""


@dataclass(slots=True)
class Source:
    """Newest request of one source."""

    request: DriveRequest
    deadline: int
    """End of its lease, ns."""
    arrived: int
    """When the request came, ns."""
    inside: bool
    """One of the robot's own planners."""
    held: bool = False
    """Must send a neutral request before it may drive."""

    @property
    def key(self) -> Key:
        """Unique key: a source outside cannot act for a planner by taking its name."""
        return self.inside, self.request.source

    @property
    def neutral(self) -> bool:
        """Whether it requests standstill."""
        return self.request.neutral

    @property
    def requests_motion(self) -> bool:
        """Whether it is a planner that requests motion."""
        return self.inside and not self.neutral

    @property
    def rank(self) -> int:
        """Its priority."""
        return PRIORITY[self.request.role]


class Sources:
    """All requests of this run.

    Args:
        nonce: of this run; requests must carry it.
        config: leases, request age and remote trackers.
    """

    def __init__(self, nonce: str, config: GateConfig) -> None:
        self.nonce = nonce
        self._config = config
        self._planner_requests = Sequences()
        self._requests = Sequences(config.max_request_age)
        self._orders = Sequences(config.max_request_age)
        self._drive: dict[Key, Source] = {}
        self._min_rank = 0
        self._released: dict[Key, None] | None = None
        """Sources that were live at the STOP order or have been neutral since, the least recent first; None = there
        was none."""
        self._stop = "", 0
        """Source and time (ns) of the newest order that stops."""
        self._stop_of_others = "", 0
        """Source and time (ns) of the newest such order of another source."""
        self._asking: dict[str, int] = {}
        """Operators who ask for the drive, and until when that counts, ns."""
        self._handed: tuple[str, int, int] | None = None
        """Operator to whom the drive was handed over, until when (ns) and below which rank others wait for it."""

    def accept_request(self, request: DriveRequest, now: int) -> Reason:
        """OK, or why a drive request from outside is refused."""
        if request.role not in OPERATORS and not (
            request.role is Role.TRACKER and request.source in self._config.remote_trackers
        ):
            return Reason.BAD_ROLE
        alive = {source.request.source: source.request for source in self.live(now) if not source.inside}
        if request.source in alive and alive[request.source].instance != request.instance:
            return Reason.BUSY
        reason = self._requests.accept(request, self.nonce, now, alive)
        return freshness(request, now, self._config.max_request_age) if reason is Reason.OK else reason

    def accept_planner_request(self, request: DriveRequest, now: int) -> Reason:
        """OK, or why a drive request of the robot's own planners is refused."""
        if request.role is not Role.TRACKER:
            return Reason.BAD_ROLE
        return self._planner_requests.accept(request, self.nonce, now)

    def accept_order(self, request: ControlRequest, now: int) -> Reason:
        """OK, or why an order is refused."""
        reason = self._orders.accept(request, self.nonce, now)
        if reason is Reason.OK and request.order in STARTING:
            return freshness(request, now, self._config.max_request_age)
        return reason

    def stopped(self, source: str, now: int) -> None:
        """A source ordered a stop: orders of others that start are refused if their sender did not know of it.

        Args:
            source: empty = not authenticated, another than every source.
            now: ns.
        """
        if source != self._stop[0]:
            self._stop_of_others = self._stop
        self._stop = source, now

    def overtaken(self, request: ControlRequest) -> str:
        """Which other source has ordered a stop since the gate state that the sender of an order that starts knew.

        Empty if none has.
        """
        stopped_by, at = self._stop_of_others if request.source == self._stop[0] else self._stop
        if request.order not in STARTING or request.gate_stamp is None or request.gate_stamp >= at:
            return ""
        return stopped_by or "a source that is not authenticated"

    def add(self, request: DriveRequest, now: int, *, inside: bool) -> Source:
        """Start or renew the lease of an accepted request."""
        lease = min(request.lease, self._config.leases.of(request.role))
        key = (inside, request.source)
        before = self._drive.get(key)
        source = Source(request, now + round(lease * SECOND), now, inside)
        if not source.neutral:
            source.held = self._unheard(key) or (before is not None and before.held and now <= before.deadline)
        self._drive = {other: it for other, it in self._drive.items() if now <= it.deadline}
        self._drive[key] = source
        if source.neutral and self._released is not None:
            self._remember_neutral(key, self._released)
        return source

    def live(self, now: int) -> list[Source]:
        """Sources whose lease has not expired."""
        return [source for source in self._drive.values() if now <= source.deadline]

    def driver(self, now: int, holder: Key | None) -> Source | None:
        """The source that may drive now.

        Args:
            now: ns.
            holder: key of the driving source.
        """
        able = [
            source
            for source in self.live(now)
            if not source.held and source.rank >= self._min_rank and not self._waits(source, now)
        ]
        return max(able, key=lambda source: (source.rank, source.requests_motion, source.key == holder), default=None)

    def ask(self, name: str, now: int) -> None:
        """An operator asks for the drive."""
        self._asking = {other: until for other, until in self._asking.items() if now <= until and other != name}
        while len(self._asking) >= 4:  # operators who ask at once; one more replaces the oldest
            del self._asking[next(iter(self._asking))]
        self._asking[name] = now + ASKING

    def asking(self, now: int) -> tuple[str, ...]:
        """Operators who ask for the drive, the newest last."""
        return tuple(name for name, until in self._asking.items() if now <= until)

    def hand_over(self, holder: Source, to: str, now: int) -> None:
        """``holder`` lets ``to`` drive; it must send a neutral request before it may drive itself."""
        # Since the tick that made it the holder it may have sent a newer request.
        self._drive.get(holder.key, holder).held = True
        self._asking.pop(to, None)
        handed = 3 * SECOND  # others wait so long for the operator to whom the drive was handed over, ns
        self._handed = to, now + handed, holder.rank
        self._min_rank = min(self._min_rank, PRIORITY[Role.STATION])

    def handed_to(self, now: int) -> str | None:
        """Operator to whom the drive was handed over just now."""
        return self._handed[0] if self._handed is not None and now <= self._handed[1] else None

    def live_name(self, name: str, now: int) -> bool:
        """Whether an operator of this name sends requests."""
        return any(not source.inside and source.request.source == name for source in self.live(now))

    def _waits(self, source: Source, now: int) -> bool:
        """Whether the drive was just handed over to another than this one."""
        to = self.handed_to(now)
        if to is None or (source.request.source == to and not source.inside):
            return False
        return self._handed is not None and source.rank <= self._handed[2]

    def priority(self, source: Source, now: int, holder: Key | None) -> Reason:
        """OK if this source drives or would drive, or why not."""
        if source.held:
            return Reason.NOT_ARMED_SPEED
        driver = self.driver(now, holder)
        if driver is source:
            return Reason.OK
        if driver is not None and driver.rank == source.rank:
            return Reason.BUSY
        return Reason.LOWER_PRIORITY

    def requesting_motion(self, now: int) -> tuple[str, ...]:
        """Names of the operators who have a valid lease and request motion; a planner may wait to be let drive."""
        return tuple(s.request.source for s in self.live(now) if s.request.role in OPERATORS and not s.neutral)

    def claim(self, role: Role) -> None:
        """``role`` has driven or stopped the truck: lower roles wait for the next ARM order."""
        self._min_rank = max(self._min_rank, PRIORITY[role])

    def hold(self, now: int) -> None:
        """Every source must send a neutral request before it may drive."""
        self._released = dict.fromkeys(source.key for source in self.live(now))
        for source in self._drive.values():
            source.held = True

    def _unheard(self, key: Key) -> bool:
        """Whether a source was neither live at the STOP order nor has been neutral since."""
        return self._released is not None and key not in self._released

    def _remember_neutral(self, key: Key, released: dict[Key, None]) -> None:
        """Add a source to the released ones; where there are too many, the least recent one without a lease goes."""
        released.pop(key, None)
        others = [name for inside, name in released if not inside]
        if not key[0] and (crowd := crowded(others, key[1])):
            oldest = next((name for name in crowd if (False, name) not in self._drive), None)
            if oldest is None:
                return
            del released[False, oldest]
        released[key] = None

    def release(self, *, planners: bool) -> None:
        """End ``claim`` and ``hold``: the truck was armed again.

        Args:
            planners: may drive as well.
        """
        self._min_rank = 0 if planners else PRIORITY[Role.STATION]
        self._released = None
        for source in self._drive.values():
            source.held = False

    def waiting(self, now: int) -> tuple[str, ...]:
        """Names of the planners that request motion."""
        return tuple(
            source.request.source
            for source in self.live(now)
            if source.request.role is Role.TRACKER and not source.neutral
        )


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
        lasting: bool = False,
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
            lasting: suppressed for as long as it repeats without a pause of the interval.
        """
        key = (reason, source)
        # Different events (reason and source) within one interval: sources may invent any number of names.
        max_keys = 64
        if key not in self._emitted and len(self._emitted) >= max_keys:
            self._emitted = {other: at for other, at in self._emitted.items() if now - at[0] < self._interval}
            if len(self._emitted) >= max_keys and not always:
                return
        last, repeated = self._emitted.get(key, (now - self._interval, 0))
        if not always and now - last < self._interval:
            self._emitted[key] = (now if lasting else last, repeated + 1)
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
        self._calibrates = False

    @property
    def active(self) -> bool:
        """Whether the truck is armed, drives, or is being stopped."""
        return self.mode.active

    @property
    def calibrates(self) -> bool:
        """Whether the truck is armed to calibrate sensors; see ``ControlRequest``."""
        return self._calibrates and self.active

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

    def arm(self, now: int, by: str, *, calibrates: bool = False) -> None:
        """Arm; on an armed truck this restarts the time until it disarms by itself."""
        self.driven = now
        self._calibrates = calibrates
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
