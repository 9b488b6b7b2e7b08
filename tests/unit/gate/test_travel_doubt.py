"""Commanded and measured distances that differ."""

import math

import numpy as np
import pytest

from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.sensor import DriveMode
from monstertruckd.gate.config import GateConfig, InForce
from monstertruckd.gate.travel_doubt import TravelDoubt
from tests.unit.gate.rig import TICK, feedback

DT = TICK / SECOND


def doubt_after(speeds, shown=lambda at, speed: speed, mode=lambda at: DriveMode.ENABLED, shafts=1):
    """Doubt after commands, one a tick, of a drive that follows them 0.1 s later and at 0.5 m/s^2 (m)."""
    doubt, now, true, lag = TravelDoubt(InForce(GateConfig()), shafts), SECOND, 0.0, 5
    for tick, speed in enumerate(speeds):
        now += TICK
        wanted = speeds[max(tick - lag, 0)] if mode(tick * DT) is DriveMode.ENABLED else 0.0
        true += min(max(wanted - true, -0.01), 0.01)
        measured = (shown(tick * DT, true),) + (true,) * (shafts - 1)
        drives = [feedback(now, one, mode(tick * DT)) for one in measured]
        doubt.observe(now, DT, (speed,) * shafts, measured, drives)
    return doubt.distance


BACK_AND_FORTH = [0.3 * math.sin(tick / 20) if tick % 200 > 20 else 0.0 for tick in range(1000)]
STEADY = [0.0] * 10 + [-0.2] * 490


@pytest.mark.parametrize("speeds", [BACK_AND_FORTH, STEADY, [0.0] * 50])
def test_a_drive_that_follows_its_commands_leaves_no_doubt(speeds):
    assert abs(doubt_after(speeds)) < 0.005


def test_noise_of_the_measured_speed_leaves_no_doubt():
    rng = np.random.default_rng(1)
    assert abs(doubt_after(STEADY, lambda at, speed: speed + 0.01 * rng.standard_normal())) < 0.01


def test_a_drive_that_is_not_enabled_yet_leaves_no_doubt():
    assert abs(doubt_after(STEADY, mode=lambda at: DriveMode.ENABLED if at > 1.0 else DriveMode.DISABLED)) < 0.005


@pytest.mark.parametrize(("share", "metres"), [(0.0, 1.8), (0.5, 0.9), (1.5, -0.9), (-1.0, 3.6)])
@pytest.mark.parametrize("shafts", [1, 2])
def test_a_drive_that_reports_another_speed_leaves_the_difference_in_doubt(share, metres, shafts):
    speeds = STEADY[:110]
    doubt = doubt_after(speeds * 5, lambda at, speed: share * speed, shafts=shafts)
    assert doubt == pytest.approx(metres, rel=0.25)
