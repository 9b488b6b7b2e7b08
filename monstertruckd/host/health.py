"""Health of every service as a topic, and the offset of real time from daemon time."""

import logging
from collections.abc import Callable, Collection
from itertools import count
from typing import Any, Final

from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import RequestRefusedError
from monstertruck_runtime.ports import EventSink, Handler, Publisher, Ready, RpcRegistry
from monstertruck_schemas.event import Event, Severity
from monstertruck_schemas.health import HealthTable, LoopHealth, RecorderHealth, ServiceHealth, ServiceState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.roles import AccessRole, ServiceName
from monstertruck_schemas.state import ClockOffset
from monstertruck_schemas.topics import LOOP, RECORDER, Writer
from monstertruckd.bus.local import Bus
from monstertruckd.gate.service import GateService
from monstertruckd.recorder.recorder import Recorder

log = logging.getLogger(__name__)

HEALTH_PERIOD = 1.0

PASSING: Final = frozenset({Reason.SLOW_LINK})
"""Reasons for degraded operation: a warning reports its start, an information event its end."""
LASTING: Final = frozenset({Reason.FILE_DAMAGED, Reason.LOG_DAMAGED})
"""Reasons for permanently reduced operation: the warning stays until the daemon exits."""


class HealthBoard:
    """Collect the state of every service; publish the table on change and once a second.

    Loss and recovery of a service are events. Repeated failures within one outage are not, unless the cause changes or
    the service is given up. A device unplugged from a hub is reported at its second failure. If the whole hub is gone,
    there is no second failure: the device waits for the hub, whose loss is one event for all its devices.

    Args:
        clock: time source.
        out: publisher of the table.
        events: sink for losses and recoveries.
        waiting: describes the reason why the named service waits to start; None if it does not wait.
        on_hubs: services whose device is connected through a hub.
    """

    name = ServiceName.HEALTH.value

    def __init__(
        self,
        clock: Clock,
        out: Publisher[HealthTable],
        events: EventSink,
        waiting: Callable[[str], str | None] = lambda _: None,
        on_hubs: Collection[str] = (),
    ) -> None:
        self._clock = clock
        self._out = out
        self._events = events
        self._waiting = waiting
        self._on_hubs = on_hubs
        self._unplugged: set[str] = set()
        self._rows: dict[str, ServiceHealth] = {}
        self._down: dict[str, set[Reason]] = {}
        """Services that are down, with the causes reported during the outage."""
        self._degraded: dict[str, Event] = {}
        self._damaged: dict[str, Event] = {}

    def observe_event(self, event: Event) -> None:
        """Handle an event of any service: its row shows the problem until the service reports its end or restarts."""
        if event.reason in PASSING and event.severity is Severity.INFO:
            self._degraded.pop(event.source, None)
        elif event.reason in PASSING:
            self._degraded[event.source] = event
        elif event.reason in LASTING and event.severity is not Severity.INFO:
            self._damaged[event.source] = event
        else:
            return
        self._publish()

    def report(self, row: ServiceHealth) -> None:
        """Update the state of a service (a ``HealthSink``)."""
        self._rows[row.name] = row
        if row.state is ServiceState.STARTING:
            self._degraded.pop(row.name, None)
        elif row.state is ServiceState.READY:
            returned = row.name in self._unplugged or row.name in self._down
            self._down.pop(row.name, None)
            self._unplugged.discard(row.name)
            text = "is back" if returned else "is ready"
            self._events(Reason.DEVICE_READY, Severity.INFO, row.name, text, restarts=row.restarts)
        elif self._may_be_its_hub(row):
            self._unplugged.add(row.name)
        elif row.state in (ServiceState.BACKOFF, ServiceState.FAILED):
            given_up, reported = row.state is ServiceState.FAILED, self._down.setdefault(row.name, set())
            if given_up or row.reason not in reported:
                severity = Severity.ERROR if given_up else Severity.WARNING
                self._events(row.reason, severity, row.name, row.detail, restarts=row.restarts)
            reported.add(row.reason)
        self._publish()

    def _may_be_its_hub(self, row: ServiceHealth) -> bool:
        """Return whether this is the first loss of a working device on a hub."""
        first = row.state is ServiceState.BACKOFF and not (row.name in self._down or row.name in self._unplugged)
        return first and row.reason is Reason.DEVICE_LOST and row.name in self._on_hubs

    def rows(self) -> tuple[ServiceHealth, ...]:
        """Return the rows of all services, in order of their first report."""
        return tuple(self._with_reason(row) for row in self._rows.values())

    def _with_reason(self, row: ServiceHealth) -> ServiceHealth:
        if row.state is ServiceState.STARTING and (why := self._waiting(row.name)) is not None:
            return row.model_copy(update={"detail": why})
        event = self._degraded.get(row.name) or self._damaged.get(row.name)
        if row.state is ServiceState.READY and event is not None:
            return row.model_copy(update={"reason": event.reason, "detail": event.text})
        return row

    def require(self, name: str) -> None:
        """Refuse requests to a service that has failed permanently.

        Raises:
            RequestRefusedError: the service has failed permanently.
        """
        row = self._rows.get(name)
        if row is not None and row.state is ServiceState.FAILED:
            raise RequestRefusedError(Reason.SERVICE_FAILED, f"{name}: {row.detail}")

    async def run(self, ready: Ready) -> None:
        """Publish the table once a second; after the start, log missing services, and once that all are ready."""
        ready()
        complete = False
        summary_after = 5  # periods from the start until the log lists missing services
        for periods in count(1):
            await self._clock.sleep(HEALTH_PERIOD)
            self._publish()
            if periods >= summary_after and not complete:
                complete = self._summarise(missing=periods == summary_after)

    def _summarise(self, *, missing: bool) -> bool:
        """Log that all services are ready or, with ``missing``, which are not; return whether all are."""
        rows = self.rows()
        rest = [row for row in rows if row.state is not ServiceState.READY]
        if not rest:
            log.info("all %d services are ready", len(rows))
        elif missing:
            level = logging.INFO if all(row.state is ServiceState.STARTING for row in rest) else logging.WARNING
            names = "; ".join(f"{row.name} ({row.detail or row.state.value})" for row in rest)
            log.log(level, "%d of %d services are ready; not ready: %s", len(rows) - len(rest), len(rows), names)
        return not rest

    def _publish(self) -> None:
        now = self._clock.now()
        self._out.put(HealthTable(stamp=now, received=now, seq=self._out.next_seq(), services=self.rows()))


class ServiceCalls:
    """Registers the remote calls of one service; they are refused after the service has failed permanently.

    Args:
        rpc: registry.
        board: holds the state of the service.
        service: name of the service.
    """

    def __init__(self, rpc: RpcRegistry, board: HealthBoard, service: str) -> None:
        self._rpc = rpc
        self._board = board
        self._service = service

    def register(
        self, name: str, handler: Handler, role: AccessRole = AccessRole.PILOT, *, recorded: bool = True
    ) -> None:
        """Serve ``name``; see ``RpcRegistry``."""

        async def served(payload: dict[str, Any]) -> dict[str, Any]:
            self._board.require(self._service)
            return await handler(payload)

        self._rpc.register(name, served, role, recorded=recorded)


class ClockService:
    """Publishes real time minus daemon time; a step of real time is an event."""

    name = ServiceName.CLOCK.value

    def __init__(self, clock: Clock, out: Publisher[ClockOffset], events: EventSink) -> None:
        self._clock = clock
        self._out = out
        self._events = events

    async def run(self, ready: Ready) -> None:
        """Measure once a second."""
        ready()
        before: int | None = None
        while True:
            offset = self._clock.real_offset()
            # SECOND // 20: a larger change of the real-time offset within one period is a step, not drift (NTP slews
            # < 1 ms/s)
            step = offset - before if before is not None and abs(offset - before) > SECOND // 20 else 0
            if step:
                self._events(Reason.CLOCK_STEPPED, Severity.WARNING, self.name, seconds=step / SECOND)
            now = self._clock.now()
            self._out.put(ClockOffset(stamp=now, received=now, seq=self._out.next_seq(), offset=offset, stepped=step))
            before = offset
            await self._clock.sleep(HEALTH_PERIOD)


class MeterService:
    """Publish the lateness of control ticks and the state of the recorder once a second.

    Reports a disk that is too slow for the recorder as an event, at most once a minute.
    """

    name = ServiceName.METER.value

    def __init__(
        self,
        clock: Clock,
        gate: GateService,
        recorder: Recorder | None,
        bus: Bus,
        events: EventSink,
    ) -> None:
        self._clock = clock
        self._gate = gate
        self._recorder = recorder
        self._events = events
        self._bus = bus
        self._loop = bus.publisher(LOOP, Writer.DAEMON)
        self._recording = bus.publisher(RECORDER, Writer.DAEMON)
        self._late = 0
        """Number of seconds with late ticks minus those without, at least 0."""
        self._said: int | None = None
        self._lost = 0
        """Number of lost messages in the last report."""
        self._lost_said: int | None = None

    async def run(self, ready: Ready) -> None:
        """Publish until cancelled."""
        ready()
        while True:
            await self._clock.sleep(HEALTH_PERIOD)
            now = self._clock.now()
            late = self._gate.lateness()
            health = LoopHealth(
                stamp=now,
                received=now,
                seq=self._loop.next_seq(),
                ticks=late.ticks,
                lateness_p50=late.p50,
                lateness_p99=late.p99,
                lateness_max=late.max,
                drops=self._bus.drops,
            )
            self._loop.put(health)
            self._say_busy(health)
            if self._recorder is not None:
                recording = self._recorder.health(self._recording.next_seq())
                self._recording.put(recording)
                self._say_lost(recording)

    def _say_lost(self, health: RecorderHealth) -> None:
        """Report messages missing in the log; the end of a recording has its own event."""
        if not health.lost or health.drops == self._lost or not _again(self._lost_said, health.stamp):
            return
        source = ServiceName.RECORDER.value
        self._events(Reason.MESSAGES_DROPPED, Severity.WARNING, source, health.lost, lost=health.drops)
        self._lost, self._lost_said = health.drops, health.stamp

    def _say_busy(self, health: LoopHealth) -> None:
        """Log a lasting overload of the computer, at most once a minute."""
        self._late = self._late + 1 if health.busy else max(0, self._late - 1)
        # 3: seconds with late ticks before an overload is logged, since a start causes some
        if health.busy and self._late >= 3 and _again(self._said, health.stamp):
            self._said = health.stamp
            log.warning("%s", health.busy)


def _again(said: int | None, now: int) -> bool:
    """Return whether a message last logged at ``said`` (ns) is due again."""
    return said is None or now - said > 60.0 * SECOND  # seconds until it is repeated
