"""Packets of the VESC: published bytes, any cut of the stream, damage."""

import binascii
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from monstertruck_drivers.vesc.protocol import (
    Deframer,
    FirmwareIdentity,
    MotorValues,
    PacketError,
    PacketId,
    WatchdogSetting,
    forwarded,
    frame,
    request,
    set_brake,
    set_current,
    set_rpm,
    set_servo,
    step,
    stop_frames,
    wrapped,
)

VALUES = MotorValues(-1.25, -0.5, -12345, 24.1, -7, 99, 4, 21, 31.5, timed_out=True)


@pytest.mark.parametrize(
    ("payload", "packet"),
    [
        (request(PacketId.FW_VERSION), "02 01 00 00 00 03"),
        (request(PacketId.GET_VALUES), "02 01 04 40 84 03"),
        (set_rpm(1000), "02 05 08 00 00 03 e8 2b 58 03"),
        (forwarded(7, set_brake(20.0)), "02 07 22 07 07 00 00 4e 20 ab 21 03"),
    ],
)
def test_packets_byte_by_byte(payload, packet):
    assert frame(payload).hex(" ") == packet


@pytest.mark.parametrize(
    ("payload", "expected"),
    [
        (set_rpm(-1000), "08 ff ff fc 18"),
        (set_current(0.0), "06 00 00 00 00"),
        (set_brake(12.5), "07 00 00 30 d4"),
        (set_servo(0.53), "0c 02 12"),
        (forwarded(7, set_rpm(1)), "22 07 08 00 00 00 01"),
        (forwarded(None, set_rpm(1)), "08 00 00 00 01"),
    ],
)
def test_payloads_byte_by_byte(payload, expected):
    assert payload.hex(" ") == expected


def test_a_long_payload_has_two_length_bytes():
    payload = bytes(300)
    assert frame(payload)[:3] == b"\x03\x01\x2c"
    assert Deframer().feed(frame(payload)) == [payload]
    with pytest.raises(ValueError, match="expected 1 to 512"):
        frame(b"")


def test_the_checksum_is_the_one_of_the_firmware():
    """Computed bit by bit: polynomial 0x1021, start 0, nothing reflected."""
    value = 0
    for byte in (data := b"\x08\x00\x00\x03\xe8"):
        value ^= byte << 8
        for _ in range(8):
            value = (value << 1 ^ 0x1021 if value & 0x8000 else value << 1) & 0xFFFF
    assert value == binascii.crc_hqx(data, 0)
    assert frame(data)[-3:-1] == value.to_bytes(2, "big")


@given(st.lists(st.binary(min_size=1, max_size=400), max_size=6), st.integers(1, 50))
def test_chunks_of_any_size_give_the_payloads(payloads, size):
    data, deframer = b"".join(map(frame, payloads)), Deframer()
    found = [payload for i in range(0, len(data), size) for payload in deframer.feed(data[i : i + size])]
    assert found == payloads
    assert deframer.bad == 0


@given(st.binary(max_size=600), st.binary(min_size=1, max_size=50))
def test_garbage_ends_nothing(garbage, payload):
    deframer = Deframer()
    deframer.feed(garbage)
    # At most one longest packet of the garbage swallows what follows.
    for _ in range(20):
        deframer.feed(frame(bytes(60)))
    assert payload in deframer.feed(frame(payload) * 2)


@given(st.binary(min_size=1, max_size=80), st.data())
def test_no_single_wrong_bit_passes(payload, data):
    packet = bytearray(frame(payload))
    bit = data.draw(st.integers(16, 8 * len(packet) - 1))
    packet[bit // 8] ^= 1 << bit % 8
    assert payload not in Deframer().feed(bytes(packet))


def test_values_survive_both_ways_and_have_the_layout_of_the_firmware():
    payload = VALUES.payload()
    assert MotorValues.of(payload) == VALUES
    assert len(payload) == 74
    assert struct.unpack_from(">i", payload, 23) == (-12345,), "rpm: behind 2 temperatures, 4 currents and the duty"
    assert struct.unpack_from(">h", payload, 27) == (241,)
    assert struct.unpack_from(">ii", payload, 45) == (-7, 99)
    assert payload[53] == 4
    assert payload[58] == 21


def test_firmware_without_the_later_fields_and_with_more_of_them_is_read():
    payload = VALUES.payload()
    assert MotorValues.of(payload[:59]).erpm == -12345
    assert not MotorValues.of(payload[:59]).timed_out
    assert MotorValues.of(payload + bytes(9)) == VALUES


@given(st.binary(max_size=90))
def test_any_payload_is_an_answer_or_refused(payload):
    for kind in (MotorValues, FirmwareIdentity, WatchdogSetting):
        try:
            kind.of(payload)
        except PacketError:
            continue


def test_a_firmware_states_version_hardware_and_serial():
    identity = FirmwareIdentity(6, 2, "60_MK6", bytes(range(12)))
    assert FirmwareIdentity.of(identity.payload() + b"app\0") == identity


def test_a_new_watchdog_changes_its_own_bytes_alone():
    settings = bytes((PacketId.GET_APPCONF,)) + bytes(range(1, 100))
    changed = WatchdogSetting(100, 20.0).applied(settings)
    assert changed[0] == PacketId.SET_APPCONF_NO_STORE
    assert changed[1:6] == settings[1:6]
    assert changed[6:14] == struct.pack(">If", 100, 20.0)
    assert changed[14:] == settings[14:]
    assert WatchdogSetting.of(bytes((PacketId.GET_APPCONF,)) + changed[1:]) == WatchdogSetting(100, 20.0)


@given(st.integers(-(2**31), 2**31 - 1), st.integers(-(2**31), 2**31 - 1))
def test_counters_wrap(before, by):
    assert step(before, wrapped(before + by)) == by


def test_the_stop_brakes_and_then_lets_go():
    assert stop_frames(20.0, 7) == (frame(forwarded(7, set_brake(20.0))), frame(forwarded(7, set_current(0.0))))
