"""A truck whose servos answer later than anybody configured drives its lap, and reports the delay."""

from pathlib import Path

import numpy as np
import pytest

from monstertruck_planners.track.paths import load_path
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.mailbox import fifo, latest
from monstertruck_schemas import topics
from monstertruck_schemas.plan import AxleResponse
from monstertruck_schemas.reasons import Reason
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.operator import LocalOperator, drive_lap
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(300)]

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
HIDDEN = 0.15
"""Dead time of the servos, s."""
CHAIN = 0.03
"""From the request to the servos: tick of the gate, serial line, frame of the pulses; s."""


def lap(kind: str, **tracker: float) -> tuple[np.ndarray, AxleResponse, list[Reason]]:
    """True distances from the path (m), the axles' response at the end, and reasons of the tracker's events."""
    base, _ = load_config(CONFIGS / "demo.yaml", SimulatedTruckConfig)
    servos = {
        f"{axle}_servo": {"channel": channel, "dead_time": HIDDEN} for channel, axle in enumerate(("rear", "front"))
    }
    overlay = {
        "recorder": None,
        "blackbox": None,
        "tracker": {"kind": kind, **tracker},
        "devices": {"steering": {"driver": {"dead_time": None, "lag": None}}},
        "sim": {"world": {"truck": servos}},
    }
    config = with_overlay(base, overlay)

    async def main(clock: VirtualClock) -> tuple[np.ndarray, AxleResponse, list[Reason]]:
        rig = VirtualRig(config, clock)
        bus = rig.bus
        with bus.subscribe(topics.TRACKER, latest()) as states, bus.subscribe(topics.EVENT, fifo(4096)) as events:
            async with rig.running():
                await clock.sleep(3.0)
                assert (
                    await drive_lap(LocalOperator(rig.daemon, clock), clock, limit=120)
                ).outcome is Reason.GOAL_REACHED
            assert states.latest is not None
            assert states.latest.axles is not None
            reasons = [event.reason for event in events.drain() if event.source == "tracker"]
            places = rig.truth.array()[:, 1:3]
        points = load_path(CONFIGS / "paths" / "loop.csv", closed=True, frame="odom").poses.reshape(-1, 3)[:, :2]
        away = np.hypot(*np.moveaxis(places[::5, None] - points, 2, 0)).min(axis=1)
        return away, states.latest.axles, reasons

    return run_virtual(main, start=SECOND)


@pytest.mark.long
def test_a_delay_that_nobody_configured_is_found_and_costs_little():
    away, axles, reasons = lap("lqr")
    assert np.sqrt(np.mean(away**2)) < 0.025
    assert axles.delay == pytest.approx(HIDDEN + CHAIN, abs=2 * axles.deviation)
    assert axles.deviation < 0.06
    assert Reason.RESPONSE_DIFFERS not in reasons


@pytest.mark.long
def test_a_delay_that_is_configured_wrongly_is_reported():
    _, axles, reasons = lap("lqr", dead_time=0.0)
    assert reasons.count(Reason.RESPONSE_DIFFERS) >= 1
    assert axles.dead_time + axles.lag == pytest.approx(HIDDEN, abs=0.05)
