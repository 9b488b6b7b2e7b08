"""A truck whose servos turn less than calibrated: reported, proposed, accepted, right from then on."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.mailbox import fifo, latest
from monstertruck_schemas import topics
from monstertruck_schemas.plan import TrackerState
from monstertruck_schemas.reasons import Reason
from monstertruckd.config.calibration import Result, with_values
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.operator import LocalOperator, drive_lap
from monstertruckd.tools.simulation.virtual_rig import VirtualRig
from tests.calibration_kit import LocalTruck

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(300)]

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
GAIN = 0.9
"""Of both servos."""


def laps(config: SimulatedTruckConfig, count: int) -> tuple[TrackerState, list[str], dict[str, Any]]:
    """The tracker's last state, texts of its events, and the calibration as the daemon tells it."""

    async def main(clock: VirtualClock) -> tuple[TrackerState, list[str], dict[str, Any]]:
        rig = VirtualRig(config, clock)
        bus = rig.bus
        with bus.subscribe(topics.TRACKER, latest()) as states, bus.subscribe(topics.EVENT, fifo(4096)) as events:
            async with rig.running():
                await clock.sleep(3.0)
                operator = LocalOperator(rig.daemon, clock)
                for _ in range(count):
                    assert (await drive_lap(operator, clock, limit=120)).outcome is Reason.GOAL_REACHED
                    await clock.sleep(2.0)
                reported = await LocalTruck(rig.daemon, clock).call("calibration")
            assert states.latest is not None
            texts = [event.text for event in events.drain() if event.reason is Reason.STEERING_DIFFERS]
            return states.latest, texts, reported

    return run_virtual(main, start=SECOND)


def wrong(gain: float) -> SimulatedTruckConfig:
    """The demo's truck, whose servos turn by this factor less far than its configuration says."""
    base, _ = load_config(CONFIGS / "demo.yaml", SimulatedTruckConfig)
    servos = {name: {"scale_us_per_deg": 10.48 * gain} for name in ("front", "rear")}
    overlay = {"recorder": None, "blackbox": None, "devices": {"steering": {"driver": servos}}}
    return with_overlay(base, overlay)


@pytest.mark.long
def test_servos_that_turn_less_are_reported_and_the_accepted_proposal_makes_up_for_it():
    config = wrong(GAIN)
    state, texts, reported = laps(config, 1)
    assert len(texts) == 1
    assert state.steering_differs.startswith("both axles steer 10 % less") or "9 % less" in state.steering_differs
    proposed = Result.model_validate_json(json.dumps(reported["proposed"]))
    scales = [proposed.estimate(f"{axle}_scale").value for axle in ("front", "rear")]
    assert np.mean(scales) == pytest.approx(10.48, rel=0.02)
    state, texts, reported = laps(with_values(config, [proposed], "proposed"), 1)
    assert (texts, state.steering_differs, reported["proposed"]) == ([], "", None)
