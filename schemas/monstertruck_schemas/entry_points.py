"""What other installed distributions give through entry points: one object each, read when first asked for.

A distribution that is broken is named and left out: it never keeps the robot from starting.
"""

import importlib.metadata
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, Generic, TypeVar

OURS = "monstertruckd"
"""Origin of what is in this repository."""

R = TypeVar("R")


@dataclass(frozen=True, slots=True)
class Broken:
    """An entry point that was left out."""

    group: str
    name: str
    origin: str
    """Distribution and version"""
    error: str

    def __str__(self) -> str:
        return f"{self.group}: {self.name} of {self.origin}: {self.error}"


@dataclass(frozen=True, slots=True)
class Extended(Generic[R]):
    """A table with its additions."""

    rows: Mapping[str, R]
    """By name: ours first, then the others' by distribution and name."""
    origins: Mapping[str, str]
    """Distribution of each row."""
    broken: tuple[Broken, ...]


@cache
def _installed() -> Any:
    """All entry points of this environment, with ``select``; reading them takes some 30 ms."""
    return importlib.metadata.entry_points()


def extended(group: str, ours: Mapping[str, R], accept: Callable[[str, Any], str | None]) -> Extended[R]:
    """Our rows, and those that other distributions give in a group of entry points.

    Args:
        group: name of the group, for instance ``monstertruck.trackers``.
        ours: rows of this repository by name.
        accept: what is wrong with an object of that name, or None; it may raise as well.
    """
    rows, origins = dict(ours), dict.fromkeys(ours, OURS)
    broken: list[Broken] = []
    found = [(_origin(entry), entry) for entry in _installed().select(group=group)]
    for origin, entry in sorted(found, key=lambda pair: (pair[0], pair[1].name)):
        try:
            row = entry.load()
            error = f"the name is taken by {origins[entry.name]}" if entry.name in rows else accept(entry.name, row)
        except (Exception, SystemExit) as raised:  # noqa: BLE001  # whatever somebody else's module does
            error = f"{type(raised).__name__}: {raised}"
        if error is None:
            rows[entry.name], origins[entry.name] = row, origin
        else:
            broken.append(Broken(group, entry.name, origin, error))
    return Extended(rows, origins, tuple(broken))


def _origin(entry: importlib.metadata.EntryPoint) -> str:
    return "unknown" if entry.dist is None else f"{entry.dist.name} {entry.dist.version}"
