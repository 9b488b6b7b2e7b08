"""A car without lidar and compass, with a PCA9685 and a camera: drives its bend; virtual clock."""

import math
from pathlib import Path

import pytest

from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.mailbox import latest
from monstertruck_schemas import topics
from monstertruck_schemas.reasons import Reason
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig
from monstertruckd.tools.simulation.operator import LocalOperator, drive_lap
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(600)]

CAR = Path(__file__).resolve().parents[2] / "configs" / "robots" / "donkeycar.yaml"


@pytest.mark.long
def test_it_drives_its_bend_and_shows_pictures_without_a_map():
    config = load_config(CAR, SimulatedTruckConfig)[0].model_copy(update={"recorder": None})
    assert config.devices.lidar is config.slam is None
    for weakness in (
        "a PCA9685 has no watchdog",
        "no sensor measures the motor",
        "gate.attitude null",
        "scan.critical",
    ):
        assert any(weakness in text for text in config.weakened()), weakness

    async def main(clock: VirtualClock) -> None:
        rig = VirtualRig(config, clock)
        with rig.bus.subscribe(topics.CAMERA, latest()) as pictures:
            async with rig.running():
                lap = await drive_lap(LocalOperator(rig.daemon, clock), clock, limit=60)
                await clock.sleep(0.5)
            assert pictures.latest is not None
            assert clock.now() - pictures.latest.stamp < SECOND
        assert lap.outcome is Reason.GOAL_REACHED
        truth = rig.truth.array()
        assert not truth[:, 5].any(), "no contact"
        assert truth[:, 4].max() == pytest.approx(0.21, rel=0.15), "the speed of the path"
        assert math.dist(truth[-1, 1:3], (2.4, 4.15)) < 0.15

    run_virtual(main, start=SECOND)
