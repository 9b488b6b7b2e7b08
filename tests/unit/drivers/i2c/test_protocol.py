"""Packets of I2C transfers: encoded, damaged, cut into pieces."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from monstertruck_drivers.i2c.protocol import I2cAnswer, I2cRequest, Packets

BYTES = st.integers(0, 255)
REQUESTS = st.builds(I2cRequest, BYTES, BYTES, st.binary(max_size=255), BYTES)
ANSWERS = st.builds(I2cAnswer, BYTES, BYTES, st.binary(max_size=255))


@given(st.lists(REQUESTS, max_size=4), st.integers(1, 40))
def test_requests_come_back_however_they_are_cut(sent, size):
    packets, line = Packets(I2cRequest), b"".join(map(bytes, sent))
    assert [one for i in range(0, len(line), size) for one in packets.feed(line[i : i + size])] == sent


@given(ANSWERS, st.binary(max_size=3))
def test_an_answer_is_found_behind_garbage(answer, garbage):
    garbage = bytes(byte for byte in garbage if byte != 0x5A)
    assert Packets(I2cAnswer).feed(garbage + bytes(answer)) == [answer]


@pytest.mark.parametrize("at", range(1, 9))
def test_a_damaged_packet_is_dropped_and_the_next_one_read(at):
    damaged = bytearray(bytes(I2cRequest(3, 0x40, b"\x06\x00", 1)))
    damaged[at] ^= 0x10
    following = [I2cRequest(number, 0x40, bytes(20), 0) for number in range(30)]
    found = Packets(I2cRequest).feed(bytes(damaged) + b"".join(map(bytes, following)))
    assert I2cRequest(3, 0x40, b"\x06\x00", 1) not in found
    assert found[-1] == following[-1]


@given(st.binary(max_size=200))
def test_any_bytes_give_packets_or_nothing(data):
    for packet in Packets(I2cAnswer).feed(data):
        assert bytes(packet) in data
