"""Servo calibration and refused configurations."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from monstertruck_drivers.maestro.config import BatteryInputConfig, MaestroConfig, ServoConfig


def test_pulse_map_of_the_truck():
    servo = ServoConfig(channel=1)
    assert servo.quarters(0.0) == round(4 * 1439.2)
    assert servo.quarters(math.radians(10)) == round(4 * (1439.2 - 104.8))
    assert ServoConfig(channel=1, direction=1).quarters(math.radians(10)) == round(4 * (1439.2 + 104.8))


def test_fractions_of_a_degree_survive():
    servo = ServoConfig(channel=0)
    assert servo.quarters(math.radians(0.1)) != servo.quarters(math.radians(0.15))


def test_targets_stay_within_angle_and_pulse_limits():
    servo = ServoConfig(channel=1)
    assert servo.quarters(math.radians(89)) == 4 * 1088
    assert servo.quarters(math.radians(-89)) == 4 * 1840
    narrow = ServoConfig(channel=1, max_angle_deg=10.0)
    assert narrow.quarters(1.0) == narrow.quarters(math.radians(10))


@given(st.floats(-0.55, 0.55), st.sampled_from([-1, 1]))
def test_angle_and_pulse_are_inverse_to_a_quarter_microsecond(angle: float, direction: int):
    servo = ServoConfig(channel=1, direction=direction)
    assert servo.angle(servo.quarters(angle)) == pytest.approx(angle, abs=math.radians(0.125 / 10.48) + 1e-9)


def test_adc_scale():
    assert BatteryInputConfig().volts(516) == pytest.approx(25.22, abs=0.005)
    assert BatteryInputConfig(gain=1.01, offset=-0.1).volts(516) == pytest.approx(25.22 * 1.01 - 0.1, abs=0.005)


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: ServoConfig(channel=1, centre_us=1900.0), "centre_us 1900.0"),
        (lambda: ServoConfig(channel=6), "less than 6"),
        (lambda: ServoConfig(channel=1, direction=0), "-1 or 1"),
        (lambda: BatteryInputConfig(low=22.5), "low 22.5 < clear 22.4"),
        (lambda: BatteryInputConfig(gain=0.4), "reading 1023"),
        (lambda: BatteryInputConfig(offset=16.0), "reading 0"),
        (lambda: MaestroConfig(deadman_channel=5), "only one use"),
        (lambda: MaestroConfig(rear=ServoConfig(channel=1)), "only one use"),
        (lambda: MaestroConfig(baud=9600), "Extra inputs"),
    ],
)
def test_bad_configurations_are_refused_by_name(make, text: str):
    with pytest.raises(ValidationError, match=text):
        make()


def test_no_battery_frees_its_channel():
    assert MaestroConfig(battery=None, deadman_channel=5).battery is None
