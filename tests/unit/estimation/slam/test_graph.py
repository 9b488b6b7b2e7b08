import numpy as np
import pytest

from monstertruck_estimation.slam.graph import Edges, drift, optimise, residuals, robust_weights
from monstertruck_estimation.slam.keyframes import pruned
from monstertruck_kinematics.se2 import between, compose
from tests.unit.estimation.slam.kit import errors, rounds

SMALL_WINDOW = np.diag((1e4, 1e4, 4e4))


def chain(poses, loops=(), information=SMALL_WINDOW):
    """Edges between successors and between ``loops`` = (origin, target, measured) of ``poses``."""
    pairs = [(k, k + 1, between(poses[k], poses[k + 1])) for k in range(len(poses) - 1)]
    rows = pairs + list(loops)
    return Edges(
        np.array([row[0] for row in rows]),
        np.array([row[1] for row in rows]),
        np.array([row[2] for row in rows]),
        np.tile(information, (len(rows), 1, 1)),
        np.arange(len(rows)) >= len(pairs),
    )


def drifted(truth, turn):
    poses = [truth[0]]
    for k in range(len(truth) - 1):
        poses.append(compose(poses[-1], between(truth[k], truth[k + 1]) + np.array((0.0, 0.0, turn))))
    return np.array(poses)


def test_a_closure_bends_the_whole_loop_back():
    truth = rounds(120, 1.0, 8.0, 6.0)
    bent = drifted(truth, 0.002)
    assert errors(bent, truth).max() > 0.8
    edges = chain(bent, [(0, 119, between(truth[0], truth[119])), (5, 118, between(truth[5], truth[118]))])
    assert errors(optimise(bent, edges), truth).max() < 0.45
    assert residuals(optimise(bent, edges), edges)[1].max() < 12


def test_a_false_closure_is_outvoted():
    truth = rounds(120, 1.0, 8.0, 6.0)
    bent = drifted(truth, 0.0005)
    true = [(k, 119 - k, between(truth[k], truth[119 - k])) for k in range(6)]
    false = (20, 80, np.zeros(3))
    edges = chain(bent, [*true, false])
    poses = optimise(bent, edges)
    assert errors(poses, truth).max() < 0.3
    weights = robust_weights(residuals(poses, edges)[1], edges.loop)
    assert weights[-1] < 0.01
    assert weights[:-1].min() > 0.9


def test_a_thousand_poses_settle():
    truth = rounds(1000, 4.0, 20.0, 15.0)
    bent = drifted(truth, 0.0005)
    loops = [(k, k + 250, between(truth[k], truth[k + 250])) for k in range(0, 750, 10)]
    assert errors(optimise(bent, chain(bent, loops)), truth).max() < 0.5 * errors(bent, truth).max()


def test_the_drift_bound_grows_with_the_way_and_shrinks_with_a_closure():
    truth = rounds(60, 0.9, 8.0, 6.0)
    edges = chain(truth)
    spread = np.tile((1e-4, 1e-5), (len(edges), 1))
    covariances, far = drift(truth, edges, spread, 59)
    assert covariances[59] == pytest.approx(np.zeros((3, 3)))
    assert (np.diff(far[::-1]) > 0).all()
    assert covariances[0, 2, 2] == pytest.approx(59e-5)
    closed = chain(truth, [(0, 59, between(truth[0], truth[59]))])
    nearer, _ = drift(truth, closed, np.tile((1e-4, 1e-5), (len(closed), 1)), 59)
    assert np.trace(nearer[0]) < 0.1 * np.trace(covariances[0])


def test_what_cannot_be_reached_is_infinitely_far():
    poses = rounds(3)
    edges = chain(poses[:2])
    covariances, far = drift(poses, edges, np.array(((1e-4, 1e-5),)), 0)
    assert np.isinf(far[2])
    assert np.isinf(covariances[2]).all()


def test_pruning_hands_relations_over_so_that_the_optimum_stays():
    truth = rounds(200, 2.0, 8.0, 6.0)
    bent = drifted(truth, 0.0003)
    edges = chain(bent, [(k, k + 99, between(truth[k], truth[k + 99])) for k in range(100)])
    full = optimise(bent, edges)
    marks = np.zeros(len(edges), bool)
    gone, stand_in, left, spread, odometry = pruned(
        full, np.zeros(len(full), np.int64), edges, np.full((len(edges), 2), 1e-4), marks, 0.1
    )
    assert gone.sum() == 20
    assert not gone[0]
    assert not gone[-60:].any()
    assert not gone[stand_in].any()
    assert not gone[left.origin].any()
    assert len(left) == len(spread) == len(odometry)
    number = np.cumsum(~gone) - 1
    again = optimise(bent[~gone], left.renumbered(number))
    assert np.abs(between(again, full[~gone])[:, :2]).max() < 0.05


def test_relations_handed_over_do_not_pile_up():
    truth = rounds(200, 2.0, 8.0, 6.0)
    edges = chain(truth, [(k, k + gap, between(truth[k], truth[k + gap])) for gap in (2, 3, 99) for k in range(100)])
    spread, marks, poses = np.full((len(edges), 2), 1e-4), np.zeros(len(edges), bool), truth
    for _ in range(5):
        gone, _, edges, spread, marks = pruned(poses, np.zeros(len(poses), np.int64), edges, spread, marks, 0.1)
        edges, poses = edges.renumbered(np.cumsum(~gone) - 1), poses[~gone]
        ends = np.sort(np.stack((edges.origin, edges.target)), axis=0)
        assert len(np.unique(ends, axis=1).T) == len(edges), "one relation between two keyframes"
