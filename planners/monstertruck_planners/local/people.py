"""Walking people near the robot: detected in scans, tracked, and predicted along their motion (pure).

A group of neighbouring returns that is as narrow as a person and not hidden by an object in front is tracked from scan
to scan. Once it moves, it is a walker. All other returns are static obstacles.
"""

import math
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import Pose2, points_placed, points_relative, to_world
from monstertruck_planners.collision import Footprint, rectangle_distance
from monstertruck_planners.local.config import PeopleConfig
from monstertruck_runtime.clock import SECOND

LEGS_APART: Final = 0.3
"""Maximum distance between neighbouring returns of one person (m), as of two legs."""
MEMORY: Final = 0.8
"""Time over which a velocity is measured (s)."""


@dataclass(frozen=True, slots=True)
class Walker:
    """A walking person, as a disc."""

    place: tuple[float, float]
    """Position of the centre (m)."""
    velocity: tuple[float, float]
    """Velocity (m/s)."""
    radius: float
    """Radius (m)."""

    def at(self, times: Array) -> Array:
        """Return the predicted centres at times from now (s), shape (n, 2) (m)."""
        return np.asarray(np.array(self.place) + times[:, None] * self.velocity)

    def carried(self, base: Pose2, other: Pose2) -> "Walker":
        """Return the person in another frame, given the pose of the base in this frame and in the other one."""
        (place,) = points_placed(points_relative(np.array([self.place]), base), other).tolist()
        turn = other[2] - base[2]
        return replace(self, place=(place[0], place[1]), velocity=to_world(turn, *self.velocity))


@dataclass(eq=False)
class _PersonTrack:
    """Positions of one group of returns over time."""

    rows: deque[tuple[int, float, float]] = field(default_factory=deque)
    """Stamp (ns) and centre (m)."""
    radius: float = 0.0

    def place(self, stamp: int) -> tuple[float, float]:
        """Return the position at a stamp, predicted with the measured velocity."""
        at, x, y = self.rows[-1]
        vx, vy = self.velocity()
        passed = (stamp - at) / SECOND
        return x + vx * passed, y + vy * passed

    def velocity(self) -> tuple[float, float]:
        """Return the velocity (m/s); 0 for a track shorter than half of ``MEMORY``."""
        t, x, y = np.array(self.rows, dtype=float).T
        t = (t - t[-1]) / SECOND
        if t[0] > -MEMORY / 2:
            return 0.0, 0.0
        off = t - t.mean()
        return float(off @ x / (off @ off)), float(off @ y / (off @ off))


class PeopleTracker:
    """Tracks the people around the robot.

    Args:
        config: criteria for a walker.
    """

    def __init__(self, config: PeopleConfig) -> None:
        self._config = config
        self._tracks: list[_PersonTrack] = []

    def observe(
        self, stamp: int, points: Array, mapped: NDArray[np.bool_], sensor: Array
    ) -> tuple[tuple[Walker, ...], NDArray[np.bool_]]:
        """Add a scan.

        Args:
            stamp: stamp of the scan (ns).
            points: returns in the odometry frame, in the order of the beams, shape (n, 2) (m). In the map frame a
                correction of the robot's pose would look like walking people.
            mapped: whether the map explains each point, shape (n,).
            sensor: position of the lidar, shape (2,) (m).

        Returns:
            The walkers, and whether each point belongs to one, shape (n,).
        """
        known, self._tracks = {track: track.place(stamp) for track in self._tracks}, []
        walkers, walking = [], np.zeros(len(points), np.bool_)
        for group in _groups(points, mapped, sensor):
            ends = points[group[[0, -1]]]
            x, y = ends.mean(axis=0).tolist()
            track = _nearest(known, (x, y))
            if track is None:
                track = _PersonTrack()
            else:
                del known[track]
            track.rows.append((stamp, x, y))
            track.radius = max(track.radius, math.dist(*ends) / 2)
            while stamp - track.rows[0][0] > MEMORY * SECOND:
                track.rows.popleft()
            self._tracks.append(track)
            velocity = track.velocity()
            if math.hypot(*velocity) >= self._config.speed:
                walkers.append(Walker((x, y), velocity, track.radius))
                walking[group] = True
        # A briefly hidden person keeps the track.
        self._tracks += [track for track in known if stamp - track.rows[-1][0] < MEMORY / 2 * SECOND]
        return tuple(walkers), walking


def _groups(points: Array, mapped: NDArray[np.bool_], sensor: Array) -> Iterator[NDArray[np.intp]]:
    """Yield the indices of each group of points that may be a person."""
    new = np.flatnonzero(~mapped)
    cuts = np.flatnonzero(np.hypot(*np.diff(points[new], axis=0).T) > LEGS_APART) + 1
    ranges = np.hypot(*(points - sensor).T)
    for group in np.split(new, cuts):
        # 0.8: maximum width of a person with a load, m
        if len(group) < 2 or math.dist(*points[group[[0, -1]]]) > 0.8:
            continue
        first, last = int(group[0]), int(group[-1])
        before, after = ranges[max(first - 1, 0)], ranges[min(last + 1, len(points) - 1)]
        # 0.1: noise and roundness of a person, m
        if before > ranges[first] - 0.1 and after > ranges[last] - 0.1:
            yield group


def _nearest(places: Mapping[_PersonTrack, tuple[float, float]], place: tuple[float, float]) -> _PersonTrack | None:
    """Return the track with the nearest predicted position, within the gap between a person's returns."""
    track = min(places, key=lambda one: math.dist(places[one], place), default=None)
    return track if track is not None and math.dist(places[track], place) < LEGS_APART else None


def meets(
    walkers: Sequence[Walker], poses: Array, times: Array, footprint: Footprint, distance: float, spread: float
) -> bool:
    """Whether a robot comes too near to a person who keeps walking as predicted.

    A robot that stands, or that moves away from a person, does not approach.

    Args:
        walkers: walking people.
        poses: planned poses of base at the times, shape (n, 3).
        times: times from now (s), shape (n,).
        footprint: outline of the robot.
        distance: minimum distance between outline and person (m).
        spread: growth of a person's disc with time (m/s).
    """
    for walker in walkers:
        places = walker.at(times)
        limits = distance + walker.radius + spread * times
        away = np.diagonal(rectangle_distance(footprint, poses, places))
        (standing,) = rectangle_distance(footprint, poses[:1], places)
        if ((away < limits) & (away < standing - 1e-3)).any():
            return True
    return False
