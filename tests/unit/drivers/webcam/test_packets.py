"""The emulated camera's line: any cut, any damage."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from monstertruck_drivers.webcam.packets import MAGIC, CameraPacket, PacketKind, PacketParser, decode_mode, encode_mode
from monstertruck_drivers.webcam.source import Mode
from monstertruck_runtime.errors import ProtocolError

packets = st.builds(
    CameraPacket,
    kind=st.sampled_from(PacketKind),
    number=st.integers(0, 2**32 - 1),
    stamp=st.integers(-(2**63), 2**63 - 1),
    payload=st.binary(max_size=60),
)


@settings(max_examples=100, deadline=None)
@given(st.lists(packets, max_size=5), st.integers(1, 30))
def test_packets_survive_any_cut(sent: list[CameraPacket], cut: int):
    data = b"".join(packet.encode() for packet in sent)
    parser = PacketParser()
    got = []
    for at in range(0, len(data), cut):
        piece, missing = data[at : at + cut], parser.missing
        new = parser.feed(piece)
        assert missing >= 1
        assert not new or len(piece) >= missing
        got += new
    assert got == sent


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=200), packets)
def test_garbage_before_a_packet_is_skipped(garbage: bytes, packet: CameraPacket):
    assert PacketParser().feed(garbage + packet.encode())[-1:] in ([packet], [])
    assert PacketParser().feed(garbage.replace(MAGIC[:1], b"") + packet.encode()) == [packet]


def test_a_lost_piece_costs_at_most_two_pictures():
    pictures = [CameraPacket(PacketKind.PICTURE, number, 0, bytes([number]) * 500) for number in range(6)]
    data = bytearray(b"".join(packet.encode() for packet in pictures))
    del data[700:1000]
    got = [packet.number for packet in PacketParser().feed(bytes(data)) if packet in pictures]
    assert got == [0, 3, 4, 5]


def test_a_wrong_header_is_not_believed():
    good = bytearray(CameraPacket(PacketKind.PICTURE, 1, 2, b"abc").encode())
    for at in range(4, 20):
        bad = bytearray(good)
        bad[at] ^= 1
        assert PacketParser().feed(bytes(bad + good)) == [CameraPacket(PacketKind.PICTURE, 1, 2, b"abc")]


def test_garbage_is_not_kept():
    parser = PacketParser()
    for _ in range(100):
        parser.feed(bytes(10_000))
    assert len(parser._buffer) < 10


def test_modes():
    mode = Mode(640, 480, 7.5)
    assert decode_mode(encode_mode(mode)) == mode
    with pytest.raises(ProtocolError):
        decode_mode(b"short")
