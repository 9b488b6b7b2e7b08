"""The rendered camera: tags where the lens puts them, people before them; without EGL a reason is named."""

import math
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from pydantic import ValidationError

from monstertruck_estimation.vision.tags import TagReader
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import NotInstalledError
from monstertruck_schemas.base import Pose2D
from monstertruck_sim.config import CeilingCamera
from monstertruck_sim.world.config import CameraConfig, HeldBoard, PersonConfig, RoofTag, Spot, TagConfig, WorldConfig
from monstertruck_sim.world.world import World
from monstertruck_sim.world3d.onlookers import CeilingView

SIZE = (320, 240)
FOCAL = 160 / math.tan(math.radians(31.5))
TAG = TagConfig(tag=7, x=0.302, y=4.1, z=0.3, yaw=0.0, size=0.2)
CONFIG = WorldConfig(
    map="rooms", engine="mujoco", noise=False, start=Pose2D(x=1.48, y=3.95, yaw=math.pi), tags=(TAG,),
    camera=CameraConfig(rendered=True, k1=-0.1),
    people=(PersonConfig(waypoints=(Spot(x=0.8, y=3.6), Spot(x=0.8, y=3.7)), pause=1000.0),),
)  # fmt: skip


@pytest.fixture(scope="module")
def world() -> World:
    try:
        return World(CONFIG, 1)
    except NotInstalledError as error:
        pytest.skip(str(error))


def test_a_tag_is_where_the_bent_lens_puts_it_and_somebody_stands_beside_it(world: World):
    picture = world.view.exposure(SECOND, SIZE)()
    assert picture.shape == (240, 320, 3)
    (seen,) = TagReader(1).read(np.asarray(Image.fromarray(picture).convert("L")))
    far = world.plant.pose[0] - 0.18 - TAG.x
    right, down = (TAG.y - 3.95) / far, -(TAG.z - 0.25 - world.plant.height) / far
    factor = 1 - 0.1 * (right**2 + down**2)
    assert seen.corners.mean(axis=0) == pytest.approx(
        (159.5 + FOCAL * right * factor, 119.5 + FOCAL * down * factor), abs=1.0
    )
    trousers = picture[..., 2].astype(int) - picture[..., 0] > 5
    assert trousers[120:, :100].sum() > 1000
    assert not trousers[120:, 200:].any()


def test_without_egl_the_world_says_so(world: World, monkeypatch: pytest.MonkeyPatch):
    del world
    monkeypatch.setitem(sys.modules, "mujoco.egl", None)
    with pytest.raises(NotInstalledError, match="no EGL on this computer"):
        World(CONFIG, 1)


def test_the_plane_renders_nothing():
    with pytest.raises(ValidationError, match=r"camera\.rendered needs engine mujoco"):
        WorldConfig(camera=CameraConfig(rendered=True))


def test_a_ceiling_camera_sees_the_tag_on_the_robot_and_a_board_that_is_held():
    config = WorldConfig(
        map="table", engine="mujoco", noise=False, start=Pose2D(x=0.3, y=0.2, yaw=0.5), roof=RoofTag(tag=3, size=0.12)
    )
    world = World(config, 1)
    above = CeilingCamera(port=Path("unused"), height=2.0, yaw=math.pi / 2)
    try:
        view = CeilingView(world, above, None, 1)
    except NotInstalledError as error:
        pytest.skip(str(error))
    world.truth(SECOND)

    def grey(view: CeilingView) -> np.ndarray:
        return np.asarray(Image.fromarray(view.exposure(SECOND, (640, 480))()).convert("L"))

    (seen,) = TagReader(1).read(grey(view))
    scale = 2 * FOCAL / (2.0 - 0.3)
    assert seen.tag == 3
    assert seen.corners.mean(axis=0) == pytest.approx((319.5 + scale * 0.3, 239.5 - scale * 0.2), abs=1.0)
    front = seen.corners[:2].mean(axis=0) - seen.corners[2:].mean(axis=0)
    assert math.atan2(-front[1], front[0]) == pytest.approx(0.5, abs=0.05)
    board = grey(CeilingView(world, above, HeldBoard(), 1))
    assert len(TagReader(1).read(board)) > 15
