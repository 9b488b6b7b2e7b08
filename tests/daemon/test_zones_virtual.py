"""Zones of the whole daemon on the virtual clock: goals keep out of them, and speed zones are driven slowly."""

from typing import Any

import numpy as np
import pytest

from monstertruck_planners.collision import Footprint
from monstertruck_planners.zones.shapes import ZoneLayer
from monstertruck_runtime.errors import RequestRefusedError
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.zones import Zone
from tests.daemon.goal_kit import Trip, assert_at, travel

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(300)]

WALL = [[2.4, 4.0], [2.8, 4.0], [2.8, 4.7], [2.4, 4.7]]
LATE = [[2.9, 4.0], [3.2, 4.0], [3.2, 4.7], [2.9, 4.7]]
SLOW = [[1.4, 3.0], [1.8, 3.0], [1.8, 5.0], [1.4, 5.0]]
AREAS = {
    "wall": {"kind": "keepout", "corners": WALL},
    "slow": {"kind": "speed", "limit": 0.08, "corners": SLOW},
}
BODY = Footprint(padding=0.0)


async def order(trip: Trip, name: str, what: str, **more: Any) -> None:
    await trip.rig.daemon.rpc.call("zones", {**trip.header(), "order": what, "name": name, **more})


def layer(corners: list[list[float]]) -> ZoneLayer:
    return ZoneLayer([Zone(name="z", kind="keepout", corners=tuple(map(tuple, corners)))])


def test_a_goal_is_reached_round_a_keepout_zone_and_slowly_over_a_speed_zone():
    async def story(trip: Trip) -> None:
        with pytest.raises(RequestRefusedError, match="keepout zone wall") as refused:
            await trip.goal(2.6, 4.2, 0.0)
        assert refused.value.refusal is Reason.KEEPOUT
        await trip.goal(4.0, 3.95, 0.0)
        await trip.arm()
        assert (await trip.end()).outcome is Reason.GOAL_REACHED

    rig = travel(story, zones={"areas": AREAS})
    assert_at(rig, 4.0, 3.95, 0.0)
    truth = rig.truth.array()
    wall, slow = layer(WALL), layer(SLOW)
    poses = [tuple(row) for row in truth[::5, 1:4].tolist()]
    assert not any(wall.keepout(BODY, pose) for pose in poses)
    speeds = np.hypot(np.diff(truth[::5, 1]), np.diff(truth[::5, 2])) / np.diff(truth[::5, 0])
    on = [speed for pose, speed in zip(poses, speeds.tolist(), strict=False) if slow.keepout(BODY, pose)]
    assert 0.05 < max(on) <= 0.085
    assert max(speeds) > 0.12


@pytest.mark.long
def test_a_zone_that_is_drawn_on_the_way_is_driven_round_and_one_that_is_off_is_crossed():
    async def story(trip: Trip) -> None:
        await order(trip, "wall", "off", seconds=600)
        await trip.goal(4.0, 3.95, 0.0)
        await trip.arm()
        await trip.clock.sleep(3.0)
        await order(trip, "late", "add", area={"kind": "keepout", "corners": LATE})
        assert (await trip.end()).outcome is Reason.GOAL_REACHED

    rig = travel(story, zones={"areas": {"wall": AREAS["wall"]}})
    poses = [tuple(row) for row in rig.truth.array()[::5, 1:4].tolist()]
    assert any(layer(WALL).keepout(BODY, pose) for pose in poses)
    assert not any(layer(LATE).keepout(BODY, pose) for pose in poses)


def test_a_zone_that_is_drawn_over_the_goal_ends_it():
    async def story(trip: Trip) -> None:
        await trip.goal(4.0, 3.95, 0.0)
        await trip.arm()
        await trip.clock.sleep(2.0)
        await order(trip, "late", "add", area={"kind": "keepout", "corners": [[3.8, 3.5], [4.3, 3.5], [4.0, 4.5]]})
        end = await trip.end(limit=3.0)
        assert (end.outcome, end.recoveries) == (Reason.KEEPOUT, 0)
        assert "zone late" in end.text

    travel(story, zones={})


def test_a_robot_that_starts_in_a_zone_leaves_it_slowly_or_is_not_armed():
    async def leaves(trip: Trip) -> None:
        await trip.goal(1.9, 3.95, 0.0)
        await trip.arm()
        assert (await trip.end()).outcome is Reason.GOAL_REACHED

    async def stands(trip: Trip) -> None:
        with pytest.raises(RequestRefusedError, match="keepout zone start") as refused:
            await trip.goal(3.0, 3.95, 0.0)
        assert refused.value.refusal is Reason.KEEPOUT
        with pytest.raises(RequestRefusedError, match="zone off start"):
            await trip.arm()

    start = {"kind": "keepout", "corners": [[0.4, 3.4], [1.1, 3.4], [1.1, 4.5], [0.4, 4.5]]}
    rig = travel(leaves, zones={"areas": {"start": start | {"inside": "leave"}}})
    assert_at(rig, 1.9, 3.95, 0.0)
    truth = rig.truth.array()
    gone = layer(start["corners"])
    speeds = np.hypot(np.diff(truth[::5, 1]), np.diff(truth[::5, 2])) / np.diff(truth[::5, 0])
    poses = map(tuple, truth[::5, 1:4].tolist())
    inside = [speed for pose, speed in zip(poses, speeds.tolist(), strict=False) if gone.keepout(BODY, pose)]
    assert 0.05 < max(inside) < 0.11
    travel(stands, zones={"areas": {"start": start}})
