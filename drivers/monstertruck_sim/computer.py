"""Emulated computer of a simulated truck: hubs, ports and nodes with the names from its configuration."""

import asyncio
from collections.abc import Iterable, Mapping
from itertools import count
from pathlib import Path

from monstertruck_drivers.cable import DeviceEnd, EmulatedPort
from monstertruck_drivers.catalog import UsbIdentity
from monstertruck_drivers.computer import Computer, Disk
from monstertruck_drivers.config import AnyPort, Devices
from monstertruck_drivers.usb.config import UsbPortConfig
from monstertruck_drivers.usb.emulated import EmulatedUsb
from monstertruck_drivers.usb.tree import ancestors, is_topology, sort_key
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import InputError

OTHER = UsbIdentity("1a86:7523", "USB Serial", "ttyUSB")
"""Adapter of a device whose kind declares no USB identity."""
DISK = Disk(total=64_000_000_000, free=32_000_000_000)
"""Disk of an emulated computer: with the real disk, logs would differ between runs."""
HELP = "known: lose HUB, return HUB, over-current PLACE, suspend PLACE; places as in 1-1.2"


class UsbCable:
    """``EmulatedPort`` of a device in the emulated tree: unplugging the cable removes the device from the tree.

    Args:
        usb: the tree.
        where: kernel name of the device's place.
        cable: cable behind its node.
    """

    def __init__(self, usb: EmulatedUsb, where: str, cable: EmulatedPort) -> None:
        self.name = cable.name
        self._usb = usb
        self._where = where
        self._cable = cable

    @property
    def device(self) -> DeviceEnd:
        """Device side of the cable."""
        return self._cable.device

    @device.setter
    def device(self, end: DeviceEnd) -> None:
        self._cable.device = end

    def plug(self) -> None:
        """Plug the device in; it appears once its hub is present."""
        self._usb.plug(self._where)

    def unplug(self) -> None:
        """Unplug the cable from the hub."""
        self._usb.unplug(self._where)


def _buses(ports: Iterable[AnyPort]) -> dict[str, int]:
    """Choose bus numbers that no kernel name uses for the controllers in topology names."""
    hubs = [port.hub for port in ports if isinstance(port, UsbPortConfig)]
    controllers = sorted({hub.rpartition("-usb-0:")[0] for hub in hubs if is_topology(hub)})
    taken = {sort_key(hub)[0] for hub in hubs if not is_topology(hub)}
    return dict(zip(controllers, (bus for bus in count(1) if bus not in taken), strict=False))


def _by_kernel(port: UsbPortConfig, buses: Mapping[str, int]) -> UsbPortConfig:
    """Convert a port to the names of the emulated kernel."""
    if not is_topology(port.hub):
        return port
    controller, _, ports = port.hub.rpartition("-usb-0:")
    bus = buses[controller]
    return port.model_copy(update={"hub": f"usb{bus}" if ports == "0" else f"{bus}-{ports}"})


class EmulatedComputer:
    """USB tree with all devices that are configured by hub and port.

    Args:
        folder: existing folder that receives proc, sys and dev.
        devices: devices of the truck.
        cables: devices emulated on the cables, by role.
        clock: time.
    """

    def __init__(self, folder: Path, devices: Devices, cables: Mapping[str, EmulatedPort], clock: Clock) -> None:
        self.folder = folder
        self._clock = clock
        self._returning: asyncio.Task[None] | None = None
        self.usb = EmulatedUsb(folder)
        self.ports: dict[str, EmulatedPort] = dict(cables)
        """Cables by role."""
        buses = _buses(device.port for device in devices.present().values())
        self.usb.controllers |= {bus: controller.partition("-")[2] for controller, bus in buses.items()}
        places = {
            role: (_by_kernel(device.port, buses), device.kind)
            for role, device in devices.present().items()
            if isinstance(device.port, UsbPortConfig)
        }
        hubs = {hub for port, _ in places.values() for hub in (port.hub, *ancestors(port.hub)) if "-" in hub}
        for hub in sorted(hubs):
            self.usb.add_hub(hub, ports=7)
        for role, (port, kind) in places.items():
            identity = kind.usb or OTHER
            self.usb.add_device(
                port.device,
                port.usb_id or identity.usb_id,
                identity.title,
                node=identity.node,
                interface=port.interface,
                serial=f"emulated-{role}",
                cable=cables[role],
            )
            self.ports[role] = UsbCable(self.usb, port.device, cables[role])

    def computer(self) -> Computer:
        """Computer for a daemon in this process."""
        return Computer(self.usb.machine(self._clock), self.folder, lambda: self.usb.watcher, lambda _: DISK)

    def command(self, words: list[str]) -> None:
        """Execute a command on the USB tree (see ``HELP``); the return of a hub takes some time.

        Raises:
            InputError: the command or the place is unknown.
        """
        try:
            match words:
                case ["lose", hub]:
                    self.usb.lose_hub(hub)
                case ["return", hub] if self.usb.knows(hub):
                    self._returning = asyncio.get_running_loop().create_task(self.usb.return_hub(hub, self._clock))
                case ["over-current", where]:
                    self.usb.over_current(where)
                case ["suspend", where]:
                    self.usb.suspend_when_idle(where)
                case _:
                    raise InputError(HELP)
        except KeyError as error:
            raise InputError(f"no hub or device at {error}; {HELP}") from error


def hangs_by_hub(devices: Devices) -> bool:
    """Whether any device is configured by hub and port."""
    return any(isinstance(device.port, UsbPortConfig) for device in devices.present().values())
