"""The doctor's drive of 20 cm through the whole daemon: what is the wrong way round is found through the gate."""

from pathlib import Path

import pytest

from monstertruck_runtime.clock import VirtualClock, run_virtual
from monstertruckd.config.load import load_config
from monstertruckd.tools.calibrate.motion import Mover
from monstertruckd.tools.doctor.context import Level
from monstertruckd.tools.doctor.drive import signs
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.virtual_rig import VirtualRig
from tests.calibration_kit import START_UP, LocalTruck

pytestmark = [pytest.mark.virtual, pytest.mark.long, pytest.mark.timeout(300)]

BASE = load_config(Path(__file__).resolve().parents[2] / "configs" / "yard.yaml", SimulatedTruckConfig)[0]
FRONT = {"channel": 1, "centre_us": 1461.0, "us_per_degree": -9.9}
REAR = {"channel": 0, "centre_us": 1422.0, "us_per_degree": -10.9}
WRONG = {"us_per_degree": 10.0}


@pytest.mark.parametrize(
    ("world", "checks"),
    [
        ({"truck": {"front_servo": FRONT, "rear_servo": REAR}}, set()),
        ({"truck": {"front_servo": FRONT, "rear_servo": REAR | WRONG}}, {"sign steering"}),
        ({"truck": {"front_servo": FRONT | WRONG, "rear_servo": REAR | WRONG}}, {"sign steering"}),
        ({"truck": {"rear_servo": REAR, "motor": {"inverted": False}}}, {"sign motor"}),
        ({"truck": {"rear_servo": REAR}, "lidar": {"yaw": 3.14159}}, {"sign lidar"}),
    ],
)
def test_signs(tmp_path: Path, world, checks):
    overlay = {"recorder": None, "blackbox": None, "state_directory": tmp_path, "sim": {"world": world}}
    config = with_overlay(BASE, overlay)

    async def main(clock: VirtualClock):
        rig = VirtualRig(config, clock)
        async with rig.running():
            await clock.sleep(START_UP)
            mover = Mover(LocalTruck(rig.daemon, clock, "doctor"), clock, config.chassis())
            return await signs(lambda step: mover.move(step, lambda *_: None), config, lambda *words: " ".join(words))

    found = run_virtual(main)
    assert {finding.check for finding in found if finding.level is not Level.OK} == checks, found
