"""Missions: steps that a robot does one after the other."""

from typing import Annotated, Literal

from pydantic import Field

from monstertruck_schemas.base import Name, Schema

Coordinate = Annotated[float, Field(ge=-10_000, le=10_000)]
Seconds = Annotated[float, Field(gt=0, le=86_400)]

Policy = Literal["abort", "continue", "return"]
"""After a step that failed: end the mission; continue with the next step; drive back to where it began, and end."""


class MissionStep(Schema):
    """What all steps have; each adds its ``do``."""

    do: str
    retries: Annotated[int, Field(ge=0, le=20)] = 0
    """How often it is tried again before it has failed"""
    on_failure: Policy | None = None
    """What follows then; null = as the mission says"""
    limit: Seconds | None = None
    """Seconds after which it has failed; null = none but its own"""


class GoToStep(MissionStep):
    """Drive to a pose."""

    do: Literal["goto"]
    x: Coordinate
    """In map, m"""
    y: Coordinate
    """In m"""
    yaw: Coordinate
    """In rad"""
    via: Annotated[tuple[tuple[Coordinate, Coordinate], ...], Field(max_length=32, strict=False)] = ()
    """Places x, y to pass before"""


class PointStep(MissionStep):
    """Drive before a tag that the camera found, or to a place that was marked."""

    do: Literal["goto_point"]
    point: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,31}$")]
    """Name of the point of interest"""
    distance: Annotated[float, Field(ge=0, le=5)] = 0.7
    """Metres before a tag"""


class LookStep(MissionStep):
    """Turn towards a place, where the robot stands."""

    do: Literal["look"]
    x: Coordinate
    """In map, m"""
    y: Coordinate
    """In m"""


class WaitStep(MissionStep):
    """Stand."""

    do: Literal["wait"]
    seconds: Seconds


class ExploreStep(MissionStep):
    """Explore what the map does not know."""

    do: Literal["explore"]
    budget: Seconds | None = None
    """Seconds after which it ends; null = as the robot is configured"""
    home: bool = False
    """Drive back to where the exploration began"""
    find: Annotated[int, Field(ge=1, le=10_000)] | None = None
    """Look for tags on walls, too, and end when the map has so many"""


class BehaviourStepOfMission(MissionStep):
    """Run a behaviour to its own end."""

    do: Literal["behaviour"]
    name: Name
    """Name of the behaviour in the robot's configuration"""
    settings: Annotated[dict[str, float | str | bool], Field(max_length=32)] = Field(default_factory=dict)
    """Settings that replace the configured ones"""


class FollowWallStep(MissionStep):
    """Run a behaviour that follows a wall, for some metres."""

    do: Literal["follow_wall"]
    name: Name
    """Of the behaviour in the robot's configuration"""
    distance: Annotated[float, Field(gt=0, le=10_000)]
    """In m"""


class RecordStep(MissionStep):
    """Leave a note in the log."""

    do: Literal["record"]
    note: Annotated[str, Field(min_length=1, max_length=200)]


class ReturnStep(MissionStep):
    """Drive back to where the mission began."""

    do: Literal["return"]


AnyStep = Annotated[
    GoToStep
    | PointStep
    | LookStep
    | WaitStep
    | ExploreStep
    | BehaviourStepOfMission
    | FollowWallStep
    | RecordStep
    | ReturnStep,
    Field(discriminator="do"),
]


class Mission(Schema):
    """A list of steps."""

    version: Literal[2]
    name: Name
    on_failure: Policy = "abort"
    """What follows a step that failed"""
    steps: Annotated[tuple[AnyStep, ...], Field(min_length=1, max_length=500, strict=False)]
