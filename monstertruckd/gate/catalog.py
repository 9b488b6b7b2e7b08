"""Catalog of gate checks that a configuration adds by ``kind``, from this repository or from other distributions."""

from typing import Annotated, Any, Final, Literal, Self

from pydantic import Field, model_validator

from monstertruck_runtime.plugins import Catalog, Plugin
from monstertruck_schemas.base import Schema
from monstertruck_schemas.topics import BY_NAME, Topic


class CheckConfig(Schema):
    """Settings of a check that a configuration adds to the gate."""

    kind: str


class FenceConfig(CheckConfig):
    """Area that the robot must not leave."""

    kind: Literal["fence"]
    corners: Annotated[tuple[tuple[float, float], ...], Field(strict=False, min_length=3)]
    """Corners of a polygon in map, m."""


class FreshConfig(CheckConfig):
    """Topic that must be fresh for the robot to move."""

    kind: Literal["fresh"]
    topic: str
    """Name of the topic, such as sensor/imu."""
    within: Annotated[float, Field(gt=0, le=60)] | None = None
    """Maximum age of the latest message, s; null: staleness limit of the topic."""

    @property
    def row(self) -> Topic[Any]:
        """Entry for the topic in the topic table."""
        return BY_NAME[self.topic]

    @property
    def limit(self) -> float:
        """Maximum age (s); +inf if neither the settings nor the topic has a limit."""
        return self.row.fresh_for() if self.within is None else self.within

    @model_validator(mode="after")
    def _limited(self) -> Self:
        if self.topic not in BY_NAME or self.row.inward:
            raise ValueError(f"topic {self.topic!r}: expected a topic of the robot")
        if self.within is None and self.row.stale_after is None:
            raise ValueError(f"topic {self.topic}: has no staleness limit; set `within`")
        return self


GATE_CHECKS: Final = Catalog(
    "monstertruck.gate_checks",
    Plugin(
        name="fence",
        settings="monstertruckd.gate.catalog:FenceConfig",
        implementation="monstertruckd.gate.fence:FenceCheck",
        doc="Keeps the robot inside a polygon of the map",
    ),
    Plugin(
        name="fresh",
        settings="monstertruckd.gate.catalog:FreshConfig",
        implementation="monstertruckd.gate.fresh:FreshCheck",
        doc="Stops the robot while a topic is silent",
    ),
    base=CheckConfig,
)
"""Checks by ``kind``, built from their settings and a ``GateView``; they can only make the gate stricter."""

AnyCheck = Annotated[CheckConfig, GATE_CHECKS.section()]
"""One check of section `checks` in the configuration."""
