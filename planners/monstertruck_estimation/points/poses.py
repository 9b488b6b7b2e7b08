"""Poses of tags in base, from readings in the camera's axes (pure)."""

import math

import numpy as np

from monstertruck_estimation.points.exchange import TagReading
from monstertruck_estimation.vision.mount import camera_axes
from monstertruck_schemas.body import Mount
from monstertruck_schemas.points import TagPose


def tag_pose(reading: TagReading, mount: Mount) -> TagPose:
    """Return the pose of a tag in base, for a camera at ``mount``.

    The covariance is that of the corners in the image. If the second pose of the square fits as well, half its
    difference in yaw counts as a standard deviation, too: which one is right is unknown.
    """
    turned = camera_axes(mount.yaw, mount.pitch, mount.roll)
    x, y, z = turned @ np.array(reading.middle) + np.array((mount.x, mount.y, mount.z))
    normal, other = turned @ np.array(reading.normal), turned @ np.array(reading.other_normal)
    yaw = math.atan2(normal[1], normal[0])
    apart = math.remainder(math.atan2(other[1], other[0]) - yaw, math.tau)
    by_reading = np.zeros((3, 6))
    by_reading[:2, :3] = turned[:2]
    by_reading[2, 3:] = np.array((-normal[1], normal[0])) @ turned[:2] / (normal[0] ** 2 + normal[1] ** 2)
    spread = by_reading @ np.array(reading.spread).reshape(6, 6) @ by_reading.T
    spread[2, 2] += (reading.doubt * apart / 2) ** 2
    flat = spread.ravel()
    flat.flags.writeable = False
    return TagPose(tag=reading.tag, x=float(x), y=float(y), z=float(z), yaw=yaw, covariance=flat)
