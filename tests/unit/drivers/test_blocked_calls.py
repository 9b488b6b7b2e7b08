"""Files and cameras of a device that hangs: neither the event loop, nor other devices, nor the end of a driver wait."""

import asyncio
import threading
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from monstertruck_drivers.computer import Machine, NoWatcher, Sysfs
from monstertruck_drivers.link import Link
from monstertruck_drivers.usb.config import CycleMethod, PowerConfig, UsbConfig
from monstertruck_drivers.usb.hub import HubCoordinator, UsbService
from monstertruck_drivers.usb.port import HubNode, HubPort, PortPower
from monstertruck_drivers.usb.tree import port_directory
from monstertruck_runtime.clock import WallClock
from monstertruckd.assembly.devices import Cabling
from monstertruckd.bus.local import Bus
from tests.unit.drivers.test_tty import LOOP_LIMIT, Watch
from tests.unit.drivers.usb.rig import PORTS, Events, Kept, emulated_truck

HELD = ("1-1.3", "1-1-port3", "ttyUSB0")
"""Place, port and node of the device that hangs."""
MANY = 40
"""Look-ups at once: more than the threads of any pool."""


class HungSysfs(Sysfs):
    """Attributes of one device wait until the kernel lets go of it."""

    def __init__(self, root: Path) -> None:
        super().__init__(root)
        self.lets_go = threading.Event()
        self.only_writes = False
        self.waited: list[str] = []

    def _wait(self, path: str) -> None:
        if any(part in path for part in HELD):
            self.waited.append(threading.current_thread().name)
            assert self.lets_go.wait(20)

    def text(self, path: str) -> str | None:
        if not self.only_writes:
            self._wait(path)
        return super().text(path)

    def write(self, path: str, text: str) -> None:
        self._wait(path)
        super().write(path, text)


@pytest.fixture
def machine(tmp_path: Path) -> Iterator[Machine]:
    usb, _ = emulated_truck(tmp_path)
    sysfs = HungSysfs(usb.sysfs.root)
    yield Machine(WallClock(), sysfs, usb.dev)
    sysfs.lets_go.set()


async def ended_soon(task: asyncio.Task[Any]) -> None:
    """Cancelled, a driver ends although its look-up goes on."""
    task.cancel()
    done, _ = await asyncio.wait([task], timeout=LOOP_LIMIT)
    assert done == {task}


def opened(machine: Machine) -> Awaitable[Link]:
    return HubPort(PORTS["drive"], machine, Events(), role="drive").open()


def usb_service(machine: Machine) -> Awaitable[None]:
    hubs = HubCoordinator(UsbConfig(), PORTS, machine.clock, Events())
    service = UsbService(UsbConfig(), machine, hubs, NoWatcher(), Kept(), Events())
    return service.run(lambda: None)


def switched_off(machine: Machine) -> Awaitable[None]:
    return PortPower(PowerConfig(method=CycleMethod.PORT), machine, Events()).switch_off("1-1.3")


@pytest.mark.parametrize("act", [opened, usb_service, switched_off], ids=["port", "tree", "power"])
async def test_a_device_whose_files_wait_stops_nothing(machine: Machine, act: Callable[[Machine], Awaitable[Any]]):
    sysfs = machine.sysfs
    assert isinstance(sysfs, HungSysfs)
    async with Watch() as loop:
        waiting = []
        for _ in range(MANY):
            waiting.append(asyncio.ensure_future(act(machine)))
            await asyncio.sleep(0.002)
        async with asyncio.timeout(5):
            while len(sysfs.waited) < MANY:
                await asyncio.sleep(0.01)
        assert threading.main_thread().name not in sysfs.waited
        async with asyncio.timeout(1):
            assert (await HubNode(PORTS["compass"], machine).resolve()).name == "ttyUSB2"
        for task in waiting:
            await ended_soon(task)
    assert loop.longest < LOOP_LIMIT


async def test_a_port_whose_power_is_being_taken_when_the_cycle_is_cancelled_gets_it_back(machine: Machine):
    sysfs = machine.sysfs
    assert isinstance(sysfs, HungSysfs)
    sysfs.only_writes = True
    cycling = asyncio.create_task(PortPower(PowerConfig(method=CycleMethod.PORT), machine, Events()).cycle("1-1.3"))
    async with asyncio.timeout(5):
        while not sysfs.waited:
            await asyncio.sleep(0.01)
    cycling.cancel()
    await asyncio.sleep(0.05)
    sysfs.lets_go.set()
    await asyncio.wait([cycling], timeout=5)
    assert cycling.cancelled()
    assert sysfs.text(f"{port_directory('1-1.3')}/disable") == "0"


async def test_a_port_that_waits_for_its_device_keeps_no_other_from_being_switched(machine: Machine):
    sysfs = machine.sysfs
    assert isinstance(sysfs, HungSysfs)
    sysfs.only_writes = True
    power = PortPower(PowerConfig(method=CycleMethod.PORT), machine, Events())
    waiting = asyncio.create_task(power.switch_off("1-1.3"))
    async with asyncio.timeout(5):
        while not sysfs.waited:
            await asyncio.sleep(0.01)
    async with asyncio.timeout(1):
        await power.switch_off("1-1.2")
    assert sysfs.text(f"{port_directory('1-1.2')}/disable") == "1"
    await ended_soon(waiting)


async def test_a_port_that_waits_for_its_device_keeps_no_other_from_being_cut(machine: Machine):
    sysfs = machine.sysfs
    assert isinstance(sysfs, HungSysfs)
    sysfs.only_writes = True
    config: Any = SimpleNamespace(
        devices=SimpleNamespace(present=lambda: {role: SimpleNamespace(port=port) for role, port in PORTS.items()}),
        usb=UsbConfig(power=PowerConfig(method=CycleMethod.PORT, cut=("drive", "compass"))),
    )
    computer: Any = SimpleNamespace(machine=machine, watch=NoWatcher)
    cutting = asyncio.create_task(Cabling(config, computer, Bus(machine.clock), {}).cut())
    compass = f"{port_directory(PORTS['compass'].device)}/disable"
    async with asyncio.timeout(2):
        while sysfs.text(compass) != "1":
            await asyncio.sleep(0.01)
    assert sysfs.waited
    await ended_soon(cutting)
