"""A truck that stands on ground the map does not know, or touches a wall of it by a cell."""

import numpy as np

from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.collision import Footprint
from monstertruck_planners.goals.config import PlannerConfig
from monstertruck_planners.goals.exchange import PlanTask, Setup
from monstertruck_planners.goals.plan_step import PlanningStep, standing_free
from monstertruck_planners.route.config import HybridConfig
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.state import Grid

NONE = np.empty((0, 2))


def planned(cells: np.ndarray, pose, goal):
    grid = Grid(
        stamp=0, received=0, seq=0, frame="map", resolution=0.05, width=cells.shape[1], height=cells.shape[0],
        origin=Pose2D(x=0.0, y=0.0, yaw=0.0), cells=cells.reshape(-1),
    )  # fmt: skip
    config = PlannerConfig(route=HybridConfig(margin=0.04, unknown="blocked", effort=3000))
    return PlanningStep().step(
        PlanTask("route", pose, goal, NONE, Setup(config, FourWheelSteering(), Footprint()), grid)
    )


def test_it_leaves_a_wall_that_its_rim_overlaps_but_not_one_it_stands_in():
    cells = np.zeros((60, 100), np.int8)
    cells[:10] = 100  # up to y = 0.5
    goal = (4.0, 1.5, 0.0)
    assert planned(cells, (1.0, 0.65, 0.0), goal).reason is Reason.OK
    assert planned(cells, (1.0, 0.45, 0.0), goal).reason is Reason.START_BLOCKED


def test_it_leaves_a_wall_that_is_as_near_as_the_narrowest_margin():
    """Its place is free at that margin, and every motion from there is a hair too near."""
    cells = np.zeros((60, 100), np.int8)
    cells[:10] = 100
    side = 0.5 + Footprint().width / 2 + Footprint().padding + 0.0305
    assert planned(cells, (1.0, side, 0.0), (4.0, 1.5, 0.0)).reason is Reason.OK


def test_unknown_ground_under_it_and_the_edge_of_the_map_do_not_hold_it():
    cells = np.zeros((60, 100), np.int8)
    cells[20:40, :17] = -1
    answer = planned(cells, (0.6, 1.5, 0.0), (3.0, 1.5, 0.0))
    assert answer.reason is Reason.OK
    edge = planned(np.zeros((60, 100), np.int8), (0.2, 1.5, 0.0), (3.0, 1.5, 0.0))
    assert edge.reason is Reason.OK
    assert planned(np.zeros((60, 100), np.int8), (0.2, 1.5, 0.0), (0.0, 1.5, 0.0)).reason is Reason.GOAL_BLOCKED


def test_only_what_the_footprint_covers_is_freed():
    cells = np.full((40, 40), -1, np.int8)
    freed = standing_free(cells, 0.05, (0.0, 0.0, 0.0), Footprint(), (1.0, 1.0, 0.0))
    rows, columns = np.nonzero(freed == 0)
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (16, 23, 14, 25)
    assert (cells == -1).all()
