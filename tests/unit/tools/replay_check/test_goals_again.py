"""Goals, routes and their deformation computed again."""

import asyncio
import json
from dataclasses import replace

import pytest
from typer.testing import CliRunner

from monstertruck_estimation.points.config import PointsConfig
from monstertruck_runtime import wire
from monstertruck_runtime.clock import VirtualLoop
from monstertruck_schemas import topics
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.roles import ServiceName
from monstertruckd.recorder.reader import LogMessage, open_log
from monstertruckd.tools.cli.main import app
from monstertruckd.tools.replay_check import check_log
from monstertruckd.tools.replay_check.chain import Chain
from monstertruckd.tools.replay_check.comparison import Kind
from monstertruckd.tools.replay_check.pace import Pace, PacedClock
from monstertruckd.tools.replay_check.recorded import RunLog, recorded_config, survey
from monstertruckd.tools.replay_check.result import ROUND_OFF
from tests.unit.tools.replay_check.log_surgery import (
    BY_NAME,
    GOALS,
    attachments_of,
    changed,
    computed_again,
    digit,
    flip,
    write,
)

pytestmark = pytest.mark.timeout(120)


def rows_of(check):
    return {row.topic: row for row in check.topics}


def another(tmp_path, change):
    """The log's own configuration with ``change`` done to it, as a file."""
    config = attachments_of(GOALS)["config.json"]
    del config["sim"]
    change(config)
    file = tmp_path / "other.yaml"
    file.write_text(json.dumps(config))
    return file


def test_the_stored_run_has_all_there_is_to_compute():
    paths = [entry.decode() for entry in open_log(GOALS) if entry.topic == "plan/path"]
    kinds = {path.name.rpartition(".")[0] for path in paths}
    assert {"goal-1", "goal-1-deformed", "halt-1", "goal-2"} <= kinds
    asked = [entry for entry in open_log(GOALS) if entry.topic == "req/goal"]
    assert len(asked) == 1  # and the other one by remote call
    assert GOALS.stat().st_size < 600_000


class NotedTurns(Pace):
    def __init__(self, name, turns):
        super().__init__()
        self.name, self.turns = name, turns

    async def release(self, instant):
        self.turns.append(self.name)


def test_ground_is_given_as_recorded_no_pictures_are_read_and_silent_ticks_have_their_turn():
    log = RunLog(GOALS)
    config = recorded_config(GOALS, log.first.attachments()).model_copy(update={"points": PointsConfig()})
    assert config.ground is not None, "it was computed when the log was recorded"
    found = survey(log)

    async def main(clock):
        chain = Chain(config, clock, (), found)
        assert chain.takes(topics.GROUND.name)
        assert {service.name for service in chain._services}.isdisjoint({ServiceName.GROUND, ServiceName.POINTS})

        # Ticks of several services recorded in a row, and between them one that left nothing.
        chain = Chain(config, clock, [(found.start + 20, "goals")], found)
        turns = []
        chain._paces = {name: NotedTurns(name, turns) for name in chain._paces}
        rows = [(topics.ODOMETRY, 10), (topics.TRACKER, 20), (topics.ODOMETRY, 30)]
        await chain.tick([LogMessage(t.name, found.start + at, found.start + at, 9, b"", "") for t, at in rows])
        assert turns == ["odometry", "goals", "tracker", "odometry"]

    with asyncio.Runner(loop_factory=lambda: VirtualLoop(found.start)) as runner:
        runner.run(main(PacedClock(runner.get_loop())))


def test_a_flipped_byte_of_a_request_is_found(tmp_path):
    check = computed_again(changed(GOALS, tmp_path / "flipped.mcap", flip("req/goal", 0, digit("x", 1))))
    assert check.reason is Reason.REPLAY_DIFFERS
    assert check.first.topic == "plan/goal"
    assert check.first.fields == ("goal",)
    rows = rows_of(check)
    assert rows[topics.POSE].differing == 0
    assert rows[topics.PATH].first.sequence == 0
    assert rows[topics.PATH].greatest[Kind.LENGTH].value == pytest.approx(0.1, abs=0.1)


@pytest.mark.long
def test_a_flipped_byte_of_a_scan_is_found_by_what_was_planned_on_its_map(tmp_path):
    def byte_of_a_range(payload):
        scan = wire.decode(topics.SCAN, payload)
        value = next(r for r in scan.ranges if 0.5 < r < 3.0)
        return payload.index(value.tobytes()) + 6

    check = computed_again(changed(GOALS, tmp_path / "flipped.mcap", flip("sensor/scan", 4, byte_of_a_range)))
    assert check.reason is Reason.REPLAY_DIFFERS
    assert check.first.topic in {"health/slam", "state/scan_motion", "state/map", "state/pose"}


def moved(name, by):
    """Poses of the path ``name`` as it was driven, moved aside."""

    def change(one):
        if one.topic != "plan/path" or (path := one.decode()).name != name:
            return one
        poses = path.poses.copy()
        poses[1::3] += by
        return replace(one, payload=wire.encode(topics.PATH, path.model_copy(update={"poses": poses})))

    return change


def test_a_changed_route_is_found_and_driven_on(tmp_path):
    check = computed_again(changed(GOALS, tmp_path / "moved.mcap", moved("goal-2.5", 0.0001)))
    rows = rows_of(check)
    row = rows[topics.PATH]
    assert (row.missing, row.surplus(check.end), row.first.sequence) == (0, 0, 4)
    assert row.greatest[Kind.LENGTH].value >= 0.9e-4
    before = [entry for entry in open_log(GOALS) if entry.topic == "plan/tracker" and entry.decode().path == "goal-2.5"]
    assert rows[topics.TRACKER].first.sequence == before[0].sequence
    assert rows[topics.TRACKER].greatest[Kind.LENGTH].value == pytest.approx(1e-4, rel=0.2)


@pytest.mark.long
def test_routes_of_another_planner_are_held_against_those_that_were_driven(tmp_path):
    def two_axles(config):
        config["planner"]["route"] |= {"swing_cost": 2.0, "crab_cost": 20.0}

    check = computed_again(GOALS, another(tmp_path, two_axles))
    rows = rows_of(check)
    assert check.reason is Reason.OK
    path = rows[topics.PATH]
    assert (path.missing, path.surplus(check.end)) == (0, 0)
    assert path.greatest[Kind.LENGTH].value > 0.001
    assert rows[topics.POSE].differing == 0
    goal = rows[topics.GOAL].first
    assert goal is None or set(goal.fields) <= {"remaining", "outcome", "text"}, "of another route"


@pytest.mark.long
def test_another_deformation_shows_where_it_begins(tmp_path):
    def closer(config):
        config["planner"]["local"]["clearance"] = 0.02

    check = computed_again(GOALS, another(tmp_path, closer))
    rows = rows_of(check)
    assert not check.agrees
    assert rows[topics.POSE].differing == 0
    assert rows[topics.PATH].first.sequence > 0  # the routes are the same, but nothing comes into their way


def late(one):
    """A message as a daemon on the wall clock would have stamped it, in the middle of its tick."""
    message = one.decode() if one.topic in {"plan/goal", "plan/drive"} else None
    if message is None or (one.topic == "plan/drive" and message.source != "goals"):
        return one
    by = 200_000 if one.topic == "plan/goal" else 250_000
    later = {"stamp": message.stamp + by, "received": message.received + by}
    payload = wire.encode(BY_NAME[one.topic], message.model_copy(update=later))
    return replace(one, log_time=one.log_time + 300_000, stamp=later["stamp"], payload=payload)


@pytest.mark.long
def test_a_run_of_the_wall_clock_has_several_stamps_in_a_tick(tmp_path):
    messages = [late(one) for one in open_log(GOALS)]
    log = write(tmp_path / "wall.mcap", messages, attachments_of(GOALS), real_offset_ns="7")
    check = check_log(log)
    rows = rows_of(check)
    assert rows[topics.PLAN_DRIVE].headers > 0
    assert check.reason is Reason.OK
    assert not rows[topics.GOAL].judged
    assert rows[topics.TRACKER].tolerance == rows[topics.PLAN_DRIVE].tolerance == 0.02
    for topic in (topics.GOAL, topics.PATH, topics.TRACKER):
        row = rows[topic]
        assert row.compared > 0
        assert row.missing == row.surplus(check.end) == 0
    assert all(one.value <= ROUND_OFF for one in rows[topics.PATH].greatest.values())  # stamps alone


@pytest.mark.long
def test_last_digits_of_a_run_of_the_wall_clock_are_reported_as_such(tmp_path):
    def nudged(one):
        if (one.topic, one.sequence) != ("state/odometry", 100):
            return one
        odometry = one.decode()
        pose = odometry.pose.model_copy(update={"x": odometry.pose.x + 1e-9})
        return replace(one, payload=wire.encode(topics.ODOMETRY, odometry.model_copy(update={"pose": pose})))

    messages = [nudged(late(one)) for one in open_log(GOALS)]
    check = check_log(write(tmp_path / "wall.mcap", messages, attachments_of(GOALS), real_offset_ns="7"))
    assert not check.agrees
    assert check.rounded
    assert check.sufficient == 0.02
    assert check_log(check.log, tolerance=check.sufficient).agrees


def test_a_lost_call_ends_in_other_reports_not_in_a_hang(tmp_path):
    def silent(one):
        return None if one.topic == "req/goal" else one

    check = computed_again(changed(GOALS, tmp_path / "silent.mcap", silent))
    assert check.agrees  # what did not come by topic must have come by remote call


def test_a_configuration_without_a_planner_leaves_it_out(tmp_path):
    file = another(tmp_path, lambda config: config.update(planner=None))
    check = computed_again(GOALS, file)
    assert check.left_out == "only one of the two configurations has a planner"
    assert not {topics.GOAL, topics.PATH, topics.TRACKER, topics.PLAN_DRIVE} & rows_of(check).keys()
    done = CliRunner().invoke(app, ["replay", str(GOALS), "--check", "--config", str(file)])
    assert "goals and tracker are not recomputed: only one of" in done.output.replace("\n", " ")


def own_config(**changes):
    config = attachments_of(GOALS)["config.json"]
    config["planner"] |= changes.pop("planner", {})
    return {"config.json": config | changes}


def test_a_map_that_is_gone_leaves_the_planner_out(tmp_path):
    config = own_config(slam=None, planner={"map": str(tmp_path / "hall.yaml")})
    check = computed_again(changed(GOALS, tmp_path / "log.mcap", **config))
    assert "hall.yaml: no such file, and the log does not contain it" in check.left_out
    assert check.figures()["left_out"] == check.left_out


@pytest.mark.long
def test_a_log_without_reports_leaves_the_planner_out(tmp_path):
    check = computed_again(changed(GOALS, tmp_path / "log.mcap", lambda one: None if one.topic == "plan/goal" else one))
    assert check.left_out == "the log contains no state of goals"
    assert check.agrees


def test_waypoints_of_a_remote_call_leave_the_planner_out(tmp_path):
    def counted(one):
        if one.topic != "plan/goal" or one.decode().number != 2:
            return one
        return replace(one, payload=wire.encode(topics.GOAL, one.decode().model_copy(update={"waypoints": 1})))

    check = computed_again(changed(GOALS, tmp_path / "log.mcap", counted))
    assert check.left_out == "waypoints came by remote call, which logs do not contain"
