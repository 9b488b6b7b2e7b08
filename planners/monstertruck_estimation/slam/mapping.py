"""Mapping: scans and odometry in; poses, keyframe map and occupancy grid out. Deterministic; no clock, no I/O."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import partial
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from monstertruck_estimation.slam.budget import ScanBudget
from monstertruck_estimation.slam.closure import CONTRADICTION, PART_CONTRADICTION, ChangeDetector, LoopCloser
from monstertruck_estimation.slam.config import GridConfig, MapperConfig
from monstertruck_estimation.slam.correlation import Submap
from monstertruck_estimation.slam.grid import NONE, GridBuilder, passed_ends
from monstertruck_estimation.slam.keyframes import LOOSENED, KeyframeMap, Trajectory
from monstertruck_estimation.slam.motion import (
    MotionPredictor,
    ScanOdometry,
    velocity,
    without_weak_direction,
)
from monstertruck_estimation.slam.mount import LidarCheck
from monstertruck_estimation.slam.movers import MoverDetector
from monstertruck_estimation.slam.relocation import (
    LossDetector,
    Relocation,
    contradicts,
    exceeds,
    led_there,
    prediction_is_certain,
)
from monstertruck_estimation.slam.scan_matcher import (
    LIKELY,
    LOW_OVERLAP,
    MatchStatus,
    PlanarMatcher,
    ScanMatch,
    ScanMatcher,
    deviations,
    enough,
    off_guess,
    rejected,
)
from monstertruck_estimation.slam.scans import Scan, prepare_input
from monstertruck_estimation.slam.storage import SavedGraph, saved_graph
from monstertruck_estimation.slam.worker_io import GridPatch, ScanIncrement, ScanInput, SlamEstimate
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import Pose2, Twist2, between, compose, compose_jacobians, inverse
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.health import MATCHED, UNCERTAIN_DEVIATION, LocalisationStatus, OdometryUse

SUSPECT_CONTRADICTION: Final = 0.03
"""Maximum contradiction of scan and map if a similar-looking place is possible."""
UNKNOWN: Final = np.diag((100.0**2, 100.0**2, math.pi**2))
"""Covariance of a lost robot's pose."""


class MappingEvent(StrEnum):
    """Event of a step."""

    KEY = "key"
    REJECTED = "rejected"
    CLOSED = "closed"
    PRUNED = "pruned"
    APART = "apart"
    """The robot is lost, and starts a submap that is not joined to the map."""
    JOINED = "joined"
    """Two submaps were joined."""
    PARTED = "parted"
    """The join of two submaps was wrong and is undone."""
    CHANGED = "changed"
    """The mapped surroundings of the robot have disappeared, as on another floor."""


@dataclass(frozen=True, slots=True)
class Step:
    """Result of one scan."""

    stamp: int
    """Stamp of the scan (ns)."""
    pose: Array
    """Base in map, shape (3,). It jumps at a loop closure; use odom and the next field for a pose without jumps."""
    map_from_odom: Array | None
    """Pose of odom in map, shape (3,); None without odometry, and while lost."""
    covariance: Array
    """Covariance of ``pose`` against the map around it, shape (3, 3); ``UNKNOWN`` while lost."""
    match: ScanMatch
    """Result of scan matching; its pose precedes a loop closure in this step."""
    scan: Scan
    """Matched points, deskewed."""
    events: tuple[MappingEvent, ...] = ()


class Mapper:
    """Simultaneous localisation and mapping in the plane.

    Args:
        config: noise models and limits.
        front: the scan front end; ``PlanarMatcher`` if not given.
        start: base in map at the first scan.
    """

    def __init__(
        self, config: MapperConfig | None = None, front: ScanMatcher | None = None, start: Pose2 = (0.0, 0.0, 0.0)
    ) -> None:
        self.config = config or MapperConfig()
        self.map = KeyframeMap(self.config)
        self._front: ScanMatcher = front or PlanarMatcher()
        self._motion = MotionPredictor(self.config)
        self._closer = LoopCloser()
        self._trajectory = Trajectory(self.config.most_scans)
        self._stamp: int | None = None
        self._pose = np.array(start, dtype=np.float64)
        self._covariance = np.zeros((3, 3))
        self._submap: Submap | None = None
        self._local: NDArray[np.intp] = np.zeros(0, np.intp)
        self._since_key = (np.zeros(3), np.zeros((3, 3)))
        self._loss = LossDetector()
        self._movers = MoverDetector()
        self._relocation = Relocation()
        self._changes = ChangeDetector()

    @property
    def lost(self) -> bool:
        """Whether recent scans have not fitted the map, or fit only a submap that is not joined to it."""
        return self._loss.lost or not self.map.joined()[-1:].all()

    @property
    def twist(self) -> Twist2:
        """Velocity of base over the last two scans (vx, vy, wz; m/s, rad/s), for deskewing the next one."""
        return self._motion.twist

    def step(
        self,
        scan: Scan,
        stamp: int,
        odom: Array | None = None,
        again: Callable[[Twist2], Scan] | None = None,
        period: float = 0.0,
    ) -> Step | None:
        """Process one scan.

        Args:
            scan: points in base at ``stamp``, their motion distortion undone by odometry or by ``twist``.
            stamp: stamp of the scan (ns); a scan not later than the previous one is ignored (None).
            odom: pose of base in odom at ``stamp``, shape (3,); None predicts from the motion so far.
            again: function that deskews the same scan with another velocity of the base (vx, vy, wz; m/s, rad/s).
                Without odometry, the scan is deskewed with the motion of its first match, and matched a second time.
            period: revolution time of an evenly turning sensor (s), for scans stamped unevenly (by a busy host, say); 0
                uses the stamps.
        """
        if self._stamp is not None and stamp <= self._stamp:
            return None
        dt = 0.0 if self._stamp is None else _evenly((stamp - self._stamp) / SECOND, period)
        self._loss.arrive(stamp)
        scan, (delta, noise), match = self._best_match(scan, stamp, self._motion.predict(dt, odom))
        # Time between two scans, s, in which their motion gives the velocity during a scan (for deskewing).
        deskew_period = (0.02, 0.5)
        if again is not None and match.accepted and deskew_period[0] <= dt <= deskew_period[1]:
            scan = again(velocity(between(self._pose, match.pose), dt))
            match = self._matched(scan, delta, noise)
        self._since_key = _moved(*self._since_key, delta, noise)
        if self._submap is not None:
            gap = self._loss.after_gap or self._loss.sparse
            guess, covariance = _moved(self._pose, self._covariance, delta, noise)
            led = gap and self._led(match, delta, guess, covariance)
            led = led or self._extends(scan, match, guess, covariance)
            driven = math.hypot(delta[0], delta[1]) / self.config.key_distance
            driven_by = (driven, self._key_share(delta)) if self._motion.by_wheels(delta) else (0.0, 0.0)
            self._loss.take(match, driven_by, led=led)
        trusted = not self._motion.check.contradicted
        moved = between(self._pose, match.pose)
        self._motion.learn(dt, delta, noise, moved, match)
        self._movers.settle(float(moved[2]))
        if trusted and self._motion.check.contradicted:
            self.map.loosen_odometry(stamp - round(self._motion.check.since * SECOND))
            self._since_key = self._since_key[0], self._since_key[1] * LOOSENED**2
        self._stamp, self._pose, self._covariance = stamp, match.pose, match.covariance
        events: tuple[MappingEvent, ...] = () if match.accepted or not len(self.map) else (MappingEvent.REJECTED,)
        if self._is_elsewhere(scan):
            events += (*self._begin_submap(scan, stamp), MappingEvent.APART)
        elif self._key_is_due(scan):
            if len(self.map):
                self._append_to_trajectory(stamp)
            events += self._extend(scan, stamp, match)
        if len(self.map):
            self._append_to_trajectory(stamp)
        events += self._searched()
        odom_now = self._motion.odom
        correction = None if odom_now is None or self.lost else compose(self._pose, inverse(odom_now))
        covariance = UNKNOWN if self.lost else self._covariance
        return Step(stamp, self._pose.copy(), correction, covariance.copy(), match, scan, events)

    @property
    def odometry(self) -> OdometryUse:
        """Whether the motion between scans is predicted by odometry."""
        return self._motion.use

    def _best_match(
        self, scan: Scan, stamp: int, motion: tuple[Array, Array]
    ) -> tuple[Scan, tuple[Array, Array], ScanMatch]:
        """Match the scan from the predicted ``motion``, or from the first alternative prediction that fits.

        Returns:
            The scan (without moving points if the predicted motion is right), the motion used, and its match.
        """
        match = self._matched(scan, *motion)
        still = self._still(scan, stamp, motion[0], match)
        if still is not scan:
            instead = self._matched(still, *motion, 1.0 - len(still) / len(scan))
            guess, covariance = _moved(self._pose, self._covariance, *motion)
            # With wrong wheels, walls seem to move, and the remaining points then fit elsewhere.
            if fits(instead) and (fits(match) or off_guess(instead.pose, guess, covariance) <= LIKELY):
                return still, motion, instead
        if fits(match) or self._submap is None:
            return scan, motion, match
        for other in self._motion.others:
            instead = self._matched(scan, *other)
            if fits(instead):
                return scan, other, instead
        return scan, motion, match

    def _still(self, scan: Scan, stamp: int, delta: Array, match: ScanMatch) -> Scan:
        """Return ``scan`` without moving points, by the distance of ``delta`` and the turn of a fitting ``match``."""
        by_wheels = delta if self._motion.by_wheels(delta) else None
        turn = between(self._pose, match.pose)[2] if fits(match) else delta[2]
        return self._movers.still(stamp, by_wheels, float(turn), scan)

    def _matched(self, scan: Scan, delta: Array, noise: Array, moving: float = 0.0) -> ScanMatch:
        """Match ``scan``, without the share ``moving`` of its points, after a motion ``delta`` with ``noise``."""
        guess, covariance = _moved(self._pose, self._covariance, delta, noise)
        if self._submap is None:
            return rejected(guess, covariance, MatchStatus.EMPTY)
        match = self._front.match(scan, delta, guess, covariance, self._submap)
        if self._motion.by_wheels(delta):
            match = replace(match, moving=moving)
            bounded = without_weak_direction(match, guess, covariance)
            # A weak constraint measures better than wheels, but less well than it claims: the walls' ends move along.
            # People measure nothing.
            match = replace(match, covariance=bounded.covariance) if match.degeneracy >= moving else bounded
        suspect, after_gap = self._loss.suspects(match, guess, covariance), self._loss.after_gap and match.accepted
        if self._loss.after_gap and self._led(match, delta, guess, covariance):
            return match
        most = PART_CONTRADICTION if suspect else CONTRADICTION
        if match.accepted and (off := self._motion.off(between(self._pose, match.pose))):
            # Maximum difference of a match from odometry, or from the last motion, if these may be wrong (m, rad).
            # Every misfit enlarges the window of the next match, and the window of the last motion is wide: sooner or
            # later a carried robot fits somewhere within it. The last motion corrects late wheel readings.
            if exceeds(off, (0.5, 1.0)):
                return rejected(guess, covariance, MatchStatus.FAR)
            # Minimum difference of a match that may be at a similar-looking place: for doubtful and for usual matches.
            if exceeds(off, (0.1, 0.1) if self._loss.doubts(match) else (0.25, 0.25)):
                suspect, most = True, SUSPECT_CONTRADICTION
        if (suspect or after_gap) and contradicts(self.map, scan, match.pose, most):
            return rejected(guess, covariance, MatchStatus.CONTRADICTED)
        if after_gap and not prediction_is_certain(covariance) and self._has_moved(match.pose):
            return rejected(guess, covariance, MatchStatus.UNSURE)
        return match

    def _led(self, match: ScanMatch, delta: Array, guess: Array, covariance: Array) -> bool:
        """Whether ``match`` agrees with the wheels: with ``guess`` and its ``covariance``."""
        return match.accepted and self._motion.by_wheels(delta) and led_there(match, guess, covariance)

    def _extends(self, scan: Scan, match: ScanMatch, guess: Array, covariance: Array) -> bool:
        """Whether ``match`` agrees with the motion, and all misfitting points lie in unknown space."""
        if self._loss.after_gap or not match.accepted or match.degenerate or not self._loss.misfits(match):
            return False
        here = led_there(match, guess, covariance)
        return here and not contradicts(self.map, scan, match.pose, SUSPECT_CONTRADICTION)

    def finish(self) -> bool:
        """Search for open submaps and remaining loop closures, then register all keyframes jointly: seconds of work.

        Returns:
            Whether the joint registration was kept (``KeyframeMap.refine``).
        """
        if not len(self.map):
            return False
        place = between(self.map.poses[-1], self._pose)
        self._relocation.finish(self.map, self._closer)
        self._closer.review(self.map)
        joint = self.map.refine()
        self._pose = compose(self.map.poses[-1], place)
        self._look_around()
        return joint

    def trajectory(self) -> tuple[NDArray[np.int64], Array]:
        """Return stamps (n,) (ns) and poses (n, 3) of base in map at all scans, by the current graph."""
        return self._trajectory.poses(self.map.poses)

    def poses_at(self, stamps: NDArray[np.int64]) -> Array:
        """Return base in map at instants (n,) (ns) by the current graph, (n, 3); NaN if unknown."""
        return self._trajectory.at(stamps, self.map.poses, self.map.joined())

    def on_map(self) -> NDArray[np.bool_]:
        """Whether each scan of ``trajectory`` belongs to the map, not to a submap that is not joined to it; (n,)."""
        return self._trajectory.marked(self.map.joined())

    def _key_is_due(self, scan: Scan) -> bool:
        if not enough(len(scan)):
            return False
        if not len(self.map):
            return True
        if not self._loss.fits and not self._loss.lost:
            return False
        return self._has_moved(self._pose)

    def _has_moved(self, pose: Array) -> bool:
        """Whether ``pose``, shape (3,), is a keyframe's distance away from the latest keyframe."""
        return self._key_share(between(self.map.poses[-1], pose)) >= 1.0

    def _key_share(self, moved: Array) -> float:
        """Return the motion ``moved``, shape (3,), as a share of the motion between keyframes."""
        way, turned = math.hypot(moved[0], moved[1]), abs(float(moved[2]))
        return max(way / self.config.key_distance, turned / self.config.key_turn)

    def _is_elsewhere(self, scan: Scan) -> bool:
        """Whether a lost robot has left the place that its motion since the last fit predicts."""
        if not len(self.map) or not enough(len(scan)) or not self._loss.lost:
            return False
        alone = self._motion.use is not OdometryUse.USED
        return alone or self._loss.after_gap or contradicts(self.map, scan, self._pose)

    def _begin_submap(self, scan: Scan, stamp: int) -> tuple[MappingEvent, ...]:
        """Start a submap from the scans since the first misfit; undo joins in doubt, which may be wrong."""
        place = between(self.map.poses[-1], self._pose)
        change = self._relocation.part(self.map, self._closer)
        if change is not None:
            self._pose = compose(self.map.poses[-1], place)
        self.map.add(scan, stamp, self._pose, apart=True)
        self._trajectory.reattach(self._loss.fitted + 1, self.map.poses, len(self.map) - 1)
        self._since_key = (np.zeros(3), np.zeros((3, 3)))
        self._covariance = np.zeros((3, 3))
        self._loss.restart()
        self._look_around()
        return () if change is None else (MappingEvent(change),)

    def _searched(self) -> tuple[MappingEvent, ...]:
        """Continue the searches for loops and for places of submaps within the budget."""
        if not len(self.map):
            return ()
        poses, place = self.map.poses, between(self.map.poses[-1], self._pose)
        events: tuple[MappingEvent, ...] = ()
        budget = ScanBudget()
        # One search at a time: the poses must not move during a search.
        if not self._relocation.busy and self._closer.step(self.map, budget):
            events += (MappingEvent.CLOSED,)
        if not self._closer.busy and (change := self._relocation.step(self.map, self._closer, budget)) is not None:
            events += (MappingEvent(change),)
        if events or self.map.poses is not poses:
            self._pose = compose(self.map.poses[-1], place)
            self._look_around()
        return events

    def _extend(self, scan: Scan, stamp: int, match: ScanMatch) -> tuple[MappingEvent, ...]:
        """Add the scan as a keyframe with its edges, start a search for loops from it, and prune the map."""
        events: tuple[MappingEvent, ...] = (MappingEvent.KEY,)
        self.map.add(scan, stamp, self._pose)
        if not self._loss.fits:
            self._loss.restart()
        if len(self.map) > 1:
            self.map.add_odometry_edge(*self._since_key)
            if match.accepted:
                self.map.add_scan_edges(self._local)
            self._closer.watch(len(self.map) - 1)
        if len(self.map) > self.config.most_keys:
            events += (MappingEvent.PRUNED,)
            kept, stand_in, offset = self.map.prune()
            self._trajectory.move(stand_in, offset)
            self._closer.forget(kept)
            self._changes.forget()
            self._relocation.forget()
        self._since_key = (np.zeros(3), np.zeros((3, 3)))
        self._look_around()
        if self._changes.take(self.map, self._local):
            events += (MappingEvent.CHANGED,)
        return events

    def _append_to_trajectory(self, stamp: int) -> None:
        newest = len(self.map) - 1
        self._trajectory.append(stamp, newest, between(self.map.poses[newest], self._pose))

    def _look_around(self) -> None:
        self._local = self.map.local()
        self._submap = self.map.submap(self._local)


def fits(match: ScanMatch) -> bool:
    """Whether the scan clearly fits the map."""
    return match.accepted and match.overlap >= LOW_OVERLAP


def _evenly(dt: float, period: float) -> float:
    """Return ``dt`` rounded to whole revolutions."""
    return dt if period <= 0 else max(round(dt / period), 1) * period


def _moved(pose: Array, covariance: Array, delta: Array, noise: Array) -> tuple[Array, Array]:
    """Return pose and covariance after a motion ``delta`` with covariance ``noise``."""
    by_pose, by_delta = compose_jacobians(pose, delta)
    return compose(pose, delta), by_pose @ covariance @ by_pose.T + by_delta @ noise @ by_delta.T


LOST_AFTER: Final = 10
"""Number of consecutive misfits until the robot is lost."""


class Estimator(Protocol):
    """Mapping, or localisation in a saved map, as run by the worker."""

    counts: dict[str, int]
    """Numbers of scans, keyframes, closures and rejected matches."""

    @property
    def twist(self) -> Twist2:
        """Velocity of base from the last scans (m/s, rad/s)."""

    @property
    def odometry(self) -> OdometryUse:
        """Whether the motion between scans is predicted by odometry."""

    def step(self, scan: Scan, inputs: ScanInput) -> SlamEstimate | None:
        """Process a scan; return None if it is not later than the previous one."""

    def changes(self) -> tuple[list[GridPatch], bool]:
        """Return the tiles changed since the last call, and whether the grid was rebuilt."""

    def patch(self) -> GridPatch:
        """Return the whole grid."""

    def graph(self) -> SavedGraph | None:
        """Return the pose graph to save with the grid; None without one."""

    def trajectory(self) -> tuple[NDArray[np.int64], Array] | None:
        """Return stamps (n,) (ns) and poses (n, 3) of base in map at all scans; None in a saved map."""

    def on_map(self) -> NDArray[np.bool_] | None:
        """Whether each of these scans, (n,), belongs to the map, not to a separate submap; None in a saved map."""

    def poses_at(self, stamps: NDArray[np.int64]) -> Array | None:
        """Return base in map at instants (n,) (ns): (n, 3), NaN if unknown; None in a saved map."""

    def finish(self) -> bool:
        """Optimise everything jointly; return False if the result was not kept."""


class MappingEstimator:
    """Mapper with an occupancy grid.

    Args:
        mapper: noise models and limits.
        grid: settings of the occupancy grid.
        front: scan front end; None for the default.
        start: base in map at the first scan.
        body: see ``GridBuilder``.
    """

    def __init__(
        self, mapper: MapperConfig, grid: GridConfig, front: ScanMatcher | None = None,
        start: Pose2 = (0.0, 0.0, 0.0), body: tuple[float, float] | None = None,
    ) -> None:  # fmt: skip
        self.mapper = Mapper(mapper, front, start)
        self.builder = GridBuilder(grid, body)
        self._passed = grid.passed
        self.counts = {"scans": 0, "keys": 0, "closures": 0, "rejected": 0}
        self._moved = False
        self._redrawn = False
        self._misfits = 0
        self._drawn: tuple[Array, Pose2] | None = None
        """Base in map and in odom at the latest scan, if it belongs to the grid."""
        self._apart: list[tuple[Scan, int, Pose2]] = []
        """Keyframes in submaps off the map: scan, stamp, mount."""
        self._doubtful: list[tuple[Scan, int, Pose2]] = []
        """Keyframes on the map through a join in doubt."""
        self._check = LidarCheck()
        self._scan_odometry = ScanOdometry()

    @property
    def twist(self) -> Twist2:
        """See ``Estimator``."""
        return self.mapper.twist

    @property
    def odometry(self) -> OdometryUse:
        """See ``Estimator``."""
        return self.mapper.odometry

    def step(self, scan: Scan, inputs: ScanInput) -> SlamEstimate | None:
        """See ``Estimator``."""
        odom = None if inputs.odom is None else np.array(inputs.odom)
        alone = self.mapper.odometry is not OdometryUse.USED or odom is None
        swept = alone and inputs.time_increment > 0
        again = partial(prepare_input, replace(inputs, odom=None), self.mapper.config.longest) if swept else None
        period = inputs.time_increment * math.tau / abs(inputs.angle_increment) if swept else 0.0
        step = self.mapper.step(scan, inputs.stamp, odom, again, period)
        if step is None:
            return None
        accepted = step.match.accepted or (MappingEvent.KEY in step.events and len(self.mapper.map) == 1)
        self._misfits = 0 if accepted else self._misfits + 1
        lost, joined, parted = self.mapper.lost, MappingEvent.JOINED in step.events, MappingEvent.PARTED in step.events
        self.counts["scans"] += 1
        self.counts["keys"] = len(self.mapper.map)
        self.counts["closures"] += MappingEvent.CLOSED in step.events
        self.counts["rejected"] += MappingEvent.REJECTED in step.events
        self._moved |= MappingEvent.CLOSED in step.events or joined or parted
        key, keyframe = {MappingEvent.KEY, MappingEvent.APART}, (step.scan, step.stamp, inputs.mount)
        if not key.isdisjoint(step.events):
            if lost or joined:
                self._apart.append(keyframe)
            elif self._doubtful:
                self._doubtful.append(keyframe)
        self._drawn = None
        if not lost and not joined and accepted:
            if inputs.odom is not None and self.mapper.odometry is OdometryUse.USED:
                self._drawn = step.pose, inputs.odom
            passed = NONE if self._passed is None else passed_ends(inputs, self._passed)
            self.builder.add(step.scan, step.stamp, step.pose, inputs.mount, passed)
            self._check.add(step.stamp, step.pose, odom, self.mapper.odometry)
        else:
            self._check.interrupt()
        if parted:
            self._withdraw_parted()
        if joined:
            self._draw_joined()
        if not self.mapper.map.doubtful:
            self._doubtful.clear()
        closed = MappingEvent.CLOSED in step.events or joined or parted
        if closed:
            self._check.interrupt()
        moved = self._scan_odometry.take(step.stamp, step.match, step.pose, alone=alone, corrected=closed)
        status = (
            LocalisationStatus.LOST
            if lost or self._misfits >= LOST_AFTER
            else status_of(step.match, LocalisationStatus.MAPPING)
        )
        return estimate(
            step.stamp,
            (step.pose, step.covariance, step.map_from_odom),
            step.match,
            status,
            tuple(map(str, step.events)),
            self._check,
            moved,
            self.mapper.odometry,
        )

    def draw(self, scan: Scan, inputs: ScanInput) -> None:
        """Add a scan of the second lidar to the grid, placed by odometry since the latest scan."""
        if self._drawn is not None and inputs.odom is not None:
            pose, odom = self._drawn
            there = compose(pose, between(np.array(odom), np.array(inputs.odom)))
            passed = NONE if self._passed is None else passed_ends(inputs, self._passed)
            self.builder.add(scan, inputs.stamp, there, inputs.mount, passed, lidar=1)

    def changes(self) -> tuple[list[GridPatch], bool]:
        """See ``Estimator``."""
        self._follow()
        redrawn, self._redrawn = self._redrawn, False
        return self.builder.grid.changes(), redrawn

    def patch(self) -> GridPatch:
        """See ``Estimator``."""
        self._follow()
        return self.builder.grid.patch()

    def graph(self) -> SavedGraph | None:
        """See ``Estimator``."""
        return saved_graph(self.mapper.map)

    def trajectory(self) -> tuple[NDArray[np.int64], Array]:
        """See ``Estimator``."""
        return self.mapper.trajectory()

    def on_map(self) -> NDArray[np.bool_]:
        """See ``Estimator``."""
        return self.mapper.on_map()

    def poses_at(self, stamps: NDArray[np.int64]) -> Array:
        """See ``Estimator``."""
        return self.mapper.poses_at(stamps)

    def finish(self) -> bool:
        """See ``Estimator``."""
        joint = self.mapper.finish()
        self._draw_joined()
        self._moved = True
        return joint

    def _draw_joined(self) -> None:
        """Add the keyframes of submaps to the grid once they are joined to the map."""
        stamps, poses = self.mapper.trajectory()
        on_map, waiting, self._apart = self.mapper.on_map(), self._apart, []
        for scan, stamp, mount in waiting:
            k = np.searchsorted(stamps, stamp)
            if on_map[k]:
                self.builder.add(scan, stamp, poses[k], mount)
            (self._doubtful if on_map[k] else self._apart).append((scan, stamp, mount))

    def _withdraw_parted(self) -> None:
        """Remove the keyframes of a wrong join from the grid."""
        stamps, _ = self.mapper.trajectory()
        on_map = self.mapper.on_map()
        self._apart += [row for row in self._doubtful if not on_map[np.searchsorted(stamps, row[1])]]
        self.builder.keep_marked(stamps, on_map)
        self._redrawn = True

    def _follow(self) -> None:
        if self._moved:
            self._moved = False
            self._redrawn |= self.builder.update_poses(*self.mapper.trajectory())


def status_of(match: ScanMatch, good: LocalisationStatus) -> LocalisationStatus:
    """Return ``good``, or DEGENERATE if the match does not constrain one direction."""
    return LocalisationStatus.DEGENERATE if match.accepted and match.degenerate else good


def estimate(
    stamp: int,
    placed: tuple[Array, Array, Array | None],
    match: ScanMatch,
    status: LocalisationStatus,
    events: tuple[str, ...],
    check: LidarCheck,
    moved: ScanIncrement | None = None,
    odometry: OdometryUse = OdometryUse.NONE,
) -> SlamEstimate:
    """Return plain numbers of a match; ``placed`` are pose, covariance and odom in map."""
    pose, covariance, correction = placed
    if status in MATCHED and deviations(covariance)[0] > UNCERTAIN_DEVIATION:
        status = LocalisationStatus.UNCERTAIN
    return SlamEstimate(
        stamp=stamp,
        pose=plain(pose),
        covariance=tuple(float(value) for value in covariance.ravel()),
        map_from_odom=None if correction is None else plain(correction),
        status=status,
        overlap=match.overlap,
        residual=match.residual,
        degeneracy=match.degeneracy,
        direction=match.direction,
        verdict=str(match.verdict),
        events=events,
        offset=check.offset,
        mount_fault=check.mount_fault,
        moved=moved,
        odometry=odometry,
    )


def plain(pose: Any) -> Pose2:
    """Return a pose as three floats."""
    x, y, yaw = (float(value) for value in pose)
    return x, y, yaw
