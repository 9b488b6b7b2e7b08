"""Local planners by ``kind``; they deform a route and run in workers."""

from typing import TYPE_CHECKING, Annotated, Final, cast

from monstertruck_planners.local.config import LocalPlannerConfig
from monstertruck_runtime.plugins import Catalog, Plugin

if TYPE_CHECKING:
    from monstertruck_planners.local.api import LocalPlanner
    from monstertruck_planners.route.api import Vehicle

LOCAL_PLANNERS: Final = Catalog(
    "monstertruck.local_planners",
    Plugin(
        name="rsband",
        settings="monstertruck_planners.local.config:RsbandConfig",
        implementation="monstertruck_planners.local.rsband:RsbandPlanner",
        doc="Elastic band joined by Reeds-Shepp motions",
        extra="planning",
    ),
    Plugin(
        name="rsband-as-published",
        settings="monstertruck_planners.local.config:PublishedConfig",
        implementation="monstertruck_planners.local.published:PublishedPlanner",
        doc="rsband_local_planner as published, with its faults",
        extra="planning",
    ),
    Plugin(
        name="teb",
        settings="monstertruck_planners.local.config:TebConfig",
        implementation="monstertruck_planners.local.teb:TebPlanner",
        doc="Timed elastic band",
        extra="planning",
    ),
    base=LocalPlannerConfig,
)
"""Local planner kinds; each is built from the vehicle and its settings, and is a ``LocalPlanner``."""

AnyLocalPlanner = Annotated[LocalPlannerConfig, LOCAL_PLANNERS.section()]
"""Type of the section `planner.local_planner` of the configuration."""


def make_local_planner(vehicle: "Vehicle", config: LocalPlannerConfig) -> "LocalPlanner":
    """Build the local planner of a configuration.

    Raises:
        InputError: the kind is unknown, or a required package is not installed.
    """
    return cast("LocalPlanner", LOCAL_PLANNERS.build(config, vehicle, config))
