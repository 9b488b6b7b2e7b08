"""Plans of the study's runs, and the paper's table beside them."""

import math
from pathlib import Path

import pytest

from monstertruck_runtime.errors import InputError
from monstertruckd.tools.simulation.config import load_simulated
from monstertruckd.tools.study import published
from monstertruckd.tools.study.runs import circle_plan, shaft_rates, straight_plan

CONFIGS = Path(__file__).resolve().parents[4] / "configs"
STAND = load_simulated(CONFIGS / "robots" / "skid_stand.yaml")


def test_a_circle_has_the_faster_side_at_the_reference():
    (stretch,) = circle_plan(STAND, 2.0, 1.57, 5.0)
    assert (stretch.left, stretch.right) == (0.785, 1.57)
    assert stretch.seconds == pytest.approx(2.0 + 5 * math.tau / (0.021 * 0.785 / 0.105))
    assert shaft_rates(STAND, stretch) == (0.785, 1.57, 0.785, 1.57)
    assert circle_plan(STAND, math.inf, 1.57, 1.0)[0].left == 0.0


def test_a_line_goes_to_and_fro():
    plan = straight_plan(STAND, 0.682, 3, 1.57)
    assert [stretch.left for stretch in plan] == [1.57, 0.0, -1.57, 0.0, 1.57, 0.0]
    assert plan[0].seconds == pytest.approx(0.682 / (0.021 * 1.57))


@pytest.mark.parametrize("numbers", [(1.0, 1.57, 1.0), (math.nan, 1.0, 1.0), (2.0, 0.0, 1.0), (2.0, 1.0, math.inf)])
def test_numbers_that_make_no_circle(numbers):
    with pytest.raises(InputError, match="expected"):
        circle_plan(STAND, *numbers)


@pytest.mark.parametrize("numbers", [(0.0, 1, 1.0), (1.0, 0, 1.0), (1.0, 1, -1.0)])
def test_numbers_that_make_no_line(numbers):
    with pytest.raises(InputError, match="expected"):
        straight_plan(STAND, *numbers)


def test_a_truck_has_no_sides():
    truck = load_simulated(CONFIGS / "demo.yaml")
    with pytest.raises(InputError, match="expected one with a left and a right side"):
        shaft_rates(truck, circle_plan(STAND, 2.0, 1.0, 1.0)[0])


def test_the_paper_contradicts_itself_where_we_say_so():
    for row in published.CIRCLES:
        circle = row.measured
        ideal = 0.021 * (circle.left + circle.right) / 2
        if row.recomputed_deviation is not None:
            assert 100 * (circle.speed / ideal - 1) == pytest.approx(row.recomputed_deviation, abs=0.1)
            assert ("speed" in row.slip) == (abs(row.recomputed_deviation - row.speed_deviation) > 0.5)
        if row.drift is not None:
            assert ("drift" in row.slip) == (abs(math.hypot(*row.drift) - row.drift_speed) > 5e-6)


def test_published_circles_are_found_by_their_rates_whichever_side_is_faster():
    row = published.nearest(0.785, 1.57)
    assert row is not None
    assert row is published.nearest(1.57, 0.785)
    assert row.measured.label == "2:1, 1.57 rad/s"
    assert published.nearest(0.5, 0.9) is None
