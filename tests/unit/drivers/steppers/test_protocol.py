"""Lines of the stepper controller: byte vectors, properties, garbage."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from monstertruck_drivers.steppers.protocol import (
    MAX_LINE,
    Identity,
    Line,
    LineError,
    MotorState,
    Splitter,
    Status,
    crc,
    decode,
    step_of,
    wrapped,
)

LINES = st.builds(
    Line,
    st.sampled_from("ICRQDSicse"),
    st.integers(0, 255),
    st.lists(st.text("0123456789-ABCxyz_.", min_size=1, max_size=8), max_size=6).map(tuple),
)


def test_the_sum_is_that_of_the_catalogues():
    assert crc(b"123456789") == 0x29B1


@pytest.mark.parametrize(
    ("line", "data"),
    [
        (Line("I", 1), b":I 1*6F34\n"),
        (Line("R", 7, ("100000", "-50000", "0", "1")), b":R 7 100000 -50000 0 1*9B95\n"),
        (Identity("STEP4", 1, 4, 400, 10).line(1), b":i 1 STEP4 1 4 400 10*D4B1\n"),
        (
            Status(MotorState.RUN, 0, 1234, (5, -6, 7, 8), (1, 2, 3, 4)).line(255),
            b":s 255 1 0 1234 5 -6 7 8 1 2 3 4*ADBE\n",
        ),
    ],
)
def test_byte_vectors(line: Line, data: bytes):
    assert bytes(line) == data
    assert decode(data) == line


@given(LINES)
def test_every_line_survives_the_way(line: Line):
    assert decode(bytes(line)) == line


@given(LINES, st.data())
def test_no_single_wrong_bit_passes(line: Line, data: st.DataObject):
    raw = bytearray(bytes(line)[:-1])
    at = data.draw(st.integers(0, len(raw) - 1))
    raw[at] ^= 1 << data.draw(st.integers(0, 7))
    with pytest.raises(LineError):
        decode(bytes(raw))


@given(st.binary(max_size=600))
def test_garbage_is_no_line_and_ends_nothing(garbage: bytes):
    splitter = Splitter()
    splitter.feed(garbage)
    assert splitter.feed(b"\n" + bytes(Line("S", 3)))[-1] == Line("S", 3)


@given(st.lists(LINES, min_size=1, max_size=5), st.integers(1, 7))
def test_pieces_of_any_size_give_the_same_lines(lines: list[Line], size: int):
    data, splitter = b"".join(map(bytes, lines)), Splitter()
    found = [line for i in range(0, len(data), size) for line in splitter.feed(data[i : i + size])]
    assert found == lines
    assert splitter.bad == 0


def test_a_line_that_lost_its_end_costs_itself_only():
    splitter = Splitter()
    assert splitter.feed(bytes(Line("S", 3))[:-3] + bytes(Line("S", 4))) == [Line("S", 4)]
    assert splitter.bad == 1
    assert splitter.feed(b"x" * MAX_LINE) == []
    assert splitter.bad == 2


@pytest.mark.parametrize("words", [("4", "0", "1"), ("1", "x", "0"), ("9", "0", "0", *("0",) * 8), ()])
def test_what_is_no_status_says_so(words: tuple[str, ...]):
    with pytest.raises(LineError):
        Status.of(Line("s", 1, words), 4)
    with pytest.raises(LineError):
        Identity.of(Line("s", 1, words))


@pytest.mark.parametrize("seq", ["256", "-1", "x", "9" * 50])
def test_sequence_numbers_are_one_byte(seq: str):
    body = f"S {seq}".encode()
    with pytest.raises(LineError):
        decode(b":%b*%04X" % (body, crc(body)))


@given(st.integers(-(2**40), 2**40), st.integers(-1000, 1000))
def test_positions_are_followed_over_the_wrap(steps: int, moved: int):
    assert step_of(wrapped(steps), wrapped(steps + moved)) == moved
