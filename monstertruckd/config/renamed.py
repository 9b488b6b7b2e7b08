"""Keys that older versions called otherwise: one table for configuration files, saved settings and calibrations."""

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
"""By version of the configuration (release 0.1.0 has 1): dotted keys, ``*`` for any one name, and what the next version
calls their last part. A key stays in its section.

Saved settings and calibrations do not say the version of their keys, so no other key ever gets a name of this table."""


def present_key(key: str) -> str:
    """The present name of a dotted key of any version."""
    names = key.split(".")
    for renamed in RENAMED.values():
        for old, name in renamed.items():
            last = old.count(".")
            if fits(names[: last + 1], old):
                names[last] = name
    return ".".join(names)


def fits(names: Sequence[str], pattern: str) -> bool:
    """Whether the parts of a key are those of a dotted pattern, in which ``*`` is any one name."""
    parts = pattern.split(".")
    return len(parts) == len(names) and all(part in ("*", name) for part, name in zip(parts, names, strict=True))
