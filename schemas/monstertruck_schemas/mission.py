"""Missions: steps that a robot executes in sequence, and steps that choose among others.

Steps that contain others, and conditions, have the names of the nodes of behaviour trees (BehaviorTree.CPP, py_trees).
"""

from typing import Annotated, Final, Literal, Self

from pydantic import Field, model_validator

from monstertruck_schemas.base import Name, Schema

Coordinate = Annotated[float, Field(ge=-10_000, le=10_000)]
Seconds = Annotated[float, Field(gt=0, le=86_400)]

Policy = Literal["abort", "continue", "return"]
"""After a step that failed: fail the step that contains it, or end the mission; continue with the next step; drive back
to where the mission began, and end."""


DAY_TIME: Final = r"([01]\d|2[0-3]):[0-5]\d"
PointName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,31}$")]
Percent = Annotated[float, Field(ge=0, le=100)]

MOST_STEPS: Final = 500
"""Maximum number of steps of a mission, nested ones included."""
DEEPEST: Final = 8
"""Maximum depth of nested steps."""


class Condition(Schema):
    """A state of the robot; it holds if all its keys do. An unknown value does not hold."""

    battery_below: Percent | None = None
    """Charge of the battery below this value, %"""
    battery_above: Percent | None = None
    """Charge of the battery above this value, %"""
    after: Seconds | None = None
    """Time since the mission was started or resumed, s"""
    point: PointName | None = None
    """A point of interest of this name is known"""
    tags: Annotated[int, Field(ge=1, le=10_000)] | None = None
    """Minimum number of known tags"""
    obstacle: Seconds | None = None
    """An obstacle has stopped the robot for this time, s"""
    zone: Name | None = None
    """The robot's footprint reaches into the zone of this name"""
    time: Annotated[str, Field(pattern=rf"^{DAY_TIME}-{DAY_TIME}$")] | None = None
    """The time of day (local, of the robot's computer) lies in this interval, as 22:00-06:30"""
    any_of: Annotated[tuple["Condition", ...], Field(min_length=1, max_length=16, strict=False)] | None = None
    """At least one of these conditions holds"""
    unless: "Condition | None" = None
    """This condition does not hold"""

    @model_validator(mode="after")
    def _says_something(self) -> Self:
        if all(value is None for value in self.__dict__.values()):
            raise ValueError(f"an empty condition: expected one of {', '.join(type(self).model_fields)}")
        return self


class MissionStep(Schema):
    """Common keys of all steps; each adds its ``do``."""

    do: str
    retries: Annotated[int, Field(ge=0, le=20)] = 0
    """How often it is tried again before it has failed"""
    on_failure: Policy | None = None
    """Reaction to the failure; null: the reaction of the mission, or abort within another step"""
    limit: Seconds | None = None
    """Timeout of an attempt, s; null: only the step's own"""


class GoToStep(MissionStep):
    """Drive to a pose."""

    do: Literal["goto"]
    x: Coordinate
    """Place in map, m"""
    y: Coordinate
    """In m"""
    yaw: Coordinate
    """In rad"""
    via: Annotated[tuple[tuple[Coordinate, Coordinate], ...], Field(max_length=32, strict=False)] = ()
    """Places x, y to pass before"""


class PointStep(MissionStep):
    """Drive before a tag that the camera found, or to a place that was marked."""

    do: Literal["goto_point"]
    point: PointName
    """Name of the point of interest"""
    distance: Annotated[float, Field(ge=0, le=5)] = 0.7
    """Metres before a tag"""


class LookStep(MissionStep):
    """Turn towards a place, where the robot stands."""

    do: Literal["look"]
    x: Coordinate
    """Place in map, m"""
    y: Coordinate
    """In m"""


class WaitStep(MissionStep):
    """Stand."""

    do: Literal["wait"]
    seconds: Seconds


class ExploreStep(MissionStep):
    """Explore unknown parts of the map."""

    do: Literal["explore"]
    budget: Seconds | None = None
    """Time budget (s); null for the robot's setting"""
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
    """Name of the behaviour in the robot's configuration"""
    distance: Annotated[float, Field(gt=0, le=10_000)]
    """In m"""


class DockStep(MissionStep):
    """Drive to the staging pose of a dock, dock, and wait until the battery is charged."""

    do: Literal["dock"]
    dock: Name | None = None
    """Name of the dock in the robot's configuration; null if there is one only"""


class UndockStep(MissionStep):
    """Leave a dock, back to its staging pose."""

    do: Literal["undock"]
    dock: Name | None = None
    """Name of the dock; null if there is one only"""


class RecordStep(MissionStep):
    """Leave a note in the log."""

    do: Literal["record"]
    note: Annotated[str, Field(min_length=1, max_length=200)]


class ReturnStep(MissionStep):
    """Drive back to where the mission began."""

    do: Literal["return"]


class ConditionStep(MissionStep):
    """Succeed if a condition holds, else fail."""

    do: Literal["condition"]
    when: Condition


class WaitUntilStep(MissionStep):
    """Stand until a condition holds."""

    do: Literal["wait_until"]
    when: Condition


class SequenceOfSteps(MissionStep):
    """Do steps in sequence; fails with the first that fails."""

    do: Literal["sequence"]
    steps: "Steps"


class FallbackStep(MissionStep):
    """Do steps until one succeeds; fails if all fail."""

    do: Literal["fallback"]
    steps: "Steps"


class RepeatStep(MissionStep):
    """Repeat a sequence of steps."""

    do: Literal["repeat"]
    steps: "Steps"
    times: Annotated[int, Field(ge=1, le=1_000_000)] | Literal["forever"] | None = None
    """Number of rounds; forever = until the mission is stopped, a watch fires or a step fails"""
    until: Condition | None = None
    """Condition that ends it after a round; fails if it does not hold after `times` rounds"""

    @model_validator(mode="after")
    def _ends(self) -> Self:
        if self.times is None and self.until is None:
            raise ValueError("a loop without exit: expected times or until (times: forever if it is meant)")
        return self


class BranchStep(MissionStep):
    """Do one of two sequences of steps."""

    do: Literal["branch"]
    when: Condition
    then: "Steps"
    """Steps if the condition holds"""
    otherwise: Annotated[tuple["AnyStep", ...], Field(max_length=MOST_STEPS, strict=False)] = ()
    """Steps if it does not"""


class MissionWatch(Schema):
    """Interruption of a parallel step as soon as a condition holds."""

    when: Condition
    then: "Steps"
    """Steps of the interruption"""
    after: Literal["resume", "end"] = "resume"
    """Afterwards: begin the interrupted step again, or end the parallel step as done"""


class ParallelStep(MissionStep):
    """Do steps in sequence while watching conditions."""

    do: Literal["parallel"]
    steps: "Steps"
    watch: Annotated[tuple[MissionWatch, ...], Field(min_length=1, max_length=16, strict=False)]
    """Watched conditions; the first has priority"""


AnyStep = Annotated[
    GoToStep
    | PointStep
    | LookStep
    | WaitStep
    | ExploreStep
    | BehaviourStepOfMission
    | FollowWallStep
    | DockStep
    | UndockStep
    | RecordStep
    | ReturnStep
    | ConditionStep
    | WaitUntilStep
    | SequenceOfSteps
    | FallbackStep
    | RepeatStep
    | BranchStep
    | ParallelStep,
    Field(discriminator="do"),
]


Steps = Annotated[tuple[AnyStep, ...], Field(min_length=1, max_length=MOST_STEPS, strict=False)]


class Mission(Schema):
    """A sequence of steps."""

    version: Literal[2]
    name: Name
    on_failure: Policy = "abort"
    """Reaction to a failed step that is not within another step"""
    steps: Steps

    @model_validator(mode="after")
    def _bounded(self) -> Self:
        if (deep := max(map(_depth, self.steps))) > DEEPEST:
            raise ValueError(f"steps: nested {deep} deep, expected at most {DEEPEST}")
        if (count := sum(map(_count, self.steps))) > MOST_STEPS:
            raise ValueError(f"steps: {count} with those within others, expected at most {MOST_STEPS}")
        return self


def blocks(node: "Mission | AnyStep") -> tuple[tuple[tuple[str | int, ...], tuple[AnyStep, ...]], ...]:
    """Return the sequences of steps within a node, each with the keys that lead to it."""
    match node:
        case BranchStep():
            return (("then",), node.then), (("otherwise",), node.otherwise)
        case ParallelStep():
            watched = ((("watch", index, "then"), watch.then) for index, watch in enumerate(node.watch))
            return (("steps",), node.steps), *watched
        case Mission() | SequenceOfSteps() | FallbackStep() | RepeatStep():
            return ((("steps",), node.steps),)
        case _:
            return ()


def _depth(step: AnyStep) -> int:
    return 1 + max((_depth(inner) for _, block in blocks(step) for inner in block), default=0)


def _count(step: AnyStep) -> int:
    return 1 + sum(_count(inner) for _, block in blocks(step) for inner in block)
