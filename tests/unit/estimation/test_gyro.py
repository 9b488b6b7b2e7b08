"""The yaw rate of an IMU: its bias, and what it is judged by."""

import pytest

from monstertruck_estimation.gyro import Gyro, GyroConfig

STEP = 20_000_000


def run(gyro, seconds, *, wheels, rate, distance=0.004, start=0):
    """Feed both at 50 Hz; returns the last answer and the time."""
    answer, now = None, start
    for _ in range(round(seconds * 50)):
        now += STEP
        if rate is not None:
            gyro.observe(now, rate)
        answer = gyro.turned(now - STEP, now, wheels, distance)
    return answer, now


def at_rest(bias=0.02):
    gyro = Gyro(GyroConfig())
    return gyro, run(gyro, 1.0, wheels=0.0, rate=bias, distance=0.0)[1]


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


def test_a_bias_that_creeps_away_is_given_up_until_the_robot_rests():
    gyro, now = at_rest(0.0)
    answers = []
    for k in range(50):
        answer, now = run(gyro, 1.0, wheels=0.0, rate=0.0005 * k, start=now)
        answers.append(answer)
    assert answers[20] is not None
    assert abs(gyro.difference) < 0.5, "it has not turned the heading by more than that in 20 s"
    assert (answers[-1], gyro.bias, gyro.trusted) == (None, None, False)
    now = run(gyro, 1.0, wheels=0.0, rate=0.025, distance=0.0, start=now)[1]
    answer, _ = run(gyro, 2.0, wheels=0.4, rate=0.425, start=now)
    assert answer == pytest.approx(0.4), "it rested, and turns with the wheels"


def test_a_good_gyroscope_keeps_its_trust_though_wheels_are_a_little_off():
    gyro, now = at_rest(0.0)
    for k in range(60):
        turn = 0.4 if k % 20 < 10 else -0.4
        answer, now = run(gyro, 1.0, wheels=turn * 1.1 + 0.008, rate=turn, start=now)
    assert answer == pytest.approx(-0.4)


def test_the_drift_of_its_bias_makes_the_turn_uncertain_by_the_cube_of_the_time_since_a_rest():
    gyro, now = at_rest(0.0)
    times = range(100)
    summed = sum(gyro.variance(now + round((k + 0.5) * 1e9), 1.0, 0.1) for k in times)
    assert summed**0.5 == pytest.approx(GyroConfig().drift * len(times) ** 2 / 2, rel=0.02)
    assert gyro.variance(now + 10**11, 1.0, 0.0) == 0.0, "a robot that stands does not turn"
    assert Gyro(GyroConfig()).variance(10**15, 1.0, 0.1) == 0.0, "it is not used before it rested"
