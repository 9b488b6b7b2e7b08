import dataclasses
import functools
import itertools
import math
from pathlib import Path

import numpy as np
import pytest

from monstertruck_estimation.slam.config import GridConfig, MapperConfig
from monstertruck_estimation.slam.kiss import KissMatcher
from monstertruck_estimation.slam.mapping import Mapper, MappingEstimator, MappingEvent
from monstertruck_estimation.slam.scans import ScanGeometry, prepare, prepare_input
from monstertruck_kinematics.se2 import between, compose
from monstertruck_schemas.health import LocalisationStatus, OdometryUse
from monstertruckd.tools.logs.scans import read_scans
from tests.unit.estimation.slam.kit import (
    BEAMS,
    CORRIDOR,
    LIDAR,
    ROOM,
    box,
    drifting,
    drive,
    errors,
    ranges,
    rounds,
    scan,
)

RECORDING = Path(__file__).resolve().parents[3] / "data" / "urg04lx_exp2.dat.gz"

# A ring of corridors too long for the lidar to see across, with something to see everywhere.
BLOCKS = (
    (-5.0, 4.5),
    (-2.3, 4.7),
    (2.5, 4.4),
    (6.6, 1.5),
    (6.3, -3.0),
    (0.5, -4.6),
    (-3.2, -4.8),
    (-6.5, -1.0),
    (1.0, 1.6),
)
RING = [
    *box(-7.0, -5.0, 7.0, 5.0),
    *box(-3.8, -1.8, 3.8, 1.8),
    *(wall for x, y in BLOCKS for wall in box(x, y, x + 0.4 + 0.05 * abs(x), y + 0.35)),
]


@pytest.fixture(scope="module")
def lap():
    """One and a fifth laps of the ring, with wheels that drift."""
    truth = rounds(330, 1.2, 5.7, 3.7)
    mapper = Mapper()
    steps = drive(mapper, RING, truth, drifting(truth))
    return truth, mapper, steps


def test_drifting_wheels_are_put_right(lap):
    truth, mapper, steps = lap
    assert errors(drifting(truth), truth).max() > 2.0
    stamps, poses = mapper.trajectory()
    assert len(stamps) == len(truth)
    assert errors(poses, truth).max() < 0.12
    assert not any(MappingEvent.REJECTED in step.events for step in steps)


def test_the_loop_is_closed_and_related(lap):
    _, mapper, _ = lap
    edges = mapper.map.edges.edges()
    assert (edges.target - edges.origin > len(mapper.map) // 2).any()


def test_odom_does_not_jump_when_the_map_does(lap):
    truth, _, steps = lap
    odom = drifting(truth)
    for step, pose in zip(steps, odom, strict=True):
        assert compose(step.map_from_odom, pose) == pytest.approx(step.pose, abs=1e-9)


def test_the_joint_registration_at_the_end_is_better_still_and_keeps_the_place():
    truth = rounds(120, 1.0)
    mapper = Mapper()
    drive(mapper, ROOM, truth, drifting(truth))
    before = errors(mapper.trajectory()[1], truth).mean()
    mapper.finish()
    poses = mapper.trajectory()[1]
    assert errors(poses, truth).mean() < max(1.1 * before, 0.01)
    step = mapper.step(scan(ROOM, truth[-1]), int(1e12), drifting(truth)[-1])
    assert np.hypot(*(step.pose - poses[-1])[:2]) < 0.03


def test_two_runs_agree_to_the_last_bit():
    truth = rounds(60, 0.6)
    results = []
    for _ in range(2):
        mapper = Mapper()
        drive(mapper, ROOM, truth, drifting(truth))
        mapper.finish()
        results.append(mapper.trajectory()[1].tobytes())
    assert results[0] == results[1]


def test_without_wheels_the_motion_so_far_is_the_guess():
    truth = rounds(120, 0.6)
    mapper = Mapper()
    steps = drive(mapper, ROOM, truth, None)
    assert errors(mapper.trajectory()[1], truth).max() < 0.06
    assert steps[-1].map_from_odom is None
    assert mapper.twist[0] == pytest.approx(0.5, abs=0.15)


def test_the_distortion_of_a_swept_scan_is_undone_by_the_motion_it_shows():
    jerky = np.cumsum(20 + 18 * np.sin(0.8 * np.arange(60))).astype(int)
    truth = rounds(1500, 1.0)[jerky]
    swept = dataclasses.replace(LIDAR, time_increment=0.08 / BEAMS)
    share = np.linspace(0.0, 0.8, BEAMS)[:, None]
    scans = []
    for now, then in itertools.pairwise(truth):
        scans.append(ranges(ROOM, compose(now, share * between(now, then)), swept))
    off = []
    for twice in (False, True):
        mapper = Mapper()
        for k, values in enumerate(scans):
            again = functools.partial(prepare, values, swept)
            mapper.step(again(mapper.twist), int(k * 1e8), None, again if twice else None)
        off.append(errors(mapper.trajectory()[1], truth[:-1]).mean())
    assert off[1] < 0.95 * off[0]


def test_scans_stamped_unevenly_are_still_of_a_sensor_that_turns_evenly():
    truth = rounds(120, 1.0)
    swept = dataclasses.replace(LIDAR, time_increment=0.08 / BEAMS)
    share = np.linspace(0.0, 0.8, BEAMS)[:, None]
    scans = [ranges(ROOM, compose(now, share * between(now, then)), swept) for now, then in itertools.pairwise(truth)]
    late = np.random.default_rng(3).uniform(-0.045, 0.045, len(scans))
    off = []
    for period in (0.0, 0.1):
        mapper = Mapper()
        for k, values in enumerate(scans):
            again = functools.partial(prepare, values, swept)
            mapper.step(again(mapper.twist), int((k + 10 * late[k]) * 1e8), None, again, period)
        off.append(errors(mapper.trajectory()[1], truth[:-1]).mean())
    assert off[1] < 0.9 * off[0]


def test_a_corridor_does_not_collapse():
    truth = np.stack((np.linspace(0, 6, 150), np.full(150, 0.2), np.zeros(150)), axis=1)
    mapper = Mapper()
    steps = drive(mapper, CORRIDOR, truth, drifting(truth, turn=0.01, scale=1.0))
    assert np.mean([step.match.degenerate for step in steps[1:]]) > 0.9
    poses = mapper.trajectory()[1]
    assert np.hypot(*(poses[-1] - poses[0])[:2]) == pytest.approx(6.0, abs=0.3)
    assert steps[-1].match.covariance[0, 0] > 4 * steps[-1].match.covariance[1, 1]


def test_a_robot_that_stands_in_a_corridor_knows_its_place_and_one_that_drives_does_not():
    """Wheels that stand are exact; those that drive may slip, and no wall shows it."""
    truth = np.zeros((160, 3))
    truth[100:, 0] = 0.05 * np.arange(1, 61)
    steps = drive(Mapper(), CORRIDOR, truth, truth)
    deviation = np.sqrt([step.covariance[0, 0] for step in steps])
    assert deviation[99] < 0.03
    assert deviation[-1] > 0.1
    assert errors([step.pose for step in steps], truth).max() < 0.05


def test_shallow_doorways_of_a_corridor_correct_long_wheels():
    """The weak constraint along a corridor still measures the distance better than wheels that are 6 % long."""
    edges = itertools.accumulate(itertools.repeat(4.0, 13), initial=-5.0)
    doorways = [wall for x in edges for wall in box(x, 1.0, x + 0.9, 1.1)[1:]]
    walls = [CORRIDOR[0], *doorways, *(((x + 0.9, 1.0), (x + 4.0, 1.0)) for x in range(-5, 47, 4))]
    truth = np.stack((np.arange(0.0, 20.5, 0.5), np.zeros(41), np.zeros(41)), axis=1)
    odom = drifting(truth, turn=0.0, scale=1.06)
    steps = drive(Mapper(), walls, truth, odom)
    assert np.mean([step.match.degenerate for step in steps[1:]]) > 0.9
    assert errors([step.pose for step in steps], truth)[-1] < 0.8 * errors(odom, truth)[-1]


def test_by_scans_alone_the_map_grows_through_a_door_into_a_new_room():
    """A recorded drive at 1.5 m/s: half of the view is new."""
    estimator = MappingEstimator(MapperConfig(), GridConfig())
    steps = [
        estimator.step(prepare_input(row, 30.0, estimator.twist), row) for row in read_scans(RECORDING).scans[340:430]
    ]
    assert LocalisationStatus.LOST not in {step.status for step in steps}


def test_kiss_serves_as_front_end():
    truth = rounds(100, 0.5)
    mapper = Mapper(front=KissMatcher())
    steps = drive(mapper, ROOM, truth, drifting(truth))
    assert errors(mapper.trajectory()[1], truth).max() < 0.15
    assert np.mean([step.match.accepted for step in steps[1:]]) > 0.9


def other_geometry(pose):
    other = ScanGeometry(-math.pi / 2, math.pi / 90, 0.1, 30.0)
    return prepare(ranges(ROOM, pose, other, 91), other)


NOTHING = np.full(240, np.inf)
THREE = np.where(np.arange(240) < 3, 1.0, np.inf)
BAD = {
    "empty": lambda pose: prepare(np.zeros(0), LIDAR),
    "no return": lambda pose: prepare(NOTHING, LIDAR),
    "three points": lambda pose: prepare(THREE, LIDAR),
    "nan": lambda pose: prepare(np.full(240, np.nan), LIDAR),
    "other geometry": other_geometry,
}


@pytest.mark.parametrize("kind", BAD)
def test_bad_scans_in_between_neither_crash_nor_jump(kind):
    truth = rounds(80, 0.5)
    odom = drifting(truth)
    mapper = Mapper()
    reported = []
    for k, pose in enumerate(truth):
        bad = k % 7 == 3 or k == 0
        reported.append(mapper.step(BAD[kind](pose) if bad else scan(ROOM, pose), int(k * 1e8), odom[k]).pose)
    off = errors(reported[1:], truth[1:])
    assert off.max() < 0.15
    assert np.median(off) < 0.03


def test_time_that_stands_or_goes_back_is_left_out():
    mapper = Mapper()
    first = scan(ROOM, (2.0, 0.0, 1.0))
    assert mapper.step(first, 1000, np.zeros(3)) is not None
    assert mapper.step(first, 1000, np.zeros(3)) is None
    assert mapper.step(first, 10, np.ones(3)) is None
    assert mapper.step(first, 2000, np.zeros(3)).pose == pytest.approx(np.zeros(3), abs=1e-3)


def test_missing_and_doubled_scans_cost_nothing():
    truth = rounds(120, 0.8)
    odom = drifting(truth)
    mapper = Mapper()
    seen = []
    for k in range(len(truth)):
        if 40 <= k < 55:
            continue
        for again in range(2 if k % 5 == 0 else 1):
            mapper.step(scan(ROOM, truth[k]), int(k * 1e8 + again * 1e6), odom[k])
            seen.append(k)
    assert errors(mapper.trajectory()[1], truth[seen]).max() < 0.08


@pytest.mark.parametrize("lie", [(np.nan, 0.0, 0.0), (500.0, -80.0, 2.0)])
def test_odometry_that_lies_once_does_no_harm(lie):
    truth = rounds(80, 0.5)
    odom = drifting(truth)
    odom[40] = lie
    mapper = Mapper()
    drive(mapper, ROOM, truth, odom)
    assert errors(mapper.trajectory()[1], truth).max() < 0.08


def wrong(odom, kind):
    """Odometry with its steps mirrored, scaled or missing from the third second on."""
    steps = between(odom[:-1], odom[1:])
    factor = {"mirrored": (1, 1, -1), "stuck": (0, 0, 0), "half": (0.5, 0.5, 0.5), "double": (2, 2, 2)}
    if kind in factor:
        steps[30:] *= factor[kind]
    poses = np.array(list(itertools.accumulate(steps, compose, initial=odom[0])))
    if kind == "nan":
        poses[30:] = np.nan
    return poses


@pytest.mark.parametrize("kind", ["mirrored", "stuck", "half", "double", "nan"])
def test_wrong_odometry_is_reported_and_costs_nothing_against_scans_alone(kind):
    truth = rounds(160, 0.9)
    alone, mapper = Mapper(), Mapper()
    drive(alone, ROOM, truth, None)
    odom = wrong(drifting(truth), kind)
    drive(mapper, ROOM, truth[:81], odom[:81])
    assert mapper.odometry is (OdometryUse.MISSING if kind == "nan" else OdometryUse.CONTRADICTED)
    for k in range(81, len(truth)):
        mapper.step(scan(ROOM, truth[k]), int(k * 1e8), odom[k])
    best = errors(alone.trajectory()[1], truth).mean()
    assert errors(mapper.trajectory()[1], truth).mean() < max(1.2 * best, 0.02)


def test_ways_that_come_late_once_do_not_lose_a_robot_whose_turns_are_contradicted():
    truth = rounds(240, laps=1.5)
    turns, mapper = wrong(drifting(truth), "mirrored"), Mapper()
    drive(mapper, ROOM, truth[:81], turns[:81])
    assert mapper.odometry is OdometryUse.CONTRADICTED
    # A second without scans, over which odometry says nothing of the way.
    for k, odom in ((95, turns[81]), (96, turns[96]), (97, turns[97])):
        step = mapper.step(scan(ROOM, truth[k]), int(k * 1e8), odom)
        assert step.match.accepted
        assert step.pose[:2] == pytest.approx(between(truth[0], truth[k])[:2], abs=0.1)


def test_a_stale_odometry_does_not_spoil_the_map():
    truth = rounds(60, 0.8)
    odom = drifting(truth)
    odom[30] = odom[29]
    mapper = Mapper()
    drive(mapper, ROOM, truth, odom)
    assert errors(mapper.trajectory()[1], truth).max() < 0.08


def test_the_map_stays_bounded_and_right():
    truth = rounds(420, 3.0)
    mapper = Mapper(MapperConfig(most_keys=90, pruning=0.1, most_scans=300))
    steps = drive(mapper, ROOM, truth, drifting(truth))
    assert any(MappingEvent.PRUNED in step.events for step in steps)
    assert len(mapper.map) <= 90
    stamps, poses = mapper.trajectory()
    assert len(stamps) <= 300
    assert errors(poses, truth[(stamps / 1e8).round().astype(int)]).max() < 0.12
