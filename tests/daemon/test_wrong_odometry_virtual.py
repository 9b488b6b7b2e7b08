"""Mapping in the daemon with odometry whose turns have the wrong sign: it is reported, and the pose stays true."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from monstertruck_estimation.odometry import DeadReckoning, OdometryEstimate
from monstertruck_estimation.se2 import between, compose
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.mailbox import fifo
from monstertruck_schemas import topics
from monstertruck_schemas.health import LocalisationStatus, OdometryUse
from monstertruck_schemas.reasons import Reason
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(300)]

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "slam.yaml"


def test_mirrored_turns_are_reported_and_the_pose_stays_true(monkeypatch: pytest.MonkeyPatch):
    right, first = DeadReckoning.estimate, []

    def mirrored(self: DeadReckoning, now: int) -> OdometryEstimate | None:
        estimate = right(self, now)
        if estimate is None:
            return None
        first.append(estimate.pose)
        x, y, yaw = between(np.array(first[0]), np.array(estimate.pose)).tolist()
        pose, (vx, vy, wz) = compose(np.array(first[0]), np.array((x, -y, -yaw))).tolist(), estimate.twist
        return replace(estimate, pose=tuple(pose), twist=(vx, -vy, -wz))

    monkeypatch.setattr(DeadReckoning, "estimate", mirrored)
    config, _ = load_config(CONFIG, SimulatedTruckConfig)
    config = config.model_copy(update={"recorder": None, "map": None})

    async def main(clock: VirtualClock) -> dict:
        rig = VirtualRig(config, clock)
        boxes = {t.name: rig.bus.subscribe(t, fifo(20_000)) for t in (topics.POSE, topics.SLAM, topics.EVENT)}
        operator = LocalOperator(rig.daemon, clock)
        async with rig.running():
            await clock.sleep(1.5)
            await operator.arm()
            await clock.sleep(18)
        return {**{name: box.drain() for name, box in boxes.items()}, "truth": rig.truth.array()}

    drive = run_virtual(main, start=SECOND)
    truth = drive["truth"]
    turned = truth[np.argmax(np.abs(np.unwrap(truth[:, 3]) - truth[0, 3]) > 0.3), 0]
    dropped = next(e for e in drive[topics.EVENT.name] if e.reason is Reason.ODOMETRY_DROPPED)
    assert dropped.stamp / SECOND < turned + 5.0
    health = drive["health/slam"]
    assert health[-1].odometry is OdometryUse.CONTRADICTED
    assert {message.standing for message in health} <= {LocalisationStatus.MAPPING, LocalisationStatus.DEGENERATE}
    poses = drive["state/pose"]
    stamps = np.array([pose.stamp for pose in poses]) / SECOND
    x, y = (np.interp(stamps, truth[:, 0], truth[:, k]) for k in (1, 2))
    off = np.hypot([p.pose.x for p in poses] - x, [p.pose.y for p in poses] - y)
    assert off[stamps > dropped.stamp / SECOND + 1.0].max() < 0.15
