"""A robot with a lidar and sonars that look backwards, through real drivers and emulators, on the virtual clock."""

import json
import math
from pathlib import Path

import pytest

from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.mailbox import fifo
from monstertruck_schemas import topics
from monstertruck_schemas.reasons import Reason
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig
from monstertruckd.tools.simulation.virtual_rig import VirtualRig
from tests.calibration_kit import LocalTruck

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(120)]

YARD = Path(__file__).resolve().parents[2] / "configs" / "yard.yaml"
PLACES = {"rl": {"x": 0.0, "y": 0.1, "yaw": math.pi}, "rr": {"x": 0.0, "y": -0.1, "yaw": math.pi}}
SONARS = {
    "kind": "srf08",
    "sonars": {name: {"address": 0xE0 + 2 * i, "mount": place} for i, (name, place) in enumerate(PLACES.items())},
    "groups": [["rl"], ["rr"]],
}
TAIL = 0.235
"""Distance of the tail behind the base, m."""


def reverse(folder, room, *, sonars, silent_at=None):
    """Ask for reverse for 12 s, ``room`` metres before a wall; distance driven, distance left (m), and reasons."""
    start = {"x": -3.5 + TAIL + room, "y": 0.0, "yaw": 0.0}
    settings = {"version": 2, "include": str(YARD), "sim": {"world": {"start": start, "sonar": {"sonars": PLACES}}}}
    if sonars:
        settings["devices"] = {"sonar": {"driver": SONARS}}
    file = folder / "robot.yaml"
    file.write_text(json.dumps(settings))
    config = load_config(file, SimulatedTruckConfig)[0].model_copy(update={"recorder": None})

    async def main(clock: VirtualClock) -> tuple[float, float, set[Reason]]:
        rig = VirtualRig(config, clock)
        with rig.bus.subscribe(topics.GATE, fifo(4096)) as gate:
            async with rig.running():
                await clock.sleep(3.0)
                truck = LocalTruck(rig.daemon, clock)
                start = rig.world.truth(clock.now())
                await truck.arm()
                gate.drain()
                for tick in range(120):
                    if tick * 0.1 == silent_at:
                        rig.robot.emulators["sonar"].inject("silent", "on")
                    await truck.drive(-0.15, 0.0, 0.0)
                    await clock.sleep(0.1)
                end = rig.world.truth(clock.now())
                assert not rig.truth.array()[:, 5].any(), "touched"
                reasons = {reason for state in gate.drain() for reason in state.reasons}
                return start.x - end.x, end.x + 3.5 - TAIL, reasons

    return run_virtual(main, start=SECOND)


def test_it_reverses_to_a_wall_that_its_sonars_measure(tmp_path):
    driven, left, reasons = reverse(tmp_path, 1.0, sonars=True)
    assert driven > 0.8
    assert 0.03 < left < 0.15
    assert reasons & {Reason.UNSEEN_STOP, Reason.OBSTACLE_STOP}


@pytest.mark.parametrize("overlay", [{"sonars": False}, {"sonars": True, "silent_at": 0.0}])
def test_without_an_answer_it_stands(overlay, tmp_path):
    driven, _, reasons = reverse(tmp_path, 1.0, **overlay)
    assert driven < 0.1
    assert Reason.UNSEEN_STOP in reasons


def test_it_stops_when_its_sonars_fall_silent(tmp_path):
    driven, left, reasons = reverse(tmp_path, 1.5, sonars=True, silent_at=3.0)
    assert 0.2 < driven < 0.6
    assert left > 0.8
    assert Reason.UNSEEN_STOP in reasons
