"""Pictures: the robot is in them, where it should be; without EGL a reason is named."""

import sys

import numpy as np
import pytest
from PIL import Image

from monstertruck_runtime.clock import VirtualClock, run_virtual
from monstertruck_runtime.errors import InputError, NotInstalledError
from monstertruck_sim.world.config import WorldConfig
from monstertruck_sim.world.world import World
from monstertruck_sim.world3d.film import RATE, SIZE, Film
from monstertruck_sim.world3d.picture import WorldRenderer, looking_at


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
        film = Film(world, clock, tmp_path / "a.gif")
        for _ in range(3):
            film.take()
            await clock.sleep(1 / RATE)
        film.close()

    run_virtual(main)
    with Image.open(tmp_path / "a.gif") as image:
        assert image.size == SIZE
        assert 1 <= image.n_frames <= 3


def test_only_rigid_worlds_and_gifs_are_filmed(tmp_path):
    async def main(clock: VirtualClock) -> None:
        with pytest.raises(InputError, match=r"only sim\.world\.engine mujoco can be filmed"):
            Film(World(WorldConfig(map="yard"), 1), clock, tmp_path / "a.gif")
        with pytest.raises(InputError, match=r"expected a name that ends with \.gif"):
            Film(World(WorldConfig(engine="mujoco", map="yard"), 1), clock, tmp_path / "a.mp4")

    run_virtual(main)


def test_without_egl_a_reason_is_named(world, monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco.egl", None)
    with pytest.raises(NotInstalledError, match="no EGL on this computer"):
        WorldRenderer(world.plant.model)
