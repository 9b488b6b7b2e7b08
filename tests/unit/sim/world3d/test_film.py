"""Pictures: the robot is in them, where it should be; without EGL a reason is named."""

import sys

import numpy as np
import pytest
from PIL import Image

from monstertruck_runtime.clock import VirtualClock, run_virtual
from monstertruck_runtime.errors import InputError, NoAnswerError, NotInstalledError
from monstertruck_schemas.base import Pose2D
from monstertruck_sim.world.config import WorldConfig
from monstertruck_sim.world.world import World, make_scene
from monstertruck_sim.world3d.model import Group
from monstertruck_sim.world3d.onlookers import FRAME_RATE, Film
from monstertruck_sim.world3d.picture import WorldRenderer, looking_at

FILM_SIZE = (480, 320)


@pytest.fixture(scope="module")
def world():
    return World(WorldConfig(engine="mujoco", map="yard", noise=False), 1)


@pytest.fixture
def renderer(world):
    try:
        made = WorldRenderer(world.plant.model, 160, 120)
    except NotInstalledError as error:
        pytest.skip(str(error))
    yield made
    made.close()


def test_the_robot_is_in_the_middle_of_a_picture_that_looks_at_it(world, renderer):
    world.truth(0)
    with_it = renderer.draw(world.plant.data, looking_at((-1.5, 0.0, 0.8), (0.0, 0.0, 0.15))).astype(int)
    assert with_it.shape == (120, 160, 3)
    beside = renderer.draw(world.plant.data, looking_at((-1.5, 2.0, 0.8), (0.0, 2.0, 0.15))).astype(int)
    blue = [(picture[..., 2] - picture[..., 0] > 40) for picture in (with_it, beside)]
    rows, columns = np.nonzero(blue[0][40:])
    assert len(rows) > 50
    assert abs(columns.mean() - 80) < 8
    assert not blue[1][40:].any()


def test_the_upper_half_of_a_level_view_is_sky_and_the_lower_half_is_ground(world, renderer):
    picture = renderer.draw(world.plant.data, looking_at((-8.0, -8.0, 3.0), (-9.0, -9.0, 3.0))).astype(int)
    assert picture[:40, :, 2].mean() > picture[:40, :, 0].mean() + 10  # blue
    assert abs(picture[80:, :, 2].mean() - picture[80:, :, 0].mean()) < 10  # grey


def test_a_film_has_a_frame_an_eighth_of_a_second(world, renderer, tmp_path):
    async def main(clock: VirtualClock) -> None:
        with Film(world, clock, tmp_path / "a.gif") as film:
            for _ in range(3):
                film.take()
                await clock.sleep(1 / FRAME_RATE)

    run_virtual(main)
    with Image.open(tmp_path / "a.gif") as image:
        assert image.size == FILM_SIZE
        assert 1 <= image.n_frames <= 3


@pytest.mark.parametrize(
    ("error", "left"), [(NoAnswerError("no lap"), ["a.gif"]), (KeyboardInterrupt(), []), (OSError("disk"), [])]
)
def test_a_film_of_a_run_that_failed_is_kept_and_one_that_is_broken_off_is_not(
    world, renderer, tmp_path, error: BaseException, left: list[str]
):
    async def main(clock: VirtualClock) -> None:
        with Film(world, clock, tmp_path / "a.gif") as film:
            for _ in range(2):
                film.take()
                world.truth(clock.now())
                await clock.sleep(1 / FRAME_RATE)
            raise error

    with pytest.raises(type(error)):
        run_virtual(main)
    assert [path.name for path in tmp_path.iterdir()] == left


def test_only_rigid_worlds_and_gifs_are_filmed(tmp_path):
    async def main(clock: VirtualClock) -> None:
        with pytest.raises(InputError, match=r"needs sim\.world\.engine mujoco"):
            Film(World(WorldConfig(map="yard"), 1), clock, tmp_path / "a.gif")
        with pytest.raises(InputError, match=r"expected a name that ends with \.gif"):
            Film(World(WorldConfig(engine="mujoco", map="yard"), 1), clock, tmp_path / "a.mp4")

    run_virtual(main)


def test_without_egl_a_reason_is_named(world, monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco.egl", None)
    with pytest.raises(NotInstalledError, match="no EGL on this computer"):
        WorldRenderer(world.plant.model)


def test_another_robot_is_drawn_as_it_is_and_steers():
    starts = [Pose2D(x=x, y=0.0, yaw=0.0) for x in (0.0, 1.0)]
    configs = [WorldConfig(engine="mujoco", map="yard", noise=False, start=start) for start in starts]
    scene = make_scene(configs[0], 1, configs[1:])
    own, other = [World(config, 1, scene, f"robot_{i}") for i, config in enumerate(configs)]
    own.truth(0)
    try:
        renderer = WorldRenderer(own.plant.model, 160, 120)
    except NotInstalledError as error:
        pytest.skip(str(error))
    above = looking_at((0.9, 0.0, 1.2), (1.0, 0.0, 0.1))

    def drawn() -> np.ndarray:
        return renderer.draw(own.plant.data, above, robots=scene.robots_beside(own.plant)).astype(int)

    with_it, without = drawn(), renderer.draw(own.plant.data, above).astype(int)
    its_own = own.plant
    renderer.close()
    renderer = WorldRenderer(other.plant.model, 160, 120)
    as_itself = renderer.draw(other.plant.data, above).astype(int)
    renderer.close()
    assert scene.robots_beside(its_own) == [other.plant]
    seen = np.abs(with_it - without).max(axis=2) > 20
    assert seen.sum() > 1000
    assert np.abs(with_it - as_itself).max(axis=2).mean() < 2.0, "the same robot in both models"
    assert not (without[..., 0] - without[..., 2] > 80).any(), "no orange box"


def test_hills_take_the_robots_shadow():
    hills = {"kind": "hills", "height": 0.03, "wavelength": 2.0}
    config = WorldConfig.model_validate({"engine": "mujoco", "map": "yard", "noise": False, "ground": [hills]})
    world = World(config, 1)
    world.truth(0)
    try:
        renderer = WorldRenderer(world.plant.model, 160, 120)
    except NotInstalledError as error:
        pytest.skip(str(error))
    above = looking_at((-0.01, 0.0, 1.6), (0.0, 0.0, 0.0))
    there = renderer.draw(world.plant.data, above).astype(int)
    renderer.arrange(world.plant.data, above, hidden=(Group.ROBOT,))
    empty = renderer.render().astype(int)
    renderer.close()
    darker = empty.min(axis=2) - there.min(axis=2)
    ground = np.ptp(there, axis=2) < 25
    assert (ground & (darker > 20)).sum() > 40
    assert (ground & (abs(darker) < 6)).sum() > 5000
