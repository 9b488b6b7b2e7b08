"""Checks of the gate that a configuration adds by ``kind``, of this repository or of other distributions."""

from typing import Annotated, Final, Literal

from pydantic import Field

from monstertruck_runtime.plugins import Catalog, Plugin
from monstertruck_schemas.base import Schema


class CheckConfig(Schema):
    """Settings of a check that a configuration adds to the gate."""

    kind: str


class FenceConfig(CheckConfig):
    """Area that the robot must not leave."""

    kind: Literal["fence"]
    corners: Annotated[tuple[tuple[float, float], ...], Field(strict=False, min_length=3)]
    """Corners of a polygon in map, m."""


GATE_CHECKS: Final = Catalog(
    "monstertruck.gate_checks",
    Plugin(
        name="fence",
        settings="monstertruckd.gate.catalog:FenceConfig",
        implementation="monstertruckd.gate.fence:FenceCheck",
        doc="Keeps the robot inside a polygon of the map",
    ),
    base=CheckConfig,
)
"""A check is a ``Check`` made from its settings and a ``GateView``; it can only make the gate stricter."""

AnyCheck = Annotated[CheckConfig, GATE_CHECKS.section()]
"""One of the configuration's section `checks`."""
