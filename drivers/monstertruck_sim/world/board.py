"""Calibration board held in front of a camera: its pose, its appearance, and the ranges a lidar measures to it."""

import math
from functools import cache

import numpy as np
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.clock import SECOND
from monstertruck_sim.world.camera import CameraPlace, FlatPanel, opencv
from monstertruck_sim.world.config import HeldBoard
from monstertruck_sim.world.noise import BOARD, generator


class BoardHolder:
    """A person who holds a board in front of a camera and changes its pose at intervals.

    Args:
        board: the board and the duration of each pose.
        field_of_view: the camera's field of view (rad).
        seed: seed for the board poses.

    Raises:
        NotInstalledError: the extra ``vision`` is not installed.
    """

    def __init__(self, board: HeldBoard, field_of_view: float, seed: int) -> None:
        board_texture(board.columns, board.rows, board.square, board.marker)
        self._board, self._field_of_view, self._seed = board, field_of_view, seed

    def panel_at(self, time_ns: int, place: CameraPlace) -> FlatPanel:
        """Return the board at a time at which the camera is at ``place``."""
        slot = time_ns // round(self._board.hold * SECOND)
        return held(self._board, place, generator(self._seed, BOARD, slot), self._field_of_view)


def held(board: HeldBoard, place: CameraPlace, rng: np.random.Generator, field_of_view: float) -> FlatPanel:
    """Return the board at a random position in the view, rotated by up to 30 degrees and tilted by 17 to 40."""
    texture = board_texture(board.columns, board.rows, board.square, board.marker)
    wide, high = (printed * board.printed_scale for printed in (board.width, board.height))
    away = rng.uniform(0.9, 1.7) * max(wide, high) / math.tan(field_of_view / 2)
    # Offset of the board's centre from the optical axis, as fractions of half the image width.
    aside, below = rng.uniform(-0.5, 0.5), rng.uniform(-0.4, 0.4)
    aside, below = (part * away * math.tan(field_of_view / 2) for part in (aside, below))
    upright = 0.35  # maximum rotation about the optical axis, rad
    spin, tilt = rng.uniform(-upright, upright), rng.uniform(-0.55, 0.55)
    lean = float(rng.choice((-1.0, 1.0))) * rng.uniform(0.3, 0.7)
    # Board axes in the camera frame: right and down, rotated about the optical axis, then tilted.
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
    """Return each beam's range to a panel (m), shape (n,); inf if the beam misses it.

    Args:
        panel: panel in the map frame.
        origin: origin of the beams in the map frame, (3,) (m).
        directions: unit vectors in the map frame, (n, 3).
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
    """Draw the board's print, ``square_pixels`` pixels per square.

    Raises:
        NotInstalledError: the extra ``vision`` is not installed.
    """
    cv2 = opencv("sim.world.board")
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    board = cv2.aruco.CharucoBoard((columns, rows), square, marker, family)
    square_pixels = 40  # pixels per board square in the texture
    drawn = board.generateImage((columns * square_pixels, rows * square_pixels), marginSize=0)
    return np.asarray(drawn, dtype=np.uint8)
