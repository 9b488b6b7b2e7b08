"""Behaviours by ``kind``: services that react to sensors directly, without a path."""

from typing import Annotated, Final

from monstertruck_runtime.plugins import Catalog, Plugin
from monstertruck_schemas.base import Schema

BEHAVIOURS: Final = Catalog(
    "monstertruck.behaviours",
    Plugin(
        name="stabiliser",
        settings="monstertruck_planners.behave.stabiliser:StabiliserConfig",
        implementation="monstertruck_planners.behave.stabiliser:build_stabiliser",
        doc="Keeps the lidar level by the compass",
    ),
)
"""A behaviour is a function that makes a ``Service`` from its settings, the clock and the bus (a ``BusPort``)."""

AnyLevelling = Annotated[Schema, BEHAVIOURS.section("stabiliser")]
"""The configuration's section `levelling`."""
