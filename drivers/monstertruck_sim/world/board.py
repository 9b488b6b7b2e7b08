"""A board that somebody holds before a camera: how it is held, what it looks like, and what a lidar sees of it."""

import math
from functools import cache

import numpy as np
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.clock import SECOND
from monstertruck_sim.world.camera import CameraPlace, FlatPanel, opencv
from monstertruck_sim.world.config import HeldBoard
from monstertruck_sim.world.noise import BOARD, generator

ASIDE: float = 0.5
"""Greatest distance of the board's middle from the camera's axis, as a share of half the picture's width."""
BELOW: float = 0.4
"""Greatest distance above or below the axis, as a share of half the picture's width."""


class BoardHolder:
    """Somebody who holds a board before a camera, every while another way.

    Args:
        board: and for how long it is held still.
        field_of_view: of the camera, rad.
        seed: of how it is held.

    Raises:
        NotInstalledError: the extra ``vision`` is not there.
    """

    def __init__(self, board: HeldBoard, field_of_view: float, seed: int) -> None:
        board_texture(board.columns, board.rows, board.square, board.marker)
        self._board, self._field_of_view, self._seed = board, field_of_view, seed

    def panel_at(self, time_ns: int, place: CameraPlace) -> FlatPanel:
        """The board at an instant, before a camera that is at ``place`` then."""
        slot = time_ns // round(self._board.hold * SECOND)
        return held(self._board, place, generator(self._seed, BOARD, slot), self._field_of_view)


def held(board: HeldBoard, place: CameraPlace, rng: np.random.Generator, field_of_view: float) -> FlatPanel:
    """The board somewhere in a camera's view, turned by up to 30 degrees, and leaning by 17 to 40."""
    texture = board_texture(board.columns, board.rows, board.square, board.marker)
    wide, high = (printed * board.printed_scale for printed in (board.width, board.height))
    away = rng.uniform(0.9, 1.7) * max(wide, high) / math.tan(field_of_view / 2)
    aside, below = rng.uniform(-ASIDE, ASIDE), rng.uniform(-BELOW, BELOW)
    aside, below = (part * away * math.tan(field_of_view / 2) for part in (aside, below))
    upright = 0.35  # turn about the camera's axis, rad, at most
    spin, tilt = rng.uniform(-upright, upright), rng.uniform(-0.55, 0.55)
    lean = float(rng.choice((-1.0, 1.0))) * rng.uniform(0.3, 0.7)
    # Its axes in the camera's: right and down, turned about the axis, then tilted.
    right = np.array((math.cos(spin) * math.cos(tilt), math.sin(spin) * math.cos(tilt), math.sin(tilt)))
    down = np.array((-math.sin(spin) * math.cos(lean), math.cos(spin) * math.cos(lean), math.sin(lean)))
    down = down - right * float(down @ right)
    down /= np.linalg.norm(down)
    corner = np.array((aside, below, away)) - right * wide / 2 - down * high / 2
    to_map: Array = place.axes.T
    return FlatPanel(
        np.repeat(texture[..., None], 3, axis=2),
        np.ones(texture.shape, np.bool_),
        place.centre + to_map @ corner,
        to_map @ right * wide,
        to_map @ down * high,
        smooth=True,
    )


def panel_ranges(panel: FlatPanel, origin: Array, directions: Array) -> Array:
    """Distances at which beams meet a panel, m; inf = they do not; (n,).

    Args:
        panel: in the map.
        origin: of the beams in the map, m, (3,).
        directions: unit vectors in the map, (n, 3).
    """
    normal = np.cross(panel.right, panel.down)
    with np.errstate(divide="ignore", invalid="ignore"):
        way = float(normal @ (panel.corner - origin)) / (directions @ normal)
        on = way[:, None] * directions + (origin - panel.corner)
        across = on @ panel.right / (panel.right @ panel.right)
        along = on @ panel.down / (panel.down @ panel.down)
        met = (way > 0) & (across >= 0) & (across <= 1) & (along >= 0) & (along <= 1)
    return np.where(met, way, np.inf)


@cache
def board_texture(columns: int, rows: int, square: float, marker: float) -> NDArray[np.uint8]:
    """The print, ``SQUARE_PIXELS`` pixels a square.

    Raises:
        NotInstalledError: the extra ``vision`` is not there.
    """
    cv2 = opencv("sim.world.board")
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    board = cv2.aruco.CharucoBoard((columns, rows), square, marker, family)
    square_pixels = 40  # pixels of a board's square in its texture
    drawn = board.generateImage((columns * square_pixels, rows * square_pixels), marginSize=0)
    return np.asarray(drawn, dtype=np.uint8)
