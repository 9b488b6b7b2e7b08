"""The bytes of LDROBOT's packets."""

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from monstertruck_drivers.ld19.protocol import HEADER, Ld19Packet, Ld19Parser, build, crc8

MANUAL = bytes.fromhex("542C6808AB7EE000E4DC00E2D900E5D500E3D300E4D000E9CD00E4CA00E2C700E9C500E5C200E5C000E5BE823A1A50")

words = st.integers(0, 0xFFFF)

packets = st.builds(Ld19Packet, words, words, st.binary(min_size=36, max_size=36), words, words)


def test_bytes_of_the_manual():
    (packet,) = Ld19Parser().feed(MANUAL)
    assert packet[:2] == (2152, 32427)
    assert packet[3:] == (33470, 6714)
    assert packet.decoded()["distance"].tolist()[:3] == [224, 220, 217]
    assert packet.decoded()["intensity"].tolist()[:3] == [228, 226, 229]
    assert packet.span == 1043
    assert build(packet) == MANUAL


@given(st.lists(packets, max_size=4), st.lists(st.integers(0, 190), max_size=6))
def test_what_is_written_is_read_again_however_it_is_cut(sent, cuts):
    data, parser = b"".join(map(build, sent)), Ld19Parser()
    edges = sorted({0, len(data), *(cut for cut in cuts if cut < len(data))})
    assert [p for a, b in pairwise(edges) for p in parser.feed(data[a:b])] == sent
    assert parser.refused == 0


@given(st.binary(max_size=300) | st.builds(lambda a, b: a + HEADER + b, st.binary(max_size=60), st.binary(max_size=90)))
def test_any_bytes_end_in_packets_or_nothing(data):
    parser = Ld19Parser()
    for packet in parser.feed(data):
        assert build(packet) in data
    again = parser.feed(bytes(94) + MANUAL)
    assert again[-1:] == Ld19Parser().feed(MANUAL)


@given(st.integers(0, 47 * 8 - 1))
def test_one_wrong_bit_is_noticed(bit):
    wrong = bytearray(MANUAL)
    wrong[bit // 8] ^= 1 << bit % 8
    assert Ld19Parser().feed(bytes(wrong)) == []
    assert crc8(MANUAL[:-1]) == MANUAL[-1]
