"""Camera views of a hand-held board, and the views still missing; processed image by image, without side effects.

A view is valid if the operator held the board still for a moment: the corners are averaged over that time, and the view
includes the lidar scans from that time.
"""

import math
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from monstertruck_estimation.vision.board import BoardReader, BoardSighting
from monstertruck_estimation.vision.lens import BoardPose, Lens, board_pose
from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.sensor import LaserScan
from monstertruckd.tools.calibrate.beams import bearings_of, stacked_ranges

HOLD: Final = round(0.7 * SECOND)
"""Hold time of the board (ns)."""
BLURRED: Final = 2.0
"""Standard deviation of an edge step above which an image is blurred (px)."""
LEAST_SCANS: Final = 3
"""Minimum scans per view."""
ROWS: Final = ("upper", "middle", "lower")
COLUMNS: Final = ("left", "middle", "right")
TILT: Final = math.radians(12.0)
STEEP: Final = math.radians(30.0)
SIDES: Final = ("left edge closer", "right edge closer", "top edge closer", "bottom edge closer")


@dataclass(frozen=True)
class BoardView:
    """View of a board that was held still."""

    sighting: BoardSighting
    """Corners, averaged over the images of the view"""
    pose: BoardPose
    """Pose by the lens configured at that time"""
    angles: Array
    """Lidar beam angles (rad), left positive; (n,); empty if there were too few scans"""
    ranges: Array
    """Median ranges over the same time (m); inf: no return; (n,)"""


def of_scans(scans: Sequence[LaserScan]) -> tuple[Array, Array]:
    """Return beam angles (rad) and median ranges (m); empty if there are too few scans."""
    if len(scans) < LEAST_SCANS:
        return np.empty(0), np.empty(0)
    return bearings_of(scans[0]), np.median(stacked_ranges(scans, np.inf), axis=0)


@dataclass
class BoardAttempts:
    """Number of images since the last view, by defect."""

    pictures: int = 0
    unseen: int = 0
    blurred: int = 0
    blur: float = 0.0
    """Blur of the last blurred view (px)"""
    moved: int = 0
    damaged: int = 0


@dataclass
class BoardGuide:
    """Collects images, keeps valid views, and lists the missing ones.

    Args:
        reader: reader of the board.
        lens: configured lens, used only to estimate tilts and distances.
        beams: whether the lidar also sees the board in a view; None without a lidar.
        patience: timeout without a new view (s).
    """

    reader: BoardReader
    lens: Lens
    beams: Callable[[BoardView], bool] | None
    patience: float
    views: list[BoardView] = field(default_factory=list)
    seen_by_lidar: list[BoardView] = field(default_factory=list)
    attempts: BoardAttempts = field(default_factory=BoardAttempts)
    _held: list[tuple[int, BoardSighting]] = field(default_factory=list)
    _scans: deque[LaserScan] = field(default_factory=lambda: deque(maxlen=64))
    _since: int | None = None

    def take(
        self, stamp: int, sighting: BoardSighting | None, scans: Iterable[LaserScan] = (), *, damaged: bool = False
    ) -> BoardView | None:
        """Process the next image; return the view that it completes, if any.

        Args:
            stamp: image time (ns).
            sighting: the board in the image; None if the board is not visible, or if the image is ``damaged``.
            scans: scans since the last call.
            damaged: whether the image could not be decoded.

        Raises:
            InputError: no new view for too long; the message names the fault or the missing views.
        """
        self._scans.extend(scans)
        self.attempts.damaged += damaged
        self._since = stamp if self._since is None else self._since
        view = self._view(stamp, sighting)
        if view is not None:
            self.keep(view)
            self.attempts, self._since = BoardAttempts(), stamp
        elif stamp - self._since > self.patience * SECOND:
            raise InputError(self.trouble())
        return view

    def keep(self, view: BoardView) -> None:
        """Store a view."""
        self.views.append(view)
        if self.beams is not None and self.beams(view):
            self.seen_by_lidar.append(view)

    def _view(self, stamp: int, sighting: BoardSighting | None) -> BoardView | None:
        attempts = self.attempts
        attempts.pictures += 1
        if sighting is None or sighting.blur > BLURRED:
            self._held = []
            if sighting is None:
                attempts.unseen += 1
            else:
                attempts.blurred, attempts.blur = attempts.blurred + 1, sighting.blur
            return None
        # 1.0: maximum motion of four corners of five during the hold (px): a single corner may be detected wrongly
        if self._held and moved(self._held[0][1], sighting) > 1.0:
            attempts.moved += 1
            self._held = []
        self._held.append((stamp, sighting))
        first = self._held[0][0]
        if stamp - first < HOLD or len(self._held) < 3:  # minimum images per view
            return None
        mean = averaged([seen for _, seen in self._held])
        self._held = self._held[-1:]
        # 12.0: minimum mean distance of the corners from the corners of every other view (px)
        if any(apart(view.sighting, mean).mean() < 12.0 for view in self.views if _shared(view.sighting, mean)):
            return None
        pose = board_pose(mean, self.reader, self.lens)
        if pose is None:
            return None
        scans = [s for s in self._scans if first <= s.stamp and s.stamp + s.scan_time * SECOND <= stamp]
        return BoardView(mean, pose, *of_scans(scans))

    # Missing views

    def missing(self) -> list[str]:
        """Describe the views still needed."""
        found = [f"the board in the {cell} of the image" for cell in self.uncovered()]
        if self.views and not self.uncovered():
            distances = [view.pose.place[2] for view in self.views]
            if max(distances) < 1.3 * min(distances):  # ratio of the farthest to the nearest view distance
                found.append(f"the board at more distances than {min(distances):.2f} to {max(distances):.2f} m")
        found += self._tilts(self.views, 3, "")  # number of views with a larger tilt needed for each of four sides
        found += _more(24 - len(self.views), "view of the board", "views of the board")
        if self.beams is not None:
            # 3: number of views needed that the lidar also sees
            found += self._tilts(self.seen_by_lidar, 3, ", across the lidar's beam")
            found += self._steep()
            if self.views and not any(view.ranges.size for view in self.views):
                found.insert(0, f"scans of the lidar: {LEAST_SCANS} or more in {HOLD / SECOND:g} s")
            more = 16 - len(self.seen_by_lidar)  # required views with the board also in the lidar's view
            found += _more(more, "view across the lidar's beam", "views across the lidar's beam")
        return found

    def uncovered(self) -> list[str]:
        """Ninths of the image that contain too few corners."""
        width, height = self.lens.size
        counts = np.zeros((3, 3), np.int64)
        for view in self.views:
            x, y = view.sighting.corners.T
            column = np.clip(x * 3 / width, 0, 2).astype(int)
            row = np.clip(y * 3 / height, 0, 2).astype(int)
            np.add.at(counts, (row, column), 1)
        return [
            "middle" if i == j == 1 else f"{row} {column}".removeprefix("middle ")
            for i, row in enumerate(ROWS)
            for j, column in enumerate(COLUMNS)
            if counts[i, j] < 6  # corners needed in each ninth of the image
        ]

    def _steep(self) -> list[str]:
        poses = [view.pose for view in self.seen_by_lidar]
        steep = f"by {math.degrees(STEEP):.0f} degrees or more, across the lidar's beam"
        # 8: number of views with a tilt above ``STEEP``, also seen by the lidar, needed for each of top and bottom edge
        # closer: only these determine the camera's height and pitch, the pitch to 0.5 degrees
        found = [
            f"its {side} {steep} ({more} more)"
            for side, sign in zip(SIDES[2:], (1, -1), strict=True)
            if (more := 8 - sum(sign * pose.lean > STEEP for pose in poses)) > 0
        ]
        distances = [float(pose.place[2]) for pose in poses if abs(pose.lean) > STEEP]
        # 1.5: ratio of their maximum to their minimum distance, which separates height from pitch
        if not found and max(distances) < 1.5 * min(distances):
            found.append(f"these tilts at more distances than {min(distances):.2f} to {max(distances):.2f} m")
        return found

    @staticmethod
    def _tilts(views: Sequence[BoardView], wanted: int, how: str) -> list[str]:
        angles = np.array([(v.pose.turn, -v.pose.turn, v.pose.lean, -v.pose.lean) for v in views]).reshape(-1, 4)
        short = wanted - (angles > TILT).sum(axis=0)
        return [f"its {side}{how} ({more} more)" for side, more in zip(SIDES, short.tolist(), strict=True) if more > 0]

    def progress(self) -> tuple[float, float]:
        """Return the progress and its total."""
        left = len(self.missing())
        return (1.0, 1.0) if not left else (len(self.views), len(self.views) + left)

    def trouble(self) -> str:
        """Return a sentence that explains why no new view was accepted."""
        a, board = self.attempts, self.reader.board
        shape = f"{board.columns} x {board.rows} squares"
        within = f"in {self.patience:g} s"
        if a.damaged > 0.5 * a.pictures:
            return f"{a.damaged} of {a.pictures} images cannot be decoded: check the camera's cable and hub"
        if a.unseen > 0.8 * a.pictures:
            strangers = sorted(self.reader.strangers)
            if strangers:
                return (
                    f"the image shows another board: marker {strangers[0]} does not belong to {shape}; state "
                    "--columns and --rows"
                )
            return (
                f"no board of {shape} was detected {within} ({a.pictures} images): print one (`stand print`) "
                "and light it"
            )
        if a.blurred > 0.4 * a.pictures:
            return (
                f"the images are blurred (edges {a.blur:.1f} pixels wide, expected {BLURRED:g}): use more "
                "light, clean and focus the lens, hold the board still"
            )
        if a.moved > 0.3 * a.pictures:
            return f"the board was never held still for {HOLD / SECOND:g} s {within}"
        return f"no new view {within}; still missing: {'; '.join(self.missing())}"


def apart(one: BoardSighting, other: BoardSighting) -> Array:
    """Distances between common corners (px), shape (n,)."""
    _, a, b = np.intersect1d(one.ids, other.ids, return_indices=True)
    return np.asarray(np.hypot(*(one.corners[a] - other.corners[b]).T))


def moved(one: BoardSighting, other: BoardSighting) -> float:
    """Maximum displacement of the steadiest four fifths of the common corners (px); inf without common corners."""
    distances = apart(one, other)
    return float(np.percentile(distances, 80)) if distances.size else math.inf


def averaged(sightings: Sequence[BoardSighting]) -> BoardSighting:
    """Mean positions of the corners that were found in most of the sightings."""
    ids = np.concatenate([s.ids for s in sightings])
    corners = np.concatenate([s.corners for s in sightings])
    numbers, counts = np.unique(ids, return_counts=True)
    kept = numbers[counts > len(sightings) / 2]
    means = np.array([corners[ids == number].mean(axis=0) for number in kept])
    return BoardSighting(means, kept, float(np.mean([s.blur for s in sightings])))


def _shared(one: BoardSighting, other: BoardSighting) -> bool:
    return np.intersect1d(one.ids, other.ids).size > 0


def _more(count: int, one: str, several: str) -> list[str]:
    return [] if count <= 0 else [f"{count} more {one if count == 1 else several}"]
