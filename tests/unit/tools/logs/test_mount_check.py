"""Mount of a lidar by a log: yaw and mirror, from motions by odometry and by scans."""

import math

import numpy as np
import pytest

from monstertruck_estimation.slam.worker_io import ScanInput
from monstertruck_kinematics.se2 import compose
from monstertruck_runtime.clock import SECOND
from monstertruckd.tools.logs.mount_check import MountCheck

TRUTH = np.array([(0.1 * k, 0.3 * math.sin(0.1 * k), 0.3 * math.cos(0.1 * k)) for k in range(200)])


def check(poses: np.ndarray, noise: float = 0.01, count: int = 200) -> MountCheck | None:
    rng = np.random.default_rng(1)
    stamps = np.arange(1, count + 1) * SECOND
    scans = [
        ScanInput(int(stamp), np.ones(9), -1.0, 0.1, 0.02, 5.6, odom=tuple(odom.tolist()))
        for stamp, odom in zip(stamps, TRUTH, strict=False)
    ]
    return MountCheck.of(scans, (stamps, poses[:count] + rng.normal(0, (noise, noise, 0.003), (count, 3))))


@pytest.mark.parametrize("degrees", [2.0, -5.0, 10.0])
def test_a_turned_lidar_is_found_to_a_third_of_a_degree(degrees: float):
    turned = compose(TRUTH, np.array((0.0, 0.0, math.radians(degrees))))
    found = check(turned)
    assert found is not None
    assert math.degrees(found.yaw) == pytest.approx(degrees, abs=0.3)
    assert found.fault is not None
    assert f"turned by {math.degrees(found.yaw):+.1f} degrees" in found.fault


def test_a_right_mount_is_no_fault():
    found = check(TRUTH)
    assert found is not None
    assert found.fault is None
    assert abs(found.yaw) < 3 * found.deviation


def test_mirrored_scans_turn_the_other_way():
    found = check(TRUTH * (1, -1, -1))
    assert found is not None
    assert found.mirrored
    assert "upside down" in str(found.fault)


def test_a_short_drive_and_one_without_odometry_tell_nothing():
    assert check(TRUTH, count=20) is None
    scans = [ScanInput(SECOND, np.ones(9), -1.0, 0.1, 0.02, 5.6)]
    assert MountCheck.of(scans, (np.array([SECOND]), np.zeros((1, 3)))) is None
