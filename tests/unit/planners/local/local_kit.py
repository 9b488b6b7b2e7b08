"""Windows, routes and checks for the tests of local planners."""

import numpy as np

from monstertruck_planners.collision import DistanceField
from monstertruck_planners.local.api import LocalPlannerState
from monstertruck_planners.pose_path import PosePath

RES = 0.04


def window(*boxes, size=4.0):
    """Free window with boxes (x0, y0, x1, y1), m."""
    count = round(size / RES)
    occupied = np.zeros((count, count), bool)
    for x0, y0, x1, y1 in boxes:
        occupied[round(y0 / RES) : round(y1 / RES), round(x0 / RES) : round(x1 / RES)] = True
    return DistanceField(occupied, RES)


def line(begin=0.8, end=6.0, y=2.0, step=0.08):
    """Straight route along x."""
    x = np.arange(begin, end, step)
    return PosePath(np.column_stack((x, np.full(len(x), y), np.zeros(len(x)))), np.ones(len(x)))


def drivable(vehicle, path, angle=0.4):
    """Whether every piece stays within the vehicle's steering."""
    turn, slip = path.segments[:, 1], path.segments[:, 2]
    if not vehicle.crab_angle:
        return bool((np.abs(turn) <= 1 / vehicle.radius + 1e-9).all() and (slip == 0.0).all())
    half = 0.16 * turn / np.cos(slip)
    return bool((np.abs(np.arctan(np.tan(slip) + half)) <= angle + 1e-9).all()) and bool(
        (np.abs(np.arctan(np.tan(slip) - half)) <= angle + 1e-9).all()
    )


class Cycles:
    """A local planner with its state: one call for every scan."""

    def __init__(self, planner):
        self.planner, self.state = planner, LocalPlannerState()

    def step(self, route, obstacles, pose):
        result = self.planner.plan(route, obstacles, pose, self.state)
        self.state = result.state
        return result
