"""The fusion in the whole daemon on the virtual clock: a wrong wheel radius that dead reckoning cannot know."""

import math
from pathlib import Path

import numpy as np
import pytest

from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.mailbox import fifo
from monstertruck_schemas import topics
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(300)]

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "fusion.yaml"
SECONDS = 15


@pytest.fixture(scope="module")
def drive() -> dict:
    config, _ = load_config(CONFIG, SimulatedTruckConfig)
    geometry = config.geometry.model_copy(update={"wheel_radius": 0.08})
    config = config.model_copy(update={"recorder": None, "map": None, "geometry": geometry})

    async def main(clock: VirtualClock) -> dict:
        rig = VirtualRig(config, clock)
        boxes = {
            topic.name: rig.bus.subscribe(topic, fifo(20_000))
            for topic in (topics.POSE, topics.ODOMETRY, topics.SCAN_MOTION, topics.EVENT)
        }
        operator = LocalOperator(rig.daemon, clock)
        async with rig.running():
            await clock.sleep(1.5)
            await operator.arm()
            await clock.sleep(SECONDS)
        return {**{name: box.drain() for name, box in boxes.items()}, "truth": rig.truth.array()}

    return run_virtual(main, start=SECOND)


def test_odometry_names_its_sensors_and_never_jumps(drive: dict):
    poses = drive["state/odometry"]
    assert {"drive", "steering", "compass", "tilt", "lidar"} == set(poses[-1].sources)
    assert {pose.frame for pose in poses} == {"odom"}
    steps = np.hypot(np.diff([p.pose.x for p in poses]), np.diff([p.pose.y for p in poses]))
    assert steps.max() < 0.02


def test_the_way_is_that_of_the_scans_not_of_the_wrong_wheels(drive: dict):
    truth, poses = drive["truth"], drive["state/odometry"]
    true = np.hypot(*np.diff(truth[:, 1:3], axis=0).T).sum()
    places = np.array([(pose.pose.x, pose.pose.y) for pose in poses])
    # Sampled once a second: the noise between ticks is no way.
    reported = np.hypot(*np.diff(places[::50], axis=0).T).sum()
    assert true > 1.5
    assert reported == pytest.approx(true, rel=0.04), "the wheels alone would make it 7 % longer"


def test_the_motion_between_scans_goes_over_the_bus(drive: dict):
    motions = drive["state/scan_motion"]
    assert len(motions) > 100
    assert all(0 < motion.stamp - motion.since < SECOND for motion in motions)
    for motion in motions:
        assert np.linalg.eigvalsh(motion.covariance.reshape(3, 3))[0] > 0
    assert max(math.hypot(motion.motion.x, motion.motion.y) for motion in motions) < 0.1


def test_the_pose_in_map_is_true(drive: dict):
    truth = drive["truth"]
    end = drive["state/pose"][-1]
    x, y = (np.interp(end.stamp / SECOND, truth[:, 0], truth[:, k]) for k in (1, 2))
    assert math.hypot(end.pose.x - x, end.pose.y - y) < 0.1
