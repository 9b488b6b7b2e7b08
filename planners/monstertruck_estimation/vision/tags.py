"""Tags in a picture: the one place where they are read (Olson, "AprilTag", ICRA 2011; ArUco by its dictionaries).

OpenCV's ArUco module finds them; corners are crossings of lines along the edges, to a part of a pixel. A tag that stays
in view is looked for around its last place and where it is expected, and everywhere once in a while, which lets one
core read several cameras.
"""

from collections.abc import Collection, Sequence
from typing import Final, Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_schemas.board import TagFamily

Picture = NDArray[np.uint8]
"""Grey, (height, width)."""

EVERYWHERE: Final = 8
"""Pictures from one look at the whole of it to the next: a tag that appears is found in the one after so many at the
latest, also where it was not expected."""


class Sighting(NamedTuple):
    """A tag in a picture."""

    tag: int
    corners: Array
    """(4, 2), pixels: of the black square, clockwise as printed, from its upper left one."""

    @property
    def size(self) -> float:
        """Mean side, pixels."""
        return _side(self.corners)


def _side(corners: Array) -> float:
    return float(np.hypot(*(corners - np.roll(corners, 1, axis=0)).T).mean())


class TagReader:
    """Reads the tags of one camera's pictures.

    Args:
        everywhere: every how many pictures the whole picture is searched, beginning with the first.
        still: tags that do not move: they are read in whole pictures only.
        corners: how they are found: as crossings of lines along the edges, which bears tags of few pixels a cell and
            dirt, or to a tenth of a pixel as crossings of the edges of the picture itself, for tags that are measured.
        phase: which ones of the pictures are looked at as a whole: cameras that are read side by side take turns.
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
            # A window around a corner takes in cells of a small tag.
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
        """Tags of the next picture.

        Args:
            picture: next one.
            expected: corners of tags, (4, 2) each, pixels, where others say that they are.
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
        # One that was missed is looked for where it was until the whole picture is looked at.
        self._last = moving if whole else self._last | moving
        return list(by_tag.values())

    def _detect(self, picture: Picture, x0: int, y0: int) -> list[Sighting]:
        # 32: minimum outline of a tag in pixels, one for each of its cells: smaller outlines are noise, and each costs
        # time
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
"""Pixels from an edge, over which its step is looked for."""


def along_edges(picture: Picture, corners: Array) -> Array:
    """Corners as crossings of the lines through the steps of the picture along each edge, (4, 2).

    OpenCV's own ones lie inwards of the true ones: at 35 pixels a side a tag seems 1.4 % smaller, so more distant.
    """
    lines = []
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        length = float(np.hypot(*(end - start)))
        along = (end - start) / length
        across = np.array((along[1], -along[0]))
        sharp_part = (0.12, 0.88)  # part of an edge that is looked at: its ends are rounded by blur
        points = start + np.linspace(*sharp_part, max(8, int(length)))[:, None] * length * along
        samples = (points[:, None] + ACROSS[:, None] * across).astype(np.float32)
        values = np.asarray(cv2.remap(picture, samples, None, cv2.INTER_LINEAR), dtype=np.float64)
        steps = np.abs(np.diff(values, axis=1))
        middles = (ACROSS[1:] + ACROSS[:-1]) / 2
        off = (steps**2 @ middles) / np.maximum((steps**2).sum(axis=1), 1e-9)
        clear = steps.max(axis=1) > 3.0  # least step of an edge from sample to sample, of 255
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
    """Return the cells of a tag's black square along a side."""
    return int(dictionary(family).markerSize) + 2


def drawn(tag: int, pixels: int, family: TagFamily = "36h11") -> Picture:
    """A tag to be printed, its white rim left aside; (pixels, pixels)."""
    return np.asarray(cv2.aruco.generateImageMarker(dictionary(family), tag, pixels), dtype=np.uint8)


def _windows(places: Sequence[Array], width: int, height: int) -> list[tuple[int, int, int, int]]:
    """Boxes around the corners of each tag, overlapping ones joined: x0, y0, x1, y1, pixels."""
    boxes: list[tuple[int, int, int, int]] = []
    for corners in places:
        # 16: pixels
        # 1.0: margin of the window around a tag on each side, in sizes of the tag: how far it may move between two
        # pictures
        margin = max(16, round(1.0 * _side(corners)))
        low, high = corners.min(axis=0), corners.max(axis=0)
        box = (
            max(int(low[0]) - margin, 0),
            max(int(low[1]) - margin, 0),
            min(int(high[0]) + margin, width),
            min(int(high[1]) + margin, height),
        )
        if box[0] >= box[2] or box[1] >= box[3]:
            continue  # out of the picture
        while (other := next((b for b in boxes if _overlap(b, box)), None)) is not None:
            boxes.remove(other)
            box = (min(box[0], other[0]), min(box[1], other[1]), max(box[2], other[2]), max(box[3], other[3]))
        boxes.append(box)
    return boxes


def _overlap(a: tuple[int, int, int, int], b: tuple[int, int, int, int]) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]
