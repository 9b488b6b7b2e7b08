"""Switches single USB ports, and keeps the kernel from suspending devices in use."""

import contextlib
from typing import Final

from monstertruck_drivers.usb.config import CycleMethod, PowerConfig
from monstertruck_drivers.usb.machine import Machine
from monstertruck_drivers.usb.tree import DEVICES, parent_of, place, port_directory, port_of, read_device
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import BusyError, DeviceError
from monstertruck_runtime.ports import EventSink
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason

FIRST_PAUSE: Final = 1
LONGEST_PAUSE: Final = 60
FORGET_AFTER: Final = 600
"""Seconds without a cycle after which the pause starts from the first one again."""
SETTLED: Final = 0.5
"""Seconds a device is left unauthorized."""


class PortPower:
    """Cycles ports, every one at most after 1, 2, 4 ... 60 s.

    Args:
        config: method and times.
        machine: where the ports are.
        events: every cycle is told.
    """

    def __init__(self, config: PowerConfig, machine: Machine, events: EventSink) -> None:
        self.config = config
        self._machine = machine
        self._events = events
        self._cycles: dict[str, tuple[int, int]] = {}

    async def cycle(self, name: str) -> None:
        """Switch the port ``name`` hangs on off and on; its device vanishes and comes back.

        Raises:
            DeviceError: switching is not configured, a hub hangs there, or the machine refused.
            BusyError: too soon after the last cycle of this port.
        """
        method = self.config.method
        if method is None:
            raise DeviceError("no method to switch USB ports is configured (power.method)")
        device = await self._machine.beside(lambda: read_device(self._machine.sysfs, name))
        if parent_of(name) is None or (device is not None and device.hub):
            raise DeviceError(f"{name} is a hub: only ports of single devices are switched")
        self._pace(name)
        try:
            if method is CycleMethod.UHUBCTL:
                await self._uhubctl(name)
            elif method is CycleMethod.PORT:
                await self._toggle(f"{port_directory(name)}/disable", "1", "0", self.config.off_time)
            else:
                await self._toggle(f"{DEVICES}/{name}/authorized", "0", "1", SETTLED)
        except OSError as error:
            raise DeviceError(f"{place(name)} cannot be switched by {method.value!r}: {error}") from error
        self._events(
            Reason.PORT_CYCLED, Severity.WARNING, "usb", f"{place(name)} was switched off and on", method=method.value
        )

    def _pace(self, name: str) -> None:
        now = self._machine.clock.now()
        count, last = self._cycles.get(name, (0, now))
        if now - last > FORGET_AFTER * SECOND:
            count = 0
        if count:
            pause = min(FIRST_PAUSE << (count - 1), LONGEST_PAUSE)
            left = pause - (now - last) / SECOND
            if left > 0:
                raise BusyError(f"{place(name)} was switched just now; again in {left:.1f} s")
        self._cycles[name] = (min(count + 1, LONGEST_PAUSE), now)

    async def _toggle(self, attribute: str, off: str, on: str, seconds: float) -> None:
        machine = self._machine
        await machine.beside(lambda: machine.sysfs.write(attribute, off))
        try:
            await machine.clock.sleep(seconds)
        finally:
            await machine.beside(lambda: machine.sysfs.write(attribute, on))

    async def _uhubctl(self, name: str) -> None:
        hub = str(parent_of(name)).removeprefix("usb")
        delay = f"{self.config.off_time:g}"
        code, output = await self._machine.run(
            ["uhubctl", "-l", hub, "-p", str(port_of(name)), "-a", "cycle", "-d", delay]
        )
        if code:
            raise DeviceError(f"{place(name)}: uhubctl failed with {code}: {output}")


async def keep_awake(machine: Machine, name: str) -> bool:
    """Forbid the kernel to suspend a device; False if that is not permitted."""

    def write() -> bool:
        with contextlib.suppress(OSError):
            machine.sysfs.write(f"{DEVICES}/{name}/power/control", "on")
        return machine.sysfs.text(f"{DEVICES}/{name}/power/control") == "on"

    return await machine.beside(write)
