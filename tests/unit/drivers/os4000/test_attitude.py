"""Units, signs, range checks and flags of the conversion."""

import math
from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from monstertruck_drivers.os4000.attitude import to_attitude
from monstertruck_drivers.os4000.config import Os4000Config
from monstertruck_drivers.os4000.protocol import Sentence

GOOD = Sentence(90.0, 10.0, 20.0, 24.5, field=(300.0, 0.0, -400.0), acceleration=(0.0, 0.0, 1.0))


def convert(sentence: Sentence, **config: object):
    return to_attitude(sentence, Os4000Config(**config), stamp=1, received=2, seq=3)


def test_units_and_signs():
    attitude = convert(GOOD)
    assert attitude.heading == pytest.approx(math.pi / 2)
    assert attitude.pitch == pytest.approx(-math.radians(10)), "nose up is negative about y"
    assert attitude.roll == pytest.approx(math.radians(20)), "right side down is positive about x"
    assert attitude.temperature == 24.5
    assert attitude.magnetic_field is not None
    assert (attitude.magnetic_field.x, attitude.magnetic_field.z) == pytest.approx((30.0, -40.0))
    assert attitude.acceleration is not None
    assert attitude.acceleration.z == pytest.approx(9.80665)
    assert (attitude.stamp, attitude.received, attitude.seq, attitude.frame) == (1, 2, 3, "base")


def test_tilt_agrees_with_the_acceleration_of_a_real_sample():
    attitude = convert(Sentence(212.4, 2.5, -14.0, 28.4, acceleration=(0.045, -0.245, 0.977)))
    assert attitude.acceleration is not None
    # Gravity's reaction in a body turned by roll about x and pitch about y (REP 103).
    assert -math.sin(attitude.pitch) * 9.80665 == pytest.approx(attitude.acceleration.x, abs=0.05)
    assert math.sin(attitude.roll) * math.cos(attitude.pitch) * 9.80665 == pytest.approx(
        attitude.acceleration.y, abs=0.05
    )


def test_absent_fields_stay_absent():
    attitude = convert(Sentence(1.0, 2.0, 3.0))
    assert (attitude.temperature, attitude.magnetic_field, attitude.acceleration) == (None, None, None)
    assert attitude.tilt_valid
    assert not attitude.heading_disturbed


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"heading": 360.0}, "heading 360.0"),
        ({"heading": -0.1}, "heading -0.1"),
        ({"heading": None}, "heading None"),
        ({"pitch": 90.1}, "pitch 90.1"),
        ({"pitch": None}, "pitch None"),
        ({"roll": -180.1}, "roll -180.1"),
        ({"roll": None}, "roll None"),
    ],
)
def test_out_of_range_is_refused_by_name(values: dict[str, float | None], text: str):
    with pytest.raises(ValueError, match=text):
        convert(replace(GOOD, **values))


def test_the_limits_themselves_are_fine():
    convert(Sentence(0.0, 90.0, 180.0))
    convert(Sentence(359.9, -90.0, -180.0))


@pytest.mark.parametrize(
    ("sentence", "disturbed"),
    [
        (GOOD, False),  # 500 mG = 50 uT
        (replace(GOOD, field=(300.0, 0.0, -550.0)), True),
        (replace(GOOD, field=(100.0, 0.0, -200.0)), True),
        (replace(GOOD, field=None, field_length=610.0), False),
        (replace(GOOD, field=None, field_length=640.0), True),
        (replace(GOOD, field=None), False),
    ],
)
def test_a_field_far_from_the_calibrated_one_disturbs(sentence: Sentence, disturbed: bool):
    assert convert(sentence, field_strength=50.0).heading_disturbed is disturbed
    assert convert(sentence).heading_disturbed is False, "unknown strength: no check"


@pytest.mark.parametrize(("g", "valid"), [(1.0, True), (1.19, True), (1.21, False), (0.81, True), (0.79, False)])
def test_tilt_needs_one_g(g: float, valid: bool):
    assert convert(replace(GOOD, acceleration=(0.0, 0.0, g))).tilt_valid is valid
    assert convert(replace(GOOD, acceleration=None, acceleration_length=g)).tilt_valid is valid


@pytest.mark.parametrize(
    ("config", "text"),
    [({"fields": 8 + 64}, "lacks heading"), ({"rate": 41}, "40"), ({"rate": 0}, "1"), ({"baud": 1}, "Extra")],
)
def test_bad_configurations_are_refused(config: dict[str, int], text: str):
    with pytest.raises(ValidationError, match=text):
        Os4000Config(**config)


IRON = {"hard_x": 6.0, "hard_y": -3.0, "soft_xx": 1.1, "soft_xy": 0.05, "soft_yy": (1 + 0.05**2) / 1.1}


@pytest.mark.parametrize("degrees", [0.0, 40.0, 135.0, 250.0, 359.0])
@pytest.mark.parametrize(("pitch", "roll"), [(0.0, 0.0), (8.0, -5.0)])
def test_calibrated_iron_is_taken_out_of_the_heading(degrees: float, pitch: float, roll: float):
    truth, nose_down, right_down = math.radians(degrees), -math.radians(pitch), math.radians(roll)
    x, y, z = 25 * math.cos(truth), 25 * math.sin(truth), -39.0
    # Into the body: Rx(-roll) Ry(-pitch).
    x, z = math.cos(nose_down) * x - math.sin(nose_down) * z, math.sin(nose_down) * x + math.cos(nose_down) * z
    y, z = math.cos(right_down) * y + math.sin(right_down) * z, math.cos(right_down) * z - math.sin(right_down) * y
    soft = [[IRON["soft_xx"], IRON["soft_xy"]], [IRON["soft_xy"], IRON["soft_yy"]]]
    x, y = np.linalg.solve(soft, (x, y)) + np.array((IRON["hard_x"], IRON["hard_y"]))
    felt = Sentence(123.4, pitch, roll, 20.0, field=(x * 10, y * 10, z * 10))
    assert convert(felt).heading == pytest.approx(math.radians(123.4)), "the unit is believed without a calibration"
    attitude = convert(felt, iron=IRON)
    assert math.remainder(attitude.heading - truth, 2 * math.pi) == pytest.approx(0, abs=1e-9)
    assert attitude.magnetic_field is not None
    assert attitude.magnetic_field.x == pytest.approx(x), "the field stays as measured"


def test_a_calibrated_heading_needs_the_field():
    with pytest.raises(ValueError, match="field is missing"):
        convert(Sentence(1.0, 2.0, 3.0), iron=IRON)
    with pytest.raises(ValidationError, match="lacks the magnetic field"):
        Os4000Config(fields=15, iron=IRON)
    with pytest.raises(ValidationError, match="root of soft_xx"):
        Os4000Config(iron={"soft_xy": 1.2})
