"""Intervals of the voltage scale from readings of a meter."""

import math

import numpy as np
import pytest

from monstertruck_runtime.errors import InputError
from monstertruckd.tools.calibrate.battery import EARTHING, BatteryWizard, MeterReading

WIZARD = BatteryWizard(meter_share=0.005, meter_digits=0.02)


def test_one_reading_tells_the_scale_but_not_the_offset():
    gain, offset = WIZARD.scale([MeterReading(24.0, 24.6, 0.0)])
    assert gain.value == pytest.approx(24.6 / 24.0)
    assert gain.half == pytest.approx(1.96 / math.sqrt(3) * math.hypot(0.005 * 24.6, 0.02, EARTHING) / 24.0, rel=1e-3)
    assert offset.value == pytest.approx(0.0, abs=1e-6)
    assert offset.half == EARTHING


def test_readings_far_apart_with_a_good_meter_tell_the_offset():
    fine = BatteryWizard(meter_share=0.0, meter_digits=0.002)
    gain, offset = fine.scale([MeterReading(raw, 1.02 * raw + 0.05, 0.0) for raw in (20.0, 24.5)])
    assert offset.value == pytest.approx(0.05, abs=0.002)
    assert offset.half < 0.03
    assert gain.value == pytest.approx(1.02, abs=1e-3)


def test_the_truth_is_inside_as_often_as_stated_whatever_the_meter_does_within_its_bounds():
    rng, inside = np.random.default_rng(3), []
    for _ in range(300):
        true_gain, true_offset = rng.uniform(0.9, 1.1), rng.uniform(-EARTHING, EARTHING)
        raws = rng.uniform(19, 25, int(rng.integers(1, 4)))
        volts = true_gain * raws + true_offset
        shown = volts * (1 + rng.uniform(-0.0049, 0.0049)) + rng.uniform(-0.02, 0.02, raws.size)
        gain, offset = WIZARD.scale([MeterReading(raw, volt, 0.0) for raw, volt in zip(raws, shown, strict=True)])
        inside.append((gain.low <= true_gain <= gain.high, offset.low <= true_offset <= offset.high))
    assert (np.mean(inside, axis=0) >= 0.92).all()


def test_readings_that_contradict_each_other_are_refused():
    with pytest.raises(InputError, match=r"no scale fits all 2 readings.*--fresh"):
        WIZARD.scale([MeterReading(24.0, 24.6, 0.0), MeterReading(20.0, 22.6, 0.0)])


@pytest.mark.parametrize("share", [0.005, 0.0])
def test_a_meter_that_is_said_to_have_no_digits_to_spare_breaks_no_fit(share: float):
    """A fine converter gives the same reading every time."""
    wizard = BatteryWizard(meter_share=share, meter_digits=0.0)
    gain, offset = wizard.scale([MeterReading(raw, 1.0135 * raw, 0.0) for raw in (7.4, 8.2)])
    assert gain.value == pytest.approx(1.0135, abs=1e-3)
    assert gain.half > 1e-4
    assert offset.value == pytest.approx(0.0, abs=0.01)
