"""Error of a thinned log's trajectory at references between its scans."""

import numpy as np
import pytest

from benchmarks.slam_parts.thinned import at_all_scans


def test_turns_between_the_scans_of_a_thinned_log_are_no_error():
    stamps = np.arange(0, 41, dtype=np.int64) * 10**9
    poses = np.stack((0.1 * np.arange(41), np.sin(np.arange(41)), np.sin(0.7 * np.arange(41))), axis=1)
    all_stamps, all_poses = at_all_scans((stamps, poses), (stamps[::10], poses[::10]))
    assert (all_stamps == stamps).all()
    assert all_poses == pytest.approx(poses, abs=1e-9)
