"""Frontiers of a map that grows: the same as those of the whole map, with a changed tile looked at alone."""

import numpy as np
import pytest

from monstertruck_planners.explore.frontier import FrontierMap
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.state import Grid


def grid_of(cells: np.ndarray, x: float = 0.0, y: float = 0.0, resolution: float = 0.05, yaw: float = 0.0) -> Grid:
    rows, columns = cells.shape
    return Grid(
        stamp=0, received=0, seq=0, frame="map", resolution=resolution, width=columns, height=rows,
        origin=Pose2D(x=x, y=y, yaw=yaw), cells=np.ascontiguousarray(cells, np.int8).reshape(-1),
    )  # fmt: skip


def plainly(cells: np.ndarray) -> np.ndarray:
    """Free cells with an unknown one beside, cell by cell."""
    result = np.zeros(cells.shape, bool)
    rows, columns = cells.shape
    for r in range(rows):
        for c in range(columns):
            if not 0 <= cells[r, c] < 50:
                continue
            for dr, dc in ((1, 0), (-1, 0), (0, 1), (0, -1)):
                inside = 0 <= r + dr < rows and 0 <= c + dc < columns
                result[r, c] |= not inside or cells[r + dr, c + dc] < 0
    return result


def test_a_free_cell_beside_an_unknown_one_is_a_frontier_and_the_maps_edge_counts_as_unknown():
    cells = np.array([[0, 0, 100, -1], [0, 40, 0, -1], [100, 100, 60, 49]])
    known = FrontierMap(grid_of(cells, 1.0, -0.5))
    column, row = (np.round(np.array((1.0, -0.5)) / 0.05).astype(int) - known.corner).tolist()
    assert np.array_equal(known.frontier[row : row + 3, column : column + 4], plainly(cells))
    assert known.frontier.sum() == plainly(cells).sum()
    assert known.free == 6
    assert known.origin[:2] == pytest.approx((known.corner * 0.05).tolist())


def test_tiles_one_after_the_other_give_what_the_whole_map_gives():
    rng = np.random.default_rng(3)
    whole = np.full((192, 256), -1, np.int8)
    known = FrontierMap(grid_of(whole[:64, :64]))
    for _ in range(60):
        row, column = int(rng.integers(3)) * 64, int(rng.integers(4)) * 64
        tile = rng.choice(np.array([-1, 0, 0, 0, 100], np.int8), (64, 64))
        if rng.random() < 0.3:
            tile[:] = -1
        whole[row : row + 64, column : column + 64] = tile
        known.put(grid_of(tile, column * 0.05, row * 0.05), whole=False)
    at = -known.corner
    there = np.s_[at[1] : at[1] + 192, at[0] : at[0] + 256]
    assert np.array_equal(known.cells[there], whole)
    assert np.array_equal(known.frontier[there], plainly(whole))
    assert known.free == int(((whole >= 0) & (whole < 50)).sum())


def test_a_whole_map_takes_the_place_of_all_before():
    known = FrontierMap(grid_of(np.zeros((70, 70))))
    known.put(grid_of(np.zeros((10, 10)), 5.0, 5.0), whole=True)
    assert known.free == 100
    assert known.frontier.sum() == 36


def test_only_the_surroundings_of_what_differs_are_looked_at_again():
    cells = np.zeros((640, 640), np.int8)
    known = FrontierMap(grid_of(cells))
    assert known.put(grid_of(cells), whole=True) == 0
    tile = np.zeros((64, 64), np.int8)
    tile[5, 5] = -1
    assert known.put(grid_of(tile, 64 * 0.05, 64 * 0.05), whole=False) == 66 * 66
    assert known.frontier[-known.corner[1] + 64 :, -known.corner[0] + 64 :][4:7, 4:7].sum() == 4


def test_a_place_has_changed_where_a_cell_became_known_or_occupied_nearby():
    cells = np.zeros((640, 640), np.int8)
    known = FrontierMap(grid_of(cells))
    before = known.changes
    tile = np.full((64, 64), 30, np.int8)  # as free as before
    known.put(grid_of(tile, 6.4, 6.4), whole=False)
    assert known.changed_within((8.0, 8.0), 1.0) == before
    tile[5, 5] = 100
    known.put(grid_of(tile, 6.4, 6.4), whole=False)
    assert known.changed_within((8.0, 8.0), 1.0) == known.changes
    assert known.changed_within((20.0, 8.0), 1.0) == before
    known.put(grid_of(np.zeros((8, 8)), -30.0, -30.0), whole=False)  # it grows
    assert known.changed_within((20.0, 8.0), 1.0) == before


@pytest.mark.parametrize(
    ("grid", "text"),
    [
        (grid_of(np.zeros((4, 4)), resolution=0.1), "cells of 0.05 m"),
        (grid_of(np.zeros((4, 4)), yaw=0.1), "without rotation"),
        (grid_of(np.zeros((4, 4)), x=0.02), "whole cells"),
    ],
)
def test_maps_that_do_not_fit_are_refused(grid: Grid, text: str):
    known = FrontierMap(grid_of(np.zeros((4, 4))))
    with pytest.raises(InputError, match=text):
        known.put(grid, whole=False)
