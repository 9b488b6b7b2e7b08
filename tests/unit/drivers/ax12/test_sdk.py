"""The maker's own library against the emulated bus, and our driver next to it, over a pty on the wall clock."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import TypeVar

import dynamixel_sdk as sdk
import pytest

from monstertruck_drivers.ax12 import protocol as p
from monstertruck_drivers.ax12.config import Ax12Config
from monstertruck_drivers.ax12.driver import Ax12Driver
from monstertruck_drivers.ax12.emulator import Ax12Bus
from monstertruck_drivers.cable import PtyPort
from monstertruck_drivers.tty import SerialPort
from monstertruck_runtime.clock import WallClock
from monstertruck_runtime.mailbox import Mailbox, latest
from monstertruck_schemas.plan import StabiliserCommand
from monstertruck_schemas.sensor import TorqueState
from tests.unit.drivers.kit import Events, Kept, background

T = TypeVar("T")

ATTEMPTS = 10
"""Tries of an exchange that the library gives only 34 ms."""


@contextlib.asynccontextmanager
async def served(tmp_path: Path, **options) -> AsyncIterator[tuple[Ax12Bus, Path]]:
    """A bus behind a pty."""
    path = tmp_path / "dynamixel"
    bus = Ax12Bus(WallClock(), **options)
    port = PtyPort(path)
    async with background(bus.run(port.device)):
        port.plug()
        try:
            yield bus, path
        finally:
            port.unplug()


class Library:
    """Blocking calls of the library; every one retried while it reports a time-out or a damaged answer."""

    def __init__(self, path: Path) -> None:
        self.port = sdk.PortHandler(str(path))
        self.packet = sdk.PacketHandler(1.0)
        assert self.port.openPort()
        assert self.port.setBaudRate(1_000_000)

    def close(self) -> None:
        self.port.closePort()

    def repeated(self, call: Callable[[], tuple[T, int, int]]) -> tuple[T, int]:
        result = sdk.COMM_RX_TIMEOUT
        for _ in range(ATTEMPTS):
            try:
                value, result, error = call()
            except IndexError:  # the library indexes an answer that it has cut off at its time-out
                continue
            if result == sdk.COMM_SUCCESS:
                return value, error
        raise AssertionError(self.packet.getTxRxResult(result))

    def ping(self, unit: int) -> tuple[int, int]:
        return self.repeated(lambda: self.packet.ping(self.port, unit))

    def read(self, unit: int, register: p.Register) -> tuple[int, int]:
        call = self.packet.read1ByteTxRx if register.size == 1 else self.packet.read2ByteTxRx
        return self.repeated(lambda: call(self.port, unit, register.address))

    def write(self, unit: int, register: p.Register, value: int) -> int:
        call = self.packet.write1ByteTxRx if register.size == 1 else self.packet.write2ByteTxRx
        return self.repeated(lambda: (None, *call(self.port, unit, register.address, value)))[1]

    def sync_write(self, register: p.Register, values: dict[int, int]) -> None:
        group = sdk.GroupSyncWrite(self.port, self.packet, register.address, register.size)
        for unit, value in values.items():
            assert group.addParam(unit, list(register.encode(value)))
        assert group.txPacket() == sdk.COMM_SUCCESS


async def in_thread(path: Path, work: Callable[[Library], T]) -> T:
    def run() -> T:
        library = Library(path)
        try:
            return work(library)
        finally:
            library.close()

    return await asyncio.to_thread(run)


async def test_the_library_pings_reads_writes_and_sync_writes(tmp_path: Path):
    def work(library: Library) -> None:
        assert library.ping(1) == (12, 0)
        assert library.ping(2) == (12, 0)
        *_, result, _ = library.packet.ping(library.port, 3)
        assert result == sdk.COMM_RX_TIMEOUT
        assert library.read(1, p.PRESENT_POSITION) == (511, 0)
        assert library.read(2, p.PRESENT_VOLTAGE) == (111, 0)
        assert library.read(2, p.RETURN_DELAY) == (250, 0)
        for unit in (1, 2):
            assert library.write(unit, p.TORQUE_ENABLE, 1) == 0
            assert library.write(unit, p.MOVING_SPEED, 300) == 0
        assert library.read(1, p.MOVING_SPEED) == (300, 0)
        library.sync_write(p.GOAL_POSITION, {1: 531, 2: 184})
        while library.read(1, p.MOVING)[0] or library.read(2, p.MOVING)[0]:
            pass
        assert abs(library.read(1, p.PRESENT_POSITION)[0] - 531) <= 1
        assert abs(library.read(2, p.PRESENT_POSITION)[0] - 184) <= 1
        data, error = library.repeated(lambda: library.packet.readTxRx(library.port, 1, p.PRESENT_POSITION.address, 8))
        assert error == 0
        assert p.Present.decode(bytes(data)).temperature == 25

    async with served(tmp_path, positions={1: 511, 2: 204}) as (bus, path):
        await in_thread(path, work)
        assert [unit.get(p.GOAL_POSITION) for unit in bus.units] == [531, 184]


async def test_the_library_sees_error_bits(tmp_path: Path):
    def refused(library: Library) -> None:
        assert library.write(1, p.LED, 7) == sdk.ERRBIT_RANGE
        assert library.write(1, p.CW_LIMIT, 400) == 0
        assert library.write(1, p.GOAL_POSITION, 300) == sdk.ERRBIT_ANGLE
        assert library.ping(1) == (12, 0)

    def overloaded(library: Library) -> None:
        assert library.read(1, p.TORQUE_LIMIT) == (0, sdk.ERRBIT_OVERLOAD | sdk.ERRBIT_VOLTAGE)
        assert library.write(1, p.TORQUE_LIMIT, 1023) == sdk.ERRBIT_VOLTAGE
        assert library.read(1, p.TORQUE_LIMIT) == (1023, sdk.ERRBIT_VOLTAGE)

    async with served(tmp_path) as (bus, path):
        await in_thread(path, refused)
        bus.inject("trip", "1")
        bus.inject("voltage", "5.0")
        await in_thread(path, overloaded)


async def test_the_driver_over_the_same_pty(tmp_path: Path):
    clock = WallClock()
    async with served(tmp_path, positions={1: 511, 2: 204}) as (bus, path):
        commands: Mailbox[StabiliserCommand] = Mailbox(latest())
        out, events = Kept(), Events()
        ready = asyncio.Event()
        driver = Ax12Driver(Ax12Config(), SerialPort(path, p.AX12_BAUD), clock, commands, out, events)
        async with background(driver.run(ready.set)):
            await asyncio.wait_for(ready.wait(), 5)
            seq, goals = 0, pytest.approx((0.1, -0.1), abs=p.STEP)
            async with asyncio.timeout(20):
                while not out.kept or (out.kept[-1].pitch, out.kept[-1].roll) != goals:
                    now = clock.now()
                    commands.put(StabiliserCommand(stamp=now, received=now, seq=seq, pitch=0.1, roll=-0.1))
                    seq += 1
                    await asyncio.sleep(0.02)
            assert out.kept[-1].pitch_joint.torque is TorqueState.HOLDING
        assert bus.angle(1, clock.now()) / p.STEP == pytest.approx(511 + 0.1 / p.STEP, abs=1.5)
