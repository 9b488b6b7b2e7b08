"""Pose of a tag fused over the approach: a Kalman filter on its pose in a frame in which the robot knows its motion.

Every image moves the estimate by its covariance; between images it grows less certain with the distance travelled,
because the frame drifts with odometry. Images from one place share an error of light and lens, which more of them do
not reduce.
"""

from dataclasses import dataclass, replace

import numpy as np

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import Pose2, between, compose, compose_jacobians, inverse, wrap
from monstertruck_planners.behave.dock.config import DockConfig
from monstertruck_schemas.points import TagPose


@dataclass(frozen=True)
class TagEstimate:
    """Estimate of a tag's pose."""

    mean: Array
    """Pose (3,)."""
    covariance: Array
    """(3, 3)."""
    images: int = 1
    """Number of images."""
    here: int = 1
    """Number of images from the present place."""
    moved: float = 0.0
    """Distance travelled since the first of them (m)."""

    @property
    def deviation(self) -> float:
        """Standard deviation of the heading (rad)."""
        return float(np.sqrt(self.covariance[2, 2]))


def seen(estimate: TagEstimate | None, tag: TagPose, base: Array) -> TagEstimate:
    """Return the estimate after an image.

    Args:
        estimate: estimate before; None at the first image.
        tag: pose of the tag in base.
        base: base at the stamp of the image, (3,), in the frame of the estimate.
    """
    local = np.array((tag.x, tag.y, tag.yaw))
    place = compose(base, local)
    by_local = compose_jacobians(base, local)[1]
    # 0.05: after this distance an image is one from another place, m
    here = 1 if estimate is None or estimate.moved >= 0.05 else estimate.here + 1
    # The error that the images of a place share (m, m, rad): half a degree, found at a quarter of full light with a
    # gradient across the image. Each image adds what it tells beyond the images of its place before.
    own, shared = tag.covariance.reshape(3, 3), np.diag(np.square((0.001, 0.001, 0.009)))
    added = np.linalg.inv(own / here + shared)
    if here > 1:
        added -= np.linalg.inv(own / (here - 1) + shared)
    spread = by_local @ np.linalg.inv(added) @ by_local.T
    if estimate is None:
        return TagEstimate(place, spread)
    gain = estimate.covariance @ np.linalg.inv(estimate.covariance + spread)
    off = place - estimate.mean
    off[2] = wrap(off[2])
    mean = estimate.mean + gain @ off
    mean[2] = wrap(mean[2])
    moved = estimate.moved if here > 1 else 0.0
    return TagEstimate(mean, (np.eye(3) - gain) @ estimate.covariance, estimate.images + 1, here, moved)


def driven(estimate: TagEstimate, base: Array, distance: float) -> TagEstimate:
    """Return the estimate after the robot, now at ``base`` (3,), has travelled a ``distance`` (m)."""
    by_base = compose_jacobians(base, between(base, estimate.mean))[0]
    # Standard deviation of odometry (x, y, yaw) after a metre (m, m, rad); it grows with the root of the distance.
    drift = np.diag(np.square((0.02, 0.02, 0.015))) * distance
    covariance = estimate.covariance + by_base @ drift @ by_base.T
    return replace(estimate, covariance=covariance, moved=estimate.moved + distance)


def docked_pose(tag: Array, dock: DockConfig) -> Array:
    """Return the pose (3,) of the docked base, turned to face the dock, from its tag's pose (3,)."""
    return compose(tag, inverse(np.array((dock.tag_distance, dock.tag_offset, np.pi))))


def facing(base: Array, dock: DockConfig) -> Array:
    """Return a pose of base (3,), turned so that its x axis leads out of the end that docks; an involution."""
    return compose(base, np.array((0.0, 0.0, np.pi))) if dock.direction == "reverse" else base


def staging_pose(dock: DockConfig) -> Pose2:
    """Return the staging pose in map: before the dock, with the camera towards its tag."""
    out = facing(np.array((dock.x, dock.y, dock.yaw)), dock)
    x, y, yaw = compose(out, np.array((-dock.staging, 0.0, 0.0))).tolist()
    return x, y, yaw
