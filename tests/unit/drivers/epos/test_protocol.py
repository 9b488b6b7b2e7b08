"""Frames against the worked exchanges, object widths, power states."""

import subprocess
import sys

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from monstertruck_drivers.epos import objects as od
from monstertruck_drivers.epos.objects import OBJECTS, ObjectEntry
from monstertruck_drivers.epos.protocol import (
    ANSWER,
    Control,
    Frame,
    FrameError,
    NmtCommand,
    ObjectSegment,
    Opcode,
    State,
    answer,
    body_size,
    crc,
    decode_body,
    decode_segment,
    error_of,
    join,
    next_control,
    read_request,
    segment_request,
    segmented_read_request,
    state_of,
    stop_frames,
    write_request,
)

READS = {
    (od.SOFTWARE_VERSION, 2): "01 03 20 01 02 88 A8",
    (od.SOFTWARE_VERSION, 1): "01 03 20 01 01 DB FD",
    (od.SOFTWARE_VERSION, 0): "01 03 20 01 00 EA CE",
    (od.STATUSWORD, 1): "01 41 60 00 01 AB F0",
    (od.VELOCITY_AVERAGED, 1): "01 28 20 00 01 CD 9B",
    (od.VELOCITY, 1): "01 6C 60 00 01 3C 34",
    (od.POSITION, 1): "01 64 60 00 01 9D 9D",
    (od.CURRENT, 1): "01 78 60 00 01 9F AB",
    (od.ERROR_COUNT, 1): "01 03 10 00 01 13 C1",
    (od.ERROR_HISTORY[0], 1): "01 03 10 01 01 32 D1",
    (od.ERROR_REGISTER, 1): "01 01 10 00 01 73 AF",
    (od.DIGITAL_INPUTS, 1): "01 71 20 01 01 B3 4B",
}
WRITES = {
    (od.MODE, 3): "03 60 60 00 01 03 00 00 00 C5 F4",
    (od.CONTROLWORD, Control.SHUTDOWN): "03 40 60 00 01 06 00 00 00 C3 71",
    (od.CONTROLWORD, Control.SWITCH_ON): "03 40 60 00 01 07 00 00 00 F3 46",
    (od.CONTROLWORD, Control.ENABLE): "03 40 60 00 01 0F 00 00 00 52 EF",
    (od.CONTROLWORD, Control.HALT): "03 40 60 00 01 0F 01 00 00 E6 99",
    (od.CONTROLWORD, Control.QUICK_STOP): "03 40 60 00 01 02 00 00 00 03 AD",
    (od.CONTROLWORD, Control.DISABLE_VOLTAGE): "03 40 60 00 01 00 00 00 00 63 C3",
    (od.CONTROLWORD, Control.FAULT_RESET): "03 40 60 00 01 80 00 00 00 39 F8",
    (od.TARGET_VELOCITY, 1000): "03 FF 60 00 01 E8 03 00 00 B2 29",
    (od.TARGET_VELOCITY, -1000): "03 FF 60 00 01 18 FC FF FF 4C 9C",
    (od.ACCELERATION, 5000): "03 83 60 00 01 88 13 00 00 74 7F",
    (od.QUICK_STOP_DECELERATION, 10000): "03 85 60 00 01 10 27 00 00 D1 E9",
}
ANSWERS = {
    "03 00 00 00 00 37 03 00 00 AD F6": (od.STATUSWORD, 0x0337),
    "03 00 00 00 00 E6 03 00 00 09 A4": (od.VELOCITY, 998),
    "03 00 00 00 00 1A FC FF FF 96 64": (od.VELOCITY, -998),
    "03 00 00 00 00 40 01 00 00 5D 46": (od.STATUSWORD, 0x0140),
    "03 00 00 00 00 08 01 00 00 51 F2": (od.STATUSWORD, 0x0108),
    "03 00 00 00 00 10 32 00 00 A6 AF": (od.ERROR_HISTORY[0], od.OVER_VOLTAGE),
}

words = st.lists(st.integers(0, 0xFFFF), min_size=1, max_size=63).map(tuple)
bytes_ = st.integers(0, 255)


def test_published_checksums():
    assert crc((0x0260, 0xB001, 0x0030)) == 0x622E
    assert crc((0x0400, 0, 0, 0x9001, 0)) == 0x5C9A
    assert crc((0x1001, 0x2003, 0x0201)) == 0xA888


@pytest.mark.parametrize(("what", "text"), READS.items(), ids=str)
def test_reads(what: tuple[ObjectEntry, int], text: str):
    frame = read_request(*what)
    assert frame.head == b"\x10"
    assert frame.body == bytes.fromhex(text)


@pytest.mark.parametrize(("what", "text"), WRITES.items(), ids=str)
def test_writes(what: tuple[ObjectEntry, int], text: str):
    frame = write_request(*what, node=1)
    assert frame.head == b"\x11"
    assert frame.body == bytes.fromhex(text)


@pytest.mark.parametrize(("text", "meaning"), ANSWERS.items())
def test_answers(text: str, meaning: tuple[ObjectEntry, int]):
    entry, value = meaning
    frame = decode_body(ANSWER, bytes.fromhex(text))
    assert error_of(frame) == 0
    assert entry.decode(join(*frame.words[2:])) == value
    assert frame.body == bytes.fromhex(text)


def test_answers_without_data():
    assert answer().body == bytes.fromhex("01 00 00 00 00 51 AA")
    assert answer(od.NO_OBJECT).body == bytes.fromhex("01 00 00 02 06 B5 20")
    assert error_of(answer(od.NO_OBJECT)) == 0x06020000
    with pytest.raises(FrameError, match="error code"):
        error_of(Frame(ANSWER, (0,)))


def test_network_and_segment_requests():
    reset = Frame(Opcode.NMT, (1, NmtCommand.RESET_NODE))
    assert reset.head + reset.body == bytes.fromhex("0E 01 01 00 81 00 6B 9C")
    assert segmented_read_request(od.SERIAL_NUMBER, 1) == Frame(Opcode.INITIATE_SEGMENTED_READ, (0x2004, 0x0100))
    assert segment_request(False).words == (0x00,)
    assert segment_request(True).words == (0x40,)


def test_stop_frames_are_quick_stop_then_power_off():
    assert [frame.body.hex(" ").upper() for frame in stop_frames(1)] == [
        WRITES[od.CONTROLWORD, Control.QUICK_STOP],
        WRITES[od.CONTROLWORD, Control.DISABLE_VOLTAGE],
    ]


@settings(max_examples=60)
@given(bytes_, words)
def test_every_frame_survives_the_wire(opcode: int, data: tuple[int, ...]):
    body = Frame(opcode, data).body
    assert len(body) == 1 + body_size(body[0])
    assert decode_body(opcode, body) == Frame(opcode, data)


@settings(max_examples=60)
@given(words, st.data())
def test_a_flipped_bit_is_always_noticed(data: tuple[int, ...], draw: st.DataObject):
    body = bytearray(Frame(ANSWER, data).body)
    at = draw.draw(st.integers(0, 8 * len(body) - 1))
    body[at // 8] ^= 1 << at % 8
    with pytest.raises(FrameError):
        decode_body(ANSWER, bytes(body))


@settings(max_examples=100)
@given(st.binary(max_size=140))
def test_garbage_is_refused_or_a_frame(data: bytes):
    try:
        frame = decode_body(ANSWER, data)
    except FrameError:
        return
    assert frame.body == data


@pytest.mark.parametrize(
    "segment",
    [ObjectSegment(b"", False, False), ObjectSegment(b"abc", True, True), ObjectSegment(b"abcd", True, False)],
)
def test_segments(segment: ObjectSegment):
    assert decode_segment(segment.words) == segment


def test_short_segments_are_refused():
    for data in ((), (0x0005,)):
        with pytest.raises(FrameError, match="segment"):
            decode_segment(data)


@settings(max_examples=60)
@given(st.sampled_from([entry for entry in OBJECTS.values() if entry.width <= 32]), st.data())
def test_values_survive_and_are_cut_to_their_width(entry: ObjectEntry, draw: st.DataObject):
    value = draw.draw(st.integers(*entry.limits))
    raw = entry.encode(value)
    assert 0 <= raw < 2**32
    assert entry.decode(raw) == value
    junk = draw.draw(st.integers(0, 2**32 - 1)) << entry.width & 0xFFFFFFFF
    assert entry.decode((raw & (1 << entry.width) - 1) | junk) == value


def test_a_value_too_big_for_its_object_is_refused():
    assert od.MODE.encode(-2) == 0xFFFFFFFE
    with pytest.raises(ValueError, match=r"0x6060/0 \(mode of operation\): 128 is outside -128..127"):
        od.MODE.encode(128)
    with pytest.raises(ValueError, match="outside"):
        od.STATUSWORD.encode(-1)


@pytest.mark.parametrize("state", [state for state in State if state is not State.UNKNOWN])
def test_states_ignore_bits_outside_the_mask(state: State):
    assert state_of(state.value) is state
    assert state_of(state.value | 0x3E80) is state


def test_unlisted_states_are_unknown():
    assert state_of(0x0337) is State.ENABLED
    assert state_of(0x0001) is State.UNKNOWN


def path(state: State, goal: State, reached: dict[tuple[State, Control], State]) -> list[Control]:
    steps = []
    while control := next_control(state, goal):
        steps.append(control)
        state = reached[state, control]
    return steps


def test_bring_up_goes_through_every_state():
    reached = {
        (State.SWITCH_ON_DISABLED, Control.SHUTDOWN): State.READY,
        (State.READY, Control.SWITCH_ON): State.SWITCHED_ON,
        (State.SWITCHED_ON, Control.ENABLE): State.ENABLED,
        (State.QUICK_STOP, Control.ENABLE): State.ENABLED,
    }
    up = [Control.SHUTDOWN, Control.SWITCH_ON, Control.ENABLE]
    assert path(State.SWITCH_ON_DISABLED, State.ENABLED, reached) == up
    assert path(State.QUICK_STOP, State.ENABLED, reached) == [Control.ENABLE]
    for passing in (State.REFRESH, State.MEASURE_INIT, State.NOT_READY, State.FAULT, State.UNKNOWN):
        assert next_control(passing, State.ENABLED) is None


@pytest.mark.parametrize("state", [State.READY, State.SWITCHED_ON, State.REFRESH, State.MEASURE_INIT, State.ENABLED])
def test_stops_need_one_step(state: State):
    assert next_control(state, State.QUICK_STOP) is Control.QUICK_STOP
    assert next_control(state, State.SWITCH_ON_DISABLED) is Control.DISABLE_VOLTAGE


def test_states_that_are_safe_already_need_none():
    assert next_control(State.QUICK_STOP, State.QUICK_STOP) is None
    assert next_control(State.SWITCH_ON_DISABLED, State.QUICK_STOP) is None
    assert next_control(State.SWITCH_ON_DISABLED, State.SWITCH_ON_DISABLED) is None
    assert next_control(State.QUICK_STOP, State.SWITCH_ON_DISABLED) is Control.DISABLE_VOLTAGE


def test_texts_of_codes():
    assert od.abort_text(0x0F00FFB9) == "0x0F00FFB9 (wrong node id)"
    assert od.fault_text(0x3210) == "0x3210 (over-voltage)"
    assert od.fault_text(0x1234) == "0x1234 (not documented)"


def test_a_stop_script_can_use_it_without_third_party_packages():
    code = "import sys, monstertruck_drivers.epos.protocol; print(*{name.split('.')[0] for name in sys.modules})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert loaded & {"pydantic", "numpy", "serial", "asyncio", "monstertruck_runtime", "monstertruck_schemas"} == set()
