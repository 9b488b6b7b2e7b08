"""Ellipse to circle: what a flat circle tells, what it does not, and what is no circle."""

import math
from dataclasses import replace

import numpy as np
import pytest

from monstertruck_runtime.errors import InputError
from monstertruck_schemas import topics
from monstertruck_schemas.sensor import Attitude, Vector3
from monstertruckd.tools.calibrate.compass import LINEARITY, FieldCircle, result_of
from monstertruckd.tools.calibrate.steps import MoveRecord

HARD = np.array((6.0, -4.0))
SOFT = np.array(((1.1, 0.06), (0.06, 0.93)))
"""What the iron does to the field; its inverse, scaled to determinant 1, is what takes it out."""
MOTOR = np.array((0.3, 0.8))


def circle(
    *,
    turns: float = 2.1,
    noise: float = 0.03,
    seed: int = 1,
    tilt: float = 0.0,
    count: int = 800,
    strength: float = 25.0,
) -> FieldCircle:
    rng = np.random.default_rng(seed)
    there = np.linspace(0, math.pi * turns, count // 2)
    heading = np.concatenate((there, there[::-1]))
    current = np.concatenate((np.full(count // 2, 0.25), np.full(count // 2, -0.25))) + 0.02 * rng.standard_normal(
        count
    )
    level = strength * np.array((np.cos(heading), np.sin(heading)))
    # The floor slopes: the truck's pitch changes as it turns.
    pitch, roll = tilt * np.cos(heading), -tilt * np.sin(heading)
    up = np.full(count, -39.0)
    x = np.cos(pitch) * level[0] - np.sin(pitch) * up
    z = np.sin(pitch) * level[0] + np.cos(pitch) * up
    y, z = np.cos(roll) * level[1] + np.sin(roll) * z, np.cos(roll) * z - np.sin(roll) * level[1]
    flat = SOFT @ np.array((x, y)) + HARD[:, None] + MOTOR[:, None] * current
    flat += noise * rng.standard_normal(flat.shape)
    believed = np.arctan2(flat[1], flat[0])
    return FieldCircle(flat[0], flat[1], z, pitch, roll, current, np.unwrap(believed))


def reading(stamp: int, number: int, **more: bool) -> Attitude:
    field = Vector3(x=20.0 + number, y=0.0, z=-39.0)
    head = {"stamp": stamp, "received": stamp, "seq": number, "heading": 0.0, "pitch": 0.0, "roll": 0.0}
    return Attitude(**head, magnetic_field=field, **more)


def truth() -> dict[str, float]:
    soft = np.linalg.inv(SOFT)
    soft /= math.sqrt(np.linalg.det(soft))
    return {
        "hard_x": HARD[0],
        "hard_y": HARD[1],
        "soft_xx": soft[0, 0],
        "soft_xy": soft[0, 1],
        "soft_yy": soft[1, 1],
    }


@pytest.mark.parametrize("tilt", [0.0, 0.05])
def test_hard_and_soft_iron_and_the_motors_field(tilt: float):
    result = result_of(circle(tilt=tilt))
    for name, value in truth().items():
        estimate = result.estimate(name)
        assert estimate is not None
        assert estimate.value == pytest.approx(value, abs=0.02 if name.startswith("hard") else 0.001)
        assert estimate.low is not None
        assert estimate.high is not None
        assert estimate.low < value < estimate.high


def test_the_noise_part_of_the_interval_is_honest():
    inside = []
    for seed in range(120):
        result = result_of(circle(seed=seed, count=200))
        for name in ("soft_xx", "soft_xy", "soft_yy"):
            estimate = result.estimate(name)
            assert estimate is not None
            assert estimate.low is not None
            assert estimate.high is not None
            inside.append(estimate.low + LINEARITY < truth()[name] < estimate.high - LINEARITY)
    assert 0.92 < np.mean(inside) < 0.98


def test_strength_is_not_observed():
    weak, strong = result_of(circle(noise=0.0)), result_of(circle(noise=0.0, strength=50.0))
    for name in ("soft_xx", "soft_xy", "soft_yy"):
        ours, theirs = weak.estimate(name), strong.estimate(name)
        assert ours is not None
        assert theirs is not None
        assert ours.value == pytest.approx(theirs.value)
    assert any("strength" in text for text in weak.unobserved)
    assert any("along z" in text for text in weak.unobserved)


def test_part_of_a_circle_is_refused():
    with pytest.raises(InputError, match=r"did not complete the circle: 1\d\d deg"):
        result_of(circle(turns=1.1))


def test_a_unit_with_other_axes_is_refused():
    turned = circle()
    with pytest.raises(InputError, match="axes are not x forward, y left"):
        result_of(replace(turned, heading=-turned.heading))


def test_the_map_of_the_motors_disturbance():
    result = result_of(circle())
    for name, value in zip(("motor_x", "motor_y"), MOTOR, strict=True):
        estimate = result.estimate(name)
        assert estimate is not None
        assert estimate.low is not None
        assert estimate.high is not None
        assert estimate.low < value < estimate.high
        assert estimate.key is None, "the driver does not know the current"
    turn = result.estimate("motor_turn")
    assert turn is not None
    assert turn.value == pytest.approx(math.degrees(float(np.hypot(*MOTOR)) / 25.0), rel=0.3)


def test_without_current_there_is_no_map():
    still = circle()
    assert result_of(replace(still, current=0.0 * still.current)).estimate("motor_x") is None


def test_iron_in_the_ground_is_separated_from_the_trucks_own():
    clean = circle()
    beside = 8.0 * np.exp(-(((np.arange(clean.x.size) % 400) - 150) ** 2) / 1800.0)
    with pytest.raises(InputError, match=r"ellipse .* calibrate elsewhere"):
        result_of(replace(clean, x=clean.x + beside))


def test_iron_in_the_ground_that_is_not_seen_widens_the_intervals():
    inside = []
    for seed in range(60):
        rng, clean = np.random.default_rng(seed), circle(seed=seed, count=200)
        there = np.arange(200)
        there = np.where(there < 100, there, 199 - there)
        bump = rng.uniform(0.3, 4.0) * np.exp(-(((there - rng.uniform(0, 100)) / rng.uniform(2.5, 15.0)) ** 2) / 2)
        way = rng.uniform(0, math.tau)
        try:
            result = result_of(replace(clean, x=clean.x + bump * math.cos(way), y=clean.y + bump * math.sin(way)))
        except InputError:
            continue
        for name, value in truth().items():
            estimate = result.estimate(name)
            assert estimate is not None
            inside.append(estimate.low < value < estimate.high)
    assert len(inside) > 200
    assert np.mean(inside) > 0.9


def test_a_magnet_that_makes_no_circle_of_it_is_refused_and_gets_no_interval_without_an_end():
    clean = circle()
    with pytest.raises(InputError, match="a magnet near the compass"):
        result_of(replace(clean, y=0.1 * clean.y))


def test_a_heading_that_stays_and_too_few_readings_are_named():
    with pytest.raises(InputError, match="stays constant while the robot turns"):
        result_of(replace(circle(), heading=np.zeros(800)))
    record = MoveRecord(others={topics.COMPASS.name: [reading(100 + i, i) for i in range(9)]}, left=99, arrived=200)
    with pytest.raises(InputError, match="sent 18 readings while the robot moved: expected 24"):
        FieldCircle.of([record, record])


def test_readings_that_the_driver_calls_disturbed_count_for_they_are_what_is_measured():
    rows = [reading(100 + i, i, heading_disturbed=True) for i in range(30)]
    found = FieldCircle.of([MoveRecord(others={topics.COMPASS.name: rows}, left=99, arrived=200)])
    assert found.x.size == 30
