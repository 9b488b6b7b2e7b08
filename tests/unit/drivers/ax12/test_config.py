"""Calibration arithmetic and what the configuration refuses."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from monstertruck_drivers.ax12.config import AlarmConfig, Ax12Config, JointConfig
from monstertruck_drivers.ax12.protocol import SPEED_UNIT, STEP


def test_defaults_are_the_robot():
    config = Ax12Config()
    assert (config.pitch.id, config.pitch.zero, config.roll.id, config.roll.zero) == (1, 511, 2, 204)
    assert config.pitch.position(0.0) == 511
    assert config.pitch.position(1.0) == 613
    assert config.roll.position(-1.0) == 102
    assert config.roll.angle(306) == pytest.approx(0.522, abs=0.001)


@given(st.floats(-0.52, 0.52), st.sampled_from([-1, 1]))
def test_angle_and_position_are_inverse(angle: float, direction: int):
    joint = JointConfig(id=1, zero=511, min_position=409, max_position=613, direction=direction)
    assert joint.angle(joint.position(angle)) == pytest.approx(angle, abs=STEP / 2 + 1e-9)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"zero": 400}, "expected min_position 409 < zero 400 < max_position 613"),
        ({"max_position": 1024}, "less than or equal to 1023"),
        ({"id": 253}, "less than or equal to 252"),
        ({"direction": 0}, "-1 or 1"),
    ],
)
def test_impossible_joints_are_refused(change: dict[str, int], text: str):
    with pytest.raises(ValidationError, match=text):
        JointConfig(**({"id": 1, "zero": 511, "min_position": 409, "max_position": 613} | change))


def test_one_id_for_both_is_refused():
    with pytest.raises(ValidationError, match="pitch and roll need different ids, both have 1"):
        Ax12Config(roll=JointConfig(id=1, zero=204, min_position=102, max_position=306))


def test_rests_in_order():
    with pytest.raises(ValidationError, match=r"expected rest 9\.0 <= rest_max 8\.0"):
        AlarmConfig(rest=9.0, rest_max=8.0)


def test_absent_units_are_never_asked_more_than_once_a_second():
    with pytest.raises(ValidationError, match="greater than or equal to 1"):
        Ax12Config(absent_interval=0.5)


def test_a_tiny_speed_never_becomes_unlimited():
    assert Ax12Config(speed=SPEED_UNIT / 10).speed_word == 1
    with pytest.raises(ValidationError, match="less than or equal to"):
        Ax12Config(speed=12.0)
