"""The kinds of route planners: which class makes routes for which settings. Light: classes are loaded on use."""

import importlib
from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from monstertruck_planners.route.config import GridAstarConfig, HybridConfig, LatticeConfig

if TYPE_CHECKING:
    from monstertruck_planners.route.api import RoutePlanner, Vehicle

RouteConfig = Annotated[HybridConfig | LatticeConfig | GridAstarConfig, Field(discriminator="kind")]
"""Settings of any route planner."""

CONFIGS = {"hybrid": HybridConfig, "lattice": LatticeConfig, "grid_astar": GridAstarConfig}

_CLASSES = {"hybrid": "HybridPlanner", "lattice": "LatticePlanner", "grid_astar": "GridAstarPlanner"}


def make_planner(vehicle: "Vehicle", config: HybridConfig | LatticeConfig | GridAstarConfig) -> "RoutePlanner":
    """Planner of the config's kind; loads numba."""
    module = importlib.import_module(f"monstertruck_planners.route.{config.kind}")
    planner: RoutePlanner = getattr(module, _CLASSES[config.kind])(vehicle, config)
    return planner
