"""Progress of a mission and the transition after each step, as pure functions.

A mission is a tree: steps, and steps that contain others. The position in it is a stack of frames, one for the mission
and one for each step that contains the current one. The current step itself has no frame: it starts
again after a restart.
"""

import math
from dataclasses import dataclass, replace
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from monstertruck_kinematics.se2 import Pose2
from monstertruck_planners.missions.conditions import UNKNOWN, Facts, holds
from monstertruck_planners.missions.conditions import in_words as condition_in_words
from monstertruck_planners.missions.outline import Container, in_words, prefix
from monstertruck_schemas.base import Pose2D, Schema
from monstertruck_schemas.mission import (
    AnyStep,
    BranchStep,
    Condition,
    ConditionStep,
    FallbackStep,
    Mission,
    ParallelStep,
    RepeatStep,
    blocks,
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

Next = Literal["step", "again", "round", "return", "done", "ended"]


@dataclass(frozen=True, slots=True)
class StepEnd:
    """Outcome of a step."""

    reason: Reason
    text: str = ""

    @property
    def good(self) -> bool:
        """Whether the step succeeded."""
        return self.reason in GOOD


class MissionFrame(Schema):
    """Position in the mission or in a step that contains others; stored for a resume."""

    block: Annotated[int, Field(ge=0)] = 0
    """Index among the node's ``blocks``: for a branch 1 = otherwise, for a parallel step n = watch n"""
    index: Annotated[int, Field(ge=0)] = 0
    """Index of the current step in the block"""
    attempt: Annotated[int, Field(ge=0)] = 0
    """Failed attempts at that step"""
    rounds: Annotated[int, Field(ge=0)] = 0
    """Completed rounds of a repeat"""
    fired: Annotated[tuple[int, ...], Field(strict=False)] = ()
    """Watches (blocks) whose condition has held since they fired"""
    interrupted: Annotated[tuple["MissionFrame", ...], Field(strict=False)] = ()
    """Position of a parallel step when a watch interrupted it: its frame and its inner frames"""
    spent: Annotated[float, Field(ge=0)] = 0.0
    """Seconds spent in the step, excluding pauses"""


@dataclass(frozen=True, slots=True)
class MissionProgress:
    """A mission and its progress."""

    mission: Mission
    start: Pose2
    """Start pose in the map frame."""
    stack: tuple[MissionFrame, ...] = (MissionFrame(),)
    """Frames of the mission and of the steps that contain the current one."""
    failures: int = 0
    why: StepEnd = StepEnd(Reason.OK)
    """Last failure."""
    returning: bool = False
    """Whether the robot is driving back to the start, where the mission ends."""

    @property
    def index(self) -> int:
        """Index of the current step of the mission, not counting those within others."""
        return self.stack[0].index

    @property
    def attempt(self) -> int:
        """Number of failed attempts at the current step."""
        return 0 if self.returning else self.stack[-1].attempt

    @property
    def step(self) -> AnyStep:
        """Current step; a step that contains others only before ``enter``, or if it has no work."""
        *_, node = _nodes(self.mission, self.stack)
        assert not isinstance(node, Mission)
        return node

    @property
    def doing(self) -> str:
        """Short description of the current action."""
        return "return" if self.returning else in_words(self.step)

    @property
    def number(self) -> str:
        """Position of the current step, see ``lines``."""
        nodes = _nodes(self.mission, self.stack)
        return ".".join(_part(node, frame.block, frame.index) for node, frame in zip(nodes, self.stack, strict=False))


def enter(progress: MissionProgress, facts: Facts) -> MissionProgress:
    """Descend to the first step without nested steps, or to a branch without work."""
    while isinstance(step := progress.step, Container):
        frame = MissionFrame(block=int(not holds(step.when, facts))) if isinstance(step, BranchStep) else MissionFrame()
        if not _block(step, frame):
            return progress
        progress = replace(progress, stack=(*progress.stack, frame))
    return progress


def after(
    progress: MissionProgress, end: StepEnd, facts: Facts = UNKNOWN, depth: int | None = None
) -> tuple[MissionProgress, Next]:
    """Advance the mission at the end of the current step or of the drive back.

    Args:
        progress: progress so far.
        end: outcome of the step.
        facts: state of the robot, for loops that end by a condition.
        depth: number of frames around the step that ended; None for the current step.

    Returns:
        The new progress and the next action: the (new) current step, a retry, another round of a loop, the drive back,
        the end after all steps, or an early end.
    """
    if progress.returning:
        return replace(progress, why=_returned(progress.why, end)), "ended"
    if end.reason in FINAL:
        return replace(progress, why=end, failures=progress.failures + 1), "ended"
    before, stack, failures, why = progress, progress.stack[:depth], progress.failures, progress.why
    following: Next | None
    while True:
        *_, node, step = _nodes(progress.mission, stack)
        assert isinstance(node, Container)
        assert not isinstance(step, Mission)
        frame = stack[-1]
        if not end.good:
            if frame.attempt < step.retries:
                again = frame.model_copy(update={"attempt": frame.attempt + 1})
                return replace(progress, stack=(*stack[:-1], again), failures=failures, why=why), "again"
            inherited = progress.mission.on_failure if isinstance(node, Mission) else "abort"
            match step.on_failure or inherited:
                case "continue":
                    failures, why, end = failures + 1, end, StepEnd(Reason.OK)
                case "return":
                    return replace(before, failures=failures + 1, why=end, returning=True), "return"
                case "abort":
                    pass
        frames, end, following = _onward(node, frame, end, facts)
        if frames:
            assert following is not None
            return replace(progress, stack=(*stack[:-1], *frames), failures=failures, why=why), following
        if isinstance(node, Mission):
            if end.good:
                return replace(before, failures=failures, why=why), "done"
            return replace(before, failures=failures + 1, why=end), "ended"
        stack = stack[:-1]


def _onward(
    node: Container, frame: MissionFrame, end: StepEnd, facts: Facts
) -> tuple[tuple[MissionFrame, ...], StepEnd, Next | None]:
    """Continue within a node after one of its steps; without frames left, the node has ended as returned."""
    following = (frame.model_copy(update={"index": frame.index + 1, "attempt": 0}),)
    more = frame.index + 1 < len(_block(node, frame))
    if isinstance(node, FallbackStep):
        return ((), end, None) if end.good or not more else (following, end, "step")
    if not end.good:
        return (), end, None
    if more:
        return following, end, "step"
    if isinstance(node, RepeatStep):
        rounds = frame.rounds + 1
        if node.until is not None and holds(node.until, facts):
            return (), end, None
        if rounds == node.times:
            missed = StepEnd(Reason.MISSION_INCOMPLETE, f"after {rounds} rounds: {_does_not_hold(node.until)}")
            return (), end if node.until is None else missed, None
        return (frame.model_copy(update={"index": 0, "attempt": 0, "rounds": rounds}),), end, "round"
    if isinstance(node, ParallelStep) and frame.block and node.watch[frame.block - 1].after == "resume":
        own, *within = frame.interrupted
        return (own.model_copy(update={"fired": frame.fired, "spent": frame.spent}), *within), end, "step"
    return (), end, None


def watched(progress: MissionProgress, facts: Facts) -> tuple[MissionProgress, bool]:
    """Check the watched conditions; return the progress and whether one interrupts the current step."""
    stack = list(progress.stack)
    for depth, node in enumerate(_nodes(progress.mission, progress.stack)[: len(stack)]):
        if progress.returning or not isinstance(node, ParallelStep):
            continue
        frame = stack[depth]
        holding = [block for block, watch in enumerate(node.watch, 1) if holds(watch.when, facts)]
        fired = tuple(block for block in frame.fired if block in holding)
        new = next((block for block in holding if block not in fired), None) if frame.block == 0 else None
        if new is not None:
            update = {"block": new, "fired": (*fired, new), "interrupted": tuple(stack[depth:])}
            begun = MissionFrame(spent=frame.spent).model_copy(update=update)
            return replace(progress, stack=(*stack[:depth], begun)), True
        if fired != frame.fired:
            stack[depth] = frame.model_copy(update={"fired": fired})
    return replace(progress, stack=tuple(stack)), False


def passed(progress: MissionProgress, seconds: float) -> MissionProgress:
    """Count time spent in the steps that contain the current one."""
    if progress.returning:
        return progress
    stack = tuple(frame.model_copy(update={"spent": frame.spent + seconds}) for frame in progress.stack)
    return replace(progress, stack=stack)


def expired(progress: MissionProgress) -> tuple[int, float] | None:
    """Return the depth and the limit (s) of the outermost step that exceeds its limit."""
    if progress.returning:
        return None
    for depth, node in enumerate(_nodes(progress.mission, progress.stack)[: len(progress.stack)]):
        limit = None if isinstance(node, Mission) else node.limit
        if limit is not None and progress.stack[depth].spent >= limit:
            return depth, limit
    return None


def judge(step: ConditionStep, facts: Facts) -> StepEnd:
    """Return the outcome of a condition."""
    return (
        StepEnd(Reason.OK) if holds(step.when, facts) else StepEnd(Reason.MISSION_INCOMPLETE, _does_not_hold(step.when))
    )


def _nodes(mission: Mission, stack: tuple[MissionFrame, ...]) -> list[Mission | AnyStep]:
    """Return the nodes of all frames, and the step of the last frame."""
    nodes: list[Mission | AnyStep] = [mission]
    for frame in stack:
        node = nodes[-1]
        assert isinstance(node, Container)
        nodes.append(_block(node, frame)[frame.index])
    return nodes


def _block(node: Container, frame: MissionFrame) -> tuple[AnyStep, ...]:
    return blocks(node)[frame.block][1]


def _part(node: Mission | AnyStep, block: int, index: int) -> str:
    return f"{prefix(node, block)}{index + 1}"


def _does_not_hold(condition: Condition | None) -> str:
    return "" if condition is None else f"{condition_in_words(condition)}: not fulfilled"


def _returned(why: StepEnd, end: StepEnd) -> StepEnd:
    """Return the outcome of a mission whose step failed with ``why`` and whose drive back ended with ``end``."""
    failed = why.text or why.reason.text
    if end.reason in GOOD:
        return StepEnd(why.reason, f"{failed}, back at its start")
    return StepEnd(end.reason, f"{failed}; not back at its start: {end.text or end.reason.text}")


def outcome(progress: MissionProgress, following: Next) -> StepEnd:
    """Return the outcome of the whole mission."""
    count = len(progress.mission.steps)
    if following == "done":
        if progress.failures == 0:
            return StepEnd(Reason.MISSION_DONE, f"{count} steps")
        return StepEnd(Reason.MISSION_INCOMPLETE, f"{progress.failures} of {count} steps failed; {progress.why.text}")
    at = f"step {progress.number} of {count} ({in_words(progress.step)})"
    return StepEnd(progress.why.reason, f"{at}: {progress.why.text or progress.why.reason.text}")


class SavedProgress(Schema):
    """Running mission as stored on disk, for resuming after a restart of the daemon."""

    mission: Mission
    source: str
    start: Pose2D
    stack: Annotated[tuple[MissionFrame, ...], Field(min_length=1, strict=False)]
    """Position in the mission"""
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
        if not _fits(self.mission, self.stack):
            raise ValueError("stack: expected the position of a step of the mission")
        return self

    @classmethod
    def of(cls, progress: MissionProgress, source: str, at: Pose2 | None = None) -> "SavedProgress":
        """Return the stored form of a mission."""
        x, y, yaw = progress.start
        return cls(
            mission=progress.mission,
            source=source,
            start=Pose2D(x=x, y=y, yaw=yaw),
            stack=progress.stack,
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
            self.mission, start, self.stack, failures=self.failures, why=why, returning=self.returning
        )

    def away(self, pose: Pose2) -> float:
        """Distance from the last pose of the robot to a pose (m)."""
        return 0.0 if self.at is None else math.dist(pose[:2], (self.at.x, self.at.y))


def _fits(mission: Mission, stack: tuple[MissionFrame, ...]) -> bool:
    """Return whether a stored position exists in the mission, the interrupted ones included."""
    node: Mission | AnyStep = mission
    for depth, frame in enumerate(stack):
        if not isinstance(node, Container):
            return False
        if frame.block >= len(blocks(node)) or frame.index >= len(_block(node, frame)):
            return False
        if isinstance(node, ParallelStep) and frame.block:
            own = frame.interrupted[:1]
            if not own or own[0].block or not _fits(mission, (*stack[:depth], *frame.interrupted)):
                return False
        node = _block(node, frame)[frame.index]
    return True
