"""The bytes of SLAMTEC's requests and samples."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from monstertruck_drivers.rplidar.protocol import (
    SIZES,
    DataType,
    Descriptor,
    Record,
    RecordParser,
    RplidarCommand,
    RplidarIdentity,
    build_capsule,
    build_descriptor,
    build_express,
    build_info,
    build_standard,
    build_ultra,
    decode_capsule,
    decode_standard,
    express_request,
    parse_descriptor,
    parse_info,
    request,
    ultra_decode,
    ultra_distances,
    ultra_encode,
)

CAPSULES = (DataType.EXPRESS, DataType.ULTRA, DataType.DENSE)


def test_bytes_of_the_protocol_document():
    assert request(RplidarCommand.STOP) == bytes.fromhex("a525")
    assert request(RplidarCommand.SCAN) == bytes.fromhex("a520")
    assert express_request(0) == bytes.fromhex("a58205000000000022")
    assert request(RplidarCommand.MOTOR_PWM, (660).to_bytes(2, "little")) == bytes.fromhex("a5f00294 02c1")
    for data, expected in (
        ("a55a1400000004", Descriptor(20, False, DataType.INFO)),
        ("a55a0300000006", Descriptor(3, False, DataType.HEALTH)),
        ("a55a0500004081", Descriptor(5, True, DataType.STANDARD)),
        ("a55a5400004082", Descriptor(84, True, DataType.EXPRESS)),
        ("a55a8400004084", Descriptor(132, True, DataType.ULTRA)),
    ):
        assert parse_descriptor(bytes.fromhex(data)) == expected
        assert build_descriptor(expected).hex() == data
    identity = RplidarIdentity(0x18, (1, 29), 7, "7DED9A87C5E392D3A5E49EF0ED383D65")
    assert parse_info(build_info(identity)) == identity


def test_a_standard_sample_by_hand():
    """Quality 15, 90 degrees, 1234.25 mm, beginning of a turn."""
    data = bytes((15 << 2 | 1, (90 * 64 & 0x7F) << 1 | 1, 90 * 64 >> 7, 4937 & 0xFF, 4937 >> 8))
    turns, ranges, qualities = decode_standard(data)
    assert (turns.tolist(), ranges.tolist(), qualities.tolist()) == ([0.25], [1.23425], [15])


@given(st.lists(st.tuples(st.floats(0, 0.999), st.integers(0, 16383), st.integers(0, 63)), min_size=1, max_size=40))
def test_standard_samples_are_read_as_they_were_written(rows):
    turns, far, quality = (np.array(column) for column in zip(*rows, strict=True))
    data = build_standard(turns, far, quality, np.arange(len(rows)) == 0)
    (record,) = RecordParser(DataType.STANDARD).feed(data)
    found = decode_standard(record.data)
    assert np.abs(np.mod(found.turns - turns + 0.5, 1.0) - 0.5).max() <= 0.5 / 23040 + 1e-9
    assert found.ranges.tolist() == (np.minimum(far * 4, 0xFFFF) / 4000).tolist()
    assert found.qualities.tolist() == quality.tolist()


def body_of(kind, values):
    if kind is DataType.EXPRESS:
        return build_express(np.minimum(values[:32], 16383), values[32:64] % 64)
    return build_ultra(values[:97]) if kind is DataType.ULTRA else values[:40].astype("<u2").tobytes()


@settings(max_examples=40, deadline=None)
@given(kind=st.sampled_from(CAPSULES), seed=st.integers(0, 999), cuts=st.lists(st.integers(0, 400), max_size=6))
def test_records_are_read_again_however_they_are_cut(kind, seed, cuts):
    rng, parser = np.random.default_rng(seed), RecordParser(kind)
    sent = [(int(rng.integers(23040)), body_of(kind, rng.integers(0, 16000, 97)), bool(i == 0)) for i in range(3)]
    data = b"".join(build_capsule(start, body, fresh=fresh) for start, body, fresh in sent)
    edges = sorted({0, len(data), *(cut for cut in cuts if cut < len(data))})
    found = [record for a, b in pairwise(edges) for record in parser.feed(data[a:b])]
    assert found == [Record(start, fresh, body) for start, body, fresh in sent]
    assert parser.refused == 0
    assert len(data) == 3 * SIZES[kind]


@given(kind=st.sampled_from([DataType.STANDARD, *CAPSULES]), data=st.binary(max_size=500))
def test_any_bytes_end_in_records_or_nothing_and_the_stream_is_found_again(kind, data):
    parser = RecordParser(kind)
    parser.feed(data)
    if kind is DataType.STANDARD:
        again = build_standard(np.arange(200) / 200, np.full(200, 900), np.full(200, 9), np.zeros(200, bool))
    else:
        again = build_capsule(64, body_of(kind, np.full(97, 900)), fresh=False) * 3
    found = parser.feed(bytes(140) + again)
    assert found[-1].data[-5:] == again[-5:]


def test_express_samples_lie_between_two_beginnings_less_their_own_angle():
    body = build_express(np.arange(1000, 1032), np.full(32, 40))
    found = decode_capsule(DataType.EXPRESS, Record(359 * 64, False, body), Record(7 * 64, False, body))
    assert found.ranges.tolist() == (np.arange(1000, 1032) / 1000).tolist()
    degrees = np.mod(359 + np.arange(32) * 8 / 32 - 5, 360)
    assert (found.turns * 360) == pytest.approx(degrees, abs=1e-9)


@given(st.lists(st.integers(1, 24000), min_size=97, max_size=97))
def test_ultra_distances_keep_what_their_codes_hold(values):
    near = np.array(values)
    smooth = 2000 + near % 300
    for far, exact in ((smooth, True), (near, False)):
        found = ultra_distances(build_ultra(far), build_ultra(np.append(far[96:], far[:96])))
        wrong = np.abs(found - far[:96])
        assert (wrong[::3] < 16).all()
        assert (wrong[found > 0] < 16).all(), "a difference too great is no return"
        if exact:
            assert (found > 0).all()
            assert wrong.max() < 4


def test_ultra_codes_by_their_levels():
    far = np.array([0, 300, 511, 512, 2047, 2048, 4095, 4096, 16383, 16384, 28000])
    codes = ultra_encode(far)
    assert codes[[1, 3, 5, 7, 9]].tolist() == [300, 512, 1280, 1792, 3328]
    distances, levels = ultra_decode(codes)
    assert levels.tolist() == [0, 0, 0, 1, 1, 2, 2, 3, 3, 4, 4]
    assert (far - distances).max() < 16
