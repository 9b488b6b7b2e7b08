"""Pictures in streams, heads and chunks, however they are cut."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from monstertruck_drivers.mjpeg.protocol import Dechunker, HttpHead, PictureSplitter, request, size_of
from monstertruck_drivers.webcam.driver import complete

HEADER = b"\xff\xe0\x00\x06\xff\xd9\xff\xd8"
"""A segment with the signs of start and end in it."""
FRAME = b"\xff\xc0\x00\x0b\x08\x00\x78\x00\xa0\x01\x01\x11\x00"


def picture(content=b"content"):
    return b"\xff\xd8" + HEADER + FRAME + b"\xff\xda\x00\x02" + content + b"\xff\xd9"


PICTURES = st.lists(
    st.builds(picture, st.binary(max_size=30).map(lambda data: data.replace(b"\xff", b"\xfe"))), max_size=4
)


def pieces(data, size):
    return [data[i : i + size] for i in range(0, len(data), size)]


@given(PICTURES, st.sampled_from([b"", b"--boundary\r\n\r\n", b"\xff"]), st.integers(1, 50))
def test_pictures_come_out_however_they_are_cut_and_whatever_is_between(sent, between, size):
    splitter = PictureSplitter(1000)
    found = [one for part in pieces(between.join(sent), size) for one in splitter.feed(part)]
    assert found == sent


def test_a_picture_that_is_cut_off_comes_out_for_refusal_and_the_next_one_is_whole():
    found = PictureSplitter(1000).feed(picture()[:-6] + picture(b"next"))
    assert found[1:] == [picture(b"next")]
    with pytest.raises(ValueError, match="do not end in FF D9"):
        complete(found[0])


def test_a_picture_without_an_end_is_dropped_at_the_limit():
    splitter = PictureSplitter(1000)
    found = [one for _ in range(30) for one in splitter.feed(picture()[:-2] + bytes(60) if not _ else bytes(60))]
    assert [len(one) > 1000 for one in found] == [True]
    assert splitter.feed(picture()) == [picture()]


def test_a_damaged_header_costs_that_picture():
    damaged = picture()[:2] + b"\0" + picture()[3:]
    found = PictureSplitter(1000).feed(damaged + picture(b"next"))
    assert found[-1] == picture(b"next")
    assert picture() not in found


@given(st.binary(max_size=300))
def test_any_bytes_give_pieces_of_them_or_nothing(data):
    for piece in PictureSplitter(100).feed(data):
        assert piece in data


def test_the_size_is_in_the_frame_header():
    assert size_of(picture()) == (160, 120)
    assert size_of(b"\xff\xd8\xff\xda\x00\x02") is None


def test_heads():
    fields = b"Content-Type: Multipart/X-Mixed-Replace; boundary=x\r\nTransfer-Encoding: chunked"
    head = HttpHead.of(b"HTTP/1.0 200 OK\r\n" + fields)
    assert head == HttpHead(200, "OK", "multipart/x-mixed-replace", chunked=True, length=None)
    assert HttpHead.of(b"HTTP/1.1 404\r\nContent-Length: 12") == HttpHead(404, "", "", chunked=False, length=12)
    with pytest.raises(ValueError, match=r"begins with 'RTSP/1\.0 200 OK'"):
        HttpHead.of(b"RTSP/1.0 200 OK")
    assert request("/a?b=1", "1.2.3.4:80").startswith(b"GET /a?b=1 HTTP/1.1\r\nHost: 1.2.3.4:80\r\n")


@given(st.lists(st.binary(min_size=1, max_size=20), max_size=5), st.integers(1, 30))
def test_chunks_however_they_are_cut(parts, size):
    sent = b"".join(b"%X;a=b\r\n%s\r\n" % (len(part), part) for part in parts) + b"0\r\n\r\n"
    dechunker = Dechunker()
    assert b"".join(dechunker.feed(part) for part in pieces(sent, size)) == b"".join(parts)


def test_a_chunk_without_a_length():
    for wrong in (b"xyz\r\n", b"\r\n", b"1" * 9000):
        with pytest.raises(ValueError, match="expected the length of a chunk"):
            Dechunker().feed(wrong)
