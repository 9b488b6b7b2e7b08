"""A port opens what hangs at its hub and number, under whatever name, and nothing else."""

import asyncio
from pathlib import Path
from unittest.mock import patch

import pytest

from monstertruck_drivers.cable import MemoryPort, PtyPort
from monstertruck_drivers.usb.config import CycleMethod, PowerConfig, UsbConfig, UsbPortConfig
from monstertruck_drivers.usb.emulated import EmulatedUsb
from monstertruck_drivers.usb.port import OPEN_TIMEOUT, HubNode, HubPort
from monstertruck_runtime.clock import SECOND, VirtualClock, WallClock, run_virtual
from monstertruck_runtime.errors import DeviceLostError, PortBusyError, WrongDeviceError
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from tests.unit.drivers.usb.rig import PORTS, Bench, Events, play


def test_bytes_reach_the_device_at_that_port(tmp_path: Path):
    async def scene(bench: Bench) -> None:
        async with await bench.ports["drive"].open() as link:
            link.write(b"\x10")
            assert await bench.cables["drive"].device.read() == b"\x10"
            bench.cables["drive"].device.write(b"O")
            assert await link.read() == b"O"

    play(tmp_path, scene)


def test_the_node_may_come_back_under_another_name(tmp_path: Path):
    async def scene(bench: Bench) -> None:
        link = await bench.ports["drive"].open()
        assert bench.node("1-1.3").tty == "ttyUSB0"
        bench.usb.unplug("1-1.3")
        assert link.is_lost
        bench.usb.busy_numbers = {0}
        bench.usb.plug("1-1.3")
        await bench.clock.sleep(1)
        assert bench.node("1-1.3").tty == "ttyUSB3"
        async with await bench.ports["drive"].open() as link:
            link.write(b"x")
            assert await bench.cables["drive"].device.read() == b"x"

    play(tmp_path, scene)


def test_two_devices_that_swap_their_names_are_not_confused(tmp_path: Path):
    async def scene(bench: Bench) -> None:
        bench.usb.unplug("1-1.3")
        bench.usb.unplug("1-1.4")
        await bench.clock.sleep(1)
        bench.usb.plug("1-1.4")
        bench.usb.plug("1-1.3")
        await bench.clock.sleep(1)
        assert (bench.node("1-1.4").tty, bench.node("1-1.3").tty) == ("ttyUSB0", "ttyUSB1")
        for role in ("drive", "stabiliser"):
            async with await bench.ports[role].open() as link:
                link.write(role.encode())
                assert await bench.cables[role].device.read() == role.encode()

    play(tmp_path, scene)


def test_it_never_falls_back_to_another_port(tmp_path: Path):
    async def scene(bench: Bench) -> None:
        bench.usb.unplug("1-1.1")
        twin = MemoryPort("twin")
        bench.usb.add_device("1-2.3", "15d1:0000", "URG-Series USB Driver", node="ttyACM", cable=twin)
        bench.usb.add_device("1-2.4", "15d1:0000", "URG-Series USB Driver", node="ttyACM")
        await bench.clock.sleep(1)
        with pytest.raises(DeviceLostError, match="hub 1-1 port 1: not plugged in"):
            await bench.ports["lidar"].open()
        bench.usb.plug("1-1.1")
        async with await bench.ports["lidar"].open() as link:
            link.write(b"V")
            assert await bench.cables["lidar"].device.read() == b"V"
        (await twin.open()).close()  # nobody had it open

    bench = play(tmp_path, scene)
    assert bench.events.of(Reason.PORT_MOVED), "reported, not used"


def test_another_kind_of_device_is_refused_before_the_first_byte(tmp_path: Path):
    async def scene(bench: Bench) -> None:
        bench.usb.unplug("1-1.1")
        intruder = MemoryPort("intruder")
        bench.usb.add_device("1-1.1", "0403:6001", "FT232R", node="ttyACM", cable=intruder)
        with pytest.raises(WrongDeviceError, match="expected USB device 15d1:0000, found 0403:6001 FT232R"):
            await bench.ports["lidar"].open()

    play(tmp_path, scene)


def test_a_device_without_the_node_is_no_port(tmp_path: Path):
    async def scene(bench: Bench) -> None:
        with pytest.raises(DeviceLostError, match="no tty at interface 2"):
            await bench.port("steering", interface=2).open()
        node = await HubNode(UsbPortConfig(hub="1-2", port=2), bench.machine, kind="video4linux").resolve()
        assert node.name == "video0"

    play(tmp_path, scene)


def test_a_fresh_node_may_refuse_for_a_while(tmp_path: Path):
    async def scene(bench: Bench) -> None:
        bench.cables["drive"].unplug()
        start = bench.clock.now()
        opening = asyncio.create_task(bench.ports["drive"].open())
        await bench.clock.sleep(1.0)
        assert not opening.done()
        bench.cables["drive"].plug()
        (await opening).close()
        assert bench.clock.now() - start < 1.2 * SECOND

        bench.cables["drive"].unplug()
        with pytest.raises(DeviceLostError):
            await bench.ports["drive"].open()
        holder = await bench.cables["compass"].open()
        start = bench.clock.now()
        with patch.object(bench.cables["compass"], "open", wraps=bench.cables["compass"].open) as attempts:
            with pytest.raises(PortBusyError):
                await bench.ports["compass"].open()
            assert attempts.call_count == 5, "each looks through the processes of the computer for the holder"
        assert (bench.clock.now() - start) / SECOND == pytest.approx(OPEN_TIMEOUT, abs=0.2)
        holder.close()

    play(tmp_path, scene)


def test_an_adapters_latency_is_lowered_at_every_open(tmp_path: Path):
    async def scene(bench: Bench) -> None:
        for _ in range(2):
            assert bench.node("1-1.3").latency_ms == 16, "every replug forgets it"
            (await bench.ports["drive"].open()).close()
            await bench.clock.sleep(6)
            assert bench.node("1-1.3").latency_ms == 1
            bench.usb.unplug("1-1.3")
            bench.usb.plug("1-1.3")
            await bench.clock.sleep(6)

    assert play(tmp_path, scene).events.kept == []


def test_a_latency_that_cannot_be_lowered_is_reported_once(tmp_path: Path):
    async def scene(bench: Bench) -> None:
        bench.usb.refused.add("latency_timer")
        for _ in range(3):
            (await bench.ports["drive"].open()).close()
        (await bench.ports["lidar"].open()).close()

    bench = play(tmp_path, scene)
    [(severity, source, text, values)] = bench.events.of(Reason.SLOW_LINK)
    assert (severity, source) == (Severity.WARNING, "drive")
    assert "stays at 16 ms" in text
    assert "udev rule" in text
    assert values == {"latency_ms": 16}


def test_short_sessions_in_a_row_cycle_the_port(tmp_path: Path):
    config = UsbConfig(power=PowerConfig(method=CycleMethod.PORT, after=3))

    async def scene(bench: Bench) -> None:
        for _ in range(3):
            (await bench.ports["drive"].open()).close()
            await bench.clock.sleep(1)
        assert bench.events.kept == []
        async with await bench.ports["drive"].open():
            await bench.clock.sleep(11)
        (await bench.ports["drive"].open()).close()

    bench = play(tmp_path, scene, config)
    assert bench.events.reasons == [Reason.PORT_CYCLED]
    assert bench.node("1-1.3").replugs == 1


def test_long_sessions_never_cycle_the_port(tmp_path: Path):
    config = UsbConfig(power=PowerConfig(method=CycleMethod.PORT, after=1))

    async def scene(bench: Bench) -> None:
        for _ in range(4):
            async with await bench.ports["drive"].open():
                await bench.clock.sleep(11)

    assert play(tmp_path, scene, config).events.kept == []


def test_a_port_that_cannot_be_cycled_is_opened_all_the_same(tmp_path: Path):
    config = UsbConfig(power=PowerConfig(method=CycleMethod.PORT, after=1))

    async def scene(bench: Bench) -> None:
        bench.usb.refused.add("disable")
        for _ in range(3):
            (await bench.ports["drive"].open()).close()
            await bench.clock.sleep(0.1)

    bench = play(tmp_path, scene, config)
    assert bench.events.reasons == [Reason.DEVICE_FAULT], "the next try would be too soon"
    assert bench.node("1-1.3").replugs == 0


async def test_on_the_wall_clock_over_ptys(tmp_path: Path):
    usb, cable = EmulatedUsb(tmp_path), PtyPort(tmp_path / "cable")
    usb.add_hub("1-1")
    usb.add_device("1-1.3", "0403:6001", node="ttyUSB", cable=cable)
    port = HubPort(PORTS["drive"], usb.machine(WallClock()), Events())
    assert port.name == "hub 1-1 port 3"
    async with await port.open() as link:
        assert (tmp_path / "dev/ttyUSB0").readlink() == tmp_path / "cable"
        cable.device.write(b"ready")
        assert await link.exactly(5) == b"ready"
        usb.unplug("1-1.3")
        with pytest.raises(DeviceLostError):
            await link.read()
    with pytest.raises(DeviceLostError, match="not plugged in"):
        await port.open()
    usb.plug("1-1.3", number=7)
    async with await port.open() as link:
        link.write(b"again")
        assert await cable.device.read() == b"again"
    usb.unplug("1-1.3")


@pytest.mark.parametrize(("usb_id", "brltty"), [("0403:6001", True), ("067b:2303", False)])
def test_an_adapter_that_a_program_holds_through_usbfs_is_said_to_be(tmp_path: Path, usb_id: str, brltty: bool):
    """As brltty does on Ubuntu 22.04; it was said to have no tty, and to need a module."""
    usb = EmulatedUsb(tmp_path)
    usb.add_hub("1-1")
    usb.add_device("1-1.4", usb_id, "USB Serial", node="ttyUSB")
    usb.claim("1-1.4")

    async def main(clock: VirtualClock) -> None:
        port = HubPort(UsbPortConfig(hub="1-1", port=4), usb.machine(clock), Events())
        with pytest.raises(DeviceLostError, match="a program holds interface 0 through usbfs") as refused:
            await port.open()
        assert ("brltty" in str(refused.value)) is brltty

    run_virtual(main)
