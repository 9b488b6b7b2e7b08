"""The local planners, which deform a route, by ``kind``; they run in workers."""

from typing import TYPE_CHECKING, Annotated, Final, cast

from monstertruck_planners.local.config import DeformConfig
from monstertruck_runtime.plugins import Catalog, Plugin

if TYPE_CHECKING:
    from monstertruck_planners.local.api import Deformer
    from monstertruck_planners.route.api import Vehicle

LOCAL_PLANNERS: Final = Catalog(
    "monstertruck.local_planners",
    Plugin(
        name="rsband",
        settings="monstertruck_planners.local.config:RsbandConfig",
        implementation="monstertruck_planners.local.rsband:Rsband",
        doc="Elastic band joined by Reeds-Shepp motions",
        extra="planning",
    ),
    Plugin(
        name="rsband-as-published",
        settings="monstertruck_planners.local.config:PublishedConfig",
        implementation="monstertruck_planners.local.published:Published",
        doc="rsband_local_planner as published, with its faults",
        extra="planning",
    ),
    Plugin(
        name="teb",
        settings="monstertruck_planners.local.config:TebConfig",
        implementation="monstertruck_planners.local.teb:Teb",
        doc="Timed elastic band",
        extra="planning",
    ),
    base=DeformConfig,
)
"""A local planner is made from the vehicle and its settings; it is a ``Deformer``."""

AnyDeformer = Annotated[DeformConfig, LOCAL_PLANNERS.section()]
"""The configuration's section `planner.deform`."""


def make_deformer(vehicle: "Vehicle", config: DeformConfig) -> "Deformer":
    """Local planner of a configuration.

    Raises:
        InputError: settings without a kind of local planner, or what it needs is not installed.
    """
    return cast("Deformer", LOCAL_PLANNERS.implementation(config)(vehicle, config))
