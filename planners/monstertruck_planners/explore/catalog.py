"""Explorers by ``kind``, which choose the next frontier."""

from typing import Annotated, Final

from monstertruck_planners.explore.config import ExplorerConfig
from monstertruck_runtime.plugins import Catalog, Plugin

EXPLORERS: Final = Catalog(
    "monstertruck.explorers",
    Plugin(
        name="information",
        settings="monstertruck_planners.explore.config:InformationConfig",
        implementation="monstertruck_planners.explore.scores:Information",
        doc="The most new area per second of driving",
        extra="planning",
    ),
    Plugin(
        name="nearest",
        settings="monstertruck_planners.explore.config:NearestConfig",
        implementation="monstertruck_planners.explore.scores:Nearest",
        doc="The nearest frontier",
        extra="planning",
    ),
    Plugin(
        name="author",
        settings="monstertruck_planners.explore.config:AuthorConfig",
        implementation="monstertruck_planners.explore.scores:Author",
        doc="The scores of the thesis's author",
        extra="planning",
    ),
    base=ExplorerConfig,
)
"""Catalog of explorers; each implements ``Explorer`` and is created from its settings."""

AnyExplorer = Annotated[ExplorerConfig, EXPLORERS.section("information")]
"""Section `explorer` of the configuration."""
