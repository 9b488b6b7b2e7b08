"""Missions that decide: transitions between nested steps, conditions, and what the checker finds."""

import json

import pytest
from pydantic import ValidationError

from monstertruck_planners.missions.check import Abilities, dead_ends, lacking, steps_of
from monstertruck_planners.missions.conditions import UNKNOWN, Facts, holds, in_words
from monstertruck_planners.missions.outline import lines, shown
from monstertruck_planners.missions.progress import (
    MissionProgress,
    SavedProgress,
    StepEnd,
    after,
    enter,
    expired,
    outcome,
    passed,
    watched,
)
from monstertruck_runtime.errors import NotFoundError
from monstertruck_schemas.mission import Condition, Mission
from monstertruck_schemas.reasons import Reason

OK, MISSED = StepEnd(Reason.OK), StepEnd(Reason.GOAL_UNREACHABLE, "walls")
LOW = {"battery_below": 20}
EMPTY, FULL = Facts(charge=10.0), Facts(charge=90.0)


def go(x: float, **more) -> dict:
    return {"do": "goto", "x": x, "y": 0.0, "yaw": 0.0, **more}


def mission(*steps: dict, on_failure: str = "abort") -> Mission:
    return Mission.model_validate_json(
        json.dumps({"version": 2, "name": "round", "on_failure": on_failure, "steps": steps})
    )


class Run:
    """Mission whose steps end with the given outcomes."""

    def __init__(self, *steps: dict, facts: Facts = FULL, **more) -> None:
        self.facts, self.next = facts, "step"
        self.at = enter(MissionProgress(mission(*steps, **more), (0.0, 0.0, 0.0)), facts)

    def end(self, end: StepEnd = OK, depth: int | None = None) -> "Run":
        self.at, self.next = after(self.at, end, self.facts, depth)
        if self.next not in ("done", "ended", "return"):
            self.at = enter(self.at, self.facts)
        return self

    def watch(self) -> bool:
        self.at, interrupted = watched(self.at, self.facts)
        self.at = enter(self.at, self.facts) if interrupted else self.at
        return interrupted

    @property
    def place(self) -> tuple[str, str]:
        return self.at.number, self.at.doing.removesuffix(" 0 0")


def test_a_fallback_does_its_next_step_only_if_one_fails():
    steps = [{"do": "fallback", "steps": [go(1), go(2), go(3)]}, go(4)]
    run = Run(*steps)
    assert run.end(MISSED).place == ("1.2", "goto 2")
    assert run.end().place == ("2", "goto 4")
    assert run.end().next == "done"
    assert outcome(run.at, run.next).reason is Reason.MISSION_DONE, "a failure that a fallback handles is none"
    run = Run(*steps).end(MISSED).end(MISSED).end(MISSED)
    assert (run.next, outcome(run.at, run.next)) == (
        "ended", StepEnd(Reason.GOAL_UNREACHABLE, "step 1.3 of 2 (goto 3 0 0): walls"),
    )  # fmt: skip


def test_a_step_that_contains_others_is_tried_again_from_its_beginning():
    run = Run({"do": "sequence", "retries": 1, "steps": [go(1), go(2)]}, go(3)).end()
    assert run.place == ("1.2", "goto 2")
    assert (run.end(MISSED).place, run.next) == (("1.1", "goto 1"), "again")
    assert run.end().end(MISSED).next == "ended"


def test_the_policy_of_a_mission_is_that_of_its_own_steps_only():
    run = Run({"do": "sequence", "steps": [go(1), go(2)]}, go(3), on_failure="continue")
    assert run.end(MISSED).place == ("2", "goto 3"), "the sequence failed with its first step"
    assert run.end().at.failures == 1
    run = Run({"do": "sequence", "steps": [go(1, on_failure="continue"), go(2)]}).end(MISSED)
    assert run.place == ("1.2", "goto 2")
    run = Run({"do": "repeat", "times": 2, "steps": [go(1, on_failure="return")]}).end(MISSED)
    assert (run.next, run.at.returning, run.at.doing) == ("return", True, "return")


def test_a_loop_ends_by_its_number_or_its_condition():
    run = Run({"do": "repeat", "times": 2, "steps": [go(1), go(2)]}, go(3))
    assert (run.end().end().place, run.next) == (("1.1", "goto 1"), "round")
    assert run.end().end().place == ("2", "goto 3")
    run = Run({"do": "repeat", "until": LOW, "steps": [go(1)]}, go(3)).end().end()
    assert run.place == ("1.1", "goto 1")
    run.facts = EMPTY
    assert run.end().place == ("2", "goto 3")
    run = Run({"do": "repeat", "until": LOW, "times": 2, "steps": [go(1)]}).end().end()
    assert run.next == "ended"
    assert outcome(run.at, run.next).text.endswith("after 2 rounds: battery below 20 %: not fulfilled")


def test_a_branch_chooses_when_it_is_reached():
    steps = [go(0), {"do": "branch", "when": LOW, "then": [go(1)], "otherwise": [go(2)]}, go(3)]
    run = Run(*steps)
    run.facts = EMPTY
    assert run.end().place == ("2.1", "goto 1")
    assert Run(*steps).end().place == ("2.otherwise.1", "goto 2")
    run = Run(*[{**step, "otherwise": []} if step["do"] == "branch" else step for step in steps]).end()
    assert run.place == ("2", "branch: battery below 20 %")
    assert run.end().place == ("3", "goto 3")


@pytest.mark.parametrize("afterwards", ["resume", "end"])
def test_a_watch_interrupts_once_while_its_condition_holds(afterwards: str):
    watch = {"when": LOW, "then": [go(8), go(9)], "after": afterwards}
    inner = {"do": "repeat", "times": 3, "steps": [go(1), go(2)]}
    run = Run({"do": "parallel", "steps": [go(0), inner], "watch": [watch]}, go(3)).end().end()
    assert not run.watch()
    run.facts = EMPTY
    assert run.watch()
    assert run.place == ("1.watch1.1", "goto 8")
    assert not run.watch(), "the interruption is not interrupted by itself"
    saved = SavedProgress.model_validate_json(SavedProgress.of(run.at, "ann").model_dump_json()).progress()
    assert saved == run.at, "a restart resumes the interruption, too"
    run.end().end()
    if afterwards == "end":
        assert run.place == ("2", "goto 3")
        return
    assert run.place == ("1.2.2", "goto 2"), "the interrupted step"
    assert not run.watch(), "it has held ever since"
    run.facts = FULL
    assert not run.watch()
    run.facts = EMPTY
    assert run.watch()


def test_an_outer_watch_interrupts_an_inner_one():
    inner = {"do": "parallel", "steps": [go(1)], "watch": [{"when": LOW, "then": [go(2)]}]}
    run = Run(
        {"do": "parallel", "steps": [inner], "watch": [{"when": {"point": "dock"}, "then": [go(3)]}]}, facts=EMPTY
    )
    assert run.watch()
    assert run.place == ("1.1.watch1.1", "goto 2")
    run.facts = Facts(charge=10.0, points=frozenset({"dock"}))
    assert run.watch()
    assert run.place == ("1.watch1.1", "goto 3")
    assert run.end().place == ("1.1.watch1.1", "goto 2")
    assert run.end().place == ("1.1.1", "goto 1")


def test_the_limit_of_an_outer_step_ends_what_it_contains():
    run = Run({"do": "fallback", "steps": [{"do": "sequence", "limit": 5, "steps": [go(1), go(2)]}, go(3)]}).end()
    run.at = passed(run.at, 4.9)
    assert expired(run.at) is None
    run.at = passed(run.at, 0.2)
    depth, limit = expired(run.at) or (0, 0.0)
    assert limit == 5
    assert run.end(StepEnd(Reason.TIMEOUT), depth).place == ("1.2", "goto 3")


@pytest.mark.parametrize("reason", [Reason.CANCELLED, Reason.ESTOPPED])
def test_who_cancels_ends_it_in_any_depth(reason: Reason):
    run = Run({"do": "fallback", "retries": 3, "steps": [go(1), go(2)]}).end(StepEnd(reason))
    assert run.next == "ended"
    assert outcome(run.at, run.next).reason is reason


@pytest.mark.parametrize(
    ("condition", "facts", "expected"),
    [
        (LOW, EMPTY, True),
        (LOW, FULL, False),
        (LOW, UNKNOWN, False),
        ({"unless": LOW}, UNKNOWN, True),
        ({"battery_above": 80}, FULL, True),
        ({"after": 5}, Facts(elapsed=5.0), True),
        ({"after": 5}, Facts(elapsed=4.9), False),
        ({"point": "dock"}, Facts(points=frozenset({"dock"})), True),
        ({"tags": 2}, Facts(tags=1), False),
        ({"obstacle": 3}, Facts(obstacle=3.5), True),
        ({"zone": "stairs"}, Facts(zones=frozenset({"stairs", "ramp"})), True),
        ({"zone": "stairs"}, Facts(zones=frozenset({"ramp"})), False),
        ({"time": "08:00-17:30"}, Facts(minute=8 * 60), True),
        ({"time": "08:00-17:30"}, Facts(minute=17 * 60 + 30), False),
        ({"time": "22:00-06:30"}, Facts(minute=23 * 60), True),
        ({"time": "22:00-06:30"}, Facts(minute=6 * 60 + 29), True),
        ({"time": "22:00-06:30"}, Facts(minute=12 * 60), False),
        ({"time": "00:00-23:59"}, UNKNOWN, False),
        ({"battery_below": 20, "after": 5}, EMPTY, False),
        ({"any_of": [LOW, {"after": 5}]}, Facts(elapsed=6.0), True),
    ],
)
def test_conditions(condition: dict, facts: Facts, expected: bool):
    one = Condition.model_validate_json(json.dumps(condition))
    assert holds(one, facts) is expected
    assert in_words(one)


def test_an_empty_condition_a_loop_without_exit_and_too_deep_steps_are_refused():
    with pytest.raises(ValidationError, match="an empty condition: expected one of battery_below"):
        mission({"do": "condition", "when": {}})
    with pytest.raises(ValidationError, match="a loop without exit: expected times or until"):
        mission({"do": "repeat", "steps": [go(1)]})
    step = go(1)
    for _ in range(8):
        step = {"do": "sequence", "steps": [step]}
    with pytest.raises(ValidationError, match="nested 9 deep, expected at most 8"):
        mission(step)
    with pytest.raises(ValidationError, match="502 with those within others, expected at most 500"):
        mission({"do": "sequence", "steps": [go(1)] * 499}, go(2), go(3))


FOREVER = {"do": "repeat", "times": "forever", "steps": [go(1)]}
NOTE = {"do": "record", "note": "x"}
BRANCH = {"do": "branch", "when": LOW, "then": [go(1)]}
ENDS = {"when": LOW, "then": [go(2)], "after": "end"}


@pytest.mark.parametrize(
    ("steps", "found"),
    [
        ([FOREVER, go(2)], {"2": "never succeeds"}),
        ([{**FOREVER, "on_failure": "continue"}, go(2)], {}),
        ([{**FOREVER, "limit": 60, "on_failure": "continue"}, go(2)], {}),
        ([{"do": "fallback", "steps": [go(1, on_failure="continue"), go(2)]}], {"1.2": "never fails"}),
        ([{"do": "fallback", "steps": [NOTE, go(2)]}], {"1.2": "never fails"}),
        ([{"do": "fallback", "steps": [{"do": "wait", "seconds": 9}, go(2)]}], {"1.2": "never fails"}),
        ([{"do": "fallback", "steps": [{"do": "wait_until", "when": LOW, "limit": 9}, go(2)]}], {}),
        ([{"do": "repeat", "times": "forever", "steps": [NOTE]}], {"1": "no step in it takes time"}),
        ([{"do": "repeat", "until": LOW, "steps": [BRANCH]}], {"1": "no step in it takes time"}),
        ([{"do": "repeat", "times": 5, "steps": [NOTE]}], {}),
        ([{"do": "branch", "when": LOW, "then": [FOREVER], "otherwise": [go(1)]}, go(2)], {}),
        ([{"do": "branch", "when": LOW, "then": [FOREVER, NOTE]}, go(2)], {"1.2": "never succeeds"}),
        ([{"do": "parallel", "steps": [FOREVER], "watch": [{"when": LOW, "then": [go(2)]}]}, go(3)], {"2": "never"}),
        ([{"do": "parallel", "steps": [FOREVER], "watch": [ENDS]}, go(3)], {}),
    ],
)  # fmt: skip
def test_dead_ends_are_found(steps: list[dict], found: dict[str, str]):
    mistakes = dead_ends(mission(*steps))
    assert [one.number for one in mistakes] == list(found)
    assert all(text in one.text for one, text in zip(mistakes, found.values(), strict=True))


def test_what_the_robot_lacks_is_found_in_any_depth():
    def behaviour(name: str, _: object) -> None:
        raise NotFoundError(f"no behaviour {name!r}")

    steps = [
        {"do": "branch", "when": {"any_of": [LOW, {"tags": 2}]}, "then": [{"do": "behaviour", "name": "wall"}]},
        {"do": "wait_until", "when": {"unless": {"obstacle": 3, "zone": "stairs"}}},
        {"do": "parallel", "steps": [go(1)], "watch": [{"when": {"point": "dock"}, "then": [go(1)]}]},
    ]
    able = Abilities(points=False, charge=False, lidar=False, zones=False, behaviour=behaviour)
    found = lacking(mission(*steps), able)
    assert [(one.number, one.key[-1]) for one in found] == [
        ("1", "when"), ("1", "when"), ("1.1", 0), ("2", "when"), ("2", "when"), ("3", "when"),
    ]  # fmt: skip
    assert lacking(mission(*steps), Abilities()) == []
    known = Abilities(known=frozenset({"door"}))
    (unknown,) = lacking(mission(*steps), known)
    assert unknown.text == "point of interest 'dock' is unknown and no step explores: known are door"
    assert lacking(mission(*steps, {"do": "explore"}), known) == [], "it may be found"


def test_lines_show_the_present_step_and_those_that_contain_it():
    watch = {"when": LOW, "then": [go(5)]}
    whole = mission(go(0), {"do": "parallel", "steps": [go(1), go(2)], "watch": [watch]}, go(3))
    numbers = ["1", "2", "2.1", "2.2", "2.watch1", "2.watch1.1", "3"]
    assert [line.number for line in lines(whole)] == numbers
    assert [line.depth for line in lines(whole)] == [0, 0, 1, 1, 1, 2, 0]
    assert [place.number for place in steps_of(whole)] == [one for one in numbers if one != "2.watch1"]
    active = [line.number for line in shown(lines(whole), "2.watch1.1") if line.active]
    assert active == ["2", "2.watch1", "2.watch1.1"]
    many = lines(mission(*[go(x) for x in range(60)]))
    assert [line.number for line in shown(many, "30")][::16] == ["22", "38"]
