"""Frames of the BNO085 in UART-RVC mode, emulator and driver on the virtual clock, and a foreign client on a pty."""

import asyncio
import contextlib
from math import asin, cos, degrees, radians, sin, tau

import pytest
import serial
from adafruit_bno08x_rvc import BNO08x_RVC

from monstertruck_drivers.bno085.config import Bno085Config
from monstertruck_drivers.bno085.driver import Bno085Driver, body_rates
from monstertruck_drivers.bno085.emulator import Bno085Emulator
from monstertruck_drivers.bno085.protocol import BNO085_BAUD, measured
from monstertruck_drivers.cable import PtyPort
from monstertruck_drivers.catalog import DEVICES
from monstertruck_drivers.emulation import ImuReading
from monstertruck_drivers.inertial import ImuCorrection
from monstertruck_runtime.clock import SECOND, VirtualClock, WallClock, run_virtual
from monstertruck_runtime.errors import (
    DeviceLostError,
    DeviceTimeoutError,
    InputError,
    ProtocolError,
    WrongDeviceError,
)
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import STANDARD_GRAVITY, Attitude, Imu
from tests.unit.drivers.kit import DriverRig, Kept, background

TILT = 0.1
"""Nose down, rad."""
"""Example of the data sheet: index 222, yaw 0.01, pitch -1.10, roll 20.85 degrees; -371, -20 and 977 mg."""


class Turning:
    """A unit that turns left at 0.5 rad/s with its nose down."""

    def imu(self, time_ns):
        return ImuReading((0.0, 0.0, 0.5), (-STANDARD_GRAVITY * sin(TILT), 0.0, STANDARD_GRAVITY * cos(TILT)), 25.0)


class Rig(DriverRig):
    def __init__(self, clock, config=None, *, tilt=True):
        super().__init__(clock, None)
        self.emulator = Bno085Emulator(clock, Turning())
        self.out: Kept[Imu] = Kept()
        self.attitude: Kept[Attitude] = Kept()
        self.driver = Bno085Driver(
            config or Bno085Config(), self.port, clock, self.out, self.attitude if tilt else None, self.events
        )


def on_bench(test, config=None, **options):
    async def main(clock: VirtualClock) -> None:
        rig = Rig(clock, config, **options)
        async with rig.plugged_in(rig.emulator.run(rig.port.device)):
            await test(rig)

    run_virtual(main, start=SECOND)


def test_rates_come_from_the_units_own_clock_over_the_wrap_of_index_and_heading():
    before = measured(254, (radians(179.95), 0.0, 0.0), (0, 0, 9.8))
    after = measured(257, (radians(180.10), 0.0, 0.0), (0, 0, 9.8))
    assert body_rates(before, after) == pytest.approx((0.0, 0.0, radians(0.15) / 0.03))
    assert body_rates(before, before) is None
    assert body_rates(before, after._replace(number=40)) is None


def test_rates_are_those_of_the_body_on_a_slope():
    pitch = asin(0.5)
    before, after = (measured(i, (i * 0.01, pitch, 0.0), (0, 0, 9.8)) for i in (0, 1))
    assert body_rates(before, after) == pytest.approx((-0.5, 0.0, cos(pitch)), abs=0.02)


def test_turn_rate_force_and_tilt():
    async def test(rig):
        async with rig.driving():
            await rig.out.total(100)
            assert rig.ready_at
            rates = [imu.angular_velocity.z for imu in rig.out.kept[20:]]
            assert sum(rates) / len(rates) == pytest.approx(0.5 * cos(TILT), abs=0.01)
            last, attitude = rig.out.last, rig.attitude.last
            assert last.linear_acceleration.x == pytest.approx(-STANDARD_GRAVITY * sin(TILT), abs=0.15)
            assert last.linear_acceleration.z == pytest.approx(STANDARD_GRAVITY * cos(TILT), abs=0.15)
            assert last.frame == "imu"
            assert 0.004 * SECOND < last.received - last.stamp < 0.03 * SECOND
            assert (rig.out.kept[-1].received - rig.out.kept[-51].received) / SECOND == pytest.approx(1.0, abs=0.03)
            assert (attitude.pitch, attitude.roll) == pytest.approx((TILT, 0.0), abs=0.01)
            assert attitude.tilt_valid
            assert attitude.heading_disturbed, "it counts from power-up"
            assert attitude.heading == pytest.approx(-(rig.clock.now() - rig.ready_at[0]) / SECOND * 0.5 % tau, abs=0.1)

    on_bench(test)


def test_biases_are_taken_out_and_a_compass_keeps_its_topic():
    async def test(rig):
        async with rig.driving():
            await rig.out.total(50)
            assert rig.out.last.angular_velocity.z == pytest.approx((0.5 - 0.1) * 2, abs=0.1)
            assert not rig.attitude.kept

    on_bench(test, Bno085Config(correction=ImuCorrection(rate_z=0.1, rate_scale=2.0)), tilt=False)


def test_a_few_damaged_torn_and_missing_frames_do_no_harm():
    async def test(rig):
        async with rig.driving():
            await rig.out.total(20)
            for fault in ("bad_checksum 3", "half_frame", "skip 5", "skip 15"):
                rig.emulator.inject(*fault.split())
                await rig.settle(0.5)
                assert rig.out.last.angular_velocity.z == pytest.approx(0.5, abs=0.3)
            assert all(abs(imu.angular_velocity.z) < 1.5 for imu in rig.out.kept)
        assert rig.events.reasons() == [Reason.DEVICE_PROTOCOL], "named once"

    on_bench(test)


def test_a_yaw_that_counts_the_other_way():
    async def test(rig):
        async with rig.driving():
            await rig.out.total(20)
            rig.emulator.inject("inverted", "on")
            await rig.settle(0.5)
            assert rig.out.last.angular_velocity.z == pytest.approx(-0.5, abs=0.3)

    on_bench(test)


def test_bytes_lost_or_one_at_a_time():
    async def test(rig):
        rig.port.device.faults.lose_rate = 0.02
        rig.port.device.faults.chunk = 1
        async with rig.driving():
            await rig.out.total(100)
        assert all(abs(imu.angular_velocity.z) < 1.5 for imu in rig.out.kept)

    on_bench(test)


@pytest.mark.parametrize(
    ("trouble", "error", "text"),
    [
        (lambda rig: rig.emulator.inject("silent", "on"), DeviceTimeoutError, "silent for 0.3 s"),
        (lambda rig: rig.emulator.inject("frozen", "on"), ProtocolError, "in a row are identical"),
        (lambda rig: rig.emulator.inject("bad_checksum", "999"), ProtocolError, "but no measurement"),
        (lambda rig: rig.port.unplug(), DeviceLostError, "unplugged"),
    ],
    ids=["silent", "frozen", "damaged", "unplugged"],
)
def test_trouble_ends_the_session_and_the_next_one_goes_on(trouble, error, text):
    async def test(rig):
        async def happen():
            await rig.out.total(10)
            trouble(rig)

        async with background(happen()):
            with pytest.raises(error, match=text):
                await rig.session()
        for fault in ("silent off", "frozen off", "bad_checksum 0"):
            rig.emulator.inject(*fault.split())
        rig.port.plug()
        async with rig.driving():
            await rig.out.count(10)

    on_bench(test)


def test_a_unit_that_restarts_reports_no_turn():
    async def test(rig):
        async with rig.driving():
            await rig.settle(1.2)
            rig.emulator.inject("reset")
            rig.emulator._awake_at = rig.clock.now() + SECOND // 5
            await rig.settle(1.0)
        assert all(abs(imu.angular_velocity.z) < 1.5 for imu in rig.out.kept)

    on_bench(test)


def test_a_stranger_and_an_unknown_fault_are_refused():
    async def main(clock: VirtualClock) -> None:
        rig = Rig(clock)

        async def talk():
            while True:
                rig.port.device.write(b"$C320.5P0.2R-18.3T19.0*3C\r\n")
                await clock.sleep(0.05)

        async with rig.plugged_in(talk()):
            with pytest.raises(WrongDeviceError, match="PS0 and PS1"):
                await rig.session()
        with pytest.raises(InputError, match="known: frozen"):
            rig.emulator.inject("skip", "x")

    run_virtual(main)


def test_the_probe_says_what_it_measures():
    async def test(rig):
        found = await DEVICES["bno085"].identify(rig.port, rig.clock)
        assert found["pitch_deg"] == pytest.approx(degrees(TILT), abs=0.5)

    on_bench(test)


@pytest.mark.wall
async def test_a_foreign_client_reads_what_the_unit_feels(tmp_path):
    """The chip maker's client by Adafruit (MIT licence); it finds a frame whose beginning it happens to read."""
    port, emulator = PtyPort(tmp_path / "imu"), Bno085Emulator(WallClock(), Turning())
    running = asyncio.create_task(emulator.run(port.device))
    await asyncio.sleep(0)
    port.plug()

    def read():
        with serial.Serial(port.name, BNO085_BAUD, timeout=2) as line:
            return BNO08x_RVC(line, timeout=5).heading

    try:
        async with asyncio.timeout(20):
            _, pitch, roll, x, y, z = await asyncio.to_thread(read)
    finally:
        port.unplug()
        running.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await running
    assert (pitch, roll) == pytest.approx((degrees(TILT), 0.0), abs=0.6)
    assert (x, y, z) == pytest.approx((-STANDARD_GRAVITY * sin(TILT), 0.0, STANDARD_GRAVITY * cos(TILT)), abs=0.2)
