"""Only whole pictures pass, and every viewer can read them."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image, ImageDraw, ImageFont

from monstertruck_drivers.webcam.driver import TABLES_SEGMENT, complete
from monstertruck_drivers.webcam.emulator import jpeg
from tests.unit.drivers.webcam.pictures import bare, picture, pixels


def test_a_whole_picture_passes_unchanged():
    assert complete(picture()) == picture()


def test_zeros_behind_the_picture_are_cut_off():
    assert complete(picture() + bytes(500)) == picture()


def test_missing_tables_are_put_in():
    """The encoder writes the tables of T.81 annex K, so that the result must show the same pixels."""
    without = bare(picture())
    assert b"\xff\xc4" not in without
    repaired = complete(without)
    assert len(repaired) == len(without) + len(TABLES_SEGMENT)
    np.testing.assert_array_equal(pixels(repaired), pixels(picture()))


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (b"", "0 bytes do not end in FF D9"),
        (picture()[: len(picture()) // 2], "do not end"),
        (picture()[:-1], "do not end"),
        (picture() + b"\x01", "do not end"),
        (picture()[2:], "instead of FF D8"),
        (b"\xff\xd8\xff\xd9", "header ends at"),
        (b"\xff\xd8\xff\xda\x00\x02\xff\xd9", "header ends at"),
        (picture()[:300] + b"\xff\xd9", "header ends at"),
    ],
)
def test_what_is_no_whole_picture_is_refused(data: bytes, text: str):
    with pytest.raises(ValueError, match=text):
        complete(data)


@settings(max_examples=100, deadline=None)
@given(st.data())
def test_any_damage_is_refused_or_passed_but_never_crashes(data: st.DataObject):
    damaged = bytearray(picture())
    for _ in range(data.draw(st.integers(1, 20))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    cut = bytes(damaged[: data.draw(st.integers(0, len(damaged)))])
    for candidate in (bytes(damaged), cut):
        try:
            result = complete(candidate)
        except ValueError:
            continue
        assert result.startswith(b"\xff\xd8")
        assert result.endswith(b"\xff\xd9")
        assert len(result) <= len(candidate) + len(TABLES_SEGMENT)


def test_the_counter_can_be_read():
    image = pixels(jpeg(np.full((480, 640, 3), 128, np.uint8), 4711)).astype(int)[..., 0]

    def likeness(number: int) -> float:
        template = Image.new("L", (640, 480))
        ImageDraw.Draw(template).text((8, 8), f"{number:06d}", fill="white", font=ImageFont.load_default(20))
        crop = np.s_[8:32, 8:90]
        return float(np.abs(np.asarray(template).astype(int)[crop] - image[crop]).mean())

    assert min(range(4700, 4720), key=likeness) == 4711
