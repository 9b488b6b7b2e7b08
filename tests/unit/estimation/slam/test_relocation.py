"""A robot that is carried while it maps: lost, a submap of its own, joined to the map by a verified closure."""

import numpy as np
import pytest

from monstertruck_estimation.se2 import between, compose
from monstertruck_estimation.slam.mapping import UNKNOWN, Mapper, MappingEvent
from monstertruck_estimation.slam.relocation import LossDetector, contradicts
from monstertruck_estimation.slam.scan_matcher import MatchStatus, ScanMatch, rejected
from monstertruck_estimation.slam.storage import saved_graph
from tests.unit.estimation.slam.kit import box, drifting, errors, rounds, scan

SECOND = 10**9
POSTS = ((-4.0, 2.6), (-1.2, 3.1), (2.0, 2.4), (4.4, 0.9), (3.6, -2.4), (0.4, -3.0), (-2.6, -2.7), (-4.6, -0.4))
HALL = [
    *box(-6.0, -4.2, 6.0, 4.0),
    *box(-1.5, -0.8, 1.7, 0.6),
    *(wall for x, y in POSTS for wall in box(x, y, x + 0.3 + 0.07 * abs(x), y + 0.3 + 0.1 * abs(y))),
]
CARRIED = 150, 60
"""The scan at which the robot is lifted, and where on its way it is put down again."""


def drive(mapper, truth, odom, stamps):
    rng = np.random.default_rng(1)
    return [
        mapper.step(scan(HALL, pose, noise=0.01, rng=rng), int(stamp), at)
        for pose, stamp, at in zip(truth, stamps, odom, strict=True)
    ]


@pytest.fixture(scope="module", params=[0.1, 60.0], ids=["at once", "after a minute"])
def carried(request):
    """Once round the hall, lifted, put down where it was before, and on; wheels know nothing of it, and begin anew."""
    way = rounds(200, 1.0, 3.6, 2.2)
    lifted, down = CARRIED
    truth = np.concatenate((way[:lifted], way[down:]))
    odom = np.concatenate((drifting(way[:lifted]), drifting(way[down:])))
    stamps = np.arange(len(truth)) * 0.1 * SECOND
    stamps[lifted:] += (request.param - 0.1) * SECOND
    mapper = Mapper()
    return mapper, drive(mapper, truth, odom, stamps), truth, stamps


def test_it_is_lost_within_three_seconds_until_the_submap_is_joined(carried):
    mapper, steps, _, stamps = carried
    apart = next(k for k, step in enumerate(steps) if MappingEvent.APART in step.events)
    joined = next(k for k, step in enumerate(steps) if MappingEvent.JOINED in step.events)
    assert 0 <= stamps[apart] - stamps[CARRIED[0]] < 3 * SECOND
    assert all(np.array_equal(step.covariance, UNKNOWN) for step in steps[apart:joined])
    assert all(step.map_from_odom is None for step in steps[apart:joined])
    assert steps[joined].map_from_odom is not None
    assert not mapper.lost


def test_the_map_is_single_and_right_afterwards(carried):
    mapper, steps, truth, _ = carried
    joined = next(k for k, step in enumerate(steps) if MappingEvent.JOINED in step.events)
    _, poses = mapper.trajectory()
    assert errors(poses, truth)[joined:].max() < 0.06
    assert mapper.map.joined().all()


def test_somewhere_else_it_stays_apart_and_is_not_saved():
    way = rounds(120, 0.6, 3.6, 2.2)
    elsewhere = [*box(-2.0, -1.5, 2.4, 1.9), *box(0.6, 0.2, 1.1, 0.5), *box(-1.6, 0.9, -1.1, 1.9)]
    mapper = Mapper()
    drive(mapper, way, way, np.arange(120) * 0.1 * SECOND)
    known, rng = len(mapper.map), np.random.default_rng(2)
    for k, pose in enumerate(rounds(90, 0.8, 0.9, 0.6)):
        step = mapper.step(scan(elsewhere, pose, noise=0.01, rng=rng), int((120 + k) * 0.1 * SECOND), pose)
    assert mapper.lost
    assert not any(event is MappingEvent.JOINED for event in step.events)
    graph = saved_graph(mapper.map)
    assert len(graph.poses) <= known + 1 < len(mapper.map)
    mapper.finish()
    assert mapper.map.poses[:known] == pytest.approx(graph.poses[:known], abs=0.05)


def fit(overlap, degeneracy=0.5):
    return ScanMatch(np.zeros(3), np.eye(3), overlap, 0.01, degeneracy, 0.0, MatchStatus.ACCEPTED, np.eye(3))


NONE = rejected(np.zeros(3), np.eye(3), MatchStatus.OVERLAP)


def watched(matches, period=0.1):
    loss = LossDetector()
    for k, match in enumerate(matches):
        loss.take(round((k + 1) * period * SECOND), match)
    return loss


def test_single_misfits_are_no_loss():
    assert watched([fit(0.95), NONE, NONE, fit(0.9)]).fits
    assert not watched([*[fit(0.95)] * 5, *[NONE] * 12]).lost
    assert watched([*[fit(0.95)] * 5, *[NONE] * 20]).lost


def test_after_a_misfit_a_half_fit_is_none():
    assert watched([fit(0.95), fit(0.65)]).fits
    assert not watched([fit(0.95), NONE, fit(0.65)]).fits


def test_after_a_gap_a_corridor_proves_nothing():
    loss = watched([fit(0.95)] * 5)
    loss.take(70 * SECOND, fit(0.95, degeneracy=0.01))
    assert not loss.fits
    loss.take(round(70.1 * SECOND), fit(0.95))
    assert loss.fits
    assert watched([fit(0.95)] * 5, period=8.0).fits


def test_what_no_keyframe_saw_contradicts_nothing():
    mapper = Mapper()
    for k, pose in enumerate(rounds(30, 0.15, 3.6, 2.2)):
        mapper.step(scan(HALL, pose), int(k * 1e8), between(np.zeros(3), pose))
    origin = rounds(30, 0.15, 3.6, 2.2)[0]
    inside = between(origin, np.array((2.0, -1.4, 0.3)))
    assert not contradicts(mapper.map, scan(HALL, compose(origin, inside)), inside)
    assert contradicts(mapper.map, scan(HALL, np.array((-3.0, 1.8, 2.0))), inside)
    assert not contradicts(mapper.map, scan(HALL, np.array((-3.0, 1.8, 2.0))), np.array((40.0, 0.0, 0.0)))
