"""An operator that arms the truck and watches a lap, over Zenoh or inside the daemon's process."""

import json
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Final, TypeVar

import numpy as np

from monstertruck_kinematics.elementary import Array
from monstertruck_runtime import wire
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import NoAnswerError, RequestRefusedError
from monstertruck_runtime.mailbox import Delivery, Mailbox, fifo, latest
from monstertruck_runtime.requests import Operator
from monstertruck_schemas import topics
from monstertruck_schemas.base import Message
from monstertruck_schemas.event import Event
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import UNCONDITIONAL, ControlRequest, DriveRequest, Order, Role
from monstertruck_schemas.state import GateState
from monstertruck_schemas.topics import Topic
from monstertruckd.daemon import Daemon

M = TypeVar("M", bound=Message)


GIVEN_UP: Final = frozenset({Reason.PATH_LOST, Reason.BAD_INPUT, Reason.NOT_FINITE, Reason.STUCK})
"""Outcomes that arming again does not change, also before the start of the path."""


class LocalOperator(Operator):
    """An operator inside the daemon's process: for the virtual clock, which has no Zenoh."""

    def __init__(self, daemon: Daemon, clock: Clock, source: str = "operator", role: Role = Role.STATION) -> None:
        self.source = source
        self._daemon = daemon
        self._clock = clock
        self._role = role
        self._seq = 0
        self._gate = daemon.bus.subscribe(topics.GATE, latest())

    def subscribe(self, topic: Topic[M], delivery: Delivery) -> Mailbox[M]:
        """Subscribe to a topic of this process."""
        return self._daemon.bus.subscribe(topic, delivery)

    async def call(self, rpc: str, payload: dict[str, Any] | None = None) -> dict[str, Any]:
        """Call ``rpc`` of the daemon."""
        return await self._daemon.rpc.call(rpc, payload or {})

    async def order(self, order: Order, *, hold: bool = False, calibrates: bool = False) -> GateState:
        """Send an order as ``TruckClient.order`` does."""
        if order in UNCONDITIONAL:
            request = ControlRequest.model_validate_json(json.dumps({**await self.header(), "order": order}))
            self._daemon.bus.inject(topics.REQ_CONTROL, request)
        answer = await self.call(order.value, {**await self.header(), "hold": hold, "calibrates": calibrates})
        return wire.decode(topics.GATE, json.dumps(answer).encode())

    async def drive_shafts(self, *rates: float, lease: float = 0.25) -> None:
        """Request wheel rates of every driven shaft, rad/s, as ``TruckClient.drive_shafts`` does."""
        request = DriveRequest(**await self.header(lease), speed=0.0, front=0.0, shafts=rates)
        self._daemon.bus.inject(topics.REQ_DRIVE, request)

    async def header(self, lease: float = 1.0) -> dict[str, Any]:
        """Return the header of the next request, once the gate has published its nonce."""
        while self._gate.latest is None:
            await self._gate.next()
        self._seq += 1
        now, gate = self._clock.now(), self._gate.latest
        return {
            "stamp": now,
            "received": now,
            "seq": self._seq,
            "source": self.source,
            "role": self._role,
            "lease": lease,
            "nonce": gate.nonce,
            "gate_stamp": gate.stamp,
        }


@dataclass(frozen=True, slots=True)
class Lap:
    """The tracker's report of one lap."""

    outcome: Reason
    start: int
    """Daemon time of arming, ns."""
    end: int
    """Daemon time of the path's end, ns."""
    cross_track: Array
    """Every reported distance from the path, m."""
    stops: tuple[Reason, ...] = ()
    """Why the gate stopped the truck on the way, in order."""
    armed_again: int = 0
    """How many of them left it disarmed."""
    text: str = ""
    """Why the path was given up, in the tracker's words; empty if it was driven."""

    @property
    def seconds(self) -> float:
        """Duration (s)."""
        return (self.end - self.start) / SECOND

    @property
    def cross_track_rms(self) -> float:
        """Root mean square distance from the path (m)."""
        return float(np.sqrt(np.mean(self.cross_track**2))) if len(self.cross_track) else 0.0


async def drive_lap(operator: Operator, clock: Clock, *, timeout: float = 30.0, limit: float = 600.0) -> Lap:
    """Arm the truck, let the tracker drive its path to the end, disarm; after a stop that disarms it, arm it again.

    Args:
        operator: sends the orders.
        clock: source of time.
        timeout: maximum time until the truck can be armed, s.
        limit: maximum time of the path, s.

    Raises:
        NoAnswerError: the truck could not be armed, or the path took too long; the text gives the reason.
    """
    with (
        operator.subscribe(topics.GATE, latest()) as gate,
        operator.subscribe(topics.STOP, fifo(256)) as stop,
        operator.subscribe(topics.TRACKER, fifo(256)) as tracker,
        operator.subscribe(topics.EVENT, fifo(256)) as events,
    ):
        await _arm(operator, clock, timeout)
        start, driven = clock.now(), False
        cross_track: list[float] = []
        stops: dict[int, Reason] = {}
        armed_again = 0
        try:
            async with clock.deadline(limit):
                while True:
                    report = await tracker.next()
                    driven |= report.outcome is Reason.DRIVING and report.received >= start
                    # 1.0: maximum delay of the tracker before it starts a path again after arming, s
                    # before
                    if not driven and report.received < start + 1.0 * SECOND:
                        continue  # of the path's end before
                    cross_track.append(report.cross_track)
                    stops |= {one.number: one.reason for one in stop.drain() if one.stamp >= start}
                    if report.outcome is not Reason.DRIVING and (report.along > 0 or report.outcome in GIVEN_UP):
                        reasons = tuple(stops.values())
                        text = await _text_of(report.outcome, events, clock)
                        across = np.array(cross_track)
                        return Lap(report.outcome, start, report.stamp, across, reasons, armed_again, text)
                    state = gate.latest
                    # 20: times in a lap that the truck is armed again after a stop; more are a fault, not a busy
                    # computer
                    if state is not None and not state.mode.active and armed_again < 20:
                        armed_again += 1
                        await _arm(operator, clock, timeout)
        except TimeoutError:
            why = gate.latest.why if gate.latest else "no state of the gate"
            raise NoAnswerError(f"path not finished within {limit:g} s ({why})") from None
        finally:
            await operator.disarm()


async def _text_of(outcome: Reason, events: Mailbox[Event], clock: Clock) -> str:
    """Return the text of the tracker's event on the end of a path, which may follow its state."""
    if outcome is Reason.GOAL_REACHED:
        return ""
    with suppress(TimeoutError):
        async with clock.deadline(1.0):
            while True:
                event = await events.next()
                if event.reason is outcome and event.text:
                    return event.text
    return ""


async def _arm(operator: Operator, clock: Clock, timeout: float) -> None:
    refusal = ""
    try:
        async with clock.deadline(timeout):
            while True:
                try:
                    await operator.arm()
                except (RequestRefusedError, NoAnswerError) as error:
                    refusal = str(error)
                else:
                    return
                await clock.sleep(0.25)
    except TimeoutError:
        text = f"the robot could not be armed within {timeout:g} s: {refusal or 'no answer'}"
        raise NoAnswerError(text) from None
