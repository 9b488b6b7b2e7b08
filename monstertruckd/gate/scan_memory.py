"""What earlier scans saw around the body, for motions towards where the lidar does not look."""

import math
from collections import deque
from collections.abc import Generator, Iterable, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from monstertruck_kinematics.chassis import STILL
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import Pose2, Twist2, integrate, placed, points_relative
from monstertruck_planners.collision import Footprint, beyond, on_body, relative
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.base import position_deviation
from monstertruck_schemas.sensor import NO_ECHO, VALID_BEAM, LaserScan

MEMORY_STEP: Final = 0.1
"""Travelled distance between two remembered scans, m."""
MEMORY_SCANS: Final = 20
SPACING: Final = 0.02
"""Distance between remembered points along the line of the beams, m: less than their drift."""
VIEW_STEP: Final = 0.3
"""Distance (m) plus turn (rad) between two of the scans that are kept to know which ground is free: each sees further
than a truck's length in half of all directions."""
VIEWS: Final = 32
"""The most of them: at 0.21 m/s the truck takes 21 in 30 s."""
DRIFT: Final = 0.03
"""Ground this near to where the body stood counts as free, m: the error of dead reckoning; less by as much as the
pose's standard deviation has grown since, beyond the padding of the footprint."""
FIELD_EDGE: Final = 0.1
"""Remembered points this near to the edge of the lidar's field are kept, rad: the error of the dead-reckoned yaw."""
POSES_KEPT: Final = 64
"""Ticks whose pose is kept, to place a scan where it was taken."""
STANDING: Final = 0.001
"""Distance travelled between two scans by a body that stands, m: rounding of its velocity."""
LEVER: Final = 1.0
"""Distance at which an error of the heading displaces remembered ground, m: a truck's length and what it stops in."""
MAP_SIZE: Final = 64
MAP_CELL: Final = 0.05
"""Cells on each side of a survey, and their size, m: what a truck covers in reverse until it has seen more."""
CHANGED: Final = 0.1
"""Difference of a beam from that of an earlier scan that neither noise nor rounding makes, m."""
ELSEWHERE: Final = 0.3
"""Share of the beams with a range that differ so once a robot was carried; people who pass change fewer."""


class _Taken(NamedTuple):
    """A scan, and where it was taken."""

    scan: LaserScan
    pose: Pose2
    """Of base, in the frame of the memory."""
    lidar: Pose2
    """Of the lidar, in the frame of the memory."""
    travelled: float
    """m."""
    points: Array
    """Its returns near the body in the frame of the memory, shape (n, 2), m."""
    free: Array
    """Free distance of every beam, m; padded with a 0 before the first and after the last."""
    variance: float
    """Of the pose in odometry when it was taken, m^2."""


class GroundSurvey(NamedTuple):
    """Which ground around a body counts as seen, and for how long."""

    stamp: int
    """Of the scan whose base is its frame, ns."""
    ages: NDArray[np.int8]
    """Shape (MAP_SIZE, MAP_SIZE), row 0 at the lowest y, the middle at base: age of the newest view in percent of the
    age up to which views count; -1 = not seen."""


class ScanMemory:
    """What earlier scans saw around the body, in a frame in which the wheels' dead reckoning gives its pose.

    Args:
        footprint: the body's outline.
        mount: pose of the lidar in base, m, m, rad.
        distance: travelled distance for which points are remembered, m.
        time: age up to which scans are remembered, s.
        deviation: growth of the pose's standard deviation up to which scans are remembered, m.
    """

    def __init__(
        self, footprint: Footprint, mount: Pose2, distance: float, time: float, deviation: float = math.inf
    ) -> None:
        self._footprint = footprint
        self._mount = mount
        self._distance = distance
        self._time = round(time * SECOND)
        self._variance_kept = deviation**2
        self._variance = 0.0
        self._rested: LaserScan | None = None
        """First scan since the robot was disarmed or carried; None = it is armed."""
        self.forget()

    def forget(self) -> None:
        """Start again: it is not known how the body has moved."""
        self._pose: Pose2 = (0.0, 0.0, 0.0)
        self._travelled = 0.0
        self._ticks: deque[tuple[int, Pose2, float]] = deque(maxlen=POSES_KEPT)
        self._newest: _Taken | None = None
        self._taken: deque[_Taken] = deque(maxlen=MEMORY_SCANS)
        self._views: deque[_Taken] = deque(maxlen=VIEWS)

    def move(self, now: int, twist: Twist2, dt: float) -> None:
        """The body moved with ``twist``, m/s and rad/s, for the ``dt`` s until ``now``, ns."""
        if twist != STILL:
            self._pose = integrate(self._pose, *twist, dt)
            self._travelled += self._footprint.corner_speed(twist) * dt
        self._ticks.append((now, self._pose, self._travelled))

    def doubt(self, covariance: Array) -> None:
        """Take the covariance of the pose in odometry, row-major of (x, y, yaw), shape (9,), m^2, m rad, rad^2."""
        self._variance = position_deviation(covariance) ** 2 + LEVER**2 * float(covariance[8])

    def rest(self, scan: LaserScan | None) -> None:
        """Take a scan of a robot whose wheels stand and that may be carried; forget everything once it was.

        None: it is armed, and nobody carries it.
        """
        if scan is None or self._rested is None:
            self._rested = scan
        elif elsewhere(self._rested, scan):
            self.forget()
            self._rested = scan

    def observe(self, scan: LaserScan, points: Array) -> None:
        """Take a scan.

        Args:
            scan: the revolution.
            points: its returns near the body in base, shape (n, 2), m.
        """
        present = scan.stamp, self._pose, self._travelled
        _, pose, travelled = min(self._ticks, key=lambda tick: abs(tick[0] - scan.stamp), default=present)
        points = spaced(points, SPACING)
        there = placed(np.column_stack((points, np.zeros(len(points)))), pose)[:, :2]
        (lidar,) = placed(np.array([self._mount]), pose).tolist()
        free = np.where((scan.codes == VALID_BEAM) | (scan.codes <= NO_ECHO), scan.ranges, 0.0)
        self._newest = _Taken(scan, pose, tuple(lidar), travelled, there, np.pad(free, 1), self._variance)
        # What a body that stands sees does not age; what its first scan there saw may be out of sight since.
        stood = [travelled - scan.travelled < STANDING for scan in list(self._taken)[-2:]]
        if stood == [True, True]:
            self._taken[-1] = self._newest
        elif stood[-1:] == [True] or not stood or travelled - self._taken[-1].travelled >= MEMORY_STEP:
            self._taken.append(self._newest)
        if self._views and travelled - self._views[-1].travelled < STANDING:
            self._views[-1] = self._newest
        elif not self._views or _apart(pose, self._views[-1].pose) >= VIEW_STEP:
            self._views.append(self._newest)

    def points(self) -> Array:
        """Remembered points where the newest scan does not look, in base as of that scan, shape (n, 2), m."""
        newest = self._newest
        if newest is None:
            return np.empty((0, 2))
        taken = self._fresh(self._taken, newest)
        kept = [scan.points for scan in taken if newest.travelled - scan.travelled < self._distance]
        there = np.concatenate((newest.points[:0], *kept))
        beams = _beams((newest,), there)[0][0]
        edge = FIELD_EDGE / abs(newest.scan.angle_increment or math.tau)
        looked = (beams >= edge) & (beams < len(newest.scan.ranges) - edge)
        points = points_relative(there[~looked], newest.pose)
        return points[~on_body(self._footprint, points, 0.0)]

    def _fresh(self, kept: Iterable[_Taken], newest: _Taken) -> list[_Taken]:
        return [
            taken
            for taken in kept
            if newest.scan.stamp - taken.scan.stamp < self._time
            and newest.variance - taken.variance < self._variance_kept
        ]

    def seen(self, points: Array) -> NDArray[np.bool_]:
        """Which of the points (n, 2), in base as of the newest scan, m, lie on ground that was seen free."""
        newest = self._newest
        if newest is None:
            return np.zeros(len(points), np.bool_)
        there = placed(np.column_stack((points, np.zeros(len(points)))), newest.pose)[:, :2]
        return np.asarray(self._free((newest, *self._fresh(self._views, newest)), there).any(axis=0))

    def survey(self) -> Generator[None, None, GroundSurvey | None]:
        """Ground around the body that counts as seen, in steps that take well below a millisecond each."""
        newest = self._newest
        if newest is None:
            return None
        middle = (np.arange(MAP_SIZE) + 0.5 - MAP_SIZE / 2) * MAP_CELL
        cells = np.column_stack((np.tile(middle, MAP_SIZE), np.repeat(middle, MAP_SIZE), np.zeros(MAP_SIZE**2)))
        there = placed(cells, newest.pose)[:, :2]
        ages = np.full(len(there), -1, np.int8)
        for view in (*self._fresh(self._views, newest), newest):  # the newest last
            (seen,) = self._free((view,), there)
            ages[seen] = min(100 * (newest.scan.stamp - view.scan.stamp) // self._time, 100)
            yield
        return GroundSurvey(newest.scan.stamp, ages.reshape(MAP_SIZE, MAP_SIZE))

    def _free(self, taken: Sequence[_Taken], there: Array) -> NDArray[np.bool_]:
        """Which points (n, 2) of the memory's frame each scan saw free, or the body stood on there; shape (m, n)."""
        beams, distances = _beams(taken, there)
        ends = np.cumsum([len(scan.free) for scan in taken])[:, None]
        starts = np.concatenate(([[0]], ends[:-1]))
        free = np.concatenate([scan.free for scan in taken])[np.clip(starts + 1 + beams, starts, ends - 1)]
        beyond_x, beyond_y = beyond(self._footprint, np.array([scan.pose for scan in taken]), there)
        newest = taken[0] if self._newest is None else self._newest
        gained = np.array([max(newest.variance - scan.variance, 0.0) for scan in taken])
        unsure = np.sqrt(gained)[:, None]
        known = np.maximum(beyond_x, beyond_y) < DRIFT - np.maximum(unsure - self._footprint.padding, 0.0)
        return np.asarray((free > distances + unsure) | known)


def elsewhere(before: LaserScan, now: LaserScan) -> bool:
    """Whether two scans of a robot whose wheels stood were taken in different places."""
    if len(before.ranges) != len(now.ranges):
        return True
    measured = [scan.codes == VALID_BEAM for scan in (before, now)]
    first, second = (
        np.where(valid, scan.ranges, scan.range_max) for valid, scan in zip(measured, (before, now), strict=True)
    )
    known = [valid | (scan.codes <= NO_ECHO) for valid, scan in zip(measured, (before, now), strict=True)]
    compared = known[0] & known[1] & (measured[0] | measured[1])
    differ = compared & (np.abs(first - second) > CHANGED)
    return bool(np.count_nonzero(differ) > ELSEWHERE * np.count_nonzero(compared))


def spaced(points: Array, spacing: float) -> Array:
    """Of points (n, 2) in the order of the beams, one on every ``spacing`` of the line along them, m."""
    along = np.cumsum(np.hypot(*np.diff(points, axis=0, prepend=points[:1]).T))
    return points[np.diff(along // spacing, prepend=-1.0) > 0]


def _apart(one: Pose2, other: Pose2) -> float:
    """Distance (m) and turn (rad) together."""
    return math.dist(one[:2], other[:2]) + abs(one[2] - other[2])


def _beams(scans: Sequence[_Taken], points: Array) -> tuple[NDArray[np.intp], Array]:
    """Number of every scan's beam towards each point, beyond the scan's where it has none; distance, m.

    Args:
        scans: m of them.
        points: in the frame of the memory, shape (n, 2), m.

    Returns:
        Two of shape (m, n).
    """
    x, y = relative(points, np.array([scan.lidar for scan in scans]))
    first = np.array([scan.scan.start_angle for scan in scans])
    step = np.array([scan.scan.angle_increment or math.tau for scan in scans])
    return np.rint((np.arctan2(y, x) - first[:, None]) / step[:, None]).astype(np.intp), np.hypot(x, y)
