"""All tables of plug-ins, for lists and for the remarks about broken ones."""

from collections.abc import Iterator
from typing import Any, Final, NamedTuple

from monstertruck_drivers.catalog import DEVICES
from monstertruck_estimation.catalog import ODOMETRY
from monstertruck_planners.behave.catalog import BEHAVIOURS, LEVELLING
from monstertruck_planners.explore.catalog import EXPLORERS
from monstertruck_planners.local.catalog import LOCAL_PLANNERS
from monstertruck_planners.route.catalog import ROUTE_PLANNERS
from monstertruck_planners.track.catalog import TRACKERS
from monstertruck_runtime.bodies import BODIES
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.plugins import Plugin
from monstertruck_schemas.entry_points import OURS, ExtensibleTable
from monstertruck_schemas.topics import BY_NAME
from monstertruckd.gate.catalog import GATE_CHECKS

TABLES: Final[tuple[ExtensibleTable[Any], ...]] = (
    DEVICES,
    BODIES,
    ODOMETRY,
    ROUTE_PLANNERS,
    LOCAL_PLANNERS,
    TRACKERS,
    EXPLORERS,
    BEHAVIOURS,
    LEVELLING,
    GATE_CHECKS,
    BY_NAME,
)


class Listed(NamedTuple):
    """One plug-in."""

    group: str
    name: str
    origin: str
    """Distribution and version"""
    doc: str
    error: str | None = None
    """Why it cannot be used"""


def plugins() -> Iterator[Listed]:
    """All kinds and topics, and the entry points that were left out; loads what other distributions bring."""
    for table in TABLES:
        for name, row in table.items():
            origin = table.origin(name)
            error = None if origin == OURS else _load_error(row)
            yield Listed(table.group, name, origin, row.doc, error)
        for broken in table.broken:
            yield Listed(table.group, broken.name, broken.origin, "", broken.error)


def _load_error(row: Any) -> str | None:
    if not isinstance(row, Plugin):
        return None
    try:
        row.implementation_class()
    except InputError as error:
        return str(error)
    except Exception as raised:  # noqa: BLE001  # whatever the plug-in's module does
        return f"{type(raised).__name__}: {raised}"
    return None
