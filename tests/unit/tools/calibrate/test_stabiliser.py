"""Zero and direction of the stabiliser's servos: what tells them, and what is refused."""

import math
from dataclasses import replace

import numpy as np
import pytest

from monstertruck_drivers.ax12.config import Ax12Config, JointConfig
from monstertruck_runtime.errors import InputError
from monstertruckd.tools.calibrate.stabiliser import Heights, RollPitch, beams_up, result_of
from tests.calibration_light import mounted, stabiliser_fit

SETTINGS = Ax12Config()
LEVEL = Heights(0.25, 0.25 - 2.0 * math.sin(0.01), 0.25 - 2.0 * math.sin(0.005))
LOW = replace(LEVEL, ahead=LEVEL.ahead + 0.05)
WALLS = (2.0, 2.0)
NARROW = SETTINGS.model_copy(update={"pitch": JointConfig(id=1, zero=511, min_position=510, max_position=512)})


class NoNoise:
    def normal(self, size=None):
        return 0.0 if size is None else np.zeros(size)


def stands(directions=(1, 1), zeros=(511.0, 204.0)):
    return [stand for _, _, stand in mounted(SETTINGS, zeros, directions, NoNoise())]


def judge(flat, nose, side):
    return result_of(flat, nose, side, LEVEL, WALLS, SETTINGS, 0.002)


@pytest.mark.parametrize("seed", range(20))
def test_every_wrong_direction_is_found(seed):
    assert all(verdict.holds for verdict in stabiliser_fit(np.random.default_rng(seed)) if "direction" in verdict.name)


def test_what_turned_the_wrong_way_has_to_be_looked_at_again():
    result = judge(*stands((1, -1)))
    assert result.again is not None
    assert result.again.startswith("roll turned the wrong way")
    assert judge(*stands()).again is None


def seen(stand, joints):
    up = beams_up(stand.body, joints, stand.angles)
    return replace(stand, ranges=np.minimum(np.where(up < 0.0, 0.25 / np.maximum(-up, 1e-9), np.inf), 3.5))


def test_swapped_servos_and_a_loose_horn_are_named():
    flat, nose, side = stands()
    for sign in (1, -1):
        with pytest.raises(InputError, match="pitch and roll servos are swapped"):
            judge(flat, seen(nose, RollPitch(0.0, sign * nose.joints.pitch)), side)
        with pytest.raises(InputError, match="pitch and roll servos are swapped"):
            judge(flat, nose, seen(side, RollPitch(sign * side.joints.roll, 0.0)))
    with pytest.raises(InputError, match="horn of the roll joint is loose"):
        judge(flat, nose, seen(side, RollPitch(0.0, 0.0)))


def test_blocks_that_are_missing_or_in_the_way_and_joints_that_rest_are_refused():
    flat, nose, side = stands()
    with pytest.raises(InputError, match=r"the nose is 0\.6 deg low: expected 4 to 15"):
        judge(flat, flat, side)
    with pytest.raises(InputError, match="the joint does not follow"):
        judge(flat, replace(nose, joints=flat.joints), side)
    floor = beams_up(nose.body, nose.body, nose.angles)
    half = np.where(np.arange(floor.size) % 2 == 0, 0.25 / np.maximum(-floor, 0.01), 3.5)
    with pytest.raises(InputError, match="unclear whether it sees the floor"):
        judge(flat, replace(nose, ranges=half), side)
    with pytest.raises(InputError, match=r"the pitch joint is level at position .* outside its limits of 510 to 512"):
        result_of(*stands(zeros=(514.0, 204.0)), LOW, WALLS, NARROW, 0.002)
    wall = replace(flat, ranges=np.minimum(flat.ranges, 1.5))
    with pytest.raises(InputError, match="use higher blocks or clear more floor"):
        judge(wall, nose, side)
