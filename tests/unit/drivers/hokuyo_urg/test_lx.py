"""UST and UTM: driver against the emulator on a bench and over TCP, and a client that is not ours, hokuyolx."""

import asyncio
import contextlib
import socket
from collections.abc import AsyncIterator
from itertools import islice
from math import pi
from typing import Any, TypeVar

import hokuyolx
import numpy as np
import pytest
from hokuyolx.exceptions import HokuyoStatusException

from monstertruck_drivers.cable import SocketPort
from monstertruck_drivers.catalog import DEVICES
from monstertruck_drivers.hokuyo_urg.config import HokuyoConfig, HokuyoLxConfig
from monstertruck_drivers.hokuyo_urg.driver import HokuyoDriver
from monstertruck_drivers.hokuyo_urg.emulator import HokuyoEmulator
from monstertruck_drivers.hokuyo_urg.lx_emulator import LxEmulator
from monstertruck_drivers.hokuyo_urg.models import LX
from monstertruck_drivers.hokuyo_urg.protocol import UNRETURNED, split_lx_ranges
from monstertruck_drivers.tcp import CONNECT_TIMEOUT, TcpPort, parse_address
from monstertruck_runtime.clock import SECOND, VirtualClock, WallClock, run_virtual
from monstertruck_runtime.errors import BusyError, DeviceError, DeviceLostError, DeviceTimeoutError, WrongDeviceError
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import NO_ECHO, VALID_BEAM, LaserScan
from tests.unit.drivers.hokuyo_urg.rig import Pattern
from tests.unit.drivers.kit import DriverRig, Kept
from tests.unit.drivers.scanning.kit import Room

T = TypeVar("T")
FIELD = 270 * pi / 180


class LxRig(DriverRig):
    """A scanner in a room, and its driver."""

    def __init__(self, clock: Any, port: Any = None, config: HokuyoLxConfig | None = None, room: Room | None = None):
        super().__init__(clock, port)
        self.room = room or Room()
        self.config = config or HokuyoLxConfig()
        self.emulator = LxEmulator(clock, self.room, LX[self.config.model])
        self.out: Kept[LaserScan] = Kept()
        self.driver = HokuyoDriver(self.config, self.port, clock, self.out, self.events)


def on_bench(test: Any, config: HokuyoLxConfig | None = None, room: Room | None = None) -> None:
    async def main(clock: VirtualClock) -> None:
        rig = LxRig(clock, None, config, room)
        async with rig.plugged_in(rig.emulator.run(rig.port.device)):
            await test(rig)

    run_virtual(main)


@pytest.mark.parametrize(("model", "rate"), [("ust_10lx", 0.0), ("ust_20lx", 1.0), ("utm_30lx", -1.0)])
def test_scans_of_a_turning_robot_show_the_room(model: Any, rate: float):
    async def test(rig: LxRig) -> None:
        async with rig.driving():
            await rig.out.count(80)
        for scan in rig.out.kept:
            assert len(scan.ranges) == 1081
            assert (scan.start_angle, scan.end_angle) == pytest.approx((-FIELD / 2, FIELD / 2))
            assert scan.scan_time == 0.025
            assert scan.range_noise == {"utm_30lx": 0.015}.get(model, 0.02)
            assert (scan.codes == VALID_BEAM).all()
            assert rig.room.off(scan).max() < 0.01, "every beam by its own instant"
            assert 0.018 < (scan.received - scan.stamp) / SECOND < 0.03
        stamps = np.diff([scan.stamp for scan in rig.out.kept]) / SECOND
        assert stamps == pytest.approx(0.025, abs=0.0015), "its counter has milliseconds"
        assert rig.events.reasons() == [Reason.DEVICE_READY]

    on_bench(test, HokuyoLxConfig(model=model), Room(rate=rate))


@pytest.mark.parametrize(
    ("attribute", "value", "least"),
    [("flip_rate", 1e-5, 100), ("drop_rate", 1e-5, 100), ("lose_rate", 0.1, 100), ("chunk", 1, 190)],
)
def test_bytes_lost_flipped_or_one_at_a_time(attribute: str, value: float, least: int):
    async def test(rig: LxRig) -> None:
        async with rig.driving():
            await rig.out.count(1)
            setattr(rig.port.device.faults, attribute, value)
            await rig.clock.sleep(5.0)
        assert least < len(rig.out.kept) <= 201
        assert all(rig.room.off(scan).max() < 0.01 for scan in rig.out.kept)

    on_bench(test)


def test_a_stall_ends_the_session_within_half_a_second_and_the_next_one_takes_the_stream_over():
    async def test(rig: LxRig) -> None:
        async with rig.clock.deadline(10.0):
            rig.port.device.faults.stalled = False
            running = asyncio.create_task(rig.session())
            await rig.out.count(5)
            rig.port.device.faults.stalled = True
            since = rig.clock.now()
            with pytest.raises(DeviceTimeoutError):
                await running
            assert 0.4 < (rig.clock.now() - since) / SECOND < 1.0
            rig.port.device.faults.stalled = False
        async with rig.driving():
            await rig.out.count(5)

    on_bench(test)


def test_revolutions_without_data_while_it_is_unstable_are_left_out():
    async def test(rig: LxRig) -> None:
        async with rig.driving():
            await rig.out.count(5)
            rig.emulator.inject("unstable", "3")
            await rig.out.count(5)
        gaps = np.diff([scan.stamp for scan in rig.out.kept]) / SECOND
        assert max(gaps) == pytest.approx(0.1, abs=0.002)

    on_bench(test)


def test_a_scanner_of_the_other_series_is_refused_by_name():
    async def main(clock: VirtualClock) -> None:
        other = LxRig(clock)
        other.driver = HokuyoDriver(HokuyoConfig(), other.port, clock, other.out, other.events)
        async with other.plugged_in(other.emulator.run(other.port.device)):
            with pytest.raises(WrongDeviceError, match="expected a URG scanner, found 'UST-10LX"):
                await other.session()
        urg = LxRig(clock)
        emulator = HokuyoEmulator(clock, Pattern())
        async with urg.plugged_in(emulator.run(urg.port.device)):
            with pytest.raises(WrongDeviceError, match="expected a UST or UTM scanner, found 'SOKUIKI Sensor URG-04LX"):
                await urg.session()

    run_virtual(main)


@pytest.mark.parametrize(("free", "unreturned"), [(False, NO_ECHO + 1), (True, NO_ECHO)])
def test_values_outside_the_range_are_errors(free: bool, unreturned: int):
    values = np.array([0, 1, 2, 5, 19, 20, 30000, 30001, UNRETURNED], np.int32)
    ranges, codes = split_lx_ranges(values, 20, 30000, free=free)
    lost = NO_ECHO + 1
    assert codes.tolist() == [lost, unreturned, lost, lost, lost, VALID_BEAM, VALID_BEAM, unreturned, unreturned]
    assert ranges[5:7].tolist() == [0.02, 30.0]
    assert np.isinf(np.delete(ranges, (5, 6))).all()


@pytest.mark.parametrize(("model", "free"), [("ust_10lx", "free"), ("ust_20lx", "unknown"), ("utm_30lx", "free")])
def test_beams_into_the_open(model: Any, free: Any):
    async def test(rig: LxRig) -> None:
        async with rig.driving():
            await rig.out.count(2)
        scan = rig.out.last
        assert np.isinf(scan.ranges).all()
        assert set(scan.codes.tolist()) == {NO_ECHO if free == "free" else NO_ECHO + 1}

    on_bench(test, HokuyoLxConfig(model=model, no_return=free), Room(half=100.0))


def test_it_is_probed():
    async def main(clock: VirtualClock) -> None:
        rig = LxRig(clock)
        async with rig.plugged_in(rig.emulator.run(rig.port.device)):
            said: Any = await DEVICES["hokuyo_lx"].identify(rig.port, clock)
        assert said["dialect"] == "SCIP 2.0"
        assert said["identity"]["product"] == "UST-10LX"
        assert (said["scan"]["beams"], said["scan"]["valid"]) == (1081, 1081)

    run_virtual(main)


# Over TCP


@contextlib.asynccontextmanager
async def served(room: Room | None = None) -> AsyncIterator[tuple[LxRig, SocketPort]]:
    """An emulated scanner on the network, and the driver of it."""
    clock = WallClock()
    with contextlib.closing(SocketPort("127.0.0.1", 0)) as cable:
        rig = LxRig(clock, cable, room=room)
        rig.driver = HokuyoDriver(rig.config, TcpPort(*cable.address), clock, rig.out, rig.events)
        async with rig.plugged_in(rig.emulator.run(cable.device)):
            yield rig, cable


async def test_scans_come_over_the_network():
    async with served(Room(rate=1.0)) as (rig, _):
        async with rig.driving():
            await rig.out.count(40)
        assert len(rig.out.kept[-1].ranges) == 1081
        for scan in rig.out.kept:
            assert rig.room.off(scan).max() < 3.0 * 0.005 + 0.01, "stamps are true to 5 ms at 1 rad/s"


async def test_a_pulled_network_cable_ends_the_session_and_a_new_one_follows():
    async with served() as (rig, cable):
        running = asyncio.create_task(rig.session())
        await rig.out.count(3)
        cable.unplug()
        with pytest.raises(DeviceError):
            await asyncio.wait_for(running, 3.0)
        with pytest.raises(DeviceError):
            await asyncio.wait_for(rig.session(), 5.0)
        cable.plug()
        async with rig.driving():
            await rig.out.count(3)


async def test_a_scanner_that_restarts_resets_the_connection():
    async with served() as (rig, cable):
        running = asyncio.create_task(rig.session())
        await rig.out.count(3)
        cable.unplug()
        rig.emulator.power_cycle()
        cable.plug()
        with pytest.raises(DeviceLostError, match=r"connection lost|closed the connection"):
            await asyncio.wait_for(running, 3.0)


async def test_it_serves_one_client():
    async with served() as (rig, cable), rig.driving():
        await rig.out.count(1)
        with pytest.raises(DeviceError):
            await DEVICES["hokuyo_lx"].identify(TcpPort(*cable.address), WallClock())
        await rig.out.count(5)
        with pytest.raises(BusyError, match="another program serves"):
            SocketPort(*cable.address)


async def test_a_free_address():
    with socket.create_server(("127.0.0.1", 0)) as gone:
        address = gone.getsockname()
    with pytest.raises(DeviceLostError, match="refused, or another program is connected"):
        await TcpPort(*address).open()


async def test_a_network_that_swallows_everything(monkeypatch: pytest.MonkeyPatch):
    async def never(*_: object) -> None:
        await asyncio.Event().wait()

    monkeypatch.setattr(asyncio.get_running_loop(), "create_connection", never)
    monkeypatch.setattr("monstertruck_drivers.tcp.CONNECT_TIMEOUT", 0.05)
    with pytest.raises(DeviceLostError, match=r"192\.0\.2\.1:10940: no answer within 0\.05 s"):
        await TcpPort("192.0.2.1", 10940).open()
    assert CONNECT_TIMEOUT > 1.0


@pytest.mark.parametrize(
    ("text", "address"),
    [("192.168.0.10:10940", ("192.168.0.10", 10940)), ("/dev/ttyUSB0", None), ("host:10940", None), ("1.2.3.4", None)],
)
def test_addresses_in_words(text: str, address: tuple[str, int] | None):
    assert parse_address(text) == address


# A client that is not ours, as it is


async def use(work: Any, room: Any = None, model: Any = "ust_10lx") -> Any:
    """Let a thread work with the foreign client; it takes one ``recv`` for a reply unless it reads byte by byte."""
    clock = WallClock()
    with contextlib.closing(SocketPort("127.0.0.1", 0)) as cable:
        emulator = LxEmulator(clock, room or Room(), LX[model])
        running = asyncio.create_task(emulator.run(cable.device))
        await asyncio.sleep(0)
        cable.plug()

        def run() -> Any:
            with contextlib.closing(hokuyolx.HokuyoLX(addr=cable.address, buf=1, convert_time=False)) as laser:
                return work(laser)

        try:
            return await asyncio.to_thread(run)
        finally:
            running.cancel()
            await asyncio.wait([running])


async def test_a_foreign_client_finds_the_model_and_switches_its_states():
    def work(laser: Any) -> None:
        assert laser.laser_state() == (3, "Single scan state")
        assert (laser.model, laser.dmin, laser.dmax, laser.scan_freq) == ("UST-10LX", 20, 30000, 40)
        assert (laser.ares, laser.amin, laser.amax, laser.aforw) == (1440, 0, 1080, 540)
        assert laser.version()["PROT"] == "SCIP 2.2"
        laser.standby()
        assert laser.laser_state()[0] == 0
        with pytest.raises(HokuyoStatusException):
            laser.get_dist()
        laser.activate()
        laser.partial_reset()
        assert laser.laser_state()[0] == 0
        laser.reset()
        laser.reboot()

    await use(work)


async def test_a_foreign_client_sees_the_room():
    def work(laser: Any) -> tuple[Any, Any, Any, Any]:
        _, single = laser.get_dist()
        _, pairs = laser.get_intens(100, 200)
        streamed = list(islice(laser.iter_dist(), 5))
        laser.standby()
        laser.activate()
        _, filtered = laser.get_filtered_dist()
        laser.standby()
        return single, pairs, streamed, filtered

    room = Room()
    single, pairs, streamed, filtered = await use(work, room)
    steps = np.arange(1081)
    ways = (steps - 540) * 2 * pi / 1440
    true = 1000 * room.half / np.maximum(np.abs(np.cos(ways)), np.abs(np.sin(ways)))
    for scan in (single, *(scan for scan, _, _ in streamed)):
        np.testing.assert_allclose(scan, true, atol=0.51)
    np.testing.assert_allclose(pairs[:, 0], true[100:201], atol=0.51)
    assert (pairs[:, 1] > 0).all()
    np.testing.assert_allclose(filtered[:, 0], ways, atol=1e-9)
    assert [left for _, _, left in streamed] == [0] * 5


async def test_a_foreign_client_synchronises_its_clock():
    def work(laser: Any) -> int:
        laser.time_sync(N=5, dt=0.02)
        laser.activate()
        return int(laser.tzero + laser.get_dist()[0])

    stamp = await use(work)
    real = (WallClock().now() + WallClock().real_offset()) / 1e6
    assert -20 <= real - stamp < 300
