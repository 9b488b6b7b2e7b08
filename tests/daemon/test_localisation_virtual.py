"""Localisation through the whole daemon: found on the right map by a second look, and outside of the wrong one."""

from pathlib import Path

import numpy as np
import pytest

from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.mailbox import fifo
from monstertruck_schemas import topics
from monstertruck_schemas.health import LocalisationStatus
from monstertruck_schemas.reasons import Reason
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(300)]

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
PLACED = {LocalisationStatus.LOCALISED, LocalisationStatus.DEGENERATE, LocalisationStatus.LOST}


def driven(map_name: str) -> dict:
    """The demo's truck in its loop, localising in a map that a file of this name holds."""
    config, _ = load_config(CONFIGS / "slam.yaml", SimulatedTruckConfig)
    slam = config.slam.model_copy(update={"mode": "localisation", "map": CONFIGS / "worlds" / map_name})
    config = config.model_copy(update={"recorder": None, "map": None, "slam": slam})

    async def main(clock: VirtualClock) -> dict:
        rig = VirtualRig(config, clock)
        boxes = {t.name: rig.bus.subscribe(t, fifo(20_000)) for t in (topics.POSE, topics.SLAM, topics.EVENT)}
        operator = LocalOperator(rig.daemon, clock)
        async with rig.running():
            await clock.sleep(1.5)
            await operator.arm()
            await clock.sleep(16)
        return {**{name: box.drain() for name, box in boxes.items()}, "truth": rig.truth.array()}

    return run_virtual(main, start=SECOND)


def test_the_truck_finds_itself_on_its_map():
    drive = driven("loop.yaml")
    truth, health = drive["truth"], drive["health/slam"]
    placed = [message.stamp / SECOND for message in health if message.standing in PLACED]
    assert placed
    before = truth[truth[:, 0] <= placed[0]]
    assert np.hypot(*np.diff(before[:, 1:3], axis=0).T).sum() > 0.7
    assert all(message.standing in PLACED for message in health if message.stamp / SECOND >= placed[0])
    poses = [pose for pose in drive["state/pose"] if pose.stamp / SECOND > placed[0] + 0.3]
    stamps = np.array([pose.stamp for pose in poses]) / SECOND
    x, y = (np.interp(stamps, truth[:, 0], truth[:, k]) for k in (1, 2))
    assert np.hypot([p.pose.x for p in poses] - x, [p.pose.y for p in poses] - y).max() < 0.1
    reasons = {event.reason for event in drive[topics.EVENT.name]}
    assert Reason.POSE_FOUND in reasons
    assert Reason.OUTSIDE_MAP not in reasons


def test_the_truck_is_outside_of_another_places_map():
    drive = driven("rooms.yaml")
    assert not PLACED & {message.standing for message in drive["health/slam"]}
    assert drive["health/slam"][-1].standing is LocalisationStatus.OUTSIDE
    (event,) = [event for event in drive[topics.EVENT.name] if event.reason is Reason.OUTSIDE_MAP]
    assert event.stamp / SECOND < 13.0
    # The pose goes on as odometry has it, without a jump to a place of that map.
    steps = np.diff([(pose.pose.x, pose.pose.y) for pose in drive["state/pose"]], axis=0)
    assert np.hypot(*steps.T).max() < 0.02
