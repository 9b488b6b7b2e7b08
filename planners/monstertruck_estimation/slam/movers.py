"""Detection of moving people and robots by comparing a scan with one about a second older.

A crowd that walks along with the robot fits best at its previous position and biases the match, especially in a
corridor, whose walls do not constrain the motion ahead. A point is moving if a beam of an older scan passed through its
position, or if the object that hid its position has left. Moving objects are narrow: a whole wall that seems to move
contradicts odometry, and is kept.
"""

import math
from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from monstertruck_estimation.slam.scans import Scan
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import between, compose, inverse, transform
from monstertruck_runtime.clock import SECOND

Marks = NDArray[np.bool_]

SECTORS: Final = 360
"""Number of sectors of a view."""


@dataclass(frozen=True, slots=True)
class View:
    """Scan as stored by the detector."""

    points: Array
    """Points in base, shape (n, 2) (m)."""
    limits: Array
    """Minimum range of each sector and its neighbours, shape (SECTORS,) (m); 0 without points."""
    owners: NDArray[np.int64]
    """Points to which these ranges belong, shape (SECTORS,)."""

    @classmethod
    def of(cls, points: Array) -> "View":
        """Return the view of ``points``, shape (n, 2)."""
        return cls(points, *_nearest(points))


class MoverDetector:
    """Remove from every scan the points that moved since a scan about a second older.

    Scans are compared with the distances of odometry and the turns of the matches: people hardly affect the turn of a
    match, and wheels measure turns worse than distances.
    """

    def __init__(self) -> None:
        self._views: deque[tuple[int, Array, View]] = deque()
        """Stamp, pose of base, shape (3,), and view of the stored scans."""
        self._pose = np.zeros(3)
        self._newest: tuple[int, Array, View] | None = None
        """Stamp, preceding motion and view of the scan that ``settle`` stores."""

    def still(self, stamp: int, delta: Array | None, turn: float, scan: Scan) -> Scan:
        """Return ``scan`` without moving points.

        Args:
            stamp: stamp of the scan, ns.
            delta: motion of base since the previous scan by odometry, shape (3,); None without trusted odometry.
            turn: turn of base since then by the match of the whole scan, rad.
            scan: points in base.
        """
        if delta is None or not len(scan):
            self._views.clear()
            self._newest = None
            return scan
        # Age of the compared scan, s: in a shorter time a slow walker moves less than 0.2 m, and over a longer time the
        # error of the wheels exceeds the spacing of clutter.
        least, most = 0.8, 1.2
        view = View.of(scan.points)
        self._newest = stamp, delta, view
        while self._views and stamp - self._views[0][0] > most * SECOND:
            self._views.popleft()
        old = [row for row in self._views if stamp - row[0] >= least * SECOND]
        if not old:
            return scan
        _, pose, before = old[-1]
        here = compose(self._pose, np.array((delta[0], delta[1], turn)))
        marks = narrow(scan.points, moved(view, before, between(pose, here)))
        return scan.chosen(~marks) if marks.any() else scan

    def settle(self, turn: float) -> None:
        """Store the latest scan; ``turn`` is the preceding rotation of base by the match (rad)."""
        if self._newest is None:
            return
        stamp, delta, view = self._newest
        self._pose = compose(self._pose, np.array((delta[0], delta[1], turn)))
        self._views.append((stamp, self._pose, view))


def moved(view: View, before: View, motion: Array) -> Marks:
    """Mark points of ``view``, shape (n,), where ``before`` looked through or an object in front has left.

    ``motion``, shape (3,), is the motion of base between both (m, rad).
    """
    marks: Marks
    marks, hidden, sectors = _sights(before.limits, transform(motion, view.points))
    left = _sights(view.limits, transform(inverse(motion), before.points))[0]
    marks[hidden] = left[before.owners[sectors[hidden]]]
    return marks


def narrow(points: Array, marks: Marks) -> Marks:
    """Return the marked ones of ``points``, shape (n, 2), in beam order, that form objects of at most 0.8 m.

    Wider objects stay: a wall that seems to move contradicts odometry.
    """
    numbers = np.flatnonzero(marks)
    if not len(numbers):
        return marks
    chosen = points[numbers]
    # Maximum distance of neighbouring points of one object, m and per metre of range.
    apart, share = 0.25, 0.02
    breaks = np.hypot(*np.diff(chosen, axis=0).T) > apart + share * np.hypot(chosen[1:, 0], chosen[1:, 1])
    things = np.append(0, np.cumsum(breaks))
    first, last = np.append(0, np.flatnonzero(breaks) + 1), np.append(np.flatnonzero(breaks), len(chosen) - 1)
    widths = np.hypot(*(chosen[last] - chosen[first]).T)
    result = np.zeros_like(marks)
    result[numbers[(widths <= 0.8)[things]]] = True
    return result


@njit(cache=True)
def _sector(x, y):  # type: ignore[no-untyped-def] # noqa: ANN001, ANN202
    return int((math.atan2(y, x) + math.pi) / (2 * math.pi) * SECTORS) % SECTORS


@njit(cache=True)
def _nearest(points):  # type: ignore[no-untyped-def] # noqa: ANN001, ANN202
    """Return ranges and owners of a ``View``."""
    ranges, owners = np.full(SECTORS, np.inf), np.zeros(SECTORS, np.int64)
    for i in range(points.shape[0]):
        k, r = _sector(points[i, 0], points[i, 1]), math.hypot(points[i, 0], points[i, 1])
        if r < ranges[k]:
            ranges[k], owners[k] = r, i
    limits, nearest = np.zeros(SECTORS), np.zeros(SECTORS, np.int64)
    for k in range(SECTORS):
        best = k
        for j in (k - 1, (k + 1) % SECTORS):
            if ranges[j] < ranges[best]:
                best = j
        if math.isfinite(ranges[best]):
            limits[k], nearest[k] = ranges[best], owners[best]
    return limits, nearest


@njit(cache=True)
def _sights(limits, points):  # type: ignore[no-untyped-def] # noqa: ANN001, ANN202
    """Tell for each of ``points``, shape (n,), whether ``limits`` look through it or hide it, and its sector."""
    # Maximum range difference of two observations of one point, m and per metre: noise, and the error of odometry.
    margin, slack = 0.1, 0.03
    through, hidden = np.zeros(points.shape[0], np.bool_), np.zeros(points.shape[0], np.bool_)
    sectors = np.zeros(points.shape[0], np.int64)
    for i in range(points.shape[0]):
        sectors[i] = k = _sector(points[i, 0], points[i, 1])
        if limits[k] <= 0:
            continue
        r = math.hypot(points[i, 0], points[i, 1])
        gap = margin + slack * r
        hidden[i], through[i] = r >= limits[k] + gap, r < limits[k] - gap
    return through, hidden, sectors
