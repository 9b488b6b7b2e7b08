"""What a skid-steer robot does besides its model: unequal wheels, a slide, a turn at each reversal."""

import math

import numpy as np
import pytest
from pydantic import ValidationError

from monstertruck_sim.world.config import SimTruckConfig, SkidModelConfig
from monstertruck_sim.world.truck_plant import SkidEffects

DT = 0.005


def turned(effects: SkidEffects, speeds: list[float]) -> list[float]:
    """Turn of the body at each speed, driven for a second, rad."""
    return [sum(effects.twist((speed, 0.0, 0.0), 0.0, DT)[2] * DT for _ in range(200)) for speed in speeds]


def test_only_reversals_turn_the_body_and_standstill_is_none():
    effects = SkidEffects(SkidModelConfig(reversal_turn=0.02), None)
    assert turned(effects, [0.03, 0.0, 0.03, -0.03, 0.0, -0.03, 0.03]) == pytest.approx([0, 0, 0, 0.02, 0, 0, 0.02])


def test_turns_scatter_by_seed_and_come_again_with_it():
    config = SkidModelConfig(reversal_turn=0.01, reversal_spread=0.005)
    speeds = [0.03 * (-1.0) ** i for i in range(400)]
    first = turned(SkidEffects(config, 7), speeds)[1:]
    assert first == turned(SkidEffects(config, 7), speeds)[1:]
    assert first != turned(SkidEffects(config, 8), speeds)[1:]
    assert np.mean(first) == pytest.approx(0.01, abs=1e-3)
    assert np.std(first) == pytest.approx(0.005, rel=0.15)


def test_a_slide_keeps_its_direction_on_the_ground_and_ends_with_the_wheels():
    effects = SkidEffects(SkidModelConfig(drift_x=1e-4, drift_y=-2e-4), None)
    for yaw in (0.0, 1.0, -2.0):
        vx, vy, _ = effects.twist((0.03, 0.0, 0.0), yaw, DT)
        c, s = math.cos(yaw), math.sin(yaw)
        slid = c * (vx - 0.03) - s * vy, s * (vx - 0.03) + c * vy
        assert slid == pytest.approx((1e-4, -2e-4))
    assert effects.twist((0.0, 0.0, 0.0), 0.5, DT) == (0.0, 0.0, 0.0)


def test_wheels_are_not_identical():
    assert SkidEffects(SkidModelConfig(wheel_gains=(1.0, 1.1)), None).wheel_speeds([0.1, 0.1]) == pytest.approx(
        [0.1, 0.11]
    )
    with pytest.raises(ValidationError, match="expected one for each of the shafts left, right"):
        SimTruckConfig.model_validate({"body": {"kind": "skid_steer"}, "skid": {"wheel_gains": [1.0]}})
