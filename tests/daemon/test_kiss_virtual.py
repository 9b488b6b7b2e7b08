"""Mapping with kiss-icp as scan matcher, and as witness, through the whole daemon: the pose is true, scans match."""

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

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "kiss.yaml"


def test_the_demos_lap_is_mapped_by_kiss_icp():
    config, _ = load_config(CONFIG, SimulatedTruckConfig)
    assert config.slam.front == "kiss"
    slam = config.slam.model_copy(update={"witness": "kiss"})
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

    drive = run_virtual(main, start=SECOND)
    truth, poses, health = drive["truth"], drive["state/pose"], drive["health/slam"]
    assert np.hypot(*(truth[-1, 1:3] - truth[0, 1:3])) > 2.0
    stamps = np.array([pose.stamp for pose in poses]) / SECOND
    x, y = (np.interp(stamps, truth[:, 0], truth[:, k]) for k in (1, 2))
    assert np.hypot([p.pose.x for p in poses] - x, [p.pose.y for p in poses] - y).max() < 0.1
    assert {message.standing for message in health} <= {LocalisationStatus.MAPPING, LocalisationStatus.DEGENERATE}
    assert np.mean([message.accepted for message in health[5:]]) > 0.95
    assert health[-1].keys > 5
    assert Reason.WITNESS_DISAGREES not in {event.reason for event in drive[topics.EVENT.name]}
