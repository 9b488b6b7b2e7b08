import numpy as np
import pytest

from monstertruck_estimation.slam.mapping import Mapper
from monstertruck_estimation.slam.movers import MoverDetector, narrow
from monstertruck_estimation.slam.scans import prepare
from monstertruck_kinematics.se2 import between, compose
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.health import UNCERTAIN_DEVIATION, OdometryUse
from tests.unit.estimation.slam.kit import CORRIDOR, LIDAR, ROOM, box, ranges

STEP = 0.05
TENTH = SECOND // 10


def person(x, y):
    return box(x - 0.2, y - 0.2, x + 0.2, y + 0.2)


def straight(count):
    return np.column_stack((STEP * np.arange(count), np.zeros((count, 2))))


def walked(walls, people, poses):
    """Scans and still scans of a robot with exact wheels; ``people`` gives theirs at a scan."""
    detector, rng = MoverDetector(), np.random.default_rng(4)
    for k, pose in enumerate(poses):
        delta = np.zeros(3) if k == 0 else between(poses[k - 1], pose)
        scan = prepare(ranges([*walls, *people(k)], pose, noise=0.01, rng=rng), LIDAR)
        yield scan, detector.still(k * TENTH, delta, float(delta[2]), scan)
        detector.settle(float(delta[2]))


@pytest.mark.parametrize("velocity", [(0.5, 0.0), (-0.5, 0.0), (0.0, 0.5)])
def test_who_walks_along_against_or_across_is_left_out_and_no_wall_is(velocity):
    start = np.array((1.2, -0.6)) if velocity[0] > 0 else np.array((2.6, -0.6))

    def place(k):
        return start + 0.1 * k * np.array(velocity)

    *_, (scan, still) = walked([*CORRIDOR, ((5.0, -1.0), (5.0, 1.0))], lambda k: person(*place(k)), straight(16))
    at = place(15) - straight(16)[-1, :2]
    near = np.hypot(*(scan.points - at).T) < 0.35
    left = np.hypot(*(still.points - at).T) < 0.35
    assert near.sum() > 8
    assert left.sum() < 0.2 * near.sum()
    # What the person hid a second ago is not known yet either.
    assert len(still) >= len(scan) - 2 * near.sum()


def test_hardly_a_point_is_left_out_of_a_room_in_which_nothing_moves():
    poses = compose(np.array((-2.0, -1.5, 0.0)), straight(40))
    for scan, still in walked(ROOM, lambda _: [], poses):
        assert len(still) >= 0.98 * len(scan)


def test_a_whole_wall_that_seems_to_move_is_no_person():
    points = np.column_stack((np.full(40, 2.0), np.linspace(-2.0, 2.0, 40)))
    marks = np.ones(40, bool)
    marks[[8, 32]] = False
    assert not narrow(points, marks).any()
    marks[5:10] = False
    assert narrow(points, marks).sum() == 5


def test_wheels_that_turn_wrongly_make_nothing_move():
    rng = np.random.default_rng(2)
    chairs = [wall for x in range(-3, 4) for y in range(-2, 5) if np.hypot(x, y - 1.5) > 1.2 for wall in person(x, y)]
    mapper, left_out = Mapper(start=(0.8, 1.5, np.pi / 2)), 0
    truth = odom = np.array((0.8, 1.5, np.pi / 2))
    for k in range(30):
        scan = prepare(ranges(chairs, truth, noise=0.01, rng=rng), LIDAR)
        step = mapper.step(scan, 2 * k * TENTH, odom)
        assert step is not None
        left_out += len(scan) - len(step.scan)
        moved = np.array((0.08, 0.0, 0.1))
        truth, odom = compose(truth, moved), compose(odom, moved + np.array((0.0, 0.0, 0.15 * (-1) ** (k // 2))))
    assert mapper.odometry is OdometryUse.USED
    assert np.hypot(*between(truth, compose(step.pose, moved))[:2]) < 0.05
    assert left_out < 30


def test_without_odometry_nothing_is_compared():
    detector = MoverDetector()
    scan = prepare(ranges(CORRIDOR, (0.0, 0.0, 0.0)), LIDAR)
    for k in range(30):
        assert detector.still(k * TENTH, None, 0.0, scan) is scan
        detector.settle(0.0)


def test_a_crowd_that_begins_to_walk_takes_little_of_the_robot_and_none_of_its_wheels_along():
    """In a bare corridor, where only people tell how far the robot drove, all of them the same, and wrong."""
    truth, rng, mapper = straight(120), np.random.default_rng(0), Mapper()
    walls = [*CORRIDOR, *box(-1.4, 0.7, -1.0, 1.0)]
    degenerate = []
    crowd = [(1.3, -0.6), (2.0, 0.5), (2.9, -0.3), (0.2, 0.7), (-0.8, -0.6)]
    for k, pose in enumerate(truth):
        people = [wall for x, y in crowd for wall in person(x + 0.045 * max(k - 30, 0), y)]
        scan = prepare(ranges([*walls, *people], pose, noise=0.01, rng=rng), LIDAR)
        step = mapper.step(scan, k * TENTH, pose * (1.01, 1.0, 1.0))
        assert step is not None
        assert mapper.odometry is OdometryUse.USED
        degenerate.append(step.match.degenerate)
    # They have walked 4 m.
    assert abs(between(truth[-1], step.pose)[0]) < 0.2
    assert np.mean(degenerate[45:]) > 0.9
    assert step.covariance[0, 0] > UNCERTAIN_DEVIATION**2
