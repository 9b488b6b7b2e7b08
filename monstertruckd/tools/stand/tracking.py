"""From tags in several cameras' pictures to the poses of robots, without jumps where one camera hands over to the next.

Each camera that sees a robot's tag gives a pose on the plane of the tag; they are averaged with weights that fall to
nothing towards a picture's border, so that a robot leaves a camera's view gradually. Who is who the tags say. A pose
that no robot can have reached is left out, until it is seen again and again.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np

from monstertruck_estimation.vision.tags import Sighting
from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.clock import SECOND
from monstertruckd.tools.stand.camera import PlacedCamera
from monstertruckd.tools.stand.config import MarkConfig, TaggedRobot

FADE: Final = 0.12
"""Of a picture's height: nearer to its border a sighting counts less."""
LEAST_WEIGHT: Final = 1e-3
FASTEST: Final = 3.0
"""m/s: robots are not faster;"""
SLACK: Final = 0.05
"""and this much, m, is no jump."""
STUBBORN: Final = 5
"""Pictures after which an impossible pose is believed."""
PIXEL: Final = 0.2
"""Standard deviation of a corner, pixels."""
BUMPED: Final = 0.005
"""m: marks seen this far from their places, on average over those of a camera and over time: the camera has moved."""
BUMP_TIME: Final = 3.0
"""Seconds over which that is averaged."""
SILENT: Final = 1.0
"""Seconds without a picture after which a camera counts as lost."""


class TagPose(NamedTuple):
    """A tag on its plane, as one camera sees it."""

    x: float
    y: float
    yaw: float
    """Of the direction in which its printed upper edge lies from its middle, rad."""
    weight: float
    sigma: float
    """Standard deviation of x and y, m."""
    heading_sigma: float


class RobotPose(NamedTuple):
    """A robot on the stand."""

    robot: str
    stamp: int
    x: float
    y: float
    yaw: float
    sigma: float
    heading_sigma: float
    cameras: tuple[str, ...]


def tag_pose(camera: PlacedCamera, sighting: Sighting, height: float) -> TagPose:
    """Where a level tag is.

    The tag's x axis is the direction in which its printed upper edge lies, as a robot's front.
    """
    points = camera.on_plane(sighting.corners, height)
    middle = points.mean(axis=0)
    up = (points[0] + points[1]) - (points[2] + points[3])
    right = (points[1] + points[2]) - (points[0] + points[3])
    ahead = up + np.array((-right[1], right[0]))
    side = float(np.hypot(*(points - np.roll(points, 1, axis=0)).T).mean())
    per_pixel = side / max(sighting.size, 1.0)
    weight = min(max(camera.border(sighting.corners) / FADE, 0.0), 1.0) + LEAST_WEIGHT
    sigma = PIXEL * per_pixel
    return TagPose(
        float(middle[0]),
        float(middle[1]),
        math.atan2(ahead[1], ahead[0]),
        weight,
        sigma / 2,
        sigma / side,
    )


def merged(poses: Sequence[TagPose]) -> TagPose:
    """Weighted mean of what several cameras see of one tag."""
    weights = np.array([pose.weight for pose in poses])
    weights /= weights.sum()
    x, y = (float(weights @ [getattr(pose, axis) for pose in poses]) for axis in ("x", "y"))
    yaw = math.atan2(weights @ [math.sin(p.yaw) for p in poses], weights @ [math.cos(p.yaw) for p in poses])
    sigma, turn = (
        math.sqrt(float(weights**2 @ [getattr(pose, name) ** 2 for pose in poses]))
        for name in ("sigma", "heading_sigma")
    )
    return TagPose(x, y, yaw, float(max(pose.weight for pose in poses)), sigma, turn)


@dataclass(slots=True)
class _Known:
    pose: RobotPose
    doubts: int = 0


@dataclass(slots=True)
class CameraState:
    """How a camera is."""

    heard: int
    """Stamp of its newest picture, ns."""
    pictures: int = 0
    off: Array = field(default_factory=lambda: np.zeros(2))
    """Smoothed distance of its marks from their places, m."""
    lost: bool = False
    bumped: bool = False


class StandTracker:
    """Poses of all robots, and the state of the cameras.

    Args:
        cameras: placed.
        robots: by name.
        marks: tags on the table, by number.
        now: stamp of the begin, ns.
    """

    def __init__(
        self,
        cameras: Mapping[str, PlacedCamera],
        robots: Mapping[str, TaggedRobot],
        marks: Mapping[int, MarkConfig],
        now: int = 0,
    ) -> None:
        self._cameras = cameras
        self._robots = {robot.tag: (name, robot) for name, robot in robots.items()}
        self.marks = marks
        self._known: dict[str, _Known] = {}
        self.cameras = {name: CameraState(now) for name in cameras}
        self.left_out = 0
        """Impossible poses."""

    def take(self, stamp: int, pictures: Mapping[str, Sequence[Sighting]]) -> list[RobotPose]:
        """Poses at ``stamp``, ns, from the tags in the cameras' pictures of that instant."""
        seen: dict[int, list[tuple[str, TagPose]]] = {}
        for name, sightings in pictures.items():
            self._watch(name, stamp, sightings)
            for sighting in sightings:
                if (entry := self._robots.get(sighting.tag)) is not None:
                    pose = tag_pose(self._cameras[name], sighting, entry[1].height)
                    seen.setdefault(sighting.tag, []).append((name, pose))
        poses = []
        for tag, found in seen.items():
            name, robot = self._robots[tag]
            whole = merged([pose for _, pose in found])
            where = _robot_pose(name, robot, stamp, whole, tuple(camera for camera, _ in found))
            if self._believed(where):
                poses.append(where)
        return poses

    def complaints(self, now: int) -> list[str]:
        """What is newly wrong with cameras, or right again."""
        said = []
        for name, state in self.cameras.items():
            lost = now - state.heard > SILENT * SECOND
            bumped = not lost and float(np.hypot(*state.off)) > BUMPED
            if lost != state.lost:
                said.append(
                    f"camera {name} " + (f"sends no picture for {SILENT:g} s" if lost else "sends pictures again")
                )
            if bumped != state.bumped and not lost:
                millimetres = 1000 * float(np.hypot(*state.off))
                text = f"has moved: its marks are {millimetres:.0f} mm from their places, calibrate the stand again"
                said.append(f"camera {name} " + (text if bumped else "sees its marks in their places again"))
                state.bumped = bumped
            state.lost = lost
        return said

    def _believed(self, pose: RobotPose) -> bool:
        known = self._known.get(pose.robot)
        if known is None:
            self._known[pose.robot] = _Known(pose)
            return True
        seconds = (pose.stamp - known.pose.stamp) / SECOND
        jump = math.hypot(pose.x - known.pose.x, pose.y - known.pose.y)
        if jump > FASTEST * max(seconds, 0.0) + SLACK and known.doubts < STUBBORN:
            known.doubts += 1
            self.left_out += 1
            return False
        known.pose, known.doubts = pose, 0
        return True

    def _watch(self, name: str, stamp: int, sightings: Sequence[Sighting]) -> None:
        """Marks of a camera that are not where they were when it was calibrated."""
        state, camera = self.cameras[name], self._cameras[name]
        seconds = (stamp - state.heard) / SECOND
        state.heard, state.pictures = stamp, state.pictures + 1
        off = []
        for sighting in sightings:
            if sighting.tag in self.marks:
                mark = self.marks[sighting.tag]
                middle = camera.on_plane(sighting.corners).mean(axis=0)
                off.append(middle - (mark.x, mark.y))
        if off:
            share = 1.0 - math.exp(-max(min(seconds, 1.0), 0.0) / BUMP_TIME)
            state.off = state.off + share * (np.mean(off, axis=0) - state.off)


def _robot_pose(name: str, robot: TaggedRobot, stamp: int, tag: TagPose, cameras: tuple[str, ...]) -> RobotPose:
    yaw = math.remainder(tag.yaw - robot.yaw, math.tau)
    c, s = math.cos(yaw), math.sin(yaw)
    x, y = tag.x - c * robot.x + s * robot.y, tag.y - s * robot.x - c * robot.y
    return RobotPose(name, stamp, x, y, yaw, tag.sigma, tag.heading_sigma, cameras)
