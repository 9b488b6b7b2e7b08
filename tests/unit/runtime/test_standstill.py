"""Why a robot stands, in a client's words: what holds it, and who or what led to that."""

import pytest

from monstertruck_runtime.mailbox import Mailbox, fifo, latest
from monstertruck_runtime.standstill import StandstillMonitor
from monstertruck_schemas.event import Cause, Event, Severity, Stop
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.state import GateMode, GateState

OFF = Reason.DISARMED.text


class Robot:
    """Its gate, what it reports, and who follows it."""

    def __init__(self) -> None:
        self.gates, self.stops, self.events = Mailbox(latest()), Mailbox(latest()), Mailbox(fifo(64))
        self.monitor = StandstillMonitor(self.gates, self.stops, self.events)
        self.now = 0

    def gate(self, mode: GateMode, *reasons: Reason) -> str:
        """Its state; returns what is said of it then."""
        self.now += 1
        self.gates.put(
            GateState(stamp=self.now, received=0, seq=0, mode=mode, nonce="n", speed_limit=0.0, reasons=reasons)
        )
        return self.monitor.why()

    def event(self, reason: Reason, text: str = "", source: str = "gate") -> None:
        self.now += 1
        self.events.put(
            Event(stamp=self.now, received=0, seq=0, reason=reason, severity=Severity.INFO, source=source, text=text)
        )

    def stop(self, mode: GateMode, *texts: str) -> None:
        """A stop by a chain of causes."""
        self.now += 1
        causes = tuple(
            Cause(reason=Reason.SCAN_STALE, source="", since=0, text=text, because=i if i < len(texts) else None)
            for i, text in enumerate(texts, start=1)
        )
        self.stops.put(
            Stop(stamp=self.now, received=0, seq=0, number=1, reason=Reason.OK, mode=mode, causes=causes, text="")
        )


def test_where_it_stood_before_anybody_looked_only_what_holds_it_is_known():
    robot = Robot()
    robot.stop(GateMode.STOPPING, "long ago")
    assert robot.monitor.why() == ""
    assert robot.gate(GateMode.DISARMED, Reason.DISARMED, Reason.SCAN_STALE) == f"{OFF}, {Reason.SCAN_STALE.text}"
    assert robot.gate(GateMode.DISARMED) == "the robot is disarmed"
    assert robot.gate(GateMode.DRIVING, Reason.OBSTACLE_SLOW) == ""


def test_who_disarmed_it_at_rest_or_on_its_way_is_named_once():
    robot = Robot()
    robot.stop(GateMode.STOPPING, "long ago")
    robot.gate(GateMode.ARMED)
    robot.event(Reason.DISARMED, "the way home failed", source="explorer")
    robot.event(Reason.DISARMED, "disarmed by ann")
    assert robot.gate(GateMode.DISARMED, Reason.DISARMED) == f"{OFF} (disarmed by ann)"
    robot.event(Reason.ARMED)
    robot.event(Reason.DRIVING)
    robot.event(Reason.DISARMED, "disarmed by bob")
    robot.stop(GateMode.STOPPING, "disarmed by bob")
    robot.event(Reason.DISARMED, OFF)
    assert robot.gate(GateMode.DISARMED, Reason.DISARMED) == f"{OFF} (disarmed by bob)"


def test_what_stopped_it_before_it_disarmed_itself_is_named():
    robot = Robot()
    robot.gate(GateMode.ARMED)
    robot.event(Reason.DRIVING)
    robot.stop(GateMode.STOPPING, "no fresh lidar scan", "lidar: unplugged")
    robot.event(Reason.DISARMED, "no driver for 1.5 s")
    said = robot.gate(GateMode.DISARMED, Reason.DISARMED, Reason.SCAN_STALE)
    cause = "no driver for 1.5 s; no fresh lidar scan, because lidar: unplugged"
    assert said == f"{OFF} ({cause}), {Reason.SCAN_STALE.text}"


@pytest.mark.parametrize("again", [True, False])
def test_stops_after_which_it_drove_on_have_not_disarmed_it(again: bool):
    robot = Robot()
    robot.gate(GateMode.ARMED)
    robot.event(Reason.DRIVING)
    robot.stop(GateMode.STOPPING if again else GateMode.DRIVING, "somebody in the way")
    if again:
        robot.event(Reason.DRIVING)
    robot.event(Reason.DISARMED, "disarmed by ann")
    assert robot.gate(GateMode.DISARMED, Reason.DISARMED) == f"{OFF} (disarmed by ann)"


def test_who_stopped_it_in_an_emergency_is_named_to_whoever_comes_later_too():
    robot = Robot()
    robot.stop(GateMode.ESTOPPED, "emergency stop by bob")
    said = robot.gate(GateMode.ESTOPPED, Reason.ESTOPPED)
    assert said == f"{Reason.ESTOPPED.text} (emergency stop by bob)"
