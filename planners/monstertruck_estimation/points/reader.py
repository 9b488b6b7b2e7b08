"""Worker step that reads images and returns tags with their poses relative to the camera. Loads OpenCV.

A tag's pose is the pose of its square (Collins and Bartoli, "Infinitesimal plane-based pose estimation", IJCV 2014; in
OpenCV ``SOLVEPNP_IPPE_SQUARE``). The problem has two solutions: a small distant square looks the same when turned to
either side. Both are refined to the minimum reprojection error before their comparison: unrefined, the slant of a tag
seen from the front scatters about nine times as much.
"""

from dataclasses import replace
from typing import Final, NamedTuple

import cv2
import numpy as np

from monstertruck_estimation.points.exchange import ReadAnswer, ReadTask, TagReading, Triple
from monstertruck_estimation.vision.lens import Lens
from monstertruck_estimation.vision.tags import Picture, Sighting, TagReader, cells, drawn
from monstertruck_kinematics.elementary import Array
from monstertruck_schemas.board import TagFamily


class ReadingStep:
    """Read images one by one; the detector of the last tag family is reused."""

    def __init__(self) -> None:
        self._family: TagFamily = "36h11"
        self._reader = TagReader(everywhere=1, corners="edges")

    def step(self, task: ReadTask) -> ReadAnswer:
        """Read one image."""
        data = np.frombuffer(task.jpeg, np.uint8)
        colour = cv2.imdecode(data, cv2.IMREAD_COLOR) if len(data) else None
        if colour is None:
            return ReadAnswer(unreadable=True)
        grey: Picture = np.asarray(cv2.cvtColor(colour, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
        if task.family != self._family:
            self._family = task.family
            self._reader = TagReader(everywhere=1, corners="edges", family=task.family)
        found = []
        lens = Lens.of(task.lens, grey.shape[1], grey.shape[0])
        for sighting in self._reader.read(grey):
            margin = decode_margin(grey, sighting, task.family)
            reading = placed(sighting, task.sizes.get(sighting.tag, task.size), lens, margin)
            near = reading is not None and float(np.linalg.norm(reading.middle)) <= task.reach
            if reading is not None and near and margin >= task.margin and reading.angle <= task.angle:
                found.append(_with_picture(reading, colour, sighting))
        return ReadAnswer(tuple(found))


def decode_margin(grey: Picture, sighting: Sighting, family: TagFamily = "36h11") -> float:
    """Return the contrast of the worst cell: 1 for black or white, 0 for grey, negative for the opposite colour."""
    count = cells(family)
    samples = 6  # pixels sampled per cell
    side = count * samples
    square = np.array(((0, 0), (side, 0), (side, side), (0, side)), np.float32) - 0.5
    turned = cv2.getPerspectiveTransform(sighting.corners.astype(np.float32), square.astype(np.float32))
    flat = cv2.warpPerspective(grey, turned, (side, side), flags=cv2.INTER_LINEAR)
    core = slice(samples // 3, samples - samples // 3)
    means = np.asarray(flat, dtype=np.float64).reshape(count, samples, count, samples)[:, core, :, core].mean((1, 3))
    white = drawn(sighting.tag, count, family) > 127
    bright, dark = float(means[white].mean()), float(means[~white].mean())
    if bright - dark < 25.0:  # minimum difference of white and black, out of 255
        return -1.0
    share = (means - (bright + dark) / 2) / ((bright - dark) / 2)
    return float(np.where(white, share, -share).min())


CORNER_DEVIATION: Final = 0.25
"""Standard deviation of a corner (pixels)."""


class _Fit(NamedTuple):
    """Candidate pose of a tag that fits its corners."""

    turn: Array
    """Rotation vector (3,)."""
    place: Array
    """Centre (3,), m."""
    error: float
    """Root mean square of the reprojection error (pixels)."""
    jacobian: Array
    """Derivatives (8, 6) of the corners by rotation vector and place."""


def placed(sighting: Sighting, size: float, lens: Lens, margin: float) -> TagReading | None:
    """Return a tag relative to the camera; None if no pose fits."""
    half = size / 2
    square = np.array(((-half, half, 0), (half, half, 0), (half, -half, 0), (-half, -half, 0)))
    count, turns, places, _ = cv2.solvePnPGeneric(
        square, sighting.corners.reshape(4, 1, 2), lens.matrix, lens.distortion, flags=cv2.SOLVEPNP_IPPE_SQUARE
    )
    found = [
        _refined(square, sighting.corners, lens, *pose) for pose in zip(turns[:count], places[:count], strict=True)
    ]
    fits = sorted(
        (fit for fit in found if np.isfinite(fit.place).all() and fit.place[2] > 0), key=lambda fit: fit.error
    )
    if not fits:
        return None
    best, other = fits[0], fits[-1]
    alone = bool(np.allclose(best.turn, other.turn, atol=1e-3))  # both converged to the same pose
    doubt = 0.0 if alone else (best.error + CORNER_DEVIATION) / (other.error + CORNER_DEVIATION)
    normal, spread = _normal(best)
    away = best.place / np.linalg.norm(best.place)
    return TagReading(
        sighting.tag,
        _triple(best.place),
        _triple(normal),
        _triple(_normal(other)[0]),
        doubt,
        sighting.size,
        margin,
        float(np.arccos(np.clip(-away @ normal, -1.0, 1.0))),
        tuple(spread.ravel().tolist()),
    )


def _refined(square: Array, corners: Array, lens: Lens, turn: Array, place: Array) -> _Fit:
    """Return the pose with the minimum reprojection error near a pose."""
    turn, place = cv2.solvePnPRefineLM(
        square, corners.reshape(4, 1, 2), lens.matrix, lens.distortion, turn.copy(), place.copy()
    )
    points, jacobian = cv2.projectPoints(square, turn, place, lens.matrix, lens.distortion)
    error = float(np.sqrt(((points.reshape(4, 2) - corners) ** 2).sum(axis=1).mean()))
    return _Fit(np.ravel(turn).astype(np.float64), np.ravel(place).astype(np.float64), error, jacobian[:, :6])


def _normal(fit: _Fit) -> tuple[Array, Array]:
    """Return the normal (3,) of a tag, and the covariance (6, 6) of its centre and normal."""
    turned, slopes = cv2.Rodrigues(fit.turn)
    by_pose = np.zeros((6, 6))
    by_pose[:3, 3:] = np.eye(3)
    by_pose[3:, :3] = slopes.T.reshape(3, 3, 3)[:, 2]  # OpenCV: row i is the derivative by component i of the vector
    pose = np.linalg.pinv(fit.jacobian.T @ fit.jacobian) * CORNER_DEVIATION**2
    return np.asarray(turned)[:, 2], by_pose @ pose @ by_pose.T


def _with_picture(reading: TagReading, colour: Array, sighting: Sighting) -> TagReading:
    margin = 0.6 * sighting.size  # margin around a tag's image on each side, in tag sides
    low, high = sighting.corners.min(axis=0) - margin, sighting.corners.max(axis=0) + margin
    x0, y0 = np.maximum(low, 0).astype(int)
    x1, y1 = np.minimum(np.ceil(high), (colour.shape[1], colour.shape[0])).astype(int)
    part = colour[y0:y1, x0:x1]
    scale = 160 / max(part.shape[:2])  # maximum size of a tag's image, pixels
    if scale < 1.0:
        part = np.asarray(cv2.resize(part, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))
    _, data = cv2.imencode(".jpg", part, (cv2.IMWRITE_JPEG_QUALITY, 80))
    return replace(reading, picture=data.tobytes())


def _triple(values: Array) -> Triple:
    x, y, z = (float(value) for value in values)
    return x, y, z
