"""Detection of a ChArUco board: a chessboard with markers in its white squares, so that a part of it suffices.

The corners are those of the chessboard, to a fraction of a pixel; the markers identify them (Garrido-Jurado et al.,
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
    """A board in an image."""

    corners: Array
    """Corners, shape (n, 2) (pixels)."""
    ids: NDArray[np.int64]
    """Numbers of the corners on the board, shape (n,)."""
    blur: float
    """Standard deviation of the step of an edge (pixels); 0.5 is the sharpest possible."""


class BoardReader:
    """Detects a board in one camera's images.

    Args:
        board: board as printed.
    """

    def __init__(self, board: BoardConfig) -> None:
        cv2.setNumThreads(1)
        self.board = board
        size = (board.columns, board.rows)
        self._printed = cv2.aruco.CharucoBoard(size, board.square, board.marker, dictionary())
        self._detector = cv2.aruco.CharucoDetector(self._printed)
        self.points: Array = np.asarray(self._printed.getChessboardCorners(), dtype=np.float64).reshape(-1, 3)
        """Corners on the board, shape (corners, 3) (m): right and down from its upper left corner."""
        self._known = len(self._printed.getIds())
        self.strangers: set[int] = set()
        """Markers seen so far that do not belong to this board."""

    def read(self, picture: Picture) -> BoardSighting | None:
        """Return the board in the next image; None if too few corners are visible, or all on one line."""
        corners, ids, _, markers = self._detector.detectBoard(picture)
        self.strangers |= (
            {int(tag) for tag in np.ravel(markers) if tag >= self._known} if markers is not None else set()
        )
        if ids is None or len(ids) < 8:  # minimum number of corners of a board in an image
            return None
        numbers, found = np.asarray(ids, dtype=np.int64).ravel(), np.asarray(corners, dtype=np.float64).reshape(-1, 2)
        if any(np.unique(places).size < 2 for places in np.divmod(numbers, self.board.columns - 1)):
            return None
        return BoardSighting(found, numbers, edge_blur(picture, found))


def edge_blur(picture: Picture, corners: Array) -> float:
    """Return the standard deviation of the edges' step around chessboard corners (pixels).

    A step blurred by a Gaussian has its maximum slope, contrast / (sqrt(2 pi) sigma), in its middle.
    """
    found = []
    profile = 6  # pixels on both sides of an edge over which its width is measured
    for x, y in np.rint(corners).astype(int):
        patch = picture[max(y - profile, 0) : y + profile + 1, max(x - profile, 0) : x + profile + 1].astype(np.float64)
        if min(patch.shape) <= profile:
            continue
        contrast = float(np.subtract(*np.percentile(patch, (90, 10))))
        down, right = np.gradient(patch)
        slope = float(np.percentile(np.hypot(down, right), 95))
        found.append(contrast / max(math.sqrt(math.tau) * slope, 1e-6))
    return float(np.median(found)) if found else math.inf
