"""Small maps and a slow look at routes."""

import math

import numpy as np

from monstertruck_planners.route.api import RouteMap, Vehicle

RESOLUTION = 0.05
CAR = Vehicle.truck("2ws")
TRUCK = Vehicle.truck("4ws")


def room(*blocks, size=(6.0, 4.0)):
    """Walled cells with occupied boxes (x0, y0, x1, y1), m."""
    cells = np.zeros((round(size[1] / RESOLUTION), round(size[0] / RESOLUTION)), dtype=np.int8)
    cells[[0, -1]] = 100
    cells[:, [0, -1]] = 100
    for box in blocks:
        x0, y0, x1, y1 = (round(v / RESOLUTION) for v in box)
        cells[y0:y1, x0:x1] = 100
    return cells


def ground(*blocks, **options):
    return RouteMap.from_cells(room(*blocks), RESOLUTION, **options)


def assert_drivable(path, where, vehicle, start, goal, off=1e-6):
    poses = path.sample(0.01).poses
    assert where.field.free(vehicle.footprint, poses).all()
    assert path.greatest_curvature <= 1 / vehicle.radius + 1e-9
    assert np.abs(path.segments[:, 2]).max(initial=0.0) <= vehicle.crab_angle + 1e-9
    assert np.abs(poses[0] - start).max() < 1e-12
    error = path.end - goal
    assert math.hypot(error[0], error[1]) <= off
    assert abs(math.remainder(error[2], math.tau)) <= off
