"""Wheel constraints and mobility: the textbook's rows and values."""

import math

import numpy as np
import pytest

from monstertruck_kinematics.elementary import KinematicsError
from monstertruck_kinematics.steered import Ackermann, Bicycle, FourWheelSteer, IndependentSteer, Synchro, Tricycle
from monstertruck_kinematics.unsteered import Differential, SkidSteer, mecanum, omni
from monstertruck_kinematics.wheels import (
    CasterWheel,
    FixedWheel,
    SteeredWheel,
    SwedishWheel,
    analyse,
    checked,
    rolling_matrix,
    sliding_matrix,
)


def test_rows_are_the_textbooks(rng):
    for _ in range(50):
        place, al, be, gam = rng.uniform(0.1, 1.0), *rng.uniform(-3.0, 3.0, 3)
        x, y, heading = place * math.cos(al), place * math.sin(al), al + be - math.pi / 2
        wheel = FixedWheel("w", x, y, 0.1, heading)
        rolling = [math.sin(al + be), -math.cos(al + be), -place * math.cos(be)]
        sliding = [math.cos(al + be), math.sin(al + be), place * math.sin(be)]
        np.testing.assert_allclose(wheel.rolling_row, rolling, atol=1e-14)
        np.testing.assert_allclose(wheel.sliding_row, sliding, atol=1e-14)
        swedish = SwedishWheel("s", x, y, 0.1, heading, gam)
        along = [math.sin(al + be + gam), -math.cos(al + be + gam), -place * math.cos(be + gam)]
        np.testing.assert_allclose(swedish.rolling_row, along, atol=1e-14)
        assert swedish.rolling_gain == pytest.approx(0.1 * math.cos(gam))
        # Caster: [cos(al+be), sin(al+be), d + l sin be] v + d bedot = 0, d counted towards the point of contact.
        caster = CasterWheel("c", x, y, 0.1, heading, offset=0.03)
        twist = rng.uniform(-1.0, 1.0, 3)
        d = -0.03
        rate = caster.steering_rate(twist)
        assert np.dot(sliding, twist) + d * twist[2] + d * rate == pytest.approx(0.0, abs=1e-14)


def test_a_caster_swings_behind():
    ahead = CasterWheel("c", 0.3, 0.0, 0.05, heading=0.2, offset=0.03)
    assert ahead.steering_rate((1.0, 0.0, 0.0)) < 0.0
    assert ahead.sliding_row is None


TEXTBOOK = {
    "differential": (Differential().wheels((1.0, 1.0)), (2, 0), "line", True),
    "bicycle": (Bicycle().wheels((0.2, 0.3)), (1, 1), "point", True),
    "tricycle": (Tricycle().wheels((0.2, 0.3)), (1, 1), "point", True),
    "tricycle, straight": (Tricycle().wheels((0.2, 0.0)), (1, 1), "infinite", True),
    "car": (Ackermann().wheels((0.2, 0.3)), (1, 1), "point", True),
    "synchro": (Synchro().wheels((1.0, 0.0), direction=0.4), (1, 1), "infinite", True),
    "omni": (omni().wheels((0.0, 0.0, 0.0)), (3, 0), "anywhere", False),
    "mecanum": (mecanum().wheels((0.0,) * 4), (3, 0), "anywhere", False),
    "truck": (FourWheelSteer().wheels((0.2, 0.3, -0.1)), (1, 2), "point", True),
    "truck, crab": (FourWheelSteer().wheels((0.2, 0.3, 0.3)), (1, 2), "infinite", True),
    "independent": (IndependentSteer().wheels(IndependentSteer().inverse((0.1, 0.2, 0.3))), (1, 2), "point", True),
    "skid steer": (SkidSteer.ideal(0.021, 0.0525).wheels((0.0, 0.0)), (1, 0), "infinite", False),
    "omni-steer": ((SteeredWheel("s", 0.3, 0.0, 0.1, 0.2), CasterWheel("c", 0, 0, 0.1, 0, 0.03)), (2, 1), "line", True),
    "two-steer": ((SteeredWheel("a", 0.3, 0, 0.1, 0.2), SteeredWheel("b", -0.3, 0, 0.1, 0.1)), (1, 2), "point", True),
    "locked circle": ((FixedWheel("a", 0.3, 0, 0.1, 0.2), FixedWheel("b", -0.3, 0, 0.1)), (1, 0), "point", False),
    "locked": (tuple(FixedWheel(f"{a}", a, 0, 0.1, a * a) for a in (0.1, 0.2, 0.4)), (0, 0), "none", False),
    "casters only": ((CasterWheel("c", 0.1, 0.0, 0.1, 0.0, 0.03),), (3, 0), "anywhere", False),
    "parallel front axle": (
        (
            FixedWheel("r", 0, 0, 0.1),
            SteeredWheel("a", 1, 0.2, 0.1, group="g"),
            SteeredWheel("b", 1, -0.2, 0.1, group="g"),
        ),
        (1, 0),
        "infinite",
        False,
    ),
}


@pytest.mark.parametrize("name", TEXTBOOK)
@pytest.mark.parametrize("scale", [1.0, 1e-6, 1e6])
@pytest.mark.parametrize("shift", [0.0, 50.0])
def test_mobility_is_the_textbooks_in_any_unit_and_frame(name, scale, shift):
    from dataclasses import replace

    wheels, robot_class, kind, non_holonomic = TEXTBOOK[name]
    wheels = [replace(w, x=(w.x + shift) * scale, y=w.y * scale, radius=w.radius * scale) for w in wheels]
    found = analyse(wheels)
    assert found.robot_class == robot_class
    assert found.manoeuvrability == sum(robot_class)
    assert found.icr_kind == kind
    assert found.non_holonomic is non_holonomic
    assert (found.icr is not None) == (kind == "point")
    assert (found.icr_line is not None) == (kind == "line")


def test_turning_centres_are_where_the_axles_meet():
    found = analyse(Tricycle(wheelbase=0.5).wheels((0.2, math.pi / 4)))
    assert found.icr == pytest.approx((0.0, 0.5), abs=1e-12)
    truck = FourWheelSteer()
    found = analyse(truck.wheels((0.2, 0.3, -0.1)))
    vx, vy, wz = truck.forward((0.2, 0.3, -0.1))
    assert found.icr == pytest.approx((-vy / wz, vx / wz))
    (x, y), (dx, dy) = analyse(TEXTBOOK["omni-steer"][0]).icr_line
    assert (dx, dy) == pytest.approx((math.sin(0.2), -math.cos(0.2)))
    assert (x - 0.3) * dy - y * dx == pytest.approx(0.0, abs=1e-12)
    (x, y), (dx, dy) = analyse(TEXTBOOK["differential"][0]).icr_line
    assert (x, abs(dy)) == pytest.approx((0.0, 1.0))


def test_rounded_headings_need_a_tolerance():
    wheels = [SteeredWheel(n, x, y, 0.1, round(a, 4)) for n, x, y, a in (
        (w.name, w.x, w.y, w.heading) for w in FourWheelSteer().wheels((0.2, 0.3, -0.1))
    )]  # fmt: skip
    assert analyse(wheels).icr_kind == "none"
    assert analyse(wheels, tolerance=1e-3).robot_class == (1, 2)


def test_matrices_of_rolling_and_sliding():
    left, right, _ = rolling_matrix(Differential(0.1, 0.4).wheels((0.0, 0.0))) @ [0.2, 0.0, 0.5]
    assert (left, right) == pytest.approx((1.0, 3.0))
    three = omni()
    assert rolling_matrix(three.swedish) @ [0.1, 0.2, 0.3] == pytest.approx(three.inverse((0.1, 0.2, 0.3)))
    assert rolling_matrix(three.swedish).shape == (3, 3)
    assert sliding_matrix(three.swedish).shape == (0, 3)


def test_bad_wheels_are_named():
    with pytest.raises(KinematicsError, match="wheels is empty"):
        analyse([])
    with pytest.raises(KinematicsError, match="wheel a: two wheels"):
        checked([FixedWheel("a", 0, 0, 1), FixedWheel("a", 1, 0, 1)])
    with pytest.raises(KinematicsError, match="wheel w: x is nan"):
        FixedWheel("w", math.nan, 0.0, 0.1)
    with pytest.raises(KinematicsError, match=r"wheel w: radius is -0\.1"):
        FixedWheel("w", 0.0, 0.0, -0.1)
    with pytest.raises(KinematicsError, match="wheel w: offset"):
        CasterWheel("w", 0.0, 0.0, 0.1)
    with pytest.raises(KinematicsError, match="wheel w: roller"):
        SwedishWheel("w", 0.0, 0.0, 0.1, roller=math.pi / 2)
