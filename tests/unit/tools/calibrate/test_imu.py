"""Biases at rest and the scale of the yaw rate."""

import math

import numpy as np
import pytest

from monstertruck_drivers.inertial import corrected_force, corrected_rate
from monstertruck_drivers.wt61.config import ImuCorrection
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError
from monstertruck_schemas import topics
from monstertruck_schemas.sensor import Attitude, Imu, Vector3
from monstertruckd.tools.calibrate.imu import Turn, rate_scale, result_of
from monstertruckd.tools.calibrate.statistics import Interval
from monstertruckd.tools.calibrate.steps import MoveRecord

NONE = {"rate_x": 0.0, "rate_y": 0.0, "rate_z": 0.0, "rate_scale": 1.0, "force_x": 0.0, "force_y": 0.0}
LEVEL = [Attitude(stamp=1, received=1, seq=1, heading=0.0, pitch=0.0, roll=0.0)]


def resting(rate=(0.01, -0.02, 0.005), noise=0.003, count=200):
    rng = np.random.default_rng(1)
    return [
        Imu(
            stamp=k,
            received=k,
            seq=k,
            angular_velocity=Vector3(**dict(zip("xyz", (rate + noise * rng.standard_normal(3)).tolist(), strict=True))),
            linear_acceleration=Vector3(x=0.1 + 0.01 * rng.standard_normal(), y=-0.05, z=9.8),
        )
        for k in range(count)
    ]


def test_biases_are_means_at_rest_and_the_scale_stays_without_turns():
    result = result_of(resting(), LEVEL, [], NONE)
    found = {e.name: e.value for e in result.estimates}
    assert (found["rate_x"], found["rate_y"], found["rate_z"]) == pytest.approx((0.01, -0.02, 0.005), abs=1e-3)
    assert found["force_x"] == pytest.approx(0.1, abs=0.01)
    assert "rate_scale" not in found
    assert result.partial


def test_what_is_corrected_already_adds_to_it():
    before = NONE | {"rate_z": 0.5, "rate_scale": 2.0}
    found = {e.name: e.value for e in result_of(resting(rate=(0.0, 0.0, 0.02)), LEVEL, [], before).estimates}
    assert found["rate_z"] == pytest.approx(0.5 + 0.02 / 2, abs=1e-3)


def test_a_unit_that_is_moved_is_refused():
    with pytest.raises(InputError, match="was moved"):
        result_of(resting(noise=0.1), LEVEL, [], NONE)


def test_the_scale_makes_a_full_turn_one():
    turns = [Turn(1.04 * side * 6.3 + 0.005 * 20, 20.0, side * 6.3, 0.003) for side in (1, -1)]
    assert rate_scale(turns, Interval(0.005, 0.0005)).value == pytest.approx(1 / 1.04, rel=1e-4)
    with pytest.raises(InputError, match="one in each direction"):
        rate_scale(turns[:1] * 2, Interval(0.0, 0.001))


@pytest.mark.parametrize(
    ("lost", "said"), [(range(0), None), (range(40, 70), "silent for 3.1 s"), (range(80, 101), "s")]
)
def test_a_unit_that_was_silent_while_the_truck_turned_is_refused(lost, said):
    def stamped(model, k, **values):
        return model(stamp=k * SECOND // 10, received=k, seq=k, **values)

    yaw = [0.0 if k < 20 else min(k - 20, 60) * math.tau / 60 for k in range(101)]
    rate = [math.tau / 6 if 20 <= k < 80 else 0.0 for k in range(101)]
    record = MoveRecord(
        attitude=[stamped(Attitude, k, heading=(-y) % math.tau, pitch=0.0, roll=0.0) for k, y in enumerate(yaw)],
        left=2 * SECOND,
        arrived=9 * SECOND,
    )
    force = Vector3(x=0.0, y=0.0, z=9.8)
    record.others[topics.IMU.name] = [
        stamped(Imu, k, angular_velocity=Vector3(x=0.0, y=0.0, z=w), linear_acceleration=force)
        for k, w in enumerate(rate)
        if k not in lost
    ]
    if said is None:
        turn = Turn.of(record, 0.0, 1.0)
        assert (turn.integral, turn.turned) == pytest.approx((math.tau, math.tau), rel=0.02)
        return
    with pytest.raises(InputError, match=said):
        Turn.of(record, 0.0, 1.0)


def test_the_driver_takes_them_out():
    by = ImuCorrection(rate_x=0.1, rate_z=0.2, rate_scale=1.5, force_y=-0.3)
    rate, force = corrected_rate((0.1, 0.2, 1.2), by), corrected_force((1.0, 2.0, 9.8), by)
    assert (rate.x, rate.y, rate.z) == pytest.approx((0.0, 0.2, 1.5))
    assert (force.x, force.y, force.z) == pytest.approx((1.0, 2.3, 9.8))
    assert math.isfinite(rate.z)
