"""Trajectories in the TUM format: every pose is of the middle of its scan's sweep."""

import math
from pathlib import Path

import numpy as np
import pytest

from monstertruck_estimation.slam.worker_io import ScanInput
from monstertruck_runtime.clock import SECOND
from monstertruckd.tools.logs.scan_log import ScanLog
from monstertruckd.tools.logs.trajectory import LINES, mid_sweep, write_trajectory


def test_poses_move_on_to_the_middle_of_the_sweep():
    stamps = np.arange(5) * 0.1
    poses = np.stack((stamps * 2.0, np.zeros(5), stamps * 0.5), axis=1)
    middle = mid_sweep(stamps, poses, 0.05)
    assert middle[:-1] == pytest.approx(poses[:-1] + np.array((0.1, 0.0, 0.025)))
    # The last one goes on as the one before.
    assert math.hypot(*(middle[-1] - poses[-1])[:2]) == pytest.approx(0.1, abs=1e-3)
    assert mid_sweep(stamps, poses, 0.0) is poses
    assert mid_sweep(stamps[:1], poses[:1], 0.05).tolist() == poses[:1].tolist()


def test_a_file_has_the_logs_own_times(tmp_path: Path):
    scans = [
        ScanInput(SECOND + k * SECOND // 10, np.ones(100), -1.0, 0.02, 0.02, 5.6, time_increment=0.001)
        for k in range(3)
    ]
    poses = [(0.1 * k, 0.0, math.pi / 2) for k in range(3)]
    file = tmp_path / "poses.txt"
    said = write_trajectory(file, [scan.stamp for scan in scans], poses, ScanLog("npz", scans, begin=999.0))
    rows = np.loadtxt(file)
    assert rows.shape == (3, 8)
    assert rows[:, 0] == pytest.approx((1000.05, 1000.15, 1000.25))
    assert rows[:, 1] == pytest.approx((0.05, 0.15, 0.25))
    assert rows[:, 6:] == pytest.approx(math.sqrt(0.5))
    assert "3 poses, each 0.05 s after" in said


def test_nothing_localised_is_an_empty_file(tmp_path: Path):
    scans = [ScanInput(SECOND, np.ones(3), -1.0, 0.02, 0.02, 5.6)]
    write_trajectory(tmp_path / "a.txt", [], [], ScanLog("npz", scans))
    assert (tmp_path / "a.txt").read_text() == ""


def test_kitti_has_matrices_and_lost_poses_keep_their_times(tmp_path: Path):
    scans = [ScanInput(SECOND + k * SECOND, np.ones(9), -1.0, 0.02, 0.02, 5.6) for k in range(3)]
    poses = [(0.1 * k, 2.0, 0.5) for k in range(3)]
    stamps, lost = [scan.stamp for scan in scans], np.array((False, True, False))
    write_trajectory(tmp_path / "a.txt", stamps, poses, ScanLog("npz", scans), lost, lines=LINES["kitti"])
    rows = np.loadtxt(tmp_path / "a.txt").reshape(3, 3, 4)
    assert rows[2] == pytest.approx(
        np.array(((math.cos(0.5), -math.sin(0.5), 0, 0.2), (math.sin(0.5), math.cos(0.5), 0, 2.0), (0, 0, 1, 0)))
    )
    assert np.loadtxt(tmp_path / "a.lost.txt")[:3] == pytest.approx((2.0, 0.1, 2.0))
