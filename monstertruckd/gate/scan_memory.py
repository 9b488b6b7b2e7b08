"""Memory of earlier scans around the body, for motions out of the lidar's field of view."""

import math
from collections import deque
from collections.abc import Generator, Iterable, Sequence
from typing import Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from monstertruck_kinematics.beams import is_full_turn, nearest_beams
from monstertruck_kinematics.chassis import STILL
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import Pose2, Twist2, integrate, placed, points_relative
from monstertruck_planners.collision import Footprint, beyond, on_body, relative
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.sensor import HIDDEN, NO_ECHO, VALID_BEAM, LaserScan

DRIFT: Final = 0.03
"""Margin around past positions of the body within which ground counts as free, m: the error of dead reckoning. As the
pose's standard deviation grows since then, its growth beyond the padding of the footprint reduces the margin. A moving
body has no margin: its tail would swing further with each scan.
"""
STANDING: Final = 0.001
"""Distance travelled between two scans below which the body stands, m: rounding of its velocity."""
MAP_SIZE: Final = 64
MAP_CELL: Final = 0.05
"""Cells along each side of a survey, and cell size, m: the ground a truck covers in reverse until it has seen more."""


class Beams(NamedTuple):
    """Free ground around a sensor, by beam."""

    stamp: int
    """Time of measurement, ns."""
    start: float
    """Angle of the first beam, rad."""
    step: float
    """Angle between adjacent beams, rad, negative clockwise."""
    free: Array
    """Free distance along every beam, shape (n,), m; 0 if unknown."""
    hidden: NDArray[np.bool_]
    """Whether parts of the robot hide each beam, shape (n,)."""

    @classmethod
    def of(cls, scan: LaserScan) -> Self:
        """Convert a scan."""
        known = (scan.codes == VALID_BEAM) | (scan.codes <= NO_ECHO)
        step = scan.angle_increment or math.tau
        free = np.where(known, scan.ranges, 0.0)
        return cls(scan.stamp, scan.start_angle, step, free, scan.codes == HIDDEN)

    @classmethod
    def across(cls, stamp: int, cone: float, free: float) -> Self:
        """Create beams with the free distance ``free`` (m) across a sonar's ``cone`` (rad), as if from two beams."""
        return cls(stamp, -cone / 4, cone / 2, np.full(2, free), np.zeros(2, np.bool_))

    def inside(self, margin: float) -> NDArray[np.bool_]:
        """Return whether each beam is further than ``margin`` (rad) from the edges of the field of view, shape (n,)."""
        count, wide = len(self.hidden), math.ceil(margin / abs(self.step))
        if is_full_turn(count, self.step):
            outside = np.pad(self.hidden, wide, "wrap")
        else:
            outside = np.pad(self.hidden, wide, constant_values=True)
        before = np.concatenate(([0], np.cumsum(outside)))
        return np.asarray(before[2 * wide + 1 :] == before[:count])


class _Taken(NamedTuple):
    """A scan or ping, with the pose at which it was taken."""

    beams: Beams
    pose: Pose2
    """Pose of base, in the frame of the memory."""
    sensor: Pose2
    """Pose of the lidar or sonar, in the frame of the memory."""
    travelled: float
    """Distance travelled before it was taken, m."""
    points: Array
    """Returns near the body, in the frame of the memory, shape (n, 2), m."""
    free: Array
    """Free distance along every beam, m; padded with a 0 before the first and after the last beam."""
    odometry: Array
    """Place (m) of the base in odometry when it was taken, and the covariance of that pose, shape (11,)."""
    doubt: float
    """Doubt about the travelled distance when it was taken, m."""
    beside: float = DRIFT
    """Margin around the body within which ground counts as free, m."""


class _LidarMemory:
    """Scans from one lidar, mounted at the pose ``mount`` in the base frame (m, m, rad)."""

    def __init__(self, mount: Pose2) -> None:
        self.mount = mount
        self.forget()

    def forget(self) -> None:
        """Discard the lidar's scans."""
        self.newest: _Taken | None = None
        self.taken: deque[_Taken] = deque(maxlen=20)
        """Scans whose points are remembered."""
        self.views: deque[_Taken] = deque(maxlen=32)  # at 0.21 m/s the truck takes 21 in 30 s
        """Scans kept as views of free ground."""


class _Heard(NamedTuple):
    """Pings from one sonar."""

    views: deque[_Taken]
    """Pings kept as views of free ground."""
    rounds: deque[_Taken]
    """Latest pings, used as obstacles."""


class GroundSurvey(NamedTuple):
    """Map of the seen ground around a body, with the age of each view."""

    stamp: int
    """Stamp of the scan whose base is the frame of the map, ns."""
    ages: NDArray[np.int8]
    """Age of the latest view, in percent of the maximum age of views; -1 if not seen. Shape (MAP_SIZE, MAP_SIZE), row 0
    at the lowest y, base in the middle."""


class ScanMemory:
    """Memory of earlier scans around the body, in the frame of the wheels' dead reckoning.

    Args:
        footprint: the body's outline.
        mounts: pose of every lidar in the base frame (m, m, rad).
        distance: distance travelled before points are discarded (m).
        time: age above which scans are discarded (s).
        deviation: standard deviation of a scan's pose relative to the body above which the scan is discarded (m).
    """

    def __init__(
        self, footprint: Footprint, mounts: Sequence[Pose2], distance: float, time: float, deviation: float = math.inf
    ) -> None:
        self._footprint = footprint
        self._eyes = [_LidarMemory(mount) for mount in mounts]
        self._distance = distance
        self._time = round(time * SECOND)
        self._variance_kept = deviation**2
        self._travel_doubt = 0.0
        self._odometry: Array = np.zeros(11)
        self._rested: LaserScan | None = None
        """First scan since the robot was disarmed or carried; None while it is armed."""
        self.forget()

    def forget(self) -> None:
        """Discard everything, because the motion of the body is unknown."""
        self._pose: Pose2 = (0.0, 0.0, 0.0)
        self._placed = self._pose
        """Pose at the latest odometry."""
        self._travelled = 0.0
        poses_kept = 64  # number of ticks whose pose is kept, to place a scan where it was taken
        self._ticks: deque[tuple[int, Pose2, float]] = deque(maxlen=poses_kept)
        self._newest: _Taken | None = None
        for eye in self._eyes:
            eye.forget()
        self._heard: dict[str, _Heard] = {}
        self._points, self._nearer = np.empty((0, 2)), np.empty(0)
        self.unsure = 0.0
        """Greatest growth of the doubt about the travelled distance since a valid view, beyond the padding of the
        footprint, m: the body may be that much nearer to unseen ground."""

    def move(self, now: int, twist: Twist2, dt: float, doubt: float = 0.0) -> None:
        """Move the body.

        Args:
            now: current time (ns).
            twist: motion during the ``dt`` s before ``now`` (m/s, rad/s).
            dt: duration of the motion (s).
            doubt: see ``TravelDoubt.distance``.
        """
        self._travel_doubt = doubt
        if twist != STILL:
            self._pose = integrate(self._pose, *twist, dt)
            self._travelled += self._footprint.corner_speed(twist) * dt
        self._ticks.append((now, self._pose, self._travelled))

    def doubt(self, place: tuple[float, float], covariance: Array) -> None:
        """Process the pose of the base in odometry; forget everything if it is not finite or jumps.

        Args:
            place: x and y (m).
            covariance: covariance of (x, y, yaw), row-major, shape (9,), m^2, m rad, rad^2.
        """
        odometry = np.concatenate((place, covariance))
        jump = math.dist(place, self._odometry[:2]) - math.dist(self._pose[:2], self._placed[:2])
        if not np.isfinite(odometry).all() or jump > math.sqrt(self._variance_kept):
            self.forget()
        if np.isfinite(odometry).all():
            self._odometry, self._placed = odometry, self._pose

    def rest(self, scan: LaserScan | None) -> None:
        """Process a scan from a robot at rest; discard the memory if the robot was carried.

        Args:
            scan: latest scan; None while the robot is armed, because an armed robot is not carried.
        """
        if scan is None or self._rested is None:
            self._rested = scan
        elif elsewhere(self._rested, scan):
            self.forget()
            self._rested = scan

    def observe(self, scan: LaserScan, points: Array, lidar: int = 0) -> None:
        """Process a scan.

        Args:
            scan: the scan (one revolution).
            points: returns from the scan near the body, in the base frame (m), shape (n, 2).
            lidar: number of the lidar.
        """
        spacing = 0.02  # distance between remembered points along the sequence of beams, m: less than their drift
        eye = self._eyes[lidar]
        self._newest = eye.newest = self._take(Beams.of(scan), spaced(points, spacing), eye.mount)
        travelled, taken = self._newest.travelled, eye.taken
        # The view of a body at rest does not age, but points of its first scan may be out of sight by now.
        stood = [travelled - scan.travelled < STANDING for scan in list(taken)[-2:]]
        memory_step = 0.1  # distance travelled between two remembered scans, m
        if stood == [True, True]:
            taken[-1] = self._newest
        elif stood[-1:] == [True] or not stood or travelled - taken[-1].travelled >= memory_step:
            taken.append(self._newest)
        _keep(eye.views, self._newest)
        self.unsure = max(map(self._doubt_since, self._seeing(self._newest)), default=math.inf)
        self._points, self._nearer = self._hidden(self._newest)

    def _doubt_since(self, view: _Taken) -> float:
        """Growth of the doubt about the travelled distance since a view, beyond the padding of the footprint (m)."""
        return max(abs(self._travel_doubt - view.doubt) - self._footprint.padding, 0.0)

    def moved(self, points: Array, lidar: int) -> Array:
        """Transform points of ``lidar`` to the base frame at the latest of all scans.

        Args:
            points: points in the base frame at the lidar's latest scan (m), shape (n, 2).
            lidar: number of the lidar.
        """
        taken = self._eyes[lidar].newest
        if taken is None or self._newest is None or taken.pose == self._newest.pose:
            return points
        return points_relative(_lifted(points, taken.pose), self._newest.pose)

    def hear(self, sonar: str, mount: Pose2, beams: Beams, arc: Array) -> None:
        """Process an echo measured by a sonar.

        Args:
            sonar: name of the sonar.
            mount: pose of the sonar in the base frame (m, m, rad).
            beams: free distance across the cone.
            arc: possible origins of the echo in the base frame (m), shape (n, 2).
        """
        # Maximum number of views kept per sonar: 2.1 m of travel, longer than a cone needs to become as wide as the
        # body.
        sonar_views = 8
        rounds = 2  # number of latest echoes per sonar used as obstacles: a single echo may be reflected away
        heard = self._heard.setdefault(sonar, _Heard(deque(maxlen=sonar_views), deque(maxlen=rounds)))
        taken = self._take(beams, arc, mount)
        heard.rounds.append(taken)
        if beams.free.any():
            _keep(heard.views, taken)

    def silence(self, sonar: str) -> None:
        """Discard all pings from a sonar."""
        self._heard.pop(sonar, None)

    def _take(self, beams: Beams, points: Array, mount: Pose2) -> _Taken:
        """Place a sensor's view at the pose of its stamp.

        Args:
            beams: the view.
            points: its points in the base frame (m), shape (n, 2).
            mount: pose of the sensor in the base frame (m, m, rad).
        """
        present = beams.stamp, self._pose, self._travelled
        _, pose, travelled = min(self._ticks, key=lambda tick: abs(tick[0] - beams.stamp), default=present)
        there = _lifted(points, pose)
        (sensor,) = placed(np.array([mount]), pose).tolist()
        return _Taken(
            beams, pose, tuple(sensor), travelled, there, np.pad(beams.free, 1), self._odometry, self._travel_doubt
        )

    def points(self) -> Array:
        """Remembered points (m) outside the view of each lidar's latest scan, shape (n, 2).

        They are in the base frame at the latest scan.
        """
        return self._points

    def nearer(self) -> Array:
        """Return how much nearer the body may be to each of ``points``, shape (n,), m.

        That is the growth of the doubt about the travelled distance since the point was seen, beyond the padding.
        """
        return self._nearer

    def _hidden(self, newest: _Taken) -> tuple[Array, Array]:
        """See ``points`` and ``nearer``."""
        taken = self._fresh((scan for eye in self._eyes for scan in eye.taken), newest)
        kept = [scan for scan in taken if newest.travelled - scan.travelled < self._distance]
        there = np.concatenate((newest.points[:0], *(scan.points for scan in kept)))
        nearer = np.repeat([self._doubt_since(scan) for scan in kept], [len(scan.points) for scan in kept])
        looked = np.zeros(len(there), np.bool_)
        for scan in self._latest():
            beams = _beams((scan,), there)[0][0]
            # Remembered points this near to the edge of the field of view are kept, rad: the error of the
            # dead-reckoned yaw.
            field_edge = 0.1
            inside = np.append(scan.beams.inside(field_edge), False)
            looked |= inside[np.minimum(beams, len(inside) - 1)]
        points = points_relative(there[~looked], newest.pose)
        outside = ~on_body(self._footprint, points, 0.0)
        return points[outside], nearer[~looked][outside]

    def echoes(self) -> Array:
        """Points on the latest arcs of all sonars (m), in the base frame at the latest scan, shape (n, 2)."""
        if self._newest is None or not self._heard:
            return np.empty((0, 2))
        arcs = np.concatenate([ping.points for heard in self._heard.values() for ping in heard.rounds])
        return points_relative(arcs, self._newest.pose)

    def _latest(self) -> list[_Taken]:
        """The latest scan of every lidar, oldest first."""
        return sorted((eye.newest for eye in self._eyes if eye.newest is not None), key=lambda scan: scan.beams.stamp)

    def _seeing(self, newest: _Taken) -> list[_Taken]:
        """Valid views of the ground from scans and pings, oldest first, with the latest scan of every lidar at the end.

        While the body stands, the latest scans are also among the stored scans.
        """
        edge = 1e-6  # ground this near to a moving body counts as its edge, m
        scans = (view for eye in self._eyes for view in eye.views)
        views = (*scans, *(view for heard in self._heard.values() for view in heard.views))
        latest = [scan._replace(beside=edge) for scan in self._fresh(self._latest(), newest)]
        return [*sorted(self._fresh(views, newest), key=lambda view: view.beams.stamp), *latest]

    def _fresh(self, kept: Iterable[_Taken], newest: _Taken) -> list[_Taken]:
        recent = [taken for taken in kept if newest.beams.stamp - taken.beams.stamp < self._time]
        near = _gained(recent, newest) < self._variance_kept
        return [taken for taken, fresh in zip(recent, near, strict=True) if fresh]

    def seen(self, points: Array) -> NDArray[np.bool_]:
        """Return whether each point (n, 2) was seen free or is under the body; base frame at the latest scan (m)."""
        newest = self._newest
        if newest is None:
            return on_body(self._footprint, points, DRIFT)
        there = _lifted(points, newest.pose)
        return np.asarray(self._free(self._seeing(newest), there).any(axis=0))

    def survey(self) -> Generator[None, None, GroundSurvey | None]:
        """Map the seen ground around the body, in steps that each take well below 1 ms."""
        newest = self._newest
        if newest is None:
            return None
        middle = (np.arange(MAP_SIZE) + 0.5 - MAP_SIZE / 2) * MAP_CELL
        cells = np.column_stack((np.tile(middle, MAP_SIZE), np.repeat(middle, MAP_SIZE), np.zeros(MAP_SIZE**2)))
        there = placed(cells, newest.pose)[:, :2]
        ages = np.full(len(there), -1, np.int8)
        for view in self._seeing(newest):
            (seen,) = self._free((view,), there)
            ages[seen] = min(100 * max(newest.beams.stamp - view.beams.stamp, 0) // self._time, 100)
            yield
        unseen = ages.reshape(MAP_SIZE, MAP_SIZE) < 0
        for _ in range(math.ceil(min(self.unsure / MAP_CELL, MAP_SIZE))):
            for cells in (unseen, unseen.T):
                cells[1:] |= cells[:-1]
                cells[:-1] |= cells[1:]
        ages[unseen.ravel()] = -1
        return GroundSurvey(newest.beams.stamp, ages.reshape(MAP_SIZE, MAP_SIZE))

    def _free(self, taken: Sequence[_Taken], there: Array) -> NDArray[np.bool_]:
        """Return whether each scan saw each point (n, 2) in the memory's frame free or under the body; shape (m, n)."""
        beams, distances = _beams(taken, there)
        ends = np.cumsum([len(scan.free) for scan in taken])[:, None]
        starts = np.concatenate(([[0]], ends[:-1]))
        free = np.concatenate([scan.free for scan in taken])[np.clip(starts + 1 + beams, starts, ends - 1)]
        beyond_x, beyond_y = beyond(self._footprint, np.array([scan.pose for scan in taken]), there)
        newest = taken[0] if self._newest is None else self._newest
        unsure = np.sqrt(_gained(taken, newest))[:, None]
        beside = np.array([scan.beside for scan in taken])[:, None]
        known = np.maximum(beyond_x, beyond_y) < beside - np.maximum(unsure - self._footprint.padding, 0.0)
        return np.asarray((free > distances + unsure) | known)


def elsewhere(before: LaserScan, now: LaserScan) -> bool:
    """Return whether two scans were taken in different places although the wheels did not turn."""
    if len(before.ranges) != len(now.ranges):
        now = _towards(before, now)
    measured = [scan.codes == VALID_BEAM for scan in (before, now)]
    first, second = (
        np.where(valid, scan.ranges, scan.range_max) for valid, scan in zip(measured, (before, now), strict=True)
    )
    known = [valid | (scan.codes <= NO_ECHO) for valid, scan in zip(measured, (before, now), strict=True)]
    compared = known[0] & known[1] & (measured[0] | measured[1])
    changed = 0.1  # minimum change of a beam between two scans that is neither noise nor rounding, m
    differ = compared & (np.abs(first - second) > changed)
    # Fraction of the beams with a range that must change to show that the robot was carried; passers-by change fewer.
    return bool(np.count_nonzero(differ) > 0.3 * np.count_nonzero(compared))


def _towards(like: LaserScan, scan: LaserScan) -> LaserScan:
    """Resample ``scan`` at the bearings of ``like``; bearings without a beam get a code that carries no information."""
    count, step = len(scan.ranges), scan.angle_increment
    if not count:
        return like.model_copy(update={"codes": np.full(len(like.codes), NO_ECHO + 1, np.uint8)})
    bearings = like.start_angle + like.angle_increment * np.arange(len(like.ranges))
    beams = nearest_beams(bearings, scan.start_angle, step)
    there = np.minimum(beams, count - 1)
    codes = np.where(beams < count, scan.codes[there], np.uint8(NO_ECHO + 1))
    return scan.model_copy(update={"ranges": scan.ranges[there], "codes": codes})


def spaced(points: Array, spacing: float) -> Array:
    """Thin points (n, 2) in beam order to one per ``spacing`` (m) along the line through them."""
    along = np.cumsum(np.hypot(*np.diff(points, axis=0, prepend=points[:1]).T))
    return points[np.diff(along // spacing, prepend=-1.0) > 0]


def _lifted(points: Array, pose: Pose2) -> Array:
    """Transform points (n, 2) relative to ``pose`` to the frame in which the pose is given."""
    return placed(np.column_stack((points, np.zeros(len(points)))), pose)[:, :2]


def _gained(taken: Sequence[_Taken], newest: _Taken) -> Array:
    """Variance (m^2) of ground remembered from each of n poses, relative to the body at the latest pose; shape (n,).

    A heading error from before a pose was taken turns that pose and the path from it by the same angle, so the ground
    stays in place relative to the body.
    """
    before = np.array([scan.odometry for scan in taken]).reshape(-1, 11)
    dx, dy = (newest.odometry[:2] - before[:, :2]).T
    xx, xy, xw, _, yy, yw, _, _, ww = before[:, 2:].T
    ahead, aside = xw - dy * ww, yw + dx * ww
    carried = np.array((xx - dy * (xw + ahead), xy + dx * xw - dy * aside, yy + dx * (yw + aside), ww))
    xx, xy, yy, ww = newest.odometry[[2, 3, 6, 10], None] - carried
    largest = (xx + yy) / 2 + np.hypot((xx - yy) / 2, xy)
    # Lever arm of a heading error that displaces remembered ground, m: the length of a truck plus its stopping
    # distance.
    lever = 1.0
    return np.asarray(np.maximum(largest, 0.0) + lever**2 * np.maximum(ww, 0.0))


def _keep(views: deque[_Taken], taken: _Taken) -> None:
    """Store a scan as a view of free ground, or replace the last view if the body has not moved since."""
    # Distance (m) plus turn (rad) between two kept views of free ground: each view reaches further than the
    # length of a truck in half of all directions.
    view_step = 0.3
    if views and taken.travelled - views[-1].travelled < STANDING:
        views[-1] = taken
    elif not views or _apart(taken.pose, views[-1].pose) >= view_step:
        views.append(taken)


def _apart(one: Pose2, other: Pose2) -> float:
    """Sum of the distance (m) and the turn (rad) between two poses."""
    return math.dist(one[:2], other[:2]) + abs(one[2] - other[2])


def _beams(scans: Sequence[_Taken], points: Array) -> tuple[NDArray[np.intp], Array]:
    """Find each scan's beam towards each point, and the distance of the point.

    Args:
        scans: m scans.
        points: points in the frame of the memory (m), shape (n, 2).

    Returns:
        Beam numbers (out of the scan's range where it has no beam) and distances (m), each of shape (m, n).
    """
    x, y = relative(points, np.array([scan.sensor for scan in scans]))
    first = np.array([scan.beams.start for scan in scans])
    step = np.array([scan.beams.step for scan in scans])
    return nearest_beams(np.arctan2(y, x), first[:, None], step[:, None]), np.hypot(x, y)
