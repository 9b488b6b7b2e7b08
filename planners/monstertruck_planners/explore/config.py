"""Settings of exploration: one ``kind`` each; light, no planner is loaded."""

from math import radians
from typing import Annotated, Literal

from pydantic import Field

from monstertruck_schemas.base import NotNegative, Positive, Schema


class ExplorerConfig(Schema):
    """Shared by all kinds of exploration."""

    kind: str
    home: bool = True
    """Drive back to the start at the end"""
    budget: Positive = 1800.0
    """Seconds of exploring, after which it ends (by way of the start, if it drives home)"""
    reach: Positive = 5.6
    """Range of the lidar that is counted on, m"""
    view: Annotated[float, Field(gt=0, le=6.2831853072)] = radians(240.0)
    """Angle of view of the sensor, rad"""
    smallest: Positive = 0.3
    """Shorter frontiers are passed over, m"""
    rate: Annotated[float, Field(gt=0, le=5)] = 1.0
    """Decisions a second"""
    blacklist: Positive = 60.0
    """Seconds for which a place is skipped that could not be reached, or from which nothing new was seen"""
    attempts: Annotated[int, Field(ge=1)] = 3
    """How often a place is tried before it is given up for good"""
    lost: Positive = 60.0
    """Seconds without a place in the map after which it ends"""
    around: bool = True
    """Meanwhile it drives half a metre to and fro, for who stands still sees nothing new"""
    reserve: Annotated[float, Field(ge=1)] = 1.5
    """The robot drives home when the charge falls below the charge for the path home times this"""
    full_range: Positive = 2000.0
    """Metres that a full battery drives, until that has been measured"""
    latency: Positive = 0.2
    """Seconds a decision takes on the virtual clock"""
    deadline: Positive = 20.0
    """Seconds after which a silent worker is killed"""


class NearestConfig(ExplorerConfig):
    """The nearest frontier."""

    kind: Literal["nearest"] = "nearest"


class AuthorConfig(ExplorerConfig):
    """The thesis author's frontier scores (pandora_explorer), with his weights.

    The score is size (1 - exp(-e n / n_max)) + distance exp(-e l / l_max) + angle cos(turn / 2) + visits exp(-times
    chosen); his program read the weight of visits into that of angles and left it undefined itself: here each is used.
    """

    kind: Literal["author"] = "author"
    size_weight: NotNegative = 0.15
    distance_weight: NotNegative = 0.45
    angle_weight: NotNegative = 0.5
    visits_weight: NotNegative = 0.3
    near: Positive = 0.2
    """Places this near to each other are one, m."""
    patience: Positive = 30.0
    """Seconds after which a goal is left."""


class InformationConfig(ExplorerConfig):
    """The most new area per second of driving."""

    kind: Literal["information"] = "information"
    depth: Positive = 1.5
    """Unknown ground is taken to go on for this far behind a frontier, m"""
    speed: Positive = 0.2
    """Driving speed, m/s"""
    turning: NotNegative = 4.0
    """Seconds that half a turn at the start costs"""
    better: Annotated[float, Field(ge=1)] = 4.0
    """How many times as much per second another frontier has to show, to be preferred to the one that is pursued"""


class TourConfig(ExplorerConfig):
    """The path to a frontier against what it shows, and the short tour over the others after it."""

    kind: Literal["tour"] = "tour"
    worth: NotNegative = 1.0
    """Metres driven for a metre of new ground, the square root of the new area"""
    turning: NotNegative = 1.0
    """Metres that half a turn at the start of the tour costs"""
    keep: NotNegative = 3.0
    """Metres by which another tour has to be better than one that begins with the present goal"""
    rest: NotNegative = 0.0
    """Weight of the short tour over the other frontiers, against the path to the first one"""
    most: Annotated[int, Field(ge=3, le=60)] = 16
    """Frontiers of a tour at most, the best ones"""
