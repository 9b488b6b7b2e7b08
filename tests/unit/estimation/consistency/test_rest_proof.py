"""Motion of a body at rest, proven by two scans."""

import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from monstertruck_estimation.consistency.exchange import Claim
from monstertruck_estimation.consistency.rest_proof import rest_evidence
from monstertruck_estimation.slam.registration import Cloud, register
from monstertruck_estimation.slam.scans import ScanGeometry, prepare
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


def test_a_person_who_covers_two_sectors_proves_none():
    """A person 1.2 m beside a robot at rest has walked 5 cm along the corridor."""
    log = np.load(Path(__file__).parents[3] / "data" / "person_beside_robot.npz")
    geometry = ScanGeometry(math.pi, -math.radians(0.8), 0.02, 12.0)
    earlier, newest = (prepare(ranges, geometry) for ranges in log["ranges"])
    own = register(newest, Cloud.of(earlier), np.zeros(3)).pose
    assert own[0] == pytest.approx(-0.018, abs=0.002), "the person drags the registration along"
    assert rest_evidence(newest, earlier, own, STANDS, (0.0, 0.0)).sigmas < 4.0


NICHE = [
    *pairwise([(-50.0, -1.0), (-1.0, -1.0), (-1.0, -1.3), (0.0, -1.3), (0.0, -1.0), (50.0, -1.0)]),
    *pairwise([(-50.0, 1.0), (1.5, 1.0), (1.5, 0.85), (1.9, 0.85), (1.9, 1.0), (50.0, 1.0)]),
]
"""A corridor with a niche and a box on its walls."""


def crowd(places, step):
    """Round people, 0.36 m wide, who have walked ``step`` metres ahead."""
    angles = np.linspace(0.0, 2.0 * math.pi, 13)
    return [
        wall
        for x, y in places
        for wall in pairwise(zip(x + step + 0.18 * np.cos(angles), y + 0.18 * np.sin(angles), strict=True))
    ]


def proven_by_crowd(count, seed):
    """Whether people prove a motion who walk along the corridor by a robot at rest, if scan odometry follows them."""
    rng, place = np.random.default_rng(seed), np.array((0.0, 0.0, 0.2))
    places, step = rng.uniform(-2.5, 2.5, (count, 2)), rng.uniform(0.03, 0.2)
    places[:, 1] = np.where(places[:, 1] > 0.0, 0.5, -0.5)
    earlier = scan([*NICHE, *crowd(places, 0.0)], place, noise=0.005, rng=rng)
    newest = scan([*NICHE, *crowd(places, step)], place, noise=0.005, rng=rng)
    own = register(newest, Cloud.of(earlier), np.zeros(3)).pose
    return rest_evidence(newest, earlier, own, STANDS, (0.0, 0.0)).proven


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_people_who_walk_the_same_way_hardly_ever_prove_one(count):
    """They constrain the motion along the corridor more than its niche and box do."""
    assert sum(proven_by_crowd(count, seed) for seed in range(30)) <= 2


@pytest.mark.parametrize("seed", range(10))
def test_a_motion_among_people_is_proven_by_the_walls(seed):
    rng = np.random.default_rng(seed)
    before, after = crowd([(-1.2, 1.3), (-2.1, -1.3)], 0.0), crowd([(-1.2, 1.3), (-2.1, -1.3)], rng.uniform(0.0, 0.1))
    found = evidence((0.05, 0.0, 0.0), before, after, seed=seed)
    assert found.proven
