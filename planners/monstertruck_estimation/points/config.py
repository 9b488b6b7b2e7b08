"""Settings of the points of interest; light, for the daemon's start."""

from math import radians
from typing import Annotated

from pydantic import Field

from monstertruck_schemas.base import Positive, Schema
from monstertruck_schemas.board import TagFamily

Size = Annotated[float, Field(gt=0.005, le=2)]


class PointsConfig(Schema):
    """What is taken for a tag in the camera's pictures; the camera's lens and mount are its device's."""

    family: TagFamily = "36h11"
    """Family of the tags: of AprilTag, or a dictionary of ArUco"""
    size: Size = 0.1
    """Side of the tags' black square, m"""
    sizes: dict[Annotated[int, Field(ge=0, le=1023)], Size] = Field(default_factory=dict)
    """Sizes of other tags by number, m"""
    rate: Annotated[float, Field(gt=0, le=30)] = 5.0
    """Pictures read a second, at most; of a robot that stands two at a place"""
    reach: Positive = 2.0
    """Tags farther away are not used, m: at 3 m a tag of 10 cm has 2 pixels a cell"""
    angle: Annotated[float, Field(gt=0, lt=1.57)] = radians(60.0)
    """Nor are those seen more obliquely, from their normal, rad"""
    margin: Annotated[float, Field(ge=0, lt=1)] = 0.15
    """Least contrast of every cell, as a share of the difference from grey to its colour; less is no tag"""
    sightings: Annotated[int, Field(ge=1, le=20)] = 2
    """Pictures that have to agree before a tag is an object of the map"""
    agree: Positive = 0.15
    """How near to each other they have to put it, m; more where they are less certain"""
    tilt: Annotated[float, Field(gt=0, le=0.5)] = 0.1
    """Pictures taken while the robot was tilted more than this are not used, rad"""
    most: Annotated[int, Field(ge=1, le=2000)] = 500
    """Points of interest"""
    latency: Annotated[float, Field(gt=0, le=1)] = 0.06
    """Seconds after which a picture that was read counts on the virtual clock"""
    deadline: Annotated[float, Field(gt=0, le=60)] = 10.0
    """Seconds after which a silent worker is killed"""
