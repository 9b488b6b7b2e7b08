"""The codec: documented vectors, round trips, and a parser that survives anything."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from monstertruck_drivers.ax12 import protocol as p
from monstertruck_drivers.ax12.protocol import LONGEST_PACKET, Alarm, Ax12Parser, Packet, Present
from tests.unit.drivers.ax12.rig import instruction, reg_write


def bytes_of(text: str) -> bytes:
    return bytes.fromhex(text)


@pytest.mark.parametrize(("body", "expected"), [("010201", 0xFB), ("0104022B01", 0xCC), ("01050322FF03", 0xD2)])
def test_published_checksums(body: str, expected: int):
    assert p.checksum(bytes_of(body)) == expected


@pytest.mark.parametrize(
    ("packet", "expected"),
    [
        (p.ping(1), "FF FF 01 02 01 FB"),
        (p.read(1, p.PRESENT_TEMPERATURE, 1), "FF FF 01 04 02 2B 01 CC"),
        (p.read(1, p.PRESENT_POSITION, 8), "FF FF 01 04 02 24 08 CC"),
        (p.write(1, p.GOAL_POSITION, bytes_of("FF 01 66 00")), "FF FF 01 07 03 1E FF 01 66 00 70"),
        (
            p.sync_write(p.GOAL_POSITION, {1: p.GOAL_POSITION.encode(511), 2: p.GOAL_POSITION.encode(204)}),
            "FF FF FE 0A 83 1E 02 01 FF 01 02 CC 00 85",
        ),
        (
            p.sync_write(p.GOAL_POSITION, {0: bytes_of("10 00 50 01"), 1: bytes_of("20 02 60 03")}),
            "FF FF FE 0E 83 1E 04 00 10 00 50 01 01 20 02 60 03 67",
        ),
        (reg_write(1, p.GOAL_POSITION, bytes_of("F4 01")), "FF FF 01 05 04 1E F4 01 E2"),
        (instruction(p.BROADCAST, p.Instruction.ACTION), "FF FF FE 02 05 FA"),
        (p.write(p.BROADCAST, p.ID, b"\x01"), "FF FF FE 04 03 03 01 F6"),
        (p.write(1, p.TORQUE_LIMIT, p.TORQUE_LIMIT.encode(1023)), "FF FF 01 05 03 22 FF 03 D2"),
        (p.write(1, p.TORQUE_ENABLE, b"\x01"), "FF FF 01 04 03 18 01 DE"),
        (instruction(1, p.Instruction.RESET), "FF FF 01 02 06 F6"),
        (Packet(1, 0).encode(), "FF FF 01 02 00 FC"),
        (Packet(1, 0, b"\x20").encode(), "FF FF 01 03 00 20 DB"),
        (Packet(1, Alarm.OVERLOAD | Alarm.OVERHEAT).encode(), "FF FF 01 02 24 D8"),
        (Packet(1, Alarm.OVERLOAD).encode(), "FF FF 01 02 20 DC"),
    ],
)
def test_packets_are_the_documented_bytes(packet: bytes, expected: str):
    assert packet == bytes_of(expected)
    assert Ax12Parser().feed(packet)[0].encode() == packet


def test_the_documented_state_of_a_unit():
    (packet,) = Ax12Parser().feed(bytes_of("FF FF 01 0A 00 FF 01 00 00 00 00 6F 24 61"))
    assert packet.unit == 1
    assert packet.code == 0
    assert Present.decode(packet.params) == Present(position=511, speed=0, load=0, voltage=111, temperature=36)


def test_clockwise_is_negative():
    present = Present.decode(bytes((0, 2)) + bytes((0x66, 0x04)) + bytes((0x0A, 0x00)) + b"\x6f\x24")
    assert (present.position, present.speed, present.load) == (512, -102, 10)


@given(st.integers(-1023, 1023))
def test_sign_bit_round_trip(value: int):
    assert p.from_sign_bit(p.to_sign_bit(value)) == value


def test_sign_bit_words_are_limited():
    assert p.to_sign_bit(5000) == 1023
    assert p.to_sign_bit(-5000) == 1023 | 1024


@pytest.mark.parametrize(
    ("value", "steps"),
    [(0, 2), (3, 2), (4, 4), (7, 4), (8, 8), (16, 16), (32, 32), (63, 32), (64, 64), (127, 64), (128, 128), (254, 128)],
)
def test_slope_bands(value: int, steps: int):
    assert p.slope_of(value) == steps


def test_sync_write_needs_rows_of_one_length():
    with pytest.raises(ValueError, match=r"same number.*\[1, 2\]"):
        p.sync_write(p.GOAL_POSITION, {1: b"\x01", 2: b"\x01\x02"})
    with pytest.raises(ValueError, match="same number"):
        p.sync_write(p.GOAL_POSITION, {})


def test_alarm_names():
    assert p.alarm_names(0) == "none"
    assert p.alarm_names(0x24) == "overheat+overload"
    assert p.alarm_names(0x81) == "voltage+0x80"


def test_the_control_table_has_no_overlap():
    used = [register.address + i for register in p.REGISTERS for i in range(register.size)]
    assert len(used) == len(set(used))
    assert max(used) < p.TABLE_SIZE
    assert {r.address for r in p.REGISTERS if r.is_stored} == {0, 2, 3, 4, 5, 6, 8, 11, 12, 13, 14, 16, 17, 18}


packets = st.builds(
    Packet, unit=st.integers(0, 254), code=st.integers(0, 255), params=st.binary(max_size=LONGEST_PACKET - 2)
)


@settings(max_examples=60)
@given(st.lists(packets, max_size=6), st.lists(st.integers(1, 9), min_size=1))
def test_packets_come_out_however_they_are_cut(sent: list[Packet], cuts: list[int]):
    wire = b"".join(packet.encode() for packet in sent)
    parser, got, at = Ax12Parser(), [], 0
    while at < len(wire):
        size = cuts[at % len(cuts)]
        got += parser.feed(wire[at : at + size])
        at += size
    assert got == sent
    assert parser.damaged == []


@settings(max_examples=100)
@given(st.binary(max_size=600))
def test_garbage_is_survived_in_bounded_space(garbage: bytes):
    parser = Ax12Parser()
    parser.feed(garbage)
    assert len(parser) < LONGEST_PACKET + 4


HEAVY = st.lists(st.sampled_from((0xFF, 0xFE, 0x01, 0x02, 0x96)), max_size=300).map(bytes)


@settings(max_examples=100)
@given(HEAVY, st.binary(max_size=20).map(lambda data: Packet(1, 0, data.replace(b"\xff", b"\x00"))))
def test_after_garbage_packets_are_found_once_a_false_header_ran_out(garbage: bytes, packet: Packet):
    parser = Ax12Parser()
    again = (LONGEST_PACKET + 4) // len(packet.encode()) + 2
    assert packet in parser.feed(garbage) + parser.feed(packet.encode() * again)


@pytest.mark.parametrize("cut", range(14))
def test_after_a_cut_or_damaged_answer_the_next_one_is_found(cut: int):
    answer = bytes_of("FF FF 01 0A 00 FF 01 00 00 00 00 6F 24 61")
    damaged = bytearray(answer)
    damaged[cut] ^= 0x08
    for broken in (answer[:cut], bytes(damaged)):
        # As the session does: no longer than what was asked for.
        parser = Ax12Parser(longest=10)
        got = parser.feed(broken) + parser.feed(answer) + parser.feed(answer)
        assert Packet(1, 0, answer[5:-1]) in got


def test_a_wrong_sum_names_the_unit():
    parser = Ax12Parser()
    assert parser.feed(bytes_of("FF FF 01 02 01 FA")) == []
    assert parser.damaged == [1]
    assert parser.feed(p.ping(2)) == [Packet(2, 1)]
    assert parser.damaged == []


def test_header_bytes_inside_parameters_are_data():
    packet = Packet(3, 0, b"\xff\xff\x01\x02\x01\xfb")
    assert Ax12Parser().feed(b"\xff" + packet.encode()) == [packet]
