"""Deformers by kind; their modules are loaded on use, in workers."""

import importlib
from typing import TYPE_CHECKING

from monstertruck_planners.local.config import DeformConfig, PublishedConfig, RsbandConfig, TebConfig
from monstertruck_runtime.errors import InputError

if TYPE_CHECKING:
    from monstertruck_planners.local.api import Deformer
    from monstertruck_planners.route.api import Vehicle

KINDS: dict[str, tuple[type[DeformConfig], str]] = {
    "rsband": (RsbandConfig, "monstertruck_planners.local.rsband:Rsband"),
    "rsband-as-published": (PublishedConfig, "monstertruck_planners.local.published:Published"),
    "teb": (TebConfig, "monstertruck_planners.local.teb:Teb"),
}
"""Settings and "module:class" of each."""


def make_deformer(vehicle: "Vehicle", config: DeformConfig) -> "Deformer":
    """Deformer of a configuration.

    Raises:
        InputError: settings without a kind of deformer.
    """
    for model, place in KINDS.values():
        if type(config) is model:
            module, name = place.split(":")
            deformer: Deformer = getattr(importlib.import_module(module), name)(vehicle, config)
            return deformer
    raise InputError(f"deformer of {type(config).__name__}: expected the settings of one of {', '.join(KINDS)}")
