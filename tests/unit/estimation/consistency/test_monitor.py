"""Sensors that lie are found within half a metre; what is no lie is not: slip, corridors, open ground, people."""

from dataclasses import replace

import numpy as np
import pytest

from monstertruck_estimation.consistency.comparison import Measure
from monstertruck_estimation.consistency.config import ConsistencyConfig
from monstertruck_estimation.consistency.monitor import ConsistencyMonitor
from monstertruck_estimation.wheel_motion import WheelIncrement
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.state import DoubtKind
from tests.unit.estimation.consistency.kit import PERIOD, SENSORS, Lies, drive, straight
from tests.unit.estimation.slam.kit import CORRIDOR, HALL, LIDAR, ROOM, box, ranges, rounds

WITH_COMPASS = {**SENSORS, Measure.COMPASS: "compass"}
LANE = straight(start=(-4.5, 2.0, 0.0))
BEND = straight(start=(-4.5, 1.8, 0.6), turn=-0.25)


def frozen(k, seen, begin=20):
    return seen[min(k, begin)]


def noisy(k, seen, begin=20):
    return frozen(k, seen, begin) + np.random.default_rng(k).normal(0.0, 0.01, len(seen[0]))


def late(k, seen):
    return seen[max(k - 8, 0)]


@pytest.mark.parametrize("front", ["own", "kiss"])
def test_an_honest_robot_is_not_accused(front):
    for poses in (LANE, BEND, rounds(200, 1.0, 3.6, 2.2)):
        assert drive(HALL, poses, front=front, sensors=WITH_COMPASS).found == {}


@pytest.mark.parametrize("front", ["own", "kiss"])
@pytest.mark.parametrize("lie", [frozen, noisy, late])
def test_scans_that_do_not_follow_the_robot_are_found_soon(lie, front):
    trial = drive(HALL, LANE, Lies(scan=lie), front=front)
    assert trial.found["lidar"].kind in DoubtKind
    assert trial.at["lidar"] <= 0.55


@pytest.mark.parametrize("front", ["own", "kiss"])
@pytest.mark.parametrize(("scale", "within"), [(0.5, 1.6), (2.0, 0.7)])
def test_ranges_of_a_wrong_scale_are_found(scale, within, front):
    trial = drive(HALL, LANE, Lies(scan=lambda k, seen: scale * seen[k]), front=front)
    assert trial.found["lidar"].against == "drive"
    assert "scans:" in trial.found["lidar"].text
    assert trial.at["lidar"] <= within


def test_wheels_that_show_half_of_the_distance_are_found():
    trial = drive(HALL, LANE, Lies(wheels=lambda motion: motion * 0.5))
    assert {"drive", "lidar"} == trial.found.keys()
    assert trial.at["drive"] <= 0.5


@pytest.mark.parametrize("slip", [0.1, 0.3])
def test_wheels_that_slip_are_not_accused(slip):
    for poses in (LANE, BEND):
        assert drive(HALL, poses, Lies(wheels=lambda motion: motion / (1.0 - slip))).found == {}


def test_a_third_measure_names_the_one_that_lies():
    turning = straight(start=(0.0, -2.5, 0.0), speed=0.1, turn=0.5)
    mirrored = drive(HALL, turning, Lies(scan=lambda k, seen: seen[k][::-1]), sensors=WITH_COMPASS)
    assert mirrored.found.keys() == {"lidar"}
    dead = drive(HALL, turning, Lies(wheels=lambda motion: motion * (1.0, 1.0, 0.0)), sensors=WITH_COMPASS)
    assert dead.found.keys() == {"drive"}
    held = drive(HALL, turning, Lies(heading=lambda _: 0.3), sensors=WITH_COMPASS)
    assert held.found.keys() == {"compass"}


def test_a_turned_mount_is_found():
    mount = replace(LIDAR, mount=(0.0, 0.0, 0.5))

    def turned(k, _):
        return ranges(HALL, LANE[k], mount, noise=0.01, rng=np.random.default_rng(k))

    trial = drive(HALL, LANE, Lies(scan=turned))
    assert "lidar" in trial.found


@pytest.mark.parametrize("lie", [0.0, 1.0])
def test_where_scans_say_nothing_nobody_is_accused(lie):
    """In a corridor, and on open ground, the same scan fits whether the robot moves or not."""
    still = Lies(wheels=lambda motion: motion * lie)
    assert drive(CORRIDOR, straight(), still).found == {}
    assert drive(box(-90, -90, 90, 90), straight(), still).found == {}


def test_people_who_walk_before_a_robot_that_stands_are_no_motion():
    """A third of what the lidar sees walks by."""
    rng, seen = np.random.default_rng(1), []
    for k in range(80):
        crowd = [wall for j in range(4) for wall in box(-2.0 + 0.05 * k + j, 1.0, -1.8 + 0.05 * k + j, 1.3)]
        seen.append(ranges([*ROOM, *crowd], (0.0, 1.4, 1.0), noise=0.01, rng=rng))
    poses = np.array([(0.0, 1.4, 1.0)] * 80)
    assert drive(ROOM, poses, Lies(scan=lambda k, _: seen[k])).found == {}


def test_a_finding_about_motion_lasts_until_the_robot_is_armed_again():
    monitor = ConsistencyMonitor(ConsistencyConfig(), {Measure.GYRO: "imu", Measure.WHEELS: "drive"})
    monitor.activate(1)
    for k in range(200):
        stamp = SECOND + k * SECOND // 50
        turn = 0.0 if k < 60 else 0.5
        rolled(monitor, stamp, turn)
        monitor.observe_rate(stamp, 0.002)
    assert {doubt.sensor for doubt in monitor.findings()} == {"imu", "drive"}
    monitor.activate(None)
    assert monitor.findings()
    monitor.activate(10 * SECOND)
    assert not monitor.findings()


def rolled(monitor, stamp, turn):
    """The wheels turn the robot on the spot for a fiftieth of a second."""
    monitor.observe_wheels(WheelIncrement(stamp - SECOND // 50, stamp, (0.0, 0.0, turn), abs(turn), (), ()))


def test_measures_in_use_are_those_with_samples_of_late():
    monitor = ConsistencyMonitor(ConsistencyConfig(), WITH_COMPASS)
    monitor.observe_heading(SECOND, 0.0)
    assert monitor.in_use(2 * SECOND) == (Measure.COMPASS,)
    assert monitor.in_use(5 * SECOND) == ()


def test_a_stand_that_sees_the_robot_shows_wheels_that_lie():
    """The wheels show half of the distance."""
    sensors = {Measure.WHEELS: "drive", Measure.STAND: "stand"}
    poses, monitor = straight(seconds=6.0), ConsistencyMonitor(ConsistencyConfig(), sensors)
    monitor.activate(1)
    for k, pose in enumerate(poses):
        stamp = SECOND + k * PERIOD
        x, y, yaw = pose.tolist()
        speed = 0.0 if k == 0 else 5.0 * (x - float(poses[k - 1][0]))
        monitor.observe_stand(stamp, Pose2D(x=x, y=y, yaw=yaw))
        monitor.observe_wheels(WheelIncrement(stamp - PERIOD, stamp, (speed, 0.0, 0.0), abs(speed) / 10, (), ()))
    assert monitor.in_use(stamp) == (Measure.WHEELS, Measure.STAND)
    (found,) = [doubt for doubt in monitor.findings() if doubt.sensor == "drive"]
    assert found.against == "stand"
    assert "stand:" in found.text
