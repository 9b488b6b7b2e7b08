"""Lidar obstacle check: the swept footprint against the latest scan and, outside its view, against earlier scans."""

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import Twist2
from monstertruck_planners.collision import (
    Footprint,
    ScanPoints,
    UnitTwist,
    first_contact,
    on_body,
    swept_poses,
)
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.base import Message
from monstertruck_schemas.event import Measurement
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import LaserScan, SonarRanges
from monstertruck_schemas.state import Odometry
from monstertruck_schemas.topics import ODOMETRY, SCANS, SONAR, Topic
from monstertruckd.gate.approach import Approach, comfortable_speed, reach, stopping
from monstertruckd.gate.checks import Check, DockArea, GateView, PaceLimit, Tick
from monstertruckd.gate.config import GateConfig, InForce
from monstertruckd.gate.motion import AHEAD, Course
from monstertruckd.gate.rear_sonars import RearSonars
from monstertruckd.gate.samples import age
from monstertruckd.gate.scan_memory import DRIFT, ScanMemory
from monstertruckd.gate.sonars import Place
from monstertruckd.gate.travel_doubt import TravelDoubt
from monstertruckd.gate.visibility import Sectors, Visibility, travelled

_Steps = tuple[int, int, int]
"""A unit twist in steps of ``TWIST_STEP``."""


TWIST_STEP: Final = 0.005
"""Rounding of unit twists before the sweep, m/m and rad/m: most sweeps are cached; the error at the end is 2 mm."""

GROUND_STEP: Final = 2
"""Interval of ground checks along the swept path, in poses."""


LEAVING: Final = 0.1
"""Minimum gain in distance per metre for a body nearer to an obstacle than the side clearance, m/m: a translation at
0.33 rad away from a wall (0.34 m/m) is allowed, a straight line along it is not."""


OUTLINE: Final = 12
"""Number of points on each edge of the footprint, used to find the directions of travel."""


def ground_ahead(body: Footprint, edges: Array, poses: Array) -> Array:
    """Ground points that a motion newly covers at each pose.

    Args:
        body: the footprint.
        edges: points on the edges of the footprint (m), shape (k, 2).
        poses: poses of the base at equal steps of one twist (m, m, rad), current pose first, shape (m, 3).

    Returns:
        The same points of the outline at all poses after the first (m), shape (m - 1, n, 2).
    """
    (step,) = at_poses(edges, poses[1:2])
    touch = 1e-6  # a point less deep than this inside the footprint is on its edge, m
    return at_poses(edges[~on_body(body, step, touch)], poses[1:])


def at_poses(points: Array, poses: Array) -> Array:
    """Transform the points (n, 2) of a body to every pose (m, 3); the result has shape (m, n, 2)."""
    c, s = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
    x, y = points.T
    return np.stack((poses[:, :1] + c * x - s * y, poses[:, 1:2] + s * x + c * y), axis=2)


class _Sweep(NamedTuple):
    """Poses and ground covered by a motion."""

    distances: Array
    """Distance of each pose along the motion, shape (m,), m."""
    poses: Array
    """Poses of base, shape (m, 3), m, m, rad."""
    ground: Array
    """Ground points reached by the motion, not under the body, shape (n, 2), m."""
    before: Array
    """Distance of the last pose before the body reaches each ground point, shape (n,), m."""
    sectors: Sectors
    """Sectors around the lidars that contain the ground, shape (lidars, k)."""


class _LidarView:
    """View of one lidar.

    Args:
        points: converts the lidar's scans to points in the base frame.
        visibility: when each sector around the lidar was last seen.
    """

    def __init__(self, points: ScanPoints, visibility: Visibility) -> None:
        self.scan_points, self.visibility = points, visibility
        self.near = self.measured = np.empty((0, 2))
        """Points near the body, and all points, in base at its latest scan, shape (n, 2), m."""
        self.stamp = 0
        """Stamp of its latest scan, ns."""


class ObstacleGuard:
    """Checks the swept footprint against the latest scan of every lidar.

    The truck may have moved since a scan was taken, so the stopping distance includes travel during the age of the
    oldest scan.

    Args:
        limits: limits in force.
        footprint: the body's outline.
        points: converts the scans of every lidar to points in the base frame.
        sonars: pose in the base frame (x and y in m, yaw in rad) of every sonar that looks backwards, by name.
    """

    def __init__(
        self,
        limits: InForce,
        footprint: Footprint,
        points: Sequence[ScanPoints],
        sonars: Mapping[str, Place] | None = None,
    ) -> None:
        self._limits = limits
        self._sonars = RearSonars(limits, sonars or {})
        self._footprint = footprint
        kept, mounts = limits.config.obstacle, [one.mount for one in points]
        self._eyes = [_LidarView(one, Visibility(footprint, one.mount, kept.seen)) for one in points]
        self.memory = ScanMemory(footprint, mounts, kept.memory_distance, kept.memory_time, kept.memory_deviation)
        self._points = np.empty((0, 2))
        self._measured = np.empty((0, 2))
        self._stamp = 0
        self.unseen: float | None = 0.0
        """Age of the oldest view of a sector of travel at the latest scan, s; None if a sector was never seen."""
        self.known = math.inf
        """Distance to unseen ground that stops the latest checked motions, less the memory's doubt about the travelled
        distance, m; +inf if none is within reach."""
        self.known_slowly = math.inf
        """Distance to unseen ground that only slows these motions, m; +inf if none is within reach."""
        self._checked: frozenset[_Steps] | None = None
        self._dock: DockArea | None = None
        self._free = math.inf
        self._outline = footprint.edge_points(OUTLINE, OUTLINE)
        self._near = 0.0
        self._adopted: GateConfig | None = None
        self._follow_limits()

    def _follow_limits(self) -> None:
        """Adopt the limits in force; if the range of stored points grows, clear the memory."""
        config = self._limits.config
        if config is self._adopted:
            return
        self._adopted = config
        self._keep = round(config.scan.stale_after * SECOND)
        delay = config.scan.stale_after + config.max_latency + config.reaction
        self._reach = reach(config, delay)
        before = self._near
        self._near = self._reach + self._footprint.circumscribed_radius + config.obstacle.side_clearance
        if self._near > before:
            self.memory.forget()
        self._sweep = lru_cache(256)(self._swept)  # sweeps cached
        self._checked = None

    @property
    def reach(self) -> float:
        """Length of the sweep (m)."""
        return self._reach

    @property
    def stamp(self) -> int:
        """Stamp of the latest scan (ns)."""
        return self._stamp

    def points(self, within: float, *, reverse: bool) -> Array:
        """Return measured and remembered points in the base frame at the latest scan (m), shape (n, 2).

        Args:
            within: maximum distance from the base (m).
            reverse: whether to include points from the rear sonars.
        """
        seen = (self._measured, self.memory.points(), *((self.memory.echoes(),) if reverse else ()))
        points: Array = np.concatenate(seen)
        points = points[np.hypot(points[:, 0], points[:, 1]) < within]
        return points[~on_body(self._footprint, points, -self._footprint.padding)]

    def looks_at(self, points: Array) -> NDArray[np.bool_]:
        """Return whether each point (m, base frame, shape (n, 2)) lies in a lidar's field of view."""
        return np.asarray(np.logical_or.reduce([eye.visibility.covers(points) for eye in self._eyes]))

    def move(self, now: int, twist: Twist2 | None, dt: float, doubt: float = 0.0) -> None:
        """Move the body as ``ScanMemory.move`` does; if ``twist`` is None, the motion is unknown."""
        self._follow_limits()
        if twist is None:
            self.memory.forget()
        else:
            self.memory.move(now, twist, dt, doubt)
        for sonar in self._sonars.silenced(now):
            self.memory.silence(sonar)
            self._checked = None

    def hear(self, ranges: SonarRanges) -> None:
        """Process a round of pings."""
        for ping in self._sonars.pings(ranges):
            self.memory.hear(*ping)
            self._checked = None

    def observe(self, scan: LaserScan, lidar: int = 0) -> None:
        """Process a scan from the lidar with number ``lidar``."""
        eye = self._eyes[lidar]
        points = eye.measured = eye.scan_points.of(scan)
        eye.visibility.observe(scan, points)
        near = points[np.hypot(points[:, 0], points[:, 1]) < self._near]
        age = eye.visibility.age(eye.near, scan.stamp)
        # Points of a sector are kept while the sector is not seen, until they are too old.
        eye.near = np.concatenate((near, eye.near[(age > 0) & (age <= self._keep)]))
        # A sensor's clock may run ahead: the stamp is at latest the arrival.
        eye.stamp = self._stamp = min(scan.stamp, scan.received)
        self.memory.observe(scan, near, lidar)
        self._points, self._measured = (
            np.concatenate([self.memory.moved(points, i) for i, points in enumerate(shown)])
            for shown in ([eye.near for eye in self._eyes], [eye.measured for eye in self._eyes])
        )
        self._checked = None

    def free_distance(self, twists: tuple[UnitTwist, ...], dock: DockArea | None = None) -> float:
        """Distance the footprint can travel from the pose of the scan (m); +inf if no obstacle is within reach.

        Args:
            twists: motions of the base; the shortest of their distances is returned.
            dock: dock area: points inside its housing are ignored, and ground in its corridor is treated as seen.
        """
        self._follow_limits()
        if self._checked is None or (dock is None) != (self._dock is None):
            # In base, as the points are: it is taken with each scan.
            self._dock, self._checked = dock, None
        rounded = frozenset((round(x / TWIST_STEP), round(y / TWIST_STEP), round(a / TWIST_STEP)) for x, y, a in twists)
        if self._checked != rounded:
            self._checked = rounded
            self._update_unseen(rounded)
            points, remembered, echoes = self._points, self.memory.points(), self.memory.echoes()
            nearer = self.memory.nearer()
            if self._dock is not None:
                outside = self._dock.outside
                nearer = nearer[outside(remembered)]
                points, remembered, echoes = (some[outside(some)] for some in (points, remembered, echoes))
            by_doubt = {doubt: remembered[nearer == doubt] for doubt in np.unique(nearer).tolist()}
            self._free = min(self._free_distance(*twist, points, by_doubt, echoes) for twist in rounded)
            self._check_ground(rounded, np.concatenate((points, remembered)))
        return self._free

    def _update_unseen(self, twists: frozenset[_Steps]) -> None:
        """Update ``unseen`` for ground travelled in a field of view; each part uses the lidar that sees it best."""
        sectors = np.concatenate([self._sweep(*twist).sectors for twist in twists], axis=1)
        ages = np.full(sectors.shape, np.nan)
        for row, of_eye, eye in zip(ages, sectors, self._eyes, strict=True):
            seen = eye.visibility.last_seen(of_eye)
            row[seen == 0] = np.inf
            row[seen > 0] = eye.stamp - seen[seen > 0]
        best = np.fmin.reduce(ages)  # NaN: in no field of view
        oldest = float(best[~np.isnan(best)].max(initial=0.0))
        self.unseen = oldest / SECOND if math.isfinite(oldest) else None

    def _swept(self, x: int, y: int, turn: int) -> _Sweep:
        """Sweep a twist in steps of ``TWIST_STEP``; between two poses, corners move no further than the base."""
        twist = (x * TWIST_STEP, y * TWIST_STEP, turn * TWIST_STEP)
        # Minimum number of poses along the swept path; more if a corner moves faster than the base.
        distances = np.linspace(0.0, self._reach, math.ceil(20 * max(self._footprint.corner_speed(twist), 1.0)))
        poses = swept_poses(twist, distances)
        ground = ground_ahead(self._footprint, self._outline, poses[::GROUND_STEP])
        before = np.repeat(distances[::GROUND_STEP][:-1], ground.shape[1])
        ground = ground.reshape(-1, 2)
        views = [eye.visibility for eye in self._eyes]
        return _Sweep(distances, poses, ground, before, travelled(views, self._footprint, ground))

    def _free_distance(
        self, x: int, y: int, turn: int, points: Array, remembered: Mapping[float, Array], echoes: Array
    ) -> float:
        sweep = self._sweep(x, y, turn)
        clearance = self._limits.config.obstacle.side_clearance
        leaving = LEAVING * sweep.distances
        contacts = [first_contact(self._footprint, sweep.poses, points, clearance, leaving)]
        if x < 0 and not _on_the_spot(x, y):
            contacts.append(first_contact(self._footprint, sweep.poses, echoes, clearance, leaving))
        free = [float(sweep.distances[contact - 1]) for contact in contacts if contact is not None]
        for nearer, those in remembered.items():
            # Without clearance: their positions may be off by as much.
            known = first_contact(self._footprint, sweep.poses, those, -self._footprint.padding)
            if known is not None:
                free.append(max(float(sweep.distances[known - 1]) - nearer, 0.0))
        return min(free, default=math.inf)

    def _check_ground(self, twists: frozenset[_Steps], measured: Array) -> None:
        """Update ``known`` and ``known_slowly``, and shorten the free distance for turns on the spot.

        Args:
            twists: motions of the base.
            measured: measured points in the base frame (m), shape (n, 2).
        """
        self.known = self.known_slowly = math.inf
        # A turn on the spot must not cover unseen ground nearer than this to a measured point, m: an obstacle there is
        # visible from one side only. A standing person is about this deep.
        depth = 0.2
        # In a motion ahead the tail must not swing onto unseen ground if a measured point is at most this far in front
        # of it and to its side, m: a wall along the body leaves the field of view this far in front of the tail.
        before_it, beside = 0.3, 0.1
        stretch = np.array((beside / before_it, 1.0))
        near = on_body(self._footprint, measured, self._reach + before_it) & ~on_body(self._footprint, measured, 0.0)
        recalled = False  # whether the memory decides about ground that stops one of the motions
        for twist in twists:
            sweep = self._sweep(*twist)
            unknown = self._unknown(twist, sweep.ground)
            ground, before = sweep.ground[unknown], sweep.before[unknown]
            recalled |= not _is_ahead(twist)
            if _is_turn(twist, self._footprint):
                self._free = float(before[_near(ground, measured[near], depth)].min(initial=self._free))
            elif twist[0] < 0 or _is_sideways(twist, self._footprint):
                self._stop_before(twist, before)
                continue
            elif _is_ahead(twist):
                hidden = ~self.looks_at(sweep.ground)
                aside = sweep.ground[hidden]
                in_front = aside[:, 0] > self._footprint.offset + self._footprint.half_length
                stopping = in_front | _near(aside * stretch, measured[near] * stretch, beside)
                recalled |= bool(stopping.any())
                self._stop_before(twist, sweep.before[hidden][stopping & unknown[hidden]])
            self.known_slowly = float(before.min(initial=self.known_slowly))
        if recalled and self.memory.unsure:
            self.known = max(min(self.known, self._reach) - self.memory.unsure, 0.0)

    def _stop_before(self, twist: _Steps, before: Array) -> None:
        """Shorten ``known`` to the minimum of the distances along a motion, refined to the edge of seen ground."""
        known = float(before.min(initial=math.inf))
        if known < self.known:
            self.known = min(self.known, known + self._further(twist, known))

    def _unknown(self, twist: _Steps, ground: Array) -> NDArray[np.bool_]:
        """Return whether each ground point (n, 2) along a motion is unseen by all scans and not on the axis of a dock.

        When moving ahead, sectors and points determine whether ground in a lidar's field of view is seen (``unseen``).
        """
        unknown = ~self.looks_at(ground) if _is_ahead(twist) else np.ones(len(ground), np.bool_)
        unknown[unknown] = ~self.memory.seen(ground[unknown])
        if self._dock is not None:
            unknown[unknown] = ~self._dock.on_axis(ground[unknown])
        return unknown

    def _further(self, twist: _Steps, known: float) -> float:
        """Return the distance beyond ``known`` on seen ground (m), which is less than the spacing of ground checks."""
        x, y, turn = (part * TWIST_STEP for part in twist)
        finer = 4  # parts of the distance between two ground checks; resolution of the edge of seen ground
        step = GROUND_STEP * float(self._sweep(*twist).distances[1]) / finer
        poses = swept_poses((x, y, turn), known + np.linspace(0.0, (finer - 1) * step, finer))
        outline = at_poses(self._outline, poses[1:])
        seen = ~self._unknown(twist, outline.reshape(-1, 2)).reshape(finer - 1, -1).any(axis=1)
        return step * (finer - 1 if seen.all() else int(np.argmin(seen)))

    def allowed_before_unseen(self, now: int) -> float:
        """Maximum pace that allows a comfortable stop on seen ground (m/s)."""
        return comfortable_speed(self.known - DRIFT, self.delay(now), self._limits.config.obstacle.deceleration)

    def allowed_speed(self, free: float, now: int) -> float:
        """Maximum pace that allows a comfortable stop within ``free`` metres (m/s)."""
        limits = self._limits.config.obstacle
        return comfortable_speed(free - limits.ahead, self.delay(now), limits.deceleration)

    def too_near(self, free: float, speed: float, now: int) -> bool:
        """Return whether an ordinary stop from the pace ``speed`` needs more than ``free`` metres."""
        return free < stopping(abs(speed), self.delay(now), self._limits.config.deceleration)

    def delay(self, now: int) -> float:
        """Time from the latest view of the path to the reaction (s)."""
        return (
            max(now - min(eye.stamp for eye in self._eyes), 0) / SECOND
            + (self.unseen or 0.0)
            + self._limits.config.reaction
        )


class ObstacleCheck(Check):
    """Keeps the swept footprint clear of current and earlier lidar returns; gives no limit without fresh scans.

    Args:
        view: read access to the gate's state.
        points: converts the scans of every lidar to points in the base frame.
        sonars: pose in the base frame (x and y in m, yaw in rad) of every sonar that looks backwards, by name.
    """

    reasons = (
        Reason.OBSTACLE_STOP,
        Reason.OBSTACLE_SLOW,
        Reason.LIDAR_BLIND,
        Reason.LIDAR_SLOW,
        Reason.UNSEEN_STOP,
        Reason.UNSEEN_DRIVE,
        Reason.UNSEEN_SLOW,
    )
    reads = (ODOMETRY, SONAR)

    def __init__(self, view: GateView, points: Sequence[ScanPoints], sonars: Mapping[str, Place] | None = None) -> None:
        super().__init__(view)
        self.guard = ObstacleGuard(view.limits, view.footprint, points, sonars)
        self._approach = Approach(view)
        self._doubt = TravelDoubt(view.limits, len(view.chassis.shafts))
        self._before_unseen = False
        """Whether the robot is stopped in front of unseen ground."""

    @property
    def urgent(self) -> bool:
        """See ``Check.urgent``."""
        return self._approach.emergency

    def observe(self, seen: Message | Tick, topic: Topic[Any] | None) -> None:
        """Process valid scans, rounds of pings, and the motion of the body at every tick."""
        view = self.view
        if isinstance(seen, Tick):
            # A disarmed robot may be pushed or carried; its memory stays valid while its wheels stand.
            known = view.mode.active or view.samples.at_rest(seen.now)
            measured, dt = view.samples.shaft_speeds(seen.now), seen.elapsed / SECOND
            self._doubt.observe(seen.now, dt, view.motion.shaft_speeds, measured, view.samples.drives)
            twist = view.samples.twist(seen.now) if known else None
            self.guard.move(seen.now, twist, dt, self._doubt.distance)
        elif isinstance(seen, LaserScan) and topic in SCANS:
            lidar = SCANS.index(topic)
            if seen is not view.samples.scans[lidar]:
                return
            if lidar == 0:
                self.guard.memory.rest(None if view.mode.active else seen)
            self.guard.observe(seen, lidar)
        elif isinstance(seen, Odometry) and topic is ODOMETRY:
            self.guard.memory.doubt((seen.pose.x, seen.pose.y), seen.pose_covariance)
        elif isinstance(seen, SonarRanges):
            self.guard.hear(seen)

    def limit(self, now: int, courses: Sequence[Course] | None) -> Iterator[PaceLimit]:
        """Sweep along the motions, and along the motion at the measured steering angles."""
        if courses is None:
            self._approach.forget()
            self._before_unseen = False
        elif courses and self.view.samples.scan_fresh(now):
            yield from self._along(now, list(courses))

    def _along(self, now: int, courses: list[Course]) -> Iterator[PaceLimit]:
        guard, view = self.guard, self.view
        fastest = max(pace for _, pace in courses)
        if view.samples.steering_fresh(now):
            courses.append((view.motion.along(courses[0][0], view.samples.angles), 0.0))
        twists = tuple(twist for twist, _ in courses)
        free = guard.free_distance(twists, view.dock)
        yield from self._approach.limits(free, guard.allowed_speed(free, now), fastest)
        unseen, slow = guard.unseen, view.config.obstacle.unseen_speed
        if unseen is None or unseen > view.config.scan.stale_after:
            yield PaceLimit(Reason.LIDAR_BLIND, 0.0)
        elif unseen:
            yield PaceLimit(Reason.LIDAR_SLOW, slow)
        slowly = max(guard.allowed_speed(guard.known_slowly, now), slow)
        if slowly < fastest:
            yield PaceLimit(Reason.UNSEEN_SLOW, slowly)
        yield from self._into_unseen(guard.allowed_before_unseen(now), fastest)
        self._approach.judge(now, twists, lambda speed: guard.too_near(free, speed, now))

    def _into_unseen(self, allowed: float, fastest: float) -> Iterator[PaceLimit]:
        """Limits before unseen ground, where the pace ``allowed`` is permitted, for motions up to ``fastest`` (m/s)."""
        config = self.view.config.obstacle
        if config.unseen == "slow" or self.view.calibrates:
            allowed = max(allowed, config.unseen_speed)
        elif self.view.confirmed and allowed < config.confirmed_speed:
            self._before_unseen = False
            yield PaceLimit(Reason.UNSEEN_DRIVE, config.confirmed_speed)
            return
        self._before_unseen = allowed < (2 * config.crawl if self._before_unseen else config.crawl)
        if self._before_unseen:
            yield PaceLimit(Reason.UNSEEN_STOP, 0.0)
        elif allowed < fastest:
            yield PaceLimit(Reason.UNSEEN_SLOW, allowed)

    def figures(self, reason: Reason, now: int) -> Iterator[Measurement]:
        """Free distance, distance on seen ground, or how long the lidar has not seen the path."""
        config = self.view.config
        ages = [age(scan, now) for scan in self.view.samples.scans]
        if reason is Reason.LIDAR_BLIND:
            yield Measurement(name="unseen", value=self.guard.unseen, unit="s", limit=config.scan.stale_after)
        elif reason is Reason.UNSEEN_STOP:
            yield Measurement(name="seen distance", value=_finite(self.guard.known), unit="m", limit=DRIFT)
            if self.guard.memory.unsure:
                yield Measurement(name="travel doubt", value=_finite(self.guard.memory.unsure), unit="m")
        elif reason is Reason.OBSTACLE_STOP:
            yield self._approach.free_distance(max((one for one in ages if one is not None), default=None))


def _on_the_spot(x: int, y: int) -> bool:
    """Return whether a motion, in steps of ``TWIST_STEP``, is a turn on the spot."""
    return math.hypot(x, y) * TWIST_STEP < AHEAD


def _is_turn(twist: _Steps, body: Footprint) -> bool:
    """Return whether a motion turns on the spot, or about a point next to or under the body that is not ahead of it."""
    return _on_the_spot(*twist[:2]) or not (twist[0] < 0 or _is_ahead(twist) or _is_sideways(twist, body))


def _near(points: Array, others: Array, within: float) -> NDArray[np.bool_]:
    """Return whether each point (n, 2) is nearer than ``within`` metres to any of ``others`` (m, 2)."""
    squares = (others**2).sum(axis=1) - 2 * points @ others.T
    return np.asarray((points**2).sum(axis=1) + squares.min(axis=1, initial=math.inf) < within**2)


def _is_ahead(twist: _Steps) -> bool:
    """Return whether a motion leads mostly ahead."""
    return twist[0] * TWIST_STEP >= AHEAD


def _is_sideways(twist: _Steps, body: Footprint) -> bool:
    """Return whether an entire side of the body moves outwards at least as fast as the body moves ahead.

    The centre of rotation then lies neither next to nor under the body.
    """
    x, y, turn = twist
    return y != 0 and abs(y + turn * body.offset) >= max(abs(turn) * body.half_length, x)


def _finite(value: float) -> float | None:
    """Return the value, or None if it is infinite."""
    return value if math.isfinite(value) else None
