"""Tags in pictures: where they are before the camera, and what is refused."""

import math
from typing import get_args

import numpy as np
import pytest

from monstertruck_drivers.webcam.emulator import jpeg
from monstertruck_estimation.points.exchange import ReadTask
from monstertruck_estimation.points.reader import ReadingStep
from monstertruck_estimation.vision.lens import Lens
from monstertruck_estimation.vision.tags import drawn
from monstertruck_schemas.board import TagFamily
from monstertruck_schemas.body import LensConfig
from monstertruck_sim.world.camera import Painter, mounted, tag_panel
from monstertruck_sim.world.config import CameraConfig, TagConfig

SIZE = (640, 480)
LENS = CameraConfig(k1=-0.15, k2=0.03)
BELIEVED = LensConfig(k1=-0.15, k2=0.03)


def picture(*tags: TagConfig, noise: float = 3.0) -> bytes:
    """Of a camera at the origin, 0.25 m over the ground, that looks along x."""
    painter = Painter(LENS, SIZE, 0.6)
    place = mounted((-LENS.x, 0.0, 0.0), LENS)
    image = painter.picture(np.full(len(painter.azimuths), 6.0), [tag_panel(tag) for tag in tags], place)
    grain = np.random.default_rng(1).normal(0, noise, image.shape)
    return jpeg(np.clip(image + grain, 0, 255).astype(np.uint8), 1)


def read(data: bytes, **more):
    return ReadingStep().step(ReadTask(data, BELIEVED, 0.1, **more))


def test_near_and_far_tags_are_placed_and_show_where_they_face():
    near = TagConfig(tag=3, x=0.7, y=0.15, z=0.3, yaw=math.pi - 0.5)
    far = TagConfig(tag=4, x=1.5, y=-0.4, z=0.2, yaw=math.pi + 0.3)
    answer = read(picture(near, far))
    readings = {reading.tag: reading for reading in answer.readings}
    assert readings.keys() == {3, 4}
    for tag in (near, far):
        right, down, ahead = readings[tag.tag].middle
        assert (ahead, -right, 0.25 - down) == pytest.approx((tag.x, tag.y, tag.z), abs=0.03)
        assert readings[tag.tag].margin > 0.3
        assert readings[tag.tag].picture.startswith(b"\xff\xd8")
    normal = readings[3].normal
    assert math.remainder(math.atan2(-normal[0], normal[2]) - near.yaw, math.tau) == pytest.approx(0.0, abs=0.1)


def test_what_is_too_far_too_oblique_or_no_tag_is_refused():
    far = picture(TagConfig(tag=3, x=1.5, y=0.0, yaw=math.pi))
    assert not read(far, reach=1.4).readings
    assert read(far).readings
    oblique = picture(TagConfig(tag=3, x=0.8, y=0.0, yaw=math.pi - 0.9))
    assert read(oblique).readings
    assert not read(oblique, angle=0.8).readings
    assert not read(picture(TagConfig(tag=3, x=1.2, y=0.0, yaw=math.pi)), margin=0.99).readings
    assert read(picture()) == read(picture(), reach=9.0)
    assert read(b"no picture").unreadable


def test_a_tag_of_another_size_is_farther_away():
    data = picture(TagConfig(tag=3, x=1.0, y=0.0, yaw=math.pi, size=0.2))
    (reading,) = read(data, sizes={3: 0.2}).readings
    assert reading.middle[2] == pytest.approx(1.0, abs=0.03)


def test_a_lens_is_scaled_to_the_pictures():
    matrix = Lens.of(LensConfig(), 320, 240).matrix
    assert matrix[0] == pytest.approx((261.1, 0.0, 159.5))


@pytest.mark.parametrize("family", get_args(TagFamily))
def test_each_family_is_read_by_its_name(family: TagFamily):
    paper = np.full((480, 640), 255, np.uint8)
    paper[160:320, 240:400] = drawn(3, 160, family)
    answer = read(jpeg(paper, 1), family=family)
    assert [reading.tag for reading in answer.readings] == [3]
    assert answer.readings[0].margin > 0.5
    other = "aruco_5x5_50" if family == "36h11" else "36h11"
    assert not read(jpeg(paper, 1), family=other).readings
