"""Goals by every route planner: reached over waypoints, by the whole daemon on the virtual clock."""

import numpy as np
import pytest

from monstertruck_planners.route.catalog import ROUTE_PLANNERS
from monstertruck_runtime.errors import RequestRefusedError
from monstertruck_schemas.reasons import Reason
from tests.daemon.goal_kit import Trip, assert_at, travel

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(300)]

LOCAL = {"lattice": None, "grid_astar": {"kind": "rsband"}}
"""Local planner of each; routes over a grid are driven by one only."""


def settings(kind: str, deform: object) -> dict[str, object]:
    return {"route": {"kind": kind, "effort": 3000, "margin": 0.04, "unknown": "blocked"}, "local_planner": deform}


def test_all_kinds_are_tried():
    assert {*LOCAL, "hybrid"} == set(ROUTE_PLANNERS)


@pytest.mark.long
@pytest.mark.parametrize("kind", LOCAL)
def test_a_goal_is_reached_over_a_waypoint(kind: str):
    async def story(trip: Trip) -> None:
        answer = await trip.goal(5.0, 3.9, 0.0, via=[(3.0, 3.6)])
        assert 3.9 < answer["length"] < 5.0
        await trip.arm()
        state = await trip.end()
        assert (state.outcome, state.waypoints) == (Reason.GOAL_REACHED, 0)
        assert trip.reasons().count(Reason.WAYPOINT_PASSED) == 1

    rig = travel(story, planner=settings(kind, LOCAL[kind]))
    assert_at(rig, 5.0, 3.9, 0.0)
    truth = rig.truth.array()
    assert np.hypot(truth[:, 1] - 3.0, truth[:, 2] - 3.6).min() < 0.3, "planner.waypoint_radius"


def test_a_route_over_the_grid_without_a_local_planner_is_refused():
    async def story(trip: Trip) -> None:
        with pytest.raises(
            RequestRefusedError, match=r"cannot drive this planner's routes directly: set planner\.local_planner"
        ):
            await trip.goal(5.0, 3.9, 0.0)

    assert_at(travel(story, planner=settings("grid_astar", None)), 1.0, 3.95, 0.0)
