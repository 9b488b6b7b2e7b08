"""Bends that the body cannot drive become motions with changes of direction."""

import math

import numpy as np
import pytest

from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.pose_path import PosePath
from monstertruck_planners.route.repair import repaired
from monstertruck_planners.track.config import PurePursuitConfig
from monstertruck_planners.track.drivable import require_drivable
from monstertruck_planners.track.segments import check_path
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.reasons import Reason
from tests.unit.planners.kit import Follower, path, straight

GEOMETRY, CONFIG = FourWheelSteering(), PurePursuitConfig()
FOLD = np.vstack((straight(), straight()[-2::-1]))


@pytest.mark.parametrize(
    ("points", "bends"), [(FOLD, 1), ([(0, 0), (3, 0), (0, 1), (3, 2)], 2)], ids=["fold", "zigzag"]
)
def test_a_repaired_path_is_driven_to_its_end(points, bends):
    mended, texts = repaired(path(points), CONFIG, GEOMETRY)
    assert len(texts) == bends
    check_path(mended)
    require_drivable(mended, CONFIG, GEOMETRY)
    assert len(PosePath.of(mended).stops) == 2 * bends
    follower = Follower(mended)
    while (end := follower.step()).outcome is Reason.DRIVING:
        pass
    assert end.outcome is Reason.GOAL_REACHED
    assert max(abs(command.cross_track) for command in follower.log) < 0.15


def test_a_path_driven_backward_ends_backward():
    mended, _ = repaired(path(FOLD, [-1.0] * len(FOLD)), CONFIG, GEOMETRY)
    directions = PosePath.of(mended).directions
    assert directions[0] == directions[-1] == -1.0
    assert len(PosePath.of(mended).stops) == 2
    require_drivable(mended, CONFIG, GEOMETRY)


def test_speeds_and_steering_are_kept():
    route = path(FOLD, steering=["counter"] * len(FOLD)).model_copy(update={"speeds": np.full(len(FOLD), 0.1)})
    mended, _ = repaired(route, CONFIG, GEOMETRY)
    count = len(mended.poses) // 3
    assert mended.steering == ("counter",) * count
    assert mended.speeds.tolist() == [0.1] * count


def test_a_drivable_path_stays_as_it_is():
    route = path(straight())
    assert repaired(route, CONFIG, GEOMETRY) == (route, [])


def test_a_turn_that_would_touch_something_is_refused():
    def beside_a_wall(poses):
        return np.abs(poses[:, 1]) < 0.1

    with pytest.raises(InputError, match=r"pose 40 at 2\.00, 0\.00 m: .* touch an obstacle of the map at"):
        repaired(path(FOLD), CONFIG, GEOMETRY, beside_a_wall)
    assert repaired(path(FOLD), CONFIG, GEOMETRY, lambda poses: np.full(len(poses), True))[1]


def test_laps_are_mended_by_hand():
    square = [(0, 0), (2, 0), (2 - 2 * math.cos(0.5), 2 * math.sin(0.5))]
    with pytest.raises(InputError, match="repaired by hand"):
        repaired(path(square, closed=True), CONFIG, GEOMETRY)
