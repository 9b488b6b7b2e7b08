"""Reading step for workers: takes an image, returns tags with their places relative to the camera. Loads OpenCV.

The pose of a tag is its square's (Collins and Bartoli, "Infinitesimal plane-based pose estimation", IJCV 2014;
in OpenCV ``SOLVEPNP_IPPE_SQUARE``). It has two solutions: from afar, a small square turned to either side looks the
same.
"""

import cv2
import numpy as np

from monstertruck_estimation.points.exchange import ReadAnswer, ReadTask, TagReading, Triple
from monstertruck_estimation.vision.lens import Lens
from monstertruck_estimation.vision.tags import Picture, Sighting, TagReader, cells, drawn
from monstertruck_kinematics.elementary import Array
from monstertruck_schemas.board import TagFamily


class ReadingStep:
    """Read images one by one; keeps the reader of the last family."""

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


def placed(sighting: Sighting, size: float, lens: Lens, margin: float) -> TagReading | None:
    """Return a tag relative to the camera; None if no pose fits."""
    half = size / 2
    square = np.array(((-half, half, 0), (half, half, 0), (half, -half, 0), (-half, -half, 0)))
    count, rotations, places, errors = cv2.solvePnPGeneric(
        square, sighting.corners.reshape(4, 1, 2), lens.matrix, lens.distortion, flags=cv2.SOLVEPNP_IPPE_SQUARE
    )
    if not count:
        return None
    middle = np.asarray(places[0], dtype=np.float64).ravel()
    if not np.isfinite(middle).all() or middle[2] <= 0:
        return None
    normals = [np.asarray(cv2.Rodrigues(turn)[0])[:, 2] for turn in rotations[:count]]
    fits = [float(np.ravel(error)[0]) for error in errors[:count]]
    pixel = 0.25  # standard deviation of a corner, pixels
    doubt = 0.0 if count < 2 else min(1.0, (fits[0] + pixel) / (fits[1] + pixel))
    away = middle / np.linalg.norm(middle)
    return TagReading(
        sighting.tag,
        _triple(middle),
        _triple(normals[0]),
        _triple(normals[-1]),
        doubt,
        sighting.size,
        margin,
        float(np.arccos(np.clip(-away @ normals[0], -1.0, 1.0))),
    )


def _with_picture(reading: TagReading, colour: Array, sighting: Sighting) -> TagReading:
    margin = 0.6 * sighting.size  # margin of a tag's image on each side, in sides of the tag
    low, high = sighting.corners.min(axis=0) - margin, sighting.corners.max(axis=0) + margin
    x0, y0 = np.maximum(low, 0).astype(int)
    x1, y1 = np.minimum(np.ceil(high), (colour.shape[1], colour.shape[0])).astype(int)
    part = colour[y0:y1, x0:x1]
    scale = 160 / max(part.shape[:2])  # maximum size of a tag's image, pixels
    if scale < 1.0:
        part = np.asarray(cv2.resize(part, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))
    _, data = cv2.imencode(".jpg", part, (cv2.IMWRITE_JPEG_QUALITY, 80))
    return TagReading(
        reading.tag, reading.middle, reading.normal, reading.other_normal, reading.doubt, reading.pixels,
        reading.margin, reading.angle, data.tobytes(),
    )  # fmt: skip


def _triple(values: Array) -> Triple:
    x, y, z = (float(value) for value in values)
    return x, y, z
