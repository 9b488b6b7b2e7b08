"""Missions: steps that a robot executes in sequence, including steps that contain or choose others.

Steps that contain others, and conditions, are named after the nodes of behaviour trees (BehaviorTree.CPP, py_trees).
"""

from typing import Annotated, Final, Literal, Self

from pydantic import Field, model_validator

from monstertruck_schemas.base import Name, Schema

Coordinate = Annotated[float, Field(ge=-10_000, le=10_000)]
Seconds = Annotated[float, Field(gt=0, le=86_400)]

Policy = Literal["abort", "continue", "return"]
"""Reaction to a failed step: fail the containing step, or end the mission; continue with the next step; drive back to
the start of the mission, and end.
"""


DAY_TIME: Final = r"([01]\d|2[0-3]):[0-5]\d"
PointName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,31}$")]
Percent = Annotated[float, Field(ge=0, le=100)]

MOST_STEPS: Final = 500
"""Maximum number of steps of a mission, including nested ones."""
DEEPEST: Final = 8
"""Maximum depth of nested steps."""


class Condition(Schema):
    """A condition on the robot's state; true if all its keys are fulfilled. An unknown value is not fulfilled."""

    battery_below: Percent | None = None
    """Charge of the battery below this value, %"""
    battery_above: Percent | None = None
    """Charge of the battery above this value, %"""
    after: Seconds | None = None
    """Time since the mission was started or resumed, s"""
    point: PointName | None = None
    """Whether a point of interest of this name is known"""
    tags: Annotated[int, Field(ge=1, le=10_000)] | None = None
    """Minimum number of known tags"""
    obstacle: Seconds | None = None
    """Minimum duration of a stop by an obstacle, s"""
    zone: Name | None = None
    """Name of a zone that the robot's footprint overlaps"""
    time: Annotated[str, Field(pattern=rf"^{DAY_TIME}-{DAY_TIME}$")] | None = None
    """Interval of the time of day (local, of the robot's computer), as 22:00-06:30"""
    any_of: Annotated[tuple["Condition", ...], Field(min_length=1, max_length=16, strict=False)] | None = None
    """Conditions; at least one must be fulfilled"""
    unless: "Condition | None" = None
    """Condition that is not fulfilled"""

    @model_validator(mode="after")
    def _says_something(self) -> Self:
        if all(value is None for value in self.__dict__.values()):
            raise ValueError(f"an empty condition: expected one of {', '.join(type(self).model_fields)}")
        return self


class MissionStep(Schema):
    """Common keys of all steps; each adds its ``do``."""

    do: str
    retries: Annotated[int, Field(ge=0, le=20)] = 0
    """Number of retries after a failure"""
    on_failure: Policy | None = None
    """Reaction to the failure; null: the reaction of the mission, or abort within another step"""
    limit: Seconds | None = None
    """Timeout of an attempt, s; null: only the step's own"""


class GoToStep(MissionStep):
    """Drive to a pose."""

    do: Literal["goto"]
    x: Coordinate
    """Position x in map, m"""
    y: Coordinate
    """Position y in map, m"""
    yaw: Coordinate
    """Heading in map, rad"""
    via: Annotated[tuple[tuple[Coordinate, Coordinate], ...], Field(max_length=32, strict=False)] = ()
    """Waypoints x, y before it"""


class PointStep(MissionStep):
    """Drive in front of a tag that the camera found, or to a marked place."""

    do: Literal["goto_point"]
    point: PointName
    """Name of the point of interest"""
    distance: Annotated[float, Field(ge=0, le=5)] = 0.7
    """Distance in front of a tag, m"""


class LookStep(MissionStep):
    """Turn on the spot towards a place."""

    do: Literal["look"]
    x: Coordinate
    """Position x in map, m"""
    y: Coordinate
    """Position y in map, m"""


class WaitStep(MissionStep):
    """Stand still."""

    do: Literal["wait"]
    seconds: Seconds


class ExploreStep(MissionStep):
    """Explore unknown parts of the map."""

    do: Literal["explore"]
    budget: Seconds | None = None
    """Time budget (s); null for the robot's setting"""
    home: bool = False
    """Drive back to the start of the exploration"""
    find: Annotated[int, Field(ge=1, le=10_000)] | None = None
    """Also search for tags on walls, and end when the map has this many"""


class BehaviourStepOfMission(MissionStep):
    """Run a behaviour to its own end."""

    do: Literal["behaviour"]
    name: Name
    """Name of the behaviour in the robot's configuration"""
    settings: Annotated[dict[str, float | str | bool], Field(max_length=32)] = Field(default_factory=dict)
    """Settings that replace the configured ones"""


class FollowWallStep(MissionStep):
    """Run a behaviour that follows a wall, for a distance."""

    do: Literal["follow_wall"]
    name: Name
    """Name of the behaviour in the robot's configuration"""
    distance: Annotated[float, Field(gt=0, le=10_000)]
    """Distance, m"""


class DockStep(MissionStep):
    """Drive to the staging pose of a dock, dock, and wait until the battery is charged."""

    do: Literal["dock"]
    dock: Name | None = None
    """Name of the dock in the robot's configuration; null: the only dock"""


class UndockStep(MissionStep):
    """Leave a dock and return to its staging pose."""

    do: Literal["undock"]
    dock: Name | None = None
    """Name of the dock; null: the only dock"""


class RecordStep(MissionStep):
    """Write a note to the log."""

    do: Literal["record"]
    note: Annotated[str, Field(min_length=1, max_length=200)]


class ReturnStep(MissionStep):
    """Drive back to the start of the mission."""

    do: Literal["return"]


class ConditionStep(MissionStep):
    """Succeed if a condition is fulfilled, otherwise fail."""

    do: Literal["condition"]
    when: Condition


class WaitUntilStep(MissionStep):
    """Stand still until a condition is fulfilled."""

    do: Literal["wait_until"]
    when: Condition


class SequenceOfSteps(MissionStep):
    """Execute steps in sequence; fails with the first failed step."""

    do: Literal["sequence"]
    steps: "Steps"


class FallbackStep(MissionStep):
    """Execute steps until one succeeds; fails if all fail."""

    do: Literal["fallback"]
    steps: "Steps"


class RepeatStep(MissionStep):
    """Repeat a sequence of steps."""

    do: Literal["repeat"]
    steps: "Steps"
    times: Annotated[int, Field(ge=1, le=1_000_000)] | Literal["forever"] | None = None
    """Number of rounds; forever = until the mission is stopped, a watch fires or a step fails"""
    until: Condition | None = None
    """Condition checked after every round that ends it; fails if unfulfilled after `times` rounds"""

    @model_validator(mode="after")
    def _ends(self) -> Self:
        if self.times is None and self.until is None:
            raise ValueError("a loop without exit: expected times or until (times: forever if it is meant)")
        return self


class BranchStep(MissionStep):
    """Execute one of two sequences of steps."""

    do: Literal["branch"]
    when: Condition
    then: "Steps"
    """Steps if the condition is fulfilled"""
    otherwise: Annotated[tuple["AnyStep", ...], Field(max_length=MOST_STEPS, strict=False)] = ()
    """Steps otherwise"""


class MissionWatch(Schema):
    """Interruption of a parallel step as soon as a condition is fulfilled."""

    when: Condition
    then: "Steps"
    """Steps of the interruption"""
    after: Literal["resume", "end"] = "resume"
    """Afterwards: restart the interrupted step, or end the parallel step successfully"""


class ParallelStep(MissionStep):
    """Execute steps in sequence while watching conditions."""

    do: Literal["parallel"]
    steps: "Steps"
    watch: Annotated[tuple[MissionWatch, ...], Field(min_length=1, max_length=16, strict=False)]
    """Watched conditions; the first has the highest priority"""


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
    """Return the sequences of steps within a node, each with its parent keys."""
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
