"""The occupancy grid: what a scan leaves in it, growth, changed tiles, rebuilding, stored points."""

from dataclasses import replace

import numpy as np
import pytest

from monstertruck_drivers.hokuyo_urg.protocol import split_ranges
from monstertruck_estimation.slam.config import GridConfig
from monstertruck_estimation.slam.grid import PAGE_POINTS, TILE, GridBuilder, OccupancyGrid, PointPages, passed_ends
from monstertruck_estimation.slam.scans import Scan, prepare_input
from monstertruck_estimation.slam.storage import elements
from monstertruck_estimation.slam.worker_io import ScanInput
from monstertruck_schemas.sensor import LaserScan

ORIGIN = np.zeros(2)


def value(grid: OccupancyGrid, x: float, y: float) -> int:
    patch = grid.patch()
    column = int(np.floor((x - patch.origin[0]) / patch.resolution + 1e-9))
    row = int(np.floor((y - patch.origin[1]) / patch.resolution + 1e-9))
    rows, columns = patch.cells.shape
    return int(patch.cells[row, column]) if 0 <= row < rows and 0 <= column < columns else -1


def scan_of(*points: tuple[float, float]) -> Scan:
    array = np.array(points, float)
    return elements(array, normals=np.tile((1.0, 0.0), (len(array), 1)), variances=np.full((len(array), 2), 1e-4))


@pytest.mark.parametrize("angle", np.linspace(0, 2 * np.pi, 17))
def test_a_beam_frees_what_it_passed_and_occupies_its_end(angle: float):
    grid = OccupancyGrid()
    middle = np.array((0.025, 0.025))  # of a cell
    end = np.array((2.02 * np.cos(angle), 2.02 * np.sin(angle)))
    grid.add(middle, (middle + end)[None])
    assert value(grid, *(middle + end)) == 70
    assert value(grid, *middle) == 40
    sideways = 0.04 * np.array((-np.sin(angle), np.cos(angle)))
    for share in (0.25, 0.5, 0.9):  # within a cell of the true line
        near = {value(grid, *(middle + end * share + shift * sideways)) for shift in (-1, 0, 1)}
        assert 40 in near
        assert near <= {40, -1}
    assert value(grid, *(middle + end * 1.2)) == -1


def test_a_scan_counts_once_per_cell_and_ends_outweigh_passes():
    once, often = OccupancyGrid(), OccupancyGrid()
    wall = np.stack((np.linspace(0.5, 3.0, 400), np.full(400, 0.21)), axis=-1)  # seen at a grazing angle
    often.add(ORIGIN, np.repeat(wall, 5, axis=0))
    once.add(ORIGIN, wall)
    assert np.array_equal(once.patch().cells, often.patch().cells)
    assert all(value(once, x, 0.21) == 70 for x in np.linspace(0.55, 2.95, 20))


def test_the_odds_are_limited_so_that_what_leaves_is_forgotten():
    grid = OccupancyGrid()
    for _ in range(200):
        grid.add(ORIGIN, np.array([[1.0, 0.0]]))
    assert value(grid, 1.0, 0.0) == 98
    for _ in range(12):
        grid.add(ORIGIN, np.array([[2.0, 0.0]]))
    assert value(grid, 1.0, 0.0) < 50


def test_it_grows_into_all_directions_and_keeps_what_it_knows():
    grid = OccupancyGrid()
    ends = [(1.0, 0.0), (-30.0, 2.0), (4.0, 25.0), (3.0, -41.0)]
    for end in ends:
        grid.add(ORIGIN, np.array([end]))
    assert [value(grid, *end) for end in ends] == [70] * 4


@pytest.mark.parametrize("code", [0, 6, 19])
def test_beams_without_a_range_say_nothing_to_the_map(code: int):
    """Neither what a covered window hides nor what is out of range is known."""
    ranges, codes = split_ranges(np.where(np.arange(683) < 341, code, 2000).astype(np.int32), 20)
    step = np.pi / 512
    scan = LaserScan(
        stamp=0, received=0, seq=0, frame="lidar", start_angle=-341 * step, end_angle=341 * step,
        time_increment=0.0, scan_time=0.1, range_min=0.02, range_max=4.1, ranges=ranges, codes=codes,
    )  # fmt: skip
    grid = OccupancyGrid()
    grid.add(ORIGIN, prepare_input(ScanInput.of(scan, (0.0, 0.0, 0.0)), 4.0).points)
    left, right = ([value(grid, x, side * 0.5) for x in np.linspace(0.3, 1.5, 9)] for side in (1, -1))
    assert set(left) == {40}
    assert set(right) == {-1}


def test_marks_may_wrap_round():
    grid = OccupancyGrid()
    grid._mark = np.iinfo(np.uint16).max - 1
    for _ in range(3):
        grid.add(ORIGIN, np.array([[1.0, 0.0]]))
    assert value(grid, 1.0, 0.0) == 93


def test_changes_are_the_tiles_that_differ():
    grid = OccupancyGrid()
    grid.add(ORIGIN, np.array([[1.0, 0.5]]))
    (tile,) = grid.changes()
    assert tile.cells.shape == (TILE, TILE)
    assert tile.origin == (0.0, 0.0)
    assert grid.changes() == []
    grid.add(ORIGIN, np.array([[-1.0, 0.5]]))
    assert [patch.origin for patch in grid.changes()] == [(-TILE * 0.05, 0.0), (0.0, 0.0)]


def test_tiles_put_together_are_the_grid():
    rng = np.random.default_rng(1)
    grid = OccupancyGrid(GridConfig(resolution=0.1))
    tiles = {}
    for _ in range(20):
        grid.add(rng.uniform(-5, 5, 2), rng.uniform(-12, 12, (30, 2)))
        tiles |= {patch.origin: patch.cells for patch in grid.changes()}
    whole = grid.patch()
    count = 0
    for (x, y), cells in tiles.items():
        for row, column in zip(*np.nonzero(cells != -1), strict=True):
            assert value(grid, x + (column + 0.5) * 0.1, y + (row + 0.5) * 0.1) == cells[row, column]
            count += 1
            if count > 3000:
                break
    assert sum((cells != -1).sum() for cells in tiles.values()) == (whole.cells != -1).sum()


def test_after_a_closure_the_map_is_drawn_anew_and_old_places_are_reported_unknown():
    builder = GridBuilder(GridConfig())
    scan = scan_of((1.0, 0.0), (1.0, 0.2))
    poses = np.array([(float(i), 0.0, 0.0) for i in range(5)])
    for i, pose in enumerate(poses):
        assert builder.add(scan, i + 1, pose, (0.0, 0.0, 0.0))
    builder.grid.changes()
    stamps = np.arange(1, 6)
    assert not builder.update_poses(stamps, poses + 0.001)
    moved = poses + np.array((0.0, 20.0, 0.0))
    assert builder.update_poses(stamps, moved)
    assert value(builder.grid, 5.0, 20.0) == 70
    assert value(builder.grid, 5.0, 0.0) == -1
    reported = {patch.origin: patch.cells for patch in builder.grid.changes()}
    assert (reported[(0.0, 0.0)] == -1).all()


def test_scans_join_by_way_turn_or_time():
    builder = GridBuilder(GridConfig(spacing=0.1, turn=0.1, pause=1.0))
    scan, level = scan_of((1.0, 0.0)), (0.0, 0.0, 0.0)
    assert builder.add(scan, 0, np.zeros(3), level)
    assert not builder.add(scan, 10**8, np.array((0.05, 0, 0)), level)
    assert builder.add(scan, 2 * 10**8, np.array((0.11, 0, 0)), level)
    assert builder.add(scan, 3 * 10**8, np.array((0.11, 0, 0.15)), level)
    assert builder.add(scan, 14 * 10**8, np.array((0.11, 0, 0.15)), level)


def test_two_lidars_in_one_place_are_both_drawn_and_thinned_alike():
    builder = GridBuilder(GridConfig(remembered=32))
    left, right, place = scan_of((0.0, 1.0)), scan_of((0.0, -1.0)), (0.0, 0.0, 0.0)
    for k in range(100):
        pose = np.array((0.2 * k, 0.0, 0.0))
        assert builder.add(left, 2 * k, pose, place)
        assert builder.add(right, 2 * k + 1, pose, place, lidar=1)
        assert not builder.add(right, 2 * k + 1, pose, place, lidar=1)
    builder.keep_marked(np.arange(200), np.ones(200, np.bool_))
    kept = [[k for k in range(100) if value(builder.grid, 0.2 * k, y) != -1] for y in (1.0, -1.0)]
    assert kept[0] == kept[1]
    assert 8 < len(kept[0]) <= 16


def test_memory_is_bounded():
    builder = GridBuilder(GridConfig(remembered=32))
    for i in range(500):
        builder.add(scan_of((1.0, 0.0)), i, np.array((0.2 * i, 0.0, 0.0)), (0.0, 0.0, 0.0))
    assert len(builder) <= 32
    assert value(builder.grid, 30.0, 0.0) != -1


def test_scans_are_remembered_as_they_came():
    rng = np.random.default_rng(1)
    scans = [rng.integers(-32000, 32000, (count, 2)).astype(np.int16) for count in rng.integers(1, 700, 900)]
    pages = PointPages()
    for scan in scans:
        pages.append(scan)
    assert len(pages) == len(scans)
    assert all(np.array_equal(pages[k], scan) for k, scan in enumerate(scans))


def test_what_is_forgotten_leaves_no_hole():
    rng = np.random.default_rng(2)
    pages, expected, most = PointPages(), [], 0
    for _ in range(12):
        for count in rng.integers(1, 5000, 120):
            scan = rng.integers(-32000, 32000, (count, 2)).astype(np.int16)
            pages.append(scan)
            expected.append(scan)
        kept = [k for k in range(len(expected)) if k % 2 == 0]
        pages.keep(kept)
        expected = [expected[k] for k in kept]
        assert all(np.array_equal(pages[k], scan) for k, scan in enumerate(expected))
        most = max(most, len(pages._pages))
    assert most * PAGE_POINTS < 1.3 * 240 * 5000 / 2 + 2 * PAGE_POINTS


def test_a_scan_may_be_larger_than_a_page():
    pages = PointPages()
    scans = [np.full((count, 2), k, np.int16) for k, count in enumerate((10, PAGE_POINTS + 5, 3, 2 * PAGE_POINTS, 7))]
    for scan in scans:
        pages.append(scan)
    pages.keep([1, 3, 4])
    assert [len(pages[k]) for k in range(3)] == [PAGE_POINTS + 5, 2 * PAGE_POINTS, 7]
    assert [int(pages[k][0, 0]) for k in range(3)] == [1, 3, 4]
    assert all((pages[k] == pages[k][0, 0]).all() for k in range(3))


def test_beams_that_met_nothing_free_what_they_passed_and_occupy_nothing():
    grid = OccupancyGrid()
    grid.add(ORIGIN, np.array([[0.0, 1.0]]), np.array([[2.0, 0.0]]))
    assert value(grid, 1.0, 0.0) == 40
    assert value(grid, 2.0, 0.0) == -1
    grid.add(ORIGIN, np.empty((0, 2)), np.array([[0.0, -1.0]]))
    assert value(grid, 0.0, -0.5) == 40


@pytest.mark.parametrize(("code", "seen"), [(0, 40), (2, 40), (6, -1), (19, -1)])
def test_only_a_code_that_says_so_is_a_beam_that_met_nothing(code: int, seen: int):
    ranges, codes = split_ranges(np.full(683, code, np.int32), 20)
    step = np.pi / 512
    scan = LaserScan(
        stamp=0, received=0, seq=0, frame="lidar", start_angle=-341 * step, end_angle=341 * step,
        time_increment=0.0, scan_time=0.1, range_min=0.02, range_max=4.1, ranges=ranges, codes=codes,
    )  # fmt: skip
    inputs = ScanInput.of(scan, (0.5, 0.0, 0.0))
    grid = OccupancyGrid()
    grid.add(np.array((0.5, 0.0)), np.empty((0, 2)), passed_ends(inputs, 3.0))
    assert value(grid, 3.2, 0.0) == seen
    assert value(grid, 3.6, 0.0) == -1
    assert not len(passed_ends(replace(inputs, slopes=(0.05, 0.0)), 3.0)), "a tilted beam passes over things"


def test_where_the_robot_stands_is_free_also_after_the_grid_is_drawn_again():
    builder = GridBuilder(GridConfig(), (0.4, 0.3))
    builder.add(scan_of((2.0, 0.0)), 10**9, np.zeros(3), (0.1, 0.0, 0.0))
    assert value(builder.grid, -0.15, 0.1) == 40
    assert value(builder.grid, -0.26, 0.0) == -1
    builder.update_poses(np.array([10**9]), np.array([[0.0, 1.0, 0.0]]))
    assert value(builder.grid, -0.15, 1.1) == 40
    assert value(builder.grid, -0.15, 0.1) == -1
    plain = GridBuilder(GridConfig())
    plain.add(scan_of((2.0, 0.0)), 10**9, np.zeros(3), (0.1, 0.0, 0.0))
    assert value(plain.grid, -0.15, 0.1) == -1
