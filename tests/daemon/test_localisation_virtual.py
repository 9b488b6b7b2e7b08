"""Localisation through the whole daemon: found on the right map by a second look, and outside of the wrong one."""

from pathlib import Path

import numpy as np
import pytest

from monstertruck_estimation.slam.storage import save
from monstertruck_estimation.slam.worker_io import GridPatch
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import RequestRefusedError
from monstertruck_runtime.mailbox import latest
from monstertruck_runtime.map_files import load_map
from monstertruck_runtime.map_folders import SAVES
from monstertruck_schemas import topics
from monstertruck_schemas.health import MATCHED, LocalisationStatus, ServiceState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import BehaviourOrder
from monstertruckd.tools.simulation.virtual_rig import VirtualRig
from tests.daemon.goal_kit import Trip, travel
from tests.daemon.slam_kit import CONFIGS, Drive, driven, lap

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(300)]

PLACED = MATCHED | {LocalisationStatus.LOST}


def localised_in(map_name: str) -> Drive:
    """The demo's truck in its loop, localising in a map that a file of this name holds."""
    place = CONFIGS / "worlds" / map_name
    return driven("slam.yaml", lap(16), slam={"mode": "localisation", "map": place})


def test_the_truck_finds_itself_on_its_map():
    drive = localised_in("loop.yaml")
    placed = [message.stamp / SECOND for message in drive.health if message.standing in PLACED]
    assert placed
    before = drive.truth[drive.truth[:, 0] <= placed[0]]
    assert np.hypot(*np.diff(before[:, 1:3], axis=0).T).sum() > 0.7
    assert all(message.standing in PLACED for message in drive.health if message.stamp / SECOND >= placed[0])
    assert drive.off(placed[0] + 0.3).max() < 0.1
    reasons = {event.reason for event in drive.events}
    assert Reason.POSE_FOUND in reasons
    assert Reason.OUTSIDE_MAP not in reasons


@pytest.mark.parametrize("harmed", [1, 2])
def test_a_damaged_save_is_named_and_the_one_before_is_read_if_it_is_whole(tmp_path: Path, harmed: int):
    world = load_map(CONFIGS / "worlds" / "loop.yaml")
    for _ in range(2):
        save(tmp_path, GridPatch(world.cells, world.origin, world.resolution), None)
    for number in ("000002", "000001")[:harmed]:
        (tmp_path / SAVES / number / "map.png").write_bytes(b"x")
    said = []

    async def story(rig: VirtualRig) -> None:
        await rig.clock.sleep(2.0)
        with rig.bus.subscribe(topics.HEALTH, latest()) as health:
            await rig.clock.sleep(1.5)
            assert health.latest is not None
            said.extend(row for row in health.latest.services if row.name == "slam")

    drive = driven("slam.yaml", story, slam={"mode": "localisation", "map": tmp_path})
    (slam,) = said
    if harmed == 1:
        (text,) = {event.text for event in drive.events if event.reason is Reason.FILE_DAMAGED}
        assert text.endswith("expected 1138 as in manifest.json; an older save is loaded instead")
        assert drive.health
        assert (slam.state, slam.reason) == (ServiceState.READY, Reason.FILE_DAMAGED)
    else:
        assert (slam.state, slam.restarts, slam.reason) == (ServiceState.FAILED, 0, Reason.FILE_DAMAGED)
        assert slam.detail.count("as in manifest.json") == 2
        assert "Traceback" not in slam.detail


def test_before_it_has_found_itself_it_takes_no_goal_and_no_mission():
    goal = {"frame": "map", "goal": {"x": 3.4, "y": 3.9, "yaw": 0.0}}
    steps = [{"do": "record", "note": "here"}]
    asked = {
        "goal": goal,
        "mission": {"order": "start", "mission": {"version": 2, "name": "there", "steps": steps}},
    }

    async def story(trip: Trip) -> None:
        await trip.arm()
        for call, request in asked.items():
            with pytest.raises(RequestRefusedError, match="`monstertruckd drive`") as refused:
                await trip.operator.call(call, {**await trip.operator.header(), **request})
            assert refused.value.refusal is Reason.POSE_LOST
        await trip.operator.behave(BehaviourOrder.START, "move", {"length": 1.1, "speed": 0.2})
        await trip.clock.sleep(9.0)
        await trip.arm()
        await trip.operator.call("mission", {**await trip.operator.header(), **asked["mission"]})

    travel(story, slam={"mode": "localisation", "map": CONFIGS / "worlds" / "rooms.yaml"})


@pytest.mark.long
def test_a_goal_ends_when_the_truck_is_carried_to_where_it_does_not_know_its_place():
    """It drove on by odometry, along a route that was somewhere else."""

    async def story(trip: Trip) -> None:
        await trip.arm()
        await trip.operator.behave(BehaviourOrder.START, "move", {"length": 1.1, "speed": 0.2})
        await trip.clock.sleep(7.5)
        await trip.goal(6.5, 3.9, 0.0)
        await trip.arm()
        await trip.clock.sleep(0.5)
        trip.rig.world.carry(trip.clock.now(), (6.85, 5.6, 1.57))
        end = await trip.end(20.0)
        assert (end.outcome, end.text) == (Reason.POSE_LOST, "its pose on the saved map is unknown (searching)")

    travel(story, slam={"mode": "localisation", "map": CONFIGS / "worlds" / "rooms.yaml"})


@pytest.mark.long
def test_the_truck_is_outside_of_another_places_map():
    drive = localised_in("rooms.yaml")
    assert not PLACED & {message.standing for message in drive.health}
    assert drive.health[-1].standing is LocalisationStatus.OUTSIDE
    (event,) = [event for event in drive.events if event.reason is Reason.OUTSIDE_MAP]
    assert event.stamp / SECOND < 13.0
    # The pose goes on as odometry has it, without a jump to a place of that map.
    steps = np.diff([(pose.pose.x, pose.pose.y) for pose in drive.poses], axis=0)
    assert np.hypot(*steps.T).max() < 0.02
