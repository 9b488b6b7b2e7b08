"""Why a robot does not drive, as a client learns it: the gate's state says what holds it, events and stops what did."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from monstertruck_runtime.mailbox import Mailbox, fifo, latest
from monstertruck_runtime.presence import Subscriber
from monstertruck_runtime.stop_text import chain, heads
from monstertruck_schemas.event import Event, Stop
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.roles import ServiceName
from monstertruck_schemas.state import GateMode, GateState
from monstertruck_schemas.topics import EVENT, GATE, STOP

BEGINS: Final = frozenset({Reason.ARMED, Reason.DRIVING})
"""Events after which what held the robot before is over."""
HELD: Final = frozenset({Reason.DISARMED, Reason.ESTOPPED})
"""Reasons that do not say what led to them."""
ENDS: Final = frozenset({Reason.DISARMED, Reason.FAULTS_REPEAT})
"""Events of the gate whose text says who or what disarmed the robot."""


class StandstillMonitor:
    """Follows one robot; see ``monitor_standstill``.

    Args:
        gate: newest state of the gate.
        stops: newest stop.
        events: all events.
    """

    def __init__(self, gate: Mailbox[GateState], stops: Mailbox[Stop], events: Mailbox[Event]) -> None:
        self.gate = gate
        self._stops = stops
        self._events = events
        self._since: int | None = None
        """When it was armed or began to drive last, or was first seen to be armed, ns of its clock; None = never."""
        self._said: list[str] = []

    def why(self) -> str:
        """Why the gate lets the robot not drive, with who or what disarmed it if that is known; nothing where it does.

        To be called now and then while the robot drives, too.
        """
        held = self.gate.latest
        self._take()
        if held is None:
            return ""
        if held.mode.active:
            self._since = held.stamp if self._since is None else self._since
            return ""
        cause = self._cause(held)
        texts = (f"{reason.text} ({cause})" if cause and reason in HELD else reason.text for reason in held.reasons)
        return ", ".join(texts) or held.why

    def _cause(self, held: GateState) -> str:
        """Who or what disarmed the robot or stopped it in an emergency; empty where that is not known."""
        stop, estopped = self._stops.latest, held.mode is GateMode.ESTOPPED
        said = [] if estopped else self._said
        if stop is not None and (stop.mode is GateMode.ESTOPPED if estopped else self._after_it_began(stop)):
            said = [*said, _causes(stop)]
        return "; ".join(dict.fromkeys(said))

    def _after_it_began(self, stop: Stop) -> bool:
        """Whether it ended the newest driving: where something is in the way the robot stands, and its driver stays."""
        return self._since is not None and stop.stamp >= self._since and not stop.mode.accepts_motion

    def _take(self) -> None:
        for event in self._events.drain():
            if event.source != ServiceName.GATE:
                continue
            if event.reason in BEGINS:
                self._since, self._said = event.stamp, []
            elif event.reason in ENDS and event.text not in ("", event.reason.text):
                self._said.append(event.text)


def _causes(stop: Stop) -> str:
    """What tripped the gate, and what was behind it, without measurements."""
    return "; ".join(", because ".join(cause.text for cause in chain(stop.causes, head)) for head in heads(stop.causes))


@contextmanager
def monitor_standstill(robot: Subscriber) -> Iterator[StandstillMonitor]:
    """Follow a robot through its ``subscribe`` while the context lasts."""
    with (
        robot.subscribe(GATE, latest()) as gate,
        robot.subscribe(STOP, latest()) as stops,
        robot.subscribe(EVENT, fifo(256)) as events,
    ):
        yield StandstillMonitor(gate, stops, events)
