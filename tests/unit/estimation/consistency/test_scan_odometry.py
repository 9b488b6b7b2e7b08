"""Motion from scan to scan."""

from itertools import pairwise

import numpy as np
import pytest

from monstertruck_estimation.consistency.exchange import StepInput
from monstertruck_estimation.consistency.scan_odometry import ScanMotionStep
from monstertruck_estimation.se2 import between
from monstertruck_estimation.slam.worker_io import ScanInput
from monstertruck_runtime.clock import SECOND
from tests.unit.estimation.consistency.kit import PERIOD, straight
from tests.unit.estimation.slam.kit import CORRIDOR, HALL, LIDAR, ROOM, ranges


def outputs(walls, poses, front):
    rng, odometry = np.random.default_rng(3), ScanMotionStep()
    for k, pose in enumerate(poses):
        scan = ScanInput(
            stamp=SECOND + k * PERIOD,
            ranges=ranges(walls, pose, noise=0.01, rng=rng),
            start_angle=LIDAR.start_angle,
            angle_increment=LIDAR.angle_increment,
            range_min=0.02,
            range_max=30.0,
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


def test_it_states_what_nothing_constrains():
    *_, hall = outputs(HALL, straight(), "own")
    *_, corridor = outputs(CORRIDOR, straight(seconds=2.0), "own")
    assert hall.deviations[0] < 0.03
    assert corridor.deviations[0] > 5 * hall.deviations[0]
    assert corridor.deviations[1] < 0.02
