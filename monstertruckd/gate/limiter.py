"""Command limiting: from a request of any form to the commanded motion, slowed by what the swept footprint would touch.

Every form of request becomes a twist of the base and the steering angles it needs (``Motion.target``); from there on
limits, ramps and the sweep know nothing of forms. The size of a twist is its **pace**: the greatest speed of the base
and of the driven wheels, m/s. It is the speed of the base for a truck that drives straight on, and that of the wheels
for a body that turns on the spot.

A beam without a range may be free ground, or a covered or dazzled sensor: ``Visibility`` says which directions the
lidar sees. Where it does not look, in reverse, sideways and on the spot, ``ScanMemory`` has what earlier scans saw.
"""

import math
from collections import deque
from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from monstertruck_kinematics.chassis import MAX_ANGLE, STILL, Angles, Chassis, Speeds
from monstertruck_kinematics.drive import Twist
from monstertruck_kinematics.elementary import Array, KinematicsError, integrate
from monstertruck_planners.collision import (
    Footprint,
    ScanPoints,
    UnitTwist,
    beyond,
    first_contact,
    on_body,
    placed,
    points_relative,
    relative,
    swept_poses,
)
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import DriveRequest, RequestedTwist
from monstertruck_schemas.sensor import NO_ECHO, VALID_BEAM, LaserScan
from monstertruckd.gate.config import GateConfig
from monstertruckd.gate.peers import PeerGuard, Seen
from monstertruckd.gate.sensors import SensorMonitor
from monstertruckd.gate.sonars import SonarGuard

POSES: Final = 20
"""Poses checked along the swept path, at least: a corner that turns faster than the base travels has more of them."""

TWIST_STEP: Final = 0.005
"""Rounding of unit twists before the sweep, m/m and rad/m: most sweeps are cached, with an error of 2 mm at the end."""

GROUND_STEP: Final = 2
"""The ground is checked at every second pose."""

SWEEPS: Final = 256
"""Sweeps cached."""

LEAVING: Final = 0.1
"""A body nearer to an obstacle than the side clearance may only drive motions that take it this much further away per
metre, m/m: a translation of 0.33 rad away from a wall does (0.34 m/m), a straight line along it does not."""

AHEAD: Final = 0.5
"""A motion whose forward speed is a smaller share of its pace has the speed limit of reverse: part of the footprint
moves to where the lidar does not look. One whose base is slower than that share turns on the spot."""
DEPTH: Final = 0.2
"""Ground that no scan has seen, nearer than this to a measured point, is not turned onto, m: what stands there is seen
from one side only. Somebody who stands is about as deep."""

MAX_SPEED: Final = 1e3
"""Requests are scaled down to this in every component before anything else, m/s and rad/s: sums of them stay finite."""

FASTEST: Final = 1e6
"""Measured speeds are clamped to this, m/s, so that their squares stay finite."""

ROUNDING: Final = 1e-6
"""Relative difference up to which two motions are the same."""

LEAST: Final = 1e-6
"""A smaller pace counts as standstill, m/s: the direction of such a twist is rounding error."""

Course = tuple[UnitTwist, float]
"""A motion of the base: its twist per metre of pace, and its pace, m/s."""

SECTORS: Final = 36
"""Sectors around the lidar: 0.1 m wide at the end of the distance the gate checks, less than the width of the body."""
SECTOR: Final = 2 * math.pi / SECTORS
PRESENT: Final = 0.5
"""Share of a sector's beams that a scan must have for the sector to be in the lidar's field."""
OUTLINE: Final = 12
"""Points on each edge of the footprint from which the directions of travel are found."""
MARGIN: Final = 0.005
"""Ground this near to the body counts as under it, m."""
TOUCH: Final = 1e-6
"""A point that enters the footprint by less is on its edge, m."""

MEMORY: Final = 30 * SECOND
"""Age up to which scans are kept, ns: people may step onto ground that was free, or take an obstacle away."""
MEMORY_STEP: Final = 0.1
"""Travelled distance between two remembered scans, m."""
MEMORY_SCANS: Final = 20
SPACING: Final = 0.02
"""Distance between remembered points along the line of the beams, m: less than their drift."""
VIEW_STEP: Final = 0.3
"""Distance (m) plus turn (rad) between two of the scans that are kept to know which ground is free: each sees further
than a truck's length in half of all directions, and ground that none of them saw only slows the truck."""
VIEWS: Final = 7
DRIFT: Final = 0.03
"""Ground this near to where the body stood counts as free, m: the error of dead reckoning."""
FIELD_EDGE: Final = 0.1
"""Remembered points this near to the edge of the lidar's field are kept, rad: the error of the dead-reckoned yaw."""
POSES_KEPT: Final = 64
"""Ticks whose pose is kept, to place a scan where it was taken."""

Sectors = NDArray[np.intp]
Pose = tuple[float, float, float]


class Visibility:
    """When each sector around the lidar was last seen.

    A beam sees if it measured a range that ends outside the body, or met nothing within the sensor's range. A sector
    is seen if a share of its beams sees: single beams fail on edges and dark surfaces.

    Args:
        footprint: the body's outline.
        mount: pose (x, y, yaw) of the lidar in base, m, m, rad.
        share: of a sector's beams that must see, 0..1.
    """

    def __init__(self, footprint: Footprint, mount: tuple[float, float, float], share: float) -> None:
        self._footprint = footprint
        self._mount = mount
        self._share = share
        self._geometry: tuple[float, float, int] | None = None
        self._sector_of_beam: Sectors = np.empty(0, np.intp)
        self._beams: Array = np.zeros(SECTORS)
        self._field: NDArray[np.bool_] = np.zeros(SECTORS, np.bool_)
        self._seen_at: NDArray[np.int64] = np.zeros(SECTORS, np.int64)

    def observe(self, scan: LaserScan, points: Array) -> None:
        """Take a scan.

        Args:
            scan: the revolution.
            points: its valid returns in base, ``scan_points``, shape (n, 2), m.
        """
        geometry = scan.start_angle, scan.angle_increment, len(scan.ranges)
        if geometry != self._geometry:
            self._geometry = geometry
            start, increment, count = geometry
            self._sector_of_beam = _sector(start + increment * np.arange(count, dtype=np.float64))
            self._beams = np.bincount(self._sector_of_beam, minlength=SECTORS).astype(float)
            self._field = self._beams * abs(increment) > PRESENT * SECTOR
        sees = scan.codes <= NO_ECHO
        sees[((scan.codes == VALID_BEAM) & np.isfinite(scan.ranges)).nonzero()[0]] = ~on_body(
            self._footprint, points, 0.0
        )
        seen = np.bincount(self._sector_of_beam, weights=sees, minlength=SECTORS) >= self._share * self._beams
        self._seen_at[seen & self._field] = scan.stamp

    def sectors_of(self, points: Array) -> Sectors:
        """Sector of every point (n, 2) in base, m."""
        x, y, yaw = self._mount
        return _sector(np.arctan2(points[:, 1] - y, points[:, 0] - x) - yaw)

    def covers(self, points: Array) -> NDArray[np.bool_]:
        """Which of the points (n, 2) in base, m, lie in the lidar's field."""
        return self._field[self.sectors_of(points)]

    def travelled(self, ground: Array) -> Sectors:
        """Sectors of the points (n, 2) in base, m, that the body does not stand on."""
        sectors = self.sectors_of(ground[~on_body(self._footprint, ground, MARGIN)])
        return np.bincount(sectors, minlength=SECTORS).nonzero()[0]

    def last_seen(self, sectors: Sectors) -> NDArray[np.int64]:
        """When each of the sectors was seen, ns, 0 for never; those outside the lidar's field are left out."""
        return self._seen_at[sectors[self._field[sectors]]]

    def age(self, points: Array, now: int) -> NDArray[np.int64]:
        """How long ago the sector of every point (n, 2) in base was seen, ns."""
        return now - self._seen_at[self.sectors_of(points)]


def _sector(bearings: Array) -> Sectors:
    return ((bearings + math.pi) // SECTOR).astype(np.intp) % SECTORS


def ground_ahead(body: Footprint, edges: Array, poses: Array) -> Array:
    """Points of the ground that a motion covers and that its pose before did not cover.

    Args:
        body: the footprint.
        edges: points on its edges, shape (k, 2), m.
        poses: of base at equal steps of one twist, the present one first, shape (m, 3), m, m, rad.

    Returns:
        Shape (m - 1, n, 2), m: the same points of the outline at all poses after the first.
    """
    (step,) = _at(edges, poses[1:2])
    return _at(edges[~on_body(body, step, TOUCH)], poses[1:])


def _at(points: Array, poses: Array) -> Array:
    """Points (n, 2) of a body at every pose (m, 3), shape (m, n, 2)."""
    c, s = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
    x, y = points.T
    return np.stack((poses[:, :1] + c * x - s * y, poses[:, 1:2] + s * x + c * y), axis=2)


class _Taken(NamedTuple):
    """A scan, and where it was taken."""

    scan: LaserScan
    pose: Pose
    """Of base, in the frame of the memory."""
    lidar: Pose
    """Of the lidar, in the frame of the memory."""
    travelled: float
    """m."""
    points: Array
    """Its returns near the body in the frame of the memory, shape (n, 2), m."""
    free: Array
    """Free distance of every beam, m; padded with a 0 before the first and after the last."""


class ScanMemory:
    """What earlier scans saw around the body, in a frame in which the wheels' dead reckoning gives its pose.

    Args:
        footprint: the body's outline.
        mount: pose of the lidar in base, m, m, rad.
        distance: travelled distance for which points are remembered, m.
    """

    def __init__(self, footprint: Footprint, mount: Pose, distance: float) -> None:
        self._footprint = footprint
        self._mount = mount
        self._distance = distance
        self.forget()

    def forget(self) -> None:
        """Start again: it is not known how the body has moved."""
        self._pose: Pose = (0.0, 0.0, 0.0)
        self._travelled = 0.0
        self._ticks: deque[tuple[int, Pose, float]] = deque(maxlen=POSES_KEPT)
        self._newest: _Taken | None = None
        self._taken: deque[_Taken] = deque(maxlen=MEMORY_SCANS)
        self._views: deque[_Taken] = deque(maxlen=VIEWS)

    def move(self, now: int, twist: Twist[float], dt: float) -> None:
        """The body moved with ``twist``, m/s and rad/s, for the ``dt`` s until ``now``, ns."""
        if twist != STILL:
            self._pose = integrate(self._pose, *twist, dt)
            self._travelled += self._footprint.corner_speed(twist) * dt
        self._ticks.append((now, self._pose, self._travelled))

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
        self._newest = _Taken(scan, pose, tuple(lidar), travelled, there, np.pad(free, 1))
        if not self._taken or travelled - self._taken[-1].travelled >= MEMORY_STEP:
            self._taken.append(self._newest)
        if not self._views or _apart(pose, self._views[-1].pose) >= VIEW_STEP:
            self._views.append(self._newest)

    def points(self) -> Array:
        """Remembered points where the newest scan does not look, in base as of that scan, shape (n, 2), m."""
        newest = self._newest
        if newest is None:
            return np.empty((0, 2))
        kept = [
            taken.points for taken in _fresh(self._taken, newest) if newest.travelled - taken.travelled < self._distance
        ]
        there = np.concatenate((newest.points[:0], *kept))
        beams = _beams((newest,), there)[0][0]
        edge = FIELD_EDGE / abs(newest.scan.angle_increment or math.tau)
        looked = (beams >= edge) & (beams < len(newest.scan.ranges) - edge)
        points = points_relative(there[~looked], newest.pose)
        return points[~on_body(self._footprint, points, 0.0)]

    def seen(self, points: Array) -> NDArray[np.bool_]:
        """Which of the points (n, 2), in base as of the newest scan, m, lie on ground that was seen free."""
        newest = self._newest
        if newest is None:
            return np.zeros(len(points), np.bool_)
        there = placed(np.column_stack((points, np.zeros(len(points)))), newest.pose)[:, :2]
        taken = newest, *_fresh(self._views, newest)
        beams, distances = _beams(taken, there)
        ends = np.cumsum([len(scan.free) for scan in taken])[:, None]
        starts = np.concatenate(([[0]], ends[:-1]))
        free = np.concatenate([scan.free for scan in taken])[np.clip(starts + 1 + beams, starts, ends - 1)]
        beyond_x, beyond_y = beyond(self._footprint, np.array([scan.pose for scan in taken]), there)
        seen = (free > distances) | ((beyond_x < DRIFT) & (beyond_y < DRIFT))
        return np.asarray(seen.any(axis=0))


def spaced(points: Array, spacing: float) -> Array:
    """Of points (n, 2) in the order of the beams, one on every ``spacing`` of the line along them, m."""
    along = np.cumsum(np.hypot(*np.diff(points, axis=0, prepend=points[:1]).T))
    return points[np.diff(along // spacing, prepend=-1.0) > 0]


def _apart(one: Pose, other: Pose) -> float:
    """Distance (m) and turn (rad) together."""
    return math.dist(one[:2], other[:2]) + abs(one[2] - other[2])


def _fresh(kept: Iterable[_Taken], newest: _Taken) -> list[_Taken]:
    return [taken for taken in kept if newest.scan.stamp - taken.scan.stamp < MEMORY]


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


class _Sweep(NamedTuple):
    """The poses and the ground that a motion covers."""

    distances: Array
    """Of its poses, shape (m,), m."""
    poses: Array
    """Of base, shape (m, 3)."""
    ground: Array
    """Points that the body does not stand on, shape (n, 2), m."""
    before: Array
    """Distance of the pose before the one that reaches each of them, shape (n,), m."""
    sectors: Sectors
    """Around the lidar."""


class ObstacleGuard:
    """Swept footprint against the newest scan.

    The truck may have moved since the scan was taken: its age becomes a part of the stopping distance.

    Args:
        config: limits.
        footprint: the body's outline.
        points: of scans, in base.
    """

    def __init__(self, config: GateConfig, footprint: Footprint, points: ScanPoints) -> None:
        self._config = config
        self._footprint = footprint
        self._scan_points = points
        self._visibility = Visibility(footprint, points.mount, config.obstacle.seen)
        self._memory = ScanMemory(footprint, points.mount, config.obstacle.memory_distance)
        self._points = np.empty((0, 2))
        self._stamp = 0
        self.unseen: float | None = 0.0
        """Age of the oldest view of a sector of travel at the newest scan, s; None = one was never seen."""
        self.known = math.inf
        """Distance along the newest motions to ground that no scan has seen, m; +inf if none is within reach."""
        self._checked: frozenset[tuple[int, int, int]] | None = None
        self._free = math.inf
        self._outline = footprint.edge_points(OUTLINE, OUTLINE)
        self._near = 0.0
        self.configure(config)

    def configure(self, config: GateConfig) -> None:
        """Take other limits, between two ticks; points beyond the range kept so far count as not seen."""
        self._config = config
        self._keep = round(config.scan.stale_after * SECOND)
        delay = config.scan.stale_after + config.max_latency + config.reaction
        self._reach = config.obstacle.ahead + self._stopping(config.speed, delay, config.obstacle.deceleration)
        before, self._near = (
            self._near,
            (self._reach + self._footprint.circumscribed_radius + config.obstacle.side_clearance),
        )
        if self._near > before:
            self._memory.forget()
        self._sweep = lru_cache(SWEEPS)(self._swept)
        self._checked = None

    @property
    def reach(self) -> float:
        """Distance swept, m."""
        return self._reach

    def looks_at(self, points: Array) -> NDArray[np.bool_]:
        """Which of the points (n, 2) in base, m, lie in the lidar's field."""
        return self._visibility.covers(points)

    def move(self, now: int, twist: Twist[float] | None, dt: float) -> None:
        """The body moved with ``twist`` for the ``dt`` s until ``now``, ns; None = it is not known how."""
        if twist is None:
            self._memory.forget()
        else:
            self._memory.move(now, twist, dt)

    def observe(self, scan: LaserScan) -> None:
        """Take a scan."""
        points = self._scan_points.of(scan)
        self._visibility.observe(scan, points)
        near = points[np.hypot(points[:, 0], points[:, 1]) < self._near]
        age = self._visibility.age(self._points, scan.stamp)
        # What was seen in a sector stays while the sector is not seen, until that is too old.
        self._points = np.concatenate((near, self._points[(age > 0) & (age <= self._keep)]))
        self._memory.observe(scan, near)
        self._stamp = min(scan.stamp, scan.received)  # a sensor's clock may run ahead; nothing arrives before it is
        self._checked = None

    def free_distance(self, twists: tuple[UnitTwist, ...]) -> float:
        """Distance the footprint can travel from where the scan was taken, m; +inf if no obstacle is within reach.

        Args:
            twists: the shortest distance of all of them counts.
        """
        rounded = frozenset((round(x / TWIST_STEP), round(y / TWIST_STEP), round(a / TWIST_STEP)) for x, y, a in twists)
        if self._checked != rounded:
            self._checked = rounded
            self._update_unseen(rounded)
            hidden = [twist for twist in rounded if twist[0] * TWIST_STEP < AHEAD]
            behind = self._memory.points() if hidden else None
            self._free = min(self._free_distance(*twist, behind) for twist in rounded)
            self.known = math.inf
            if behind is not None:
                self._check_ground(hidden, np.concatenate((self._points, behind)))
        return self._free

    def _update_unseen(self, twists: frozenset[tuple[int, int, int]]) -> None:
        """Update ``unseen`` from the sectors of travel within the lidar's field."""
        seen = np.concatenate([self._visibility.last_seen(self._sweep(*twist).sectors) for twist in twists])
        oldest = int(seen.min(initial=self._stamp))
        self.unseen = (self._stamp - oldest) / SECOND if oldest > 0 else None

    def _swept(self, x: int, y: int, turn: int) -> _Sweep:
        """Sweep of a twist in steps of ``TWIST_STEP``; between two poses corners move no further than the base."""
        twist = (x * TWIST_STEP, y * TWIST_STEP, turn * TWIST_STEP)
        distances = np.linspace(0.0, self._reach, math.ceil(POSES * max(self._footprint.corner_speed(twist), 1.0)))
        poses = swept_poses(twist, distances)
        ground = ground_ahead(self._footprint, self._outline, poses[::GROUND_STEP])
        before = np.repeat(distances[::GROUND_STEP][:-1], ground.shape[1])
        ground = ground.reshape(-1, 2)
        return _Sweep(distances, poses, ground, before, self._visibility.travelled(ground))

    def _free_distance(self, x: int, y: int, turn: int, remembered: Array | None) -> float:
        sweep = self._sweep(x, y, turn)
        clearance = self._config.obstacle.side_clearance
        leaving = LEAVING * sweep.distances
        contacts = [first_contact(self._footprint, sweep.poses, self._points, clearance, leaving)]
        if remembered is not None:
            # Without a clearance, as their places may be off by as much.
            contacts.append(first_contact(self._footprint, sweep.poses, remembered, -self._footprint.padding))
        return min(
            (float(sweep.distances[contact - 1]) for contact in contacts if contact is not None), default=math.inf
        )

    def _check_ground(self, twists: list[tuple[int, int, int]], measured: Array) -> None:
        """Update ``known``, and shorten the free distance of turns on the spot.

        Args:
            twists: in steps of ``TWIST_STEP``.
            measured: points in base, shape (n, 2), m.
        """
        sweeps = [self._sweep(*twist) for twist in twists]
        ground = np.concatenate([sweep.ground for sweep in sweeps])
        before = np.concatenate([sweep.before for sweep in sweeps])
        turns = [math.hypot(*twist[:2]) * TWIST_STEP < AHEAD for twist in twists]
        turning = np.repeat(turns, [len(sweep.ground) for sweep in sweeps])
        hidden = ~self._memory.seen(ground)
        self.known = float(before[hidden].min(initial=math.inf))
        reached = hidden & turning & (before < self._free)
        near = on_body(self._footprint, measured, self._reach + DEPTH) & ~on_body(self._footprint, measured, 0.0)
        apart = ((ground[reached][:, None] - measured[near]) ** 2).sum(axis=2).min(axis=1, initial=math.inf)
        self._free = float(before[reached][apart < DEPTH**2].min(initial=self._free))

    def allowed_speed(self, free: float, now: int) -> float:
        """Greatest pace from which the body stops comfortably within ``free`` metres, m/s."""
        limits = self._config.obstacle
        return comfortable_speed(free - limits.ahead, self._delay(now), limits.deceleration)

    def too_near(self, free: float, speed: float, now: int) -> bool:
        """Whether an ordinary stop from the pace ``speed`` needs more than ``free`` metres."""
        return free < self._stopping(abs(speed), self._delay(now), self._config.deceleration)

    def _delay(self, now: int) -> float:
        return max(now - self._stamp, 0) / SECOND + (self.unseen or 0.0) + self._config.reaction

    @staticmethod
    def _stopping(speed: float, delay: float, deceleration: float) -> float:
        return speed * delay + speed**2 / (2 * deceleration)


def comfortable_speed(room: float, delay: float, deceleration: float) -> float:
    """Greatest speed from which a body that brakes after ``delay`` s stands within ``room`` metres, m/s."""
    return deceleration * (math.sqrt(delay**2 + 2 * max(room, 0.0) / deceleration) - delay)


SATURATED: Final = 1e-4
"""Difference between wanted and reachable steering angle from which on the gate reports it, rad."""


class Target(NamedTuple):
    """The motion that a request means for this body."""

    twist: Twist[float]
    """Of the base."""
    angles: Angles
    """Steering angles it needs."""
    clipped: bool
    """It differs from the request: the nearest motion that the body can do."""
    saturated: bool
    """It differs because of the servos' range."""
    shafts: Speeds | None = None
    """Open loop: the shaft speeds themselves, of which the twist is only the prediction, m/s."""


class Motion:
    """Commanded motion: the twist of the base and the steering angles, rad.

    Args:
        config: limits.
        chassis: kinematics of the body.
    """

    def __init__(self, config: GateConfig, chassis: Chassis) -> None:
        self._config = config
        self._chassis = chassis
        self.twist: Twist[float] = STILL
        self.angles: Angles = chassis.straight
        self._open: Speeds | None = None
        """Shaft speeds that are commanded open loop, m/s; None = they follow from the twist."""
        self._servos = self.angles, chassis.servos(*self.angles)
        self._shafts = (STILL, self.angles), chassis.shafts_along(STILL, *self.angles)

    def configure(self, config: GateConfig) -> None:
        """Take other limits, between two ticks."""
        self._config = config

    @property
    def standing(self) -> bool:
        """Whether standstill is commanded."""
        return self.twist == STILL and not any(self._open or ())

    @property
    def servos(self) -> Angles:
        """Servo angles that give the steering angles, rad."""
        if self._servos[0] != self.angles:
            self._servos = self.angles, self._chassis.servos(*self.angles)
        return self._servos[1]

    @property
    def axle_angles(self) -> tuple[float, float]:
        """Axle angles of the bicycle that moves alike, rad; 0 where none does."""
        return self._chassis.axle_angles(self.twist, self.angles)

    @property
    def motor_velocities(self) -> tuple[float, ...]:
        """Motor rate of every driven shaft, as in ``DriveCommand``."""
        return tuple(map(self._chassis.drivetrain.motor_rate, self.shaft_speeds))

    @property
    def shaft_speeds(self) -> Speeds:
        """Wheel speed over ground of every driven shaft, m/s."""
        if self._open is not None:
            return self._open
        command = self.twist, self.angles
        if self._shafts[0] != command:
            self._shafts = command, self._chassis.shafts_along(self.twist, *self.angles)
        return self._shafts[1]

    def target(self, request: DriveRequest) -> Target:
        """What a request means for this body, within the limit of the axle angles.

        Raises:
            KinematicsError: the body cannot move like that; the reason is named.
        """
        if request.shafts is not None:
            return self._target_of_shafts(request.shafts)
        return self._target_of_axles(request) if request.twist is None else self._target_of_twist(request.twist)

    def _target_of_axles(self, request: DriveRequest) -> Target:
        chassis = self._chassis
        if (why := chassis.refusal(request.front, request.rear)) is not None:
            raise KinematicsError(why)
        front = min(max(request.front, -MAX_ANGLE), MAX_ANGLE)
        rear = min(max(request.rear, -MAX_ANGLE), MAX_ANGLE)
        clipped = max(abs(front), abs(rear)) > self._config.angle
        if clipped:
            front, rear = chassis.limited(front, rear, self._config.angle)
        (front, rear), saturated = self._reached((front, rear))
        speed = min(max(request.speed, -MAX_SPEED), MAX_SPEED)
        twist = chassis.bicycle.body_twist(speed, front, rear)
        return Target(twist, chassis.steering_for_axles(front, rear, self.angles), clipped or saturated, saturated)

    def _target_of_twist(self, request: RequestedTwist) -> Target:
        chassis = self._chassis
        asked = request.vx, request.vy, request.wz
        asked = _scaled(asked, MAX_SPEED / max(*map(abs, asked), MAX_SPEED))
        twist = chassis.possible(asked)
        angles, clipped = chassis.limited_steering(chassis.steering_for(twist, self.angles), self._config.angle)
        angles, saturated = self._reached(angles)
        return Target(twist, angles, clipped or saturated or not _same(twist, asked), saturated)

    def _target_of_shafts(self, rates: Sequence[float]) -> Target:
        """The steering stays as it is."""
        radius = self._chassis.drivetrain.wheel_radius
        speeds = [min(max(rate, -MAX_SPEED), MAX_SPEED) * radius for rate in rates]
        shafts = tuple(speed * min(MAX_SPEED / max(*map(abs, speeds), MAX_SPEED), 1.0) for speed in speeds)
        return Target(self._chassis.predicted(shafts, *self.angles), self.angles, False, False, shafts)

    def _reached(self, angles: Angles) -> tuple[Angles, bool]:
        """Steering angles that the servos reach, and whether these are others."""
        reached = self._chassis.reached(angles)
        return reached, max(abs(asked - got) for asked, got in zip(angles, reached, strict=True)) > SATURATED

    def along(self, twist: Twist[float], angles: Angles | None = None) -> Twist[float]:
        """The part of a twist that the body can do at steering angles, by default the commanded ones."""
        return self._chassis.along(twist, *(self.angles if angles is None else angles))

    def pace(self, twist: Twist[float], shafts: Speeds | None = None) -> float:
        """Greatest speed of the base and of the driven wheels for a twist at the commanded steering angles, m/s.

        Args:
            twist: of the base.
            shafts: speeds of the wheels that are driven open loop; None = they follow from the twist.
        """
        rolling = self._chassis.shafts_along(twist, *self.angles) if shafts is None else shafts
        return max(math.hypot(twist[0], twist[1]), *map(abs, rolling))

    @property
    def present_pace(self) -> float:
        """Pace of the commanded motion, m/s."""
        return self.pace(self.twist, self._open)

    def max_pace(self, twist: Twist[float], shafts: Speeds | None = None) -> float:
        """Greatest pace allowed in the direction of ``twist``, m/s; arguments as of ``pace``."""
        ahead = twist[0] >= AHEAD * self.pace(twist, shafts)
        return self._config.speed if ahead else self._config.reverse_speed

    def progress(self, measured: Speeds, twist: UnitTwist) -> float:
        """Measured pace along a unit twist, m/s: a least-squares fit of its shaft speeds to the measured ones."""
        shafts = self._chassis.shafts_along(twist, *self.angles)
        return _dot(measured, shafts) / (_dot(shafts, shafts) or 1.0)

    def steer(self, target: Angles, dt: float) -> None:
        """Turn all steered wheels towards ``target``, rad, within the steering rate, all by the same share."""
        step = max(abs(to - at) for at, to in zip(self.angles, target, strict=True))
        if step > 0:
            share = min(self._config.steering_rate * dt / step, 1.0)
            self.angles = tuple(at + share * (to - at) for at, to in zip(self.angles, target, strict=True))
            self.twist = self.along(self.twist)

    def aligned(self, target: Angles) -> bool:
        """Whether the body may move while its wheels turn to ``target``."""
        return self._chassis.aligned(self.angles, target)

    def reverses(self, target: Twist[float], shafts: Speeds | None = None) -> bool:
        """Whether wheels that turn for the present motion turn the other way for ``target``, on the whole.

        A motion from open loop to the other forms, or back, counts as one: it passes through standstill.
        """
        if (shafts is None) is not (self._open is None) and not self.standing:
            return True
        rolling = self._chassis.shafts_along(target, *self.angles) if shafts is None else shafts
        return _dot(self.shaft_speeds, rolling) < 0

    def turn_shafts(self, target: Speeds, dt: float) -> None:
        """Change the shaft speeds, open loop, towards ``target``, m/s, as ``accelerate`` does the twist."""
        now = self.shaft_speeds
        change = tuple(to - at for to, at in zip(target, now, strict=True))
        step = self.pace(self._forecast(change), change)
        share = 1.0
        if step > 0:
            growing = self.pace(self._forecast(target), target) > self.present_pace
            rate = self._config.acceleration if growing else self._config.deceleration
            share = min(rate * dt / step, 1.0)
        moved = tuple(at + share * part for at, part in zip(now, change, strict=True))
        self._open = target if share == 1.0 else moved
        self.twist = self._forecast(self._open)

    def slow_down(self, dt: float) -> None:
        """Change the commanded motion towards standstill, whatever its form."""
        if self._open is None:
            self.accelerate(STILL, dt)
        else:
            self.turn_shafts((0.0,) * len(self._open), dt)

    def _forecast(self, shafts: Speeds) -> Twist[float]:
        """Twist of the base at shaft speeds, even if they contradict each other while they change."""
        return self._chassis.twist(self._chassis.input_speeds(shafts, *self.angles), *self.angles)

    def accelerate(self, target: Twist[float], dt: float) -> None:
        """Change the twist towards ``target``: no wheel, nor the base, changes its speed faster than allowed."""
        self._open = None
        change = (target[0] - self.twist[0], target[1] - self.twist[1], target[2] - self.twist[2])
        # A difference of two motions need not be one that the body can do.
        rolling = zip(self._chassis.shafts_along(target, *self.angles), self.shaft_speeds, strict=True)
        step = max(math.hypot(change[0], change[1]), *(abs(to - at) for to, at in rolling))
        if step == 0:
            self.twist = target
            return
        growing = self.pace(target) > self.pace(self.twist)
        rate = self._config.acceleration if growing else self._config.deceleration
        share = min(rate * dt / step, 1.0)
        if growing and change[2] != 0:
            share = min(share, self._config.yaw_acceleration * dt / abs(change[2]))
        x, y, turn = (now + share * part for now, part in zip(self.twist, change, strict=True))
        self.twist = target if share == 1.0 else (x, y, turn)

    def halt(self) -> None:
        """Command standstill without a ramp: the drive controllers decelerate by their own profile."""
        self.twist = STILL
        self._open = None


class CommandLimiter:
    """Moves the commanded motion towards the request of each tick, within all limits.

    Args:
        config: limits.
        motion: commanded motion.
        obstacles: swept footprint against the newest scan.
        sensors: newest samples.
        sonars: swept footprint against the newest echoes; None = the robot has a lidar, or no range sensor at all.
        peers: swept footprint against other robots; None = no peers.
    """

    def __init__(
        self,
        config: GateConfig,
        motion: Motion,
        obstacles: ObstacleGuard,
        sensors: SensorMonitor,
        sonars: SonarGuard | None = None,
        peers: PeerGuard | None = None,
    ) -> None:
        self._config = config
        self._motion = motion
        self._obstacles = obstacles
        self._sensors = sensors
        self._sonars = sonars
        self._peers = peers
        self.blocked = False
        """An obstacle ahead allows no motion."""
        self.blind = False
        """A sector of travel was not seen for too long."""
        self.emergency = False
        """An obstacle is so near that only the quick stop avoids contact."""
        self.free: float | None = None
        """Distance the footprint can travel, m; None = no obstacle within the distance checked."""

    def configure(self, config: GateConfig) -> None:
        """Take other limits, between two ticks."""
        self._config = config
        self._motion.configure(config)
        self._obstacles.configure(config)
        self._sensors.configure(config)
        if self._sonars is not None:
            self._sonars.configure(config)
        if self._peers is not None:
            self._peers.configure(config)

    @property
    def unseen(self) -> float | None:
        """See ``ObstacleGuard.unseen``."""
        return self._obstacles.unseen

    def halt(self) -> None:
        """Command standstill and clear the obstacle state."""
        self._motion.halt()
        self.blocked = self.blind = self.emergency = False
        self.free = None

    def update(self, now: int, dt: float, request: DriveRequest, limits: dict[Reason, float]) -> None:
        """Advance by ``dt`` s towards ``request``; adds the limits of the pace that apply, m/s, to ``limits``."""
        motion = self._motion
        target = motion.target(request)
        turning = motion.aligned(target.angles)
        if turning or (motion.standing and self._sensors.at_rest(now)):
            motion.steer(target.angles, dt)
        shafts = target.shafts
        wanted = STILL if not turning else motion.along(target.twist) if shafts is None else target.twist
        passing = motion.reverses(wanted, shafts)
        if passing:
            wanted, shafts = STILL, None  # a change of direction passes through standstill
        pace = motion.pace(wanted, shafts)
        max_pace = motion.max_pace(wanted, shafts) if pace > 0 else motion.max_pace(motion.twist)
        if target.saturated:
            limits[Reason.SERVO_LIMIT] = max_pace
        if target.clipped or pace > max_pace * (1 + ROUNDING):
            limits[Reason.CLIPPED] = max_pace
        if pace > 0 or not motion.standing:
            if self._sonars is not None:
                self._check_sonars(now, self._sonars, wanted, shafts, limits)
            elif self._sensors.scan_fresh(now):
                self._check_obstacles(now, wanted, shafts, limits)
            else:
                self._check_peers(now, wanted, shafts, limits)
        allowed = min((*limits.values(), max_pace))
        factor = 1.0 if pace <= allowed else allowed / pace
        if allowed == 0:
            motion.halt()
        elif passing:
            motion.slow_down(dt)
        elif shafts is not None:
            motion.turn_shafts(tuple(factor * speed for speed in shafts), dt)
        else:
            motion.accelerate(_scaled(wanted, factor), dt)

    def stopping_distance(self, now: int) -> float:
        """Distance travelled if stopped now, m, by the greater of measured and commanded speed."""
        speed = max(abs(self._sensors.speed(now) or 0.0), *map(abs, self._motion.shaft_speeds))
        speed = min(speed, FASTEST)
        return speed * self._config.reaction + speed**2 / (2 * self._config.deceleration)

    def _courses(self, wanted: Twist[float], shafts: Speeds | None) -> list[Course]:
        """The motions to be swept: ``wanted`` and the commanded one, without those that stand still."""
        motion = self._motion
        courses = ((wanted, motion.pace(wanted, shafts)), (motion.twist, motion.present_pace))
        return [(_scaled(twist, 1.0 / pace), pace) for twist, pace in courses if twist != STILL and pace >= LEAST]

    def _stop_before(self, free: float, allowed: float, fastest: float, limits: dict[Reason, float]) -> None:
        """Add the limit for ``free`` metres ahead, which allow a pace of ``allowed`` m/s."""
        crawl = self._config.obstacle.crawl
        self.free = free if math.isfinite(free) else None
        self.blocked = allowed < (2 * crawl if self.blocked else crawl)
        if self.blocked:
            limits[Reason.OBSTACLE_STOP] = 0.0
        elif allowed < fastest:
            limits[Reason.OBSTACLE_SLOW] = allowed

    def _comfortable(self, free: float, delay: float) -> float:
        """Pace allowed by an obstacle ``free`` metres ahead, seen ``delay`` s ago, m/s."""
        obstacle = self._config.obstacle
        return comfortable_speed(free - obstacle.ahead, delay, obstacle.deceleration)

    def _reach(self, delay: float) -> float:
        """Distance to be swept against obstacles seen ``delay`` s ago, m."""
        config = self._config
        return config.obstacle.ahead + config.speed * (delay + config.speed / (2 * config.obstacle.deceleration))

    def _free_of_peers(
        self, now: int, courses: list[Course], reach: float, limits: dict[Reason, float], seen: Seen | None
    ) -> float:
        """Sweep the footprint against other robots.

        Args:
            now: ns.
            courses: motions to be swept.
            reach: distance swept, m.
            limits: gets the limit for robots whose place is not known.
            seen: the lidar's field of view in base; None = no lidar.

        Returns:
            The free distance, m.
        """
        peers, slow = self._peers, self._config.obstacle.unseen_speed
        if peers is None:
            return math.inf
        looked = self._sonars is not None or seen is not None
        if peers.unknown(now) and any(pace > slow and not (looked and twist[0] >= AHEAD) for twist, pace in courses):
            limits[Reason.PEER_UNKNOWN] = slow
        return peers.free_distance([twist for twist, _ in courses], reach, now, seen)

    def _check_peers(self, now: int, wanted: Twist[float], shafts: Speeds | None, limits: dict[Reason, float]) -> None:
        """Sweep the footprint of a robot without range sensors along both motions: against other robots alone."""
        courses = self._courses(wanted, shafts)
        if self._peers is None or not courses:
            return
        delay = self._config.reaction
        free = self._free_of_peers(now, courses, self._reach(delay), limits, None)
        self._stop_before(free, self._comfortable(free, delay), max(pace for _, pace in courses), limits)

    def _check_sonars(
        self, now: int, sonars: SonarGuard, wanted: Twist[float], shafts: Speeds | None, limits: dict[Reason, float]
    ) -> None:
        """Sweep the footprint along both motions against the sonars' echoes."""
        config, courses = self._config, self._courses(wanted, shafts)
        if not sonars.fresh(now):
            limits[Reason.SONAR_STALE] = 0.0
            return
        delay = sonars.delay(now) + config.reaction
        reach = self._reach(delay)
        views = [sonars.look(twist, reach, now) for twist, _ in courses]
        free = min((view.free for view in views), default=math.inf)
        free = min(free, self._free_of_peers(now, courses, reach, limits, None))
        fastest = max((pace for _, pace in courses), default=0.0)
        self._stop_before(free, self._comfortable(free, delay), fastest, limits)
        if any(view.dead for view in views):
            limits[Reason.SONAR_BLIND] = 0.0
        elif any(view.unknown for view in views):
            limits[Reason.SONAR_SLOW] = config.sonar.unseen_speed

    def _check_obstacles(
        self, now: int, wanted: Twist[float], shafts: Speeds | None, limits: dict[Reason, float]
    ) -> None:
        """Sweep the footprint against the scan: along both motions, and along that of the measured steering angles."""
        motion, courses = self._motion, self._courses(wanted, shafts)
        if not courses:
            return
        fastest = max(pace for _, pace in courses)
        if self._sensors.steering_fresh(now):
            courses.append((motion.along(courses[0][0], self._sensors.angles), 0.0))
        twists = tuple(twist for twist, _ in courses)
        free = self._obstacles.free_distance(twists)
        free = min(free, self._free_of_peers(now, courses, self._obstacles.reach, limits, self._obstacles.looks_at))
        self._stop_before(free, self._obstacles.allowed_speed(free, now), fastest, limits)
        unseen = self._obstacles.unseen
        self.blind = unseen is None or unseen > self._config.scan.stale_after
        if self.blind:
            limits[Reason.LIDAR_BLIND] = 0.0
        elif unseen:
            limits[Reason.LIDAR_SLOW] = self._config.obstacle.unseen_speed
        allowed = max(self._obstacles.allowed_speed(self._obstacles.known, now), self._config.obstacle.unseen_speed)
        if allowed < fastest:
            limits[Reason.UNSEEN_SLOW] = allowed
        measured = self._sensors.shaft_speeds(now)
        speed = max(motion.progress(measured, twist) for twist in twists) if measured else 0.0
        approaching = speed > self._config.standstill
        near = self.blocked and self._obstacles.too_near(free, speed, now)
        self.emergency = approaching and (self.emergency or near)


def _scaled(twist: Twist[float], factor: float) -> Twist[float]:
    return twist[0] * factor, twist[1] * factor, twist[2] * factor


def _dot(one: Speeds, other: Speeds) -> float:
    return math.fsum(a * b for a, b in zip(one, other, strict=True))


def _same(one: Twist[float], other: Twist[float]) -> bool:
    return all(math.isclose(a, b, rel_tol=ROUNDING, abs_tol=ROUNDING) for a, b in zip(one, other, strict=True))
