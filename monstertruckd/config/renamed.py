"""Keys renamed since older versions: one table for configuration files, saved settings and calibrations."""

from collections.abc import Sequence
from typing import Final

RENAMED: Final[dict[int, dict[str, str]]] = {
    1: {
        "gate.obstacle.beside": "side_clearance",
        "odometry.compass.patience": "steady_time",
        "placement.deformer": "local_planner",
        "planner.deform": "local_planner",
        "planner.ladder": "recovery",
        "planner.local.beside": "rejoin_distance",
        "planner.local.patience": "blocked_timeout",
        "planner.local.rejoin": "rejoin_clearance",
        "planner.route.greed": "heuristic_weight",
        "planner.sightings": "blocked_scans",
        "slam.mapper.thinning": "pruning",
        "tracker.turn_within": "steering_distance",
        "usb.patience": "empty_timeout",
    },
}
"""Renamed keys by version of the configuration (release 0.1.0 has 1): dotted keys (``*`` matches any name), and the
next version's name of their last part. A key stays in its section.

Saved settings and calibrations do not record the version of their keys, so names in this table are never reused."""


def present_key(key: str) -> str:
    """Current name of a dotted key from any version."""
    names = key.split(".")
    for renamed in RENAMED.values():
        for old, name in renamed.items():
            last = old.count(".")
            if fits(names[: last + 1], old):
                names[last] = name
    return ".".join(names)


def fits(names: Sequence[str], pattern: str) -> bool:
    """Return whether a key matches a dotted pattern (``*`` matches any name)."""
    parts = pattern.split(".")
    return len(parts) == len(names) and all(part in ("*", name) for part, name in zip(parts, names, strict=True))
