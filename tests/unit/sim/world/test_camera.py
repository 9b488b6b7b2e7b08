"""What the pictures of the plane's camera show."""

import io
import math

import numpy as np
import pytest
from PIL import Image

from monstertruck_drivers.webcam.driver import complete
from monstertruck_drivers.webcam.emulator import jpeg
from monstertruck_estimation.vision.tags import TagReader
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.base import Pose2D
from monstertruck_sim.world.camera import CameraPlace, Painter, mounted, person_panel
from monstertruck_sim.world.config import CameraConfig, PersonConfig, Spot, TagConfig, WorldConfig
from monstertruck_sim.world.world import World

SIZE = (640, 480)
HERE = mounted((0.0, 0.0, 0.0), CameraConfig())
FOCAL = 320 / math.tan(math.radians(31.5))


def painted(ranges: np.ndarray, painter: Painter, place: CameraPlace = HERE) -> np.ndarray:
    return painter.picture(ranges, [], place).astype(int)


def flat(distance: float, painter: Painter) -> np.ndarray:
    """Ranges of a wall across the camera's axis."""
    return distance / np.cos(painter.azimuths)


def wall_rows(painter: Painter, ranges: np.ndarray, column: int = 320) -> int:
    """Rows of a column that differ from the empty plain's."""
    empty = painted(np.full(len(ranges), np.inf), painter)
    return int((np.abs(painted(ranges, painter) - empty)[:, column].sum(axis=1) > 40).sum())


def painter_of(size: tuple[int, int] = SIZE, **lens: float) -> Painter:
    return Painter(CameraConfig(**lens), size, 0.6)


def test_azimuths_run_from_left_to_right_over_the_field_of_view():
    painter = painter_of(field_of_view=math.radians(60))
    assert painter.azimuths[0] == pytest.approx(math.radians(30), abs=0.002)
    assert painter.azimuths[-1] == -painter.azimuths[0]
    assert np.all(np.diff(painter.azimuths) < 0)


def test_a_walls_height_in_pixels_is_its_height_over_its_distance():
    painter = painter_of()
    for distance in (1.0, 2.0, 4.0):
        assert wall_rows(painter, flat(distance, painter)) == pytest.approx(FOCAL * 0.6 / distance, abs=4)


def test_a_wall_across_the_axis_is_a_rectangle_without_fish_eye():
    painter = painter_of()
    ranges = flat(2.0, painter)
    assert wall_rows(painter, ranges, 5) == pytest.approx(wall_rows(painter, ranges, 320), abs=3)


def test_something_on_the_left_is_drawn_on_the_left_and_near_is_brighter():
    painter = painter_of()
    image = painted(np.where(painter.azimuths > 0, 1.0, 4.0), painter)
    assert image[240, 100].sum() > image[240, 540].sum() + 50


def test_touching_a_wall_fills_the_picture_and_nothing_overflows():
    image = painted(np.zeros(640), painter_of())
    assert np.ptp(image[60:, :, 0]) < 10


def test_every_size_is_a_whole_picture():
    for size in ((160, 120), (1600, 1200)):
        painter = painter_of(size)
        data = jpeg(painted(flat(2.0, painter), painter).astype(np.uint8), 1)
        assert complete(data) == data
        assert Image.open(io.BytesIO(data)).size == size


def test_a_camera_that_looks_down_sees_more_floor_and_a_bent_lens_bends_a_walls_edge():
    level, down, bent = painter_of(), painter_of(pitch=0.2), painter_of(k1=-0.2)
    image = painted(flat(2.0, down), down)
    above = painted(flat(2.0, level), level)
    foot, foot_above = (int(np.argmax(np.abs(np.diff(i[::-1, 320].sum(axis=1)))[40:] > 150)) for i in (image, above))
    assert foot - foot_above == pytest.approx(FOCAL * math.tan(0.2), rel=0.1)
    assert wall_rows(bent, flat(2.0, bent), 2) < 0.95 * wall_rows(bent, flat(2.0, bent), 320)


# Tags and people


def world_with(tags: tuple[TagConfig, ...], people: tuple[PersonConfig, ...] = (), **camera: float) -> World:
    """The rooms; the camera is 1 m before the west wall of the hall, at x = 0.3, and looks at it."""
    start = Pose2D(x=1.3 + 0.18, y=3.95, yaw=math.pi)
    camera_config = CameraConfig(**camera)
    config = WorldConfig(map="rooms", start=start, tags=tags, people=people, camera=camera_config, noise=bool(camera))
    return World(config, 1)


def seen(world: World) -> dict[int, np.ndarray]:
    picture = world.view.exposure(SECOND, SIZE)()
    grey = np.asarray(Image.fromarray(picture).convert("L"))
    return {sighting.tag: sighting.corners for sighting in TagReader(1, corners="edges").read(grey)}


def test_a_tag_on_a_wall_is_where_the_lens_puts_it():
    tag = TagConfig(tag=7, x=0.305, y=3.95 + 0.1, z=0.3, yaw=0.0)
    world = world_with((tag,))
    (corners,) = seen(world).values()
    far = world.plant.pose[0] - 0.18 - 0.305
    expected = [
        (319.5 + FOCAL * right / far, 239.5 - FOCAL * up / far)
        for right, up in ((0.05, 0.1), (0.15, 0.1), (0.15, 0.0), (0.05, 0.0))
    ]
    # The robot looks west: north is to its right.
    assert corners == pytest.approx(np.array(expected), abs=0.35)


def test_a_distorted_noisy_lens_moves_the_tag_as_its_coefficients_say():
    tag = TagConfig(tag=7, x=0.305, y=3.95 + 0.4, z=0.4, yaw=0.0)
    straight, bent = seen(world_with((tag,)))[7], seen(world_with((tag,), k1=-0.2, noise=3.0))[7]
    ideal = (straight - (319.5, 239.5)) / FOCAL
    factor = 1 - 0.2 * (ideal**2).sum(axis=1, keepdims=True)
    assert bent == pytest.approx(ideal * factor * FOCAL + (319.5, 239.5), abs=0.5)


def test_light_falls_off_to_one_side_and_saturates():
    plain, dark, bright = (
        world_with((), noise=0.0, **light).view.exposure(SECOND, SIZE)().astype(float)
        for light in ({}, {"brightness": 0.5, "gradient": 0.4}, {"brightness": 4.0})
    )
    left, centre, right = (dark[:, at] / plain[:, at] for at in (0, 320, 639))
    assert np.median(left) == pytest.approx(0.7, abs=0.02)
    assert np.median(centre) == pytest.approx(0.5, abs=0.02)
    assert np.median(right) == pytest.approx(0.3, abs=0.02)
    assert bright.max() == 255


def test_defocus_flattens_the_edges_of_a_tag_and_keeps_its_place():
    tag = TagConfig(tag=7, x=0.305, y=3.95 + 0.1, z=0.3, yaw=0.0)
    sharp, blurred = world_with((tag,), noise=0.0), world_with((tag,), noise=0.0, blur=1.0)
    edges = [
        np.abs(np.diff(w.view.exposure(SECOND, SIZE)()[..., 0].astype(int), axis=1)).max() for w in (sharp, blurred)
    ]
    assert edges[1] < 0.6 * edges[0]
    assert seen(blurred)[7] == pytest.approx(seen(sharp)[7], abs=0.2)


def test_a_tag_is_hidden_by_a_person_and_has_no_back():
    tag = TagConfig(tag=7, x=0.305, y=3.95, yaw=0.0)
    walker = PersonConfig(waypoints=(Spot(x=0.8, y=3.95), Spot(x=0.8, y=4.2)), pause=1000.0)
    assert 7 in seen(world_with((tag,)))
    assert not seen(world_with((tag,), (walker,)))
    assert not seen(world_with((tag.model_copy(update={"yaw": math.pi}),)))


def test_a_person_stands_upright_before_the_wall():
    painter = painter_of()
    person = person_panel(2.0, 0.3, 0.2, HERE)
    empty = painted(np.full(640, 4.0), painter)
    there = painter.picture(np.full(640, 4.0), [person], HERE).astype(int)
    rows, columns = np.nonzero(np.abs(there - empty).sum(axis=2) > 30)
    away = math.hypot(2.0 - 0.18, 0.3) - 0.2
    assert rows.max() == pytest.approx(239.5 + FOCAL * 0.25 / away, abs=6)
    assert columns.mean() < 310
    hidden = painter.picture(np.full(640, 1.0), [person], HERE).astype(int)
    assert np.array_equal(hidden, painted(np.full(640, 1.0), painter))
