"""Bench for the USB tree: an emulated machine with two hubs, the watching service, ports by role."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from pathlib import Path
from typing import Any

from monstertruck_drivers.cable import MemoryPort
from monstertruck_drivers.usb.config import UsbConfig, UsbPortConfig
from monstertruck_drivers.usb.emulated import EmulatedUsb
from monstertruck_drivers.usb.hub import HubCoordinator, UsbService
from monstertruck_drivers.usb.port import HubPort, PortPower
from monstertruck_runtime.clock import SECOND, Clock, VirtualClock, run_virtual
from monstertruck_runtime.errors import DeviceError
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.usb import UsbNode, UsbState, UsbTree

PORTS = {
    "lidar": UsbPortConfig(hub="1-1", port=1, usb_id="15d1:0000"),
    "steering": UsbPortConfig(hub="1-1", port=2),
    "drive": UsbPortConfig(hub="1-1", port=3, baud=38400),
    "stabiliser": UsbPortConfig(hub="1-1", port=4, baud=1_000_000),
    "compass": UsbPortConfig(hub="1-2", port=1, baud=19200),
}


CONTROLLER = "0000:00:14.0"
"""Controller of bus 1."""
BY_TOPOLOGY = {
    role: port.model_copy(update={"hub": f"pci-{CONTROLLER}-usb-0:{port.hub[2:]}"}) for role, port in PORTS.items()
}


def emulated_truck(folder: Path, *controllers: str) -> tuple[EmulatedUsb, dict[str, MemoryPort]]:
    """Two hubs; the first carries four of five serial devices, the second the compass and a camera.

    Args:
        folder: of the machine.
        controllers: of the buses, from 1 on.
    """
    usb = EmulatedUsb(folder)
    usb.controllers |= dict(enumerate(controllers, 1))
    cables = {role: MemoryPort(role) for role in PORTS}
    usb.add_hub("1-1")
    usb.add_hub("1-2")
    usb.add_device("1-1.1", "15d1:0000", "URG-Series USB Driver", node="ttyACM", cable=cables["lidar"])
    usb.add_device("1-1.2", "1ffb:0089", "Pololu Micro Maestro", node="ttyACM", serial="77", cable=cables["steering"])
    usb.add_device("1-1.3", "0403:6001", "FT232R USB UART", node="ttyUSB", serial="A1", cable=cables["drive"])
    usb.add_device("1-1.4", "0403:6001", "USB2Dynamixel", node="ttyUSB", serial="A2", cable=cables["stabiliser"])
    usb.add_device("1-2.1", "10c4:ea60", "CP2102", node="ttyUSB", cable=cables["compass"])
    usb.add_device("1-2.2", "046d:080a", "C905", node="video")
    return usb, cables


class Kept:
    """Publisher that keeps everything."""

    def __init__(self) -> None:
        self.kept: list[UsbTree] = []

    def next_seq(self) -> int:
        return len(self.kept)

    def put(self, message: UsbTree) -> None:
        self.kept.append(message)


class Events:
    """Event sink that keeps everything."""

    def __init__(self) -> None:
        self.kept: list[tuple[Reason, Severity, str, str, dict[str, Any]]] = []

    def __call__(self, reason: Reason, severity: Severity, source: str, text: str = "", **values: Any) -> None:
        self.kept.append((reason, severity, source, text, values))

    def of(self, reason: Reason) -> list[tuple[Severity, str, str, dict[str, Any]]]:
        return [tuple(rest) for why, *rest in self.kept if why is reason]

    @property
    def reasons(self) -> list[Reason]:
        return [row[0] for row in self.kept]


class Bench:
    """Everything of one machine; the service runs inside ``watching``."""

    def __init__(
        self, folder: Path, clock: Clock, config: UsbConfig | None = None, places: Mapping[str, UsbPortConfig] = PORTS
    ) -> None:
        self.clock = clock
        self.usb, self.cables = emulated_truck(folder, *[CONTROLLER] * (places is BY_TOPOLOGY))
        self.config = config or UsbConfig()
        self.places = places
        self.machine = self.usb.machine(clock)
        self.events = Events()
        self.out = Kept()
        self.hubs = HubCoordinator(self.config, places, clock, self.events)
        self.power = PortPower(self.config.power, self.machine, self.events)
        self.service = UsbService(self.config, self.machine, self.hubs, self.usb.watcher, self.out, self.events)
        self.ports = {role: self.port(role) for role in PORTS}

    def port(self, role: str, **changes: Any) -> HubPort:
        place = self.places[role].model_copy(update=changes)
        return HubPort(place, self.machine, self.events, self.hubs, self.power, role)

    @contextlib.asynccontextmanager
    async def watching(self) -> AsyncIterator[None]:
        is_ready = asyncio.Event()
        task = asyncio.create_task(self.service.run(is_ready.set))
        try:
            await is_ready.wait()
            yield
        finally:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task

    @contextlib.asynccontextmanager
    async def drivers(self, *roles: str) -> AsyncIterator[dict[str, list[float]]]:
        """Stand-ins for supervised drivers: hold the port open, retry every 100 ms; yields when each started."""
        starts: dict[str, list[float]] = {role: [] for role in roles or PORTS}

        async def drive(role: str) -> None:
            while True:
                with contextlib.suppress(DeviceError):
                    async with await self.ports[role].open() as link:
                        starts[role].append(self.clock.now() / SECOND)
                        await link.read()
                await self.clock.sleep(0.1)

        tasks = [asyncio.create_task(drive(role)) for role in starts]
        try:
            await self.clock.sleep(0.1)
            yield starts
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    def node(self, name: str) -> UsbNode:
        """Newest published row of one place."""
        return next(node for node in self.out.kept[-1].nodes if node.name == name)

    def states(self) -> dict[str, UsbState]:
        return {node.name: node.state for node in self.out.kept[-1].nodes}


def play(
    folder: Path,
    scene: Callable[[Bench], Awaitable[None]],
    config: UsbConfig | None = None,
    places: Mapping[str, UsbPortConfig] = PORTS,
    *,
    watched: bool = True,
) -> Bench:
    """Run ``scene`` on a virtual clock, with the service running unless stated otherwise."""

    async def main(clock: VirtualClock) -> Bench:
        bench = Bench(folder, clock, config, places)
        if watched:
            async with bench.watching():
                await scene(bench)
        else:
            await scene(bench)
        return bench

    return run_virtual(main)
