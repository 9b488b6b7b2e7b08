"""The tracker somewhere else: its inputs go to an actor, its outputs come back."""

from typing import Any

from monstertruck_planners.track.step import TrackInput, TrackOutput, TrackSetup
from monstertruck_runtime.actors.placement import Actor
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.ports import EventSink, Publisher, Ready, Subscription
from monstertruck_runtime.schedule import Schedule
from monstertruck_schemas.plan import TrackerState
from monstertruck_schemas.req import DriveRequest


class PlacedTracker:
    """A step per period, as ``TrackerService`` takes it in the loop.

    Args:
        setup: of the tracker.
        clock: time.
        actor: where it computes.
        inputs: subscriptions by ``tracking.INPUTS``.
        drive: ``plan/drive``.
        tracker: ``plan/tracker``.
        events: where events go.
    """

    name = "tracker"

    def __init__(
        self,
        setup: TrackSetup,
        clock: Clock,
        actor: Actor,
        *,
        inputs: dict[str, Subscription[Any]],
        drive: Publisher[DriveRequest],
        tracker: Publisher[TrackerState],
        events: EventSink,
    ) -> None:
        self._setup, self._clock, self._actor, self._inputs = setup, clock, actor, inputs
        self._drive, self._tracker, self._events = drive, tracker, events

    async def run(self, ready: Ready) -> None:
        """Track until cancelled.

        Raises:
            WorkerError: the actor failed or was late; the next session begins without its memory.
        """
        async with self._actor as actor:
            await actor.start()
            ready()
            sent: dict[str, Any] = {}
            setup: TrackSetup | None = self._setup
            schedule = Schedule(self._clock, self._setup.config.rate)
            while True:
                await schedule.next()
                newest = {name: box.latest for name, box in self._inputs.items() if box.latest is not None}
                news = {name: message for name, message in newest.items() if sent.get(name) is not message}
                self._tell(await actor.step(TrackInput(self._clock.now(), news, setup)))
                sent, setup = newest, None

    def _tell(self, outputs: TrackOutput) -> None:
        for request in outputs.drive:
            self._drive.put(request.model_copy(update={"seq": self._drive.next_seq()}))
        for told in outputs.events:
            self._events(told.reason, told.severity, told.source, told.text, **told.values)
        for state in outputs.tracker:
            self._tracker.put(state.model_copy(update={"seq": self._tracker.next_seq()}))
