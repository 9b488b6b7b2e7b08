"""Servos that answer late."""

import math

import pytest

from monstertruck_sim.world.actuators import Servo
from monstertruck_sim.world.config import ServoModelConfig

STEP = 0.005


def angles(seconds=0.4, **config):
    """Arm angle after each step, the pulse of 10 degrees to the left given at 0."""
    servo = Servo(ServoModelConfig(channel=1, rate=100.0, **config))
    found = []
    for k in range(round(seconds / STEP)):
        if k % 4 == 0:
            servo.latch(1439.2 - 104.8)
        servo.step(STEP)
        found.append(servo.angle)
    return found


def test_a_servo_moves_after_its_dead_time():
    found = angles(dead_time=0.06)
    assert not any(found[:12])
    assert found[12] == pytest.approx(math.radians(10), rel=0.01)
    assert angles()[0] == found[12]


def test_a_servo_turns_with_its_lag():
    found = angles(dead_time=0.02, lag=0.1)
    for k in (3, 20, 50):
        expected = math.radians(10) * -math.expm1(-max((k + 1) * STEP - 0.02, 0.0) / 0.1)
        assert found[k] == pytest.approx(expected, rel=0.01, abs=1e-9)


def test_a_servo_moves_when_its_dead_time_ends_within_a_step():
    found = angles(dead_time=0.0625, lag=0.1)
    assert not any(found[:12])
    assert found[12] == pytest.approx(math.radians(10) * -math.expm1(-0.0025 / 0.1), rel=0.01)
