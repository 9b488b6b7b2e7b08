"""A robot that is carried while it maps: lost, a submap of its own, joined to the map by a verified closure."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from monstertruck_estimation.slam.budget import ScanBudget, finished
from monstertruck_estimation.slam.closure import LoopCloser, opposed
from monstertruck_estimation.slam.config import MapperConfig
from monstertruck_estimation.slam.keyframes import KeyframeMap
from monstertruck_estimation.slam.mapping import UNKNOWN, Mapper, MappingEvent
from monstertruck_estimation.slam.relocation import LossDetector, Relocation, contradicts, led_there
from monstertruck_estimation.slam.scan_matcher import MatchStatus, ScanMatch, rejected
from monstertruck_estimation.slam.storage import saved_graph
from monstertruck_kinematics.se2 import between, compose
from tests.unit.estimation.slam.kit import HALL, WAY, box, drifting, errors, extend, rounds, scan, submaps

SECOND = 10**9
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


def test_after_a_gap_a_room_of_the_same_outline_is_another_if_it_looks_through_the_cupboards():
    outline, mapper, rng = box(-2.5, -2.0, 2.5, 2.0), Mapper(), np.random.default_rng(3)
    cupboards = [*box(1.2, -0.5, 1.6, 0.9), *box(-1.0, 1.1, 0.3, 1.4), *box(-0.8, -1.6, 0.6, -1.2)]
    way = np.linspace((-1.4, 0.0, 0.0), (0.2, 0.0, 0.0), 60)
    for k, pose in enumerate(way):
        mapper.step(scan([*outline, *cupboards], pose, noise=0.01, rng=rng), int(k * 1e8), pose)
    # Not to a centimetre where it was: wheels that stood would say that it is still there.
    put_down = compose(way[-1], np.array((0.05, -0.05, 0.1)))
    steps = [
        mapper.step(scan(outline, put_down, noise=0.01, rng=rng), int((60 + k / 10) * SECOND), way[-1])
        for k in range(30)
    ]
    assert not any(step.match.accepted for step in steps[:2])
    assert mapper.lost
    assert any(MappingEvent.APART in step.events for step in steps)


@pytest.mark.parametrize(
    ("moved", "odom", "lost"),
    [
        pytest.param((0.9, 0.6, 0.4), (9.0, 4.0, 2.0), True, id="wheels begin anew"),
        pytest.param((0.9, 0.6, 0.4), None, True, id="no wheels"),
        pytest.param((0.0, 0.0, 0.0), None, False, id="it stood"),
        pytest.param((0.9, 0.6, 0.4), (0.9, 0.6, 0.4), False, id="wheels say where to"),
        pytest.param((0.9, 0.6, 0.4), (0.9, -0.1, 0.4), True, id="wheels say another place"),
    ],
)
def test_after_a_gap_one_place_that_fits_is_no_proof_unless_the_motion_led_there(moved, odom, lost):
    """In a room of the same shape, for instance: that nothing contradicts it says nothing."""
    walls, mapper, rng = [*box(-2.5, -2.0, 2.5, 2.0), *box(1.2, -0.5, 1.6, 0.9)], Mapper(), np.random.default_rng(3)
    for k, pose in enumerate(np.linspace((-1.4, -0.4, 0.0), (-1.0, -0.4, 0.0), 12)):
        mapper.step(scan(walls, pose, noise=0.01, rng=rng), int(k * 1e8), pose)
    place = compose(pose, np.array(moved))
    after = [
        mapper.step(
            scan(walls, place, noise=0.01, rng=rng),
            int((60 + k / 10) * SECOND),
            None if odom is None else compose(pose, np.array(odom)),
        )
        for k in range(5)
    ]
    assert after[0].match.accepted is not lost
    assert mapper.lost is lost
    assert any(MappingEvent.APART in step.events for step in after) is lost


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


def test_a_submap_left_open_is_joined_when_the_robot_comes_back_to_it():
    keyframes, relocation, closer = submaps(slice(15), slice(20, 40)), Relocation(), LoopCloser()
    joined = [
        (count - 35, np.unique(keyframes.part).tolist())
        for count in extend(keyframes, WAY[5:32], (-9.0, 2.0, 2.0))
        if relocation.step(keyframes, closer, ScanBudget(1e12))
    ]
    assert [parts for _, parts in joined] == [[0, 15], [0]]
    assert joined[0][0] < 15 < joined[1][0]
    assert errors(keyframes.poses, np.concatenate((WAY[:15], WAY[20:40], WAY[5:32]))).max() < 0.06


def test_at_the_end_of_a_run_open_submaps_are_searched_for_once_more():
    keyframes, relocation = submaps(slice(22), slice(10, 40)), Relocation()
    assert relocation.finish(keyframes, LoopCloser())
    assert keyframes.joined().all()
    assert errors(keyframes.poses, np.concatenate((WAY[:22], WAY[10:40]))).max() < 0.06


def test_submaps_of_different_places_stay_apart_at_the_end():
    keyframes = submaps(slice(10), slice(25, 35))
    assert not Relocation().finish(keyframes, LoopCloser())
    assert np.unique(keyframes.part).tolist() == [0, 10]


def test_aligning_a_submap_never_moves_the_map():
    keyframes = submaps(slice(10), slice(5, 15))
    there = keyframes.poses[:10].copy()
    keyframes.place(12, there[7], 0)
    assert keyframes.poses[12] == pytest.approx(there[7])
    eighth = np.array((1.0, 1.0, 1.0))
    keyframes.place(8, eighth, 10)
    assert keyframes.poses[:10] == pytest.approx(there)
    assert between(keyframes.poses[8], keyframes.poses[12]) == pytest.approx(between(eighth, there[7]))


class Searched(KeyframeMap):
    """Remembers which keyframes were merged."""

    def submap(self, numbers):
        self.merged = numbers
        return super().submap(numbers)


def test_a_loop_is_not_searched_for_in_what_is_known_from_the_keyframe_itself():
    keyframes, closer, way = Searched(MapperConfig()), LoopCloser(), rounds(70, 1.4, 3.6, 2.2)[:60]
    odom, rng = drifting(way, 0.004, 1.01), np.random.default_rng(3)
    for k, pose in enumerate(way):
        keyframes.add(scan(HALL, pose, noise=0.01, rng=rng), k * SECOND, odom[k])
        if k:
            keyframes.add_odometry_edge(between(odom[k - 1], odom[k]), np.diag((0.05**2, 0.05**2, 0.01**2)))
    overlapped = closed = 0
    for at in range(50, 59):
        known, keyframes.merged = keyframes.well_known(at), ()
        closed += finished(closer._close(keyframes, at))
        overlapped += np.isin(keyframes.merged, known).sum()
    assert closed >= 3
    assert not overlapped


def sides(keyframes):
    return np.flatnonzero(keyframes.part != 0), np.flatnonzero(keyframes.part == 0)


def test_submaps_joined_at_a_wrong_place_look_through_each_other():
    keyframes = submaps(slice(22), slice(10, 40))
    keyframes.place(22, keyframes.poses[10], 0)
    assert not finished(opposed(keyframes, *sides(keyframes)))
    keyframes.place(22, compose(keyframes.poses[10], np.array((0.0, 1.5, 0.8))), 0)
    assert finished(opposed(keyframes, *sides(keyframes)))


def fit(overlap, degeneracy=0.5):
    return ScanMatch(np.zeros(3), np.eye(3), overlap, 0.01, degeneracy, 0.0, MatchStatus.ACCEPTED, np.eye(3))


NONE = rejected(np.zeros(3), np.eye(3), MatchStatus.OVERLAP)


def watched(matches, period=0.1):
    loss = LossDetector()
    for k, match in enumerate(matches):
        loss.arrive(round((k + 1) * period * SECOND))
        loss.take(match)
    return loss


@pytest.mark.parametrize(("off", "mapped"), [(0.0, True), (0.3, False)])
def test_where_the_wheels_lead_sparse_scans_grow_the_map_into_new_rooms(off, mapped):
    """Scans of a new room, half a metre apart, overlap what is known by half."""
    way, rng = rounds(31, 1.0, 3.6, 2.2), np.random.default_rng(3)
    mapper, known = Mapper(start=tuple(way[0].tolist())), 20

    def match(_scan, _delta, guess, covariance, _submap):
        overlap = 0.9 if len(mapper.map) < known else 0.5
        place = guess if overlap > 0.5 else guess + np.array((0.0, off, 0.0))
        return dataclasses.replace(fit(overlap), pose=place, covariance=np.diag((1e-4, 1e-4, 1e-4)))

    mapper._front = SimpleNamespace(match=match)
    for k, pose in enumerate(way if mapped else way[: known + 3]):
        step = mapper.step(scan(HALL, pose, noise=0.01, rng=rng), 2 * (k + 1) * SECOND, pose)
        assert (MappingEvent.KEY in step.events) is (mapped or k < known)
    assert not mapper.lost


def test_single_misfits_are_no_loss():
    assert watched([fit(0.95), NONE, NONE, fit(0.9)]).fits
    assert not watched([*[fit(0.95)] * 5, *[NONE] * 12]).lost
    assert watched([*[fit(0.95)] * 5, *[NONE] * 20]).lost


def test_sparse_scans_that_do_not_fit_are_judged_along_the_path():
    loss = LossDetector()
    for k in range(40):
        loss.arrive(2 * (k + 1) * SECOND)
        loss.take(fit(0.95) if k < 30 else NONE, (0.5, 1.6))
        assert loss.lost is (k >= 30 and 0.5 * (k - 29) >= 7.0)
    for _ in range(5):
        loss.take(NONE, (0.5, 1.6))
    assert loss.lost


@pytest.mark.parametrize(
    ("off", "deviation", "led"),
    [
        pytest.param((0.05, 0.0, 0.5), (0.1, 0.6), True, id="the yaw alone is uncertain"),
        pytest.param((0.2, 0.0, 0.0), (0.1, 0.1), False, id="beside the prediction"),
        pytest.param((0.2, 0.0, 0.0), (0.8, 0.1), False, id="the place is uncertain"),
    ],
)
def test_over_a_gap_wheels_lead_to_a_match_within_their_deviation(off, deviation, led):
    covariance = np.diag(np.square((deviation[0], *deviation)))
    match = dataclasses.replace(fit(0.5), pose=np.array(off))
    assert led_there(match, np.zeros(3), covariance) is led


def test_over_a_gap_a_half_fit_where_the_wheels_led_does_not_spare_another_match_the_check():
    outline, rng = box(-2.5, -2.0, 2.5, 2.0), np.random.default_rng(3)
    cupboards = [*box(1.2, -0.5, 1.6, 0.9), *box(-1.0, 1.1, 0.3, 1.4), *box(-0.8, -1.6, 0.6, -1.2)]
    mapper, way = Mapper(), np.linspace((-1.4, 0.0, 0.0), (0.2, 0.0, 0.0), 60)
    for k, pose in enumerate(way):
        mapper.step(scan([*outline, *cupboards], pose, noise=0.01, rng=rng), int(k * 1e8), pose)
    # The scan shows a room without the cupboards: by the wheels it fits by half, by the last motion as a whole.
    overlaps = iter((0.5, 0.9))

    def match(_scan, _delta, guess, covariance, _submap):
        return dataclasses.replace(fit(next(overlaps)), pose=guess, covariance=covariance)

    mapper._front = SimpleNamespace(match=match)
    step = mapper.step(scan(outline, way[-1], noise=0.01, rng=rng), 60 * SECOND, way[-1])
    assert step.match.overlap == 0.5, "the other one was checked, and rejected"


def test_after_a_misfit_a_half_fit_is_none():
    assert watched([fit(0.95), fit(0.65)]).fits
    assert not watched([fit(0.95), NONE, fit(0.65)]).fits


def test_after_a_gap_a_corridor_proves_nothing():
    loss = watched([fit(0.95)] * 5)
    loss.arrive(70 * SECOND)
    loss.take(fit(0.95, degeneracy=0.01))
    assert not loss.fits
    loss.arrive(round(70.1 * SECOND))
    loss.take(fit(0.95))
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
