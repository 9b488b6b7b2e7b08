"""Motion from scan to scan."""

import subprocess
import sys
from itertools import pairwise

import numpy as np
import pytest

from monstertruck_estimation.consistency.config import ConsistencyConfig
from monstertruck_estimation.consistency.exchange import ScanVerdict, StepInput, StepOutput
from monstertruck_estimation.consistency.monitor import ConsistencyMonitor
from monstertruck_estimation.consistency.scan_odometry import ScanMotionStep, scatter_of
from monstertruck_estimation.slam.worker_io import ScanInput
from monstertruck_estimation.wheel_motion import WheelIncrement
from monstertruck_kinematics.se2 import between
from monstertruck_runtime.clock import SECOND
from tests.unit.estimation.consistency.kit import PERIOD, SENSORS, straight
from tests.unit.estimation.slam.kit import BEAMS, CORRIDOR, HALL, LIDAR, ROOM, box, ranges


def outputs(walls, poses, front, turn=0.0):
    rng, odometry = np.random.default_rng(3), ScanMotionStep()
    for k, pose in enumerate(poses):
        scan = ScanInput(
            stamp=SECOND + k * PERIOD,
            ranges=ranges(walls, pose, noise=0.01, rng=rng),
            start_angle=LIDAR.start_angle,
            angle_increment=LIDAR.angle_increment,
            range_min=0.02,
            range_max=30.0,
            time_increment=turn / BEAMS,
        )
        yield odometry.step(StepInput(scan, front))


@pytest.mark.parametrize("front", ["own", "kiss"])
@pytest.mark.parametrize(("walls", "start"), [(HALL, (-4.5, 2.0, 0.0)), (ROOM, (0.0, 1.4, 1.0))])
def test_it_follows_a_slow_start_along_walls(walls, start, front):
    """Pairs of points alone hold kiss-icp back by up to 0.1 m."""
    poses = straight(speed=0.1, seconds=5.0, start=start)
    truth = [between(a, b)[0] for a, b in pairwise(poses)]
    seen = [output.motion[0] for output in outputs(walls, poses, front)][1:]
    assert np.abs(np.cumsum(np.subtract(seen, truth))).max() < 0.02


@pytest.mark.parametrize("front", ["own", "kiss"])
def test_a_robot_at_rest_is_seen_at_rest_where_only_the_last_beams_meet_walls(front):
    """A distortion undone by the newest motion alone swings up from scan to scan."""
    corner = [((-1.6, 2.4), (1.2, 2.4)), ((1.2, 0.8), (1.2, 2.4))]
    seen = [output.motion for output in outputs(corner, [(0.0, 0.0, 0.0)] * 100, front, turn=0.067)][1:]
    assert np.abs(seen).max() < 0.03


def test_it_states_what_nothing_constrains():
    *_, hall = outputs(HALL, straight(), "own")
    *_, corridor = outputs(CORRIDOR, straight(seconds=2.0), "own")
    assert hall.deviations[0] < 0.03
    assert corridor.deviations[0] > 5 * hall.deviations[0]
    assert corridor.deviations[1] < 0.02


def watched(poses, walls=HALL, crowd=None):
    """What the scans show while the wheels read rest, in a robot that nobody has armed; the last of ``poses``."""
    rng, monitor, shown = np.random.default_rng(3), ConsistencyMonitor(ConsistencyConfig(), SENSORS), []
    odometry = ScanMotionStep()
    for k, pose in enumerate(poses):
        stamp = SECOND + k * PERIOD
        seen = walls if crowd is None else [*walls, *crowd(k)]
        monitor.observe_wheels(WheelIncrement(stamp - PERIOD, stamp, (0.0, 0.0, 0.0), 0.0, (), ()))
        scan = ScanInput(
            stamp=stamp,
            ranges=ranges(seen, pose, noise=0.01, rng=rng),
            start_angle=LIDAR.start_angle,
            angle_increment=LIDAR.angle_increment,
            range_min=0.02,
            range_max=30.0,
        )
        monitor.observe_scan(odometry.step(StepInput(scan, "own", rest=monitor.rest_claim(stamp, stamp))))
        shown.append(monitor.unshown)
    return shown


@pytest.mark.parametrize(("speed", "turn"), [(0.1, 0.0), (0.03, 0.0), (0.0, 0.3)])
def test_a_body_that_moves_while_its_wheels_read_rest_is_shown(speed, turn):
    shown = watched(straight(speed=speed, seconds=9.0, start=(-4.5, 2.0, 0.0), turn=turn))
    assert not any(shown[:20])
    first, newest = [motion for motion in shown if motion is not None][:2]
    assert newest.since == first.stamp, "none counts twice"
    seconds = (newest.stamp - newest.since) / SECOND
    assert newest.distance == pytest.approx(speed * seconds, abs=0.03)
    assert newest.turn == pytest.approx(turn * seconds, abs=0.05)


def test_a_body_that_stands_is_not_shown_to_move_though_people_walk_by():
    def crowd(k):
        return [wall for j in range(4) for wall in box(-2.0 + 0.05 * k + j, 1.0, -1.8 + 0.05 * k + j, 1.3)]

    assert not any(watched(np.array([(0.0, 1.4, 1.0)] * 80), ROOM, crowd))
    assert not any(watched(np.array([(0.0, 0.0, 0.0)] * 80), CORRIDOR))


def test_motions_that_jump_to_and_fro_state_their_scatter():
    """Along a corridor the registration jumps from one person who walks there to the next."""
    rng = np.random.default_rng(4)
    noise = rng.normal(0.0, 0.1, 200)
    changes = [(float(change**2), 0.0) for change in np.diff(noise, 2)]
    assert scatter_of(changes)[0] == pytest.approx(0.1, rel=0.15)
    assert scatter_of([]) == (0.0, 0.0)
    *_, newest = outputs(HALL, straight(), "own")
    assert newest.scatter[0] < 0.02
    assert newest.scatter[1] < 0.01


@pytest.mark.parametrize("scatter", [0.0, 0.1])
def test_scans_whose_motions_scatter_contradict_only_what_stands_out(scatter):
    monitor = ConsistencyMonitor(ConsistencyConfig(), SENSORS)
    monitor.activate(1)
    for k in range(15):
        stamp = SECOND + k * PERIOD
        monitor.observe_wheels(WheelIncrement(stamp - PERIOD, stamp, (0.5, 0.0, 0.0), 0.05, (), ()))
        asked = monitor.claim(stamp)
        refuted = None if asked is None else ScanVerdict(claimed=1, own=23, misfits=11)
        since = None if k == 0 else stamp - PERIOD
        moved = (0.02 if k % 2 else 0.0, 0.0, 0.0)
        monitor.observe_scan(StepOutput(stamp, since, moved, (0.01, 0.005), (scatter, 0.0), verdict=refuted))
        if monitor.findings():
            break
    assert bool(monitor.findings()) is (scatter == 0.0)


FIRST_SCAN = """
import sys
from importlib import import_module
from monstertruck_estimation.consistency.exchange import StepInput
from monstertruck_estimation.consistency.service import TARGET
from monstertruck_estimation.slam.scans import scans_in_a_room
module, name = TARGET.split(":")
worker, first, *_ = getattr(import_module(module), name)(), *scans_in_a_room()
before = set(sys.modules)
output = worker.step(StepInput(first, "kiss"))
print(output.front, output.since, sorted(set(sys.modules) - before))
"""


def test_a_worker_has_loaded_everything_before_its_first_scan():
    said = subprocess.run([sys.executable, "-c", FIRST_SCAN], check=True, capture_output=True, text=True).stdout
    assert said == "kiss None []\n"
