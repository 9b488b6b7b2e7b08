"""The safety gate as a service: feeds ``Gate``, ticks it on an absolute schedule, and alone writes to the actuators."""

import asyncio
import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Final, TypeVar

from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.ports import EventSink, Publisher, Ready, Subscription
from monstertruck_runtime.schedule import Schedule
from monstertruck_runtime.stops import sentence
from monstertruck_runtime.threads import Offload, in_thread
from monstertruck_schemas.cmd import DriveCommand, SteeringCommand
from monstertruck_schemas.event import Event, Severity, Stop
from monstertruck_schemas.health import HealthTable
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import ControlRequest, DriveRequest
from monstertruck_schemas.sensor import Attitude, Battery, DriveFeedback, LaserScan, SteeringFeedback
from monstertruck_schemas.state import GateMode, GateState
from monstertruckd.gate.core import Gate
from monstertruckd.gate.latch import Latch
from monstertruckd.gate.meter import Lateness, TickMeter
from monstertruckd.gate.output import GateOutput
from monstertruckd.gate.stops import Trip

log = logging.getLogger(__name__)

T = TypeVar("T")

STATE_PERIOD: Final = SECOND // 10
"""``state/gate`` goes out on every change and at least this often, ns."""

LATCH_RETRY: Final = 1.0
"""Seconds between two tries to store the latch."""


@dataclass(frozen=True, slots=True)
class GateInputs:
    """What the gate reads, by the newest message. Requests and orders are passed to it as they arrive."""

    scan: Subscription[LaserScan]
    attitude: Subscription[Attitude]
    drives: tuple[Subscription[DriveFeedback], ...]
    """One per driven shaft."""
    steering: Subscription[SteeringFeedback]
    battery: Subscription[Battery]
    health: Subscription[HealthTable]


@dataclass(frozen=True, slots=True)
class GateOutputs:
    """What the gate writes; nobody else gets the first two."""

    drives: tuple[Publisher[DriveCommand], ...]
    steering: Publisher[SteeringCommand]
    state: Publisher[GateState]
    stops: Publisher[Stop]


class GateService:
    """Thin shell around ``Gate``.

    Args:
        gate: the state machine, built with ``latched=latch.engaged()``.
        rate: ticks per second.
        clock: time.
        inputs: subscriptions.
        outputs: publishers.
        events: where events go.
        latch: keeps the emergency stop over restarts.
        black_box: told of every stop as it happens; names the file that will hold the minute before, if any.
        offload: where the latch is stored: a disk's sync must not hold up the loop.
    """

    name = "gate"

    def __init__(
        self,
        gate: Gate,
        rate: float,
        clock: Clock,
        inputs: GateInputs,
        outputs: GateOutputs,
        events: EventSink,
        latch: Latch,
        black_box: Callable[[Trip], str | None] = lambda _: None,
        offload: Offload = in_thread,
    ) -> None:
        self._gate = gate
        self._rate = rate
        self._clock = clock
        self._outputs = outputs
        self._events = events
        self._black_box = black_box
        self._kept: tuple[int, str | None] = (0, None)
        """Number of the newest stop, and its black box."""
        self._latch = latch
        self._offload = offload
        self._latched: bool | None = latch.engaged()
        """What is on the disk; None while it is being written."""
        self._latch_differs = asyncio.Event()
        self._meter = TickMeter()
        self._broken = asyncio.Event()
        self._bug: Exception | None = None
        self._told: tuple[object, ...] = ()
        self._told_at = 0
        self._feeds: list[_Feed] = [
            _Feed(inputs.scan, gate.observe_scan),
            _Feed(inputs.attitude, gate.observe_attitude),
            *(_Feed(drive, partial(gate.observe_drive, shaft=i)) for i, drive in enumerate(inputs.drives)),
            _Feed(inputs.steering, gate.observe_steering),
            _Feed(inputs.battery, gate.observe_battery),
            _Feed(inputs.health, gate.observe_health),
        ]

    @property
    def mode(self) -> GateMode:
        """State now."""
        return self._gate.mode

    def ticks(self) -> int:
        """Ticks so far; advances with every one, for the watchdog."""
        return self._meter.ticks

    def lateness(self) -> Lateness:
        """Punctuality of the tick."""
        return self._meter.lateness()

    def control(self, order: ControlRequest) -> Reason:
        """Carry out an order at once, before any queue could lose it; see ``Gate.control``."""
        return self._taken(Reason.INTERNAL, self._gate.control, order, self._clock.now())

    def request(self, request: DriveRequest) -> Reason:
        """Take a drive request from outside, at once; see ``Gate.request``."""
        return self._taken(Reason.INTERNAL, self._gate.request, request, self._clock.now())

    def planner_request(self, request: DriveRequest) -> Reason:
        """Take one of the robot's own planners, at once; see ``Gate.planner_request``."""
        return self._taken(Reason.INTERNAL, self._gate.planner_request, request, self._clock.now())

    def observe_event(self, event: Event) -> None:
        """Take any service's event at once: it may be what is behind a stop."""
        self._taken(None, self._gate.observe_event, event)

    def shut_down(self) -> None:
        """Command neutral now and for good; the ticks go on until ``run`` is cancelled."""
        self._publish(self._gate.neutral(self._clock.now()), self._clock.now())

    def _taken(self, otherwise: T, take: Callable[..., T], *arguments: object) -> T:
        """What ``take`` returns; a bug in it ends this service, and not whoever sent the message."""
        try:
            return take(*arguments)
        except Exception as bug:
            log.exception("a message could not be taken")
            self._bug = bug
            self._broken.set()
            return otherwise

    async def _fail(self) -> None:
        await self._broken.wait()
        assert self._bug is not None
        raise self._bug

    async def run(self, ready: Ready) -> None:
        """Tick until cancelled; the last commands are neutral, whatever ends it, and the latch is on the disk."""
        try:
            async with asyncio.TaskGroup() as group:
                group.create_task(self._keep_latch(), name="gate latch")
                group.create_task(self._fail(), name="gate bug")
                try:
                    await self._tick_for_ever(ready)
                finally:
                    self.shut_down()  # before anybody waits for a disk
        finally:
            await self._store_latch()

    async def _tick_for_ever(self, ready: Ready) -> None:
        schedule = Schedule(self._clock, self._rate, ahead=0)
        while True:
            due = await schedule.next()
            now = self._clock.now()
            self._meter.record((now - due) / SECOND)
            for feed in self._feeds:
                feed.poll()
            self._publish(self._gate.tick(now), now)
            ready()

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
                front_servo=output.front_servo,
                rear_servo=output.rear_servo,
                deadman=Reason.DRIVE_STALE not in output.reasons,
            )
        )
        for event in output.events:
            self._events(event.reason, event.severity, self.name, event.text, **event.values)
        for trip in output.trips:
            stop = self._stop(trip, now)
            self._outputs.stops.put(stop)
            log.log(logging.INFO if stop.ordered else logging.WARNING, "%s", stop.text)
        news = (output.mode, output.holder, output.reasons)
        if news != self._told or now - self._told_at >= STATE_PERIOD:
            self._told, self._told_at = news, now
            self._outputs.state.put(self._state(output, now))
        if (output.mode is GateMode.ESTOPPED) != self._latched:
            self._latch_differs.set()

    def _stop(self, trip: Trip, now: int) -> Stop:
        if trip.number != self._kept[0]:
            self._kept = trip.number, self._black_box(trip)
        return Stop(
            stamp=trip.at,
            received=now,
            seq=self._outputs.stops.next_seq(),
            number=trip.number,
            reason=trip.reason,
            mode=trip.mode,
            ordered=trip.ordered,
            quick=trip.quick,
            holder=trip.holder,
            role=trip.role,
            speed=trip.speed,
            stopping_distance=trip.stopping_distance,
            causes=trip.causes,
            black_box=self._kept[1],
            text=f"stopped: {sentence(trip.causes, trip.at)}",
        )

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
        )

    async def _keep_latch(self) -> None:
        while True:
            await self._latch_differs.wait()
            self._latch_differs.clear()
            if not await self._store_latch():
                await self._clock.sleep(LATCH_RETRY)
                self._latch_differs.set()

    async def _store_latch(self) -> bool:
        """Store the latch if it differs from the gate's state, to the end even if cancelled; False if that failed."""
        wanted = self._gate.mode is GateMode.ESTOPPED
        if wanted == self._latched:
            return True
        before, self._latched = self._latched, None  # stays so if cancelled: then it is stored once more
        try:
            await self._offload(partial(self._latch.store, wanted))
        except OSError as error:
            self._latched = before
            self._complain(error)
            return False
        self._latched = wanted
        return True

    def _complain(self, error: OSError) -> None:
        text = f"the emergency stop's latch could not be stored: {error}"
        self._events(Reason.INTERNAL, Severity.ERROR, self.name, text)


class _Feed:
    """Hands each newest message of a subscription on once."""

    def __init__(self, subscription: Subscription[Any], observe: Callable[[Any], None]) -> None:
        self._subscription = subscription
        self._observe = observe
        self._seen: object = None

    def poll(self) -> None:
        message = self._subscription.latest
        if message is not None and message is not self._seen:
            self._seen = message
            self._observe(message)
