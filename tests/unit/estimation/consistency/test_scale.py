"""All ranges change by one factor from one revolution to the next."""

import numpy as np
import pytest

from monstertruck_estimation.consistency.comparison import Measure
from monstertruck_estimation.consistency.config import ConsistencyConfig
from monstertruck_estimation.consistency.exchange import StepInput, StepOutput
from monstertruck_estimation.consistency.monitor import ConsistencyMonitor
from monstertruck_estimation.consistency.scan_odometry import ScanMotionStep
from monstertruck_estimation.slam.worker_io import ScanInput
from monstertruck_estimation.wheel_motion import WheelIncrement
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.state import DoubtKind
from tests.unit.estimation.consistency.kit import PERIOD, SENSORS, Lies, drive, straight
from tests.unit.estimation.slam.kit import HALL, LIDAR, ranges

LANE = straight(start=(-4.5, 2.0, 0.0))


def changed(factor, at=40):
    return lambda k, seen: seen[k] * (factor if k >= at else 1.0)


@pytest.mark.parametrize("front", ["own", "kiss"])
@pytest.mark.parametrize("factor", [0.3, 0.5, 0.8, 1.3, 2.0])
def test_a_change_is_found_at_once(factor, front):
    trial = drive(HALL, LANE, Lies(scan=changed(factor)), front=front)
    doubt = trial.found["lidar"]
    assert doubt.kind is DoubtKind.SCALE
    assert doubt.difference == pytest.approx(abs(factor - 1.0), abs=0.03)
    assert trial.at["lidar"] == pytest.approx(21 * 0.025, abs=0.03), "at the first revolution"


def test_a_change_at_rest_is_found_though_the_robot_is_not_armed():
    trial = drive(HALL, LANE, Lies(scan=changed(0.5, at=10)), armed=1000)
    assert trial.found["lidar"].kind is DoubtKind.SCALE
    assert trial.at["lidar"] == 0.0


def test_a_part_of_the_view_that_a_hand_covers_is_no_change():
    def covered(k, seen):
        return np.where(np.arange(len(seen[k])) < 100, seen[k] * (0.2 if k >= 40 else 1.0), seen[k])

    found = drive(HALL, LANE, Lies(scan=covered)).found
    assert not any(doubt.kind is DoubtKind.SCALE for doubt in found.values())


@pytest.mark.parametrize("speed", [3.0, 5.0])
def test_a_robot_that_drives_far_between_two_revolutions_changes_no_scale(speed):
    """The wheels lead the registration, which does not reach so far by itself."""
    monitor, found = ConsistencyMonitor(ConsistencyConfig(), SENSORS), []
    poses = straight(speed=speed, seconds=1.2, start=(-4.5, 2.0, 0.0))
    rng, odometry = np.random.default_rng(1), ScanMotionStep()
    for k, pose in enumerate(poses):
        stamp, moved = SECOND + k * PERIOD, 0.0 if k < 20 else speed
        monitor.observe_wheels(WheelIncrement(stamp - PERIOD, stamp, (moved, 0.0, 0.0), moved / 10, (), ()))
        seen = ranges(HALL, pose, noise=0.01, rng=rng)
        scan = ScanInput(stamp, seen, LIDAR.start_angle, LIDAR.angle_increment, 0.02, 30.0)
        output = odometry.step(StepInput(scan, "own", rolled=monitor.rolled(stamp)))
        monitor.observe_scan(output)
        found.append(output.scale)
    assert found == [None] * len(poses)


def test_it_ends_when_the_ranges_change_back_or_the_lidar_has_been_silent():
    for end in (StepOutput(SECOND + PERIOD, None, scale=2.0), StepOutput(4 * SECOND, None)):
        monitor = ConsistencyMonitor(ConsistencyConfig(), SENSORS)
        monitor.observe_scan(StepOutput(SECOND, None, scale=0.5))
        monitor.activate(SECOND + 1)
        assert [doubt.sensor for doubt in monitor.findings()] == [SENSORS[Measure.SCANS]]
        monitor.observe_scan(end)
        assert monitor.findings() == ()
