"""Inputs and outputs of the image reader; light, for import by the daemon."""

import math
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np

from monstertruck_estimation.vision.mount import camera_axes
from monstertruck_schemas.board import TagFamily
from monstertruck_schemas.body import LensConfig, Mount
from monstertruck_schemas.points import TagPose

Triple = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class ReadTask:
    """Image to read."""

    jpeg: bytes
    lens: LensConfig
    size: float
    """Side of the tags (m)."""
    sizes: dict[int, float] = field(default_factory=dict)
    """Sizes of other tags, by number."""
    reach: float = 2.0
    """Maximum distance of a tag (m)."""
    angle: float = 1.0
    """Maximum viewing angle from a tag's normal (rad)."""
    margin: float = 0.15
    family: TagFamily = "36h11"

    @classmethod
    def of(cls, jpeg: bytes, lens: LensConfig, config: Any) -> Self:
        """Return the task for an image by a ``PointsConfig``."""
        return cls(
            jpeg, lens, config.size, dict(config.sizes), config.reach, config.angle, config.margin, config.family
        )


@dataclass(frozen=True, slots=True)
class TagReading:
    """A tag's pose from one image, in the camera's axes: right, down, ahead."""

    tag: int
    middle: Triple
    """Centre (m)."""
    normal: Triple
    """Unit vector out of the tag's front."""
    other_normal: Triple
    """Normal of the second pose that fits the outline as well."""
    doubt: float
    """Fit of the second pose, from 0 (does not fit) to 1 (fits equally well: the heading is ambiguous)."""
    pixels: float
    """Mean side of the black square (pixels)."""
    margin: float
    """Contrast of the worst cell."""
    angle: float
    """Angle from the tag's normal to the camera (rad)."""
    spread: tuple[float, ...]
    """Covariance of centre and normal from the corners alone, row-major (6, 6)."""
    picture: bytes = b""
    """JPEG of the tag and its surroundings."""


@dataclass(frozen=True, slots=True)
class ReadAnswer:
    """Result of reading an image."""

    readings: tuple[TagReading, ...] = ()
    unreadable: bool = False
    """Whether the data are not an image."""


def tag_pose(reading: TagReading, mount: Mount) -> TagPose:
    """Return the pose of a tag in base, for a camera at ``mount``.

    The covariance comes from the noise of the corners in the image. If the second pose of the square fits as well, half
    the difference in yaw is added as a standard deviation: the choice between the two poses is uncertain.
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
