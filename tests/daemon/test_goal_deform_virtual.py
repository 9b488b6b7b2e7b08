"""The route under deformation, in the whole daemon: what is put onto it is passed, or there is another way, or none."""

import itertools

import numpy as np
import pytest

from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_sim.world.obstacles import Box
from tests.daemon.goal_kit import Trip, assert_at, travel

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(300)]


async def surprise(trip: Trip, ahead: float, aside: float, size: float) -> None:
    """Put a box before the driving truck, m."""
    now = trip.clock.now()
    truth = trip.rig.world.truth(now)
    trip.rig.world.add(now, Box(truth.x + ahead, truth.y + aside, size, size))


@pytest.mark.parametrize("kind", ["rsband", pytest.param("teb", marks=pytest.mark.long)])
def test_a_box_put_onto_the_route_is_passed_by_deformation(kind: str):
    async def story(trip: Trip) -> None:
        await trip.goal(4.4, 3.9, 0.0)
        await trip.arm()
        await trip.clock.sleep(3.0)
        await surprise(trip, 1.3, 0.05, 0.25)
        state = await trip.end()
        assert (state.outcome, state.recoveries) == (Reason.GOAL_REACHED, 0)
        reasons = trip.reasons()
        assert reasons[:3] == [Reason.GOAL_ACCEPTED, Reason.ROUTE_FOUND, Reason.ROUTE_DEFORMED]
        assert (Reason.ROUTE_FREE in reasons) or kind == "teb", "whose band need not come back"
        assert Reason.PATH_BLOCKED not in reasons

    rig = travel(story, planner={"local_planner": {"kind": kind}})
    assert_at(rig, 4.4, 3.9, 0.0)
    assert np.ptp(rig.truth.array()[:, 2]) > 0.2, "it went round"


@pytest.mark.long
def test_without_a_deformer_the_route_is_planned_anew():
    async def story(trip: Trip) -> None:
        await trip.goal(6.0, 3.9, 0.0)
        await trip.arm()
        await trip.clock.sleep(5.0)
        await surprise(trip, 1.3, 0.05, 0.25)
        assert (await trip.end()).outcome is Reason.GOAL_REACHED
        reasons = trip.reasons()
        assert Reason.PATH_BLOCKED in reasons
        assert Reason.ROUTE_DEFORMED not in reasons

    assert_at(travel(story, planner={"local_planner": None}), 6.0, 3.9, 0.0)


@pytest.mark.long
def test_where_the_hall_is_blocked_the_truck_takes_the_way_through_the_rooms():
    async def story(trip: Trip) -> None:
        await trip.goal(7.0, 3.9, 0.0)
        await trip.arm()
        await trip.clock.sleep(4.0)
        trip.rig.world.add(trip.clock.now(), Box(4.5, 3.95, 0.1, 1.55))
        assert (await trip.end(250.0)).outcome is Reason.GOAL_REACHED
        assert Reason.PATH_BLOCKED in trip.reasons()

    rig = travel(story)
    assert_at(rig, 7.0, 3.9, 0.0)
    assert rig.truth.array()[:, 2].max() > 5.5


@pytest.mark.long
def test_where_all_ways_are_blocked_the_recovery_behaviours_are_tried_to_the_last():
    async def story(trip: Trip) -> None:
        world, now = trip.rig.world, trip.clock.now
        world.add(now(), Box(5.5, 6.65, 0.1, 1.0))
        await trip.goal(7.0, 3.9, 0.0)
        await trip.arm()
        await trip.clock.sleep(4.0)
        world.add(now(), Box(4.5, 3.95, 0.1, 1.55))
        state = await trip.end(300.0)
        assert state.outcome is Reason.GOAL_UNREACHABLE
        assert state.text
        events = trip.events.drain()
        assert not [event for event in events if event.reason in (Reason.BUSY, Reason.DISARMED)]
        reported = [event for event in events if event.source == "goals"]
        behaviours = [event.text.rpartition(": ")[2] for event in reported if event.reason is Reason.RECOVERING]
        tried = [behaviour for behaviour, _ in itertools.groupby(behaviours) if "backs out" not in behaviour]
        assert tried == ["clear", "back out", "wait", "replan"]
        assert reported[-1].severity is Severity.WARNING

    assert not travel(story).truth.array()[:, 5].any(), "collided"


@pytest.mark.long
def test_the_way_to_the_next_goal_does_not_back_into_what_was_seen_on_the_way_to_the_last():
    async def story(trip: Trip) -> None:
        await trip.goal(3.0, 6.0, 1.5)
        await trip.arm()
        async with trip.clock.deadline(60.0):
            while trip.rig.world.truth(trip.clock.now()).y < 4.94:
                await trip.clock.sleep(0.1)
        trip.rig.world.add(trip.clock.now(), Box(2.58, 5.83, 0.12, 0.12))
        assert (await trip.end()).outcome is Reason.GOAL_REACHED
        await trip.goal(2.0, 2.0, -1.5)
        await trip.arm()
        await trip.clock.sleep(20.0)
        assert trip.reasons()

    assert not travel(story).truth.array()[:, 5].any(), "collided"


@pytest.mark.long
def test_the_published_set_up_comes_near_its_goal_and_touches_nothing():
    """The yardstick keeps its published faults: at the goal it drives to and fro."""

    async def story(trip: Trip) -> None:
        await trip.goal(5.0, 3.9, 0.0)
        await trip.arm()
        await trip.clock.sleep(40.0)
        assert trip.reasons()[:2] == [Reason.GOAL_ACCEPTED, Reason.ROUTE_FOUND]

    truth = travel(story, base="as-published.yaml").truth.array()
    assert not truth[:, 5].any(), "collided"
    assert np.hypot(truth[:, 1] - 5.0, truth[:, 2] - 3.9).min() < 0.25
