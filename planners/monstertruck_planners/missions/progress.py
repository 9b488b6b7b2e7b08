"""Progress of a mission and the transition after each step, as pure functions."""

import math
from dataclasses import dataclass, replace
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from monstertruck_kinematics.se2 import Pose2
from monstertruck_schemas.base import Pose2D, Schema
from monstertruck_schemas.mission import (
    AnyStep,
    BehaviourStepOfMission,
    ExploreStep,
    FollowWallStep,
    GoToStep,
    LookStep,
    Mission,
    PointStep,
    RecordStep,
    ReturnStep,
    WaitStep,
)
from monstertruck_schemas.reasons import Reason

FINAL = frozenset({Reason.CANCELLED, Reason.DISARMED, Reason.ESTOPPED, Reason.SHUTDOWN})
"""Step outcomes that override the failure policy: a client or the gate has ended the mission."""
GOOD = frozenset(
    {
        Reason.OK,
        Reason.GOAL_REACHED,
        Reason.BEHAVIOUR_DONE,
        Reason.EXPLORED,
        Reason.BUDGET_SPENT,
        Reason.POINTS_FOUND,
        Reason.MISSION_DONE,
    }
)
"""Outcomes of a successful step."""

Next = Literal["step", "again", "return", "done", "ended"]


@dataclass(frozen=True, slots=True)
class StepEnd:
    """Outcome of a step."""

    reason: Reason
    text: str = ""


@dataclass(frozen=True, slots=True)
class MissionProgress:
    """A mission and its progress."""

    mission: Mission
    start: Pose2
    """Start pose in the map frame."""
    index: int = 0
    """Index of the current step."""
    attempt: int = 0
    """Number of failed attempts at the current step."""
    failures: int = 0
    why: StepEnd = StepEnd(Reason.OK)
    """Last failure."""
    returning: bool = False
    """Whether the robot is driving back to the start, where the mission ends."""

    @property
    def step(self) -> AnyStep:
        """Current step."""
        return self.mission.steps[self.index]

    @property
    def doing(self) -> str:
        """Short description of the current action."""
        return "return" if self.returning else in_words(self.step)


def after(progress: MissionProgress, end: StepEnd) -> tuple[MissionProgress, Next]:
    """Advance the mission at the end of the current step or of the drive back.

    Returns:
        The new progress and the next action: the (new) current step, a retry, the drive back,
        the end after all steps, or an early end.
    """
    if progress.returning:
        return replace(progress, why=_returned(progress.why, end)), "ended"
    if end.reason in FINAL:
        return replace(progress, why=end, failures=progress.failures + 1), "ended"
    if end.reason in GOOD:
        return _onward(progress)
    if progress.attempt < progress.step.retries:
        return replace(progress, attempt=progress.attempt + 1), "again"
    failed = replace(progress, failures=progress.failures + 1, why=end)
    match progress.step.on_failure or progress.mission.on_failure:
        case "continue":
            return _onward(failed)
        case "return":
            return replace(failed, returning=True, attempt=0), "return"
        case "abort":
            return failed, "ended"


def _returned(why: StepEnd, end: StepEnd) -> StepEnd:
    """Return the outcome of a mission whose step failed with ``why`` and whose drive back ended with ``end``."""
    failed = why.text or why.reason.text
    if end.reason in GOOD:
        return StepEnd(why.reason, f"{failed}, back where it began")
    return StepEnd(end.reason, f"{failed}; not back where it began: {end.text or end.reason.text}")


def _onward(progress: MissionProgress) -> tuple[MissionProgress, Next]:
    if progress.index + 1 == len(progress.mission.steps):
        return progress, "done"
    return replace(progress, index=progress.index + 1, attempt=0), "step"


def outcome(progress: MissionProgress, following: Next) -> StepEnd:
    """Return the outcome of the whole mission."""
    count = len(progress.mission.steps)
    if following == "done":
        if progress.failures == 0:
            return StepEnd(Reason.MISSION_DONE, f"{count} steps")
        return StepEnd(Reason.MISSION_INCOMPLETE, f"{progress.failures} of {count} steps failed; {progress.why.text}")
    at = f"step {progress.index + 1} of {count} ({in_words(progress.step)})"
    return StepEnd(progress.why.reason, f"{at}: {progress.why.text or progress.why.reason.text}")


def in_words(step: AnyStep) -> str:
    """Describe a step in one line: all its fields except retries, policy and limit."""
    match step:
        case GoToStep(x=x, y=y, yaw=yaw, via=via):
            return " ".join((f"goto {x:g} {y:g} {yaw:g}", *(f"via {a:g},{b:g}" for a, b in via)))
        case LookStep(x=x, y=y):
            return f"look at {x:g} {y:g}"
        case PointStep(point=point, distance=distance):
            return f"goto_point {point}, {distance:g} m before a tag"
        case WaitStep(seconds=seconds):
            return f"wait {seconds:g} s"
        case ExploreStep(budget=budget, home=home, find=find):
            words = "explore"
            words += "" if budget is None else f" for {budget:g} s"
            words += "" if find is None else f" until it knows {find} tags"
            return f"{words} and home" if home else words
        case BehaviourStepOfMission(name=name, settings=settings):
            return " ".join((f"behaviour {name}", *(f"{key}={value}" for key, value in settings.items())))
        case FollowWallStep(name=name, distance=distance):
            return f"follow_wall {name} for {distance:g} m"
        case RecordStep(note=note):
            return f"record: {note}"
        case ReturnStep():
            return "return"


class SavedProgress(Schema):
    """Running mission as stored on disk, for resuming after a restart of the daemon."""

    mission: Mission
    source: str
    start: Pose2D
    index: Annotated[int, Field(ge=0)]
    failures: Annotated[int, Field(ge=0)]
    at: Pose2D | None = None
    """Last pose of the robot in the map frame"""
    why: Reason = Reason.OK
    """Last failure"""
    text: str = ""
    """Description of the last failure"""
    returning: bool = False
    """Whether the robot was driving back to the start of the mission"""

    @model_validator(mode="after")
    def _at_a_step(self) -> Self:
        if self.index >= len(self.mission.steps):
            raise ValueError(f"index {self.index}: expected one of {len(self.mission.steps)} steps, from 0")
        return self

    @classmethod
    def of(cls, progress: MissionProgress, source: str, at: Pose2 | None = None) -> "SavedProgress":
        """Return the stored form of a mission."""
        x, y, yaw = progress.start
        return cls(
            mission=progress.mission,
            source=source,
            start=Pose2D(x=x, y=y, yaw=yaw),
            index=progress.index,
            failures=progress.failures,
            at=None if at is None else Pose2D(x=at[0], y=at[1], yaw=at[2]),
            why=progress.why.reason,
            text=progress.why.text,
            returning=progress.returning,
        )

    def progress(self) -> MissionProgress:
        """Return the mission at the beginning of the interrupted step, or of the interrupted drive back."""
        start, why = (self.start.x, self.start.y, self.start.yaw), StepEnd(self.why, self.text)
        return MissionProgress(
            self.mission, start, self.index, failures=self.failures, why=why, returning=self.returning
        )

    def away(self, pose: Pose2) -> float:
        """Distance from the last pose of the robot to a pose (m)."""
        return 0.0 if self.at is None else math.dist(pose[:2], (self.at.x, self.at.y))
