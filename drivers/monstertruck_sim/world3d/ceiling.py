"""Cameras under the ceiling of the world in three dimensions: what a test stand sees from above."""

import math
from functools import cache

import numpy as np
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_sim.config import BoardInView, CeilingCamera
from monstertruck_sim.world.camera import CameraPlace, Drawing, FlatPanel, SimulatedView, mounted
from monstertruck_sim.world.noise import BOARD, generator
from monstertruck_sim.world.world import World
from monstertruck_sim.world3d.camera import RenderedView
from monstertruck_sim.world3d.model import Group

CELL: int = 40
"""Pixels of a board's square in its texture."""


class CeilingView(RenderedView):
    """``ViewSource`` of a camera that hangs in the world.

    Args:
        world: of engine mujoco.
        config: place, lens and noise.
        board: somebody holds it before the camera, another way in each picture; None = nobody does.
        seed: of noise and board.

    Raises:
        NotInstalledError: this computer has no EGL.
        InputError: the world has nothing to render.
    """

    HIDDEN: tuple[Group, ...] = ()

    def __init__(self, world: World, config: CeilingCamera, board: BoardInView | None, seed: int) -> None:
        drawn = SimulatedView(world.plant, world.scene.cast, config, crowd=world.scene, seed=seed)
        super().__init__(drawn)
        self._board, self._board_seed = board, seed

    def exposure(self, time_ns: int, size: tuple[int, int]) -> Drawing:
        """``ViewSource``."""
        draw = super().exposure(time_ns, size)
        if self._board is None:
            return draw
        place = self._place(time_ns)
        rng = generator(self._board_seed, BOARD, self._rigid.slot(time_ns, 1_000_000))
        panel = held(self._board, place, rng, self.config.field_of_view)
        painter = self._painter(size)

        def with_board() -> NDArray[np.uint8]:
            picture = draw()
            painter.draw(picture, panel, place, np.full(len(painter.azimuths), np.inf))
            return picture

        return with_board

    def _place(self, _time_ns: int) -> CameraPlace:
        return mounted((0.0, 0.0, 0.0), self.config)


def held(board: BoardInView, place: CameraPlace, rng: np.random.Generator, field_of_view: float) -> FlatPanel:
    """The board somewhere in a camera's view, turned anyhow and tilted by up to 30 degrees."""
    texture = _texture(board.columns, board.rows, board.square, board.marker)
    wide, high = board.columns * board.square, board.rows * board.square
    away = rng.uniform(0.9, 1.6) * max(wide, high) / math.tan(field_of_view / 2)
    aside, below = rng.uniform(-0.25, 0.25, 2) * away * math.tan(field_of_view / 2)
    spin, tilt, lean = rng.uniform(-math.pi, math.pi), *rng.uniform(-0.5, 0.5, 2)
    # Its axes in the camera's: right and down, turned about the axis, then tilted.
    right = np.array((math.cos(spin), math.sin(spin), 0.0))
    down = np.array((-math.sin(spin), math.cos(spin), 0.0))
    right = np.array((*(right[:2] * math.cos(tilt)), math.sin(tilt)))
    down = np.array((*(down[:2] * math.cos(lean)), math.sin(lean)))
    down = down - right * float(down @ right)
    down /= np.linalg.norm(down)
    middle = np.array((aside, below, away))
    corner = middle - right * wide / 2 - down * high / 2
    to_map: Array = place.axes.T
    return FlatPanel(
        np.repeat(texture[..., None], 3, axis=2),
        np.ones(texture.shape, np.bool_),
        place.centre + to_map @ corner,
        to_map @ right * wide,
        to_map @ down * high,
    )


@cache
def _texture(columns: int, rows: int, square: float, marker: float) -> NDArray[np.uint8]:
    import cv2  # noqa: PLC0415  # the library of an extra

    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    board = cv2.aruco.CharucoBoard((columns, rows), square, marker, family)
    drawn = board.generateImage((columns * CELL, rows * CELL), marginSize=0)
    return np.asarray(drawn, dtype=np.uint8)
