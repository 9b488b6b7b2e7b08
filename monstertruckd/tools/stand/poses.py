"""Poses of markers in one image, and of robots from several: tags, and pairs of coloured discs."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from monstertruck_estimation.vision.tags import Sighting
from monstertruck_kinematics.elementary import Array
from monstertruckd.tools.stand.camera import PlacedCamera
from monstertruckd.tools.stand.config import BlobRobot, TaggedRobot


class MarkerPose(NamedTuple):
    """A tag, or a pair of discs, on its plane, as seen by one camera."""

    x: float
    y: float
    yaw: float
    """Direction from the centre to a tag's printed upper edge, or to the front disc (rad)."""
    weight: float
    sigma: float
    """Standard deviation of x and y (m)."""
    heading_sigma: float
    side: float
    """Side of the tag, or distance of the discs (m)."""


class RobotPose(NamedTuple):
    """Pose of a robot on the stand."""

    robot: str
    stamp: int
    x: float
    y: float
    yaw: float
    sigma: float
    heading_sigma: float
    cameras: tuple[str, ...]


def tag_pose(camera: PlacedCamera, sighting: Sighting, height: float) -> MarkerPose:
    """Return the pose of a level tag.

    The tag's x axis points to its printed upper edge, the robot's front.
    """
    points = camera.on_plane(sighting.corners, height)
    middle = points.mean(axis=0)
    up = (points[0] + points[1]) - (points[2] + points[3])
    right = (points[1] + points[2]) - (points[0] + points[3])
    ahead = up + np.array((-right[1], right[0]))
    side = float(np.hypot(*(points - np.roll(points, 1, axis=0)).T).mean())
    per_pixel = side / max(sighting.size, 1.0)
    sigma = 0.2 * per_pixel  # standard deviation of a corner, pixels
    return MarkerPose(
        float(middle[0]),
        float(middle[1]),
        math.atan2(ahead[1], ahead[0]),
        weight_of(camera, sighting.corners),
        sigma / 2,
        sigma / side,
        side,
    )


def weight_of(camera: PlacedCamera, pixels: Array) -> float:
    """Return the weight of points at these pixels, (n, 2): 1, and less near the image border."""
    # 0.12: share of a picture's height: nearer to its border a sighting has less weight
    return min(max(camera.border(pixels) / 0.12, 0.0), 1.0) + 1e-3  # least weight


def merged(poses: Sequence[MarkerPose]) -> MarkerPose:
    """Return the weighted mean of several cameras' poses of one marker."""
    weights = np.array([pose.weight for pose in poses])
    weights /= weights.sum()
    x, y, side = (float(weights @ [getattr(pose, name) for pose in poses]) for name in ("x", "y", "side"))
    yaw = math.atan2(weights @ [math.sin(p.yaw) for p in poses], weights @ [math.cos(p.yaw) for p in poses])
    sigma, turn = (
        math.sqrt(float(weights**2 @ [getattr(pose, name) ** 2 for pose in poses]))
        for name in ("sigma", "heading_sigma")
    )
    return MarkerPose(x, y, yaw, float(max(pose.weight for pose in poses)), sigma, turn, side)


def robot_pose(
    name: str, robot: TaggedRobot | BlobRobot, stamp: int, tag: MarkerPose, cameras: tuple[str, ...]
) -> RobotPose:
    """Return the pose of a robot from its marker."""
    yaw = math.remainder(tag.yaw - robot.yaw, math.tau)
    c, s = math.cos(yaw), math.sin(yaw)
    x, y = tag.x - c * robot.x + s * robot.y, tag.y - s * robot.x - c * robot.y
    return RobotPose(name, stamp, x, y, yaw, tag.sigma, tag.heading_sigma, cameras)
