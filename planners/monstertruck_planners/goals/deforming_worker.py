"""Worker that deforms routes: ``monstertruck_planners.goals.deforming_worker:DeformingWorker``.

A step's inputs are a ``DeformTask``, its outputs a ``DeformAnswer``; the first one brings the configuration.
"""

import numpy as np

from monstertruck_planners.collision import DistanceField
from monstertruck_planners.goals.deforming import DeformStep
from monstertruck_planners.local.api import LocalPlannerState, PosePath
from monstertruck_planners.local.catalog import make_local_planner
from monstertruck_planners.local.config import RsbandConfig, TebConfig
from monstertruck_planners.route.api import Vehicle


class DeformingWorker(DeformStep):
    """Keeps window, route and deformation; compiled once it is built."""

    def __init__(self) -> None:
        super().__init__()
        cells = np.zeros((100, 100), np.bool_)
        cells[45:55, 45:55] = True
        poses = np.column_stack((np.linspace(0.5, 3.5, 31), np.full(31, 2.0), np.zeros(31)))
        guide, surroundings = PosePath(poses, np.ones(31)), DistanceField(cells, 0.04)
        for config in (RsbandConfig(effort=200), TebConfig(effort=200)):
            make_local_planner(Vehicle.truck(), config).plan(guide, surroundings, poses[0], LocalPlannerState())
