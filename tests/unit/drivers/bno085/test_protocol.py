"""The bytes of the BNO085's frames in UART-RVC mode."""

import struct
from math import degrees

import pytest
from hypothesis import given
from hypothesis import strategies as st

from monstertruck_drivers.bno085.protocol import RvcFrame, RvcParser, build, measured

MANUAL = bytes.fromhex("aaaa de 0100 92ff 2508 8dfe ecff d103 000000 e7")


def test_the_example_of_the_data_sheet():
    (frame,) = RvcParser().feed(MANUAL)
    assert frame == RvcFrame(222, 1, -110, 2085, -371, -20, 977)
    assert build(frame) == MANUAL
    assert [degrees(angle) for angle in frame.angles] == pytest.approx([0.01, -1.10, 20.85])
    assert frame.acceleration == pytest.approx((-3.638, -0.196, 9.581), abs=1e-3)


@given(st.binary(max_size=65), st.integers(1, 40))
def test_chunks_of_any_size_give_the_frames(numbers, size):
    frames = [RvcFrame(*row) for row in struct.iter_unpack("<B6h", numbers[: len(numbers) // 13 * 13])]
    data, parser = b"".join(map(build, frames)), RvcParser()
    assert [frame for i in range(0, len(data), size) for frame in parser.feed(data[i : i + size])] == frames


@given(st.binary(max_size=200))
def test_any_bytes_end_in_frames_or_nothing(data):
    parser = RvcParser()
    parser.feed(data)
    assert parser.feed(build(measured(1, (0, 0, 0), (0, 0, 9.8))) * 3)


@given(st.integers(0, 151))
def test_no_single_wrong_bit_passes(bit):
    data = bytearray(MANUAL)
    data[bit // 8] ^= 1 << bit % 8
    assert RvcParser().feed(bytes(data)) == []
