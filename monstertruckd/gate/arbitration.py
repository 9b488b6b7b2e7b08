"""Arbitration: sources of requests, their leases, the choice of the driver, and the gate's state machine.

Rules:

- A valid request has this run's nonce and a sequence number above the latest number of its source and kind.
- While a source holds a lease, no other program can take over its name.
- A request that may set the truck in motion must carry the stamp of a recent gate state, which proves that it has not
  waited long in a queue. The stamp comes from the robot's clock, so no other clock has to be trusted.
- Operators send requests from outside the daemon, the tracker from inside; a tracker on another machine must be listed
  in the configuration.
- The source with the highest role and a valid lease drives. Among equal roles the driving source keeps control, except
  that a planner of the robot that requests motion takes precedence over a planner that requests standstill.
- Control passes to a higher role immediately, but to a lower role only after a new ARM order: once a role has driven
  or ordered a stop, requests from lower roles are refused until the truck is armed again. So a tracker never resumes by
  itself after an operator has released the stick.
- After a STOP order every source, even a new source, must send a neutral request before it may drive again. For a
  source that was driving, staying silent for the length of its lease is equivalent. A new ARM order ends this rule.
- An ARM order with ``hold`` blocks planners until the next ARM order without ``hold``.
- A driving operator may hand over to an operator who has asked for control. For a moment no other source of the same
  priority may drive; the former driver must first send a neutral request.
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
"""Priority of each role; the higher number wins."""

Key = tuple[bool, str]


ASKING: Final = 20 * SECOND
"""Lifetime of an operator's request for the drive, ns."""

MODE_REASONS: Final = {GateMode.ESTOPPED: (Reason.ESTOPPED,), GateMode.DISARMED: (Reason.DISARMED,)}
"""Reasons why the truck does not drive, by mode."""


@dataclass(slots=True)
class Source:
    """Latest request of one source."""

    request: DriveRequest
    deadline: int
    """End of its lease, ns."""
    arrived: int
    """Arrival of the request, ns."""
    inside: bool
    """Whether the source is a planner of the robot."""
    held: bool = False
    """Whether the source must send a neutral request before it may drive."""

    @property
    def key(self) -> Key:
        """Unique key; an external source cannot impersonate a planner by using its name."""
        return self.inside, self.request.source

    @property
    def neutral(self) -> bool:
        """Whether the source requests standstill."""
        return self.request.neutral

    @property
    def requests_motion(self) -> bool:
        """Whether the source is a planner that requests motion."""
        return self.inside and not self.neutral

    @property
    def rank(self) -> int:
        """Priority of the source."""
        return PRIORITY[self.request.role]


class Sources:
    """All requests of this run.

    Args:
        nonce: nonce of this run; requests must carry it.
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
        """Sources that were live at the STOP order or have been neutral since, least recent first; None without a STOP
        order."""
        self._stop = "", 0
        """Source and time (ns) of the latest stopping order."""
        self._stop_of_others = "", 0
        """Source and time (ns) of the latest stopping order of another source."""
        self._asking: dict[str, int] = {}
        """Operators who ask for the drive, with the expiry of their request, ns."""
        self._handed: tuple[str, int, int] | None = None
        """Operator who received the drive, end of the wait of others (ns), and the highest rank that waits."""

    def accept_request(self, request: DriveRequest, now: int) -> Reason:
        """Return OK, or why an external drive request is refused."""
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
        """Return OK, or why a drive request from the robot's planners is refused."""
        if request.role is not Role.TRACKER:
            return Reason.BAD_ROLE
        return self._planner_requests.accept(request, self.nonce, now)

    def accept_order(self, request: ControlRequest, now: int) -> Reason:
        """Return OK, or why an order is refused."""
        reason = self._orders.accept(request, self.nonce, now)
        if reason is Reason.OK and request.order in STARTING:
            return freshness(request, now, self._config.max_request_age)
        return reason

    def stopped(self, source: str, now: int) -> None:
        """Record a stop ordered by a source; refuse starting orders from other sources that did not know of the stop.

        Args:
            source: name of the source; empty if not authenticated, which differs from every source.
            now: current time (ns).
        """
        if source != self._stop[0]:
            self._stop_of_others = self._stop
        self._stop = source, now

    def overtaken(self, request: ControlRequest) -> str:
        """Return another source that ordered a stop after the gate state known to the sender of a starting order.

        Empty if there is no such source.
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
        """Return the source that may drive now.

        Args:
            now: current time (ns).
            holder: key of the source that is driving.
        """
        able = [
            source
            for source in self.live(now)
            if not source.held and source.rank >= self._min_rank and not self._waits(source, now)
        ]
        return max(able, key=lambda source: (source.rank, source.requests_motion, source.key == holder), default=None)

    def ask(self, name: str, now: int) -> None:
        """Record that an operator asks for control."""
        self._asking = {other: until for other, until in self._asking.items() if now <= until and other != name}
        while len(self._asking) >= 4:  # maximum number of operators who ask at once; one more replaces the oldest
            del self._asking[next(iter(self._asking))]
        self._asking[name] = now + ASKING

    def asking(self, now: int) -> tuple[str, ...]:
        """Operators who are asking for control, latest last."""
        return tuple(name for name, until in self._asking.items() if now <= until)

    def hand_over(self, holder: Source, to: str, now: int) -> None:
        """Hand control from ``holder`` to ``to``; ``holder`` must send a neutral request before driving again."""
        # The holder may have sent a later request since the tick that made it the holder.
        self._drive.get(holder.key, holder).held = True
        self._asking.pop(to, None)
        handed = 3 * SECOND  # time that others wait for the operator who received the drive, ns
        self._handed = to, now + handed, holder.rank
        self._min_rank = min(self._min_rank, PRIORITY[Role.STATION])

    def handed_to(self, now: int) -> str | None:
        """Operator who has just received control."""
        return self._handed[0] if self._handed is not None and now <= self._handed[1] else None

    def live_name(self, name: str, now: int) -> bool:
        """Return whether an external source with this name has a valid lease."""
        return any(not source.inside and source.request.source == name for source in self.live(now))

    def _waits(self, source: Source, now: int) -> bool:
        """Return whether the source must wait because another operator has just received control."""
        to = self.handed_to(now)
        if to is None or (source.request.source == to and not source.inside):
            return False
        return self._handed is not None and source.rank <= self._handed[2]

    def priority(self, source: Source, now: int, holder: Key | None) -> Reason:
        """Return OK if this source drives or would drive, otherwise the reason."""
        if source.held:
            return Reason.NOT_ARMED_SPEED
        driver = self.driver(now, holder)
        if driver is source:
            return Reason.OK
        if driver is not None and driver.rank == source.rank:
            return Reason.BUSY
        return Reason.LOWER_PRIORITY

    def requesting_motion(self, now: int) -> tuple[str, ...]:
        """Names of operators with a valid lease who request motion; planners are excluded."""
        return tuple(s.request.source for s in self.live(now) if s.request.role in OPERATORS and not s.neutral)

    def claim(self, role: Role) -> None:
        """Make lower roles wait for the next ARM order, because ``role`` has driven or stopped the truck."""
        self._min_rank = max(self._min_rank, PRIORITY[role])

    def hold(self, now: int) -> None:
        """Require every source to send a neutral request before it may drive."""
        self._released = dict.fromkeys(source.key for source in self.live(now))
        for source in self._drive.values():
            source.held = True

    def _unheard(self, key: Key) -> bool:
        """Return whether a source had no lease at the STOP order and has not sent a neutral request since."""
        return self._released is not None and key not in self._released

    def _remember_neutral(self, key: Key, released: dict[Key, None]) -> None:
        """Add a source to the released sources; if there are too many, drop the oldest source without a lease."""
        released.pop(key, None)
        others = [name for inside, name in released if not inside]
        if not key[0] and (crowd := crowded(others, key[1])):
            oldest = next((name for name in crowd if (False, name) not in self._drive), None)
            if oldest is None:
                return
            del released[False, oldest]
        released[key] = None

    def release(self, *, planners: bool) -> None:
        """End ``claim`` and ``hold`` because the truck was armed again.

        Args:
            planners: whether planners may also drive.
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
        interval: minimum time between two events with the same reason and source (s); suppressed events are counted.
    """

    def __init__(self, interval: float) -> None:
        self._interval = round(interval * SECOND)
        self._events: list[GateEvent] = []
        self._emitted: dict[tuple[Reason, str], tuple[int, int]] = {}
        """Time of the last emission (ns) and number of suppressed events since, by reason and source."""

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
        """Add an event; repetitions within the interval only increase ``repeated`` of the next event.

        Args:
            now: current time (ns).
            reason: reason for the event.
            severity: severity of the event.
            text: message; by default the text of the reason.
            values: measurements behind the event.
            source: program or person concerned.
            always: whether the event is never suppressed, as for transitions.
            lasting: whether to keep suppressing the event until it has been absent for one interval.
        """
        key = (reason, source)
        # Maximum number of different events (reason and source) per interval: sources may invent any number of names.
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
        """Return the events since the last call."""
        events = tuple(self._events)
        self._events.clear()
        return events


class GateStateMachine:
    """States: disarmed > armed > driving > stopping > (armed | disarmed); an emergency stop from any state latches.

    Args:
        events: log that receives the transitions.
        latched: whether the emergency stop is latched at the start.
    """

    def __init__(self, events: EventLog, *, latched: bool) -> None:
        self._events = events
        self.mode = GateMode.ESTOPPED if latched else GateMode.DISARMED
        self.since = 0
        """Time of entry into this mode, ns."""
        self.holder: Source | None = None
        """Driving source; None in every mode except driving."""
        self.driven = 0
        """Time when a source last drove or the truck was armed, ns."""
        self.disarm_at_rest = False
        """Whether to disarm as soon as the truck is at rest."""
        self._stopped_by: tuple[Reason, ...] = ()
        self._calibrates = False

    @property
    def active(self) -> bool:
        """Whether the truck is armed, driving or being stopped."""
        return self.mode.active

    @property
    def calibrates(self) -> bool:
        """Whether the truck is armed to calibrate sensors; see ``ControlRequest``."""
        return self._calibrates and self.active

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """Reasons why the truck does not drive in this mode."""
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
        """Arm the truck; if it is already armed, restart the timeout for automatic disarming."""
        self.driven = now
        self._calibrates = calibrates
        if self.mode is GateMode.DISARMED:
            self._enter(GateMode.ARMED, now)
            self.disarm_at_rest = False
            self._events.emit(now, Reason.ARMED, Severity.INFO, source=by, always=True)

    def drive(self, now: int, driver: Source) -> None:
        """Let ``driver`` start or continue to drive."""
        if self.mode is not GateMode.DRIVING:
            self._enter(GateMode.DRIVING, now)
        if self.holder_key != driver.key:
            request = driver.request
            values = {"role": request.role.value}
            self._events.emit(now, Reason.DRIVING, Severity.INFO, "", values, source=request.source, always=True)
        self.holder, self.driven = driver, now

    def stop(self, now: int, reasons: Iterable[Reason]) -> None:
        """Start to stop the truck."""
        self._enter(GateMode.STOPPING, now)
        self._stopped_by = tuple(dict.fromkeys(reasons))

    def release(self, now: int) -> None:
        """Release control: the driver ended its requests while the truck was at rest."""
        text = f"{self.holder_name} released control"
        self._enter(GateMode.ARMED, now)
        self._events.emit(now, Reason.STOPPED, Severity.INFO, text)

    def rest(self, now: int) -> None:
        """Return to armed because the stopped truck is at rest."""
        self._enter(GateMode.ARMED, now)
        self._events.emit(now, Reason.STOPPED, Severity.INFO, always=True)

    def disarm(self, now: int, text: str) -> None:
        """Disarm; ``text`` states the reason."""
        self._enter(GateMode.DISARMED, now)
        self.disarm_at_rest = False
        self._events.emit(now, Reason.DISARMED, Severity.INFO, text, always=True)

    def latch(self, now: int) -> None:
        """Latch the emergency stop."""
        self._enter(GateMode.ESTOPPED, now)

    def _enter(self, mode: GateMode, now: int) -> None:
        self.mode, self.since, self.holder, self._stopped_by = mode, now, None, ()
