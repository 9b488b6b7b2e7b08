"""What is computed of a map is kept: distances, costs of cells, ways to the goal."""

import numpy as np
import pytest

from monstertruck_planners.collision import DistanceField, boxes_of
from monstertruck_planners.route import heuristic
from monstertruck_planners.route.api import RouteCosts, RouteMap
from monstertruck_planners.route.config import HybridConfig
from monstertruck_planners.route.hybrid import HybridPlanner
from tests.unit.planners.route.route_kit import CAR, RESOLUTION, TRUCK, assert_drivable, ground, room


def boxes_of_obstacles(rng, cells, count, value=100):
    for _ in range(count):
        row, column = rng.integers(1, np.array(cells.shape) - 10)
        height, width = rng.integers(1, 9, 2)
        cells[row : row + height, column : column + width] = value


@pytest.mark.parametrize("seed", range(8))
def test_distances_follow_changes(seed):
    rng = np.random.default_rng(seed)
    cells = np.zeros((rng.integers(80, 260), rng.integers(80, 260)), np.int8)
    boxes_of_obstacles(rng, cells, rng.integers(0, 30))
    field = DistanceField(cells > 0, 0.05)
    for _ in range(4):
        boxes_of_obstacles(rng, cells, 2)
        boxes_of_obstacles(rng, cells, 2, value=0)
        before = field.data().distance.copy()
        newer, afresh = DistanceField(cells > 0, 0.05, previous=field), DistanceField(cells > 0, 0.05)
        assert np.array_equal(newer.data().distance, afresh.data().distance)
        assert np.array_equal(field.data().distance, before)
        if newer.changes is not None:
            outside = np.ones(before.shape, bool)
            for top, left, bottom, right in newer.changes:
                outside[top:bottom, left:right] = False
            assert np.array_equal(newer.data().distance[outside], before[outside])
        field = newer


def test_distances_are_those_between_cells():
    from scipy.ndimage import distance_transform_edt

    rng = np.random.default_rng(0)
    occupied = rng.random((70, 90)) < 0.02
    expected = distance_transform_edt(~np.pad(occupied, 1, constant_values=True), sampling=0.05)
    assert DistanceField(occupied, 0.05).data().distance == pytest.approx(expected, abs=1e-6)


def test_a_field_of_another_place_is_computed_anew():
    field = DistanceField(room() > 0, RESOLUTION)
    moved = DistanceField(room() > 0, RESOLUTION, (1.0, 0.0, 0.0), previous=field)
    assert moved.changes is None
    same = DistanceField(room() > 0, RESOLUTION, previous=field)
    assert same.changes == []
    assert same.data().distance is field.data().distance


def test_boxes_hold_all_changes():
    mask = np.zeros((200, 150), bool)
    assert boxes_of(mask) == []
    mask[3, 5] = mask[10, 60] = mask[190, 149] = True
    assert boxes_of(mask) == [(3, 5, 11, 61), (190, 149, 191, 150)]


@pytest.mark.parametrize("unknown", ["blocked", "dear"])
def test_costs_of_cells_follow_changes(unknown):
    rng = np.random.default_rng(1)
    costs = RouteCosts.of(TRUCK, HybridConfig(unknown=unknown))
    cells = room((2.0, 1.0, 2.5, 2.0))
    boxes_of_obstacles(rng, cells, 6, value=-1)
    tilt = np.zeros(cells.shape)
    where = RouteMap.from_cells(cells, RESOLUTION, unknown=unknown, tilt=tilt)
    where.cell_costs(costs)
    for _ in range(5):
        cells = cells.copy()
        boxes_of_obstacles(rng, cells, 2)
        boxes_of_obstacles(rng, cells, 2, value=-1)
        boxes_of_obstacles(rng, cells, 2, value=0)
        tilt = tilt + np.pad(np.full((4, 4), 0.3), ((20, cells.shape[0] - 24), (30, cells.shape[1] - 34)))
        where = RouteMap.from_cells(cells, RESOLUTION, unknown=unknown, tilt=tilt, previous=where)
        afresh = RouteMap.from_cells(cells, RESOLUTION, unknown=unknown, tilt=tilt)
        assert costs in where.coarse  # taken over, not computed when asked for
        assert np.array_equal(where.cell_costs(costs), afresh.cell_costs(costs))
        assert np.array_equal(where.cost_layer(costs).terrain, afresh.cost_layer(costs).terrain)


def test_costs_of_a_map_are_computed_once():
    where, costs = ground(), RouteCosts.of(CAR, HybridConfig())
    assert where.cell_costs(costs) is where.cell_costs(costs)
    planner = HybridPlanner(CAR, HybridConfig(effort=500))
    before = where.cell_costs(planner.costs).copy()
    planner.plan(where, (1.0, 1.0, 0.0), (5.0, 3.0, 0.0))
    assert np.array_equal(where.cell_costs(planner.costs), before)


def plain_dijkstra(cell_cost, goal):
    """Cost from every cell to the goal, slowly."""
    cost = np.full(cell_cost.shape, heuristic.UNREACHED)
    cost[goal] = 0
    open_cells = {goal}
    while open_cells:
        row, column = min(open_cells, key=lambda cell: cost[cell])
        open_cells.discard((row, column))
        for k, (across, along) in enumerate(heuristic.NEIGHBOURS.tolist()):
            r, c = row + along, column + across
            if not (0 <= r < cost.shape[0] and 0 <= c < cost.shape[1]) or cell_cost[r, c] == 0:
                continue
            both = int(cell_cost[r, c]) + int(cell_cost[row, column])
            if k & 1 and (cell_cost[row, c] == 0 or cell_cost[r, column] == 0):
                continue
            step = both * 141 // 200 if k & 1 else both // 2
            if cost[row, column] + step < cost[r, c]:
                cost[r, c] = cost[row, column] + step
                open_cells.add((r, c))
    return cost


def test_the_cost_to_go_is_exact_wherever_it_is_asked_for():
    rng = np.random.default_rng(2)
    for _ in range(5):
        cell_cost = np.where(rng.random((30, 40)) < 0.25, 0, rng.choice([100, 150, 400], (30, 40))).astype(np.int16)
        goal, start = (3, 4), (25, 33)
        cell_cost[goal] = cell_cost[start] = 100
        expected = plain_dijkstra(cell_cost, goal)
        to_go = heuristic.cost_to_go(cell_cost, 0.1, goal, start, overrun=np.inf)
        for cell in [start, *zip(rng.integers(0, 30, 80).tolist(), rng.integers(0, 40, 80).tolist(), strict=True)]:
            assert heuristic.cost_at(to_go, *cell) == expected[cell]


def test_the_cost_to_go_visits_what_is_asked_for():
    cell_cost = np.full((400, 400), 100, np.int16)
    to_go = heuristic.cost_to_go(cell_cost, 0.1, (200, 50), (200, 350))
    assert heuristic.cost_at(to_go, 200, 350) == 300 * heuristic.UNIT
    assert np.count_nonzero(to_go.cost < heuristic.UNREACHED) < 0.02 * cell_cost.size
    assert heuristic.cost_at(to_go, 210, 200) == 140 * 100 + 10 * 141
    assert heuristic.cost_at(to_go, 399, 0) == heuristic.UNREACHED  # too far round
    heuristic.complete(to_go)
    assert np.count_nonzero(to_go.cost < heuristic.UNREACHED) > 0.2 * cell_cost.size


def test_a_direct_motion_that_costs_nothing_extra_is_the_route():
    where = ground()
    start, goal = np.array([1.5, 2.0, 0.0]), np.array([4.5, 2.0, 0.0])
    result = HybridPlanner(TRUCK, HybridConfig()).plan(where, start, goal)
    assert_drivable(result.path, where, TRUCK, start, goal)
    assert result.statistics["trials"] == result.statistics["expanded"] == 0
    assert not where.coarse  # nothing is computed of the map
