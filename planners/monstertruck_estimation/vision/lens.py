"""Lens model: conversion of pixels to directions, and calibration from images of a flat board.

The lens model is Brown's (two radial and two tangential terms; the third radial one stays 0). It is fitted to images of
a board held at any angle: Zhang, "A flexible new technique for camera calibration", IEEE Transactions on Pattern
Analysis and Machine Intelligence, 2000; by OpenCV's ``calibrateCameraExtended``.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import cv2
import numpy as np

from monstertruck_estimation.vision.board import BoardReader, BoardSighting
from monstertruck_estimation.vision.tags import Picture
from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.body import LensConfig

LEAST_BOARDS: Final = 6
"""Images of the board."""
PARAMETERS: Final = ("focal_x", "focal_y", "centre_x", "centre_y", "k1", "k2", "p1", "p2")
"""Fitted lens parameters in OpenCV's order."""


@dataclass(frozen=True)
class Lens:
    """Projection of a camera."""

    matrix: Array
    """Camera matrix, shape (3, 3) (pixels)."""
    distortion: Array
    """Distortion k1, k2, p1, p2, k3, shape (5,)."""
    size: tuple[int, int]
    """Width and height (pixels)."""

    @classmethod
    def of(cls, config: LensConfig, width: int, height: int) -> "Lens":
        """Build a lens from the configuration, also for images of another size than in the calibration."""
        across, up = width / config.width, height / config.height
        matrix = np.array(
            (
                (config.focal_x * across, 0.0, (config.centre_x + 0.5) * across - 0.5),
                (0.0, config.focal_y * up, (config.centre_y + 0.5) * up - 0.5),
                (0.0, 0.0, 1.0),
            )
        )
        distortion = np.array((config.k1, config.k2, config.p1, config.p2, config.k3))
        return cls(matrix, distortion, (width, height))

    def directions(self, pixels: Array) -> Array:
        """Return x and y of the rays through pixels at z = 1 of the camera; (n, 2) both."""
        points = np.ascontiguousarray(pixels, dtype=np.float64).reshape(-1, 1, 2)
        return np.asarray(cv2.undistortPoints(points, self.matrix, self.distortion)).reshape(-1, 2)

    @property
    def parameters(self) -> Array:
        """Return the values of ``PARAMETERS``, (8,)."""
        (fx, _, cx), (_, fy, cy), _ = self.matrix.tolist()
        return np.array((fx, fy, cx, cy, *self.distortion[:4]))


class LensFit(NamedTuple):
    """A lens with its uncertainty."""

    lens: Lens
    sigmas: Array
    """Standard deviations of ``PARAMETERS``, (8,): the larger of corner noise and scatter between views."""
    rms: float
    """RMS residual of the corners (pixels), both axes together."""
    corners: int
    by_view: tuple[float, ...]
    """RMS residual of each view (pixels)."""


def fit_lens(views: Sequence[BoardSighting], reader: BoardReader, size: tuple[int, int]) -> LensFit:
    """Fit a lens to sightings of a board.

    Args:
        views: views of the board.
        reader: reader that found them.
        size: width and height of the images (pixels).

    Raises:
        InputError: too few sightings, or none of them tilted.
    """
    if len(views) < LEAST_BOARDS:
        raise InputError(f"the board is visible in {len(views)} images: expected {LEAST_BOARDS}")
    objects = [reader.points[view.ids].astype(np.float32) for view in views]
    images = [view.corners.astype(np.float32) for view in views]
    try:
        rms, matrix, distortion, turns, places, sigmas, _, off = cv2.calibrateCameraExtended(
            objects, images, size, np.eye(3), np.zeros(5), flags=cv2.CALIB_FIX_K3
        )
    except cv2.error as error:
        raise InputError(f"the images of the board do not determine the lens: {error.err}: hold it tilted") from error
    count = sum(len(view.ids) for view in views)
    lens = Lens(np.asarray(matrix), np.ravel(distortion)[:5], size)
    poses = zip(views, turns, places, strict=True)
    spread = sigmas_by_view([_slopes(view, reader, lens, turn, place) for view, turn, place in poses])
    return LensFit(
        lens, np.maximum(np.ravel(sigmas)[: len(PARAMETERS)], spread), float(rms), count, tuple(np.ravel(off).tolist())
    )


def sigmas_by_view(views: Sequence[tuple[Array, Array, Array]]) -> Array:
    """Return the standard deviations of a lens's parameters from the scatter between views, (8,).

    The corner errors of one view may be correlated (a bent board, an edge at a slant to the pixels), so only views are
    independent measurements. The covariance by clusters follows Liang and Zeger ("Longitudinal data analysis using
    generalized linear models", Biometrika 1986), corrected for the number of clusters.

    Args:
        views: per view, derivatives by the parameters of the lens (2 n, 8) and of the pose (2 n, 6), and residuals (2
            n,).
    """
    information, scores = np.zeros((len(PARAMETERS), len(PARAMETERS))), []
    for by_lens, by_pose, off in views:
        rest = by_lens - by_pose @ np.linalg.lstsq(by_pose, by_lens, rcond=None)[0]
        information += rest.T @ rest
        scores.append(rest.T @ off)
    inverse = np.linalg.inv(information)
    covariance = inverse @ np.sum([np.outer(score, score) for score in scores], axis=0) @ inverse
    correction = len(views) / max(len(views) - len(PARAMETERS), 1)
    return np.asarray(np.sqrt(np.diag(covariance) * correction))


def _slopes(
    view: BoardSighting, reader: BoardReader, lens: Lens, turn: Array, place: Array
) -> tuple[Array, Array, Array]:
    """Return the inputs of ``sigmas_by_view``."""
    shown, slopes = cv2.projectPoints(reader.points[view.ids], turn, place, lens.matrix, lens.distortion)
    found = np.asarray(slopes, dtype=np.float64)
    return found[:, 6 : 6 + len(PARAMETERS)], found[:, :6], (view.corners - np.asarray(shown).reshape(-1, 2)).ravel()


def lens_from_pictures(pictures: Sequence[Picture], reader: BoardReader) -> tuple[LensFit, int]:
    """Fit a lens to images of a board; return it with the number of usable images. Raises as ``fit_lens``."""
    views = [view for picture in pictures if (view := reader.read(picture)) is not None]
    if len(views) < LEAST_BOARDS:
        raise InputError(f"the board is visible in {len(views)} of {len(pictures)} images: expected {LEAST_BOARDS}")
    height, width = pictures[0].shape
    return fit_lens(views, reader, (width, height)), len(views)


class BoardPose(NamedTuple):
    """Pose of a board relative to a camera."""

    axes: Array
    """Rotation, (3, 3): columns are the board's right, down, and backward axes in the camera's axes."""
    place: Array
    """Upper left corner, (3,) (m)."""
    rms: float
    """RMS residual of the corners (pixels)."""

    @property
    def turn(self) -> float:
        """Turn about the vertical (rad); positive if the left edge is nearer."""
        return math.atan2(-float(self.axes[0, 2]), float(self.axes[2, 2]))

    @property
    def lean(self) -> float:
        """Lean (rad); positive if the upper edge is nearer."""
        return math.atan2(-float(self.axes[1, 2]), float(self.axes[2, 2]))


def board_pose(view: BoardSighting, reader: BoardReader, lens: Lens) -> BoardPose | None:
    """Return the pose of a board (Collins and Bartoli's solution, refined); None if no pose fits."""
    points = reader.points[view.ids]
    fine, turn, place = cv2.solvePnP(points, view.corners, lens.matrix, lens.distortion, flags=cv2.SOLVEPNP_IPPE)
    if not fine:
        return None
    turn, place = cv2.solvePnPRefineLM(points, view.corners, lens.matrix, lens.distortion, turn, place)
    shown, _ = cv2.projectPoints(points, turn, place, lens.matrix, lens.distortion)
    off = np.asarray(shown).reshape(-1, 2) - view.corners
    return BoardPose(
        np.asarray(cv2.Rodrigues(turn)[0]), np.ravel(place), float(np.sqrt(np.mean(np.sum(off**2, axis=1))))
    )
