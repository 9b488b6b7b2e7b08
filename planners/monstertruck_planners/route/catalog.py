"""Route planners by ``kind``."""

from typing import Annotated, Final

from monstertruck_planners.route.config import GoalConfig
from monstertruck_runtime.plugins import Catalog, Plugin

ROUTE_PLANNERS: Final = Catalog(
    "monstertruck.route_planners",
    Plugin(
        name="hybrid",
        settings="monstertruck_planners.route.config:HybridConfig",
        implementation="monstertruck_planners.route.hybrid:HybridPlanner",
        doc="Hybrid-A* with improvement until the time budget is used up",
        extra="planning",
    ),
    Plugin(
        name="lattice",
        settings="monstertruck_planners.route.config:LatticeConfig",
        implementation="monstertruck_planners.route.lattice:LatticePlanner",
        doc="State lattice with moves of exact radius",
        extra="planning",
    ),
    Plugin(
        name="grid_astar",
        settings="monstertruck_planners.route.config:GridAstarConfig",
        implementation="monstertruck_planners.route.grid_astar:GridAstarPlanner",
        doc="The author's first planner: A* over a grid with inflated obstacles",
        extra="planning",
    ),
    base=GoalConfig,
)
"""A route planner kind is built from the vehicle and its settings, and is a ``RoutePlanner``."""

AnyRoutePlanner = Annotated[GoalConfig, ROUTE_PLANNERS.section()]
"""Section `planner.route` of the configuration."""
