"""Identities of robots with two coloured discs; several robots may look the same.

A front disc and a rear disc at the right distance are a robot's pose. It is assigned to the robot expected nearest to
it (by extrapolation with each robot's speed, nearest first, no disc twice). Robots that look the same and were out of
sight together are not guessed: one of them must be seen at its start.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from monstertruck_estimation.vision.blobs import Blob
from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.clock import SECOND
from monstertruckd.tools.stand.camera import PlacedCamera
from monstertruckd.tools.stand.config import BlobRobot
from monstertruckd.tools.stand.poses import MarkerPose, weight_of

AT_START: Final = 0.15
"""Maximum distance from its start position to identify a robot that looks like others (m)."""
UNSURE: Final = 0.5
"""Maximum time out of sight before robots that look the same may be confused (s)."""


class Pair(NamedTuple):
    """Two discs that may belong to a robot."""

    front: int
    rear: int
    pose: MarkerPose
    off: float
    """Difference between their distance and the robot's disc distance (m)."""


@dataclass(slots=True)
class _Track:
    stamp: int
    place: Array
    velocity: Array

    def expected(self, stamp: int) -> tuple[Array, float]:
        seconds = max((stamp - self.stamp) / SECOND, 0.0)
        return self.place + self.velocity * min(seconds, UNSURE), seconds


class Identities:
    """Assigns pairs of discs to robots.

    Args:
        robots: robots by name.
    """

    def __init__(self, robots: Mapping[str, BlobRobot]) -> None:
        self._robots = robots
        self._tracks: dict[str, _Track] = {}
        self._alike = {
            name: [other for other, its in robots.items() if other != name and its.colours == robot.colours]
            for name, robot in robots.items()
        }
        self._mistakable: set[str] = set()
        self._said: set[str] = set()

    def seen(self, stamp: int, camera: PlacedCamera, blobs: Sequence[Blob]) -> list[tuple[str, MarkerPose]]:
        """Return the robots in one image.

        Args:
            stamp: stamp of the image (ns).
            camera: its camera.
            blobs: its discs.
        """
        options = [
            (cost, name, pair)
            for name, robot in self._robots.items()
            for pair in pairs(camera, robot, blobs)
            if (cost := self._cost(name, stamp, pair)) is not None
        ]
        found: dict[str, MarkerPose] = {}
        taken: set[int] = set()
        for _, name, pair in sorted(options, key=lambda option: option[0]):
            if name in found or {pair.front, pair.rear} & taken or self._may_be_another(name, stamp, pair):
                continue
            taken |= {pair.front, pair.rear}
            found[name] = pair.pose
        return list(found.items())

    def learn(self, stamp: int, name: str, pose: MarkerPose) -> None:
        """Store the pose of a robot from all cameras together."""
        place = np.array((pose.x, pose.y))
        track = self._tracks.get(name)
        self._mistakable.discard(name)
        self._said.discard(name)
        if track is None or stamp - track.stamp > UNSURE * SECOND:
            self._tracks[name] = _Track(stamp, place, np.zeros(2))
        elif (seconds := (stamp - track.stamp) / SECOND) > 0:
            share = 1 - math.exp(-seconds / 0.15)  # seconds over which a robot's speed is averaged
            track.velocity = track.velocity + share * ((place - track.place) / seconds - track.velocity)
            track.stamp, track.place = stamp, place

    def complaints(self) -> list[str]:
        """Return the robots that have just become indistinguishable."""
        new = sorted(self._mistakable - self._said)
        self._said |= self._mistakable
        if not new:
            return []
        return [
            f"robots {', '.join(new)} look alike and were out of sight together: place them at their "
            "starts one at a time"
        ]

    def _cost(self, name: str, stamp: int, pair: Pair) -> float | None:
        """Return the distance of a pair from the expected place of a robot (m); None if too far."""
        place = np.array((pair.pose.x, pair.pose.y))
        start = self._robots[name].start
        at_start = None if start is None else float(np.hypot(*(place - start)))
        track = self._tracks.get(name)
        if track is None:
            if not self._alike[name]:
                return AT_START + pair.off
            return at_start if at_start is not None and at_start < AT_START else None
        expected, seconds = track.expected(stamp)
        off = float(np.hypot(*(place - expected)))
        # 0.06: distance from the expected position within which a robot is found again, m
        # 1.0: growth of that distance with the time since the robot was seen, m/s
        if off < 0.06 + 1.0 * seconds:
            return off
        return AT_START + pair.off if seconds > UNSURE and not self._alike[name] else None

    def _may_be_another(self, name: str, stamp: int, pair: Pair) -> bool:
        """Return whether a robot that was out of sight for long may be another one that looks the same."""
        if self._long_gone(name, stamp) and not self._at_start(name, pair):
            others = {
                o for o in self._alike[name] if self._long_gone(o, stamp) and self._cost(o, stamp, pair) is not None
            }
            if others:
                self._mistakable |= {name, *others}
                return True
        return False

    def _long_gone(self, name: str, stamp: int) -> bool:
        track = self._tracks.get(name)
        return track is not None and stamp - track.stamp > UNSURE * SECOND

    def _at_start(self, name: str, pair: Pair) -> bool:
        start = self._robots[name].start
        return start is not None and math.hypot(pair.pose.x - start[0], pair.pose.y - start[1]) < AT_START


def pairs(camera: PlacedCamera, robot: BlobRobot, blobs: Sequence[Blob]) -> Iterator[Pair]:
    """Yield the pairs of discs with a robot's colours and distance."""
    if not blobs:
        return
    pixels = np.array([blob.middle for blob in blobs])
    points = camera.on_plane(pixels, robot.height)
    for i, front in enumerate(blobs):
        for j, rear in enumerate(blobs):
            if front.colour != robot.front or rear.colour != robot.rear:
                continue
            ahead = points[i] - points[j]
            apart = float(np.hypot(*ahead))
            if abs(apart - robot.apart) > 0.012:  # tolerance of the distance of two discs, m
                continue
            x, y = (points[i] + points[j]) / 2
            # 0.1: standard deviation of a disc's centre, pixels
            sigma = 0.1 * apart / float(np.hypot(*(pixels[i] - pixels[j])))
            yield Pair(
                i,
                j,
                MarkerPose(
                    float(x),
                    float(y),
                    math.atan2(ahead[1], ahead[0]),
                    weight_of(camera, pixels[[i, j]]),
                    sigma / math.sqrt(2),
                    sigma * math.sqrt(2) / apart,
                    apart,
                ),
                abs(apart - robot.apart),
            )
