"""Places of which only a part was seen before, found again at the end of a run."""

import math

import numpy as np
import pytest

from monstertruck_estimation.se2 import between, compose
from monstertruck_estimation.slam.closure import Hit, LoopCloser, agreed, in_view
from monstertruck_estimation.slam.config import MapperConfig
from monstertruck_estimation.slam.keyframes import KeyMap
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
    """Key scans of a way out of the hall, round, and back into it from the other side, related by wheels that drift."""
    out = [(x, -1.0, 0.0) for x in np.arange(1.4, 3.1, 0.4)]
    turns = np.linspace(-math.pi / 2, math.pi / 2, 40)
    away = [(9.5 + 4 * math.cos(a), 1.6 * math.sin(a), a + math.pi / 2) for a in turns]
    back = [(x, 1.0, math.pi) for x in np.arange(3.4, 0.6, -0.4)]
    truth = np.array(out + away + back)
    odom = drifting(truth, 0.004, 1.01)
    keymap = KeyMap(MapperConfig())
    for k, pose in enumerate(truth):
        walls = hall(POSTS if k < len(out) + len(away) else came_back_to)
        keymap.add(scan(walls, pose), k, odom[k])
        if k:
            keymap.relate_by_odometry(between(odom[k - 1], odom[k]), np.diag((0.02**2, 0.02**2, 0.004**2)))
    return keymap, truth


def test_the_review_finds_a_place_seen_again_from_the_other_side():
    keymap, truth = far_round()
    assert errors(keymap.poses, truth)[-1] > 0.6
    assert LoopCloser().review(keymap)
    assert errors(keymap.poses, truth)[-1] < 0.05


def test_the_review_leaves_a_place_that_is_another_one():
    keymap, _ = far_round(came_back_to=OTHERS)
    before = keymap.poses.copy()
    assert not LoopCloser().review(keymap)
    assert keymap.poses == pytest.approx(before)


def test_the_joint_registration_keeps_a_closure_that_no_pair_of_scans_shows():
    keymap, truth = far_round()
    LoopCloser().review(keymap)
    keymap.refine()
    assert errors(keymap.poses, truth)[-1] < 0.05


def test_walls_hide_what_is_behind_them():
    viewer = scan(hall(()), (0.0, 0.0, 0.0))
    points = np.array(((4.0, 0.0), (4.5, 0.5), (5.5, 0.0), (-3.0, 0.0)))
    pose = np.array((1.0, 2.0, math.pi / 2))
    seen = in_view([viewer], pose[None], compose(pose, np.column_stack((points, np.zeros(4))))[:, :2])
    assert seen.tolist() == [True, True, False, False]


def line_of_keys(count=40):
    """Key scans 0.3 m apart on a line, related by wheels."""
    keymap = KeyMap(MapperConfig())
    for k in range(count):
        keymap.add(scan(hall(POSTS), (0.0, 0.0, 0.0)), k, (0.3 * k, 0.0, 0.0))
        if k:
            keymap.relate_by_odometry(np.array((0.3, 0.0, 0.0)), np.diag((0.02**2, 0.02**2, 0.004**2)))
    return keymap


def found(keymap, target, off):
    """Key scan ``target`` found beside the first one, ``off`` metres to the left of where the graph has it."""
    place = between(keymap.poses[0], compose(np.array((0.0, off, 0.0)), keymap.poses[target]))
    return Hit(0, target, place, np.diag((1e3, 1e3, 1e4)))


def test_hits_that_agree_are_believed_if_they_are_enough_and_far_enough_apart():
    keymap = line_of_keys()
    hits = [found(keymap, k, 0.5) for k in (20, 22, 24)]
    assert agreed(keymap, hits) == hits
    assert not agreed(keymap, hits[:2])
    assert not agreed(keymap, [found(keymap, k, 0.5) for k in (20, 21, 22)])


def test_hits_from_the_same_stretch_that_contradict_must_be_outvoted():
    keymap = line_of_keys()
    hits = [found(keymap, k, 0.5) for k in (18, 20, 22, 24)]
    false = [found(keymap, k, -1.0) for k in (21, 23)]
    assert not agreed(keymap, [*hits, *false])
    more = [*hits, found(keymap, 19, 0.5)]
    assert set(agreed(keymap, [*more, *false])) == set(more)


def test_hits_from_elsewhere_neither_contradict_nor_agree():
    keymap = line_of_keys()
    hits = [found(keymap, k, 0.5) for k in (20, 22, 24)]
    assert agreed(keymap, [*hits, *(found(keymap, k, -1.0) for k in (37, 38))]) == hits
    assert agreed(keymap, [*hits, *(found(keymap, k, 0.5) for k in (37, 38))]) == hits
