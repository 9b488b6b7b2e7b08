"""Mount of a lidar: yaw and mirror, from motions by odometry and by scans."""

import math

import numpy as np
import pytest

from monstertruck_estimation.slam.config import GridConfig, MapperConfig
from monstertruck_estimation.slam.mapping import MappingEstimator
from monstertruck_estimation.slam.mount import MountEstimate, mount_of
from monstertruck_estimation.slam.scans import prepare_input
from monstertruck_estimation.slam.worker_io import ScanInput
from monstertruck_kinematics.se2 import between, compose
from monstertruck_runtime.clock import SECOND
from tests.unit.estimation.slam.kit import HALL, LIDAR, drifting, ranges, rounds

TRUTH = np.array([(0.1 * k, 0.3 * math.sin(0.1 * k), 0.3 * math.cos(0.1 * k)) for k in range(200)])


def check(poses: np.ndarray, noise: float = 0.01, count: int = 200) -> MountEstimate | None:
    rng = np.random.default_rng(1)
    stamps = np.arange(1, count + 1) * SECOND
    scans = [
        ScanInput(int(stamp), np.ones(9), -1.0, 0.1, 0.02, 5.6, odom=tuple(odom.tolist()))
        for stamp, odom in zip(stamps, TRUTH, strict=False)
    ]
    return mount_of(scans, (stamps, poses[:count] + rng.normal(0, (noise, noise, 0.003), (count, 3))))


@pytest.mark.parametrize("degrees", [2.0, -5.0, 10.0])
def test_a_turned_lidar_is_found_to_a_third_of_a_degree(degrees: float):
    turned = compose(TRUTH, np.array((0.0, 0.0, math.radians(degrees))))
    found = check(turned)
    assert found is not None
    assert math.degrees(found.yaw) == pytest.approx(degrees, abs=0.3)
    assert found.fault is not None
    assert f"differ by {math.degrees(found.yaw):+.1f} degrees" in found.fault


def test_a_robot_that_crabs_looks_like_a_turned_lidar_and_both_causes_are_named():
    """Both axles trimmed to the left by 3 degrees: odometry knows nothing of it."""
    steps = between(TRUTH[:-1], TRUTH[1:])
    turn = compose(np.array((0.0, 0.0, math.radians(3.0))), steps)
    steps[:, :2] = turn[:, :2]
    path = [TRUTH[0]]
    for step in steps:
        path.append(compose(path[-1], step))
    found = check(np.array(path))
    assert found is not None
    assert math.degrees(found.yaw) == pytest.approx(-3.0, abs=0.3)
    assert "the lidar is turned relative to its mount: add that to its yaw, or run `calibrate lidar`" in str(
        found.fault
    )
    assert "both axles steer to one side: run `calibrate steering`" in str(found.fault)


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
    assert mount_of(scans, (np.array([SECOND]), np.zeros((1, 3)))) is None


def test_wrong_matches_and_slip_do_not_count():
    turned = compose(TRUTH, np.array((0.0, 0.0, math.radians(5.0))))
    turned[100:] += (0.0, 0.6, 0.0)
    turned[150:] += (-0.4, 0.3, 0.0)
    found = check(turned)
    assert found is not None
    assert math.degrees(found.yaw) == pytest.approx(5.0, abs=0.3)


def test_a_lidar_that_sits_elsewhere_on_the_robot_is_not_turned():
    """A robot that always turns left sees a displaced lidar move sideways all the time."""
    angles = 0.05 * np.arange(200)
    circle = np.column_stack((2.0 * np.sin(angles), 2.0 - 2.0 * np.cos(angles), angles))
    circle = np.concatenate((TRUTH, compose(np.broadcast_to(TRUTH[-1], circle.shape), circle)))
    stamps = np.arange(1, len(circle) + 1) * SECOND
    scans = [
        ScanInput(int(t), np.ones(9), -1.0, 0.1, 0.02, 5.6, odom=tuple(o)) for t, o in zip(stamps, circle, strict=True)
    ]
    found = mount_of(scans, (stamps, compose(circle, np.array((0.0, 0.1, 0.0)))))
    assert found is not None
    assert abs(math.degrees(found.yaw)) < 0.3


@pytest.mark.parametrize(
    ("yaw", "turns", "fault"), [(0.0, 1, None), (-5.0, 1, "differ by -"), (0.0, -1, "upside down")]
)
def test_mapping_reports_the_mount_within_twenty_seconds(yaw: float, turns: int, fault: str | None):
    truth, rng = rounds(150, laps=0.7, width=3.6, height=2.2), np.random.default_rng(2)
    odom, estimator = drifting(truth), MappingEstimator(MapperConfig(), GridConfig())
    for k, pose in enumerate(compose(truth, np.array((0.0, 0.0, math.radians(yaw))))):
        inputs = ScanInput(
            (k + 1) * SECOND // 8,
            ranges(HALL, pose, noise=0.01, rng=rng)[::turns],
            LIDAR.start_angle,
            LIDAR.angle_increment,
            LIDAR.range_min,
            LIDAR.range_max,
            odom=tuple(odom[k].tolist()),
        )
        estimate = estimator.step(prepare_input(inputs, 30.0), inputs)
    assert estimate is not None
    assert (estimate.mount_fault is None) if fault is None else (fault in str(estimate.mount_fault))
