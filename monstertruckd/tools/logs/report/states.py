"""States over time: the rows and bars of the report's timeline."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import Any, Final

from monstertruck_runtime.clock import SECOND
from monstertruck_schemas import topics as t
from monstertruck_schemas.health import HealthTable, ServiceHealth, ServiceState
from monstertruck_schemas.sensor import Battery, BatteryLevel, DriveFeedback, DriveMode
from monstertruck_schemas.state import GateMode, GateState
from monstertruck_schemas.topics import Topic
from monstertruck_schemas.usb import UsbState, UsbTree


class Tone(IntEnum):
    """Colour of a state; larger is worse."""

    NONE = 0
    """Not drawn."""
    CALM = 1
    GOOD = 2
    BUSY = 3
    WARNING = 4
    BAD = 5


@dataclass(frozen=True, slots=True)
class StateSpan:
    """A state that held from ``start`` to ``end`` (ns)."""

    start: int
    end: int
    text: str
    tone: Tone
    detail: str = ""

    @property
    def seconds(self) -> float:
        """Duration (s)."""
        return (self.end - self.start) / SECOND


@dataclass(slots=True)
class StateTrack:
    """One row of the timeline."""

    name: str
    spans: list[StateSpan] = field(default_factory=list)

    def set(self, time: int, text: str, tone: Tone, detail: str = "") -> None:
        """Begin a state at ``time``."""
        if self.spans:
            last = self.spans[-1]
            if (last.text, last.tone, last.detail) == (text, tone, detail):
                return
            self.spans[-1] = replace(last, end=time)
        self.spans.append(StateSpan(time, time, text, tone, detail))

    def close(self, end: int) -> None:
        """End the current state at ``end``."""
        if self.spans:
            self.spans[-1] = replace(self.spans[-1], end=max(end, self.spans[-1].start))

    @property
    def worst(self) -> Tone:
        """Worst state."""
        return max((span.tone for span in self.spans), default=Tone.NONE)

    def seconds(self, text: str) -> float:
        """Return the total duration of the state ``text`` (s)."""
        return sum(span.seconds for span in self.spans if span.text == text)


def merged_spans(spans: list[StateSpan], shortest: int) -> list[StateSpan]:
    """Return the spans to draw: neighbours shorter than ``shortest`` (ns) are merged and take the worse state."""
    merged: list[StateSpan] = []
    for span in spans:
        if merged and span.end - span.start < shortest and merged[-1].end - merged[-1].start < shortest:
            worse = max(merged[-1], span, key=lambda s: s.tone)
            merged[-1] = replace(worse, start=merged[-1].start, end=span.end)
        else:
            merged.append(span)
    return [span for span in merged if span.tone is not Tone.NONE]


_GATE: Final = {
    GateMode.DISARMED: Tone.CALM,
    GateMode.ARMED: Tone.BUSY,
    GateMode.DRIVING: Tone.GOOD,
    GateMode.STOPPING: Tone.WARNING,
    GateMode.ESTOPPED: Tone.BAD,
}
_SERVICE: Final = {
    ServiceState.STARTING: Tone.BUSY,
    ServiceState.READY: Tone.GOOD,
    ServiceState.BACKOFF: Tone.WARNING,
    ServiceState.FAILED: Tone.BAD,
    ServiceState.STOPPED: Tone.CALM,
}
_MOTOR: Final = {
    DriveMode.DISABLED: Tone.CALM,
    DriveMode.STARTING: Tone.BUSY,
    DriveMode.ENABLED: Tone.GOOD,
    DriveMode.QUICK_STOP: Tone.WARNING,
    DriveMode.FAULT: Tone.BAD,
}
_BATTERY: Final = {
    BatteryLevel.UNKNOWN: Tone.CALM,
    BatteryLevel.NORMAL: Tone.GOOD,
    BatteryLevel.LOW: Tone.WARNING,
    BatteryLevel.CRITICAL: Tone.BAD,
    BatteryLevel.OVERCHARGED: Tone.WARNING,
    BatteryLevel.SENSOR_FAULT: Tone.WARNING,
}
_USB: Final = {
    UsbState.PRESENT: Tone.GOOD,
    UsbState.ABSENT: Tone.BAD,
    UsbState.WAITING: Tone.WARNING,
    UsbState.HELD: Tone.WARNING,
}
_NORMAL: Final = {"disarmed"}
"""Limits that the gate's row already shows."""


class StateTimeline:
    """Every row of the timeline, filled message by message."""

    def __init__(self) -> None:
        self.gate = StateTrack("gate")
        self.driver = StateTrack("driven by")
        self.limit = StateTrack("limited by")
        self.motor = StateTrack("motor")
        self.battery = StateTrack("battery")
        self.services: dict[str, StateTrack] = {}
        self.health: dict[str, ServiceHealth] = {}
        """Latest health of each service, except its ordinary stop."""
        self.usb: dict[str, StateTrack] = {}

    def handlers(self) -> Iterator[tuple[Topic[Any], Callable[[int, Any], None]]]:
        """Topics and the functions that add their messages."""
        yield t.GATE, self._gate
        yield t.DRIVE, self._motor
        yield t.BATTERY, self._battery
        yield t.HEALTH, self._services
        yield t.USB, self._usb

    def close(self, end: int) -> None:
        """End all states at the end of the log."""
        for track in (*self.main, *self.services.values(), *self.usb.values()):
            track.close(end)

    @property
    def main(self) -> tuple[StateTrack, ...]:
        """Rows that are always shown."""
        return self.gate, self.driver, self.limit, self.motor, self.battery

    def _gate(self, now: int, gate: GateState) -> None:
        self.gate.set(now, gate.mode.value, _GATE[gate.mode])
        self.driver.set(now, gate.holder or "", Tone.BUSY if gate.holder else Tone.NONE)
        reasons = [reason for reason in gate.reasons if reason.value not in _NORMAL]
        tone = Tone.WARNING if reasons else Tone.NONE
        self.limit.set(now, reasons[0].value if reasons else "", tone, ", ".join(r.text for r in reasons))

    def _motor(self, now: int, drive: DriveFeedback) -> None:
        self.motor.set(now, drive.mode.value, _MOTOR[drive.mode])

    def _battery(self, now: int, battery: Battery) -> None:
        self.battery.set(now, battery.level.value, _BATTERY[battery.level])

    def _services(self, now: int, table: HealthTable) -> None:
        for row in table.services:
            track = self.services.setdefault(row.name, StateTrack(row.name))
            track.set(now, row.state.value, _SERVICE[row.state], row.detail)
            if row.state is not ServiceState.STOPPED or row.name not in self.health:
                self.health[row.name] = row

    def _usb(self, now: int, tree: UsbTree) -> None:
        for node in tree.nodes:
            if node.role is not None:
                track = self.usb.setdefault(node.role, StateTrack(f"usb {node.role}"))
                track.set(now, node.state.value, _USB[node.state], node.name)
