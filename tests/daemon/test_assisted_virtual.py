"""A stick held straight, in a corridor round a block: assisted driving follows the corridor, the bare gate stops."""

from pathlib import Path

import numpy as np
import pytest

from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_schemas import topics
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.state import GateMode
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.virtual_rig import VirtualRig
from tests.calibration_kit import LocalTruck

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(300)]

DEMO = Path(__file__).resolve().parents[2] / "configs" / "demo.yaml"
AT_CORNER = {"x": 1.2, "y": -1.7, "yaw": 0.0}


def drive(seconds: float, *, assisted: bool) -> tuple[np.ndarray, set[Reason], int]:
    """Truth of the drive (columns t, x, y, yaw, v, collided), reasons of the gate, and requests at standstill."""
    config = load_config(DEMO, SimulatedTruckConfig)[0].model_copy(update={"recorder": None, "path": None})
    changes = {"gate": {"assist": {"on": assisted}}, "sim": {"world": {"map": "loop", "start": AT_CORNER}}}
    config = with_overlay(config, changes)

    async def main(clock: VirtualClock) -> tuple[np.ndarray, set[Reason], int]:
        rig = VirtualRig(config, clock)
        reasons: set[Reason] = set()
        stood = 0
        async with rig.running():
            await clock.sleep(3.0)
            truck = LocalTruck(rig.daemon, clock)
            await truck.arm()
            begin = clock.now() / SECOND
            for step in range(round(seconds / 0.1)):
                await truck.drive(0.2, 0.0, 0.0)
                await clock.sleep(0.1)
                gate = rig.bus.newest(topics.GATE)
                assert gate is not None
                reasons |= set(gate.reasons)
                stood += step > 20 and (gate.mode is not GateMode.DRIVING or gate.speed_limit == 0.0)
            truth = rig.truth.array()
        return truth[truth[:, 0] >= begin], reasons, stood

    return run_virtual(main, start=SECOND)


def length(truth: np.ndarray) -> float:
    return float(np.hypot(*np.diff(truth[:, 1:3], axis=0).T).sum())


@pytest.mark.long
@pytest.mark.timeout(900)
def test_a_stick_held_straight_follows_the_corridor_for_ten_metres():
    truth, reasons, stood = drive(54.0, assisted=True)
    assert length(truth) > 10.0
    assert not truth[:, 5].any()
    assert stood == 0
    assert Reason.ASSISTED in reasons


def test_a_corner_is_driven_round_and_without_assistance_the_gate_stops():
    truth, reasons, stood = drive(9.0, assisted=True)
    assert truth[-1, 3] > 1.0
    assert Reason.ASSISTED in reasons
    assert stood == 0
    truth, reasons, stood = drive(9.0, assisted=False)
    assert abs(truth[-1, 3]) < 0.1
    assert Reason.OBSTACLE_STOP in reasons
    assert Reason.ASSISTED not in reasons
    assert stood > 0
