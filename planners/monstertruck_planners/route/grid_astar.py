"""The author's first planner: the cheapest way over a grid with inflated obstacles, for a truck as a point. Compiled.

Costs as on the author's robot: neutral 50 for every cell, three times the costmap's value on top, nothing from 200 up;
the value falls with distance beyond the inscribed circle as exp(-10 d), to 0.3 m. Headings point along the way. The
result is not drivable as it is: turning radius and footprint are not looked at.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_planners.route import heuristic as togo
from monstertruck_planners.route.api import Budget, Clock, RouteMap, RouteResult, Vehicle, check_ends
from monstertruck_planners.route.config import GridAstarConfig
from monstertruck_schemas.reasons import Reason

INSCRIBED_COST = 252.0


class GridAstarPlanner:
    """Ways over the grid.

    Args:
        vehicle: its inscribed circle inflates the obstacles.
        config: costs.
    """

    def __init__(self, vehicle: Vehicle, config: GridAstarConfig | None = None) -> None:
        self.vehicle = vehicle
        self.config = config or GridAstarConfig()

    def plan(self, ground: RouteMap, start: ArrayLike, goal: ArrayLike, now: Clock | None = None) -> RouteResult:
        """Way between two poses; ``poses`` of the result, one for each cell."""
        config = self.config
        budget = Budget(config.budget, now, config.effort)
        ends = check_ends(
            ground, self.vehicle, start, goal, config.position_tolerance, config.yaw_tolerance, config.margin
        )
        if isinstance(ends, RouteResult):
            return ends
        field = ground.field.data()
        toll = self._tolls(field.distance)
        row, column = togo.cell_at(field, field.resolution, ends.start[0], ends.start[1])
        goal_row, goal_column = togo.cell_at(field, field.resolution, ends.goal[0], ends.goal[1])
        cost, step = togo.spread(
            toll, np.zeros((0, 0), np.bool_), goal_row, goal_column, row * toll.shape[1] + column, 1.0
        )
        if cost[row, column] >= togo.FAR:
            return RouteResult(Reason.GOAL_UNREACHABLE, text="no way over free cells")
        cells = togo.cells_on_way(step, row, column)
        across, along = (cells[:, 1] + 0.5) * field.resolution, (cells[:, 0] + 0.5) * field.resolution
        points = np.column_stack(
            (field.x + across * field.cos - along * field.sin, field.y + across * field.sin + along * field.cos)
        )
        poses = _headed(points, ends.start, ends.goal)
        metres = float(cost[row, column]) * field.resolution / config.neutral
        return RouteResult(
            Reason.OK, poses=poses, cost=metres, statistics={"first_s": budget.elapsed, "cells": float(len(cells))}
        )

    def _tolls(self, distance: NDArray[np.float32]) -> NDArray[np.int16]:
        config = self.config
        beyond = distance - np.float32(self.vehicle.footprint.inscribed_radius)
        value = np.where(beyond < config.inflation, INSCRIBED_COST * np.exp(-config.decay * np.maximum(beyond, 0)), 0.0)
        toll = np.minimum(config.neutral + config.cost_factor * value, config.lethal - 1)
        return np.where((value >= config.lethal - 1) | (beyond < 0), 0, toll).astype(np.int16)


def _headed(points: Array, start: Array, goal: Array) -> Array:
    """Poses along points, from the exact start to the exact goal."""
    points = np.vstack((start[:2], points[1:-1], goal[:2]))
    ahead = np.diff(points, axis=0)
    return np.column_stack((points, np.concatenate(([start[2]], np.arctan2(ahead[1:, 1], ahead[1:, 0]), [goal[2]]))))
