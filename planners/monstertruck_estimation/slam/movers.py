"""Detection of people and robots that move: comparison of a scan with one about a second older.

A crowd that walks along fits itself best where it stood before, so it drags the match with it, most of all in a
corridor, where walls do not constrain the motion ahead. A point moves if an older scan looked through its place, or if
what hid its place has left since. A thing that moves is narrow: a whole wall that seems to move contradicts odometry,
and stays.
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
"""Directions of a view."""


@dataclass(frozen=True, slots=True)
class View:
    """A scan as the detector keeps it."""

    points: Array
    """Shape (n, 2), in base, m."""
    limits: Array
    """Shape (SECTORS,): least range of each sector and its neighbours, m; 0 where nothing was met."""
    owners: NDArray[np.int64]
    """Shape (SECTORS,): the points that these ranges belong to."""

    @classmethod
    def of(cls, points: Array) -> "View":
        """The view of ``points``, shape (n, 2)."""
        return cls(points, *_nearest(points))


class MoverDetector:
    """Removes from every scan the points that moved since a scan about a second older.

    Scans are compared by the distances of odometry and the turns of the matches: people hardly turn a match, and wheels
    turn worse than they roll.
    """

    def __init__(self) -> None:
        self._views: deque[tuple[int, Array, View]] = deque()
        """Stamp, pose of base, shape (3,), and view of the scans kept."""
        self._pose = np.zeros(3)
        self._newest: tuple[int, Array, View] | None = None
        """Stamp, motion before it and view of the scan that ``settle`` keeps."""

    def still(self, stamp: int, delta: Array | None, turn: float, scan: Scan) -> Scan:
        """Return ``scan`` without the points that move.

        Args:
            stamp: stamp of the scan, ns.
            delta: shape (3,), motion of base since the scan before by odometry; None without trusted odometry.
            turn: turn of base since then by the match of the whole scan, rad.
            scan: points in base.
        """
        if delta is None or not len(scan):
            self._views.clear()
            self._newest = None
            return scan
        # Age of the scan that a new one is compared with, s: in the former a slow walker moves 0.2 m, and wheels
        # measure longer times less well than clutter is apart.
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
        """Keep the latest scan; ``turn`` is the rotation of base before it by the match, rad."""
        if self._newest is None:
            return
        stamp, delta, view = self._newest
        self._pose = compose(self._pose, np.array((delta[0], delta[1], turn)))
        self._views.append((stamp, self._pose, view))


def moved(view: View, before: View, motion: Array) -> Marks:
    """Return which points of ``view``, shape (n,), are where ``before`` looked through, or behind an object that left.

    ``motion``, shape (3,), is the motion of base between both, m and rad.
    """
    marks: Marks
    marks, hidden, sectors = _sights(before.limits, transform(motion, view.points))
    left = _sights(view.limits, transform(inverse(motion), before.points))[0]
    marks[hidden] = left[before.owners[sectors[hidden]]]
    return marks


def narrow(points: Array, marks: Marks) -> Marks:
    """The marked ones of ``points``, shape (n, 2), in the order of the beams, that form things of 0.8 m at most.

    Wider things stay: a wall that seems to move contradicts odometry.
    """
    numbers = np.flatnonzero(marks)
    if not len(numbers):
        return marks
    chosen = points[numbers]
    # Neighbouring points of one thing are this far apart at most, m and per metre of range.
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
    """Limits and owners of a ``View``."""
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
    """Whether the view of ``limits`` looks through each of ``points``, shape (n,), or hides it, and its sector."""
    # Difference of range within which two points are one, m and per metre: noise, and the error of odometry.
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
