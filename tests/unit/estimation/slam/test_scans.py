import math
from dataclasses import replace

import numpy as np
import pytest

from monstertruck_estimation.slam.scans import (
    RANGE_NOISE,
    RELATIVE_NOISE,
    Scan,
    ScanGeometry,
    downsample_indices,
    prepare,
    prepare_input,
)
from monstertruck_estimation.slam.worker_io import ScanInput
from tests.unit.estimation.slam.kit import BEAMS, LIDAR, ROOM, box, ranges

FAN = ScanGeometry(-math.pi / 2, math.pi / 180, 0.1, 30.0)


def test_what_is_no_return_gives_no_point():
    values = np.full(181, 2.0)
    values[:6] = np.inf, np.nan, 0.0, 0.05, 30.0, -1.0
    assert len(prepare(values, FAN)) == 181 - 6
    assert len(prepare(values, FAN, longest=1.0)) == 0
    assert len(prepare(np.zeros(0), FAN)) == 0


def test_points_lie_where_the_beams_ended():
    points = prepare(np.full(181, 2.0), FAN).points
    assert points[90] == pytest.approx((2.0, 0.0))
    assert points[0] == pytest.approx((0.0, -2.0))
    mounted = ScanGeometry(-math.pi / 2, math.pi / 180, 0.1, 30.0, mount=(0.1, 0.2, math.pi / 2))
    assert prepare(np.full(181, 2.0), mounted).points[90] == pytest.approx((0.1, 2.2))


def test_a_wall_has_its_normal_towards_the_sensor_and_says_nothing_along_itself():
    angles = np.radians(np.arange(-90, 91))
    wall = 2.0 / np.maximum(np.cos(angles), 1e-9)
    scan = prepare(np.where(wall < 4.0, wall, np.inf), FAN)
    inner = slice(1, -1)
    assert scan.normals[inner] == pytest.approx(np.tile((-1.0, 0.0), (len(scan) - 2, 1)), abs=1e-6)
    assert (scan.variances[inner, 1] > 1.0).all()
    assert (scan.variances[inner, 0] < 0.04**2).all()


def test_a_lone_point_says_the_same_in_all_directions():
    values = np.full(181, np.inf)
    values[90] = 2.0
    scan = prepare(values, FAN)
    assert scan.variances[0, 0] == scan.variances[0, 1]


def test_points_are_as_unsure_as_the_data_sheet_says():
    values = ranges(ROOM, (2.0, 0.0, 1.5))
    sheet = {"start_angle": LIDAR.start_angle, "angle_increment": LIDAR.angle_increment, "range_min": 0.02}
    inputs = ScanInput(stamp=0, ranges=values, range_max=5.6, **sheet)
    for stated, near in ((None, RANGE_NOISE), (0.005, RANGE_NOISE), (0.0225, 0.0225)):
        least = (near + RELATIVE_NOISE * values.min()) ** 2
        found = prepare_input(replace(inputs, range_noise=stated), 4.0).variances[:, 0].min()
        assert found == pytest.approx(least, rel=0.05), stated


def test_motion_during_the_scan_is_undone():
    still = prepare(ranges(ROOM, (2.0, 0.0, 1.5)), LIDAR)
    beam_time = 0.067 / BEAMS
    moving = ScanGeometry(LIDAR.start_angle, LIDAR.angle_increment, 0.02, 5.6, beam_time)
    twist = (0.8, 0.1, 1.5)
    values = np.empty(BEAMS)
    for k in range(BEAMS):
        dt = k * beam_time
        turn = twist[2] * dt
        c, s = math.cos(1.5 + turn / 2), math.sin(1.5 + turn / 2)
        pose = (2.0 + (c * twist[0] - s * twist[1]) * dt, (s * twist[0] + c * twist[1]) * dt, 1.5 + turn)
        values[k] = ranges(ROOM, pose)[k]

    def off(scan):
        gap = np.hypot(*(scan.points[:, None] - still.points[None]).transpose(2, 0, 1)).min(axis=1)
        return np.percentile(gap, 90)

    assert off(prepare(values, moving, twist)) < 0.5 * off(prepare(values, moving))


@pytest.mark.parametrize("sense", [1, -1])
@pytest.mark.parametrize("rate", [1.0, -1.0])
def test_a_turn_of_one_radian_a_second_displaces_no_point_of_a_full_revolution(sense, rate):
    """At 3 m, of a lidar ahead of the centre that turns ten times a second either way."""
    count, beam_time = 450, 0.1 / 450
    start = -sense * math.pi
    geometry = ScanGeometry(start, sense * math.tau / count, 0.02, 12.0, beam_time, (0.14, 0.0, 0.0))
    turns = rate * beam_time * np.arange(count)
    poses = np.column_stack((np.zeros(count), np.zeros(count), turns))
    walls = box(-3.0, -3.0, 3.0, 3.0)

    def off(twist):
        points = prepare(ranges(walls, poses, geometry, count), geometry, twist).points
        return np.abs(np.abs(points).max(axis=1) - 3.0).max()

    assert off((0.0, 0.0, rate)) < 1e-6
    assert off((0.0, 0.0, 0.0)) > 0.1


def test_pruning_keeps_one_point_per_square_and_no_more_than_asked():
    scan = prepare(ranges(ROOM, (2.0, 0.0, 1.5)), LIDAR)
    pruned = scan.downsampled(0.2, 1000)
    cells = np.floor(pruned.points / 0.2)
    assert len(np.unique(cells, axis=0)) == len(pruned)
    assert len(scan.downsampled(0.01, 50)) == 50


@pytest.mark.parametrize("slope", [-0.3, 0.3])
def test_the_points_that_are_kept_of_a_wall_lie_on_it_on_average(slope):
    rng = np.random.default_rng(3)
    along = np.arange(0.0, 40.0, 0.01)
    off = rng.normal(0.0, 0.012, len(along))
    wall = np.array((math.cos(slope), math.sin(slope)))
    points = along[:, None] * wall + off[:, None] * (-wall[1], wall[0])
    kept = downsample_indices(points, 0.04)
    assert np.mean(off[kept]) == pytest.approx(0.0, abs=3 * 0.012 / math.sqrt(len(kept)))


def test_points_of_one_square_are_averaged_and_both_sides_of_a_wall_stay_apart():
    rng = np.random.default_rng(3)
    x = np.linspace(0.0, 0.2, 200, endpoint=False)
    near = np.column_stack((x, 1.0 + rng.normal(0.0, 0.005, len(x))))
    far = near + np.array((0.0, 0.009))
    down, up = np.tile((0.0, -1.0), (len(x), 1)), np.tile((0.0, 1.0), (len(x), 1))
    variances, extents = np.tile((0.01, 25.0), (2 * len(x), 1)), np.full(2 * len(x), 0.001)
    scan = Scan(np.concatenate((near, far)), np.concatenate((down, up)), variances, extents)
    few = scan.averaged(0.2)
    below, above = few.points[few.normals[:, 1] < 0], few.points[few.normals[:, 1] > 0]
    assert 1 <= len(below) <= 2
    assert 1 <= len(above) <= 2
    assert few.variances[0] == pytest.approx((0.01, 25.0))
    assert np.hypot(*few.normals.T) == pytest.approx(np.ones(len(few)))
    assert len(Scan(near[:0], down[:0], variances[:0], extents[:0]).averaged(0.1)) == 0
    shifted = Scan(near - np.array((0.0, 0.1)), down, variances[: len(x)], extents[: len(x)]).averaged(0.2)
    assert shifted.points == pytest.approx(np.array([[x.mean(), 0.9]]), abs=0.001), "the noise of 200 is averaged"
