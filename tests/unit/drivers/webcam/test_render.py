"""What the pictures show."""

import io
import math

import numpy as np
import pytest
from PIL import Image, ImageDraw, ImageFont

from monstertruck_drivers.webcam.driver import complete
from monstertruck_drivers.webcam.emulator import FONT_SIZE, Renderer
from monstertruck_drivers.webcam.source import Mode
from tests.unit.drivers.webcam.pictures import pixels

MODE = Mode(640, 480, 15.0)


def flat(distance: float, renderer: Renderer) -> np.ndarray:
    """Ranges of a wall across the camera's axis."""
    return distance / np.cos(renderer.angles)


def wall_rows(renderer: Renderer, ranges: np.ndarray, column: int = 320) -> int:
    """Rows of a column that differ from the empty plain's."""
    empty = pixels(renderer.jpeg(np.full(len(ranges), np.inf), 0)).astype(int)
    seen = pixels(renderer.jpeg(ranges, 0)).astype(int)
    return int((np.abs(seen - empty)[:, column].sum(axis=1) > 40).sum())


def test_angles_run_from_left_to_right_over_the_field_of_view():
    renderer = Renderer(MODE, field_of_view=math.radians(60))
    assert renderer.angles[0] == pytest.approx(math.radians(30), abs=0.002)
    assert renderer.angles[-1] == -renderer.angles[0]
    assert np.all(np.diff(renderer.angles) < 0)


def test_a_walls_height_in_pixels_is_its_height_over_its_distance():
    renderer = Renderer(MODE, wall_height=0.6)
    focal = 320 / math.tan(math.radians(31.5))
    for distance in (1.0, 2.0, 4.0):
        assert wall_rows(renderer, flat(distance, renderer)) == pytest.approx(focal * 0.6 / distance, abs=4)


def test_a_wall_across_the_axis_is_a_rectangle_without_fish_eye():
    renderer = Renderer(MODE)
    ranges = flat(2.0, renderer)
    assert wall_rows(renderer, ranges, 5) == pytest.approx(wall_rows(renderer, ranges, 320), abs=3)


def test_something_on_the_left_is_drawn_on_the_left_and_near_is_brighter():
    renderer = Renderer(MODE)
    image = pixels(renderer.jpeg(np.where(renderer.angles > 0, 1.0, 4.0), 0)).astype(int)
    assert image[240, 100].sum() > image[240, 540].sum() + 50


def test_touching_a_wall_fills_the_picture_and_nothing_overflows():
    renderer = Renderer(MODE)
    image = pixels(renderer.jpeg(np.zeros(640), 0)).astype(int)
    assert np.ptp(image[60:, :, 0]) < 10


def test_the_counter_can_be_read():
    renderer = Renderer(MODE)
    image = pixels(renderer.jpeg(np.full(640, np.inf), 4711)).astype(int)[..., 0]

    def likeness(number: int) -> float:
        template = Image.new("L", (640, 480))
        ImageDraw.Draw(template).text((8, 8), f"{number:06d}", fill="white", font=ImageFont.load_default(FONT_SIZE))
        crop = np.s_[8:32, 8:90]
        return float(np.abs(np.asarray(template).astype(int)[crop] - image[crop]).mean())

    assert min(range(4700, 4720), key=likeness) == 4711


def test_every_size_is_a_whole_picture():
    for width, height in ((160, 120), (1600, 1200)):
        renderer = Renderer(Mode(width, height, 15.0))
        data = renderer.jpeg(flat(2.0, renderer), 1)
        assert complete(data) == data
        assert Image.open(io.BytesIO(data)).size == (width, height)
