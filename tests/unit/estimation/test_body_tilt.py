"""The body's tilt by its compass without what its own acceleration adds."""

import math

import pytest

from monstertruck_estimation.body_tilt import BodyAcceleration, without
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.sensor import Attitude
from tests.unit.estimation.kit import felt_tilt
from tests.unit.planners.behave.wall_kit import odometry


@pytest.mark.parametrize(("forward", "left"), [(0.9, 0.0), (-1.2, 0.0), (0.0, 0.8), (0.5, -0.6)])
@pytest.mark.parametrize(("roll", "pitch"), [(0.0, 0.0), (0.1, -0.15)])
def test_the_bodys_acceleration_is_taken_out_of_its_tilt(forward, left, roll, pitch):
    measured = felt_tilt(forward, left, roll, pitch)
    assert math.dist(measured, (roll, pitch)) > 0.05
    assert without((forward, left), measured) == pytest.approx((roll, pitch), abs=0.004)


def test_acceleration_is_that_of_the_speeds_before_the_reading():
    body = BodyAcceleration(0.06)
    assert body.at(SECOND) == (0.0, 0.0)
    for i in range(20):
        t = 0.02 * i
        body.observe(odometry(vx=0.5 * t, wz=0.4, now=round(t * SECOND)))
    assert body.at(round(0.38 * SECOND)) == pytest.approx((0.5, 0.4 * 0.5 * 0.35))
    assert body.at(round(0.05 * SECOND)) == (0.0, 0.0)  # too little is known
    assert body.at(SECOND) == (0.0, 0.0)  # the odometry is silent
    assert body.at(round(0.44 * SECOND)) == (0.0, 0.0)  # its newest is as old as the oldest that is wanted
    body.observe(odometry(vx=9.0, now=round(0.40 * SECOND)))  # spinning wheels
    assert body.at(round(0.40 * SECOND))[0] == 0.0


def test_a_truck_that_brakes_on_the_level_is_level():
    body = BodyAcceleration()
    for i in range(10):
        body.observe(odometry(vx=0.5 - 0.02 * i, now=round(0.02 * i * SECOND)))  # 1 m/s^2
    braking = felt_tilt(-1.0, 0.0, 0.0, 0.0)
    stamp = round(0.18 * SECOND)
    reading = Attitude(stamp=stamp, received=stamp, seq=0, heading=0.0, roll=braking.roll, pitch=braking.pitch)
    assert braking.pitch > 0.1
    assert body.tilt(reading) == pytest.approx((0.0, 0.0), abs=0.001)
