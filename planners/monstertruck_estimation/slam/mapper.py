"""The mapper: scans and odometry in, poses, map and events out. Deterministic; no clock, no I/O."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_estimation.slam.closure import LoopCloser
from monstertruck_estimation.slam.config import MapperConfig
from monstertruck_estimation.slam.frontend import DOUBTFUL, LEAST_PAIRS, FrontEnd, Match, Planar, Verdict, rejected
from monstertruck_estimation.slam.keymap import KeyMap
from monstertruck_estimation.slam.motion import MotionModel, velocity
from monstertruck_estimation.slam.scans import Scan
from monstertruck_estimation.slam.se2 import between, compose, compose_jacobians, inverse
from monstertruck_estimation.slam.store import Trail
from monstertruck_estimation.slam.submap import Submap
from monstertruck_runtime.clock import SECOND

Array = NDArray[np.float64]
Vector = tuple[float, float, float]

SWIFT: Final = (0.02, 0.5)
"""Scans this far apart tell the velocity during a scan, s."""
PATIENCE: Final = 3
"""A doubtful scan joins the map only if this many in a row are: a single one may have a wrong stamp or odometry."""


class Event(StrEnum):
    """What happened at a step, beside its pose."""

    KEY = "key"
    REJECTED = "rejected"
    CLOSED = "closed"
    THINNED = "thinned"


@dataclass(frozen=True, slots=True)
class Step:
    """Where the robot is after one scan."""

    stamp: int
    """ns, the scan's."""
    pose: Array
    """Shape (3,): base in map. Jumps with a closure; for what must not jump use odom, and this transform:"""
    map_from_odom: Array | None
    """Shape (3,): pose of odom in map; None without odometry."""
    covariance: Array
    """Shape (3, 3): of ``pose`` against the map around it."""
    match: Match
    """How the scan fitted; its pose is that before a closure at this step."""
    scan: Scan
    """The points as they were used last."""
    events: tuple[Event, ...] = ()


class Mapper:
    """Simultaneous localisation and mapping in the plane.

    Args:
        config: noise models and limits.
        front: the scan front end; ``Planar`` if not given.
    """

    def __init__(self, config: MapperConfig | None = None, front: FrontEnd | None = None) -> None:
        self.config = config or MapperConfig()
        self.map = KeyMap(self.config)
        self._front: FrontEnd = front or Planar()
        self._motion = MotionModel(self.config)
        self._closer = LoopCloser()
        self._trail = Trail(self.config.most_scans)
        self._stamp: int | None = None
        self._pose = np.zeros(3)
        self._covariance = np.zeros((3, 3))
        self._submap: Submap | None = None
        self._local: NDArray[np.intp] = np.zeros(0, np.intp)
        self._since_key = (np.zeros(3), np.zeros((3, 3)))
        self._doubts = 0

    @property
    def twist(self) -> Vector:
        """Velocity of base over the last two scans (vx, vy, wz; m/s, rad/s), for the next one's motion distortion."""
        return self._motion.twist

    def step(
        self,
        scan: Scan,
        stamp: int,
        odom: Array | None = None,
        again: Callable[[Vector], Scan] | None = None,
        period: float = 0.0,
    ) -> Step | None:
        """Take one scan.

        Args:
            scan: points in base at ``stamp``, their motion distortion undone by odometry or by ``twist``.
            stamp: ns; a scan that is not later than the one before is left out (None).
            odom: shape (3,), pose of base in odom at ``stamp``; None predicts from the motion so far.
            again: prepares the same scan for another velocity of the base (vx, vy, wz; m/s, rad/s): where odometry does
                not tell it, the scan is matched a second time by the motion that the first match found.
            period: seconds of a revolution of a sensor that turns evenly, however unevenly its scans are stamped (by a
                busy host, say); 0 = take stamps as they are.
        """
        if self._stamp is not None and stamp <= self._stamp:
            return None
        dt = 0.0 if self._stamp is None else _evenly((stamp - self._stamp) / SECOND, period)
        delta, noise = self._motion.predict(dt, odom)
        guess, covariance = _moved(self._pose, self._covariance, delta, noise)
        self._since_key = _moved(*self._since_key, delta, noise)
        if self._submap is None:
            match = rejected(guess, covariance, Verdict.EMPTY)
        else:
            match = self._front.locate(scan, delta, guess, covariance, self._submap)
            if again is not None and match.accepted and SWIFT[0] <= dt <= SWIFT[1]:
                scan = again(velocity(between(self._pose, match.pose), dt))
                match = self._front.locate(scan, delta, guess, covariance, self._submap)
        doubtful = not match.accepted or match.overlap < DOUBTFUL
        self._doubts = self._doubts + 1 if doubtful else 0
        self._motion.learn(dt, delta, noise, between(self._pose, match.pose), match)
        self._stamp, self._pose, self._covariance = stamp, match.pose, match.covariance
        events: tuple[Event, ...] = () if match.accepted or not len(self.map) else (Event.REJECTED,)
        if self._key_is_due(scan):
            if len(self.map):
                self._append_to_trail(stamp)
            events += self._extend(scan, stamp, match)
        if len(self.map):
            self._append_to_trail(stamp)
        odom_now = self._motion.odom
        correction = None if odom_now is None else compose(self._pose, inverse(odom_now))
        return Step(stamp, self._pose.copy(), correction, self._covariance.copy(), match, scan, events)

    def finish(self) -> None:
        """Register all key scans jointly (seconds of work): for the end of a run, or a robot that stands."""
        if len(self.map):
            place = between(self.map.poses[-1], self._pose)
            self._closer.review(self.map)
            self.map.refine()
            self._pose = compose(self.map.poses[-1], place)
            self._look_around()

    def trajectory(self) -> tuple[NDArray[np.int64], Array]:
        """Stamps (n,), ns, and poses (n, 3) of base in map at all scans, as the graph has them now."""
        return self._trail.poses(self.map.poses)

    def _key_is_due(self, scan: Scan) -> bool:
        if len(scan) < LEAST_PAIRS:
            return False
        if not len(self.map):
            return True
        if 0 < self._doubts < PATIENCE:
            return False
        moved = between(self.map.poses[-1], self._pose)
        return math.hypot(moved[0], moved[1]) >= self.config.key_distance or abs(moved[2]) >= self.config.key_turn

    def _extend(self, scan: Scan, stamp: int, match: Match) -> tuple[Event, ...]:
        """Make the scan a key scan, relate it, look for a loop, and keep the map bounded."""
        events: tuple[Event, ...] = (Event.KEY,)
        self.map.add(scan, stamp, self._pose)
        if len(self.map) > 1:
            self.map.relate_by_odometry(*self._since_key)
            if match.accepted:
                self.map.relate_by_scans(self._local)
            if self._closer.close(self.map):
                events += (Event.CLOSED,)
                self._pose = self.map.poses[-1].copy()
        if len(self.map) > self.config.most_keys:
            events += (Event.THINNED,)
            kept, stand_in, offset = self.map.thin()
            self._trail.move(stand_in, offset)
            self._closer.forget(kept)
        self._since_key = (np.zeros(3), np.zeros((3, 3)))
        self._look_around()
        return events

    def _append_to_trail(self, stamp: int) -> None:
        newest = len(self.map) - 1
        self._trail.append(stamp, newest, between(self.map.poses[newest], self._pose))

    def _look_around(self) -> None:
        self._local = self.map.local()
        self._submap = self.map.submap(self._local)


def _evenly(dt: float, period: float) -> float:
    """``dt`` as the nearest number of whole revolutions."""
    return dt if period <= 0 else max(round(dt / period), 1) * period


def _moved(pose: Array, covariance: Array, delta: Array, noise: Array) -> tuple[Array, Array]:
    """Pose and covariance after a motion ``delta`` of covariance ``noise``."""
    by_pose, by_delta = compose_jacobians(pose, delta)
    return compose(pose, delta), by_pose @ covariance @ by_pose.T + by_delta @ noise @ by_delta.T
