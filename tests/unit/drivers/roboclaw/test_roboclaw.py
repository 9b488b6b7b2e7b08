"""Codec, driver and emulator of a RoboClaw with two encoders."""

import asyncio
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from monstertruck_drivers.catalog import DEVICES
from monstertruck_drivers.roboclaw.config import RoboclawConfig
from monstertruck_drivers.roboclaw.driver import RoboclawDriver
from monstertruck_drivers.roboclaw.emulator import VERSION, RoboclawEmulator
from monstertruck_drivers.roboclaw.protocol import (
    COUNTER,
    RoboclawCommand,
    counted,
    counts,
    is_intact,
    request,
    signed,
    step,
)
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import (
    DeviceLostError,
    DeviceRestartedError,
    DeviceTimeoutError,
    InputError,
    ProtocolError,
    WrongDeviceError,
)
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import WheelEncoders
from tests.unit.drivers.kit import DriverRig, Kept, background


class Rolling:
    """1 rad/s on the left, 2 rad/s on the right."""

    def wheels(self, time_ns):
        return time_ns / SECOND, 2 * time_ns / SECOND


class Rig(DriverRig):
    def __init__(self, clock, config=None):
        super().__init__(clock, None)
        self.config = config or RoboclawConfig()
        self.emulator = RoboclawEmulator(clock, Rolling(), self.config)
        self.out: Kept[WheelEncoders] = Kept()
        self.driver = RoboclawDriver(self.config, self.port, clock, self.out, self.events)

    async def rates(self, seconds=1.0):
        """Of both wheels over the next seconds."""
        await self.out.count(1)
        first = self.out.last
        await self.out.count(round(seconds * self.config.rate))
        dt = (self.out.last.stamp - first.stamp) / SECOND
        return (self.out.last.left - first.left) / dt, (self.out.last.right - first.right) / dt


def on_bench(test, config=None):
    async def main(clock: VirtualClock) -> None:
        rig = Rig(clock, config)
        async with rig.plugged_in(rig.emulator.run(rig.port.device)):
            await test(rig)

    run_virtual(main)


def crc(data):
    """As the manual writes it."""
    value = 0
    for byte in data:
        value ^= byte << 8
        for _ in range(8):
            value = (value << 1 ^ 0x1021 if value & 0x8000 else value << 1) & 0xFFFF
    return value


def test_bytes_of_the_manual():
    asked = request(0x80, RoboclawCommand.COUNTS)
    assert asked == bytes((0x80, 78))
    answer = signed(asked, counted(6, -1))
    assert answer[:8] == bytes.fromhex("00000006 ffffffff")
    assert int.from_bytes(answer[8:], "big") == crc(asked + answer[:8])


@given(st.integers(-(2**31), 2**31 - 1), st.integers(0, COUNTER - 1))
def test_counters_wrap(by, before):
    first, second = counts(counted(before + by, before))
    assert (step(before, first), second) == (by, before)


@given(st.binary(max_size=60), st.integers(0, 7))
def test_one_wrong_bit_is_noticed(data, bit):
    asked = request(0x80, RoboclawCommand.VERSION)
    answer = signed(asked, data + b"\x00")
    assert is_intact(asked, answer)
    wrong = answer[:-3] + bytes((answer[-3] ^ 1 << bit,)) + answer[-2:]
    assert not is_intact(asked, wrong)
    assert not is_intact(request(0x81, RoboclawCommand.VERSION), answer)


@pytest.mark.parametrize(
    "settings", [{}, {"left": 2}, {"left_inverted": True, "counts_per_turn": 1024}, {"right_inverted": True}]
)
def test_wheels_are_read_however_they_are_wired(settings):
    async def test(rig):
        async with rig.driving():
            assert await rig.rates() == pytest.approx((1.0, 2.0), abs=0.02)
            assert rig.out.last.stamp <= rig.out.last.received

    on_bench(test, RoboclawConfig(**settings))


def test_a_stuck_and_a_mirrored_encoder_count_as_they_do():
    async def test(rig):
        async with rig.driving():
            rig.emulator.inject("stuck", "left", "on")
            rig.emulator.inject("mirrored", "right", "on")
            assert await rig.rates() == pytest.approx((0.0, -2.0), abs=0.02)
            rig.emulator.inject("stuck", "left", "off")
            rig.emulator.inject("mirrored", "right", "off")
            assert await rig.rates() == pytest.approx((1.0, 2.0), abs=0.02)

    on_bench(test)


def test_a_few_wrong_sums_do_no_harm_and_many_end_the_session():
    async def test(rig):
        async def noisy() -> None:
            await rig.out.count(3)
            rig.emulator.inject("noise", "2")
            assert await rig.rates() == pytest.approx((1.0, 2.0), abs=0.02)
            rig.emulator.inject("noise", "9")

        async with background(noisy()):
            with pytest.raises(ProtocolError, match="wrong CRC"):
                await rig.session()

    on_bench(test)


def test_a_unit_that_restarts_ends_the_session_and_no_position_jumps():
    async def test(rig):
        async def restart() -> None:
            await rig.settle(3.0)
            rig.emulator.inject("reset")

        async with background(restart()):
            with pytest.raises(DeviceRestartedError, match="restarted its counters"):
                await rig.session()
        last = rig.out.last
        assert rig.events.reasons()[-1] is Reason.DEVICE_RESTARTED
        async with rig.driving():
            await rig.out.count(1)
            assert rig.out.last.left == pytest.approx(last.left, abs=0.2)

    on_bench(test)


@pytest.mark.parametrize(
    ("trouble", "error"),
    [
        (lambda rig: rig.emulator.inject("silent", "on"), DeviceTimeoutError),
        (lambda rig: rig.port.unplug(), DeviceLostError),
    ],
    ids=["silent", "unplugged"],
)
def test_trouble_ends_the_session_and_the_next_one_goes_on(trouble, error):
    async def test(rig):
        async def happen() -> None:
            await rig.out.count(3)
            trouble(rig)

        async with background(happen()):
            with pytest.raises(error):
                await rig.session()
        with pytest.raises(error):
            await rig.session()
        rig.emulator.inject("silent", "off")
        rig.port.plug()
        async with rig.driving():
            assert await rig.rates() == pytest.approx((1.0, 2.0), abs=0.02)

    on_bench(test)


def test_a_stranger_and_an_unknown_fault_are_refused():
    async def main(clock: VirtualClock) -> None:
        rig = Rig(clock)

        async def parrot():
            while True:
                rig.port.device.write(await rig.port.device.read())

        async with rig.plugged_in(parrot()):
            with pytest.raises(WrongDeviceError, match="not the answer of a RoboClaw"):
                await rig.session()
        with pytest.raises(InputError, match="known: stuck"):
            rig.emulator.inject("stuck", "left")

    run_virtual(main)


def test_half_a_request_of_a_dead_host_does_no_harm():
    async def test(rig):
        async with await rig.port.open() as link:
            link.write(b"\x80")
            await asyncio.sleep(0.001)
        found = await DEVICES["roboclaw"].identify(rig.port, rig.clock)
        assert found["version"] == VERSION.decode().partition("\n")[0]
        assert len(found["counts"]) == 2

    on_bench(test)


def test_a_count_is_a_share_of_a_turn():
    assert RoboclawConfig(counts_per_turn=400).count == pytest.approx(math.tau / 400)
