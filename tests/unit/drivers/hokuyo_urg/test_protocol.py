"""The SCIP codec: worked examples, round trips, resynchronisation, statuses, ranges."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from monstertruck_drivers.hokuyo_urg.protocol import (
    MAX_REPLY,
    Reply,
    ScipParser,
    StatusMeaning,
    build_reply,
    classify,
    decode,
    decode_array,
    decode_counter,
    decode_scan,
    encode,
    encode_array,
    line_sum,
    request,
    scan_command,
    scip1_scan_command,
    split_ranges,
    sum_matches,
    unwrap_lines,
    wrap_lines,
)
from monstertruck_runtime.errors import ProtocolError

ACK = b"MD0384038801002\n00P\n\n"
BEFORE_WRAP = b"MD0384038801001\n99b\nooo`]\n0CB0CH00000C0ooa\n\n"
AFTER_WRAP = b"MD0384038801000\n99b\n001DE\n0CB0CH00000C0ooa\n\n"
WORKED = ACK + BEFORE_WRAP + AFTER_WRAP


@pytest.mark.parametrize(
    ("text", "check"),
    [
        *[("00", "P"), ("01", "Q"), ("02", "R"), ("03", "S"), ("0B", "b"), ("0E", "e"), ("10", "Q"), ("99", "b")],
        *[
            ("AMIN:44", "7"),
            ("LASR:OFF", "7"),
            ("LASR:ON", "9"),
            ("JUGn", "D"),
            ("DMAX:5600", "_"),
            ("ARES:1024", "\\"),
        ],
    ],
)
def test_line_sums(text: str, check: str):
    assert line_sum(text.encode()) == ord(check)


def test_a_sum_may_count_the_semicolon_or_not():
    assert sum_matches(b"AMIN:44;7")
    assert sum_matches(b"AMIN:44;" + bytes((line_sum(b"AMIN:44;"),)))
    assert not sum_matches(b"AMIN:44;8")
    assert not sum_matches(b"AMIN:457")
    assert not sum_matches(b"")


@pytest.mark.parametrize(
    ("value", "text"),
    [(1234, b"CB"), (5432, b"1Dh"), (16_000_000, b"m2@0"), (16_777_215, b"oooo"), (6_968_830, b"JUGn")],
)
def test_published_numbers(value: int, text: bytes):
    assert encode(value, len(text)) == text
    assert decode(text) == value


@given(st.integers(2, 4), st.data())
def test_numbers_return(width: int, data: st.DataObject):
    values = data.draw(st.lists(st.integers(0, (1 << 6 * width) - 1), max_size=50))
    payload = b"".join(encode(value, width) for value in values)
    array = np.array(values, np.int32)
    assert encode_array(array, width) == payload
    assert decode_array(payload, width).tolist() == values
    assert unwrap_lines(wrap_lines(payload)) == payload
    assert all(len(line) <= 65 and sum_matches(line) for line in wrap_lines(payload))


@pytest.mark.parametrize("value", [-1, 4096])
def test_numbers_that_do_not_fit(value: int):
    with pytest.raises(ValueError, match="does not fit"):
        encode(value, 2)


@pytest.mark.parametrize("text", [b"0/", b"0p", b"\xff0"])
def test_bytes_outside_the_encoding(text: bytes):
    with pytest.raises(ProtocolError):
        decode(text)
    with pytest.raises(ProtocolError, match="outside"):
        decode_array(text, 2)


def test_numbers_cut_short():
    with pytest.raises(ProtocolError, match="whole number"):
        decode_array(b"0000", 3)


def test_requests():
    assert request("VV") == b"VV\n"
    assert request(scan_command("MD", 384, 388, 1, 0, 2)) == b"MD0384038801002\n"
    assert request(scan_command("MS", 44, 725, 3, 1), "truck") == b"MS0044072503100;truck\n"
    assert scip1_scan_command(0, 768) == "G00076801"


@pytest.mark.parametrize("make", [lambda: request("VV", "x" * 17), lambda: request("V\nV"), lambda: request("")])
def test_requests_that_would_be_refused(make: object):
    with pytest.raises(ValueError):  # noqa: PT011
        make()  # type: ignore[operator]


def test_parameters_out_of_their_digits():
    with pytest.raises(ValueError, match="skip 10"):
        scan_command("MD", 0, 768, skip=10)
    with pytest.raises(ValueError, match="end 1000"):
        scip1_scan_command(0, 1000)


# Replies


def test_worked_scan_across_the_wrap():
    ack, before, after = ScipParser().feed(WORKED)
    assert (ack.echo, ack.status, ack.lines) == ("MD0384038801002", "00", [])
    assert all(reply.answers_scan("MD0384038801002") for reply in (ack, before, after))
    assert not ack.answers_scan("MD0384038901002")
    blocks = [decode_scan(reply, 384, 388) for reply in (before, after)]
    assert [block.counter for block in blocks] == [16_777_200, 84]
    assert (blocks[1].counter - blocks[0].counter) & 0xFFFFFF == 100
    for block in blocks:
        assert block.values.tolist() == [1234, 1240, 0, 19, 4095]


def test_two_character_scan():
    (reply,) = ScipParser().feed(b"MS0384038801001\n99b\nooo`]\nCBCH000Coo1\n\n")
    assert decode_scan(reply, 384, 388).values.tolist() == [1234, 1240, 0, 19, 4095]


def test_first_line_of_the_captured_scan():
    line = b"06806806706105m05m05h05c05c05c05`05]05Z05W05W05U05S05O05S05P05P0_"
    values = decode_array(unwrap_lines([line])[:63], 3)
    assert values[:4].tolist() == [392, 392, 391, 385]
    assert values[-1] == 352


def test_scip1_replies():
    version, laser, refused, scan = ScipParser().feed(b"V\n0\nVEND:X\n\nL1\n0\n\nQT\nE\n\nG00000401\n0\nCBCH000Coo\n\n")
    assert version.scip1
    assert version.lines == [b"VEND:X"]
    assert (laser.echo, laser.status) == ("L1", "0")
    assert refused.status == "E"
    block = decode_scan(scan, 0, 4)
    assert block.counter is None
    assert block.values.tolist() == [1234, 1240, 0, 19, 4095]


@given(st.lists(st.integers(1, 30), max_size=120))
def test_replies_do_not_depend_on_the_pieces(sizes: list[int]):
    parser, replies, at = ScipParser(), [], 0
    for size in [*sizes, len(WORKED)]:
        replies += parser.feed(WORKED[at : at + size])
        at += size
    assert replies == ScipParser().feed(WORKED)


@settings(max_examples=100)
@given(st.binary(max_size=300))
def test_any_bytes_before_are_survived(garbage: bytes):
    parser = ScipParser()
    parser.feed(garbage)
    parser.feed(b"\n\n")
    assert parser.feed(WORKED) == ScipParser().feed(WORKED)


@settings(max_examples=100)
@given(st.binary(max_size=100))
def test_garbage_glued_to_a_reply_costs_nothing(garbage: bytes):
    found = ScipParser().feed(garbage + WORKED)
    assert found[-3:] == ScipParser().feed(WORKED)


@settings(max_examples=100)
@given(st.integers(0, len(BEFORE_WRAP) - 1), st.integers(0, 7))
def test_a_flipped_bit_never_changes_a_range(at: int, bit: int):
    damaged = bytearray(BEFORE_WRAP)
    damaged[at] ^= 1 << bit
    values = []
    for reply in ScipParser().feed(bytes(damaged) + AFTER_WRAP):
        if reply.answers_scan("MD0384038801002") and reply.status == "99":
            try:
                values.append(decode_scan(reply, 384, 388))
            except ProtocolError:
                continue
    assert values
    assert values[-1].counter == 84
    for block in values:
        assert block.values.tolist() == [1234, 1240, 0, 19, 4095]
        assert block.counter in (84, 16_777_200)


@settings(max_examples=100)
@given(st.integers(0, len(BEFORE_WRAP)))
def test_a_block_cut_anywhere_spares_the_next(at: int):
    replies = ScipParser().feed(BEFORE_WRAP[:at] + AFTER_WRAP)
    assert decode_scan(replies[-1], 384, 388).counter == 84


def test_the_buffer_is_bounded():
    parser = ScipParser()
    for _ in range(100):
        parser.feed(b"x" * 1000)
        assert len(parser._buffer) <= MAX_REPLY
    assert parser.rejected > 0
    assert len(parser.feed(b"\n\n" + WORKED)) == 3


def test_reset_forgets_half_a_reply():
    parser = ScipParser()
    parser.feed(b"VV\n00P\nVEND")
    parser.reset()
    assert [reply.echo for reply in parser.feed(b"QT\n00P\n\n")] == ["QT"]


def test_a_bad_status_sum_is_rejected():
    parser = ScipParser()
    assert parser.feed(b"QT\n00Q\n\n") == []
    assert parser.rejected == 1
    assert parser.replies == 0


def test_an_empty_line_within_vv_is_bridged():
    first, second = ScipParser().feed(b"VV\n00P\nVEND:X;h\n\nSERI:1;b\n\n")
    assert (first.echo, second.echo) == ("VV", "VV")
    assert second.lines == [b"SERI:1;b"]


def test_build_reply_is_read_back():
    replies = ScipParser().feed(build_reply("QT;abc", "00") + build_reply("V", "0", [b"VEND:X"]))
    assert replies == [Reply("QT;abc", "00", []), Reply("V", "0", [b"VEND:X"])]


# Scans that are refused


@pytest.mark.parametrize(
    "block",
    [
        b"MD0384038801001\n99b\nooo`]\n0CB0CH00000C0ooa\n\n".replace(b"0CB", b"0CC"),
        b"MD0384038801001\n99b\nooo`^\n0CB0CH00000C0ooa\n\n",
        b"MD0384038801001\n99b\nooo]\n0CB0CH00000C0ooa\n\n",
        b"MD0384038801001\n99b\nooo`]\n\n",
        b"VV\n00P\nVEND:X;h\nSERI:1;b\n\n",
        b"MD0384038801001\n99b\nooo`]\n0CB0CH" + bytes((line_sum(b"0CB0CH"),)) + b"\n\n",
    ],
    ids=["data sum", "time sum", "time short", "no data", "no scan", "too few"],
)
def test_damaged_scans(block: bytes):
    (reply,) = ScipParser().feed(block)
    with pytest.raises(ProtocolError):
        decode_scan(reply, 384, 388)


def test_an_overlong_line_is_refused():
    text = b"0" * 65
    with pytest.raises(ProtocolError):
        unwrap_lines([text + bytes((line_sum(text),))])


def test_a_counter_of_the_wrong_length():
    with pytest.raises(ProtocolError):
        decode_counter(b"")


@pytest.mark.parametrize("count", [1, 2])
def test_a_partial_last_cluster_may_be_there_or_not(count: int):
    lines = [b"0000" + bytes((line_sum(b"0000"),)), *wrap_lines(encode_array(np.full(count, 700), 3))]
    reply = Reply("MD0000000403000", "99", lines)
    assert len(decode_scan(reply, 0, 4, cluster=3).values) == count


# Statuses and codes


@pytest.mark.parametrize(
    ("command", "status", "outcome"),
    [
        ("QT", "00", StatusMeaning.OK),
        ("L1", "0", StatusMeaning.OK),
        ("SCIP2.0", "E", StatusMeaning.BAD_REQUEST),
        ("MD", "0A", StatusMeaning.FAULT),
        ("MD", "0B", StatusMeaning.BUSY),
        ("VV", "0I", StatusMeaning.UPDATE_MODE),
        ("QT", "0E", StatusMeaning.BAD_REQUEST),
        ("BM", "01", StatusMeaning.FAULT),
        ("BM", "02", StatusMeaning.ALREADY),
        ("BM", "0C", StatusMeaning.BAD_REQUEST),
        ("TM0", "02", StatusMeaning.ALREADY),
        ("TM2", "03", StatusMeaning.ALREADY),
        ("TM1", "04", StatusMeaning.BAD_REQUEST),
        ("SS019200", "03", StatusMeaning.ALREADY),
        ("SS019200", "04", StatusMeaning.BAD_REQUEST),
        ("MD", "01", StatusMeaning.BAD_REQUEST),
        ("GD", "10", StatusMeaning.LASER_OFF),
        ("MD", "21", StatusMeaning.VERIFYING),
        ("MS", "49", StatusMeaning.VERIFYING),
        ("MD", "50", StatusMeaning.FAULT),
        ("MD", "97", StatusMeaning.FAULT),
        ("MD", "98", StatusMeaning.RESUMED),
        ("MD", "99", StatusMeaning.DATA),
        ("VV", "99", StatusMeaning.BAD_REQUEST),
    ],
)
def test_statuses(command: str, status: str, outcome: StatusMeaning):
    assert classify(command, status) is outcome


def test_values_below_the_least_range_are_codes():
    ranges, codes = split_ranges(np.array([0, 7, 19, 20, 5600], np.int32), 20)
    assert ranges.tolist() == [np.inf, np.inf, np.inf, 0.02, 5.6]
    assert codes.tolist() == [0, 7, 19, 255, 255]
    assert codes.dtype == np.uint8


def test_a_code_is_never_mistaken_for_valid():
    _, codes = split_ranges(np.array([255, 299], np.int32), 300)
    assert codes.tolist() == [254, 254]
