"""Settings of the points of interest; light, for the daemon's start."""

from math import radians
from typing import Annotated

from pydantic import Field

from monstertruck_schemas.base import Positive, Schema
from monstertruck_schemas.board import TagFamily

Size = Annotated[float, Field(gt=0.005, le=2)]


class PointsConfig(Schema):
    """Tag detection in the camera's images; the camera's device has the settings of lens and mount."""

    family: TagFamily = "36h11"
    """Tag family: AprilTag, or an ArUco dictionary"""
    size: Size = 0.1
    """Side of the tags' black square (m)"""
    sizes: dict[Annotated[int, Field(ge=0, le=1023)], Size] = Field(default_factory=dict)
    """Sizes of other tags by number (m)"""
    rate: Annotated[float, Field(gt=0, le=30)] = 5.0
    """Maximum rate of processed images (1/s); a standing robot reads two images per place"""
    reach: Positive = 2.0
    """Maximum distance of a tag (m): at 3 m a tag of 10 cm has 2 pixels per cell"""
    angle: Annotated[float, Field(gt=0, lt=1.57)] = radians(60.0)
    """Maximum viewing angle from a tag's normal (rad)"""
    margin: Annotated[float, Field(ge=0, lt=1)] = 0.15
    """Minimum contrast of every cell of a tag, as a share of the difference from grey to its colour"""
    sightings: Annotated[int, Field(ge=1, le=20)] = 2
    """Minimum number of images that agree before a tag is an object of the map"""
    agree: Positive = 0.15
    """Maximum distance between the places in these images (m); more if they are less certain"""
    tilt: Annotated[float, Field(gt=0, le=0.5)] = 0.1
    """Maximum tilt of the robot for images that are used (rad)"""
    most: Annotated[int, Field(ge=1, le=2000)] = 500
    """Points of interest"""
    latency: Annotated[float, Field(gt=0, le=1)] = 0.06
    """Latency of an image reading on the virtual clock (s)"""
    deadline: Annotated[float, Field(gt=0, le=60)] = 10.0
    """Maximum silence of the worker before it is killed (s)"""
