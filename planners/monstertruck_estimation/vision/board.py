"""The ChArUco board in a picture: a chessboard whose white squares carry markers, so that a part of it is enough.

Corners are the chessboard's, to a fraction of a pixel; the markers identify them (Garrido-Jurado et al.,
"Automatic generation and detection of highly reliable fiducial markers under occlusion", Pattern Recognition 2014;
OpenCV's ``CharucoDetector``).
"""

import math
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from monstertruck_estimation.vision.tags import Picture, dictionary
from monstertruck_kinematics.elementary import Array
from monstertruck_schemas.board import BoardConfig


class BoardSighting(NamedTuple):
    """A board in a picture."""

    corners: Array
    """(n, 2), pixels."""
    ids: NDArray[np.int64]
    """(n,): which corners of the board."""
    blur: float
    """Standard deviation of the step of an edge, pixels; 0.5 is as sharp as pixels are."""


class BoardReader:
    """Finds a board in one camera's pictures.

    Args:
        board: as printed.
    """

    def __init__(self, board: BoardConfig) -> None:
        cv2.setNumThreads(1)
        self.board = board
        size = (board.columns, board.rows)
        self._printed = cv2.aruco.CharucoBoard(size, board.square, board.marker, dictionary())
        self._detector = cv2.aruco.CharucoDetector(self._printed)
        self.points: Array = np.asarray(self._printed.getChessboardCorners(), dtype=np.float64).reshape(-1, 3)
        """(corners, 3), m: on the board, right and down from its upper left corner."""
        self._known = len(self._printed.getIds())
        self.strangers: set[int] = set()
        """Markers seen so far that are not of this board."""

    def read(self, picture: Picture) -> BoardSighting | None:
        """The board in the next picture; None if too few of its corners are seen, or all in one line."""
        corners, ids, _, markers = self._detector.detectBoard(picture)
        self.strangers |= (
            {int(tag) for tag in np.ravel(markers) if tag >= self._known} if markers is not None else set()
        )
        if ids is None or len(ids) < 8:  # least number of corners of a board in a picture
            return None
        numbers, found = np.asarray(ids, dtype=np.int64).ravel(), np.asarray(corners, dtype=np.float64).reshape(-1, 2)
        if any(np.unique(places).size < 2 for places in np.divmod(numbers, self.board.columns - 1)):
            return None
        return BoardSighting(found, numbers, edge_blur(picture, found))


def edge_blur(picture: Picture, corners: Array) -> float:
    """Standard deviation of the step of the edges around corners of a chessboard, pixels.

    A step blurred by a Gaussian has its greatest slope, contrast / (sqrt(2 pi) sigma), in its middle.
    """
    found = []
    profile = 6  # pixels to both sides of an edge, over which its width is measured
    for x, y in np.rint(corners).astype(int):
        patch = picture[max(y - profile, 0) : y + profile + 1, max(x - profile, 0) : x + profile + 1].astype(np.float64)
        if min(patch.shape) <= profile:
            continue
        contrast = float(np.subtract(*np.percentile(patch, (90, 10))))
        down, right = np.gradient(patch)
        slope = float(np.percentile(np.hypot(down, right), 95))
        found.append(contrast / max(math.sqrt(math.tau) * slope, 1e-6))
    return float(np.median(found)) if found else math.inf
