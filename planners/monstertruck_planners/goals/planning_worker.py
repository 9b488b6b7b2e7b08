"""Worker that plans ways to goals: ``monstertruck_planners.goals.planning_worker:PlanningWorker``.

A step's inputs are a ``PlanTask``, its outputs a ``PlanAnswer``; the first one brings the configuration.
"""

from monstertruck_planners.goals.planning import PlanningStep
from monstertruck_planners.route.api import Vehicle, warm_up
from monstertruck_planners.route.catalog import make_planner
from monstertruck_planners.route.config import HybridConfig, LatticeConfig


class PlanningWorker(PlanningStep):
    """Keeps map, obstacles and route; compiled once it is built."""

    def __init__(self) -> None:
        super().__init__()
        for config in (HybridConfig(effort=200), LatticeConfig(effort=200)):
            warm_up(make_planner(Vehicle.truck(), config))
