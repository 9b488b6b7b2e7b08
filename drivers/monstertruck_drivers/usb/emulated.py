"""Emulated machine with USB hubs: a sysfs tree in a folder, change notifications, and cables that can be unplugged.

The folder contains the parts of ``/sys`` and ``/dev`` that this package reads and writes. Serial nodes lead to emulated
ports, so all code above runs as on a robot, with either clock.
"""

import errno
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Final

from monstertruck_drivers.cable import EmulatedPort, MemoryPort, PtyPort
from monstertruck_drivers.computer import Machine, Sysfs
from monstertruck_drivers.link import BAUD, Framing, Port
from monstertruck_drivers.tty import SerialPort
from monstertruck_drivers.usb.tree import DEVICES, ancestors, parent_of, port_directory, port_of, renumbered, sort_key
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.threads import inline

ENUMERATION: Final = 0.12
"""Interval between the devices of a returning hub (s)."""


@dataclass(slots=True)
class _HubOrDevice:
    """A hub or device that exists, whether plugged in or not."""

    name: str
    usb_id: str
    title: str
    serial: str | None
    ports: int = 0
    """Number of ports of a hub; 0 for a device."""
    node: str | None = None
    """``ttyUSB``, ``ttyACM`` or ``video``."""
    interface: int = 0
    cable: EmulatedPort | None = None
    plugged: bool = False
    autosuspend: bool = False
    node_name: str | None = None


@dataclass(slots=True)
class EmulatedWatcher:
    """Reports changes of the emulated machine; if ``deaf``, there is no udev and nothing is reported."""

    deaf: bool = False
    _hint: Callable[[], None] | None = field(default=None)

    def start(self, hint: Callable[[], None]) -> None:
        """Start listening."""
        self._hint = hint

    def stop(self) -> None:
        """Stop listening."""
        self._hint = None

    def announce(self) -> None:
        """Report a change."""
        if self._hint is not None and not self.deaf:
            self._hint()


class EmulatedUsb:
    """Hubs and devices in a folder.

    Args:
        folder: existing folder that receives ``sys`` and ``dev``.
    """

    def __init__(self, folder: Path) -> None:
        self.watcher = EmulatedWatcher()
        self.sysfs = _EmulatedSysfs(folder / "sys", self)
        self.dev = folder / "dev"
        self.refused: set[str] = set()
        """Attributes that refuse writes, as for a user without permission: ``latency_timer`` ..."""
        self.busy_numbers: set[int] = set()
        """Node numbers still taken by a process that has a vanished node open."""
        self.controllers: dict[int, str] = {}
        """Controllers by bus number; root hubs report them as serial number."""
        self.commands: list[Sequence[str]] = []
        """Programs that were run."""
        self._devices: dict[str, _HubOrDevice] = {}
        self._devnums = count(2)
        (folder / "sys" / DEVICES).mkdir(parents=True)
        self.dev.mkdir()

    def machine(self, clock: Clock) -> Machine:
        """Return the computer for the code under test."""
        return Machine(clock, self.sysfs, self.dev, inline, self._run, self._serial)

    # Hubs and devices

    def add_hub(self, name: str, *, ports: int = 4) -> None:
        """Create a hub and plug it in; root hubs are created automatically."""
        self._add_root(parent_of(name))
        self._devices[name] = _HubOrDevice(name, "05e3:0608", "USB2.0 Hub", None, ports=ports)
        self.plug(name)

    def add_device(
        self,
        name: str,
        usb_id: str,
        title: str = "",
        *,
        node: str | None = None,
        interface: int = 0,
        serial: str | None = None,
        cable: EmulatedPort | None = None,
    ) -> None:
        """Create a device and plug it in.

        Args:
            name: place, such as ``1-1.2``; its hub must exist.
            usb_id: ``vendor:product``.
            title: product name.
            node: ``ttyUSB`` (FTDI), ``ttyACM`` (CDC) or ``video``; None for no node.
            interface: USB interface of the node.
            serial: serial number.
            cable: emulated port behind a serial node.
        """
        self._add_root(parent_of(name))
        self._devices[name] = _HubOrDevice(name, usb_id, title, serial, node=node, interface=interface, cable=cable)
        self.plug(name)

    def _add_root(self, hub: str | None) -> None:
        """Create a root hub unless it exists."""
        if hub is not None and hub.startswith("usb") and hub not in self._devices:
            controller = self.controllers.get(int(hub.removeprefix("usb")))
            self._devices[hub] = _HubOrDevice(hub, "1d6b:0002", "xHCI Host Controller", controller, ports=8)
            self.plug(hub)

    def knows(self, name: str) -> bool:
        """Return whether the hub or device exists, plugged in or not."""
        return name in self._devices

    def present(self, name: str) -> bool:
        """Return whether the hub or device appears in the tree."""
        return (self.sysfs.root / DEVICES / name).exists()

    # Changes

    def plug(self, name: str, *, number: int | None = None) -> None:
        """Plug in one hub or device; no effect while its hub is absent.

        Args:
            name: place.
            number: number of its node; None selects the lowest free number.
        """
        device = self._devices[name]
        device.plugged = True
        if self.present(name) or any(not self.present(hub) for hub in ancestors(name)):
            return
        vendor, product = device.usb_id.split(":")
        values = {
            "devnum": str(next(self._devnums)),
            "idVendor": vendor,
            "idProduct": product,
            "bDeviceClass": "09" if device.ports else "00",
            "product": device.title,
            "authorized": "1",
            "power/control": "auto" if device.ports or device.autosuspend else "on",
        }
        if device.serial is not None:
            values["serial"] = device.serial
        self._write(f"{DEVICES}/{name}", values)
        if device.ports:
            for port in range(1, device.ports + 1):
                child = f"{name[3:]}-{port}" if name.startswith("usb") else f"{name}.{port}"
                self._write(port_directory(child), {"over_current_count": "0", "disable": "0"})
        self._bind(device, number)
        self.watcher.announce()

    def unplug(self, name: str) -> None:
        """Unplug one hub or device, and all devices behind it."""
        self._devices[name].plugged = False
        self._vanish(name)

    def lose_hub(self, name: str) -> None:
        """Make a hub drop off the bus: its devices vanish, then the hub, while every cable stays plugged in."""
        self._vanish(self._devices[name].name)

    async def return_hub(self, name: str, clock: Clock, *, first: float = 0.2, between: float = ENUMERATION) -> None:
        """Enumerate a hub again, then its plugged devices in sequence.

        Args:
            name: name of the hub.
            clock: clock for the delays.
            first: delay of the hub itself (s).
            between: delay before each of its devices (s).
        """
        await clock.sleep(first)
        self.plug(name)
        for child in self._behind(name):
            if self._devices[child].plugged:
                await clock.sleep(between)
                self.plug(child)

    def move(self, name: str, to: str) -> None:
        """Plug a device into another port."""
        self.unplug(name)
        device = self._devices.pop(name)
        device.name = to
        self._devices[to] = device
        self.plug(to)

    def renumber(self, buses: Mapping[str, str]) -> None:
        """Restart controllers: all devices behind them are enumerated again, with other bus numbers.

        Args:
            buses: new bus number by old bus number.
        """
        for bus in buses:
            self._vanish(f"usb{bus}")
        controllers = {int(buses.get(str(bus), bus)): name for bus, name in self.controllers.items()}
        self.controllers.clear()
        self.controllers.update(controllers)
        devices = {renumbered(name, buses): device for name, device in self._devices.items()}
        self._devices.clear()
        self._devices.update(devices)
        for name, device in devices.items():
            device.name = name
        for name in sorted(devices, key=sort_key):
            if str(sort_key(name)[0]) in buses.values() and devices[name].plugged:
                self.plug(name)

    def claim(self, name: str) -> None:
        """Let a program claim the interface behind a device's node through usbfs, as brltty does; the node vanishes."""
        device = self._devices[name]
        self._unbind(device)
        interface = f"{name}:1.{device.interface}"
        self._write(f"{DEVICES}/{interface}", {"uevent": "DEVTYPE=usb_interface\nDRIVER=usbfs"})
        (self.sysfs.root / DEVICES / name / interface).symlink_to(Path("..") / interface)
        self.watcher.announce()

    def over_current(self, name: str) -> None:
        """Report over-current at the port of ``name``."""
        name = self._devices[name].name
        attribute = f"{port_directory(name)}/over_current_count"
        seen = self.sysfs.number(attribute) or 0
        self._write(port_directory(name), {"over_current_count": str(seen + 1)})
        self.watcher.announce()

    def suspend_when_idle(self, name: str) -> None:
        """Let the kernel suspend the device, now and after every replug, as a power saver would."""
        self._devices[name].autosuspend = True
        self._write(f"{DEVICES}/{name}", {"power/control": "auto"})
        self.watcher.announce()

    def written(self, path: str, value: str) -> None:
        """React like the kernel to an attribute written by the code under test.

        Raises:
            PermissionError: the attribute is in ``refused``.
        """
        attribute = Path(path).name
        if attribute in self.refused:
            raise PermissionError(errno.EACCES, "Permission denied", path)
        folder = Path(path).parent.name
        if attribute == "disable":
            self._switch(self._at_port(folder), on=value == "0")
        elif attribute == "authorized":
            device = self._devices[folder]
            self._unbind(device) if value == "0" else self._bind(device, None)
            self.watcher.announce()

    # Implementation

    def _behind(self, hub: str) -> list[str]:
        return sorted((name for name in self._devices if hub in ancestors(name)), key=sort_key)

    def _vanish(self, name: str) -> None:
        """Remove a hub or device, children first, as the kernel does."""
        for child in [*reversed(self._behind(name)), name]:
            if not self.present(child):
                continue
            self._unbind(self._devices[child])
            for interface in self.sysfs.root.joinpath(DEVICES).glob(f"{_interface_prefix(child)}:*"):
                shutil.rmtree(interface)
            shutil.rmtree(self.sysfs.root / DEVICES / child)
            self.watcher.announce()

    def _bind(self, device: _HubOrDevice, number: int | None) -> None:
        """Bind drivers to the device: interface and node appear."""
        if device.node is None:
            return
        taken = {other.node_name for other in self._devices.values()} | {
            f"{device.node}{busy}" for busy in self.busy_numbers
        }
        free = next(n for n in count() if f"{device.node}{n}" not in taken) if number is None else number
        device.node_name = f"{device.node}{free}"
        interface = f"{DEVICES}/{device.name}:1.{device.interface}"
        link = self.sysfs.root / DEVICES / device.name / f"{device.name}:1.{device.interface}"
        if device.node == "ttyUSB":
            self._write(f"{interface}/{device.node_name}", {"latency_timer": "16"})  # default of an FTDI
        else:
            kind = "video4linux" if device.node == "video" else "tty"
            self._write(f"{interface}/{kind}/{device.node_name}", {})
        link.symlink_to(Path("..") / link.name)
        if device.cable is not None:
            device.cable.plug()
            if isinstance(device.cable, PtyPort):
                (self.dev / device.node_name).symlink_to(device.cable.name)

    def _unbind(self, device: _HubOrDevice) -> None:
        if device.node_name is None:
            return
        if device.cable is not None:
            device.cable.unplug()
        (self.dev / device.node_name).unlink(missing_ok=True)
        link = self.sysfs.root / DEVICES / device.name / f"{device.name}:1.{device.interface}"
        link.unlink(missing_ok=True)
        shutil.rmtree(self.sysfs.root / DEVICES / link.name)
        device.node_name = None

    def _at_port(self, folder: str) -> _HubOrDevice | None:
        devices = (device for device in self._devices.values() if parent_of(device.name) is not None)
        return next((device for device in devices if Path(port_directory(device.name)).name == folder), None)

    def _switch(self, device: _HubOrDevice | None, *, on: bool) -> None:
        """Switch a port's power; its device vanishes or appears."""
        if device is not None and not on:
            self._vanish(device.name)
        elif device is not None and device.plugged:
            self.plug(device.name)

    def _write(self, path: str, values: dict[str, str]) -> None:
        folder = self.sysfs.root / path
        folder.mkdir(parents=True, exist_ok=True)
        for attribute, value in values.items():
            (folder / attribute).parent.mkdir(exist_ok=True)
            (folder / attribute).write_text(f"{value}\n")

    def _serial(
        self,
        path: Path,
        baud: int = BAUD,
        *,
        dtr: bool = True,
        rts: bool = True,
        low_latency: bool = False,
        framing: Framing = "8N1",
    ) -> Port:
        for device in self._devices.values():
            if device.node_name == path.name and isinstance(device.cable, MemoryPort):
                return device.cable
        return SerialPort(path, baud, dtr=dtr, rts=rts, low_latency=low_latency, framing=framing)

    async def _run(self, arguments: Sequence[str]) -> tuple[int, str]:
        """Run the only existing program: ``uhubctl``, which switches one port."""
        self.commands.append(arguments)
        if list(arguments[:1]) != ["uhubctl"] or "uhubctl" in self.refused:
            raise FileNotFoundError(errno.ENOENT, "No such file or directory", arguments[0])
        options = dict(zip(arguments[1::2], arguments[2::2], strict=True))
        for device in self._devices.values():
            hub = parent_of(device.name) or ""
            if (hub.removeprefix("usb"), str(port_of(device.name))) == (options["-l"], options["-p"]):
                self._switch(device, on=options["-a"] == "on")
                return 0, ""
        return 1, "No compatible devices detected!"


class _EmulatedSysfs(Sysfs):
    """Sysfs whose attributes take effect when written."""

    def __init__(self, root: Path, usb: EmulatedUsb) -> None:
        super().__init__(root)
        self._usb = usb

    def write(self, path: str, text: str) -> None:
        if not (self.root / path).exists():
            raise FileNotFoundError(errno.ENOENT, "No such file or directory", path)
        self._usb.written(path, text)
        if (self.root / path).exists():  # unless the device vanished by the write
            (self.root / path).write_text(f"{text}\n")


def _interface_prefix(name: str) -> str:
    return f"{name[3:]}-0" if name.startswith("usb") else name
