"""Explains why a robot does not drive: the gate's current reason, and its cause from events and stops."""

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
"""Events that end an earlier reason for standing still."""
HELD: Final = frozenset({Reason.DISARMED, Reason.ESTOPPED})
"""Reasons without a cause."""
ENDS: Final = frozenset({Reason.DISARMED, Reason.FAULTS_REPEAT})
"""Events of the gate whose text names the source or cause of a disarm."""


class StandstillMonitor:
    """Follows one robot; see ``monitor_standstill``.

    Args:
        gate: latest state of the gate.
        stops: latest stop.
        events: all events.
    """

    def __init__(self, gate: Mailbox[GateState], stops: Mailbox[Stop], events: Mailbox[Event]) -> None:
        self.gate = gate
        self._stops = stops
        self._events = events
        self._since: int | None = None
        """Time of the last arming or start of driving, or when the client first saw it armed, ns of its clock; None if
        never.
        """
        self._said: list[str] = []

    def why(self) -> str:
        """Return why the robot may not drive, with the cause of a disarm if known; empty if it may.

        Call it regularly, also while the robot drives.
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
        """Return the source or cause of the disarm or emergency stop; empty if unknown."""
        stop, estopped = self._stops.latest, held.mode is GateMode.ESTOPPED
        said = [] if estopped else self._said
        if stop is not None and (stop.mode is GateMode.ESTOPPED if estopped else self._after_it_began(stop)):
            said = [*said, _causes(stop)]
        return "; ".join(dict.fromkeys(said))

    def _after_it_began(self, stop: Stop) -> bool:
        """Whether the stop ended the latest drive; at an obstacle the robot stands, but its driver keeps control."""
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
    """Return the tripped check and its causes, without measurements."""
    return "; ".join(", because ".join(cause.text for cause in chain(stop.causes, head)) for head in heads(stop.causes))


@contextmanager
def monitor_standstill(robot: Subscriber) -> Iterator[StandstillMonitor]:
    """Follow a robot through its ``subscribe`` for the duration of the context."""
    with (
        robot.subscribe(GATE, latest()) as gate,
        robot.subscribe(STOP, latest()) as stops,
        robot.subscribe(EVENT, fifo(256)) as events,
    ):
        yield StandstillMonitor(gate, stops, events)
