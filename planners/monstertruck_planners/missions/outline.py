"""A mission as a list of lines: each step in words, with its position."""

from collections.abc import Iterator

from monstertruck_planners.missions.conditions import in_words as condition_in_words
from monstertruck_schemas.mission import (
    AnyStep,
    BehaviourStepOfMission,
    BranchStep,
    ConditionStep,
    DockStep,
    ExploreStep,
    FallbackStep,
    FollowWallStep,
    GoToStep,
    LookStep,
    Mission,
    ParallelStep,
    PointStep,
    RecordStep,
    RepeatStep,
    ReturnStep,
    SequenceOfSteps,
    UndockStep,
    WaitStep,
    WaitUntilStep,
    blocks,
)
from monstertruck_schemas.plan import MissionLine

Container = Mission | SequenceOfSteps | FallbackStep | RepeatStep | BranchStep | ParallelStep
"""Nodes that contain steps."""


def in_words(step: AnyStep) -> str:
    """Describe a step in one line: all its fields except retries, policy and limit."""
    match step:
        case BranchStep(when=when):
            return f"branch: {condition_in_words(when)}"
        case RepeatStep(times=times, until=until):
            words = "repeat"
            words += "" if times is None else " forever" if times == "forever" else f" {times} times"
            return words if until is None else f"{words} until {condition_in_words(until)}"
        case SequenceOfSteps() | FallbackStep() | ParallelStep():
            return step.do
        case DockStep(dock=dock) | UndockStep(dock=dock):
            return step.do if dock is None else f"{step.do} {dock}"
        case _:
            return _leaf_in_words(step)


def _leaf_in_words(step: AnyStep) -> str:
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
        case ConditionStep(when=when):
            return f"condition: {condition_in_words(when)}"
        case WaitUntilStep(when=when):
            return f"wait until {condition_in_words(when)}"
        case _:
            raise AssertionError(step.do)


def lines(mission: Mission) -> tuple[MissionLine, ...]:
    """Return all steps in order, nested steps below their containing step; watches and otherwise get separate lines."""
    return tuple(_lines(mission, "", 0))


def _lines(node: Container, before: str, depth: int) -> Iterator[MissionLine]:
    for block, (_, steps) in enumerate(blocks(node)):
        inner, number = depth, f"{before}{prefix(node, block)}"
        if block and steps:
            text = "otherwise" if isinstance(node, BranchStep) else ""
            if isinstance(node, ParallelStep):
                watch = node.watch[block - 1]
                text = f"watch: {condition_in_words(watch.when)}, then {watch.after}"
            yield MissionLine(number=number.rstrip("."), depth=depth, text=text)
            inner += 1
        for index, step in enumerate(steps, 1):
            yield MissionLine(number=f"{number}{index}", depth=inner, text=in_words(step))
            if isinstance(step, Container):
                yield from _lines(step, f"{number}{index}.", inner + 1)


def shown(all_lines: tuple[MissionLine, ...], number: str) -> tuple[MissionLine, ...]:
    """Return the lines around the current step, marked where they contain it."""
    at = next((index for index, line in enumerate(all_lines) if line.number == number), 0)
    # 8: number of lines before and after the current one, which keeps a report small
    return tuple(
        line.model_copy(update={"active": f"{number}.".startswith(f"{line.number}.")})
        for line in all_lines[max(0, at - 8) : at + 9]
    )


def prefix(node: Mission | AnyStep, block: int) -> str:
    """Return the part of a position before the index: the block of a branch or a parallel step."""
    if block == 0:
        return ""
    return "otherwise." if isinstance(node, BranchStep) else f"watch{block}."
