"""The codec: documented vectors, round trips, and a decoder that survives anything."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from monstertruck_drivers.maestro.protocol import (
    DATA_BYTES,
    Code,
    Decoder,
    Encoder,
    Error,
    ServoCommand,
    crc7,
    error_names,
    halves,
    words,
)


@pytest.mark.parametrize(
    ("data", "crc"), [("8301", 0x17), ("D1016400", 0x68), ("8402702E", 0x18), ("A1", 0x1B), ("AA0C0402702E", 0x11)]
)
def test_published_crc_vectors(data: str, crc: int):
    assert crc7(bytes.fromhex(data)) == crc


@pytest.mark.parametrize(
    ("packet", "expected"),
    [
        (Encoder().set_target(2, 6000), "84 02 70 2E"),
        (Encoder(device=12).set_target(2, 6000), "AA 0C 04 02 70 2E"),
        (Encoder(crc=True).set_target(2, 6000), "84 02 70 2E 18"),
        (Encoder(device=12, crc=True).set_target(2, 6000), "AA 0C 04 02 70 2E 11"),
        (Encoder().get_position(5), "90 05"),
        (Encoder(crc=True).get_position(5), "90 05 02"),
        (Encoder().get_errors(), "A1"),
        (Encoder(crc=True).get_errors(), "A1 1B"),
        (Encoder().set_speed(1, 120), "87 01 78 00"),
        (Encoder(crc=True).set_speed(1, 120), "87 01 78 00 7A"),
        (Encoder().set_acceleration(0, 4), "89 00 04 00"),
        (Encoder().set_target(0, 4352), "84 00 00 22"),
        (Encoder().set_target(1, 7360), "84 01 40 39"),
    ],
)
def test_commands_are_the_documented_bytes(packet: bytes, expected: str):
    assert packet == bytes.fromhex(expected)


def test_answers_are_little_endian_words():
    assert words(bytes.fromhex("04 02 10 00")) == [516, 0x10]


def test_values_beyond_14_bits_are_refused():
    with pytest.raises(ValueError, match="14 bits"):
        halves(16384)


def test_error_names_say_every_bit():
    assert error_names(0) == []
    assert error_names(0x31) == ["serial_signal", "protocol", "serial_timeout"]
    assert error_names(0x200) == ["0x200"]


commands = st.sampled_from(sorted(DATA_BYTES)).flatmap(
    lambda code: st.tuples(
        st.just(code), st.lists(st.integers(0, 127), min_size=DATA_BYTES[code], max_size=DATA_BYTES[code])
    )
)


@given(st.lists(commands), st.sampled_from([None, 12]), st.booleans(), st.integers(1, 5))
@settings(max_examples=100)
def test_what_is_encoded_is_decoded_however_it_is_cut(
    items: list[tuple[int, list[int]]], device: int | None, crc: bool, cut: int
):
    encoder, decoder = Encoder(device, crc), Decoder(12, crc)
    stream = b"".join(encoder.command(code, *data) for code, data in items)
    seen = [item for i in range(0, len(stream), cut) for item in decoder.feed(stream[i : i + cut])]
    assert seen == [ServoCommand(Code(code), tuple(data)) for code, data in items]


@given(st.binary(max_size=200), st.booleans())
@settings(max_examples=100)
def test_the_decoder_recovers_from_any_garbage(garbage: bytes, crc: bool):
    decoder = Decoder(12, crc)
    decoder.feed(garbage)
    decoder.feed(b"\xa1\x1b" if crc else b"\xa1")  # at worst this ends what was open
    assert decoder.feed(Encoder(crc=crc).set_target(3, 5000))[-1] == ServoCommand(Code.SET_TARGET, (3, 8, 39))


@pytest.mark.parametrize(
    ("stream", "expected"),
    [
        (b"A", [Error.PROTOCOL]),  # data outside a command
        (bytes.fromhex("84 02 A1"), [Error.PROTOCOL, ServoCommand(Code.GET_ERRORS)]),  # interrupted
        (bytes.fromhex("9F 02 00 70 2E"), [Error.PROTOCOL]),  # Mini only, its data belong to it
        (bytes.fromhex("AA 07 21 AA 0C 21"), [ServoCommand(Code.GET_ERRORS)]),  # another device number
        (bytes.fromhex("FF 03 FE"), [ServoCommand(Code.MINI_SSC, (3, 254))]),
        (bytes.fromhex("FF 03 FF"), [Error.PROTOCOL]),
    ],
)
def test_bytes_against_the_protocol(stream: bytes, expected: list[object]):
    assert Decoder().feed(stream) == expected


def test_a_wrong_crc_is_an_error_and_no_command():
    assert Decoder(crc=True).feed(bytes.fromhex("84 02 70 2E 19 A1 1B")) == [Error.CRC, ServoCommand(Code.GET_ERRORS)]


def test_a_command_knows_its_14_bit_value():
    assert ServoCommand(Code.SET_TARGET, (2, 0x70, 0x2E)).value == 6000
