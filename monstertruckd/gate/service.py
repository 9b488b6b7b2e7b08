"""The safety gate as a service: feeds ``Gate``, ticks it on an absolute schedule and publishes its commands."""

import asyncio
import logging
from collections.abc import Awaitable, Callable, Generator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Final, TypeVar, assert_never

import numpy as np

from monstertruck_runtime.clock import SECOND, Clock, Schedule
from monstertruck_runtime.errors import NoAnswerError, RequestRefusedError, disk_reason
from monstertruck_runtime.mailbox import fifo
from monstertruck_runtime.ports import EventSink, Publisher, Ready, RpcRegistry, Subscription
from monstertruck_runtime.requests import parse_request
from monstertruck_runtime.threads import Offload, in_thread
from monstertruck_schemas.base import Pose2D, Twist2D, servo_fields
from monstertruck_schemas.cmd import DriveCommand, SteeringCommand
from monstertruck_schemas.event import Event, Severity, Stop
from monstertruck_schemas.health import HealthTable
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import STARTING, ControlRequest, DriveRequest, Order
from monstertruck_schemas.roles import AccessRole, ServiceName
from monstertruck_schemas.state import GateMode, GateState, Grid
from monstertruck_schemas.topics import EVENT, GATE, HEALTH, REQ_CONTROL, Topic
from monstertruckd.bus.local import Bus
from monstertruckd.gate.config import GateConfig
from monstertruckd.gate.core import Decision, Gate, GateOutput
from monstertruckd.gate.latch import Latch
from monstertruckd.gate.scan_memory import MAP_CELL, MAP_SIZE, GroundSurvey

log = logging.getLogger(__name__)

T = TypeVar("T")


SURVEY_PERIOD: Final = SECOND
"""Minimum period of ``state/seen``, ns; longer if a survey takes longer."""

LATCH_RETRY: Final = 1.0
"""Time between two attempts to store the latch or its mark, s."""


METER_DEPTH: Final = 1 << 12
"""Number of ticks kept by ``TickMeter``: 82 s at 50 Hz."""


@dataclass(frozen=True, slots=True)
class Lateness:
    """Lateness of ticks against the schedule (s)."""

    ticks: int
    p50: float
    p99: float
    max: float


class TickMeter:
    """Lateness of recent ticks; count and maximum cover all ticks."""

    def __init__(self, depth: int = METER_DEPTH) -> None:
        self._ring = np.zeros(depth)
        self.ticks = 0
        self._max = 0.0

    def record(self, lateness: float) -> None:
        """Add the lateness of one tick (s)."""
        self._ring[self.ticks % len(self._ring)] = lateness
        self.ticks += 1
        self._max = max(self._max, lateness)

    def lateness(self) -> Lateness:
        """Return percentiles over the latest ticks, and the maximum over all ticks."""
        if self.ticks == 0:
            return Lateness(0, 0.0, 0.0, 0.0)
        known = self._ring[: self.ticks]
        middle, high = ((len(known) * percent + 99) // 100 - 1 for percent in (50, 99))
        ordered = np.partition(known, (middle, high))
        return Lateness(self.ticks, float(ordered[middle]), float(ordered[high]), self._max)


@dataclass(frozen=True, slots=True)
class GateOutputs:
    """Topics written by the gate, the only writer of the first two."""

    drives: tuple[Publisher[DriveCommand], ...]
    steering: Publisher[SteeringCommand]
    state: Publisher[GateState]
    stops: Publisher[Stop]
    seen: Publisher[Grid]


class GateService:
    """Runs a ``Gate``.

    Args:
        gate: the state machine, built with ``latched=latch.engaged()``.
        rate: tick rate (1/s).
        clock: time source.
        inputs: subscriptions.
        outputs: publishers.
        events: receives events.
        latch: keeps the emergency stop across restarts.
        black_box: called at every stop; returns the file that will hold the preceding minute, if any.
        offload: runs blocking writes of the latch.
        weakened: settings less safe than the defaults, shown to every client.
        cut_ports: switches off the power of the drives' ports.
    """

    name = ServiceName.GATE.value

    def __init__(
        self,
        gate: Gate,
        rate: float,
        clock: Clock,
        inputs: Mapping[Topic[Any], Subscription[Any]],
        outputs: GateOutputs,
        events: EventSink,
        latch: Latch,
        black_box: Callable[[Stop], str | None] = lambda _: None,
        offload: Offload = in_thread,
        weakened: tuple[str, ...] = (),
        cut_ports: Callable[[], Awaitable[None]] | None = None,
    ) -> None:
        self._gate = gate
        self._cut_ports = cut_ports
        self._nothing_helps = asyncio.Event()
        self._port_off = False
        self._weakened = weakened
        self._rate = rate
        self._clock = clock
        self._outputs = outputs
        self._events = events
        self._black_box = black_box
        self._boxed: tuple[int, str | None] = (0, None)
        """Number of the latest stop, and its black box."""
        self._latch = latch
        self._offload = offload
        self._latched: bool | None = latch.stored()
        """State on the disk; None if unknown: a write is in progress or failed, or it cannot be read."""
        self._marked: bool | None = None
        """State of the latch's mark; None if not written in this run."""
        self._mark_due = 0
        """Time of the next attempt to write the mark, ns."""
        self._latch_differs = asyncio.Event()
        self._meter = TickMeter()
        self._broken = asyncio.Event()
        self._bug: Exception | None = None
        self._published: tuple[object, ...] = ()
        self._published_at = 0
        self._survey: Generator[None, None, GroundSurvey | None] | None = None
        """Survey in progress, one step per tick; None if no survey is in progress."""
        self._surveyed = -SURVEY_PERIOD
        """Start of the latest survey, ns."""
        self._feeds = [_Feed(topic, subscription, gate.observe) for topic, subscription in inputs.items()]

    def configure(self, config: GateConfig, weakened: tuple[str, ...]) -> None:
        """Replace the limits from the next tick; see ``Gate.configure``."""
        self._guarded(None, self._gate.configure, config)
        added, self._weakened = set(weakened) - set(self._weakened), weakened
        for setting in sorted(added):
            self._events(Reason.WEAKENED, Severity.WARNING, self.name, setting)
        self._published = ()

    @property
    def mode(self) -> GateMode:
        """Current mode."""
        return self._gate.mode

    def ticks(self) -> int:
        """Return the number of ticks so far, for the watchdog."""
        return self._meter.ticks

    def lateness(self) -> Lateness:
        """Return the lateness of the ticks."""
        return self._meter.lateness()

    def control(self, order: ControlRequest) -> Decision:
        """Carry out an order immediately; see ``Gate.control``.

        An emergency stop does not wait for the next tick: it is commanded and marked before the gate answers.
        """
        bug = Decision(Reason.INTERNAL, Reason.INTERNAL.text)
        before = self.mode
        decision = self._guarded(bug, self._gate.control, order, self._clock.now())
        if before is not GateMode.ESTOPPED and self.mode is GateMode.ESTOPPED:
            self._guarded(None, self._tick)
        elif decision.reason is Reason.OK and order.order not in STARTING:
            self._published = ()  # starting orders are refused until their sender knows of this order
        self._mark_latch()
        return decision

    def request(self, request: DriveRequest) -> Reason:
        """Process an external drive request immediately; see ``Gate.request``."""
        return self._guarded(Reason.INTERNAL, self._gate.request, request, self._clock.now())

    def planner_request(self, request: DriveRequest) -> Reason:
        """Process a drive request from the robot's planners immediately; see ``Gate.planner_request``."""
        return self._guarded(Reason.INTERNAL, self._gate.planner_request, request, self._clock.now())

    def observe_event(self, event: Event) -> None:
        """Process an event from any service immediately; see ``Gate.observe``."""
        self._guarded(None, self._gate.observe, event, EVENT)

    def observe_health(self, table: HealthTable) -> None:
        """Process a health table immediately; see ``Gate.observe``."""
        self._guarded(None, self._gate.observe, table, HEALTH)

    def shut_down(self) -> None:
        """Command neutral until ``run`` is cancelled; ticks continue."""
        self._publish(self._gate.neutral(self._clock.now()), self._clock.now())

    def _guarded(self, default: T, take: Callable[..., T], *arguments: object) -> T:
        """Return the result of ``take``; a bug in it ends this service, not the sender of the message."""
        try:
            return take(*arguments)
        except Exception as bug:
            log.exception("a message could not be taken")
            self._bug = bug
            self._broken.set()
            return default

    async def _fail(self) -> None:
        await self._broken.wait()
        assert self._bug is not None
        raise self._bug

    async def run(self, ready: Ready) -> None:
        """Tick until cancelled; however the run ends, finally command neutral and store the latch on the disk.

        Orders are still accepted afterwards, until ``close``.
        """
        for setting in self._weakened:
            log.warning("%s: %s", Reason.WEAKENED.text, setting)
            self._events(Reason.WEAKENED, Severity.WARNING, self.name, setting)
        try:
            async with asyncio.TaskGroup() as group:
                group.create_task(self._keep_latch(), name="gate latch")
                group.create_task(self._fail(), name="gate bug")
                group.create_task(self._cut(), name="gate ports")
                try:
                    await self._tick_forever(ready)
                finally:
                    self.shut_down()  # before waiting for the disk
        finally:
            await self.store_latch()

    async def _cut(self) -> None:
        """Switch off the ports whenever no other step stops the robot."""
        while True:
            await self._nothing_helps.wait()
            self._nothing_helps.clear()
            if self._cut_ports is not None:
                await self._cut_ports()

    async def close(self) -> None:
        """Store the latch and remove its mark once no more orders can arrive; does not raise ``OSError``."""
        if await self.store_latch():
            self._latch.close()

    async def _tick_forever(self, ready: Ready) -> None:
        schedule = Schedule(self._clock, self._rate, ahead=0)
        while True:
            due = await schedule.next()
            self._meter.record((self._clock.now() - due) / SECOND)
            self._tick()
            ready()

    def _tick(self) -> None:
        now = self._clock.now()
        for feed in self._feeds:
            feed.poll()
        self._publish(self._gate.tick(now), now)
        self._continue_survey(now)

    def _continue_survey(self, now: int) -> None:
        """Advance the survey of seen ground by one step, and publish it when complete."""
        if self._survey is None:
            if now - self._surveyed >= SURVEY_PERIOD:
                self._survey, self._surveyed = self._gate.survey(), now
            return
        try:
            next(self._survey)
        except StopIteration as done:
            self._survey = None
            if done.value is not None:
                self._outputs.seen.put(_grid(done.value, now, self._outputs.seen.next_seq()))

    def _publish(self, output: GateOutput, now: int) -> None:
        steering = self._outputs.steering
        for drive, speed, velocity in zip(self._outputs.drives, output.speeds, output.motor_velocities, strict=True):
            drive.put(
                DriveCommand(
                    stamp=now,
                    received=now,
                    seq=drive.next_seq(),
                    action=output.action,
                    speed=speed,
                    motor_velocity=velocity,
                )
            )
        steering.put(
            SteeringCommand(
                stamp=now,
                received=now,
                seq=steering.next_seq(),
                front=output.front,
                rear=output.rear,
                **servo_fields(output.servos, "_servo"),
                deadman=output.mode is not GateMode.ESTOPPED and Reason.DRIVE_STALE not in output.reasons,
            )
        )
        self._mark_latch()
        for event in output.events:
            self._events(event.reason, event.severity, self.name, event.text, **event.values)
            if event.reason is Reason.FAULTS_REPEAT:
                log.warning("%s", event.text)
        for trip in output.trips:
            stop = self._stop(trip, now)
            self._outputs.stops.put(stop)
            log.log(logging.INFO if stop.ordered else logging.WARNING, "%s", stop.text)
        asked = output.asking, output.handed_to
        whole = output.mode, output.stopping
        visible = (whole, output.holder, output.reasons, output.waiting, asked, self._latched)
        state_period = SECOND // 10  # ``state/gate`` is published on every change and at least this often, ns
        if visible != self._published or now - self._published_at >= state_period:
            self._published, self._published_at = visible, now
            self._outputs.state.put(self._state(output, now))
        if (output.mode is GateMode.ESTOPPED) != self._latched:
            self._latch_differs.set()
        if output.port_off and not self._port_off:
            self._nothing_helps.set()
        self._port_off = output.port_off

    def _stop(self, trip: Stop, now: int) -> Stop:
        if trip.number != self._boxed[0]:
            self._boxed = trip.number, self._black_box(trip)
        seq = self._outputs.stops.next_seq()
        return trip.model_copy(update={"received": now, "seq": seq, "black_box": self._boxed[1]})

    def _state(self, output: GateOutput, now: int) -> GateState:
        return GateState(
            stamp=now,
            received=now,
            seq=self._outputs.state.next_seq(),
            mode=output.mode,
            nonce=self._gate.nonce,
            holder=output.holder,
            role=output.role,
            lease_left=output.lease_left,
            last_seq=output.last_seq,
            speed_limit=output.speed_limit,
            reasons=output.reasons,
            stopping_distance=output.stopping_distance,
            form=output.form,
            twist=Twist2D(**dict(zip(("vx", "vy", "wz"), output.twist, strict=True))),
            latched=self._latched is True,
            weakened=self._weakened,
            waiting=output.waiting,
            asking=output.asking,
            handed_to=output.handed_to,
            stopping=output.stopping,
        )

    def _mark_latch(self) -> None:
        """Mark an emergency stop before it is reported; clear the mark once the file on the disk agrees.

        The thread that writes the file never touches the mark. So an emergency stop ordered while the previous stop's
        file is being removed keeps its mark.
        """
        marked = self.mode is GateMode.ESTOPPED and self._latched is not True
        now = self._clock.now()
        if marked == self._marked or now < self._mark_due:
            return
        try:
            self._latch.mark(marked)
        except OSError as error:
            self._mark_due = now + round(LATCH_RETRY * SECOND)
            self._report(error)
        else:
            self._marked = marked

    async def _keep_latch(self) -> None:
        while True:
            await self._latch_differs.wait()
            self._latch_differs.clear()
            if not await self.store_latch():
                await self._clock.sleep(LATCH_RETRY)
                self._latch_differs.set()

    async def store_latch(self) -> bool:
        """Write the latch file if it differs from the gate's mode, even if cancelled; return False on failure."""
        wanted = self._gate.mode is GateMode.ESTOPPED
        if wanted == self._latched:
            return True
        before, self._latched = self._latched, None  # remains None if cancelled, so that the file is stored once more
        try:
            await self._offload(partial(self._latch.store, wanted))
        except OSError as error:
            self._report(error)
            if await self._offload(self._latch.stored) is before:
                self._latched = before  # otherwise the file has changed, but its folder is not synced
            return False
        self._latched = wanted
        return True

    def _report(self, error: OSError) -> None:
        text = f"the emergency stop's latch could not be stored: {error}"
        self._events(disk_reason(error), Severity.ERROR, self.name, text)


class _Feed:
    """Forwards each message of a latest-only subscription once."""

    def __init__(
        self, topic: Topic[Any], subscription: Subscription[Any], observe: Callable[[Any, Topic[Any]], None]
    ) -> None:
        self._topic = topic
        self._subscription = subscription
        self._observe = observe
        self._seen: object = None

    def poll(self) -> None:
        message = self._subscription.latest
        if message is not self._seen:
            self._seen = message
            self._observe(message, self._topic)


STANDSTILL: Final = 4.0
"""Timeout for the truck to come to rest, s."""

GRADUAL: Final = frozenset({Order.DISARM, Order.STOP})
"""Orders completed when the truck is at rest; other orders take effect at once."""


def register_gate_calls(rpc: RpcRegistry, bus: Bus, clock: Clock) -> None:
    """Serve every ``Order`` under its name; the payload is a ``ControlRequest``, the answer a ``GateState``.

    An order is injected on ``req/control``, so it is recorded and checked like any other order. The answer follows when
    the order has been carried out, or refused with the reason.

    Args:
        rpc: registry of the calls.
        bus: carries the orders to the gate.
        clock: time source.
    """
    for order in Order:
        role = AccessRole.OBSERVER if order is Order.ESTOP else AccessRole.PILOT
        rpc.register(order.value, partial(_carry_out, bus, clock, order), role)


async def _carry_out(bus: Bus, clock: Clock, order: Order, payload: dict[str, Any]) -> dict[str, Any]:
    request = parse_request(ControlRequest, {**payload, "order": order.value})
    with bus.subscribe(GATE, fifo(64)) as states:
        states.drain()
        (decision,) = bus.inject(REQ_CONTROL, request)
        assert isinstance(decision, Decision)
        if decision.reason is not Reason.OK:
            raise RequestRefusedError(decision.reason, decision.text)
        try:
            async with clock.deadline(STANDSTILL):
                while True:
                    state = await states.next()
                    if _is_carried_out(order, state):
                        return state.model_dump(mode="json")
                    if order not in GRADUAL:
                        raise RequestRefusedError(state.worst)
        except TimeoutError:
            msg = (
                f"{order.value} accepted, but standstill is not confirmed after {STANDSTILL:g} s: {_why(states.latest)}"
            )
            raise NoAnswerError(msg) from None


def _why(state: GateState | None) -> str:
    return "the gate is silent" if state is None else state.why


def _is_carried_out(order: Order, state: GateState) -> bool:
    """Return whether the gate's state shows that ``order`` has been carried out."""
    mode = state.mode
    match order:
        case Order.ARM:
            return mode.active
        case Order.DISARM:
            return not mode.active and not state.stopping
        case Order.ESTOP:
            return mode is GateMode.ESTOPPED
        case Order.RESET:
            return mode is not GateMode.ESTOPPED
        case Order.STOP:
            return not mode.moving and not state.stopping
        case Order.ASK | Order.HAND_OVER:
            return True
        case _:
            assert_never(order)


def _grid(survey: GroundSurvey, now: int, seq: int) -> Grid:
    """Convert a survey to a message."""
    corner = -MAP_SIZE / 2 * MAP_CELL
    return Grid(
        stamp=survey.stamp,
        received=now,
        seq=seq,
        frame="base",
        resolution=MAP_CELL,
        width=MAP_SIZE,
        height=MAP_SIZE,
        origin=Pose2D(x=corner, y=corner, yaw=0.0),
        cells=survey.ages.ravel(),
    )
