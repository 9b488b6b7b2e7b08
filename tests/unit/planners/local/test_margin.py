"""A truck that came nearer to something than the margin: away from it first, then on."""

import numpy as np
import pytest

from monstertruck_planners.local import elastic_band
from monstertruck_planners.local.api import LocalPlannerState
from monstertruck_planners.local.catalog import make_local_planner
from monstertruck_planners.local.config import RsbandConfig, TebConfig
from monstertruck_planners.local.core import LocalPlannerCore
from monstertruck_planners.route.api import Vehicle
from monstertruck_schemas.reasons import Reason
from tests.unit.planners.local.local_kit import drivable, line, window

CARS = {kind: Vehicle.truck(kind) for kind in ("2ws", "counter", "4ws")}
BESIDE = (1.0, 1.72, 1.4, 1.84)
"""A box at the right side of the truck's front: half of the margin of 0.02 m is left at y = 2.03."""
AHEAD = (2.2, 1.9, 2.4, 2.2)


def here(vehicle, y, yaw=0.0):
    return vehicle.reference_pose(np.array([0.9, y, yaw]))


@pytest.mark.parametrize("car", CARS)
@pytest.mark.parametrize("config", [RsbandConfig(), TebConfig()], ids=lambda config: config.kind)
def test_only_the_way_out_is_without_the_margin(car, config):
    vehicle, field = CARS[car], window(BESIDE, AHEAD)
    pose = here(vehicle, 2.03, 0.02)
    assert not field.free(vehicle.footprint, pose[None], 0.02)[0]
    result = make_local_planner(vehicle, config).plan(line(y=2.1), field, pose, LocalPlannerState())
    assert result.reason is Reason.OK
    assert drivable(vehicle, result.path)
    samples = result.path.sample(0.01)
    free = field.free(vehicle.footprint, samples.poses, 0.02)
    assert free[samples.travelled > 0.3 + 1e-6].all()
    assert not free[0]


@pytest.mark.parametrize("car", CARS)
@pytest.mark.parametrize("y", [2.03, 2.01])
def test_nothing_comes_nearer_on_the_way_out(car, y):
    vehicle, field = CARS[car], window(BESIDE)
    surveyor, pose = LocalPlannerCore(vehicle, RsbandConfig()), here(vehicle, y)
    out = surveyor.leave_margin(field, pose)
    assert drivable(vehicle, out)
    assert field.free(vehicle.footprint, out.end[None], 0.02)[0]
    clearances = [elastic_band.clearance(field.data(), surveyor.cover, *p) for p in out.sample(0.01).poses]
    assert min(np.diff(clearances)) > -0.003


def test_no_way_out_where_nothing_is_near_or_all_sides_are():
    vehicle = CARS["4ws"]
    surveyor = LocalPlannerCore(vehicle, RsbandConfig())
    assert surveyor.leave_margin(window(BESIDE), here(vehicle, 2.2)) is None
    tube = window((0.2, 1.7, 3.6, 1.84), (0.2, 2.21, 3.6, 2.36), (0.2, 1.8, 0.6, 2.3), (1.2, 1.8, 3.6, 2.3))
    assert surveyor.leave_margin(tube, here(vehicle, 2.03)) is None


def test_a_truck_in_an_obstacle_has_none():
    vehicle = CARS["4ws"]
    assert (
        LocalPlannerCore(vehicle, RsbandConfig()).leave_margin(window((0.7, 1.9, 0.9, 2.1)), here(vehicle, 2.0)) is None
    )
