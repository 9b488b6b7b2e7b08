"""Settings of exploration, one class for each ``kind``. Loads no planner."""

from math import radians
from typing import Annotated, Literal

from pydantic import Field

from monstertruck_schemas.base import NotNegative, Positive, Schema


class ExplorerConfig(Schema):
    """Settings shared by all kinds of exploration."""

    kind: str
    home: bool = True
    """Drive back to the start at the end"""
    budget: Positive = 1800.0
    """Maximum duration of exploring (s), without the drive home"""
    reach: Positive = 5.6
    """Usable range of the lidar (m)"""
    view: Annotated[float, Field(gt=0, le=6.2831853072)] = radians(240.0)
    """Angle of view of the sensor (rad)"""
    smallest: Positive = 0.3
    """Minimum length of a frontier (m)"""
    rate: Annotated[float, Field(gt=0, le=5)] = 1.0
    """Decisions per second"""
    blacklist: Positive = 60.0
    """Time on the blacklist of a place that could not be reached or showed nothing new (s)"""
    attempts: Annotated[int, Field(ge=1)] = 3
    """Number of attempts at a place before it is skipped permanently"""
    lost: Positive = 60.0
    """Time without localisation until the exploration ends (s)"""
    around: bool = True
    """Drive half a metre back and forth while lost, since a standing robot sees nothing new"""
    reserve: Annotated[float, Field(ge=1)] = 1.5
    """Factor on the charge for the path home; below this charge the robot drives home"""
    full_range: Positive = 2000.0
    """Range of a full battery until it has been measured (m)"""
    latency: Positive = 0.2
    """Latency of a decision on the virtual clock (s)"""
    deadline: Positive = 20.0
    """Timeout of a silent worker (s), which is then killed"""


class NearestConfig(ExplorerConfig):
    """Nearest frontier."""

    kind: Literal["nearest"] = "nearest"


class AuthorConfig(ExplorerConfig):
    """The thesis author's frontier scores (pandora_explorer), with his weights.

    The score is size (1 - exp(-e n / n_max)) + distance exp(-e l / l_max) + angle cos(turn / 2) + visits exp(-times
    chosen). His program read the visits weight into the angle weight and left the visits weight undefined; here each
    weight is used.
    """

    kind: Literal["author"] = "author"
    size_weight: NotNegative = 0.15
    """Weight of the frontier's size."""
    distance_weight: NotNegative = 0.45
    """Weight of the distance."""
    angle_weight: NotNegative = 0.5
    """Weight of the turn towards the frontier."""
    visits_weight: NotNegative = 0.3
    """Weight of the number of times that the frontier was chosen."""
    near: Positive = 0.2
    """Maximum distance between places treated as one (m)."""
    patience: Positive = 30.0
    """Maximum time for a goal (s)."""


class InformationConfig(ExplorerConfig):
    """Maximum new area per second of driving."""

    kind: Literal["information"] = "information"
    depth: Positive = 1.5
    """Assumed depth of unknown ground behind a frontier (m)"""
    speed: Positive = 0.2
    """Driving speed (m/s)"""
    turning: NotNegative = 4.0
    """Cost of half a turn at the start (s)"""
    better: Annotated[float, Field(ge=1)] = 4.0
    """Minimum ratio of area per second of another frontier to the current one, for replacing it"""
