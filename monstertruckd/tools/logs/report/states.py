"""From messages to the rows of the timeline."""

from collections.abc import Callable, Iterator
from typing import Any, Final

from monstertruck_schemas import topics as t
from monstertruck_schemas.health import HealthTable, ServiceHealth, ServiceState
from monstertruck_schemas.sensor import Battery, BatteryLevel, DriveFeedback, DriveMode
from monstertruck_schemas.state import GateMode, GateState
from monstertruck_schemas.topics import Topic
from monstertruck_schemas.usb import UsbState, UsbTree
from monstertruckd.tools.logs.report.spans import Tone, Track

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
"""Limits of a truck that is meant to stand: the gate's row says so already."""


class States:
    """Every row of the timeline, filled message by message."""

    def __init__(self) -> None:
        self.gate = Track("gate")
        self.driver = Track("driven by")
        self.limit = Track("limited by")
        self.motor = Track("motor")
        self.battery = Track("battery")
        self.services: dict[str, Track] = {}
        self.health: dict[str, ServiceHealth] = {}
        """Newest row of each service that was not its ordinary stop."""
        self.usb: dict[str, Track] = {}

    def takers(self) -> Iterator[tuple[Topic[Any], Callable[[int, Any], None]]]:
        """Which message goes where."""
        yield t.GATE, self._gate
        yield t.DRIVE, self._motor
        yield t.BATTERY, self._battery
        yield t.HEALTH, self._services
        yield t.USB, self._usb

    def close(self, end: int) -> None:
        """The log ends."""
        for track in (*self.main, *self.services.values(), *self.usb.values()):
            track.close(end)

    @property
    def main(self) -> tuple[Track, ...]:
        """Rows that are always worth showing."""
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
            track = self.services.setdefault(row.name, Track(row.name))
            track.set(now, row.state.value, _SERVICE[row.state], row.detail)
            if row.state is not ServiceState.STOPPED or row.name not in self.health:
                self.health[row.name] = row

    def _usb(self, now: int, tree: UsbTree) -> None:
        for node in tree.nodes:
            if node.role is not None:
                track = self.usb.setdefault(node.role, Track(f"usb {node.role}"))
                track.set(now, node.state.value, _USB[node.state], node.name)
