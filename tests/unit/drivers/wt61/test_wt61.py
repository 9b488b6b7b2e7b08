"""Codec, driver and emulator of the WT61."""

import asyncio
from itertools import pairwise
from math import radians

import pytest
from hypothesis import given
from hypothesis import strategies as st

from monstertruck_drivers.cable import DeviceEnd
from monstertruck_drivers.catalog import DEVICES
from monstertruck_drivers.emulation import ImuReading
from monstertruck_drivers.wt61.config import Wt61Config
from monstertruck_drivers.wt61.driver import Wt61Driver
from monstertruck_drivers.wt61.emulator import Wt61Emulator
from monstertruck_drivers.wt61.protocol import TOGGLE_SLEEP, Wt61Kind, Wt61Packet, Wt61Parser, build, measured
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import (
    DeviceLostError,
    DeviceTimeoutError,
    InputError,
    ProtocolError,
    WrongDeviceError,
)
from monstertruck_schemas.sensor import Imu
from tests.unit.drivers.kit import DriverRig, Kept

counts = st.integers(-32768, 32767)
packets = st.builds(Wt61Packet, st.sampled_from(Wt61Kind), counts, counts, counts, counts)


class Turning:
    """1 rad/s to the left, level."""

    def imu(self, time_ns):
        return ImuReading((0.0, 0.0, 1.0), (0.5, 0.0, 9.81), 25.0)


class Rig(DriverRig):
    def __init__(self, clock, config=None):
        super().__init__(clock, None)
        self.emulator = Wt61Emulator(clock, Turning(), seed=1)
        self.out: Kept[Imu] = Kept()
        self.driver = Wt61Driver(config or Wt61Config(), self.port, clock, self.out, self.events)


def on_bench(test, config=None):
    async def main(clock: VirtualClock) -> None:
        rig = Rig(clock, config)
        async with rig.plugged_in(rig.emulator.run(rig.port.device)):
            await test(rig)

    run_virtual(main)


def test_bytes_of_the_manual():
    quarter = Wt61Packet(Wt61Kind.ACCELERATION, 0x0800, 0, 0x0800, -2220)
    data = build(quarter)
    assert data == bytes.fromhex("55 51 00 08 00 00 00 08 54 f7 01".replace("01", f"{sum(data[:10]) & 255:02x}"))
    assert quarter.acceleration == pytest.approx((9.80665, 0.0, 9.80665))
    assert quarter.celsius == pytest.approx(30.0, abs=0.01)
    assert Wt61Packet(Wt61Kind.ANGULAR_VELOCITY, 0, 0, 0x4000, 0).angular_velocity[2] == pytest.approx(radians(1000))


@given(st.lists(packets, max_size=5), st.lists(st.integers(0, 60), max_size=5))
def test_what_is_written_is_read_again_however_it_is_cut(sent, cuts):
    data, parser = b"".join(map(build, sent)), Wt61Parser()
    edges = sorted({0, len(data), *(cut for cut in cuts if cut < len(data))})
    read = [p for a, b in pairwise(edges) for p in parser.feed(data[a:b])]
    assert read == sent
    assert parser.refused == 0


@given(st.binary(max_size=200))
def test_any_bytes_end_in_packets_or_nothing(data):
    parser = Wt61Parser()
    for packet in parser.feed(data):
        assert build(packet) in data
    assert parser.feed(bytes(11) + build(Wt61Packet(Wt61Kind.ANGLE, 1, 2, 3, 4)))[-1:] == [
        Wt61Packet(Wt61Kind.ANGLE, 1, 2, 3, 4)
    ]


def test_a_measurement_beyond_the_range_is_clipped():
    assert measured(Wt61Kind.ANGULAR_VELOCITY, (100.0, -100.0, 0.0), 30.0)[1:4] == (32767, -32767, 0)


def test_it_streams_unasked_and_is_only_listened_to():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.out.count(20)
        last = rig.out.last
        assert last.angular_velocity.z == pytest.approx(1.0, abs=0.01)
        assert last.linear_acceleration.z == pytest.approx(9.81, abs=0.03)
        assert last.temperature == pytest.approx(25.0, abs=0.01)
        assert last.frame == "imu"
        span = (rig.out.kept[-1].stamp - rig.out.kept[0].stamp) / SECOND
        assert 19 / span == pytest.approx(50, rel=0.02)
        assert 0.005 < (last.received - last.stamp) / SECOND < 0.03
        assert bytes(rig.emulator.received) == b""

    on_bench(test)


def test_a_unit_in_standby_is_woken_up_once():
    async def test(rig: Rig) -> None:
        await rig.settle(0.1)
        rig.emulator.inject("asleep", "on")
        async with rig.driving():
            await rig.out.count(5)
        assert bytes(rig.emulator.received) == TOGGLE_SLEEP

    on_bench(test)


@pytest.mark.parametrize(
    ("fault", "error"),
    [
        (("silent", "on"), DeviceTimeoutError),
        (("frozen", "on"), ProtocolError),
        (("bad_checksum", "99"), ProtocolError),
    ],
)
def test_trouble_ends_the_session(fault, error):
    async def test(rig: Rig) -> None:
        async def trouble() -> None:
            await rig.out.count(5)
            rig.emulator.inject(*fault)

        asyncio.get_running_loop().create_task(trouble())
        with pytest.raises(error):
            await rig.session()

    on_bench(test)


def test_a_few_wrong_sums_and_torn_packets_do_no_harm():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.out.count(5)
            rig.emulator.inject("bad_checksum", "3")
            rig.emulator.inject("half_packet")
            await rig.out.count(20)
        assert all(abs(m.angular_velocity.z - 1.0) < 0.02 for m in rig.out.kept)

    on_bench(test)


@pytest.mark.parametrize("damage", [{"flip_rate": 0.003}, {"drop_rate": 0.003}, {"chunk": 1}])
def test_bytes_lost_flipped_or_one_at_a_time(damage):
    async def test(rig: Rig) -> None:
        rig.port.device.faults.seed(3)
        for name, value in damage.items():
            setattr(rig.port.device.faults, name, value)
        async with rig.driving():
            await rig.out.count(200)
        assert all(abs(m.angular_velocity.z - 1.0) < 0.02 for m in rig.out.kept)

    on_bench(test)


def test_a_stall_a_replug_and_a_stranger():
    async def test(rig: Rig) -> None:
        async def later() -> None:
            await rig.out.count(3)
            rig.port.unplug()

        asyncio.get_running_loop().create_task(later())
        with pytest.raises(DeviceLostError):
            await rig.session()
        rig.port.plug()
        async with rig.driving():
            await rig.out.count(3)
        assert len(rig.ready_at) == 2
        rig.port.device.faults.stalled = True
        with pytest.raises(DeviceTimeoutError):
            await rig.session()

    on_bench(test)


def test_another_device_is_refused():
    async def chatter(end: DeviceEnd, clock) -> None:
        while True:
            end.write(b"$C123.4P1.0R-2.0*3A\r\n")
            await clock.sleep(0.05)

    async def main(clock: VirtualClock) -> None:
        rig = Rig(clock)
        async with rig.plugged_in(chatter(rig.port.device, clock)):
            with pytest.raises(WrongDeviceError, match="WT61"):
                await rig.session()

    run_virtual(main)


def test_probe_and_unknown_faults():
    async def test(rig: Rig) -> None:
        found = await DEVICES["wt61"].identify(rig.port, rig.clock)
        assert found["device"] == "WitMotion WT61 inertial measurement unit"
        assert found["angular_velocity"][2] == pytest.approx(1.0, abs=0.02)
        with pytest.raises(InputError, match="known: frozen"):
            rig.emulator.inject("smoke")

    on_bench(test)
