"""Ports of devices, as configured."""

import asyncio
import contextlib
import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from monstertruck_drivers.cable import MemoryPort, SocketPort
from monstertruck_drivers.config import CommandPortConfig, PortConfig, TcpPortConfig
from monstertruck_drivers.link import Framing, Port
from monstertruck_drivers.usb.config import UsbConfig, UsbPortConfig
from monstertruck_runtime.clock import VirtualClock, WallClock, run_virtual
from monstertruckd.assembly import devices
from monstertruckd.assembly.devices import Cabling
from monstertruckd.bus.local import Bus
from tests.unit.drivers.usb.rig import emulated_truck


@pytest.mark.parametrize(
    "place", [{"path": Path("/dev/ttyUSB0")}, {"hub": "1-1", "port": 1}], ids=["by path", "by hub and port"]
)
@pytest.mark.parametrize(
    ("dtr", "rts", "framing"), [(False, True, None), (True, False, "8E2")], ids=["DTR low", "RTS low, 8E2"]
)
def test_the_control_lines_of_a_port_are_those_of_its_settings(
    place: dict[str, Any],
    dtr: bool,
    rts: bool,
    framing: Framing | None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
):
    """An RPLIDAR's motor stops while DTR is raised; SBUS has a parity bit."""
    made: list[tuple[bool, bool, Framing]] = []

    def serial(
        path: Path,
        baud: int,
        *,
        dtr: bool = True,
        rts: bool = True,
        low_latency: bool = False,
        framing: Framing = "8N1",
    ) -> Port:
        made.append((dtr, rts, framing))
        cable = MemoryPort(str(path))
        cable.plug()
        return cable

    monkeypatch.setattr(devices, "SerialPort", serial)
    kind = UsbPortConfig if "hub" in place else PortConfig
    lidar = SimpleNamespace(port=kind(**place, dtr=dtr, rts=rts, framing=framing))
    config: Any = SimpleNamespace(devices=SimpleNamespace(present=lambda: {"lidar": lidar}), usb=UsbConfig())

    async def opened(clock: VirtualClock) -> None:
        usb, _ = emulated_truck(tmp_path)
        machine = dataclasses.replace(usb.machine(clock), serial=serial)
        computer: Any = SimpleNamespace(machine=machine, watch=lambda: usb.watcher)
        (await Cabling(config, computer, Bus(clock), {}).port("lidar").open()).close()

    run_virtual(opened)
    assert made == [(dtr, rts, framing or "8N1")]


async def test_a_sensor_on_the_network_is_reached_by_its_address():
    with contextlib.closing(SocketPort("127.0.0.1", 0)) as cable:
        cable.plug()
        lidar = SimpleNamespace(port=TcpPortConfig(address=cable.address[0], tcp=cable.address[1]))
        config: Any = SimpleNamespace(devices=SimpleNamespace(present=lambda: {"lidar": lidar}), usb=UsbConfig())
        computer: Any = SimpleNamespace(machine=SimpleNamespace(clock=WallClock()))
        async with await Cabling(config, computer, Bus(WallClock()), {}).port("lidar").open() as link:
            cable.device.write(b"there")
            await asyncio.sleep(0.05)
            cable.device.write(b"there")
            assert (await link.read(2.0)).startswith(b"there")


def test_a_bus_is_opened_by_its_path_or_given():
    steering = SimpleNamespace(port=PortConfig(path=Path("/dev/i2c-1")))
    config: Any = SimpleNamespace(devices=SimpleNamespace(present=lambda: {"steering": steering}), usb=UsbConfig())

    async def main(clock: VirtualClock) -> None:
        computer: Any = SimpleNamespace(machine=SimpleNamespace(clock=clock))
        bus, cable = Bus(clock), MemoryPort("given")
        assert Cabling(config, computer, bus, {}).bus("steering").name == "/dev/i2c-1"
        assert Cabling(config, computer, bus, {"steering": cable}).bus("steering") is cable

    run_virtual(main)


def test_a_program_is_a_port():
    camera = SimpleNamespace(port=CommandPortConfig(command=("/usr/bin/rpicam-vid", "-o", "-")))
    config: Any = SimpleNamespace(devices=SimpleNamespace(present=lambda: {"camera": camera}), usb=UsbConfig())

    async def main(clock: VirtualClock) -> None:
        computer: Any = SimpleNamespace(machine=SimpleNamespace(clock=clock))
        assert Cabling(config, computer, Bus(clock), {}).port("camera").name == "rpicam-vid"

    run_virtual(main)
