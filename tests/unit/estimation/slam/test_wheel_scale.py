"""Scale of the wheels: found where the ground changes, not moved by one wrong stretch, and 1 within their error."""

import numpy as np
import pytest

from monstertruck_estimation.slam.config import MapperConfig
from monstertruck_estimation.slam.motion import MotionPredictor
from monstertruck_estimation.slam.scan_matcher import MatchStatus, ScanMatch
from monstertruck_estimation.slam.wheel_scale import WheelScale
from monstertruck_schemas.health import OdometryUse

STEP = np.array((0.1, 0.01, 0.05))


def drive(scale: WheelScale, metres: float, factor: float, rng=None):
    for _ in range(round(metres / 0.1)):
        noise = np.zeros(3) if rng is None else rng.normal(0.0, (0.005, 0.005, 0.003))
        scale.add(STEP * (factor, factor, 1.0), STEP + noise)


def test_a_carpet_is_found_within_3_m_and_left_again():
    scale, rng = WheelScale(0.1, 0.02), np.random.default_rng(3)
    drive(scale, 10.0, 1.02, rng)
    assert scale.value == pytest.approx(1 / 1.02, abs=0.02)
    assert scale.factor == 1.0, "wheels are within their stated deviation"
    drive(scale, 3.0, 1.3, rng)
    assert scale.factor == pytest.approx(1 / 1.3, abs=0.03)
    drive(scale, 3.0, 1.0, rng)
    assert scale.factor == 1.0


def test_one_wrong_stretch_is_no_other_ground():
    scale = WheelScale(0.1, 0.02)
    drive(scale, 10.0, 1.0)
    scale.add(STEP, STEP + np.array((0.4, 0.0, 0.0)))
    drive(scale, 2.0, 1.0)
    assert scale.value == pytest.approx(1.0, abs=0.02)


def test_turns_that_wheels_measure_wrongly_are_no_scale():
    scale = WheelScale(0.1, 0.02)
    for _ in range(100):
        scale.add(np.array((0.3, 0.0, -0.4)), np.array((0.3, 0.0, 0.1)))
    assert scale.value == pytest.approx(1.0, abs=0.02)


def test_the_motion_is_predicted_with_the_scale_and_wheels_stay_in_use():
    model, odom = MotionPredictor(MapperConfig()), 0.0
    delta = np.zeros(3)
    for _ in range(80):
        odom += 0.13
        delta, noise = model.predict(0.2, np.array((odom, 0.0, 0.0)))
        match = ScanMatch(np.zeros(3), noise, 0.95, 0.01, 0.5, 0.0, MatchStatus.ACCEPTED, np.eye(3))
        model.learn(0.2, delta, noise, np.array((0.1, 0.0, 0.0)), match)
    assert model.use is OdometryUse.USED
    assert delta[0] == pytest.approx(0.1, abs=0.003)
