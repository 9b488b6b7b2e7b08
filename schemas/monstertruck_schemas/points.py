"""Points of interest: found by the camera in the map, or marked by an operator."""

import math
from enum import StrEnum
from typing import Annotated

from pydantic import Field

from monstertruck_schemas.base import Covariance, Message, Nanoseconds, Pose2D, Schema
from monstertruck_schemas.req import Request

PointName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,31}$")]
Coordinate = Annotated[float, Field(ge=-10_000, le=10_000)]


class PointKind(StrEnum):
    """Origin of a point of interest."""

    TAG = "tag"
    """An AprilTag detected by the camera."""
    MARK = "mark"
    """A mark of an operator."""


class PointOfInterest(Schema):
    """One point of interest, in map."""

    name: PointName
    """Name of the point."""
    kind: PointKind
    """Kind of the point."""
    tag: Annotated[int, Field(ge=0)] | None = None
    """Number of the tag."""
    x: float
    """Position, m; of a tag its centre."""
    y: float
    """m; of a tag its middle."""
    z: float = 0.0
    """Height above the ground, m."""
    yaw: float
    """Yaw, rad; of a tag the direction it faces, of a mark as given."""
    covariance: Covariance
    """Covariance of (x, y, yaw) relative to the surrounding map, shape (9,), row-major: m^2, m rad, rad^2."""
    sightings: Annotated[int, Field(ge=0)] = 0
    """Number of images in which it was detected."""
    size: float | None = None
    """Side of the tag's black square, m."""
    first: Nanoseconds
    """Time of the first detection, or of the mark."""
    last: Nanoseconds
    """Time of the latest detection, or of the mark."""
    picture: bool = False
    """Whether an image exists: remote call ``point_picture``."""

    def before(self, distance: float) -> Pose2D:
        """Viewing pose of a robot: at this distance (m) in front of a tag; for a mark, the mark itself."""
        if self.kind is PointKind.MARK:
            return Pose2D(x=self.x, y=self.y, yaw=self.yaw)
        x, y = self.x + distance * math.cos(self.yaw), self.y + distance * math.sin(self.yaw)
        return Pose2D(x=x, y=y, yaw=math.remainder(self.yaw + math.pi, math.tau))


class TagPose(Schema):
    """Pose of a tag in the ``frame`` of the message."""

    tag: Annotated[int, Field(ge=0)]
    """Number of the tag."""
    x: float
    """Centre (m)."""
    y: float
    """Centre (m)."""
    z: float
    """Height above base (m)."""
    yaw: float
    """Direction it faces (rad)."""
    covariance: Covariance
    """Shape (9,), row-major, of (x, y, yaw): m^2, m rad, rad^2."""


class TagPoses(Message):
    """Tags in one image, in base at the stamp of the image."""

    tags: tuple[TagPose, ...] = ()


class PointsOfInterest(Message):
    """All known points, in the order of discovery."""

    points: tuple[PointOfInterest, ...] = ()


class PointOrder(StrEnum):
    """Operator's change to a point of interest."""

    MARK = "mark"
    REMOVE = "remove"


class PointRequest(Request):
    """Mark a place, or remove a point of interest."""

    order: PointOrder
    name: PointName
    x: Coordinate | None = None
    """Position of a mark in map, m; None: the robot's."""
    y: Coordinate | None = None
    yaw: Coordinate | None = None
    """Yaw (rad); None: the robot's."""
