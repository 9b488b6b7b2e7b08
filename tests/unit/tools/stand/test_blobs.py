"""Robots with coloured discs: found in pictures, distinguished, and not guessed at."""

import itertools
import math

import numpy as np
import pytest

pytest.importorskip("cv2")

import cv2

from monstertruck_estimation.vision.blobs import Blob, BlobReader
from monstertruck_estimation.vision.tags import TagReader
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import ConfigError
from monstertruckd.config.load import load_config
from monstertruckd.tools.stand.camera import PlacedCamera
from monstertruckd.tools.stand.config import BlobRobot, OverheadConfig
from monstertruckd.tools.stand.sources import stream
from monstertruckd.tools.stand.track import StandReader
from monstertruckd.tools.stand.tracking import StandTracker
from tests.stand_kit import hidden_camera
from tests.stand_render import PictureQuality, StandRenderer, disc_plate

CAMERA: PlacedCamera = hidden_camera(0.0, 0.0, np.random.default_rng(2), (2.0, 2.6))
APART = 0.1


@pytest.fixture(scope="module")
def renderer():
    return StandRenderer(CAMERA, PictureQuality(), 1)


def robot(front="red", rear="blue", start=None):
    return BlobRobot(front=front, rear=rear, apart=APART, start=start)


def tracker(**robots):
    return StandTracker({"c1": CAMERA}, {}, {}, 0, robots)


def discs(*robots):
    """What a camera without noise sees of robots: x, y, yaw, and colours of front and rear."""
    found = []
    for x, y, yaw, front, rear in robots:
        for colour, ahead in ((front, 0.5), (rear, -0.5)):
            place = np.array([(x + ahead * APART * math.cos(yaw), y + ahead * APART * math.sin(yaw), 0.08)])
            found.append(Blob(colour, CAMERA.project(place)[0], 100))
    return {"c1": found}


def alike(*places):
    return discs(*((x, y, yaw, "red", "blue") for x, y, yaw in places))


def where(poses):
    return {pose.robot: (pose.x, pose.y) for pose in poses}


@pytest.mark.parametrize("light", [1.0, 0.5])
def test_robots_of_all_colours_are_placed_to_millimetres(renderer, light):
    reader = StandReader((), ("red", "yellow", "green", "blue", "magenta"))
    looks = [("red", "blue"), ("yellow", "green"), ("magenta", "yellow")]
    robots = {f"r{k}": robot(*look) for k, look in enumerate(looks)}
    rng = np.random.default_rng(5)
    places = [(rng.uniform(-0.2, 0.2) + 0.5 * k, rng.uniform(-0.5, 0.5), rng.uniform(-3, 3)) for k in (-1, 0, 1)]
    plates = [disc_plate(*look, *place) for look, place in zip(looks, places, strict=True)]
    poses = tracker(**robots).take(0, {"c1": reader.read(renderer.picture(plates, PictureQuality(light=light)))})
    assert [pose.robot for pose in sorted(poses)] == list(robots)
    for pose, (x, y, yaw) in zip(sorted(poses), places, strict=True):
        assert math.hypot(pose.x - x, pose.y - y) < 0.004
        assert abs(math.remainder(pose.yaw - yaw, math.tau)) < math.radians(2)


def test_what_is_no_disc_is_left_aside():
    picture = np.full((200, 300, 3), 120, np.uint8)
    red = (40, 40, 200)
    cv2.circle(picture, (100, 100), 8, red, -1)
    cv2.circle(picture, (0, 50), 8, red, -1)  # cut by the border
    cv2.circle(picture, (200, 20), 1, red, -1)  # a speck
    cv2.rectangle(picture, (150, 150), (250, 156), red, -1)  # a cable
    cv2.circle(picture, (230, 80), 60, red, -1)  # a jacket
    cv2.circle(picture, (40, 150), 8, (110, 110, 130), -1)  # hardly coloured
    (found,) = BlobReader(["red", "blue"]).read(picture)
    assert found.colour == "red"
    assert found.middle == pytest.approx((100, 100))


def test_robots_that_look_alike_keep_their_names_where_they_cross():
    track = tracker(a=robot(start=(-0.5, 0.15)), b=robot(start=(0.5, -0.15)))
    for k in range(50):
        x = -0.5 + 0.02 * k
        hidden = 22 <= k < 28  # a hand is over them
        shown = () if hidden else ((x, 0.15, 0.0), (-x, -0.15, math.pi))
        places = where(track.take(k * SECOND // 25, alike(*shown)))
        assert hidden or places["a"] == pytest.approx((x, 0.15), abs=0.002)
        assert hidden or places["b"] == pytest.approx((-x, -0.15), abs=0.002)
    assert track.complaints(2 * SECOND) == []


def test_discs_of_two_robots_side_by_side_are_not_a_third():
    track = tracker(a=robot(start=(0.0, 0.0)), b=robot(start=(0.1, 0.0)), c=robot(start=(0.05, 0.0)))
    # Front of one and rear of the other are as far apart as those of one robot.
    shown = alike((0.0, 0.0, math.pi / 2), (0.1, 0.0, -math.pi / 2))
    places = where(track.take(0, shown))
    assert places == {"a": pytest.approx((0, 0), abs=1e-3), "b": pytest.approx((0.1, 0), abs=1e-3)}


def test_which_of_two_that_were_gone_together_it_is_is_not_guessed():
    track = tracker(a=robot(start=(-0.5, 0.0)), b=robot(start=(0.5, 0.0)))
    track.take(0, alike((-0.5, 0.0, 0.0), (0.5, 0.0, 0.0)))
    assert track.take(SECOND, alike((0.1, 0.4, 0.0))) == []
    (said,) = track.complaints(SECOND)
    assert said.startswith("robots a, b look alike and were out of sight together: place them at their starts")
    assert track.take(2 * SECOND, alike((0.1, 0.4, 0.0))) == []
    assert track.complaints(2 * SECOND) == []
    # One of them at its start says who the other is.
    found = [where(track.take(t * SECOND // 10, alike((-0.5, 0.0, 0.0), (0.1, 0.4, 0.0)))) for t in (30, 31)]
    assert found[1]["a"] == pytest.approx((-0.5, 0.0), abs=1e-3)
    assert found[1]["b"] == pytest.approx((0.1, 0.4), abs=1e-3)


def test_one_that_was_gone_alone_is_known_again():
    track = tracker(a=robot(start=(-0.5, 0.0)), b=robot(start=(0.5, 0.0)), c=robot("green", "red"))
    track.take(0, {"c1": [*alike((-0.5, 0.0, 0.0), (0.5, 0.0, 0.0))["c1"], *discs((0, -0.4, 0, "green", "red"))["c1"]]})
    for k in range(1, 50):
        assert set(where(track.take(k * SECOND // 25, alike((-0.5, 0.0, 0.0))))) == {"a"}
    shown = [*alike((-0.5, 0.0, 0.0), (0.2, 0.3, 1.0))["c1"], *discs((0.6, -0.5, 2.0, "green", "red"))["c1"]]
    assert set(where(track.take(2 * SECOND, {"c1": shown}))) == {"a", "b", "c"}


def test_a_stand_without_colours_reads_grey_pictures_and_one_with_them_colour(tmp_path):
    from monstertruckd.tools.stand.config import FileSource

    cv2.imwrite(str(tmp_path / "0.png"), np.full((48, 64, 3), (200, 90, 30), np.uint8))
    source = FileSource(path=tmp_path)
    assert next(stream(source, (64, 48), 25.0)).shape == (48, 64)
    assert next(stream(source, (64, 48), 25.0, colour=True)).shape == (48, 64, 3)
    assert StandReader((), ["red"]).read(np.full((48, 64), 90, np.uint8)) == []


def test_where_no_robot_has_a_tag_marks_are_looked_for_in_one_picture_of_eight(monkeypatch):
    read = []
    monkeypatch.setattr(TagReader, "read", lambda self, picture, expected: read.append(picture.ndim) or [])
    pictures = [np.full((48, 64, 3), 90, np.uint8)] * 17
    for tagged, times in ((False, 3), (True, 17)):
        read.clear()
        reader = StandReader((100,), ["red"], tagged=tagged)
        for picture in pictures:
            reader.read(picture)
        assert read == [2] * times


ROBOT = "{ front: red, rear: blue, apart: 0.1 }"


@pytest.mark.parametrize(
    ("robots", "said"),
    [
        ("robots: {}", "expected a robot"),
        ("robots: { a: { tag: 1 } }\nblobs: { a: { front: red, rear: blue, apart: 0.1 } }", "a: expected in robots or"),
        ("robots: { a: { tag: 1 }, b: { tag: 1 } }", "tag 1: expected on one robot"),
        ("robots: { a: { tag: 100 } }", "tag 100: expected on one robot only, and not among the marks"),
        ("blobs: { a: { front: red, rear: red, apart: 0.1 } }", "front and rear are both red"),
        (f"blobs: {{ a: {ROBOT}, b: {{ front: blue, rear: red, apart: 0.1 }} }}", "blobs.a has the same colours as b"),
    ],
)
def test_robots_that_cannot_be_distinguished_are_refused(tmp_path, robots, said):
    file = tmp_path / "stand.yaml"
    camera = "cameras: { c1: { source: { kind: file, path: film }, boards: b, floor: f } }"
    file.write_text(f"version: 2\n{camera}\nmarks: {{ 100: {{ x: 0.0, y: 0.0 }} }}\n{robots}\n")
    with pytest.raises(ConfigError, match=said):
        load_config(file, OverheadConfig)


def test_every_two_colours_have_hues_of_their_own():
    from monstertruck_estimation.vision.blobs import HUES

    spans = {c: set(range(a, b + 1)) if a <= b else {*range(a, 180), *range(b + 1)} for c, (a, b) in HUES.items()}
    assert not any(spans[one] & spans[other] for one, other in itertools.combinations(spans, 2))
