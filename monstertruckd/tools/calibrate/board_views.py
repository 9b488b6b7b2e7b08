"""What the camera saw of a board that somebody holds, and what is still missing: pure, picture by picture.

A view counts when the board was held still for a moment: its corners are averaged over that time, and the lidar's scans
of the same time belong to it.
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
"""Time for which the board is held still, ns."""
BLURRED: Final = 2.0
"""Pixels: standard deviation of the step of an edge."""
LEAST_SCANS: Final = 3
"""Scans of a view, at least."""
ROWS: Final = ("upper", "middle", "lower")
COLUMNS: Final = ("left", "middle", "right")
TILT: Final = math.radians(12.0)
STEEP: Final = math.radians(30.0)
SIDES: Final = ("left edge nearer", "right edge nearer", "upper edge nearer", "lower edge nearer")


@dataclass(frozen=True)
class BoardView:
    """The board, held still."""

    sighting: BoardSighting
    """Corners averaged over its pictures"""
    pose: BoardPose
    """Pose by the lens that was configured then"""
    angles: Array
    """Angles of the lidar's beams, rad, left positive; (n,); empty: it sent too few scans"""
    ranges: Array
    """Medians over the same time, m; inf = nothing; (n,)"""


def of_scans(scans: Sequence[LaserScan]) -> tuple[Array, Array]:
    """Angles of the beams, rad, and medians of their ranges, m; empty where there are too few."""
    if len(scans) < LEAST_SCANS:
        return np.empty(0), np.empty(0)
    return bearings_of(scans[0]), np.median(stacked_ranges(scans, np.inf), axis=0)


@dataclass
class BoardAttempts:
    """Pictures since the last view, by what was wrong with them."""

    pictures: int = 0
    unseen: int = 0
    blurred: int = 0
    blur: float = 0.0
    """Blur of the last blurred view, pixels"""
    moved: int = 0
    damaged: int = 0


@dataclass
class BoardGuide:
    """Takes pictures, keeps views, and says what is missing.

    Args:
        reader: of the board.
        lens: as configured: only tilts and distances are judged by it.
        beams: whether a view is one that the lidar sees, too; None = there is no lidar.
        patience: s without a new view that end it.
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
        """Take the next picture in; returns a view that has come of it.

        Args:
            stamp: of the picture, ns.
            sighting: of the board in it; None = it is not seen, or the picture is ``damaged``.
            scans: that have come since the last call.
            damaged: the picture cannot be decoded.

        Raises:
            InputError: nothing new for too long: says what is wrong, or missing.
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
        """Keep a view."""
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
        # 1.0: pixels that four corners of five move meanwhile, at most: a single one may be found wrong
        if self._held and moved(self._held[0][1], sighting) > 1.0:
            attempts.moved += 1
            self._held = []
        self._held.append((stamp, sighting))
        first = self._held[0][0]
        if stamp - first < HOLD or len(self._held) < 3:  # pictures of a view, at least
            return None
        mean = averaged([seen for _, seen in self._held])
        self._held = self._held[-1:]
        # 12.0: pixels by which corners differ from those of every other view, on average
        if any(apart(view.sighting, mean).mean() < 12.0 for view in self.views if _shared(view.sighting, mean)):
            return None
        pose = board_pose(mean, self.reader, self.lens)
        if pose is None:
            return None
        scans = [s for s in self._scans if first <= s.stamp and s.stamp + s.scan_time * SECOND <= stamp]
        return BoardView(mean, pose, *of_scans(scans))

    # What is missing

    def missing(self) -> list[str]:
        """What has to be shown yet, in words."""
        found = [f"the board in the {cell} of the picture" for cell in self.uncovered()]
        if self.views and not self.uncovered():
            distances = [view.pose.place[2] for view in self.views]
            if max(distances) < 1.3 * min(distances):  # distance of the farthest view over that of the nearest
                found.append(f"the board nearer and farther than {min(distances):.2f} to {max(distances):.2f} m")
        found += self._tilts(self.views, 3, "")  # views needed that are tilted by more, to each of four sides
        found += _more(24 - len(self.views), "view of it", "views of it")
        if self.beams is not None:
            # 3: views needed that the lidar sees as well
            found += self._tilts(self.seen_by_lidar, 3, ", across the lidar's beam")
            found += self._steep()
            if self.views and not any(view.ranges.size for view in self.views):
                found.insert(0, f"scans of the lidar: {LEAST_SCANS} or more in {HOLD / SECOND:g} s")
            more = 16 - len(self.seen_by_lidar)  # views in which the lidar sees the board, too
            found += _more(more, "view across the lidar's beam", "views across the lidar's beam")
        return found

    def uncovered(self) -> list[str]:
        """Ninths of the picture in which too few corners were seen."""
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
            if counts[i, j] < 6  # corners in each ninth of the picture
        ]

    def _steep(self) -> list[str]:
        poses = [view.pose for view in self.seen_by_lidar]
        steep = f"by {math.degrees(STEEP):.0f} degrees or more, across the lidar's beam"
        # 8: views that the lidar sees, tilted by more than ``STEEP``, upper and lower edge nearer each: by these alone
        # height and pitch of the camera are known, and pitch to 0.5 degrees
        found = [
            f"its {side} {steep} ({more} more)"
            for side, sign in zip(SIDES[2:], (1, -1), strict=True)
            if (more := 8 - sum(sign * pose.lean > STEEP for pose in poses)) > 0
        ]
        distances = [float(pose.place[2]) for pose in poses if abs(pose.lean) > STEEP]
        # 1.5: distance of the farthest of them over that of the nearest: it tells height from pitch
        if not found and max(distances) < 1.5 * min(distances):
            found.append(f"it so nearer and farther than {min(distances):.2f} to {max(distances):.2f} m")
        return found

    @staticmethod
    def _tilts(views: Sequence[BoardView], wanted: int, how: str) -> list[str]:
        angles = np.array([(v.pose.turn, -v.pose.turn, v.pose.lean, -v.pose.lean) for v in views]).reshape(-1, 4)
        short = wanted - (angles > TILT).sum(axis=0)
        return [f"its {side}{how} ({more} more)" for side, more in zip(SIDES, short.tolist(), strict=True) if more > 0]

    def progress(self) -> tuple[float, float]:
        """How much of how much is done."""
        left = len(self.missing())
        return (1.0, 1.0) if not left else (len(self.views), len(self.views) + left)

    def trouble(self) -> str:
        """Why nothing new came, in a sentence."""
        a, board = self.attempts, self.reader.board
        shape = f"{board.columns} x {board.rows} squares"
        within = f"in {self.patience:g} s"
        if a.damaged > 0.5 * a.pictures:
            return f"{a.damaged} of {a.pictures} pictures cannot be decoded: look at the camera's cable and hub"
        if a.unseen > 0.8 * a.pictures:
            strangers = sorted(self.reader.strangers)
            if strangers:
                return f"another board is shown: marker {strangers[0]} is none of {shape}; state --columns and --rows"
            return f"no board of {shape} is seen {within} ({a.pictures} pictures): print one (`stand print`), light it"
        if a.blurred > 0.4 * a.pictures:
            return (
                f"the pictures are blurred (edges of {a.blur:.1f} pixels, expected {BLURRED:g}): more light, a clean "
                "and focused lens, a still hand"
            )
        if a.moved > 0.3 * a.pictures:
            return f"the board was never held still for {HOLD / SECOND:g} s {within}"
        return f"nothing new {within}; still missing: {'; '.join(self.missing())}"


def apart(one: BoardSighting, other: BoardSighting) -> Array:
    """Distances of the corners that both have, pixels; (n,)."""
    _, a, b = np.intersect1d(one.ids, other.ids, return_indices=True)
    return np.asarray(np.hypot(*(one.corners[a] - other.corners[b]).T))


def moved(one: BoardSighting, other: BoardSighting) -> float:
    """What four of five corners that both have moved by at most, pixels; inf where they have none."""
    distances = apart(one, other)
    return float(np.percentile(distances, 80)) if distances.size else math.inf


def averaged(sightings: Sequence[BoardSighting]) -> BoardSighting:
    """Means of the corners that most of them have."""
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
