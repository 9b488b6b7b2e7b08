"""Lidars that hang upside down, or behind parts of the robot."""

import math

import numpy as np
import pytest

from monstertruck_drivers.scanning.mounting import MountedScans, turned_by_roll, upright
from monstertruck_estimation.transforms import quaternion_from_rpy
from monstertruck_schemas.body import Mount
from monstertruck_schemas.sensor import HIDDEN, VALID_BEAM
from tests.unit.gate.rig import scan


class Kept:
    def __init__(self):
        self.scans = []

    def next_seq(self):
        return 7

    def put(self, message):
        self.scans.append(message)


def published(mount, hidden=(), start=-math.pi, end=math.pi * (1 - 2 / 360)):
    """A scan of 360 beams counter-clockwise, whose ranges are their numbers, as it is published."""
    message = scan(1).model_copy(
        update={
            "start_angle": start,
            "end_angle": end,
            "ranges": np.arange(360.0),
            "codes": np.full(360, VALID_BEAM, np.uint8),
        }
    )
    out = Kept()
    sink = MountedScans(out, mount, hidden)
    assert sink.next_seq() == 7
    sink.put(message)
    (found,) = out.scans
    return found


def bearing(message, beam):
    return message.start_angle + beam * message.angle_increment


def test_the_beams_of_a_lidar_that_hangs_are_mirrored():
    standing, hanging = published(Mount()), published(Mount(roll=math.pi))
    assert bearing(standing, 270) == pytest.approx(math.pi / 2)
    assert bearing(hanging, 270) == pytest.approx(-math.pi / 2)
    assert (hanging.ranges == standing.ranges).all()


@pytest.mark.parametrize(("roll", "found"), [(math.pi, 0.0), (3.1, 3.1 - math.pi), (-3.1, math.pi - 3.1), (0.1, 0.1)])
def test_its_mount_is_that_of_one_that_stands(roll, found):
    mount = Mount(x=0.1, yaw=1.0, roll=roll)
    assert upright(mount).roll == pytest.approx(found)
    assert upright(mount).planar == mount.planar


@pytest.mark.parametrize("turn", [(0.0, math.pi, 0.0), (0.1, 3.0, -0.5), (-2.0, -1.7, 3.0)])
def test_the_same_orientation_by_roll_instead_of_pitch(turn):
    roll, pitch, yaw = turn
    same = turned_by_roll(Mount(roll=roll, pitch=pitch, yaw=yaw))
    assert abs(same.pitch) < math.pi / 2
    rotations = quaternion_from_rpy(same.roll, same.pitch, same.yaw), quaternion_from_rpy(*turn)
    assert abs(np.dot(*rotations)) == pytest.approx(1.0), "quaternions of one rotation"


def degrees(message):
    return [round(math.degrees(bearing(message, i))) for i in np.flatnonzero(message.codes == HIDDEN)]


def test_hidden_sectors_measure_nothing_also_across_the_rear():
    message = published(Mount(), hidden=((3.0, -3.0), (0.0, 0.05)))
    assert degrees(message) == [*range(-180, -171), *range(3), *range(172, 180)]
    assert np.isinf(message.ranges[message.codes == HIDDEN]).all()
    assert np.isfinite(message.ranges[message.codes == VALID_BEAM]).all()


def test_hidden_sectors_are_those_of_the_published_scan():
    message = published(Mount(roll=math.pi), hidden=((1.0, 1.1),))
    assert degrees(message) == [63, 62, 61, 60, 59, 58]
