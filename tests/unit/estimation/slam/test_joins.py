"""Joins of submaps are in doubt until confirmed: a robot is carried into a room that looks like one of its map."""

import itertools
import math

import numpy as np
import pytest

from monstertruck_estimation.slam.budget import ScanBudget
from monstertruck_estimation.slam.closure import LoopCloser
from monstertruck_estimation.slam.config import GridConfig, MapperConfig
from monstertruck_estimation.slam.keyframes import KeyframeMap
from monstertruck_estimation.slam.mapping import Mapper, MappingEstimator, MappingEvent
from monstertruck_estimation.slam.relocation import JoinChange, Relocation
from monstertruck_estimation.slam.scans import prepare_input
from monstertruck_estimation.slam.worker_io import ScanInput
from monstertruck_kinematics.se2 import between, compose, transform
from monstertruck_schemas.health import LocalisationStatus
from tests.unit.estimation.slam.kit import HALL, LIDAR, WAY, box, consume, extend, ranges, rounds, scan

SECOND = 10**9


def wall(y, *ends):
    return [((a, y), (b, y)) for a, b in zip(ends[::2], ends[1::2], strict=True)]


TWINS = [
    *[*wall(0.0, 0.0, 8.0), *wall(4.0, 0.0, 1.5, 2.5, 5.5, 6.5, 12.0), *wall(5.6, 0.0, 12.0)],
    *[((x, y), (x, top)) for x, y, top in ((0.0, 0.0, 5.6), (4.0, 0.0, 4.0), (8.0, 0.0, 4.0), (12.0, 4.0, 5.6))],
    *[*box(1.0, 1.0, 1.4, 1.3), *box(5.0, 1.0, 5.4, 1.3), *box(10.0, 5.2, 10.5, 5.6)],
]
"""Two equal rooms, their doors on one hall: the left end of the hall is nearer to the left one."""
RIGHT = ((9, 4.8), (5, 4.8), (6, 4.2), (6, 2.4), (7.2, 1.6), (7, 0.7), (6, 0.7), (6.2, 2.4), (6, 3))
LEFT = ((2, 2.4), (3.2, 1.6), (3, 0.7), (2, 0.7), (2.2, 2.4), (2, 4), (1.6, 4.8), (0.7, 4.9), (0.6, 4.6), (1.2, 4.5))
ON = ((5, 4.9), (9.4, 4.8))


def along(*corners):
    """Poses, shape (n, 3), a decimetre apart, facing ahead."""
    done = np.r_[0.0, np.cumsum([math.dist(a, b) for a, b in itertools.pairwise(corners)])]
    at = np.arange(0.0, done[-1], 0.1)
    here, before, after = (
        np.stack([np.interp(s, done, column) for column in np.array(corners, float).T], axis=1)
        for s in (at, at - 0.3, at + 0.3)
    )
    ahead = after - before
    return np.column_stack((here, np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))))


@pytest.fixture(scope="module")
def deceived():
    """It maps the right room, is carried into the left one, and leaves that: estimates, and walls on the grid."""
    legs = along(*RIGHT), along(*LEFT, *ON)
    truth = np.concatenate(legs)
    odom = np.concatenate((legs[0], compose(legs[0][-1], between(legs[1][0], legs[1]))))
    estimator, rng, steps, grids = MappingEstimator(MapperConfig(), GridConfig()), np.random.default_rng(1), [], {}
    for k, (pose, by_wheels) in enumerate(zip(truth, odom, strict=True)):
        inputs = ScanInput(
            int((k + 1) * 0.2 * SECOND), ranges(TWINS, pose, noise=0.01, rng=rng), LIDAR.start_angle,
            LIDAR.angle_increment, LIDAR.range_min, LIDAR.range_max, odom=tuple(by_wheels),
        )  # fmt: skip
        steps.append(estimator.step(prepare_input(inputs, 30.0), inputs))
        for event in {"apart", "joined", "parted"}.intersection(steps[-1].events):
            redrawn = estimator.changes()[1]
            grids.setdefault(event, []).append((k, walls_of(estimator.patch(), truth[0]), redrawn))
    return estimator, steps, truth, grids


def walls_of(patch, origin):
    """Middles, shape (n, 2), of the occupied cells in the world."""
    rows, columns = np.nonzero(patch.cells > 65)
    cells = np.stack((columns + 0.5, rows + 0.5), axis=1) * patch.resolution + patch.origin
    return transform(origin, cells)


def beside(cells):
    """Distance of each from the nearest wall of the world, m."""
    a, b = (np.array([each[k] for each in TWINS], float) for k in (0, 1))
    along_, off = b - a, cells[:, None] - a
    share = np.clip((off * along_).sum(-1) / (along_**2).sum(-1), 0.0, 1.0)
    return np.linalg.norm(off - share[..., None] * along_, axis=-1).min(axis=1)


def test_a_join_that_the_way_out_of_the_room_contradicts_is_undone_and_it_is_lost_again(deceived):
    _, steps, _, grids = deceived
    (apart, *_), (wrong, right), (parted,) = (grids[name] for name in ("apart", "joined", "parted"))
    assert apart[0] < wrong[0] < parted[0] < right[0]
    for k, step in enumerate(steps):
        lost = apart[0] <= k < wrong[0] or parted[0] <= k < right[0]
        assert (step.status is LocalisationStatus.LOST) is lost or k < apart[0]
        assert (step.map_from_odom is None) is lost or k < apart[0]


def test_the_grid_is_drawn_anew_without_what_the_wrong_join_had_brought(deceived):
    _, _, _, grids = deceived
    (_, before, _), _, (_, after, redrawn) = grids["apart"][0], grids["joined"][0], grids["parted"][0]
    assert redrawn
    assert beside(after).max() < 0.12
    assert after[:, 0].min() > before[:, 0].min() - 0.1
    assert abs(len(after) - len(before)) < 0.1 * len(before)


def test_then_it_is_joined_where_it_is_with_all_that_waited(deceived):
    estimator, _, truth, grids = deceived
    _, cells, _ = grids["joined"][1]
    assert beside(cells).max() < 0.15
    assert cells[:, 0].min() < 0.1
    pose = compose(truth[0], estimator.mapper.map.poses[-1])
    assert math.dist(pose[:2], truth[-1, :2]) < 0.4
    assert beside(walls_of(estimator.patch(), truth[0])).max() < 0.15


def joined(off):
    """A map of a part of the hall, and a submap of the next joined to it, displaced by ``off``, shape (3,)."""
    keyframes = KeyframeMap(MapperConfig())
    consume(extend(keyframes, WAY[:25], WAY[0]))
    consume(extend(keyframes, WAY[18:22], compose(WAY[18], np.array(off))))
    measured = between(keyframes.poses[20], keyframes.poses[27])
    keyframes.edges.add(20, 27, measured, np.eye(3) * 1e4, (1e-3, 1e-4), loop=True)
    keyframes.join(25, 0)
    return keyframes


def test_what_both_sides_see_through_of_each_other_parts_them_and_no_edge_is_left_between():
    keyframes, relocation, closer = joined((0.8, 0.9, 0.5)), Relocation(), LoopCloser()
    before = keyframes.poses[:25].copy()
    assert not keyframes.part.any()
    changes = (relocation.step(keyframes, closer, ScanBudget(1e12)) for _ in extend(keyframes, WAY[21:30]))
    assert JoinChange.PARTED in changes
    assert keyframes.part.tolist() == [0] * 25 + [25] * (len(keyframes) - 25)
    edges = keyframes.edges.edges()
    assert not ((edges.origin < 25) & (edges.target >= 25)).any()
    assert keyframes.poses[:25] == pytest.approx(before, abs=1e-3)
    assert not keyframes.doubtful


def test_a_right_join_is_confirmed_after_some_way_and_not_before():
    keyframes, relocation, closer, doubts = joined((0.0, 0.0, 0.0)), Relocation(), LoopCloser(), []
    for _ in extend(keyframes, np.concatenate((WAY[21:25], WAY[24::-1], WAY[:6]))):
        assert relocation.step(keyframes, closer, ScanBudget(1e12)) is None
        way = np.hypot(*np.diff(keyframes.poses[29:, :2], axis=0).T).sum()
        doubts.append((way, bool(keyframes.doubtful)))
    assert all(doubt == (way < 10.0) for way, doubt in doubts)
    assert not doubts[-1][1]
    assert not keyframes.part.any()


def test_joins_are_undone_back_to_the_wrong_one_each_with_its_own_keyframes():
    keyframes = KeyframeMap(MapperConfig())
    for k, first in enumerate((0, 10, 20)):
        consume(extend(keyframes, WAY[first : first + 5], (9.0 * k, 0.0, 0.0)))
    keyframes.join(10, 5)
    first = keyframes.doubtful[0]
    consume(extend(keyframes, WAY[24:27]))
    keyframes.join(5, 0)
    consume(extend(keyframes, WAY[26:29]))
    assert [side.tolist() for side in keyframes.sides(first)] == [list(range(10, 19)), list(range(5, 10))]
    keyframes.separate(first)
    assert keyframes.part.tolist() == [0] * 5 + [5] * 5 + [10] * 9


def test_who_is_lost_again_before_the_join_is_confirmed_has_it_undone():
    way, mapper, rng = rounds(200, 1.0, 3.6, 2.2), Mapper(), np.random.default_rng(1)
    events = []
    elsewhere = [*box(-2.0, -1.5, 2.4, 1.9), *box(0.6, 0.2, 1.1, 0.5), *box(-1.6, 0.9, -1.1, 1.9)]
    stretches = [(HALL, way[:70]), (HALL, way[15:75]), (elsewhere, rounds(20, 0.2, 0.9, 0.6))]
    odom = np.zeros(3)
    for walls, stretch in stretches:
        for k, pose in enumerate(stretch):
            odom = odom if k == 0 else compose(odom, between(stretch[k - 1], pose))
            stamp = (len(events) + 1) * SECOND // 10
            events.append(mapper.step(scan(walls, pose, noise=0.01, rng=rng), stamp, odom).events)
    reported = [event for step in events for event in step if event in {"apart", "joined", "parted"}]
    assert reported == [MappingEvent.APART, MappingEvent.JOINED, MappingEvent.PARTED, MappingEvent.APART]
    assert len(np.unique(mapper.map.part)) == 3
    assert mapper.lost


@pytest.mark.parametrize(
    "down",
    [
        pytest.param((1.33, 2.21, 0.60), id="fits at once in the window of its last motion"),
        pytest.param((3.24, 2.57, 0.64), id="in the other room"),
        pytest.param((5.06, 5.02, 1.30), id="fits by half, looking through walls"),
    ],
)
def test_a_carried_robot_is_lost_though_something_fits_where_odometry_did_not_lead(down):
    way = along(*RIGHT[:5])
    put = np.array([compose(np.array(down), np.array((0.03 * k, 0.0, 0.0))) for k in range(14)])
    odom = np.concatenate((way, compose(way[-1], between(put[0], put))))
    mapper, rng = Mapper(), np.random.default_rng(1)
    steps = [
        mapper.step(scan(TWINS, pose, noise=0.01, rng=rng), (k + 1) * SECOND // 5, by_wheels)
        for k, (pose, by_wheels) in enumerate(zip(np.concatenate((way, put)), odom, strict=True))
    ]
    assert not any(MappingEvent.KEY in step.events for step in steps[len(way) : len(way) + 7])
    assert any(MappingEvent.APART in step.events for step in steps[len(way) :])
    assert mapper.lost
