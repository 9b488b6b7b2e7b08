"""The mapper: scans and odometry in, poses, map and events out. Deterministic; no clock, no I/O."""

import math
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from monstertruck_estimation.slam.closure import LoopCloser
from monstertruck_estimation.slam.config import MapperConfig
from monstertruck_estimation.slam.frontend import (
    DOUBTFUL,
    LEAST_PAIRS,
    FrontEnd,
    Match,
    Planar,
    Verdict,
    deviations,
    rejected,
)
from monstertruck_estimation.slam.graph import drift, optimise
from monstertruck_estimation.slam.motion import MotionModel
from monstertruck_estimation.slam.refinement import refine
from monstertruck_estimation.slam.registration import Cloud, register
from monstertruck_estimation.slam.scans import Scan
from monstertruck_estimation.slam.se2 import between, compose, compose_jacobians, inverse
from monstertruck_estimation.slam.store import EdgeStore, Key, Rows
from monstertruck_estimation.slam.submap import Submap, merged
from monstertruck_runtime.clock import SECOND

Array = NDArray[np.float64]


class Event(StrEnum):
    """What happened at a step, beside its pose."""

    KEY = "key"
    REJECTED = "rejected"
    CLOSED = "closed"


@dataclass(frozen=True, slots=True)
class Step:
    """Where the robot is after one scan."""

    stamp: int
    """ns, the scan's."""
    pose: Array
    """Shape (3,): base in map."""
    covariance: Array
    """Shape (3, 3): of ``pose`` against the map around it."""
    match: Match
    """How the scan fitted; ``pose`` in it is before a closure at this step."""
    map_from_odom: Array | None
    """Shape (3,): odom in map; None without odometry."""
    events: tuple[Event, ...] = ()


@dataclass
class _Trail:
    """Every scan's place, relative to a key scan, so that the whole trajectory moves with the graph."""

    stamps: Rows = field(default_factory=lambda: Rows(dtype=np.int64))
    keys: Rows = field(default_factory=lambda: Rows(dtype=np.int64))
    relative: Rows = field(default_factory=lambda: Rows(3))


class Mapper:
    """Simultaneous localisation and mapping in the plane.

    Args:
        config: noise models and limits.
        front: the scan front end.
    """

    def __init__(self, config: MapperConfig | None = None, front: FrontEnd | None = None) -> None:
        self.config = config or MapperConfig()
        self._front: FrontEnd = front or Planar()
        self.keys: list[Key] = []
        self.poses = np.zeros((0, 3))
        self.edges = EdgeStore()
        self._trail = _Trail()
        self._pose = np.zeros(3)
        self._covariance = np.zeros((3, 3))
        self._motion = MotionModel(self.config)
        self._submap: Submap | None = None
        self._local: NDArray[np.intp] = np.zeros(0, np.intp)
        self._since = np.zeros(3)
        self._since_covariance = np.zeros((3, 3))
        self._stamp: int | None = None
        self._doubts = 0
        self._closer = LoopCloser(self.config)

    def step(self, scan: Scan, stamp: int, odom: Array | None = None) -> Step | None:
        """Take one scan.

        Args:
            scan: points in base at ``stamp``.
            stamp: ns; a scan that is not later than the one before is left out (None).
            odom: shape (3,), pose of base in odom at ``stamp``; None predicts from the motion so far.
        """
        if self._stamp is not None and stamp <= self._stamp:
            return None
        dt = 0.0 if self._stamp is None else (stamp - self._stamp) / SECOND
        delta, noise = self._motion.predict(dt, odom)
        guess = compose(self._pose, delta)
        by_pose, by_delta = compose_jacobians(self._pose, delta)
        covariance = by_pose @ self._covariance @ by_pose.T + by_delta @ noise @ by_delta.T
        self._accumulate(delta, noise)
        if self._submap is None:
            match = rejected(guess, covariance, Verdict.EMPTY)
        else:
            match = self._front.locate(scan, guess, covariance, self._submap)
        doubtful = not match.accepted or match.overlap < DOUBTFUL
        self._doubts = self._doubts + 1 if doubtful else 0
        self._motion.learn(dt, delta, noise, between(self._pose, match.pose), match)
        self._stamp, self._pose, self._covariance = stamp, match.pose, match.covariance
        events = self._extend(scan, stamp, match)
        self._record(stamp)
        odom_now = self._motion.odom
        correction = None if odom_now is None else compose(self._pose, inverse(odom_now))
        return Step(stamp, self._pose.copy(), self._covariance.copy(), match, correction, events)

    def trajectory(self) -> tuple[NDArray[np.int64], Array]:
        """Stamps (n,) and poses (n, 3) of all scans, as the graph has them now."""
        keys = self._trail.keys.view
        return self._trail.stamps.view.copy(), compose(self.poses[keys], self._trail.relative.view)

    def _accumulate(self, delta: Array, noise: Array) -> None:
        by_before, by_delta = compose_jacobians(self._since, delta)
        self._since_covariance = by_before @ self._since_covariance @ by_before.T + by_delta @ noise @ by_delta.T
        self._since = compose(self._since, delta)

    def _extend(self, scan: Scan, stamp: int, match: Match) -> tuple[Event, ...]:
        """Make the scan a key scan where it is due."""
        config = self.config
        events = [] if match.accepted or not self.keys else [Event.REJECTED]
        if self.keys:
            moved = between(self.poses[-1], self._pose)
            if math.hypot(moved[0], moved[1]) < config.key_distance and abs(moved[2]) < config.key_turn:
                return tuple(events)
        if len(scan) < LEAST_PAIRS or (self.keys and 0 < self._doubts < 3):
            return tuple(events)
        thinned = scan.thinned(config.key_cell, config.key_points)
        self.keys.append(Key(stamp, thinned, Cloud.of(thinned)))
        self.poses = np.vstack((self.poses, self._pose))
        events.append(Event.KEY)
        if len(self.keys) > 1:
            self._relate(match)
            if self._closer.close(self):
                events.append(Event.CLOSED)
                self._pose = self.poses[-1].copy()
        self._since, self._since_covariance = np.zeros(3), np.zeros((3, 3))
        self._update_submap()
        return tuple(events)

    def _relate(self, match: Match) -> None:
        """Relations of the newest key scan: odometry, and those it overlaps."""
        new = len(self.keys) - 1
        place, turn = deviations(self._since_covariance)
        information = np.linalg.inv(self._since_covariance + np.diag((1e-6, 1e-6, 1e-6)))
        self.edges.add(new - 1, new, self._since, information, (place**2, turn**2), odometry=True)
        if not match.accepted:
            return
        linked = 0
        order = self._local[np.argsort(self._closeness(self._local, self.poses[new]), kind="stable")]
        candidates = [new - 1, *[int(k) for k in order if k != new - 1]]
        for other in candidates:
            if linked >= self.config.neighbours:
                break
            linked += self.link(other, new, loop=other < new - 5)

    def link(self, origin: int, target: int, loop: bool) -> bool:
        """Relate two key scans that overlap where they are now; False if they do not match."""
        config = self.config
        guess = between(self.poses[origin], self.poses[target])
        fit = register(self.keys[target].scan, self.keys[origin].cloud, guess)
        off = between(guess, fit.pose)
        if fit.overlap < 0.4 or fit.pairs < 20 or math.hypot(off[0], off[1]) > 0.15 or abs(off[2]) > 0.1:
            return False
        way = math.hypot(guess[0], guess[1])
        place = config.drift_distance[0] + config.drift_distance[1] * way
        turn = config.drift_turn[0] + config.drift_turn[1] * abs(float(guess[2]))
        covariance = np.linalg.inv(fit.information + np.diag((1.0, 1.0, 1.0)))
        weakest, _ = deviations(covariance)
        covariance += np.diag((0.005**2, 0.005**2, 0.002**2))
        self.edges.add(origin, target, fit.pose, np.linalg.inv(covariance), (place**2 + weakest**2, turn**2), loop=loop)
        return True

    def _closeness(self, numbers: NDArray[np.intp], pose: Array) -> Array:
        off = between(pose, self.poses[numbers])
        return np.hypot(off[:, 0], off[:, 1]) + 0.7 * np.abs(off[:, 2])

    def around(self, source: int, centre: Array, most: int, reach: float | None = None) -> NDArray[np.intp]:
        """Numbers of the key scans near ``centre`` that are sure against number ``source``, nearest first."""
        config = self.config
        _, far = drift(self.poses, self.edges.edges(), self.edges.spread, source)
        off = np.hypot(self.poses[:, 0] - centre[0], self.poses[:, 1] - centre[1])
        near = np.flatnonzero((far <= config.local_spread**2) & (off <= (reach or config.local_reach)))
        return near[np.argsort(self._closeness(near, centre), kind="stable")][:most]

    def submap(self, numbers: NDArray[np.intp]) -> Submap:
        """Cloud of the numbered key scans in map."""
        scan = merged([self.keys[k].scan for k in numbers], self.poses[numbers])
        return Submap(Cloud.of(scan))

    def _update_submap(self) -> None:
        newest = len(self.keys) - 1
        near = self.around(newest, self.poses[newest], self.config.local_keys)
        recent = np.arange(max(newest - 2, 0), newest + 1)
        self._local = np.union1d(near, recent)
        self._submap = self.submap(self._local)

    def optimise(self) -> None:
        """Fit all poses to all relations; the newest key scan keeps its place in odom by ``map_from_odom``."""
        self.poses = optimise(self.poses, self.edges.edges())

    def finish(self) -> None:
        """Register all key scans jointly (seconds of work): for the end of a run, or a standing robot."""
        self.poses = refine(self.keys, self.poses, self.edges.odometry())

    def _record(self, stamp: int) -> None:
        if not self.keys:
            return
        newest = len(self.keys) - 1
        self._trail.stamps.append(stamp)
        self._trail.keys.append(newest)
        self._trail.relative.append(between(self.poses[newest], self._pose))
