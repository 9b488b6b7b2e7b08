"""Evidence of a saved grid: what a scan sees agrees with the map, contradicts it, or is unknown to it."""

import numpy as np

from monstertruck_estimation.slam.map_evidence import Evidence, EvidenceGrid
from monstertruck_runtime.map_files import FREE, OCCUPIED, UNKNOWN, WorldMap
from tests.unit.estimation.slam.kit import ROOM, scan

STEP, ORIGIN = 0.05, (-4.0, -4.0)
MOUNT = np.zeros(2)
POSE = np.array((-2.0, 0.0, 0.3))


def drawn(walls=ROOM, half_width=3.0) -> WorldMap:
    """The room as a grid of 8 x 8 m: its walls are drawn, all else within ``half_width`` of the middle is free."""
    cells = np.full((160, 160), UNKNOWN, np.int8)
    near = np.abs(np.arange(160) * STEP + ORIGIN[0]) < half_width
    cells[np.ix_(near, near)] = FREE
    for (x0, y0), (x1, y1) in walls:
        share = np.linspace(0, 1, 400)
        column = ((x0 + share * (x1 - x0) - ORIGIN[0]) / STEP).astype(int)
        row = ((y0 + share * (y1 - y0) - ORIGIN[1]) / STEP).astype(int)
        cells[row, column] = OCCUPIED
    return WorldMap(cells, STEP, ORIGIN)


def test_a_scan_at_its_true_pose_agrees():
    evidence = EvidenceGrid(drawn()).judge(POSE, scan(ROOM, POSE).points, MOUNT)
    assert evidence.agreeing > 150
    assert evidence.contradiction < 0.02


def test_beams_through_walls_and_ends_in_free_space_contradict():
    grid = EvidenceGrid(drawn())
    points = scan(ROOM, POSE).points
    assert grid.judge(POSE + np.array((0.0, 0.0, 0.8)), points, MOUNT).contradiction > 0.4
    assert grid.judge(POSE + np.array((0.6, 0.0, 0.0)), points, MOUNT).contradiction > 0.4
    # A room without the box in its middle: all that is seen fits walls of the map, but beams pass where the box is.
    empty = [*ROOM[:4], *ROOM[8:]]
    assert grid.judge(POSE, scan(empty, POSE).points, MOUNT).contradiction > 0.2
    # A map without the box: the beams end in its free space.
    assert EvidenceGrid(drawn(empty)).judge(POSE, scan(ROOM, POSE).points, MOUNT).contradiction > 0.2


def test_what_the_map_does_not_know_counts_neither_way():
    evidence = EvidenceGrid(drawn(walls=[], half_width=0.5)).judge(POSE, scan(ROOM, POSE).points, MOUNT)
    assert evidence.agreeing == 0
    assert evidence.unknown > 0.8 * (evidence.unknown + evidence.against)
    assert Evidence().contradiction == 0.0


def test_a_map_without_walls_and_points_beyond_it_are_no_error():
    grid = EvidenceGrid(WorldMap(np.zeros((4, 4), np.int8), STEP, (0.0, 0.0)))
    evidence = grid.judge(np.zeros(3), np.array(((50.0, 50.0), (0.1, 0.1), (0.0, 0.0))), MOUNT)
    assert (evidence.agreeing, evidence.unknown) == (0, 1)


def test_the_beams_begin_at_the_sensor():
    grid = EvidenceGrid(drawn([((0.0, -1.0), (0.0, 1.0)), ((1.0, -1.0), (1.0, 1.0))]))
    ahead = np.array(((1.5, 0.0),))
    base = np.array((-0.5, 0.0, 0.0))
    assert grid.judge(base, ahead, np.array((0.2, 0.0))).against == 1
    assert grid.judge(base, ahead, np.array((0.7, 0.0))).agreeing == 1


def test_beams_that_end_where_the_map_knows_nothing_are_not_judged():
    grid = EvidenceGrid(drawn())
    points = np.array(((4.9, 0.0), (6.9, 0.0), (9.0, 0.0), (0.6, 0.0)))
    # A wall, beyond it, off the grid in the direction of a wall, and free space.
    assert grid.judged(np.array((-2.0, -1.3, 0.0)), points, MOUNT).tolist() == [True, True, True, True]
    # Without walls the same ends are unknown, but for the last one.
    bare = EvidenceGrid(drawn(walls=[], half_width=2.5))
    assert bare.judged(np.array((-2.0, -1.3, 0.0)), points, MOUNT).tolist() == [False, False, False, True]
