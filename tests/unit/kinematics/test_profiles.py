"""Moves (R, D, phi) under both speed profiles, for every family."""

import math

import numpy as np
import pytest

from monstertruck_kinematics.elementary import KinematicsError
from monstertruck_kinematics.profiles import (
    BasicMove,
    CubicProfile,
    CubicRamp,
    TimedRamp,
    TrapezoidalProfile,
    shortest_ramp,
)
from monstertruck_kinematics.se2 import integrate
from monstertruck_kinematics.steered import Ackermann, Bicycle, FourWheelSteer, IndependentSteer, Synchro, Tricycle
from monstertruck_kinematics.unsteered import Differential, SkidSteer, mecanum, omni

ARCS = (BasicMove.arc(1.0, 0.8), BasicMove.arc(-1.0, -0.5), BasicMove.straight(0.6))
ROBOTS = {
    "differential": (Differential(), (*ARCS, BasicMove.spot(1.0))),
    "tricycle": (Tricycle(), (*ARCS, BasicMove.spot(-1.0))),
    "bicycle": (Bicycle(), ARCS),
    "ackermann": (Ackermann(), ARCS),
    "four-wheel steer": (FourWheelSteer(), ARCS),
    "independent": (IndependentSteer(), (*ARCS, BasicMove.spot(1.0), BasicMove.arc(0.05, 0.3))),
    "synchro": (Synchro(), (*ARCS, BasicMove.spot(1.0))),
    "omni": (omni(), (*ARCS, BasicMove.spot(1.0))),
    "mecanum": (mecanum(), (*ARCS, BasicMove.spot(1.0))),
    "skid steer": (SkidSteer(0.02, 0.07, -0.06), (*ARCS, BasicMove.spot(1.0))),
}


@pytest.mark.parametrize("name", ROBOTS)
def test_every_robot_drives_its_moves_to_their_ends(name):
    drive, moves = ROBOTS[name]
    for move in moves:
        command = drive.inverse(move.direction)
        assert drive.forward(command) == pytest.approx(move.direction, abs=1e-12)
        x, y, yaw = integrate((1.0, 2.0, 0.5), *(part * move.profile_distance for part in move.direction), 1.0)
        assert yaw - 0.5 == pytest.approx(move.angle)
        if move.radius == 0.0:
            assert (x, y) == pytest.approx((1.0, 2.0))
        else:
            chord = move.length if math.isinf(move.radius) else 2.0 * move.radius * math.sin(move.angle / 2.0)
            heading = 0.5 + move.angle / 2.0
            assert (x, y) == pytest.approx((1.0 + chord * math.cos(heading), 2.0 + chord * math.sin(heading)))


@pytest.mark.parametrize("distance", [0.02, 0.5, -0.5, 3.0, 0.0])
@pytest.mark.parametrize("kind", ["trapezoidal", "cubic"])
def test_profiles_run_from_rest_to_rest(distance, kind):
    profile = TrapezoidalProfile(distance, 0.2, 0.4) if kind == "trapezoidal" else CubicProfile(distance, 0.2, 0.5)
    times = np.linspace(-0.1, profile.duration + 0.1, 20001)
    way, speed = profile.position(times), profile.speed(times)
    assert way[[0, -1]] == pytest.approx([0.0, distance], abs=1e-12)
    assert speed[[0, -1]] == pytest.approx([0.0, 0.0], abs=1e-12)
    assert np.abs(speed).max() <= 0.2 + 1e-12
    step = times[1] - times[0]
    np.testing.assert_allclose(np.gradient(way, step), speed, atol=2e-4)
    steepest = 0.4 if kind == "trapezoidal" else 1.5 * 0.2 / 0.5
    assert np.abs(np.diff(speed)).max() / step <= steepest * (1 + 1e-9)
    if abs(distance) >= 0.5:
        assert np.abs(speed).max() == pytest.approx(0.2)


def test_ramp_as_published():
    ramp = CubicRamp(0.0, 0.2, 0.5)
    assert ramp.coefficients == pytest.approx((2.4, -3.2))
    assert CubicRamp(0.2, 0.0, 0.5).coefficients == pytest.approx((-2.4, 3.2))
    assert ramp.acceleration(0.25) == pytest.approx(0.6)
    assert [ramp.speed(t) for t in (-1.0, 0.0, 0.25, 0.5, 9.0)] == pytest.approx([0.0, 0.0, 0.1, 0.2, 0.2])
    assert ramp.acceleration(0.6) == 0.0
    cut = CubicRamp(0.1, -0.2, 0.4, a0=0.6)
    assert (cut.speed(0.0), cut.acceleration(0.0)) == pytest.approx((0.1, 0.6))
    assert (cut.speed(0.4), cut.acceleration(0.4)) == pytest.approx((-0.2, 0.0))
    share = CubicProfile(1.0, 0.2, 0.5)
    times = np.linspace(0.0, 0.5, 11)
    np.testing.assert_allclose(share.speed(times), [ramp.speed(float(t)) for t in times], atol=1e-15)


def test_bad_moves_and_profiles_are_named():
    for call, text in (
        (lambda: BasicMove(1.0, 2.0, 1.0), "length is 2"),
        (lambda: BasicMove(0.0, 1.0, 1.0), "length is 1"),
        (lambda: BasicMove(math.inf, 1.0, 0.1), "angle is 0.1"),
        (lambda: BasicMove(math.nan, 1.0, 0.1), "radius is nan"),
        (lambda: BasicMove.arc(0.0, 1.0), "radius is 0"),
        (lambda: BasicMove.straight(math.nan), "length is nan"),
        (lambda: TrapezoidalProfile(1.0, 0.0, 1.0), "max_speed"),
        (lambda: TrapezoidalProfile(math.nan, 1.0, 1.0), "distance"),
        (lambda: CubicProfile(1.0, 1.0, -1.0), "ramp_time"),
        (lambda: CubicRamp(0.0, math.inf, 1.0), "v1"),
        (lambda: CubicRamp(0.0, 1.0, 0.0), "duration"),
    ):
        with pytest.raises(KinematicsError, match=text):
            call()


@pytest.mark.parametrize(
    ("v0", "v1", "a0", "time"), [(0.0, 0.2, 0.0, 0.5), (0.2, 0.0, -0.1, 0.7), (-0.1, 0.3, 0.4, 1.0)]
)
def test_the_distance_of_a_ramp_is_the_integral_of_its_speed(v0, v1, a0, time):
    ramp = CubicRamp(v0, v1, time, a0)
    times = np.linspace(0.0, time, 2001)
    assert ramp.distance == pytest.approx(np.trapezoid([ramp.speed(float(t)) for t in times], times), abs=1e-7)


@pytest.mark.parametrize("a0", [0.0, 0.3, -0.05, -5.0])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_ramp_to_rest_covers_the_way_that_is_left(a0, side):
    ramp = CubicRamp.to_rest(0.2 * side, 0.07 * side, a0 * side)
    assert ramp.distance == pytest.approx(0.07 * side)
    assert ramp.speed(ramp.duration) == pytest.approx(0.0, abs=1e-12)
    assert ramp.a0 == (a0 * side if a0 > -1.0 else 0.0)  # braking so hard it would stand before
    with pytest.raises(KinematicsError, match="expected the sign of the speed"):
        CubicRamp.to_rest(0.2, -0.1)


def test_a_bearing_turns_the_direction_of_travel():
    assert BasicMove.straight(1.0, math.pi / 2).direction == (0.0, 1.0, 0.0)
    assert BasicMove.arc(2.0, 1.0, -math.pi / 2).direction == (0.0, -1.0, 0.5)
    assert BasicMove.spot(1.0).direction == (0.0, 0.0, 1.0)


@pytest.mark.parametrize(("v0", "a0", "v1"), [(0, 0, 0.2), (0.2, -0.5, 0.3), (0.3, 0.6, -0.1), (0.1, 0.3, 0.1)])
def test_the_shortest_ramp_keeps_its_limits_and_none_shorter_does(v0, a0, v1):
    ramp = shortest_ramp(v0, a0, v1, 0.6, 4.8)
    assert (ramp.speed(0.0), ramp.speed(ramp.duration)) == (pytest.approx(v0), pytest.approx(v1))
    assert ramp.acceleration(0.0) == pytest.approx(a0)
    assert ramp.acceleration(ramp.duration) == pytest.approx(0.0, abs=1e-9)
    t = np.arange(0.0, ramp.duration, 1e-3)
    a = np.array([ramp.acceleration(at) for at in t])
    assert np.abs(a).max() == pytest.approx(ramp.peaks[0], abs=1e-3)
    assert np.abs(np.diff(a)).max() / 1e-3 == pytest.approx(ramp.peaks[1], abs=0.05)
    assert ramp.peaks[0] <= 0.6 + 1e-6
    assert ramp.peaks[1] <= 4.8 + 1e-6
    shorter = CubicRamp(v0, v1, 0.98 * ramp.duration, a0).peaks
    assert shorter[0] > 0.6 + 1e-6 or shorter[1] > 4.8 + 1e-6


def test_from_rest_it_is_the_published_ramp_and_begun_ramps_go_on_as_they_were():
    ramp = shortest_ramp(0.0, 0.0, 0.2, 0.6, 4.8)
    assert ramp.duration == pytest.approx(0.5, abs=1e-3)
    timed = TimedRamp(3.0, ramp)
    rest = shortest_ramp(timed.at(3.2), timed.acceleration(3.2), 0.2, 0.6, 4.8)
    assert rest.duration == pytest.approx(ramp.duration - 0.2, abs=2e-3)
    assert not timed.over(3.2)
    assert timed.over(3.6)


@pytest.mark.parametrize("wrong", [{"max_acceleration": 0.0}, {"max_jerk": -1.0}, {"v0": math.nan}])
def test_limits_and_speeds_of_a_ramp_are_checked(wrong):
    with pytest.raises(KinematicsError, match=next(iter(wrong))):
        shortest_ramp(**{"v0": 0.0, "a0": 0.0, "v1": 1.0, "max_acceleration": 0.6, "max_jerk": 4.8, **wrong})
