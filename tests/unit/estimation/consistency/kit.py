"""A robot in a flat world whose sensors may lie, before the pure core of the consistency check."""

import math
from dataclasses import dataclass, field

import numpy as np

from monstertruck_estimation.consistency.comparison import Measure
from monstertruck_estimation.consistency.config import ConsistencyConfig
from monstertruck_estimation.consistency.exchange import StepInput
from monstertruck_estimation.consistency.monitor import ConsistencyMonitor
from monstertruck_estimation.consistency.scan_odometry import ScanMotionStep
from monstertruck_estimation.slam.worker_io import ScanInput
from monstertruck_estimation.wheel_motion import WheelIncrement
from monstertruck_kinematics.se2 import between, compose
from monstertruck_runtime.clock import SECOND
from tests.unit.estimation.slam.kit import LIDAR, ranges

PERIOD = SECOND // 10
SENSORS = {Measure.WHEELS: "drive", Measure.SCANS: "lidar"}


@dataclass
class Lies:
    """What is wrong; by default nothing."""

    scan: object = None
    """Called with (number, ranges by number); gives the ranges that are shown."""
    wheels: object = staticmethod(lambda motion: motion)
    """Called with the true motion, (3,)."""
    heading: object = staticmethod(lambda yaw: yaw)


@dataclass
class Trial:
    """What was found, and when."""

    found: dict = field(default_factory=dict)
    """Doubt by sensor."""
    at: dict = field(default_factory=dict)
    """Distance travelled when it was found, m."""


def straight(speed=0.25, seconds=8.0, start=(-2.0, 0.0, 0.0), turn=0.0):
    """Poses, (n, 3), ten a second: two seconds at rest, then at a constant speed (m/s) and turn rate (rad/s)."""
    poses = [np.array(start, float)] * 20
    for _ in range(int(seconds * 10)):
        poses.append(compose(poses[-1], np.array((speed / 10, 0.0, turn / 10))))
    return np.array(poses)


def drive(walls, poses, lies=None, front="own", sensors=SENSORS, config=None, gyro=False, armed=15) -> Trial:
    """Drive along the poses; ends when something is found."""
    lies = lies or Lies()
    rng, monitor, odometry = np.random.default_rng(3), ConsistencyMonitor(config or ConsistencyConfig(), sensors), None
    odometry, trial, way, seen = ScanMotionStep(), Trial(), 0.0, []
    for k, pose in enumerate(poses):
        stamp = SECOND + k * PERIOD
        if k == armed:
            monitor.activate(stamp - 1)
        if k:
            moved = between(poses[k - 1], pose)
            way += math.hypot(moved[0], moved[1])
            shown = np.asarray(lies.wheels(moved)) * 10.0
            monitor.observe_wheels(WheelIncrement(stamp - PERIOD, stamp, tuple(shown.tolist()), abs(moved[0]), (), ()))
        if Measure.COMPASS in sensors:
            monitor.observe_heading(stamp, float(lies.heading(pose[2])))
        if Measure.SCANS in sensors:
            seen.append(ranges(walls, pose, noise=0.01, rng=rng))
            beams = seen[-1] if lies.scan is None else lies.scan(k, seen)
            scan = ScanInput(
                stamp=stamp,
                ranges=beams,
                start_angle=LIDAR.start_angle,
                angle_increment=LIDAR.angle_increment,
                range_min=0.02,
                range_max=30.0,
            )
            monitor.observe_whole("lidar", stamp, beams.tobytes() if np.isfinite(beams).sum() > 20 else None)
            claim, rest, rolled = monitor.claim(stamp), monitor.rest_claim(stamp, stamp), monitor.rolled(stamp)
            step = StepInput(scan, front, claim=claim, lag=monitor.lag(), rest=rest, rolled=rolled)
            monitor.observe_scan(odometry.step(step))
        for doubt in monitor.findings():
            trial.found.setdefault(doubt.sensor, doubt)
            trial.at.setdefault(doubt.sensor, way)
        if trial.found:
            break
    return trial
