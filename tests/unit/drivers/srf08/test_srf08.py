"""Codec, driver and emulator of SRF08 sonars behind a USB-ISS."""

import asyncio

import pytest
from hypothesis import given
from hypothesis import strategies as st

from monstertruck_drivers.cable import DeviceEnd
from monstertruck_drivers.catalog import DEVICES
from monstertruck_drivers.srf08 import protocol
from monstertruck_drivers.srf08.config import SonarConfig, Srf08Config, five_sonars
from monstertruck_drivers.srf08.driver import Srf08Driver
from monstertruck_drivers.srf08.emulator import Srf08Emulator
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import (
    DeviceLostError,
    DeviceTimeoutError,
    InputError,
    ProtocolError,
    WrongDeviceError,
)
from monstertruck_schemas.body import Mount
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import SonarRanges
from tests.unit.drivers.kit import DriverRig, Kept

NAMES = ["l", "fl", "f", "fr", "r"]


class Places:
    """Distances that a test sets; keeps who fired when."""

    def __init__(self):
        self.distances = dict(zip(NAMES, (0.3, 0.42, 2.5, float("inf"), 1.0), strict=True))
        self.fired = []

    def fire(self, name, time_ns):
        self.fired.append((time_ns, name))

    def range(self, name):
        return self.distances[name]


class Rig(DriverRig):
    def __init__(self, clock, config=None):
        super().__init__(clock, None)
        self.places = Places()
        self.emulator = Srf08Emulator(clock, self.places, config, seed=1)
        self.out: Kept[SonarRanges] = Kept()
        self.driver = Srf08Driver(config or Srf08Config(), self.port, clock, self.out, self.events)

    def after(self, messages, act):
        async def later():
            await self.out.count(messages)
            act()

        self.task = asyncio.get_running_loop().create_task(later())


def on_bench(test, config=None):
    async def main(clock: VirtualClock) -> None:
        rig = Rig(clock, config)
        async with rig.plugged_in(rig.emulator.run(rig.port.device)):
            await test(rig)

    run_virtual(main)


def test_bytes_of_the_manuals():
    assert bytes.fromhex("5a 02 60 aa") == protocol.SET_MODE
    assert protocol.write(0xE0, 0, 0x52) == bytes.fromhex("55 e0 00 01 52")
    assert protocol.read(0xE2) == bytes.fromhex("55 e3 00 04")
    reading = protocol.parse_reading(bytes.fromhex("0a 7f 16 c8"))
    assert reading == (10, 127, 5832)
    assert reading.present
    assert not protocol.parse_reading(b"\xff" * 4).present
    assert protocol.range_setting(11.0) == 255
    assert protocol.range_setting(0.043) == 0
    assert protocol.ranging_time(255) == pytest.approx(0.065)


@given(st.binary(max_size=8))
def test_a_reading_of_any_bytes_is_one_or_refused(data):
    if len(data) == 4:
        assert protocol.parse_reading(data).microseconds == int.from_bytes(data[2:], "big")
    else:
        with pytest.raises(ValueError, match="expected 4 bytes"):
            protocol.parse_reading(data)


@given(st.floats(0.01, 6.0))
def test_the_range_setting_waits_long_enough(metres):
    assert protocol.ranging_time(protocol.range_setting(metres)) >= 2 * metres / 345 - 0.0003


@given(st.lists(st.binary(min_size=1, max_size=20), max_size=10))
def test_the_bridge_answers_after_any_bytes_once_it_had_a_pause(pieces):
    async def test(rig):
        link = await rig.port.open()
        for piece in pieces:
            link.write(piece)
        await rig.settle(2.0)
        link.discard()
        link.write(protocol.VERSION)
        await rig.settle(0.1)
        assert (await link.read(0.1))[-3:-1] == bytes((protocol.MODULE, 8))
        link.close()

    on_bench(test)


def test_groups_fire_in_turn_and_every_round_is_a_message():
    async def test(rig):
        async with rig.driving():
            await rig.out.count(10)
        first, last = rig.out.kept[0], rig.out.last
        assert [sonar.name for sonar in last.sonars] == NAMES
        assert [sonar.range for sonar in last.sonars] == [
            pytest.approx(0.3, abs=0.003), pytest.approx(0.42, abs=0.003), pytest.approx(2.5, abs=0.003), None,
            pytest.approx(1.0, abs=0.003),
        ]  # fmt: skip
        assert all(sonar.answered for sonar in last.sonars)
        assert 9 / ((last.stamp - first.stamp) / SECOND) == pytest.approx(10, rel=0.02)
        assert last.received - last.stamp < 0.11 * SECOND
        assert [name for _, name in rig.places.fired[:5]] == ["l", "f", "r", "fl", "fr"]
        assert rig.places.fired[3][0] - rig.places.fired[0][0] == pytest.approx(0.05 * SECOND, rel=0.2)
        assert last.field_of_view == 0.87
        assert rig.emulator.modules[0xE0].range == protocol.range_setting(3.0)
        assert rig.emulator.modules[0xE0].gain == 16

    on_bench(test)


def test_a_dead_sonar_is_named_and_the_others_go_on():
    async def test(rig):
        async with rig.driving():
            await rig.out.count(3)
            rig.emulator.inject("dead", "f", "on")
            await rig.out.count(5)
            assert [sonar.answered for sonar in rig.out.last.sonars] == [True, True, False, True, True]
            rig.emulator.inject("dead", "f", "off")
            rig.emulator.inject("brownout", "f")
            await rig.out.count(5)
            assert rig.out.last.echo("f").range == pytest.approx(2.5, abs=0.003)
        assert rig.events.reasons() == [Reason.DEVICE_FAULT, Reason.DEVICE_READY]

    on_bench(test)


def test_a_sonar_that_lost_its_settings_gets_them_again():
    async def test(rig):
        async with rig.driving():
            await rig.out.count(3)
            rig.emulator.inject("brownout", "l")
            await rig.out.count(4)
        assert rig.emulator.modules[0xE0].range == protocol.range_setting(3.0)
        assert rig.out.last.echo("l").answered

    on_bench(test)


def test_a_stuck_sonar_counts_as_not_answering():
    async def test(rig):
        async with rig.driving():
            await rig.out.count(3)
            rig.emulator.inject("stuck", "l", "on")
            await rig.out.count(25)
            assert not rig.out.last.echo("l").answered
            assert rig.out.last.echo("r").answered
        assert rig.events.reasons() == [Reason.DEVICE_FAULT]

    on_bench(test)


def test_a_ghost_is_measured_like_any_echo():
    async def test(rig):
        rig.emulator.inject("ghost", "fr", "0.5")
        async with rig.driving():
            await rig.out.count(3)
        assert rig.out.last.echo("fr").range == pytest.approx(0.5, abs=0.003)

    on_bench(test)


def test_all_sonars_dead_end_the_session():
    async def test(rig):
        rig.after(3, lambda: [rig.emulator.inject("dead", name, "on") for name in NAMES])
        with pytest.raises(DeviceTimeoutError, match="no sonar answers"):
            await rig.session()

    on_bench(test)


def test_a_silent_bridge_and_one_byte_too_many():
    async def test(rig):
        rig.after(3, lambda: rig.emulator.inject("silent", "on"))
        with pytest.raises(DeviceTimeoutError, match="does not answer"):
            await rig.session()
        rig.emulator.inject("silent", "off")
        rig.after(3, lambda: rig.emulator.inject("extra"))
        with pytest.raises(ProtocolError, match="out of step"):
            await rig.session()

    on_bench(test)


def test_unplugged_plugged_in_again_and_stalled():
    async def test(rig):
        rig.after(3, rig.port.unplug)
        with pytest.raises(DeviceLostError):
            await rig.session()
        rig.port.plug()
        async with rig.driving():
            await rig.out.count(3)
        rig.port.device.faults.stalled = True
        with pytest.raises(DeviceTimeoutError):
            await rig.session()

    on_bench(test)


def test_half_a_command_of_a_dead_host_and_one_byte_reads_do_no_harm():
    async def test(rig):
        link = await rig.port.open()
        link.write(b"\x55\xe0\x00")
        link.close()
        rig.port.device.faults.chunk = 1
        async with rig.driving():
            await rig.out.count(3)

    on_bench(test)


def test_a_line_that_loses_bytes_ends_sessions_and_never_hangs():
    async def test(rig):
        rig.port.device.faults.seed(5)
        rig.port.device.faults.drop_rate = 0.01
        for _ in range(5):
            with pytest.raises((DeviceTimeoutError, ProtocolError, WrongDeviceError)):
                await asyncio.wait_for(rig.session(), 300)
        rig.port.device.faults.drop_rate = 0.0
        async with rig.driving():
            await rig.out.count(3)

    on_bench(test)


def test_flipped_bits_never_leave_the_range_limits():
    async def test(rig):
        rig.port.device.faults.seed(5)
        async with rig.driving():
            await rig.out.count(3)
            rig.port.device.faults.flip_rate = 0.002
            await rig.out.count(100)
            ranges = [sonar.range for message in rig.out.kept for sonar in message.sonars if sonar.range is not None]
            assert max(ranges) <= 3.0

    on_bench(test)


def test_another_device_is_refused():
    async def chatter(end: DeviceEnd, clock) -> None:
        while True:
            await end.read()
            end.write(b"\x15\x02\x00")

    async def main(clock: VirtualClock) -> None:
        rig = Rig(clock)
        async with rig.plugged_in(chatter(rig.port.device, clock)):
            with pytest.raises(WrongDeviceError, match="USB-ISS"):
                await rig.session()

    run_virtual(main)


def test_probe_names_the_sonars_and_inject_the_faults():
    async def test(rig):
        found = await DEVICES["srf08"].identify(rig.port, rig.clock)
        assert found["sonars"] == dict.fromkeys(map(str, range(224, 234, 2)), 10)
        with pytest.raises(InputError, match=r"expected 'dead l\|fl"):
            rig.emulator.inject("dead", "x", "on")

    on_bench(test)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"groups": (("l", "f"),)}, "expected each of l, fl, f, fr, r once"),
        ({"rate": 20.0}, "a group needs"),
        ({"range_min": 3.0}, "expected less than range_max"),
        ({"sonars": {n: five_sonars()["l"] for n in NAMES}}, "same address"),
    ],
)
def test_settings_that_cannot_be(changes, text):
    with pytest.raises(ValueError, match=text):
        Srf08Config(**changes)


def test_an_odd_address_is_refused():
    with pytest.raises(ValueError, match="expected an even one"):
        SonarConfig(address=225, mount=Mount())
