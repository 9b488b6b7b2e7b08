"""The table of trackers: which class is behind a ``kind``, loaded on use."""

import importlib
from typing import Final, cast

from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.track.api import Tracker
from monstertruck_planners.track.config import TrackerConfig
from monstertruck_runtime.errors import InputError

TRACKERS: Final = {
    "pure_pursuit": "monstertruck_planners.track.pure_pursuit:PurePursuit",
    "stanley": "monstertruck_planners.track.stanley:Stanley",
    "fuzzy": "monstertruck_planners.track.fuzzy:Fuzzy",
    "lqr": "monstertruck_planners.track.lqr:Lqr",
    "mpc": "monstertruck_planners.track.mpc:Mpc",
}
"""Module and class by kind."""


def build_tracker(config: TrackerConfig, steering: FourWheelSteering) -> Tracker:
    """The tracker of a configuration.

    Args:
        config: with its ``kind``.
        steering: the truck's geometry.

    Raises:
        InputError: no such kind, or what it needs is not installed.
    """
    kind = str(vars(config).get("kind"))
    if kind not in TRACKERS:
        raise InputError(f"tracker.kind {kind!r}: expected one of {', '.join(TRACKERS)}")
    module, name = TRACKERS[kind].split(":")
    try:
        found = getattr(importlib.import_module(module), name)
    except ImportError as error:
        raise InputError(f"tracker.kind {kind}: needs the extra [planning]: {error}") from error
    return cast("Tracker", found(config, steering))
