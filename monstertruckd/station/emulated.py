"""Emulated robot in the station's process: faults in its devices, obstacles in its world."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from monstertruck_runtime.errors import InputError
from monstertruckd.station.commands import DeviceFault

FAULTS: Final[Mapping[DeviceFault, Sequence[str]]] = {
    "none": ("plug", "line deaf off", "line flip_rate 0"),
    "unplugged": ("unplug",),
    "deaf": ("line deaf on",),
    "noise": ("line flip_rate 0.02",),
}
"""Emulator commands that cause each fault; the commands for ``none`` end all faults."""


class EmulatedWorld:
    """Faults and obstacles of one emulated robot.

    Args:
        devices: roles of its emulated devices.
        command: executes one command of the emulator's console; raises InputError.
    """

    def __init__(self, devices: Sequence[str], command: Callable[[list[str]], None]) -> None:
        self._command = command
        self._faults: dict[str, DeviceFault] = dict.fromkeys(devices, "none")
        self._obstacles: list[tuple[float, float]] = []

    def state(self) -> dict[str, Any]:
        """Return the current faults by device, and the positions of the obstacles (m)."""
        return {"faults": self._faults, "obstacles": self._obstacles}

    def inject(self, device: str, fault: DeviceFault) -> None:
        """Replace the fault of a device.

        Raises:
            InputError: the device does not exist, or its emulator refuses.
        """
        if device not in self._faults:
            raise InputError(f"device {device!r}: expected one of {', '.join(self._faults)}")
        for line in (*FAULTS["none"], *(FAULTS[fault] if fault != "none" else ())):
            self._command([device, *line.split()])
        self._faults[device] = fault

    def place(self, at: tuple[float, float] | None) -> None:
        """Place an obstacle at a position in the world (m); None removes all obstacles.

        Raises:
            InputError: the robot is at this position.
        """
        if at is None:
            self._command(["room", "clear"])
            self._obstacles.clear()
        else:
            self._command(["room", "post", *map(str, at)])
            self._obstacles.append(at)
