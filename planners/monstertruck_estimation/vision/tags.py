"""Tag detection, shared by all readers (Olson, "AprilTag", ICRA 2011; ArUco by its dictionaries).

OpenCV's ArUco module detects the tags; corners are the intersections of lines along the edges, to a fraction of a
pixel. A tag in view is searched for around its last and its expected place, and once in a while in the whole image.
This lets one core read several cameras.
"""

from collections.abc import Collection, Sequence
from typing import Final, Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_schemas.board import TagFamily

Picture = NDArray[np.uint8]
"""Grey image, shape (height, width)."""

EVERYWHERE: Final = 8
"""Interval between searches of the whole image, in images: a tag that appears unexpectedly is found within it."""


class Sighting(NamedTuple):
    """A tag in an image."""

    tag: int
    corners: Array
    """Corners of the black square, (4, 2) (pixels), clockwise as printed, from its upper left."""

    @property
    def size(self) -> float:
        """Mean side (pixels)."""
        return _side(self.corners)


def _side(corners: Array) -> float:
    return float(np.hypot(*(corners - np.roll(corners, 1, axis=0)).T).mean())


class TagReader:
    """Detects the tags in one camera's images.

    Args:
        everywhere: every how many pictures the whole picture is searched, beginning with the first.
        still: whether tags never move; only whole images are then searched.
        corners: corner detection: as intersections of lines along the edges, which tolerates few pixels per cell and
            dirt; or, for precise tags, to a tenth of a pixel as intersections of the edges in the original image.
        phase: offset of the searches of whole images, which lets cameras read side by side take turns.
        family: family of the tags.
    """

    def __init__(
        self,
        everywhere: int = EVERYWHERE,
        still: Collection[int] = (),
        corners: Literal["lines", "edges"] = "lines",
        phase: int = 0,
        family: TagFamily = "36h11",
    ) -> None:
        cv2.setNumThreads(1)  # cameras are read side by side; OpenCV's own threads wait for each other
        self._still = frozenset(still)
        parameters = cv2.aruco.DetectorParameters()
        if corners == "lines":
            # A window around a corner would include cells of a small tag.
            parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_CONTOUR
        else:
            parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        parameters.adaptiveThreshWinSizeMin = 5
        parameters.adaptiveThreshWinSizeMax = 21
        parameters.adaptiveThreshWinSizeStep = 8
        self._exact = corners == "edges"
        self._parameters = parameters
        self._detector = cv2.aruco.ArucoDetector(dictionary(family), parameters)
        self._everywhere = everywhere
        self._phase = phase
        self._count = 0
        self._last: dict[int, Sighting] = {}

    def read(self, picture: Picture, expected: Sequence[Array] = ()) -> list[Sighting]:
        """Return the tags of the next image.

        Args:
            picture: next image.
            expected: corners of tags where other cameras predict them, (4, 2) each (pixels).
        """
        whole = self._count == 0 or (self._count - self._phase) % self._everywhere == 0
        self._count += 1
        if whole:
            found = self._detect(picture, 0, 0)
        else:
            found = []
            places = [*(sighting.corners for sighting in self._last.values()), *expected]
            for x0, y0, x1, y1 in _windows(places, picture.shape[1], picture.shape[0]):
                found += self._detect(np.ascontiguousarray(picture[y0:y1, x0:x1]), x0, y0)
        if self._exact:
            found = [sighting._replace(corners=along_edges(picture, sighting.corners)) for sighting in found]
        by_tag = {sighting.tag: sighting for sighting in found}
        moving = {tag: sighting for tag, sighting in by_tag.items() if tag not in self._still}
        # A missed tag is searched for at its last place until the next search of the whole image.
        self._last = moving if whole else self._last | moving
        return list(by_tag.values())

    def _detect(self, picture: Picture, x0: int, y0: int) -> list[Sighting]:
        # 32: minimum outline of a tag in pixels, one per cell; smaller outlines are noise, and each costs time
        self._parameters.minMarkerPerimeterRate = 32 / max(picture.shape)
        self._detector.setDetectorParameters(self._parameters)
        corners, ids, _ = self._detector.detectMarkers(picture)
        if ids is None:
            return []
        return [
            Sighting(int(tag), np.asarray(points, dtype=np.float64).reshape(4, 2) + (x0, y0))  # noqa: RUF005
            for tag, points in zip(np.ravel(ids), corners, strict=True)
        ]


ACROSS: Final = np.linspace(-2.5, 2.5, 21)
"""Maximum distance from an edge in the search for its step (pixels)."""


def along_edges(picture: Picture, corners: Array) -> Array:
    """Return corners as intersections of the lines through the steps along each edge, (4, 2).

    OpenCV's own corners lie inside the true ones: a tag with sides of 35 pixels seems 1.4 % smaller, hence more
    distant.
    """
    lines = []
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        length = float(np.hypot(*(end - start)))
        along = (end - start) / length
        across = np.array((along[1], -along[0]))
        sharp_part = (0.12, 0.88)  # used part of an edge: blur rounds its ends
        points = start + np.linspace(*sharp_part, max(8, int(length)))[:, None] * length * along
        samples = (points[:, None] + ACROSS[:, None] * across).astype(np.float32)
        values = np.asarray(cv2.remap(picture, samples, None, cv2.INTER_LINEAR), dtype=np.float64)
        steps = np.abs(np.diff(values, axis=1))
        middles = (ACROSS[1:] + ACROSS[:-1]) / 2
        off = (steps**2 @ middles) / np.maximum((steps**2).sum(axis=1), 1e-9)
        clear = steps.max(axis=1) > 3.0  # minimum step of an edge from sample to sample, of 255
        if clear.sum() < 4:
            return corners
        # 0.7: maximum distance of a sample from its edge, pixels
        clear &= np.abs(off - np.median(off[clear])) < 0.7
        on = points[clear] + off[clear, None] * across
        middle = on.mean(axis=0)
        lines.append((middle, np.linalg.svd(on - middle)[2][0]))
    found = []
    for (one, direction), (other, towards) in zip([lines[-1], *lines[:-1]], lines, strict=True):
        crossing = np.array((direction, -towards)).T
        if abs(float(np.linalg.det(crossing))) < 0.1:
            return corners
        found.append(one + np.linalg.solve(crossing, other - one)[0] * direction)
    return np.array(found)


def dictionary(family: TagFamily = "36h11") -> "cv2.aruco.Dictionary":
    """Return the tags of a family."""
    if family[0].isdigit():
        name = f"DICT_APRILTAG_{family}"
    else:
        name = "DICT_" + family.upper() if family == "aruco_original" else family.upper().replace("ARUCO", "DICT")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def cells(family: TagFamily = "36h11") -> int:
    """Return the number of cells along a side of a tag's black square."""
    return int(dictionary(family).markerSize) + 2


def drawn(tag: int, pixels: int, family: TagFamily = "36h11") -> Picture:
    """Return a printable tag without its white margin, (pixels, pixels)."""
    return np.asarray(cv2.aruco.generateImageMarker(dictionary(family), tag, pixels), dtype=np.uint8)


def _windows(places: Sequence[Array], width: int, height: int) -> list[tuple[int, int, int, int]]:
    """Return boxes around the corners of each tag, overlapping ones merged: x0, y0, x1, y1 (pixels)."""
    boxes: list[tuple[int, int, int, int]] = []
    for corners in places:
        # 16: pixels 1.0: margin of the window on each side of a tag, in tag sizes: its maximum motion between two
        # images
        margin = max(16, round(1.0 * _side(corners)))
        low, high = corners.min(axis=0), corners.max(axis=0)
        box = (
            max(int(low[0]) - margin, 0),
            max(int(low[1]) - margin, 0),
            min(int(high[0]) + margin, width),
            min(int(high[1]) + margin, height),
        )
        if box[0] >= box[2] or box[1] >= box[3]:
            continue  # outside the image
        while (other := next((b for b in boxes if _overlap(b, box)), None)) is not None:
            boxes.remove(other)
            box = (min(box[0], other[0]), min(box[1], other[1]), max(box[2], other[2]), max(box[3], other[3]))
        boxes.append(box)
    return boxes


def _overlap(a: tuple[int, int, int, int], b: tuple[int, int, int, int]) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]
