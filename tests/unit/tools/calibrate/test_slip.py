"""Turning centres from arcs between rests."""

import pytest

from monstertruck_kinematics.se2 import integrate
from monstertruck_kinematics.unsteered import SkidSteer
from monstertruck_runtime.errors import InputError
from monstertruckd.tools.calibrate.slip import SkidArc, result_of

TRUTH = {"icr_left": 0.08, "icr_right": -0.07, "icr_x": -0.01, "gain_left": 1.05, "gain_right": 0.98}


def arcs(pairs, **other):
    robot = SkidSteer(0.021, **(TRUTH | other))
    found = []
    for left, right in pairs:
        x, y, yaw = integrate((0.0, 0.0, 0.0), *robot.forward((left, right)), 1.0)
        found.append(SkidArc(left, right, (x, y, yaw), (0.0002, 0.0005)))
    return found


def test_turning_centres_and_wheels():
    result = result_of(arcs([(8.0, 12.0), (12.0, 8.0), (-5.0, -12.0), (12.0, 5.0), (20.0, 20.0)]), 0.021, 0.0525)
    assert {e.name: e.value for e in result.estimates} == pytest.approx(TRUTH, abs=1e-4)
    assert {e.key for e in result.estimates} == {f"body.{name}" for name in TRUTH}


def test_arcs_to_one_side_are_refused():
    with pytest.raises(InputError, match="in both directions"):
        result_of(arcs([(8.0, 12.0)] * 5), 0.021, 0.0525)


@pytest.mark.parametrize(("true", "taken"), [(0.0001, True), (0.02, False)])
def test_centres_before_the_base_by_less_than_the_error_are_at_it(true: float, taken: bool):
    pairs = [(8.0, 12.0), (12.0, 8.0), (-5.0, -12.0), (12.0, 5.0), (20.0, 20.0)]
    found = result_of(arcs(pairs, icr_x=true), 0.021, 0.0525).estimate("icr_x")
    assert found is not None
    assert (found.value == 0.0, found.high == 0.0) == (taken, taken)
    assert found.low < found.value <= found.high
