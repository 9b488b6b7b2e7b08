"""Steering beyond what the servos' pulses reach, through the whole daemon."""

from pathlib import Path

import pytest

from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.mailbox import latest
from monstertruck_schemas import topics
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.state import GateState
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.virtual_rig import VirtualRig
from tests.calibration_kit import LocalTruck

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(120)]

YARD = Path(__file__).resolve().parents[2] / "configs" / "yard.yaml"
NOMINAL = {
    name: {"channel": channel, "centre_us": 1439.2, "us_per_degree": -10.48}
    for name, channel in (("front_servo", 1), ("rear_servo", 0))
}


def drive(front: float, rear: float, seconds: float = 4.0) -> tuple[GateState, float]:
    """State of the gate and true curvature, 1/m, after some seconds of the same request."""
    config = load_config(YARD, SimulatedTruckConfig)[0].model_copy(update={"recorder": None})
    config = with_overlay(config, {"sim": {"world": {"truck": NOMINAL}}})

    async def main(clock: VirtualClock) -> tuple[GateState, float]:
        rig = VirtualRig(config, clock)
        with rig.bus.subscribe(topics.GATE, latest()) as gate:
            async with rig.running():
                await clock.sleep(3.0)
                truck = LocalTruck(rig.daemon, clock)
                await truck.arm()
                for _ in range(round(seconds / 0.1)):
                    await truck.drive(0.1, front, rear)
                    await clock.sleep(0.1)
                truth = rig.world.truth(clock.now())
                assert gate.latest is not None
                return gate.latest, truth.wz / truth.v

    return run_virtual(main, start=SECOND)


@pytest.mark.parametrize(("angle", "curvature"), [(0.4, 2.30), (-0.43, -2.47)])
def test_the_gate_names_a_saturated_servo_and_the_truck_turns_as_tightly_as_that_side_lets_it(angle, curvature):
    gate, turned = drive(angle, -angle)
    assert Reason.SERVO_LIMIT in gate.reasons
    assert turned == pytest.approx(curvature, rel=0.02)


def test_what_the_servos_reach_is_turned_exactly():
    gate, turned = drive(0.3, -0.3)
    assert Reason.SERVO_LIMIT not in gate.reasons
    assert turned == pytest.approx(1.933, rel=0.02)
