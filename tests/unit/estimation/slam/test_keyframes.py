"""The trajectory that moves with the graph."""

import numpy as np
import pytest

from monstertruck_estimation.slam import keyframes
from monstertruck_estimation.slam.graph import drift
from monstertruck_estimation.slam.keyframes import LOOSENED, Trajectory
from monstertruck_estimation.slam.mapping import Mapper
from monstertruck_kinematics.se2 import between
from tests.unit.estimation.slam.kit import rounds, scan
from tests.unit.estimation.slam.test_relocation import HALL


def straight(count: int = 9, every: int = 4) -> tuple[Trajectory, np.ndarray]:
    """Scans 1 m apart, every fourth one a keyframe; and the keyframes."""
    poses = np.column_stack((np.arange(float(count)), np.zeros(count), np.zeros(count)))
    keys = poses[::every]
    trail = Trajectory(1000)
    for k, pose in enumerate(poses):
        if k and k % every == 0:
            trail.append(k, k // every - 1, between(keys[k // every - 1], pose))
        trail.append(k, k // every, between(keys[k // every], pose))
    return trail, keys


def test_an_unmoved_graph_gives_back_what_was_reported():
    trail, keys = straight()
    stamps, poses = trail.poses(keys)
    assert stamps.tolist() == list(range(9))
    assert poses[:, 0] == pytest.approx(np.arange(9))


def test_every_scan_has_the_mark_of_its_keyframe():
    trail, _ = straight()
    assert trail.marked(np.array((True, False, True))).tolist() == [True] * 4 + [False] * 4 + [True]


def test_what_a_closure_moves_is_spread_over_the_scans_between():
    trail, keys = straight()
    keys[1] += (0.0, 0.4, 0.0)
    keys[2] += (0.0, 0.4, 0.0)
    _, poses = trail.poses(keys)
    assert poses[:, 1] == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4, 0.4, 0.4, 0.4, 0.4])


def test_a_trail_of_one_key_scan_follows_it():
    trail, _ = straight(3)
    stamps, poses = trail.poses(np.array([[1.0, 2.0, 0.0]]))
    assert stamps.tolist() == [0, 1, 2]
    assert poses == pytest.approx(np.array([[1.0, 2.0, 0.0], [2.0, 2.0, 0.0], [3.0, 2.0, 0.0]]))


@pytest.fixture(scope="module")
def twice_round():
    """Keyframes of two rounds through a hall, in which the second sees what the first saw."""
    mapper = Mapper()
    for k, pose in enumerate(rounds(160, 2.0, 3.6, 2.2)):
        mapper.step(scan(HALL, pose), k * 10**8, pose)
    return mapper.map


def test_a_joint_registration_is_kept_only_where_views_far_apart_in_time_agree_better(twice_round, monkeypatch):
    good = twice_round.poses.copy()
    bent = good + 0.2 * np.sin(np.linspace(0, 9.0, len(good)))[:, None] * (1.0, 1.0, 0.0)
    monkeypatch.setattr(keyframes, "refine", lambda *_: bent)
    assert not twice_round.refine()
    assert np.array_equal(twice_round.poses, good)
    twice_round.poses = bent
    monkeypatch.setattr(keyframes, "refine", lambda *_: good)
    assert twice_round.refine()
    assert np.array_equal(twice_round.poses, good)


def test_views_that_judge_are_far_apart_in_time_and_no_partners(twice_round):
    pairs = keyframes.witnesses(twice_round.frames, twice_round.poses, np.zeros(len(twice_round), int))
    stamps = np.array([key.stamp for key in twice_round.frames])
    assert len(pairs) > 10
    assert np.diff(stamps[pairs], axis=1).min() >= 0.25 * (stamps[-1] - stamps[0])
    partners = set(map(tuple, keyframes.partners(twice_round.poses).tolist()))
    assert not partners & set(map(tuple, pairs.tolist()))


def test_poses_at_any_instant_move_with_the_keyframes_and_are_unknown_off_the_map():
    poses = np.column_stack((np.arange(3.0), np.zeros(3), np.zeros(3)))
    trail, keys = Trajectory(1000), poses[:2].copy()
    for k, pose in enumerate(poses):
        trail.append(100 * k, min(k, 1), between(keys[min(k, 1)], pose))
    asked, joined = np.array([-1, 0, 50, 200, 201]), np.ones(2, np.bool_)
    found = trail.at(asked, keys, joined)
    assert np.isnan(found[[0, -1]]).all()
    assert found[1:4, 0] == pytest.approx([0.0, 0.5, 2.0])
    keys[:, 1] += 2.0
    assert trail.at(asked, keys, joined)[2] == pytest.approx(found[2] + np.array((0.0, 2.0, 0.0)))
    for lost in (0, 1):
        joined[:] = True
        joined[lost] = False
        assert np.isnan(trail.at(asked, keys, joined)[2]).all(), "one end of the line is nowhere"


def test_the_drift_is_computed_once_until_poses_or_edges_change(monkeypatch: pytest.MonkeyPatch):
    mapper, computed = Mapper(), []
    for k, pose in enumerate(rounds(40, 0.5, 3.6, 2.2)):
        mapper.step(scan(HALL, pose), k * 10**8, pose)
    keys, newest = mapper.map, len(mapper.map) - 1
    monkeypatch.setattr(keyframes, "drift", lambda *inputs: computed.append(inputs) or drift(*inputs))
    keys.drift(0)
    first, _ = keys.drift(newest)
    assert keys.drift(newest)[0] is first
    assert len(computed) == 2
    keys.poses = keys.poses + np.array((1.0, 0.0, 0.0))
    keys.drift(newest)
    assert len(computed) == 3
    keys.edges.loosen(np.ones(len(keys.edges), bool))
    assert keys.drift(newest)[0][0, 2, 2] == pytest.approx(first[0, 2, 2] * LOOSENED**2)
    count = len(keys.edges)
    keys.edges.keep(slice(1, count))
    keys.drift(newest)
    assert len(computed) == 5
