"""The lines of boards that speak ROSArduinoBridge."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from monstertruck_drivers.arduino_bridge.protocol import BoardLines, counts_of, is_number, pwm, speeds


def test_commands_byte_by_byte():
    assert (speeds(10, -20), pwm(0, 255)) == (b"m 10 -20\r", b"o 0 255\r")
    assert counts_of(b"-15 2147483647") == (-15, 2147483647)
    assert [is_number(line) for line in (b"57600", b"OK", b"12 13", b"")] == [True, False, False, False]


@pytest.mark.parametrize("line", [b"OK", b"", b"1", b"1 2 3", b"1  2", b"a b", b"1 2x", b"-1 --2"])
def test_what_is_no_answer_is_none(line):
    assert counts_of(line) is None


@given(st.lists(st.binary(max_size=80), max_size=6), st.integers(1, 30))
def test_any_bytes_end_in_lines(chunks, size):
    data, lines = b"".join(chunks), BoardLines()
    for i in range(0, len(data), size):
        for line in lines.feed(data[i : i + size]):
            counts_of(line)
    lines.feed(b"\n")
    assert lines.feed(b"5 6\r\n") == [b"5 6"]
