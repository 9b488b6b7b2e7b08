"""The tracker as a service: poses and a path in, drive requests to the gate out."""

import asyncio
import functools
from collections.abc import Awaitable, Callable, Mapping
from typing import Any

from monstertruck_planners.collision import ScanPoints
from monstertruck_planners.track.step import Newest, TrackingStep, TrackInput, TrackOutput, TrackSetup
from monstertruck_runtime.actors.placement import Actor
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.ports import EventSink, Publisher, Ready, Subscription
from monstertruck_runtime.schedule import Schedule
from monstertruck_schemas.plan import TrackerState
from monstertruck_schemas.req import DriveRequest, Role
from monstertruck_schemas.state import GateState


class TrackerService:
    """Follows ``plan/path`` by one tracking step per period.

    Args:
        setup: the tracker and the truck.
        clock: time.
        inputs: subscriptions by the names of ``Newest``.
        drive: ``plan/drive``.
        tracker: ``plan/tracker``.
        events: where events go.
        actor: where the steps are taken; None = in the loop, which turns while a long path is prepared.
        points: of scans, in base, shared by what runs in the loop.

    Raises:
        InputError: the tracker cannot be built.
    """

    name = "tracker"

    def __init__(
        self,
        setup: TrackSetup,
        clock: Clock,
        *,
        inputs: Mapping[str, Subscription[Any]],
        drive: Publisher[DriveRequest],
        tracker: Publisher[TrackerState],
        events: EventSink,
        actor: Actor | None = None,
        points: ScanPoints | None = None,
    ) -> None:
        self._setup, self._clock = setup, clock
        self._inputs = [inputs.get(name) for name in Newest._fields]
        self._drive, self._tracker, self._events = drive, tracker, events
        self._actor = actor
        self._step = TrackingStep(setup, points) if actor is None else None
        self._sent: Newest | None = None
        """Messages the actor has; None before its first step."""

    async def run(self, ready: Ready) -> None:
        """Track until cancelled.

        Raises:
            WorkerError: the actor failed or was late; the next session begins without its memory.
        """
        if self._actor is None:
            await self._serve(ready, self._step_here)
            return
        async with self._actor as actor:
            await actor.start()
            self._sent = None
            await self._serve(ready, functools.partial(self._step_by, actor))

    async def _serve(self, ready: Ready, step: Callable[[int, Newest], Awaitable[None]]) -> None:
        ready()
        schedule = Schedule(self._clock, self._setup.config.rate)
        while True:
            await schedule.next()
            newest = Newest(*[None if box is None else box.latest for box in self._inputs])
            await step(self._clock.now(), newest)

    async def _step_here(self, now: int, newest: Newest) -> None:
        assert self._step is not None
        for output in self._step.parts(now, newest):
            if output is None:
                await asyncio.sleep(0)
            else:
                self._publish(now, newest.gate, output)

    async def _step_by(self, actor: Actor, now: int, newest: Newest) -> None:
        sent = self._sent or Newest()
        news = {name: new for name, new, old in zip(Newest._fields, newest, sent, strict=True) if new is not old}
        output: TrackOutput = await actor.step(TrackInput(now, news, self._setup if self._sent is None else None))
        self._sent = newest
        self._publish(now, newest.gate, output)

    def _publish(self, now: int, gate: GateState | None, output: TrackOutput) -> None:
        command = output.command
        if command is not None and gate is not None and output.drive:
            self._drive.put(
                DriveRequest(
                    stamp=now,
                    received=now,
                    seq=self._drive.next_seq(),
                    source=self.name,
                    role=Role.TRACKER,
                    lease=self._setup.config.lease,
                    nonce=gate.nonce,
                    gate_stamp=gate.stamp,
                    speed=command.speed,
                    front=command.front,
                    rear=command.rear,
                )
            )
        for event in output.events:
            self._events(event.reason, event.severity, self.name, event.text, **event.values)
        if command is not None:
            self._tracker.put(
                TrackerState(
                    stamp=now,
                    received=now,
                    seq=self._tracker.next_seq(),
                    frame=output.frame,
                    path=output.path,
                    cross_track=command.cross_track,
                    heading_error=command.heading_error,
                    along=output.along,
                    length=output.length,
                    outcome=command.outcome,
                )
            )
