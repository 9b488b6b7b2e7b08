"""The trajectory that moves with the graph."""

import numpy as np
import pytest

from monstertruck_estimation.se2 import between
from monstertruck_estimation.slam.keyframes import Trajectory


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


def test_an_unmoved_graph_gives_back_what_was_told():
    trail, keys = straight()
    stamps, poses = trail.poses(keys)
    assert stamps.tolist() == list(range(9))
    assert poses[:, 0] == pytest.approx(np.arange(9))


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
