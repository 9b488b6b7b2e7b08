"""The author's first planner: the cheapest path of a point over a grid with inflated obstacles. Loads numba.

Costs as on the author's robot: 50 per cell, plus three times the costmap's value; cells from 200 up are closed; beyond
the inscribed circle the value falls with the distance d as exp(-10 d), up to 0.3 m. Headings point along the path. The
result is not a drivable motion: turning radius and footprint are ignored. The start therefore only has to be free; the
tracker must leave obstacles that are too near.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_planners.route import heuristic
from monstertruck_planners.route.api import Budget, Clock, RouteMap, RouteResult, Vehicle, check_endpoints
from monstertruck_planners.route.config import GridAstarConfig
from monstertruck_schemas.reasons import Reason


class GridAstarPlanner:
    """Grid paths for one vehicle.

    Args:
        vehicle: vehicle whose inscribed circle inflates the obstacles.
        config: costs.
    """

    def __init__(self, vehicle: Vehicle, config: GridAstarConfig | None = None) -> None:
        self.vehicle = vehicle
        self.config = config or GridAstarConfig()

    def plan(self, route_map: RouteMap, start: ArrayLike, goal: ArrayLike, now: Clock | None = None) -> RouteResult:
        """Return the shortest path between two poses, one of the ``poses`` per cell."""
        config = self.config
        budget = Budget(config.budget, now, config.effort)
        ends = check_endpoints(
            route_map, self.vehicle, start, goal, config.position_tolerance, config.yaw_tolerance, config.margin,
            start_margin=0.0,
        )  # fmt: skip
        if isinstance(ends, RouteResult):
            return ends
        field = route_map.field.data()
        cell_cost = self._cell_costs(field.distance)
        start, goal = (heuristic.cell_at(field, field.resolution, *pose[:2]) for pose in (ends.start, ends.goal))
        if not cell_cost[start]:
            cell_cost[start] = int(config.lethal) - 1
        to_go = heuristic.cost_to_go(cell_cost, field.resolution, goal, start, least=int(config.neutral))
        cost = heuristic.cost_at(to_go, *start)
        if cost >= heuristic.UNREACHED:
            return RouteResult(Reason.GOAL_UNREACHABLE, text="no path over free cells")
        cells = heuristic.cells_to_goal(to_go.step, *start)
        across, along = (cells[:, 1] + 0.5) * field.resolution, (cells[:, 0] + 0.5) * field.resolution
        points = np.column_stack(
            (field.x + across * field.cos - along * field.sin, field.y + across * field.sin + along * field.cos)
        )
        poses = _headed(points, ends.start, ends.goal)
        metres = float(cost) * field.resolution / config.neutral
        return RouteResult(
            Reason.OK, poses=poses, cost=metres, statistics={"first_s": budget.elapsed, "cells": float(len(cells))}
        )

    def _cell_costs(self, distance: NDArray[np.float32]) -> NDArray[np.int16]:
        config = self.config
        beyond = distance - np.float32(self.vehicle.footprint.inscribed_radius)
        value = np.where(beyond < config.inflation, 252.0 * np.exp(-config.decay * np.maximum(beyond, 0)), 0.0)
        cell_cost = np.minimum(config.neutral + config.cost_factor * value, config.lethal - 1)
        return np.where((value >= config.lethal - 1) | (beyond < 0), 0, cell_cost).astype(np.int16)


def _headed(points: Array, start: Array, goal: Array) -> Array:
    """Return poses along points, from the exact start to the exact goal."""
    points = np.vstack((start[:2], points[1:-1], goal[:2]))
    ahead = np.diff(points, axis=0)
    return np.column_stack((points, np.concatenate(([start[2]], np.arctan2(ahead[1:, 1], ahead[1:, 0]), [goal[2]]))))
