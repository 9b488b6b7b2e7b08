"""A line through the arcs of echoes, of cones and of beams."""

import math

import numpy as np
import pytest

from monstertruck_planners.behave.wall.echoes import TIGHT, Cone, WallEstimate, refine, residuals, search
from tests.unit.planners.behave.wall_kit import heard, turning

CONE, BEAM = Cone(0.435, 0.45), Cone(0.0, 1.3)
NEAR = WallEstimate(math.pi / 2, 0.35)


def along(line, distance, metres, count=30, weave=0.1):
    """Poses beside a line that wind a little."""
    n = np.array([math.cos(line.normal), math.sin(line.normal)])
    start, way = n * (line.offset - distance), np.array([math.cos(line.heading), math.sin(line.heading)])
    return [
        (*(start + way * metres * i / count), line.heading + weave * math.sin(i / 3)) for i in range(count)
    ]  # fmt: skip


@pytest.mark.parametrize("cone", [CONE, BEAM], ids=["cone", "beam"])
@pytest.mark.parametrize("normal", [-3.0, -1.2, 0.4, 2.9])
def test_exact_echoes_give_the_line_from_an_estimate_and_without_one(cone, normal):
    line = WallEstimate(normal, 0.7)
    poses = along(line, 0.35, 1.0)
    echoes, at = heard(line, poses, cone), poses[-1][:2]
    for fit in (refine(echoes, WallEstimate(normal + 0.03, 0.7), at, cone), search(echoes, at, cone)):
        assert math.remainder(fit.line.normal - normal, math.tau) == pytest.approx(0.0, abs=2e-3)
        assert fit.line.distance(*at) == pytest.approx(0.35, abs=1e-3)
        assert fit.explained == len(echoes)


def test_a_third_of_other_echoes_does_not_move_it():
    line = WallEstimate(math.pi / 2, 0.35)
    poses = along(line, 0.35, 1.5, 60)
    echoes = heard(line, poses, CONE, noise=0.005)
    echoes[::3, 3] += np.random.default_rng(1).uniform(0.05, 1.0, len(echoes[::3]))
    fit = refine(echoes, WallEstimate(math.pi / 2 + 0.03, 0.36), poses[-1][:2], CONE)
    assert fit.line.distance(*poses[-1][:2]) == pytest.approx(0.35, abs=4e-3)
    assert fit.sigma[1] < 4e-3


def test_a_line_found_before_is_not_lost_to_a_worse_one_nor_kept_against_a_better_one():
    far = WallEstimate(0.1, 1.91)
    echoes = turning([NEAR, far, WallEstimate(-0.93, 2.12)], CONE, np.linspace(1.0, -0.36, 40))
    assert search(echoes, (0.0, 0.0), CONE, NEAR).line.normal == pytest.approx(NEAR.normal, abs=1e-3)
    echoes = turning([NEAR, far], CONE, np.linspace(1.0, -0.36, 40))
    assert search(echoes, (0.0, 0.0), CONE, far).line.normal == pytest.approx(NEAR.normal, abs=1e-3)


def test_an_echo_from_where_no_sound_comes_back_belongs_to_no_line():
    line = WallEstimate(math.pi / 2, 0.35)
    behind = np.array([(0.0, 0.0, -math.pi / 2, 0.35, 0, 0.0, 0.0)])
    assert np.abs(residuals(behind, line, CONE)[0]) > TIGHT
    assert not CONE.hears(-math.pi / 2, line.normal)


def test_few_echoes_leave_the_estimate_where_it_was():
    before = WallEstimate(math.pi / 2, 0.35)
    echoes = np.array([(0.05, 0.05, math.pi / 2, 0.31, 0, 0.0, 0.0)])
    fit = refine(echoes, before, (0.0, 0.0), CONE)
    assert fit.line.normal == pytest.approx(before.normal, abs=0.01)
    assert 0.35 < fit.line.distance(0.0, 0.0) < 0.361
    assert fit.sigma[0] > 0.02
