"""An inertial measurement unit in base: the vertical, and the rate of the heading on a slope."""

import math

import pytest

from monstertruck_estimation.gyro import GyroConfig
from monstertruck_estimation.inertial import Inertial, InertialTilt
from monstertruck_estimation.transforms import conjugate, quaternion_from_rpy, rotate
from monstertruck_runtime.clock import SECOND
from tests.unit.estimation.fusion.kit import imu

LEVEL = (0.0, 0.0, 9.81)
NOSE_DOWN = (-9.81 * math.sin(0.3), 0.0, 9.81 * math.cos(0.3))


def observed(tilt, seconds, *, rate=(0.0, 0.0, 0.0), force=LEVEL, start=0):
    """Feed a hundred a second; returns when it ended."""
    for i in range(1, round(seconds * 100) + 1):
        tilt.observe(start + i * SECOND // 100, rate, force)
    return start + round(seconds * SECOND)


def test_the_tilt_is_that_of_the_force_at_rest():
    tilt = InertialTilt()
    now = observed(tilt, 0.1, force=NOSE_DOWN)
    assert tilt.tilt(now) == pytest.approx((0.0, 0.3), abs=1e-6)
    assert tilt.tilt(now + SECOND) is None


def test_gyroscopes_turn_it_and_a_push_hardly_does():
    tilt = InertialTilt()
    now = observed(tilt, 0.5)
    now = observed(tilt, 0.5, force=(0.9, 0.0, 9.8), start=now)  # 0.9 m/s^2 for half a second
    assert abs(tilt.tilt(now).pitch) < 0.03
    now = observed(tilt, 0.5, rate=(0.0, 0.6, 0.0), force=(0.0, 0.0, 20.0), start=now)  # over an edge, with a blow
    assert tilt.tilt(now).pitch == pytest.approx(0.3, abs=0.03)


@pytest.mark.parametrize("force", [(0.0, 0.0, 0.0), (0.0, 0.0, -9.81)], ids=["no force at all", "upside down"])
def test_without_a_plausible_force_there_is_no_tilt_and_the_rate_is_that_about_z(force):
    tilt = InertialTilt()
    now = observed(tilt, 0.1, force=force)
    assert tilt.tilt(now) is None
    assert tilt.yaw_rate((0.1, 0.2, 0.3)) == 0.3


def test_a_force_that_stays_implausible_ends_the_tilt():
    tilt = InertialTilt()
    now = observed(tilt, 6.0, force=(0.0, 0.0, 5.0), start=observed(tilt, 0.1))
    assert tilt.tilt(now) is None


@pytest.mark.parametrize("mount", [(0.0, 0.0, 0.0), (math.pi, 0.0, 0.5), (math.pi / 2, 0.0, 0.0)])
def test_the_rate_of_the_heading_on_a_slope_by_a_unit_mounted_as_it_may_be(mount):
    unit = Inertial(GyroConfig(), rotation := quaternion_from_rpy(*mount))
    back = conjugate(rotation)
    heading = (-0.4 * math.sin(0.3), 0.0, 0.4 * math.cos(0.3))  # turns with 0.4 rad/s, nose down
    for i in range(1, 50):
        now = i * SECOND // 100
        unit.observe(imu(now, rotate(back, heading), rotate(back, NOSE_DOWN)))
    assert unit.gyro._rates[-1][1] == pytest.approx(0.4, abs=0.01)
