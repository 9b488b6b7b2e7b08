"""The yaw rate of an IMU: its bias, and what it is judged by."""

import pytest

from monstertruck_estimation.gyro import Gyro, GyroConfig

STEP = 20_000_000


def run(gyro, seconds, *, wheels, rate, way=0.004, start=0):
    """Feed both at 50 Hz; returns the last answer and the time."""
    answer, now = None, start
    for _ in range(round(seconds * 50)):
        now += STEP
        if rate is not None:
            gyro.observe(now, rate)
        answer = gyro.turned(now - STEP, now, wheels, way)
    return answer, now


def at_rest(bias=0.02):
    gyro = Gyro(GyroConfig())
    return gyro, run(gyro, 1.0, wheels=0.0, rate=bias, way=0.0)[1]


def test_the_bias_is_what_it_says_at_rest():
    gyro, now = at_rest()
    assert gyro.bias == pytest.approx(0.02)
    assert run(gyro, 1.0, wheels=0.3, rate=0.32, start=now)[0] == pytest.approx(0.3)


def test_before_it_rested_it_is_left_to_the_wheels():
    assert run(Gyro(GyroConfig()), 1.0, wheels=0.3, rate=0.3)[0] is None


def test_a_robot_that_is_turned_by_hand_teaches_no_bias():
    assert at_rest(bias=0.5)[0].bias is None


@pytest.mark.parametrize("rate", [-0.4, 0.0, 2.0], ids=["wrong sign", "stuck", "too fast"])
def test_a_rate_that_contradicts_the_wheels_is_left_out(rate):
    gyro, now = at_rest(0.0)
    answer, now = run(gyro, 2.0, wheels=0.4, rate=rate, start=now)
    assert answer is None
    assert not gyro.trusted
    answer, _ = run(gyro, 3.0, wheels=0.4, rate=0.4, start=now)
    assert answer == pytest.approx(0.4), "it agreed over a turn"


def test_driving_straight_proves_nothing():
    gyro, now = at_rest(0.0)
    _, now = run(gyro, 2.0, wheels=0.4, rate=-0.4, start=now)
    assert run(gyro, 3.0, wheels=0.0, rate=0.0, start=now)[0] is None


def test_without_rates_the_wheels_go_on():
    gyro, now = at_rest()
    assert run(gyro, 1.0, wheels=0.3, rate=None, start=now)[0] is None
    assert gyro.trusted
