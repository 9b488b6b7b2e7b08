"""CRSF and SBUS frames, the receiver's driver and its emulator, and a foreign parser."""

import pytest
from crsf_parser import CRSFParser, PacketValidationStatus
from hypothesis import given
from hypothesis import strategies as st

from monstertruck_drivers.cable import MemoryPort
from monstertruck_drivers.catalog import DEVICES
from monstertruck_drivers.emulation import EmulatorSetup
from monstertruck_drivers.receiver import crsf, sbus
from monstertruck_drivers.receiver.config import CrsfConfig, SbusConfig
from monstertruck_drivers.receiver.crsf import CrsfParser
from monstertruck_drivers.receiver.driver import ReceiverDriver
from monstertruck_drivers.receiver.emulator import ReceiverEmulator
from monstertruck_drivers.receiver.frames import ReceiverFrame
from monstertruck_drivers.receiver.protocol import (
    CENTRE,
    CRSF_ADDRESS,
    HIGH,
    LOW,
    RADIO_CHANNELS,
    SBUS_SIZE,
    pack,
    position,
    raw,
    unpack,
)
from monstertruck_drivers.receiver.sbus import SbusParser
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import (
    DeviceLostError,
    DeviceTimeoutError,
    InputError,
    ProtocolError,
    WrongDeviceError,
)
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import HandControls
from tests.unit.drivers.kit import DriverRig, Kept, background

MIDDLE = (CENTRE,) * RADIO_CHANNELS
BOTH = pytest.mark.parametrize("config", [CrsfConfig(estop=6), SbusConfig(estop=6)], ids=["crsf", "sbus"])
STICK, ARM, ESTOP = 2, 5, 6
channels = st.binary(min_size=22, max_size=22).map(unpack)
PUBLISHED = bytes.fromhex("ee18 16 e1e3de09c7d78a56800f7ce0031ff8c0073ef0810f7c 36")
"""Example of a public implementation of CRSF: sticks near their ends and all switches in the middle."""


class Rig(DriverRig):
    def __init__(self, clock, config):
        super().__init__(clock, None)
        self.emulator = ReceiverEmulator(clock, config)
        self.out: Kept[HandControls] = Kept()
        self.driver = ReceiverDriver(config, self.port, clock, self.out, self.events)


def on_bench(test, config):
    async def main(clock: VirtualClock) -> None:
        rig = Rig(clock, config)
        async with rig.plugged_in(rig.emulator.run(rig.port.device)):
            await test(rig)

    run_virtual(main, start=SECOND)


def test_positions_of_sticks():
    assert [position(value) for value in (LOW, CENTRE, HIGH)] == pytest.approx([-1.0, 0.0, 1.0], abs=1e-3)
    assert (position(0), position(2047)) == (-1.0, 1.0)
    assert [raw(value) for value in (-1.0, 0.0, 1.0)] == pytest.approx([LOW, CENTRE, HIGH], abs=1)


@given(channels)
def test_channels_survive_packing(words):
    assert unpack(pack(words)) == words


def test_a_published_frame_has_our_sum_and_channels():
    body = PUBLISHED[2:-1]
    assert crsf.crc8(body) == PUBLISHED[-1]
    words = unpack(body[1:])
    assert set(words[8:]) == {CENTRE}
    assert crsf.channels_frame(words) == bytes((CRSF_ADDRESS,)) + PUBLISHED[1:]


def test_a_foreign_parser_reads_our_frames_and_ours_reads_its_layout():
    """crsf-parser (MIT licence)."""
    words = tuple(range(172, 172 + 100 * RADIO_CHANNELS, 100))
    found = []
    client = CRSFParser(lambda frame, status: found.append((frame, status)))
    client.parse_stream(bytearray(crsf.channels_frame(words) + crsf.link_frame(0.93, -71.0) + b"\xc8"))
    (first, one), (second, two) = found
    assert (one, two) == (PacketValidationStatus.VALID,) * 2
    assert sorted(first.payload.channels) == sorted(words)
    assert second.payload.uplink_link_quality == 93
    assert abs(second.payload.uplink_rssi_ant_1) == 71


def test_link_statistics_and_what_they_leave_out():
    assert CrsfParser().feed(crsf.link_frame(0.5, -71.0)) == [ReceiverFrame(quality=0.5, rssi=-71.0)]
    assert CrsfParser().feed(crsf.link_frame(0.0, 0.0)) == [ReceiverFrame(quality=0.0, failsafe=True)]
    assert CrsfParser().feed(crsf.frame(0x08, bytes(8))) == [], "battery"


def test_sbus_byte_by_byte():
    data = sbus.frame(MIDDLE, lost=True, failsafe=True)
    assert data.hex() == "0f" + pack(MIDDLE).hex() + "0c00"
    parser = SbusParser()
    assert parser.feed(data) == [], "of the first one only the place is believed"
    assert parser.feed(data) == parser.feed(data) == [ReceiverFrame(MIDDLE, lost=True, failsafe=True)]


@given(st.lists(channels, min_size=1, max_size=4), st.integers(1, 60))
def test_chunks_of_any_size_give_the_frames(words, size):
    for build, parser, skipped in ((crsf.channels_frame, CrsfParser(), 0), (sbus.frame, SbusParser(), 1)):
        data = b"".join(map(build, words)) + bytes(SBUS_SIZE)
        found = [frame for i in range(0, len(data), size) for frame in parser.feed(data[i : i + size])]
        assert [frame.channels for frame in found][: len(words) - skipped] == words[skipped:][: len(found)]


@given(st.binary(max_size=200))
def test_any_bytes_end_in_frames_or_nothing(data):
    for build, parser in ((crsf.channels_frame, CrsfParser()), (sbus.frame, SbusParser())):
        parser.feed(data)
        for _ in range(6):
            found = parser.feed(build(MIDDLE))
        assert found[-1].channels == MIDDLE


@given(st.integers(8, 26 * 8 - 1))
def test_no_single_wrong_bit_of_crsf_passes(bit):
    data = bytearray(crsf.channels_frame(tuple(range(RADIO_CHANNELS))))
    data[bit // 8] ^= 1 << bit % 8
    assert CrsfParser().feed(bytes(data) + bytes(64)) == []


@BOTH
def test_sticks_and_switches(config):
    async def test(rig):
        async with rig.driving():
            await rig.out.total(20)
            first = rig.out.last
            assert (first.lost, first.arm, first.speed, first.steer, first.drive) == (False, False, 0.0, 0.0, True)
            rig.emulator.move(STICK, 0.5)
            rig.emulator.move(1, 1.0)
            rig.emulator.move(ARM, 1.0)
            await rig.settle(0.3)
            last = rig.out.last
            assert (last.speed, last.steer) == pytest.approx((0.5, -1.0), abs=0.01)
            assert last.arm
            assert not last.estop
            assert last.link_quality == 1.0
            rig.emulator.move(STICK, 0.03)
            rig.emulator.move(ESTOP, 1.0)
            await rig.settle(0.3)
            assert rig.out.last.speed == 0.0
            assert rig.out.last.estop
            assert (last.rssi is None) is isinstance(config, SbusConfig)
        within = [one for one in rig.out.kept if one.received > last.received - SECOND // 4]
        assert 10 <= len(within) <= 40

    on_bench(test, config)


@BOTH
def test_a_switch_is_on_after_three_frames_and_off_at_once(config):
    async def test(rig):
        async with rig.driving():
            await rig.settle(0.5)
            rig.emulator.move(ARM, 1.0)
            asked = rig.clock.now()
            while not rig.out.last.arm:
                await rig.settle(0.001)
            assert 0.02 < (rig.clock.now() - asked) / SECOND < 0.065
            rig.emulator.move(ARM, -1.0)
            asked = rig.clock.now()
            while rig.out.last.arm:
                await rig.settle(0.001)
            assert (rig.clock.now() - asked) / SECOND < 0.025

    on_bench(test, config)


@BOTH
def test_the_loss_of_the_transmitter_is_reported_and_its_return(config):
    async def test(rig):
        async with rig.driving():
            rig.emulator.move(ARM, 1.0)
            await rig.settle(1.0)
            assert rig.out.last.arm
            rig.emulator.inject("transmitter", "off")
            lost_at = rig.clock.now()
            while not rig.out.last.lost:
                await rig.settle(0.005)
            assert (rig.clock.now() - lost_at) / SECOND < 0.25
            last = rig.out.last
            assert (last.arm, last.drive, last.estop, last.speed) == (False, False, False, 0.0)
            await rig.settle(1.0)
            assert rig.clock.now() - rig.out.last.received < SECOND // 20, "the loss is published all the time"
            assert rig.out.last.link_quality == pytest.approx(0.0, abs=0.2)
            rig.emulator.inject("transmitter", "on")
            await rig.settle(1.0)
            assert not rig.out.last.lost
        assert rig.events.reasons() == [Reason.DEVICE_READY, Reason.DEVICE_LOST, Reason.DEVICE_READY]

    on_bench(test, config)


@BOTH
def test_a_bad_link_shows_its_quality(config):
    async def test(rig):
        rig.emulator.inject("quality", "0.6")
        async with rig.driving():
            await rig.settle(3.0)
            assert rig.out.last.link_quality == pytest.approx(0.6, abs=0.15)

    on_bench(test, config)


@BOTH
def test_damage_and_single_bytes_do_no_harm(config):
    async def test(rig):
        async with rig.driving():
            rig.emulator.move(STICK, 1.0)
            await rig.settle(0.5)
            rig.emulator.inject("damage", "3")
            rig.port.device.faults.chunk = 1
            await rig.settle(0.5)
            rig.port.device.faults.lose_rate = 0.02
            await rig.settle(2.0)
            rig.port.device.faults.lose_rate = 0.0
            await rig.settle(0.5)
            assert rig.out.last.speed == pytest.approx(1.0, abs=0.01)
            assert not any(one.arm for one in rig.out.kept)

    on_bench(test, config)


@BOTH
@pytest.mark.parametrize(
    ("trouble", "error"),
    [
        (lambda rig: rig.emulator.inject("silent", "on"), DeviceTimeoutError),
        (lambda rig: rig.emulator.inject("damage", "9999"), ProtocolError),
        (lambda rig: rig.port.unplug(), DeviceLostError),
    ],
    ids=["silent", "damaged", "unplugged"],
)
def test_trouble_ends_the_session_and_the_next_one_goes_on(config, trouble, error):
    async def test(rig):
        async def happen():
            await rig.out.total(20)
            trouble(rig)

        async with background(happen()):
            with pytest.raises(error):
                await rig.session()
        rig.emulator.inject("silent", "off")
        rig.emulator.inject("damage", "0")
        rig.port.plug()
        async with rig.driving():
            await rig.out.count(20)
            assert not rig.out.last.lost

    on_bench(test, config)


def test_a_stranger_and_an_unknown_fault_are_refused():
    async def main(clock: VirtualClock) -> None:
        rig = Rig(clock, SbusConfig())

        async def talk():
            while True:
                rig.port.device.write(b"$C320.5P0.2R-18.3T19.0*3C\r\n")
                await clock.sleep(0.05)

        async with rig.plugged_in(talk()):
            with pytest.raises(WrongDeviceError, match="is the signal inverted"):
                await rig.session()
        with pytest.raises(InputError, match="known: move"):
            rig.emulator.inject("move", "x", "1")

    run_virtual(main)


@BOTH
def test_the_probe_says_what_the_receiver_hears(config):
    async def test(rig):
        rig.emulator.move(STICK, 1.0)
        found = await DEVICES[config.kind].identify(rig.port, rig.clock, config)
        assert found["channels"][STICK - 1] == pytest.approx(1.0, abs=0.01)
        assert not found["failsafe"]

    on_bench(test, config)


@pytest.mark.parametrize("name", ["crsf", "sbus"])
def test_without_settings_emulator_and_probe_of_a_kind_speak_its_protocol(name):
    kind = DEVICES[name]

    async def main(clock: VirtualClock) -> None:
        port = MemoryPort("hand")
        emulator = kind.emulated(EmulatorSetup("hand", None, clock, None, port=port))
        async with background(emulator.run(port.device)):
            port.plug()
            found = await kind.identify(port, clock)
        assert name.upper() in found["device"]
        assert found["channels"] is not None

    run_virtual(main, start=SECOND)


def test_every_channel_has_one_use():
    with pytest.raises(ValueError, match="only one use"):
        CrsfConfig(speed=1)
