"""Motion of a body at rest, proven by two scans."""

import math
from itertools import pairwise

import numpy as np
import pytest

from monstertruck_estimation.consistency.exchange import Claim
from monstertruck_estimation.consistency.rest_proof import rest_evidence
from monstertruck_kinematics.se2 import compose
from tests.unit.estimation.slam.kit import CORRIDOR, ROOM, box, scan

PLACE = np.array((-2.0, 0.0, 0.3))
STANDS = Claim(0, (0.0, 0.0), 0.0, (0.0, 0.0))


def evidence(moved, before=(), after=(), walls=ROOM, claim=STANDS, own=None, seed=0):
    """Between a scan at ``PLACE`` and one ``moved`` from there, with walls that are there only before or after."""
    rng, moved = np.random.default_rng(seed), np.array(moved, float)
    earlier = scan([*walls, *before], PLACE, noise=0.005, rng=rng)
    newest = scan([*walls, *after], compose(PLACE, moved), noise=0.005, rng=rng)
    return rest_evidence(newest, earlier, moved if own is None else np.array(own, float), claim, (0.0, 0.0))


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("moved", [(0.03, 0.0, 0.0), (0.0, -0.03, 0.0), (0.0, 0.0, 0.03)])
def test_three_centimetres_or_hundredths_prove_a_motion(moved, seed):
    found = evidence(moved, seed=seed)
    assert found.proven
    assert found.motion == pytest.approx(moved, abs=0.006)


@pytest.mark.parametrize("seed", range(40))
def test_noise_proves_none(seed):
    rng = np.random.default_rng(seed)
    assert not evidence((0.0, 0.0, 0.0), own=rng.normal(0.0, 0.005, 3), seed=seed).proven


def test_what_the_wheels_show_is_no_news():
    claim = Claim(0, (0.05, 0.0), 0.0, (0.0, 0.0))
    assert not evidence((0.05, 0.0, 0.0), claim=claim).proven
    found = evidence((0.1, 0.0, 0.0), claim=claim)
    assert found.proven
    assert found.motion[0] == pytest.approx(0.05, abs=0.006)


def curtain(sway):
    """A curtain two metres wide, whose folds sway."""
    edge = [(-3.0 + x, 1.6 + sway * math.sin(4.0 * x)) for x in np.arange(0.0, 2.0, 0.1)]
    return list(pairwise(edge))


@pytest.mark.parametrize("step", [0.02, 0.05, 0.1, 0.3])
def test_what_moves_by_itself_proves_none(step):
    person = box(-1.4, 0.9, -1.1, 1.2)
    walked = [((x1 - step, y1), (x2 - step, y2)) for (x1, y1), (x2, y2) in person]
    for own in ((0.0, 0.0, 0.0), (step, 0.0, 0.0)):
        assert not evidence((0.0, 0.0, 0.0), person, walked, own=own).proven
        assert not evidence((0.0, 0.0, 0.0), curtain(0.0), curtain(step), own=own).proven


def test_a_person_alone_in_a_corridor_proves_none():
    """Nothing but the person tells how far the body has moved along the corridor."""
    person, walked = box(0.0, -0.1, 0.3, 0.2), box(-0.1, -0.1, 0.2, 0.2)
    assert not evidence((0.0, 0.0, 0.0), person, walked, CORRIDOR, own=(0.1, 0.0, 0.0)).proven


def test_scan_odometry_that_stood_meanwhile_contradicts():
    """People who walk in a row with equal gaps look alike after some time, a little further on."""
    assert evidence((0.04, 0.0, 0.0)).proven
    assert not evidence((0.04, 0.0, 0.0), own=(0.0, 0.0, 0.0)).proven
