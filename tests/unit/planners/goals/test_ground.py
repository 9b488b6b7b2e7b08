"""Routes and the ground: layers of the map's cells, and the way round a rough patch."""

import math

import numpy as np
import pytest

from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.collision import Footprint
from monstertruck_planners.goals.config import PlannerConfig
from monstertruck_planners.goals.exchange import PlanTask, Setup
from monstertruck_planners.goals.plan_step import PlanningStep, StaticMap, ground_layers
from monstertruck_planners.route.config import HybridConfig
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.state import GROUND_UNKNOWN, Grid, Ground

HEADER = {"stamp": 1, "received": 1, "seq": 0, "frame": "map"}


def ground(tilt: np.ndarray, roughness: np.ndarray, origin=(0.0, 0.0, 0.0), resolution=0.1) -> Ground:
    height, width = tilt.shape
    x, y, yaw = origin
    return Ground(
        **HEADER, resolution=resolution, width=width, height=height, origin=Pose2D(x=x, y=y, yaw=yaw),
        tilt=tilt.astype(np.uint8).ravel(), roughness=roughness.astype(np.uint8).ravel(),
    )  # fmt: skip


def empty_map(metres: float, origin=(0.0, 0.0, 0.0)) -> StaticMap:
    cells = round(metres / 0.05)
    return StaticMap(np.zeros((cells, cells), np.int8), 0.05, origin)


@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (-1.0, -2.0, 0.0), (0.5, -1.0, 0.6)])
@pytest.mark.parametrize("turned", [(1.0, 1.0, 0.0), (1.5, 0.7, -0.4)])
def test_layers_lie_where_the_ground_does(origin, turned):
    tilt = np.full((3, 4), GROUND_UNKNOWN)
    tilt[1, 2] = 40
    grid = empty_map(6.0, origin)
    layer, roughness = ground_layers(ground(tilt, tilt, turned), grid, 0.0)
    assert layer.max() == pytest.approx(0.2)
    assert roughness.max() == pytest.approx(0.04)
    rows, columns = np.nonzero(layer)
    assert len(rows) == pytest.approx(4, abs=3)

    def out(x, y, pose):
        c, s = math.cos(pose[2]), math.sin(pose[2])
        return pose[0] + c * x - s * y, pose[1] + s * x + c * y

    seen = out((columns.mean() + 0.5) * 0.05, (rows.mean() + 0.5) * 0.05, origin)
    assert seen == pytest.approx(out(0.25, 0.15, turned), abs=0.04)


def test_the_worst_within_reach_counts_beyond_the_known_cells():
    tilt = np.zeros((1, 1)) + 40
    layer, _ = ground_layers(ground(tilt, tilt, (3.0, 3.0, 0.0)), empty_map(6.0), 0.17)
    rows, columns = np.nonzero(layer)
    assert (rows.min(), rows.max()) == (columns.min(), columns.max()) == (56, 65)  # 2.8 m ... 3.3 m


def test_ground_outside_the_map_is_none_of_its_cells():
    tilt = np.zeros((2, 2)) + 40
    layer, _ = ground_layers(ground(tilt, tilt, (30.0, 3.0, 0.0)), empty_map(6.0), 0.17)
    assert layer.shape == (120, 120)
    assert not layer.any()


@pytest.mark.parametrize(("half", "round_it"), [(0.5, True), (2.6, False)])
def test_a_route_goes_round_a_rough_patch_if_that_is_not_much_longer(half, round_it):
    """A detour of half the way is too long."""
    cells = np.full((140, 120), 0, np.int8)
    grid = Grid(
        **HEADER, resolution=0.05, width=120, height=140, origin=Pose2D(x=0, y=-3.5, yaw=0), cells=cells.ravel()
    )
    size = round(2 * half / 0.1)
    rough = np.zeros((size, 10)) + 20
    patch = ground(np.zeros_like(rough), rough, (2.5, -half, 0.0))
    setup = Setup(PlannerConfig(route=HybridConfig(effort=20000)), FourWheelSteering(), Footprint())
    step, none = PlanningStep(), np.empty((0, 2))
    task = PlanTask("route", (1.0, 0.0, 0.0), (5.0, 0.0, 0.0), none, setup, grid)
    straight = step.step(task)
    assert straight.length == pytest.approx(4.0, abs=0.01)
    answer = step.step(PlanTask("route", (1.0, 0.0, 0.0), (5.0, 0.0, 0.0), none, ground=patch, afresh=True))
    over = (abs(answer.path.poses[:, 0] - 3.0) < 0.5) & (abs(answer.path.poses[:, 1]) < half)
    assert over.any() != round_it
    assert answer.length < 1.5 * straight.length
