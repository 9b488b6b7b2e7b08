"""Intervals from few measurements keep what they promise."""

import numpy as np
import pytest

from monstertruckd.tools.calibrate.statistics import Interval, correlation_factor, mean_interval, student


@pytest.mark.parametrize(("freedom", "expected"), [(1, 12.706), (3, 3.182), (30, 2.042), (60, 2.000), (1000, 1.962)])
def test_student(freedom: int, expected: float):
    assert student(freedom) == pytest.approx(expected, abs=0.002)


def test_a_single_value_has_no_spread():
    with pytest.raises(ValueError, match="at least 1"):
        student(0)


@pytest.mark.parametrize("count", [3, 4, 8])
def test_the_mean_lies_inside_as_often_as_promised(count: int):
    rng = np.random.default_rng(count)
    rows = rng.normal(7.0, 0.3, (4000, count))
    inside = np.mean([abs(mean_interval(row).value - 7.0) <= mean_interval(row).half for row in rows])
    assert 0.94 < inside < 0.96


def test_values_that_happen_to_agree_are_no_better_than_the_instrument():
    assert mean_interval([2.0, 2.0, 2.0, 2.0], least_error=0.1).half == pytest.approx(0.098)


def test_interval_arithmetic():
    interval = Interval(10.0, 1.0).widened(0.5).times(-2.0)
    assert (interval.value, interval.low, interval.high) == (-20.0, -23.0, -17.0)


def test_slow_errors_count_as_fewer_readings():
    rng = np.random.default_rng(1)
    white = rng.standard_normal(4000)
    slow = np.convolve(white, np.ones(9) / 3, "valid")
    assert correlation_factor(white) == pytest.approx(1.0, abs=0.1)
    assert correlation_factor(slow) == pytest.approx(3.0, rel=0.2)
    assert correlation_factor(np.zeros(10)) == 1.0
