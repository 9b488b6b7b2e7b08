"""Tables that other installed distributions extend by entry points.

A broken entry point is reported and skipped: it never prevents the start of the robot.
"""

import importlib.metadata
from abc import abstractmethod
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass
from enum import EnumType
from functools import cache, cached_property
from typing import Any, Final, NamedTuple, Protocol, TypeVar, get_type_hints

from pydantic import TypeAdapter, ValidationError

OURS: Final = "monstertruckd"
"""Origin of rows in this repository."""


class Named(Protocol):
    """A row of a table."""

    @property
    def name(self) -> str:
        """Name in the table."""


R = TypeVar("R", bound=Named)


@dataclass(frozen=True, slots=True)
class Broken:
    """A skipped entry point."""

    group: str
    name: str
    origin: str
    """Distribution and version"""
    error: str

    def __str__(self) -> str:
        return f"{self.group}: {self.name} of {self.origin}: {self.error}"


class _Read(NamedTuple):
    rows: Mapping[str, Any]
    origins: Mapping[str, str]
    broken: tuple[Broken, ...]


class ExtensibleTable(Mapping[str, R]):
    """Rows by name: built-in ones in the given order, then rows of other distributions, read on first use.

    Each entry point has the name of its row.

    Args:
        group: group of the entry points, for instance ``monstertruck.trackers``.
        ours: built-in rows.
    """

    def __init__(self, group: str, ours: Iterable[R]) -> None:
        self.group = group
        self.ours: Mapping[str, R] = {row.name: row for row in ours}

    @abstractmethod
    def fault(self, row: Any) -> str | None:
        """Error in a row of another distribution, or None; it may also raise."""

    @cached_property
    def _read(self) -> _Read:
        rows, origins = dict(self.ours), dict.fromkeys(self.ours, OURS)
        broken: list[Broken] = []
        found = [(_origin(entry), entry) for entry in _installed().select(group=self.group)]
        for origin, entry in sorted(found, key=lambda pair: (pair[0], pair[1].name)):
            try:
                row = entry.load()
                error = (
                    f"the name is taken by {origins[entry.name]}"
                    if entry.name in rows
                    else f"the entry point is called {entry.name}, what it points to {row.name}"
                    if getattr(row, "name", entry.name) != entry.name
                    else wrong_value(row) or self.fault(row)
                )
            except (Exception, SystemExit) as raised:  # noqa: BLE001  # whatever the plug-in's module does
                error = f"{type(raised).__name__}: {raised}"
            if error is None:
                rows[entry.name], origins[entry.name] = row, origin
            else:
                broken.append(Broken(self.group, entry.name, origin, error))
        _LEFT_OUT[self.group] = tuple(broken)
        return _Read(rows, origins, tuple(broken))

    def __getitem__(self, name: str) -> R:
        row: R = self._read.rows[name]
        return row

    def __iter__(self) -> Iterator[str]:
        return iter(self._read.rows)

    def __len__(self) -> int:
        return len(self._read.rows)

    def origin(self, name: str) -> str:
        """Distribution that a row comes from."""
        return self._read.origins[name]

    @property
    def broken(self) -> tuple[Broken, ...]:
        """Skipped entry points."""
        return self._read.broken


_LEFT_OUT: Final[dict[str, tuple[Broken, ...]]] = {}


def left_out() -> Iterator[Broken]:
    """Yield the skipped entry points of the tables that this process has read."""
    for broken in _LEFT_OUT.values():
        yield from broken


def wrong_value(row: Any) -> str | None:
    """Return the first field of a row whose value violates its annotation, with the allowed values; None if all fit.

    Rows within the row are checked as well.

    Args:
        row: dataclass instance; other objects always fit.
    """
    if not is_dataclass(row):
        return None
    hints = get_type_hints(type(row))
    for field in fields(row):
        value = getattr(row, field.name)
        try:
            TypeAdapter(hints[field.name]).validate_python(value, strict=True)
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            place = "".join(f".{part}" if isinstance(part, str) else f"[{part}]" for part in first["loc"])
            expected = _choices(hints[field.name]) or first["msg"].removeprefix("Input should be ")
            return f"{field.name}{place}: expected {expected}, found {first['input']!r}"
        inner = value.items() if isinstance(value, Mapping) else enumerate(value) if isinstance(value, tuple) else ()
        for key, row_within in inner:
            if wrong := wrong_value(row_within):
                return f"{field.name}[{key!r}].{wrong}"
    return None


def _choices(annotation: Any) -> str | None:
    """Return the members of an enumeration as code writes them; None for another annotation."""
    if not isinstance(annotation, EnumType):
        return None
    return " or ".join(f"{annotation.__name__}.{name}" for name in annotation.__members__)


@cache
def _installed() -> Any:
    """All entry points of this environment, with ``select``; reading them takes some 30 ms."""
    return importlib.metadata.entry_points()


def _origin(entry: importlib.metadata.EntryPoint) -> str:
    return "unknown" if entry.dist is None else f"{entry.dist.name} {entry.dist.version}"
