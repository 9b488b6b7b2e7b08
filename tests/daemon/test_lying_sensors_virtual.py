"""Plausible sensors that lie, through the whole daemon: noticed before the truck touches the post ahead of it."""

from itertools import product

import pytest

from benchmarks.lying_sensors import CASES, GAP, quiet, trial
from monstertruck_schemas.reasons import Reason
from tests.long_kit import mostly_long

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(300)]


@pytest.mark.parametrize(
    ("case", "world", "seed"), [("repeated", "loop", 1), ("noisy", "rooms", 1), ("late", "loop", 0)]
)
def test_scans_that_do_not_follow_the_truck(case, world, seed):
    outcome = trial(CASES[case], world, seed)
    assert not outcome.contact
    assert outcome.noticed is not None
    assert outcome.driven < GAP


def test_a_repeated_revolution_keeps_the_truck_from_being_armed():
    outcome = trial(CASES["repeated"], "loop", 0)
    assert outcome.reason == Reason.SENSOR_FROZEN
    assert outcome.driven == 0.0


@pytest.mark.parametrize("case", ["doubled", "half-odometry"])
def test_measures_of_a_wrong_scale(case):
    outcome = trial(CASES[case], "loop", 1)
    assert not outcome.contact
    assert outcome.reason == Reason.SENSORS_DISAGREE


@pytest.mark.parametrize(
    ("case", "seed"), mostly_long(product(("doubled", "halved"), (0, 1)), {("doubled", 1), ("halved", 0)})
)
def test_a_scale_that_changes_is_noticed_by_the_next_revolution(case, seed):
    """At rest (seed 0) and while it drives."""
    outcome = trial(CASES[case], "rooms", seed)
    assert not outcome.contact
    assert outcome.reason == Reason.SENSORS_DISAGREE
    assert outcome.driven <= 0.05


def test_a_frozen_compass():
    outcome = trial(CASES["compass"], "loop", 1)
    assert outcome.noticed is not None
    assert outcome.noticed < 3.0


@pytest.mark.parametrize("slip", [pytest.param(0.0, marks=pytest.mark.long), 0.3])
def test_the_demo_raises_no_alarm_not_even_with_wheels_that_slip(slip):
    found = quiet("demo.yaml", 12.0, {"sim": {"world": {"truck": {"motor": {"ratio": 644.0 / (1.0 - slip)}}}}})
    assert found.alarms == ()
    assert found.measures == ("wheels", "scans", "compass")
    assert found.driven > 1.0


def test_without_a_second_measure_the_truck_is_slow():
    overlay = {
        "devices": {"compass": None},
        "consistency": {"scans": None},
        "gate": {"attitude": {"critical": False, "stale_after": 0.25}},
    }
    alone, both = quiet("demo.yaml", 6.0, overlay), quiet("demo.yaml", 6.0, {})
    assert alone.measures == ("wheels",)
    assert alone.driven < 0.75 * both.driven
