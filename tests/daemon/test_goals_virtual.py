"""Goals of the whole daemon on the virtual clock: reached, refused, cancelled, paused."""

import asyncio
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from monstertruck_planners.track.paths import load_path
from monstertruck_runtime.drives import drive_to, follow
from monstertruck_runtime.errors import RequestRefusedError
from monstertruck_schemas import topics
from monstertruck_schemas.plan import Path as DrivePath
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import DriveRequest, GoalOrder, GoalRequest, PathRequest, Role
from monstertruckd.tools.simulation.operator import LocalOperator
from tests.daemon.goal_kit import Trip, assert_at, own_path, travel

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(300)]


@pytest.mark.parametrize(
    ("goal", "least", "most"),
    [
        ((1.9, 3.95, 0.0), 0.85, 1.0),
        pytest.param((2.4, 1.5, -1.57), 3.0, 3.6, marks=pytest.mark.long, id="in another room"),
    ],
)
def test_a_goal_is_reached(goal: tuple[float, float, float], least: float, most: float):
    async def story(trip: Trip) -> None:
        answer = await trip.goal(*goal)
        assert answer["planned"]
        assert least < answer["length"] < most
        await trip.arm()
        state = await trip.end()
        assert (state.outcome, state.number, state.source) == (Reason.GOAL_REACHED, 1, "tester")
        assert trip.reasons() == [Reason.GOAL_ACCEPTED, Reason.ROUTE_FOUND, Reason.GOAL_REACHED]

    assert_at(travel(story), *goal)


@pytest.mark.long
def test_waypoints_are_passed_in_their_order_asked_for_by_call_or_by_topic():
    async def story(trip: Trip) -> None:
        answer = await trip.goal(3.5, 3.9, 0.0, via=[(2.4, 1.6), (2.4, 3.8, 1.57)])
        assert 5.0 < answer["length"] < 8.0
        assert trip.states.latest is not None
        assert trip.states.latest.waypoints == 2
        await trip.arm()
        state = await trip.end()
        assert (state.outcome, state.waypoints) == (Reason.GOAL_REACHED, 0)
        assert trip.reasons().count(Reason.WAYPOINT_PASSED) == 2
        goal = {**trip.header(), "goal": {"x": 5.0, "y": 3.9, "yaw": 0.0}, "waypoints": [{"x": 4.2, "y": 3.5}]}
        trip.rig.bus.inject(topics.REQ_GOAL, GoalRequest.model_validate_json(json.dumps(goal)))
        assert (await trip.end()).outcome is Reason.GOAL_REACHED
        assert trip.reasons().count(Reason.WAYPOINT_PASSED) == 1
        with pytest.raises(RequestRefusedError, match="waypoint 1 of 1: goal") as refused:
            await trip.goal(6.0, 3.9, 0.0, via=[(4.7, 2.5)])
        assert refused.value.refusal is Reason.GOAL_BLOCKED

    rig = travel(story)
    assert_at(rig, 5.0, 3.9, 0.0)
    truth = rig.truth.array()
    assert np.hypot(truth[:, 1] - 2.4, truth[:, 2] - 1.6).min() < 0.05
    assert np.hypot(truth[:, 1] - 4.2, truth[:, 2] - 3.5).min() < 0.05


def test_bad_goals_are_refused_with_the_reason_and_nothing_moves():
    async def story(trip: Trip) -> None:
        for goal, reason in (
            ((4.7, 2.5, 0.0), Reason.GOAL_BLOCKED),
            ((20.0, 1.0, 0.0), Reason.GOAL_OUTSIDE),
            ((math.nan, 1.0, 0.0), Reason.NOT_FINITE),
        ):
            with pytest.raises(RequestRefusedError) as refused:
                await trip.goal(*goal)
            assert refused.value.refusal is reason
        with pytest.raises(RequestRefusedError) as refused:
            await trip.rig.daemon.rpc.call(
                "goal", {**trip.header(), "nonce": "another", "goal": {"x": 4.0, "y": 3.9, "yaw": 0.0}}
            )
        assert refused.value.refusal is Reason.BAD_NONCE
        with pytest.raises(RequestRefusedError, match="goal in frame 'base': expected 'odom' or 'map'") as refused:
            await trip.rig.daemon.rpc.call(
                "goal", {**trip.header(), "frame": "base", "goal": {"x": 4.0, "y": 3.9, "yaw": 0.0}}
            )
        assert refused.value.refusal is Reason.BAD_INPUT
        with pytest.raises(RequestRefusedError) as refused:
            await trip.order("cancel")
        assert refused.value.refusal is Reason.NOT_FOUND

    assert_at(travel(story), 1.0, 3.95, 0.0)


def test_cancel_stops_and_pause_interrupts():
    async def story(trip: Trip) -> None:
        truth = trip.rig.truth
        await trip.goal(6.0, 3.9, 0.0)
        await trip.arm()
        await trip.clock.sleep(4.0)
        await trip.order("cancel")
        assert (await trip.end()).outcome is Reason.CANCELLED
        await trip.clock.sleep(2.0)
        stopped = truth.array()[-1]
        assert 1.2 < stopped[1] < 2.0
        await trip.arm()
        await trip.clock.sleep(3.0)
        assert math.dist(truth.array()[-1][1:3], stopped[1:3]) < 0.01, "no goal, no motion"

        await trip.goal(2.6, 3.9, 0.0)
        await trip.arm()
        await trip.clock.sleep(3.0)
        await trip.order("pause")
        await trip.clock.sleep(2.0)
        paused = truth.array()[-1]
        await trip.clock.sleep(2.0)
        assert math.dist(truth.array()[-1][1:3], paused[1:3]) < 0.01
        await trip.order("resume")
        await trip.arm()
        assert (await trip.end()).outcome is Reason.GOAL_REACHED
        assert {Reason.PAUSED, Reason.RESUMED, Reason.CANCELLED} <= set(trip.reasons())

    assert_at(travel(story), 2.6, 3.9, 0.0)


class LocalDriver(LocalOperator):
    """What a client is to the commands, inside the daemon's process."""

    source = "operator"

    def __init__(self, trip: Trip) -> None:
        super().__init__(trip.rig.daemon, trip.clock)
        self._trip = trip

    async def get_retained(self, topic: Any) -> Any:
        return self._trip.rig.bus.newest(topic)

    async def goal(
        self, goal: tuple[float, float, float], frame: str = "map", via: Sequence[tuple[float, ...]] = ()
    ) -> dict[str, Any]:
        return await self._trip.goal(*goal, via=via)

    async def goal_control(self, order: GoalOrder, *, own: bool = False) -> None:
        await self._trip.order(order)

    async def path(self, path: DrivePath, lease: float = 1.0) -> None:
        header = self._trip.header()
        request = PathRequest.model_validate({**header, "role": Role.STATION, "source": self.source, "path": path})
        self._trip.rig.bus.inject(topics.REQ_PATH, request)


def test_the_commands_follow_a_goal_and_a_path_and_tell_how_they_end(tmp_path: Path):
    file = tmp_path / "straight.csv"
    file.write_text("x,y,yaw,direction\n" + "".join(f"{x / 10:.1f},3.95,0.0,1\n" for x in range(10, 17)))

    async def story(trip: Trip) -> None:
        driver = LocalDriver(trip)
        arrival = await follow(driver, trip.clock, load_path(file, closed=False, frame="odom"), arm=True)
        assert arrival.reason is Reason.GOAL_REACHED
        assert arrival.length == pytest.approx(0.6)
        arrival = await drive_to(driver, trip.clock, (2.1, 3.9, 0.0), arm=True)
        assert (arrival.reason, arrival.routes, arrival.recoveries) == (Reason.GOAL_REACHED, 1, 0)
        assert (
            await drive_to(driver, trip.clock, (3.3, 3.9, 0.0), [(2.7, 3.85)], arm=True)
        ).reason is Reason.GOAL_REACHED
        assert Reason.WAYPOINT_PASSED in trip.reasons()
        with pytest.raises(RequestRefusedError, match="outside the map"):
            await drive_to(driver, trip.clock, (30.0, 3.9, 0.0), arm=True)
        trip.states.drain()
        driving = asyncio.create_task(drive_to(driver, trip.clock, (8.5, 3.9, 0.0), arm=True))
        await trip.clock.sleep(2.0)
        driving.cancel()
        await asyncio.wait([driving])
        assert (await trip.end()).outcome is Reason.CANCELLED

    assert not travel(story).truth.array()[:, 5].any()


def test_of_a_goal_that_was_cancelled_nothing_is_driven_by_whoever_arms_later():
    """Driven back by hand, it drove to where it had come to rest as soon as it was armed."""
    at: list[float] = []

    async def story(trip: Trip) -> None:
        hand = LocalOperator(trip.rig.daemon, trip.clock, "hand", Role.GAMEPAD)
        await trip.goal(6.0, 3.9, 0.0)
        await trip.arm()
        await trip.clock.sleep(5.0)
        await trip.order("cancel")
        await trip.clock.sleep(3.0)
        await hand.arm()
        for speed in (-0.12,) * 50 + (0.0,) * 10:
            request = DriveRequest(**await hand.header(0.25), speed=speed, front=0.0)
            trip.rig.bus.inject(topics.REQ_DRIVE, request)
            await trip.clock.sleep(0.05)
        await trip.clock.sleep(3.0)
        at.append(trip.rig.truth.array()[-1, 1])
        await hand.arm()
        await trip.clock.sleep(3.0)

    rig = travel(story)
    assert abs(rig.truth.array()[-1, 1] - at[0]) < 0.005


def test_a_goal_ends_the_path_that_is_followed_whether_it_is_refused_or_not(tmp_path: Path):
    file = own_path(tmp_path)

    async def story(trip: Trip) -> None:
        await trip.arm()
        await trip.clock.sleep(2.0)
        with pytest.raises(RequestRefusedError):
            await trip.goal(4.7, 2.5, 0.0)
        await trip.clock.sleep(4.0)
        assert 1.1 < trip.rig.truth.array()[-1, 1] < 1.5
        path = load_path(file, closed=False, frame="odom")
        await trip.goal(4.0, 3.9, 0.0)
        await LocalDriver(trip).path(path)
        await trip.clock.sleep(1.0)
        assert (await trip.end()).outcome is Reason.GOAL_BLOCKED
        assert (await trip.end()).text == "the tracker follows another path"
        await trip.goal(1.8, 3.9, 0.0)
        await trip.arm()
        assert (await trip.end()).outcome is Reason.GOAL_REACHED

    assert_at(travel(story, path={"file": file, "closed": False}), 1.8, 3.9, 0.0)


@pytest.mark.parametrize("closed", [False, True])
def test_of_a_path_whose_command_has_ended_nothing_is_driven_by_whoever_arms_later(closed: bool):
    """Interrupted before its end it was resumed, and a lap that was done was driven once more."""
    round_trip = [(1.0, 3.95), (1.3, 3.95)] if closed else [(1.0, 3.95), (4.0, 3.95)]
    poses = np.array([(*place, 0.0) for place in round_trip]).ravel()
    directions = np.array([-1.0, 1.0] if closed else [1.0, 1.0])
    path = DrivePath(stamp=0, received=0, seq=0, frame="odom", poses=poses, directions=directions, closed=closed)
    at: list[float] = []

    async def story(trip: Trip) -> None:
        driving = asyncio.create_task(follow(LocalDriver(trip), trip.clock, path, arm=True))
        if closed:
            assert (await driving).reason is Reason.GOAL_REACHED
        else:
            await trip.clock.sleep(5.0)
            driving.cancel()
            await asyncio.wait([driving])
        await trip.clock.sleep(4.0)
        at.append(trip.rig.truth.array()[-1, 1])
        await trip.arm()
        await trip.clock.sleep(4.0)

    truth = travel(story).truth.array()
    assert truth[:, 1].max() > 1.25, "it was driven"
    assert abs(truth[-1, 1] - at[0]) < 0.005


def test_an_emergency_stop_ends_a_goal():
    """Reset and armed by somebody else, it drove on."""
    at: list[float] = []

    async def story(trip: Trip) -> None:
        await trip.goal(6.0, 3.9, 0.0)
        await trip.arm()
        await trip.clock.sleep(3.0)
        await trip.operator.estop()
        assert (await trip.end()).outcome is Reason.ESTOPPED
        with pytest.raises(RequestRefusedError) as refused:
            await trip.goal(6.0, 3.9, 0.0)
        assert refused.value.refusal is Reason.ESTOPPED
        await trip.clock.sleep(2.0)
        at.append(trip.rig.truth.array()[-1, 1])
        await trip.operator.reset()
        await trip.arm()
        await trip.clock.sleep(3.0)

    assert abs(travel(story).truth.array()[-1, 1] - at[0]) < 0.005


@pytest.mark.long
@pytest.mark.parametrize("where", ["worker"])
def test_planner_and_tracker_drive_the_same_from_wherever_they_are_placed(where: str):
    async def story(trip: Trip) -> None:
        await trip.goal(1.8, 3.8, 0.2)
        await trip.arm()
        assert (await trip.end()).outcome is Reason.GOAL_REACHED

    here = travel(story).truth.array()
    there = travel(story, placement={"planner": where, "local_planner": where, "tracker": where}).truth.array()
    assert here.shape == there.shape
    assert np.abs(here - there).max() < 1e-9
