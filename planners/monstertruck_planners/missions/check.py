"""Checks of a mission before it starts: steps that cannot be reached, endless loops, parts that the robot lacks."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from monstertruck_planners.behave.dock.config import Docks, chosen
from monstertruck_planners.missions.outline import Container, prefix
from monstertruck_runtime.errors import NotFoundError, TruckError
from monstertruck_schemas.mission import (
    AnyStep,
    BehaviourStepOfMission,
    BranchStep,
    Condition,
    ConditionStep,
    DockStep,
    ExploreStep,
    FallbackStep,
    FollowWallStep,
    Mission,
    ParallelStep,
    PointStep,
    RecordStep,
    RepeatStep,
    UndockStep,
    WaitStep,
    WaitUntilStep,
    blocks,
)

Key = tuple[str | int, ...]


@dataclass(frozen=True, slots=True)
class Mistake:
    """An error in a mission."""

    key: Key
    """Keys and indices of its location in the file."""
    number: str
    """Position of the step."""
    text: str
    lacks: bool = False
    """Whether the robot lacks a part, while the mission itself is correct."""


@dataclass(frozen=True, slots=True)
class Abilities:
    """Parts of the robot required by steps and conditions."""

    explorer: bool = True
    points: bool = True
    charge: bool = True
    """Whether the robot estimates its battery charge."""
    lidar: bool = True
    zones: bool = True
    behaviour: Callable[[str, Mapping[str, float | str | bool]], object] | None = lambda _name, _settings: None
    """Check of a behaviour: raises a ``TruckError`` if it is unknown or its settings are invalid; None without any."""
    docks: Docks | None = None
    """Docks by name; None if unknown"""
    known: frozenset[str] | None = None
    """Names of the points of interest; None unless all are known."""


class Ends(NamedTuple):
    """Possible outcomes of a step."""

    good: bool
    """Whether it can succeed."""
    bad: bool
    """Whether it can fail."""
    takes_time: bool
    """Whether it takes time whatever its outcome."""


class StepPlace(NamedTuple):
    """A step and its position in the mission."""

    key: Key
    number: str
    step: AnyStep

    def mistake(self, text: str, *more: str | int, lacks: bool = False) -> Mistake:
        """Return an error in this step, at one of its keys if given."""
        return Mistake((*self.key, *more), self.number, text, lacks)


def steps_of(mission: Mission) -> Iterator[StepPlace]:
    """Return all steps, nested steps after their containing steps."""
    return _steps(mission, (), "")


def _steps(node: Container, key: Key, before: str) -> Iterator[StepPlace]:
    for places in _blocks(node, key, before):
        for place in places:
            yield place
            if isinstance(place.step, Container):
                yield from _steps(place.step, place.key, f"{place.number}.")


def _blocks(node: Container, key: Key, before: str) -> list[list[StepPlace]]:
    return [
        [
            StepPlace((*key, *keys, index), f"{before}{prefix(node, block)}{index + 1}", step)
            for index, step in enumerate(steps)
        ]
        for block, (keys, steps) in enumerate(blocks(node))
    ]


def dead_ends(mission: Mission) -> list[Mistake]:
    """Return the unreachable steps, and the loops that never end or take no time."""
    found: list[Mistake] = []
    (places,) = _blocks(mission, (), "")
    _sequence(places, mission.on_failure, found)
    return sorted(found, key=lambda mistake: [str(part).zfill(4) for part in mistake.key])


def _sequence(places: list[StepPlace], policy: str, found: list[Mistake]) -> Ends:
    """Return the outcomes of steps in sequence, and record their errors."""
    bad, takes_time, before = False, False, None
    for place in places:
        if before is not None:
            found.append(place.mistake(f"is never reached: step {before.number} never succeeds"))
            break
        ends = _ends(place, policy, found)
        bad, takes_time = bad or ends.bad, takes_time or ends.takes_time
        before = None if ends.good else place
    return Ends(before is None, bad, takes_time)


def _fallback(places: list[StepPlace], found: list[Mistake]) -> Ends:
    good, bad, takes_time, before = False, True, True, None
    for place in places:
        if before is not None:
            found.append(place.mistake(f"is never reached: step {before.number} never fails"))
            break
        ends = _ends(place, "abort", found)
        good, bad, takes_time = good or ends.good, ends.bad, takes_time and ends.takes_time
        before = None if ends.bad else place
    return Ends(good, bad, takes_time)


def _ends(place: StepPlace, policy: str, found: list[Mistake]) -> Ends:
    """Return the outcomes of a step for its containing steps: after retries, its limit and its policy."""
    good, bad, takes_time = _own_ends(place, found)
    policy = place.step.on_failure or policy
    bad = bad or (place.step.limit is not None and takes_time)
    if policy == "return":
        return Ends(good, False, takes_time)
    return Ends(good or bad, False, takes_time) if policy == "continue" else Ends(good, bad, takes_time)


def _own_ends(place: StepPlace, found: list[Mistake]) -> Ends:
    step = place.step
    inner = _blocks(step, place.key, f"{place.number}.") if isinstance(step, Container) else []
    match step:
        case RecordStep():
            return Ends(good=True, bad=False, takes_time=False)
        case WaitStep() | WaitUntilStep():
            return Ends(good=True, bad=False, takes_time=True)
        case ConditionStep():
            return Ends(good=True, bad=True, takes_time=False)
        case FallbackStep():
            return _fallback(inner[0], found)
        case RepeatStep():
            return _repeat(place, step, _sequence(inner[0], "abort", found), found)
        case BranchStep():
            sides = [_sequence(block, "abort", found) for block in inner]
            good, bad = (any(ends[end] for ends in sides) for end in (0, 1))
            return Ends(good, bad, all(ends.takes_time for ends in sides))
        case ParallelStep():
            main = _sequence(inner[0], "abort", found)
            others = [_sequence(block, "abort", found) for block in inner[1:]]
            ended = [ends.good for ends, watch in zip(others, step.watch, strict=True) if watch.after == "end"]
            return Ends(main.good or any(ended), main.bad or any(ends.bad for ends in others), main.takes_time)
        case _ if inner:
            return _sequence(inner[0], "abort", found)
        case _:
            return Ends(good=True, bad=True, takes_time=True)


def _repeat(place: StepPlace, step: RepeatStep, body: Ends, found: list[Mistake]) -> Ends:
    forever = step.until is None and step.times == "forever"
    if not body.takes_time and not isinstance(step.times, int):
        found.append(place.mistake("a loop without exit: no step in it takes time"))
    return Ends(
        body.good and not forever, body.bad or (step.until is not None and step.times is not None), body.takes_time
    )


def lacking(mission: Mission, able: Abilities) -> list[Mistake]:
    """Return the missing needs of steps and conditions, and the unknown points of interest."""
    found: list[Mistake] = []
    places = list(steps_of(mission))
    explores = any(isinstance(place.step, ExploreStep) for place in places)
    known = None if explores else able.known
    for place in places:
        try:
            _require_parts(place.step, able)
        except TruckError as error:
            found.append(place.mistake(str(error), lacks=isinstance(error, NotFoundError)))
        if isinstance(place.step, PointStep) and able.points and known is not None and place.step.point not in known:
            found.append(place.mistake(_unknown(place.step.point, known), "point", lacks=True))
        for key, condition in conditions_of(place.step):
            found += [place.mistake(text, *key, lacks=True) for text in _lacking(condition, able, known)]
    return found


def conditions_of(step: AnyStep) -> Iterator[tuple[Key, Condition]]:
    """Return the conditions of a step, each with the keys that lead to it."""
    match step:
        case ConditionStep(when=when) | WaitUntilStep(when=when) | BranchStep(when=when):
            yield ("when",), when
        case RepeatStep(until=until) if until is not None:
            yield ("until",), until
        case ParallelStep(watch=watch):
            for index, one in enumerate(watch):
                yield ("watch", index, "when"), one.when


def _require_parts(step: AnyStep, able: Abilities) -> None:
    if isinstance(step, ExploreStep) and not able.explorer:
        raise NotFoundError("explore: add a section `explorer` to the robot's configuration")
    looks = isinstance(step, PointStep) or (isinstance(step, ExploreStep) and step.find is not None)
    if looks and not able.points:
        raise NotFoundError(f"{step.do}: add a section `points` to the robot's configuration")
    if isinstance(step, DockStep | UndockStep) and able.docks is not None:
        try:
            chosen(able.docks, step.dock or "")
        except ValueError as error:
            raise NotFoundError(f"{step.do}: {error}") from None
    if isinstance(step, BehaviourStepOfMission | FollowWallStep):
        if able.behaviour is None:
            raise NotFoundError(f"{step.do}: add a section `behaviours` to the robot's configuration")
        able.behaviour(step.name, step.settings if isinstance(step, BehaviourStepOfMission) else {})


def _lacking(condition: Condition, able: Abilities, known: frozenset[str] | None) -> Iterator[str]:
    if not able.charge and (condition.battery_below is not None or condition.battery_above is not None):
        yield "condition on the battery: no device of the robot measures it"
    if not able.points and (condition.point is not None or condition.tags is not None):
        yield "condition on points of interest: add a section `points` to the robot's configuration"
    elif condition.point is not None and known is not None and condition.point not in known:
        yield _unknown(condition.point, known)
    if not able.lidar and condition.obstacle is not None:
        yield "condition on obstacles: the robot has no lidar (`devices.lidar`)"
    if not able.zones and condition.zone is not None:
        yield "condition on zones: add a section `zones` to the robot's configuration"
    inner = (*(condition.any_of or ()), *(() if condition.unless is None else (condition.unless,)))
    for one in inner:
        yield from _lacking(one, able, known)


def _unknown(name: str, known: frozenset[str]) -> str:
    names = ", ".join(sorted(known)[:10]) or "none"
    return f"point of interest {name!r} is unknown and no step explores: known are {names}"
