"""Missions: what follows a step, and the service with services that only pretend to drive."""

import asyncio
import errno
import json
import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from pydantic import ValidationError

from monstertruck_planners.missions.outline import in_words
from monstertruck_planners.missions.progress import MissionProgress, SavedProgress, StepEnd, after, outcome
from monstertruck_planners.missions.service import SILENT, MissionInputs, MissionParts, MissionService
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import InputError, NotFoundError, RequestRefusedError
from monstertruck_runtime.threads import inline
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.mission import Mission
from monstertruck_schemas.plan import BehaviourState, ExplorationPhase, ExplorationState, GoalPhase, GoalState
from monstertruck_schemas.points import PointKind
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import BehaviourOrder, GoalControl, GoalOrder, MissionOrder, MissionRequest, Role

GO = {"do": "goto", "x": 1.0, "y": 0.0, "yaw": 0.0}
WAIT = {"do": "wait", "seconds": 3.0}
DONE, MISSED = StepEnd(Reason.GOAL_REACHED), StepEnd(Reason.GOAL_UNREACHABLE, "walls")


def mission(*steps: dict, on_failure: str = "abort") -> Mission:
    return Mission.model_validate_json(
        json.dumps({"version": 2, "name": "round", "on_failure": on_failure, "steps": steps})
    )


def progress(*steps: dict, **more) -> MissionProgress:
    return MissionProgress(mission(*steps, **more), (1.0, 2.0, 3.0))


def test_steps_follow_each_other_to_the_end():
    at, following = after(progress(GO, WAIT), DONE)
    assert (at.index, following) == (1, "step")
    at, following = after(at, StepEnd(Reason.OK))
    assert following == "done"
    assert outcome(at, following).reason is Reason.MISSION_DONE


def test_a_step_is_tried_again_before_it_has_failed():
    at, following = after(progress({**GO, "retries": 2}, WAIT), MISSED)
    assert (at.attempt, following) == (1, "again")
    at, following = after(at, MISSED)
    assert (at.attempt, following) == (2, "again")
    at, following = after(at, MISSED)
    assert (at.failures, following) == (1, "ended")
    end = outcome(at, following)
    assert end.reason is Reason.GOAL_UNREACHABLE
    assert end.text == "step 1 of 2 (goto 1 0 0): walls"


def test_the_policy_of_a_step_counts_before_that_of_the_mission():
    at, following = after(progress({**GO, "on_failure": "continue"}, WAIT), MISSED)
    assert (at.index, at.failures, following) == (1, 1, "step")
    at, following = after(at, StepEnd(Reason.OK))
    assert outcome(at, following) == StepEnd(Reason.MISSION_INCOMPLETE, "1 of 2 steps failed; walls")
    at, following = after(progress({**GO, "on_failure": "return"}, WAIT, on_failure="continue"), MISSED)
    assert (following, at.returning) == ("return", True)
    back, following = after(at, DONE)
    assert following == "ended"
    assert outcome(back, following).text.endswith("walls, back at its start")
    assert outcome(back, following).reason is Reason.GOAL_UNREACHABLE


@pytest.mark.parametrize("reason", [Reason.GOAL_BLOCKED, Reason.DISARMED])
def test_a_way_back_that_fails_too_is_reported_with_what_made_it_drive_back(reason: Reason):
    step = {**GO, "retries": 1, "on_failure": "return"}
    at, _ = after(progress(WAIT, step), StepEnd(Reason.OK))
    for following in ("again", "return"):
        at, next_ = after(at, MISSED)
        assert next_ == following
    assert at.attempt == 0, "the way back is tried for the first time"
    at, following = after(at, StepEnd(reason, "a box"))
    assert (following, at.failures) == ("ended", 1)
    end = outcome(at, following)
    assert end.reason is reason
    assert end.text == "step 2 of 2 (goto 1 0 0): walls; not back at its start: a box"


def test_points_that_were_looked_for_and_found_are_no_failure():
    at, following = after(progress({"do": "explore", "find": 2}, WAIT), StepEnd(Reason.POINTS_FOUND))
    assert (at.index, at.failures, following) == (1, 0, "step")


@pytest.mark.parametrize("reason", [Reason.CANCELLED, Reason.DISARMED])
def test_who_cancels_or_disarms_ends_it_whatever_the_policy(reason: Reason):
    at, following = after(progress({**GO, "retries": 3, "on_failure": "continue"}, WAIT), StepEnd(reason))
    assert following == "ended"
    assert outcome(at, following).reason is reason


def test_what_is_saved_comes_back():
    at, _ = after(progress({**GO, "on_failure": "continue"}, WAIT), MISSED)
    again = SavedProgress.model_validate_json(SavedProgress.of(at, "ann").model_dump_json()).progress()
    assert (again.mission, again.start, again.index, again.failures) == (at.mission, at.start, 1, 1)
    assert again.why == MISSED, "it is in the text of the end"


def test_a_step_takes_no_more_settings_than_a_behaviour_is_started_with():
    with pytest.raises(ValidationError, match="at most 32"):
        mission({"do": "behaviour", "name": "wall", "settings": {f"k{i}": 1.0 for i in range(33)}})


def test_a_line_says_all_that_a_step_does():
    lines = {
        "goto 1 0 0": GO,
        "goto 1 0 0 via 2,3 via 0.5,4": {**GO, "via": [[2, 3], [0.5, 4]]},
        "look at 2 3": {"do": "look", "x": 2, "y": 3},
        "wait 3 s": WAIT,
        "goto_point dock, 0.5 m before a tag": {"do": "goto_point", "point": "dock", "distance": 0.5},
        "explore": {"do": "explore"},
        "explore for 60 s until it knows 2 tags and home": {"do": "explore", "budget": 60, "find": 2, "home": True},
        "behaviour move length=0.3": {"do": "behaviour", "name": "move", "settings": {"length": 0.3}},
        "follow_wall left for 2 m": {"do": "follow_wall", "name": "left", "distance": 2},
        "record: here": {"do": "record", "note": "here"},
        "return": {"do": "return"},
    }
    assert [in_words(step) for step in mission(*lines.values()).steps] == list(lines)


class Behaviours:
    """A robot that is busy at first, and whose behaviours take a second."""

    noun = "behaviour"

    def __init__(self, robot: "Pretended", busy: int) -> None:
        self._robot, self._busy, self.asked, self.tasks = robot, busy, [], self

    def take(self, request) -> int:
        assert request.own is (request.order is BehaviourOrder.STOP)
        self.asked.append(request.order)
        if self._busy:
            self._busy -= 1
            raise RequestRefusedError(Reason.BUSY, "the path 'halt-1.2' is followed")
        running = request.order is BehaviourOrder.START
        self.say(1, running, Reason.DRIVING if running else Reason.CANCELLED)
        if running:
            asyncio.get_running_loop().call_later(1.0, self.say, 1, False, Reason.BEHAVIOUR_DONE)
        return 1

    def check(self, name: str, settings: dict[str, object]) -> None:
        if name != "wall":
            raise NotFoundError(f"no behaviour {name!r}: expected one of wall")
        if wrong := settings.keys() - {"distance"}:
            raise InputError(f"settings.{min(wrong)}: not a setting of wall_pd for one run")

    def say(self, number: int, running: bool, reason: Reason, source: str = "missions") -> None:
        now = self._robot.clock.now()
        self._robot.latest["behaviour"] = BehaviourState(
            stamp=now, received=now, seq=0, frame="odom", number=number, behaviour="wall", source=source,
            running=running, outcome=reason,
        )  # fmt: skip


class Pretended:
    """A robot whose goals end on request."""

    noun = "goal"

    def __init__(
        self, clock: VirtualClock, file: Path | None = None, *, localised: bool = False, busy: int = 0, offload=inline
    ) -> None:
        self.tasks = self
        self.clock, self.number, self.reached = clock, 0, [Reason.GOAL_REACHED] * 99
        topics = ("gate", "pose", "goal", "behaviour", "explore", "points", "slam", "battery", "zones")
        self.latest = dict.fromkeys(topics)
        self.reports, self.events, self.goals, self.held = [], [], [], set()
        self.refusals: list[RequestRefusedError] = []
        box = {name: self._box(name) for name in self.latest}
        dock = SimpleNamespace(
            name="dock", kind=PointKind.TAG, before=lambda away: Pose2D(x=7.0 - away, y=8.0, yaw=0.0)
        )
        self.latest["points"] = SimpleNamespace(points=(dock,))
        self.latest["gate"] = SimpleNamespace(nonce="n", stamp=0, reasons=(), mode=SimpleNamespace(active=True))
        self.seq, self.placed, self.behaviours = 0, True, Behaviours(self, busy)
        self.service = MissionService(
            MissionParts(self, self.behaviours, None),
            clock, file=file, localised=localised, offload=offload, max_age=5.0,
            inputs=MissionInputs(**box, lidar=True), state=SimpleNamespace(next_seq=lambda: 1, put=self.reports.append),
            events=lambda reason, severity, source, text="", **_: self.events.append((reason, text)),
        )  # fmt: skip

    def _box(self, name: str):
        return type("Box", (), {"latest": property(lambda _: self.latest[name])})()

    def take(self, request):
        """As the goal service's task server."""
        if isinstance(request, GoalControl):
            assert (request.order, request.own) == (GoalOrder.CANCEL, True)
            self.task.cancel()
            self._say(GoalPhase.IDLE, Reason.CANCELLED)
            return self.number
        if self.refusals:
            raise self.refusals.pop(0)
        self.number += 1
        self.goals.append((request.goal.x, request.goal.y))
        self._say(GoalPhase.DRIVING, Reason.DRIVING)
        self.task = asyncio.get_running_loop().call_later(2.0, self._say, GoalPhase.IDLE, self.reached.pop(0))
        return self.number

    def hold(self, who: str, *, on: bool):
        (self.held.add if on else self.held.discard)(who)

    def _say(self, phase: GoalPhase, reason: Reason, source: str = "missions"):
        state = GoalState(
            stamp=1, received=1, seq=0, frame="map", number=self.number, source=source, phase=phase, outcome=reason
        )
        self.latest["goal"] = state

    def order(
        self, order: MissionOrder, *steps: dict, moved: bool = False, own: bool = False, source: str = "ann", **more
    ) -> int:
        self.seq += 1
        now = self.clock.now()
        self.latest["gate"].stamp = now
        if self.placed:
            self.latest["pose"] = SimpleNamespace(received=now, pose=Pose2D(x=5.0, y=6.0, yaw=0.0))
        request = MissionRequest(
            stamp=now, received=now, seq=self.seq, source=source, role=Role.STATION, lease=1.0, nonce="n",
            gate_stamp=now, order=order, moved=moved, own=own, mission=mission(*steps, **more) if steps else None,
        )  # fmt: skip
        return self.service.tasks.take(request)


def played(story, file: Path | None = None, **more) -> Pretended:
    async def main(clock: VirtualClock) -> Pretended:
        robot = Pretended(clock, file, **more)
        task = asyncio.create_task(robot.service.run(lambda: None))
        await clock.sleep(0.1)
        await story(robot)
        task.cancel()
        await asyncio.wait([task])
        return robot

    return run_virtual(main, start=SECOND)


def test_a_step_goes_before_a_point_of_interest_and_says_when_none_has_its_name():
    async def story(robot: Pretended) -> None:
        point = {"do": "goto_point", "point": "dock", "distance": 1.0}
        robot.order(MissionOrder.START, point, point | {"point": "tag-9"})
        await robot.clock.sleep(6.0)

    robot = played(story)
    assert robot.goals == [(6.0, 8.0)]
    assert robot.reports[-1].outcome is Reason.NOT_FOUND
    assert "'tag-9'" in robot.reports[-1].text


def test_a_mission_is_done_step_by_step_and_keeps_the_robot_armed(tmp_path: Path):
    file = tmp_path / "mission.json"

    async def story(robot: Pretended) -> None:
        assert robot.order(MissionOrder.START, GO, WAIT, {"do": "record", "note": "here"}, {"do": "return"}) == 1
        await robot.clock.sleep(1.0)
        assert robot.held == {"missions"}
        assert json.loads(file.read_text())["stack"][0]["index"] == 0
        with pytest.raises(RequestRefusedError, match="is running"):
            robot.order(MissionOrder.START, GO)
        await robot.clock.sleep(9.0)

    robot = played(story, file)
    assert robot.goals == [(1.0, 0.0), (5.0, 6.0)]
    assert robot.reports[-1].outcome is Reason.MISSION_DONE
    assert (Reason.MISSION_NOTE, "here") in robot.events
    assert not robot.held
    assert not file.exists()
    assert [report.step for report in robot.reports if report.running][-1] == 4


def test_why_an_attempt_failed_is_reported_until_the_next_mission():
    async def story(robot: Pretended) -> None:
        robot.reached = [Reason.STUCK, Reason.GOAL_REACHED, Reason.GOAL_REACHED]
        robot.order(MissionOrder.START, {**GO, "retries": 1}, GO)
        await robot.clock.sleep(7.0)
        robot.order(MissionOrder.START, WAIT)
        await robot.clock.sleep(1.0)

    reports = played(story).reports
    assert {(report.attempt, report.failed) for report in reports if report.step == 1 and report.number == 1} == {
        (1, ""),
        (2, Reason.STUCK.text),
    }
    assert reports[-1].failed == ""


def test_a_step_fails_when_what_does_it_falls_silent():
    async def story(robot: Pretended) -> None:
        robot.order(MissionOrder.START, GO)
        await robot.clock.sleep(1.0)
        robot.task.cancel()  # no report any more
        await robot.clock.sleep(SILENT + 1.0)

    robot = played(story)
    assert (robot.reports[-1].running, robot.reports[-1].outcome) == (False, Reason.SERVICE_FAILED)
    assert robot.latest["goal"].outcome is Reason.CANCELLED, "in case it only says nothing"


def test_a_process_that_stood_for_a_while_is_not_taken_for_silence():
    async def story(robot: Pretended) -> None:
        robot.order(MissionOrder.START, GO, WAIT)
        await robot.clock.sleep(1.0)
        robot.task.cancel()
        robot.clock.spend(3 * SILENT)
        await robot.clock.sleep(1.0)
        assert (robot.reports[-1].running, robot.reports[-1].failed) == (True, "")
        robot._say(GoalPhase.IDLE, Reason.GOAL_REACHED)
        await robot.clock.sleep(0.5)

    assert played(story).reports[-1].step == 2


def test_a_behaviour_is_asked_for_again_while_the_robot_brakes_after_a_goal():
    async def story(robot: Pretended) -> None:
        robot.order(MissionOrder.START, GO, {"do": "behaviour", "name": "wall"})
        await robot.clock.sleep(8.0)

    robot = played(story, busy=2)
    assert robot.reports[-1].outcome is Reason.MISSION_DONE, robot.reports[-1].text
    assert robot.behaviours.asked == [BehaviourOrder.START] * 3


def test_what_another_client_started_in_its_place_is_neither_waited_for_nor_stopped():
    async def story(robot: Pretended) -> None:
        robot.order(MissionOrder.START, {"do": "behaviour", "name": "wall", "limit": 60.0})
        await robot.clock.sleep(0.5)
        robot.behaviours.say(2, True, Reason.DRIVING, "bob")
        await robot.clock.sleep(0.4)

    robot = played(story)
    assert (robot.reports[-1].running, robot.reports[-1].outcome) == (False, Reason.CANCELLED)
    assert "bob started another behaviour" in robot.reports[-1].text
    assert robot.behaviours.asked == [BehaviourOrder.START]


@pytest.mark.parametrize("what", ["goal", "behaviour", "explore"])
def test_it_takes_nothing_over_from_somebody_else(what: str):
    def drive(robot: Pretended) -> None:
        now = robot.clock.now()
        if what == "goal":
            robot.number += 1
            robot._say(GoalPhase.DRIVING, Reason.DRIVING, "bob")
        elif what == "behaviour":
            robot.behaviours.say(9, True, Reason.DRIVING, "bob")
        else:
            robot.latest["explore"] = ExplorationState(
                stamp=now, received=now, seq=0, frame="map", number=1, source="bob", phase=ExplorationPhase.DRIVING
            )

    async def story(robot: Pretended) -> None:
        robot.order(MissionOrder.START, WAIT, GO)
        await robot.clock.sleep(1.0)
        drive(robot)
        await robot.clock.sleep(4.0)
        assert (robot.reports[-1].running, robot.reports[-1].outcome) == (False, Reason.CANCELLED)
        assert "of bob is" in robot.reports[-1].text
        with pytest.raises(RequestRefusedError, match=r"of bob is .*, stop it first") as refused:
            robot.order(MissionOrder.START, GO)
        assert refused.value.refusal is Reason.BUSY

    assert played(story).goals == []


def test_a_robot_that_has_lost_its_place_is_waited_for():
    async def story(robot: Pretended) -> None:
        robot.refusals = [RequestRefusedError(Reason.POSE_LOST, "where is it?")] * 3
        robot.order(MissionOrder.START, GO)
        await robot.clock.sleep(2.0)
        assert (robot.reports[-1].running, robot.reports[-1].text) == (True, "where is it?")
        await robot.clock.sleep(6.0)

    assert played(story).reports[-1].outcome is Reason.MISSION_DONE


def test_a_look_waits_for_a_pose_and_a_point_for_the_list_of_points():
    async def story(robot: Pretended) -> None:
        points, robot.latest["points"] = robot.latest["points"], None
        robot.order(MissionOrder.START, {"do": "look", "x": 5.0, "y": 9.0}, {"do": "goto_point", "point": "dock"})
        robot.latest["pose"] = None
        await robot.clock.sleep(5.0)
        assert (robot.reports[-1].running, robot.reports[-1].text) == (True, "no fresh pose")
        robot.latest["pose"] = SimpleNamespace(received=2**60, pose=Pose2D(x=5.0, y=6.0, yaw=0.0))
        await robot.clock.sleep(5.0)
        assert robot.reports[-1].text == "no points of interest yet"
        robot.latest["points"] = points
        await robot.clock.sleep(5.0)

    robot = played(story)
    assert robot.reports[-1].outcome is Reason.MISSION_DONE
    assert robot.goals == [(5.0, 6.0), (6.3, 8.0)]


@pytest.mark.parametrize("after", [0.0, 0.5, 1.0])
def test_stopped_at_its_start_or_at_the_limit_of_a_step_it_has_ended(after: float):
    async def story(robot: Pretended) -> None:
        robot.order(MissionOrder.START, {**GO, "limit": 1.0, "on_failure": "continue"}, WAIT)
        if after:
            await robot.clock.sleep(1.0 - after)
            asyncio.get_running_loop().call_later(after, robot.order, MissionOrder.STOP)
        else:
            robot.order(MissionOrder.STOP)
        await robot.clock.sleep(8.0)
        assert robot.order(MissionOrder.START, WAIT) == 2, "it is not in the way of the next one"

    robot = played(story)
    (end,) = [report for report in robot.reports if report.number == 1 and not report.running]
    assert (end.outcome, end.text) == (Reason.CANCELLED, "stopped by ann")


def test_stopped_twice_it_is_not_resumed_after_a_restart(tmp_path: Path):
    file = tmp_path / "mission.json"

    async def story(robot: Pretended) -> None:
        async def slow(work):
            await robot.clock.sleep(0.3)
            return work()

        robot.service._offload = slow
        robot.order(MissionOrder.START, GO, WAIT)
        await robot.clock.sleep(1.0)
        assert file.exists()
        robot.order(MissionOrder.STOP)
        await robot.clock.sleep(0.1)
        with pytest.raises(RequestRefusedError, match="no mission is running"):
            robot.order(MissionOrder.STOP)
        await robot.clock.sleep(1.0)

    played(story, file)
    assert not file.exists()


def test_interrupted_on_its_way_back_it_goes_on_back(tmp_path: Path):
    file = tmp_path / "mission.json"

    async def interrupted(robot: Pretended) -> None:
        robot.reached[0] = Reason.GOAL_UNREACHABLE
        robot.order(MissionOrder.START, {**GO, "on_failure": "return"}, WAIT)
        await robot.clock.sleep(3.0)

    assert played(interrupted, file).goals == [(1.0, 0.0), (5.0, 6.0)]

    async def resumed(robot: Pretended) -> None:
        assert (robot.reports[-1].doing, robot.reports[-1].resumable) == ("return", True)
        assert "on the way back" in robot.reports[-1].text
        robot.order(MissionOrder.RESUME)
        await robot.clock.sleep(8.0)

    robot = played(resumed, file)
    assert robot.goals == [(5.0, 6.0)]
    assert robot.reports[-1].outcome is Reason.GOAL_UNREACHABLE
    assert robot.reports[-1].text.endswith(", back at its start")


def test_stopped_it_cancels_its_goal():
    async def story(robot: Pretended) -> None:
        with pytest.raises(RequestRefusedError, match="no mission"):
            robot.order(MissionOrder.STOP)
        robot.order(MissionOrder.START, GO, WAIT)
        await robot.clock.sleep(1.0)
        robot.order(MissionOrder.STOP)
        await robot.clock.sleep(1.0)

    robot = played(story)
    assert robot.latest["goal"].outcome is Reason.CANCELLED
    assert robot.reports[-1].outcome is Reason.CANCELLED
    assert "ann" in robot.reports[-1].text


def test_who_stops_only_its_own_ends_no_mission_of_others_and_gives_none_up(tmp_path: Path):
    file = tmp_path / "mission.json"
    file.write_text(SavedProgress.of(progress(GO), "ann").model_dump_json())

    async def story(robot: Pretended) -> None:
        with pytest.raises(RequestRefusedError, match="no mission is running"):
            robot.order(MissionOrder.STOP, own=True)
        robot.order(MissionOrder.RESUME)
        await robot.clock.sleep(0.5)
        with pytest.raises(RequestRefusedError, match="the mission of ann is running") as refused:
            robot.order(MissionOrder.STOP, own=True, source="bob")
        assert refused.value.refusal is Reason.NOT_FOUND
        assert robot.reports[-1].running
        robot.order(MissionOrder.STOP, own=True)
        assert not robot.reports[-1].running

    played(story, file)


def test_a_step_that_takes_too_long_has_failed_and_its_goal_is_cancelled():
    async def story(robot: Pretended) -> None:
        robot.order(MissionOrder.START, {**GO, "limit": 1.0, "on_failure": "continue"}, WAIT)
        await robot.clock.sleep(8.0)

    robot = played(story)
    assert robot.reports[-1].outcome is Reason.MISSION_INCOMPLETE
    assert robot.latest["goal"].outcome is Reason.CANCELLED


def test_the_limit_of_a_step_does_not_run_while_its_goal_is_paused():
    async def story(robot: Pretended) -> None:
        robot.order(MissionOrder.START, {**GO, "limit": 3.0, "on_failure": "continue"}, WAIT)
        await robot.clock.sleep(1.0)
        robot.task.cancel()
        robot._say(GoalPhase.PAUSED, Reason.DRIVING)
        await robot.clock.sleep(9.0)
        assert robot.reports[-1].step == 1
        robot._say(GoalPhase.DRIVING, Reason.DRIVING)
        await robot.clock.sleep(3.0)
        assert (robot.reports[-1].step, robot.reports[-1].failed) == (2, "not finished within 3 s")

    played(story)


@pytest.mark.parametrize("reason", [Reason.DISARMED, Reason.ESTOPPED])
def test_a_robot_that_is_disarmed_while_it_waits_ends_it(reason: Reason):
    async def story(robot: Pretended) -> None:
        robot.order(MissionOrder.START, {**WAIT, "seconds": 9.0}, GO, on_failure="continue")
        await robot.clock.sleep(1.0)
        gate = robot.latest["gate"]
        gate.mode, gate.worst, gate.why = SimpleNamespace(active=False), reason, reason.text
        await robot.clock.sleep(1.0)
        gate.mode = SimpleNamespace(active=True)
        await robot.clock.sleep(9.0)

    robot = played(story)
    assert robot.reports[-1].outcome is reason
    assert robot.goals == []


def test_after_a_restart_it_can_be_gone_on_with_at_the_step_that_was_interrupted(tmp_path: Path):
    file = tmp_path / "mission.json"

    async def interrupted(robot: Pretended) -> None:
        with pytest.raises(RequestRefusedError, match="no mission was interrupted"):
            robot.order(MissionOrder.RESUME)
        robot.order(MissionOrder.START, GO, WAIT, {**GO, "x": 7.0}, {"do": "return"})
        await robot.clock.sleep(3.5)

    played(interrupted, file)
    assert json.loads(file.read_text())["stack"][0]["index"] == 1

    async def resumed(robot: Pretended) -> None:
        assert robot.reports[-1].resumable
        assert (robot.reports[-1].step, robot.reports[-1].steps) == (2, 4)
        robot.order(MissionOrder.RESUME)
        await robot.clock.sleep(12.0)

    robot = played(resumed, file)
    assert robot.goals == [(7.0, 0.0), (5.0, 6.0)]
    assert robot.reports[-1].outcome is Reason.MISSION_DONE


def test_just_restarted_it_waits_for_a_pose_and_for_the_planner(tmp_path: Path):
    file = tmp_path / "mission.json"
    file.write_text(SavedProgress.of(progress(GO), "ann").model_dump_json())

    async def story(robot: Pretended) -> None:
        robot.placed = False
        with pytest.raises(RequestRefusedError, match="no pose"):
            robot.order(MissionOrder.RESUME)
        robot.placed = True
        robot.refusals = [RequestRefusedError(Reason.PLANNER_STARTING)] * 3
        robot.order(MissionOrder.RESUME)
        await robot.clock.sleep(6.0)

    robot = played(story, file)
    assert robot.goals == [(1.0, 0.0)]
    assert robot.reports[-1].outcome is Reason.MISSION_DONE
    running = [report for report in robot.reports if report.running]
    assert running[-1].text == ""
    assert Reason.PLANNER_STARTING.text in {report.text for report in running}, "what it waits for is said"


@pytest.mark.parametrize(("code", "reason"), [(errno.ENOSPC, Reason.DISK_FULL), (errno.EIO, Reason.RECORDING_FAILED)])
def test_progress_that_cannot_be_kept_is_named_by_what_the_disk_says(tmp_path: Path, code: int, reason: Reason):
    async def offload(work):
        raise OSError(code, os.strerror(code))

    async def story(robot: Pretended) -> None:
        robot.service._offload = offload
        robot.order(MissionOrder.START, GO)
        await robot.clock.sleep(1.0)

    robot = played(story, tmp_path / "mission.json")
    assert {reason for reason, text in robot.events if "progress not saved" in text} == {reason}


@pytest.mark.parametrize("localised", [False, True])
def test_where_odometry_began_anew_it_does_not_drive_by_places_that_are_elsewhere(tmp_path: Path, localised: bool):
    file = tmp_path / "mission.json"

    async def interrupted(robot: Pretended) -> None:
        robot.order(MissionOrder.START, GO, WAIT)
        robot.latest["pose"].pose = Pose2D(x=5.6, y=6.0, yaw=0.0)
        await robot.clock.sleep(1.0)
        assert json.loads(file.read_text())["at"]["x"] == 5.6, "kept while it drives"
        robot.latest["pose"] = SimpleNamespace(received=robot.clock.now(), pose=Pose2D(x=8.0, y=6.0, yaw=0.0))

    played(interrupted, file)
    assert json.loads(file.read_text())["at"]["x"] == 8.0, "and at the end"

    async def resumed(robot: Pretended) -> None:
        if not localised:
            with pytest.raises(
                RequestRefusedError, match=r"3\.0 m from the one at which round was interrupted.*--moved"
            ):
                robot.order(MissionOrder.RESUME)
        robot.order(MissionOrder.RESUME, moved=not localised)
        await robot.clock.sleep(8.0)

    robot = played(resumed, file, localised=localised)
    assert robot.reports[-1].outcome is Reason.MISSION_DONE


def test_an_interrupted_mission_can_be_given_up(tmp_path: Path):
    file = tmp_path / "mission.json"
    file.write_text(SavedProgress.of(progress(GO), "ann").model_dump_json())

    async def story(robot: Pretended) -> None:
        robot.order(MissionOrder.STOP)
        assert not robot.reports[-1].resumable
        await robot.clock.sleep(0.5)

    robot = played(story, file)
    assert not file.exists()
    assert robot.events[-1] == (Reason.CANCELLED, "round: abandoned by ann")


@pytest.mark.parametrize("latency", [0.0, 0.3])
def test_a_request_is_answered_once_it_outlasts_a_power_cut(tmp_path: Path, latency: float):
    file, begun = tmp_path / "mission.json", []

    async def story(robot: Pretended) -> None:
        async def offload(work):
            begun.append(robot.clock.now())
            await robot.clock.sleep(latency)
            return work()

        robot.service._offload = offload
        await robot.service.kept()
        for _ in range(2):
            robot.order(MissionOrder.START, GO, WAIT)
            await robot.service.kept()
            assert json.loads(file.read_text())["stack"][0]["index"] == 0
            robot.order(MissionOrder.STOP)
            await robot.service.kept()
            assert not file.exists()
        assert robot.clock.now() - begun[0] == pytest.approx(4 * latency * SECOND, abs=0.01 * SECOND)

    played(story, file)


def test_the_next_mission_starts_while_the_disk_still_forgets_the_one_before(tmp_path: Path):
    file = tmp_path / "mission.json"

    async def story(robot: Pretended) -> None:
        async def offload(work):
            await robot.clock.sleep(0.3)
            return work()

        robot.service._offload = offload
        robot.order(MissionOrder.START, {"do": "record", "note": "here"})
        while robot.reports[-1].running:
            await robot.clock.sleep(0.01)
        assert robot.order(MissionOrder.START, WAIT) == 2
        await robot.clock.sleep(1.0)
        assert robot.held == {"missions"}
        assert json.loads(file.read_text())["mission"]["steps"][0]["do"] == "wait"

    played(story, file)


SAVED = SavedProgress.of(progress(GO), "ann").model_dump_json()


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("{", "Invalid JSON"),
        (SAVED.replace('"index":0', '"index":7'), "expected the position of a step"),
        (SAVED.replace('"source"', '"sauce"'), "expected the progress of a mission: source: Field required"),
        (SAVED + " " * 1_000_000, "expected at most 1000000"),
    ],
)
def test_a_damaged_file_is_reported_from_the_loop_and_forgotten(tmp_path: Path, text: str, what: str):
    file, inside, by = tmp_path / "mission.json", [], []
    file.write_text(text)

    async def offload(work):
        inside.append(1)
        try:
            return work()
        finally:
            inside.pop()

    async def main(clock: VirtualClock) -> Pretended:
        robot = Pretended(clock, file, offload=offload)
        robot.service._events = lambda *event, **_: by.append((len(inside), event[0], event[-1]))
        task = asyncio.create_task(robot.service.run(lambda: None))
        await clock.sleep(0.1)
        task.cancel()
        await asyncio.wait([task])
        return robot

    assert not run_virtual(main, start=SECOND).reports[-1].resumable
    ((within, reason, said),) = by
    assert (within, reason) == (0, Reason.FILE_DAMAGED)
    assert str(file) in said
    assert what in said
    assert said.endswith("the file is kept as mission.json.damaged")
    assert (file.parent / "mission.json.damaged").exists()


def test_all_that_the_robot_cannot_do_is_named_before_it_sets_off():
    lacks = "step 2: explore: .* section `explorer` .*; step 3: no behaviour 'left': expected one of wall"

    async def story(robot: Pretended) -> None:
        with pytest.raises(NotFoundError, match=lacks):
            robot.order(MissionOrder.START, GO, {"do": "explore"}, {"do": "behaviour", "name": "left"})
        assert robot.goals == []

    played(story)


def test_settings_that_a_behaviour_does_not_take_are_named_before_it_sets_off():
    wrong, right = ({"do": "behaviour", "name": "wall", "settings": {key: 0.3}} for key in ("distanse", "distance"))

    async def story(robot: Pretended) -> None:
        with pytest.raises(InputError, match=r"^step 2: settings\.distanse: not a setting of wall_pd for one run$"):
            robot.order(MissionOrder.START, GO, wrong)
        with pytest.raises(InputError, match=r"^step 1: settings\.distanse: .*; step 2: no behaviour 'left'"):
            robot.order(MissionOrder.START, wrong, {"do": "follow_wall", "name": "left", "distance": 1.0})
        robot.order(MissionOrder.START, right)
        robot.order(MissionOrder.STOP)
        await robot.clock.sleep(0.5)
        robot.service._parts = replace(robot.service._parts, behaviours=None)
        with pytest.raises(NotFoundError, match=r"^step 1: behaviour: .* section `behaviours` .*$"):
            robot.order(MissionOrder.START, right)
        assert robot.goals == []

    played(story)


def test_a_robot_is_only_said_to_be_disarmed_if_nothing_else_is_in_the_way():
    wrong = {"do": "behaviour", "name": "wall", "settings": {"distanse": 0.3}}

    async def story(robot: Pretended) -> None:
        disarmed = {"mode": SimpleNamespace(active=False), "worst": Reason.DISARMED, "why": Reason.DISARMED.text}
        vars(robot.latest["gate"]).update(disarmed)
        with pytest.raises(InputError):
            robot.order(MissionOrder.START, wrong)
        with pytest.raises(RequestRefusedError) as refused:
            robot.order(MissionOrder.START, GO)
        assert refused.value.refusal is Reason.DISARMED
        robot.placed, robot.latest["pose"] = False, None
        with pytest.raises(RequestRefusedError) as refused:
            robot.order(MissionOrder.START, GO)
        assert refused.value.refusal is Reason.NO_MAP

    played(story)


def test_a_robot_without_points_of_interest_is_not_sent_to_look_for_them():
    async def story(robot: Pretended) -> None:
        robot.service._parts = replace(robot.service._parts, explorer=SimpleNamespace())
        robot.service._in = replace(robot.service._in, points=None)
        with pytest.raises(NotFoundError, match=r"^step 2: explore: .* section `points` .*$"):
            robot.order(MissionOrder.START, {"do": "explore"}, {"do": "explore", "find": 2})

    played(story)


LOW = {"battery_below": 20}


def charge(robot: Pretended, share: float) -> None:
    robot.latest["battery"] = SimpleNamespace(received=robot.clock.now() + 60 * SECOND, charge=share)


def test_a_watch_cancels_the_goal_and_the_interrupted_step_begins_again(tmp_path: Path):
    file, far = tmp_path / "mission.json", {**GO, "x": 9.0}
    patrol = {"do": "parallel", "steps": [GO, far], "watch": [{"when": LOW, "then": [{**GO, "x": 3.0}, WAIT]}]}

    async def interrupted(robot: Pretended) -> None:
        charge(robot, 0.9)
        robot.order(MissionOrder.START, patrol)
        await robot.clock.sleep(3.0)
        assert robot.goals == [(1.0, 0.0), (9.0, 0.0)]
        charge(robot, 0.1)
        await robot.clock.sleep(0.5)
        assert robot.goals[2:] == [(3.0, 0.0)]
        assert robot.reports[-1].node == "1.watch1.1"
        assert [line.number for line in robot.reports[-1].lines if line.active] == ["1", "1.watch1", "1.watch1.1"]

    played(interrupted, file)

    async def resumed(robot: Pretended) -> None:
        charge(robot, 0.1)
        assert robot.reports[-1].text == "interrupted at step 1.watch1.1"
        robot.order(MissionOrder.RESUME)
        await robot.clock.sleep(10.0)

    robot = played(resumed, file)
    assert robot.goals == [(3.0, 0.0), (9.0, 0.0)]
    assert robot.reports[-1].outcome is Reason.MISSION_DONE


def test_the_limit_of_an_outer_step_cancels_what_runs():
    steps = [{"do": "fallback", "steps": [{"do": "sequence", "limit": 3.5, "steps": [WAIT, GO]}, {**GO, "x": 7.0}]}]

    async def story(robot: Pretended) -> None:
        robot.order(MissionOrder.START, *steps)
        await robot.clock.sleep(4.0)
        assert robot.goals == [(1.0, 0.0), (7.0, 0.0)]
        await robot.clock.sleep(4.0)

    robot = played(story)
    assert robot.reports[-1].outcome is Reason.MISSION_DONE
    assert (Reason.TIMEOUT, "step 1.1.2 of 1: goto 1 0 0: not finished within 3.5 s") in robot.events


@pytest.mark.parametrize(("change", "reason"), [("points", Reason.MISSION_DONE), ("gate", Reason.DISARMED)])
def test_it_waits_until_a_condition_holds_unless_it_is_disarmed(change: str, reason: Reason):
    async def story(robot: Pretended) -> None:
        robot.latest["points"] = SimpleNamespace(points=())
        robot.order(MissionOrder.START, {"do": "wait_until", "when": {"point": "dock", "after": 1.0}}, GO)
        await robot.clock.sleep(3.0)
        assert robot.goals == []
        if change == "gate":
            vars(robot.latest["gate"]).update(mode=SimpleNamespace(active=False), worst=Reason.DISARMED, why="disarmed")
        else:
            robot.latest["points"] = SimpleNamespace(points=(SimpleNamespace(name="dock", kind=PointKind.MARK),))
        await robot.clock.sleep(4.0)

    assert played(story).reports[-1].outcome is reason


def test_an_obstacle_that_stays_is_a_condition():
    watch = {"when": {"obstacle": 2.0}, "then": [{**GO, "x": 3.0}], "after": "end"}

    async def story(robot: Pretended) -> None:
        robot.order(
            MissionOrder.START, {"do": "parallel", "steps": [{"do": "wait", "seconds": 60.0}], "watch": [watch]}
        )
        for reasons, seconds in (((Reason.OBSTACLE_STOP,), 1.5), ((), 1.0), ((Reason.OBSTACLE_STOP,), 1.5)):
            robot.latest["gate"].reasons = reasons
            await robot.clock.sleep(seconds)
        assert robot.goals == []
        await robot.clock.sleep(1.0)
        assert robot.goals == [(3.0, 0.0)]
        await robot.clock.sleep(3.0)

    assert played(story).reports[-1].outcome is Reason.MISSION_DONE


def test_a_zone_that_the_robot_enters_is_a_condition():
    watch = {"when": {"zone": "stairs"}, "then": [{**GO, "x": 3.0}], "after": "end"}

    async def story(robot: Pretended) -> None:
        robot.order(
            MissionOrder.START, {"do": "parallel", "steps": [{"do": "wait", "seconds": 60.0}], "watch": [watch]}
        )
        await robot.clock.sleep(1.0)
        assert robot.goals == []
        robot.latest["zones"] = SimpleNamespace(inside=("ramp", "stairs"))
        await robot.clock.sleep(1.0)
        assert robot.goals == [(3.0, 0.0)]
        await robot.clock.sleep(3.0)

    assert played(story).reports[-1].outcome is Reason.MISSION_DONE


def test_a_loop_whose_steps_take_no_time_leaves_the_loop_to_others():
    note = {"do": "record", "note": "again"}

    async def story(robot: Pretended) -> None:
        robot.order(MissionOrder.START, {"do": "repeat", "times": 6, "steps": [note]})
        await robot.clock.sleep(2.0)
        noted = [reason for reason, _ in robot.events if reason is Reason.MISSION_NOTE]
        assert len(noted) == 6
        assert robot.reports[-1].outcome is Reason.MISSION_DONE
        with pytest.raises(InputError, match=r"step 1: a loop without exit: no step in it takes time"):
            robot.order(MissionOrder.START, {"do": "repeat", "times": "forever", "steps": [note]})

    played(story)


def test_a_restart_does_not_decide_a_branch_again(tmp_path: Path):
    file = tmp_path / "mission.json"

    async def interrupted(robot: Pretended) -> None:
        charge(robot, 0.1)
        robot.order(MissionOrder.START, {"do": "branch", "when": LOW, "then": [GO], "otherwise": [WAIT]})
        await robot.clock.sleep(1.0)
        assert len(json.loads(file.read_text())["stack"]) == 2, "also if it is killed now"

    played(interrupted, file)

    async def resumed(robot: Pretended) -> None:
        charge(robot, 0.9)
        robot.order(MissionOrder.RESUME)
        await robot.clock.sleep(3.0)

    assert played(resumed, file).goals == [(1.0, 0.0)]
