"""Places of which only a part was seen before, found again at the end of a run."""

import math

import numpy as np
import pytest

from monstertruck_estimation.slam.closure import LoopCloser, LoopMatch, consistent_group, in_view
from monstertruck_estimation.slam.config import MapperConfig
from monstertruck_estimation.slam.keyframes import KeyframeMap
from monstertruck_kinematics.se2 import between, compose
from tests.unit.estimation.slam.kit import box, drifting, errors, scan

POSTS = ((-1.6, 1.3), (-0.7, -0.2), (0.4, 1.0), (0.9, -2.0), (1.7, 0.3), (2.6, -1.0), (3.4, 1.5), (3.0, 0.5))
OTHERS = ((-1.3, -1.7), (0.2, 0.2), (0.9, 1.6), (1.6, -0.4), (2.2, 1.1), (2.9, -1.6), (3.7, -0.5))


def hall(posts):
    """A hall with posts, and a second one the way leads through before it comes back."""
    return [
        *box(-4.5, -2.4, 4.5, 2.4),
        *(wall for x, y in posts for wall in box(x, y, x + 0.3, y + 0.2)),
        *box(9.0, -4.0, 20.0, 4.0),
    ]


def far_round(came_back_to=POSTS):
    """Keyframes of a way out of the hall, round, and back into it from the other side, related by wheels that drift."""
    out = [(x, -1.0, 0.0) for x in np.arange(1.4, 3.1, 0.4)]
    turns = np.linspace(-math.pi / 2, math.pi / 2, 40)
    away = [(9.5 + 4 * math.cos(a), 1.6 * math.sin(a), a + math.pi / 2) for a in turns]
    back = [(x, 1.0, math.pi) for x in np.arange(3.4, 0.6, -0.4)]
    truth = np.array(out + away + back)
    odom = drifting(truth, 0.004, 1.01)
    keyframes = KeyframeMap(MapperConfig())
    for k, pose in enumerate(truth):
        walls = hall(POSTS if k < len(out) + len(away) else came_back_to)
        keyframes.add(scan(walls, pose), k, odom[k])
        if k:
            keyframes.add_odometry_edge(between(odom[k - 1], odom[k]), np.diag((0.02**2, 0.02**2, 0.004**2)))
    return keyframes, truth


def test_the_review_finds_a_place_seen_again_from_the_other_side():
    keyframes, truth = far_round()
    assert errors(keyframes.poses, truth)[-1] > 0.6
    assert LoopCloser().review(keyframes)
    assert errors(keyframes.poses, truth)[-1] < 0.05


def test_the_review_leaves_a_place_that_is_another_one():
    keyframes, _ = far_round(came_back_to=OTHERS)
    before = keyframes.poses.copy()
    assert not LoopCloser().review(keyframes)
    assert keyframes.poses == pytest.approx(before)


def test_the_joint_registration_keeps_a_closure_that_no_pair_of_scans_shows():
    keyframes, truth = far_round()
    LoopCloser().review(keyframes)
    keyframes.refine()
    assert errors(keyframes.poses, truth)[-1] < 0.05


def test_walls_hide_what_is_behind_them():
    viewer = scan(hall(()), (0.0, 0.0, 0.0))
    points = np.array(((4.0, 0.0), (4.5, 0.5), (5.5, 0.0), (-3.0, 0.0)))
    pose = np.array((1.0, 2.0, math.pi / 2))
    seen = in_view([viewer], pose[None], compose(pose, np.column_stack((points, np.zeros(4))))[:, :2])
    assert seen.tolist() == [True, True, False, False]


def line_of_keys(count=40):
    """Keyframes 0.3 m apart on a line, related by wheels."""
    keyframes = KeyframeMap(MapperConfig())
    for k in range(count):
        keyframes.add(scan(hall(POSTS), (0.0, 0.0, 0.0)), k, (0.3 * k, 0.0, 0.0))
        if k:
            keyframes.add_odometry_edge(np.array((0.3, 0.0, 0.0)), np.diag((0.02**2, 0.02**2, 0.004**2)))
    return keyframes


def found(keyframes, target, off):
    """Keyframe ``target`` found beside the first one, ``off`` metres to the left of where the graph has it."""
    place = between(keyframes.poses[0], compose(np.array((0.0, off, 0.0)), keyframes.poses[target]))
    return LoopMatch(0, target, place, np.diag((1e3, 1e3, 1e4)), (0.0009, 0.0001), target)


def test_hits_that_agree_are_believed_if_they_are_enough_and_far_enough_apart():
    keyframes = line_of_keys()
    hits = [found(keyframes, k, 0.5) for k in (20, 22, 24)]
    assert consistent_group(keyframes, hits) == hits
    assert not consistent_group(keyframes, hits[:2])
    assert not consistent_group(keyframes, [found(keyframes, k, 0.5) for k in (20, 21, 22)])


def test_hits_from_the_same_stretch_that_contradict_must_be_outvoted():
    keyframes = line_of_keys()
    hits = [found(keyframes, k, 0.5) for k in (18, 20, 22, 24)]
    false = [found(keyframes, k, -1.0) for k in (21, 23)]
    assert not consistent_group(keyframes, [*hits, *false])
    more = [*hits, found(keyframes, 19, 0.5)]
    assert set(consistent_group(keyframes, [*more, *false])) == set(more)


def test_hits_from_elsewhere_neither_contradict_nor_agree():
    keyframes = line_of_keys()
    hits = [found(keyframes, k, 0.5) for k in (20, 22, 24)]
    assert consistent_group(keyframes, [*hits, *(found(keyframes, k, -1.0) for k in (37, 38))]) == hits
    assert consistent_group(keyframes, [*hits, *(found(keyframes, k, 0.5) for k in (37, 38))]) == hits
