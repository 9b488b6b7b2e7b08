"""Differences between recorded and recomputed outputs of a topic: metres, angles, other numbers, else text."""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any, Final

import numpy as np

from monstertruck_estimation.transforms import conjugate, multiply, wrap_angle
from monstertruck_runtime import wire
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.base import Message, Pose2D, Schema
from monstertruck_schemas.plan import Path
from monstertruck_schemas.state import Grid, Transform
from monstertruck_schemas.topics import Topic

HEADER: Final = frozenset({"stamp", "received", "seq"})
ANGLES: Final = frozenset({"yaw", "roll", "pitch", "tilt", "front", "rear", "heading_error", "direction"})
LENGTHS: Final = frozenset({"cross_track", "along", "length"})


class Kind(StrEnum):
    """Unit of a difference."""

    LENGTH = "m"
    ANGLE = "rad"
    NUMBER = "number"
    TEXT = "text"


@dataclass(frozen=True, slots=True)
class Difference:
    """Difference of one field."""

    kind: Kind
    field: str
    value: float
    """Difference in SI units; +inf where the two cannot be subtracted."""


def differences(before: Message, after: Message) -> list[Difference]:
    """Return every field that differs between two messages, except headers; NaN is infinitely far from any number."""
    found = (replace(one, value=math.inf) if math.isnan(one.value) else one for one in _walk("", before, after))
    return [one for one in found if one.value > 0]


def same_header(before: Message, after: Message) -> bool:
    """Return whether stamps and sequence numbers are equal."""
    return all(getattr(before, name) == getattr(after, name) for name in HEADER)


def _walk(name: str, a: Any, b: Any) -> Iterator[Difference]:
    match a, b:
        case Pose2D(), Pose2D():
            yield Difference(Kind.LENGTH, name, _distance((a.x, a.y), (b.x, b.y)))
            yield Difference(Kind.ANGLE, f"{name}.yaw", _turn(a.yaw, b.yaw))
        case (Transform(), Transform()) | (Grid(), Grid()) | (Path(), Path()):
            yield from _figure(name, a, b)
        case Schema(), Schema() if type(a) is type(b):
            for field in type(a).model_fields:
                if field not in HEADER:
                    yield from _walk(f"{name}.{field}".lstrip("."), getattr(a, field), getattr(b, field))
        case np.ndarray(), np.ndarray():
            yield _array(name, a, b)
        case tuple(), tuple() if len(a) == len(b):
            for index, (one, other) in enumerate(zip(a, b, strict=True)):
                yield from _walk(f"{name}[{index}]", one, other)
        case (bool(), _) | (_, bool()):
            yield _text(name, a, b)
        case ((int() | float()), (int() | float())):
            yield _number(name, a, b)
        case _:
            yield _text(name, a, b)


def _figure(name: str, a: Any, b: Any) -> Iterator[Difference]:
    """Yield the differences of composite values, such as poses and grids."""
    if isinstance(a, Transform):
        yield from _transform(name, a, b)
    elif isinstance(a, Grid):
        yield from _grid(a, b)
    else:
        yield from _path(a, b)


def _number(name: str, a: float, b: float) -> Difference:
    last = name.rpartition(".")[2]
    kind = Kind.ANGLE if last in ANGLES else Kind.LENGTH if last in LENGTHS else Kind.NUMBER
    return Difference(kind, name, _turn(a, b) if kind is Kind.ANGLE else _distance((a,), (b,)))


def _turn(a: float, b: float) -> float:
    """Return the difference of two angles, rad; infinite if only one of them is finite."""
    if _same(a, b):
        return 0.0
    return abs(wrap_angle(b - a)) if math.isfinite(b - a) else math.inf


def _distance(a: Sequence[float], b: Sequence[float]) -> float:
    """Return the distance of two points; equal coordinates, or both NaN, have distance 0."""
    return math.hypot(*(0.0 if _same(one, other) else other - one for one, other in zip(a, b, strict=True)))


def _same(a: Any, b: Any) -> Any:
    """Return whether both are equal or NaN; of arrays for each element."""
    return (a == b) | ((a != a) & (b != b))  # NaN alone differs from itself


def _text(name: str, a: object, b: object) -> Difference:
    return Difference(Kind.TEXT, name, 0.0 if a == b else math.inf)


def _array(name: str, a: Any, b: Any) -> Difference:
    if a.shape != b.shape:
        return Difference(Kind.TEXT, name, math.inf)
    other = ~_same(a, b)
    off = np.abs(b[other].astype(np.float64) - a[other])
    return Difference(Kind.NUMBER, name, float(off.max()) if off.size else 0.0)


def _transform(name: str, a: Transform, b: Transform) -> Iterator[Difference]:
    yield _text(f"{name}.frames", (a.parent, a.child), (b.parent, b.child))
    yield Difference(Kind.LENGTH, f"{a.child}.translation", _distance(a.translation, b.translation))
    x, y, z, w = multiply(conjugate(a.rotation), b.rotation)
    turned = 0.0 if all(map(_same, a.rotation, b.rotation)) else 2 * math.atan2(math.hypot(x, y, z), abs(w))
    yield Difference(Kind.ANGLE, f"{a.child}.rotation", turned)


def _path(a: Path, b: Path) -> Iterator[Difference]:
    """Yield the distance of two paths: Hausdorff distance of their poses, and the angle between the nearest ones."""
    if not len(a.poses) or not len(b.poses):
        yield _text("poses", len(a.poses), len(b.poses))
        return
    one, other = (np.reshape(path.poses, (-1, 3)) for path in (a, b))
    apart = np.hypot(*(one[:, None, :2] - other[None, :, :2]).transpose(2, 0, 1))
    near, back = apart.argmin(axis=1), apart.argmin(axis=0)
    pairs = zip([*one[:, 2], *other[:, 2]], [*other[near, 2], *one[back, 2]], strict=True)
    yield Difference(Kind.LENGTH, "poses", float(np.max([apart.min(axis=1).max(), apart.min(axis=0).max()])))
    yield Difference(Kind.ANGLE, "poses.yaw", max(_turn(float(a), float(b)) for a, b in pairs))
    ways = (path.directions[np.flatnonzero(np.diff(path.directions, prepend=0.0))].tolist() for path in (a, b))
    yield _text("directions", *ways)
    yield _text("name", (a.name, a.closed), (b.name, b.closed))


def _grid(a: Grid, b: Grid) -> Iterator[Difference]:
    """Yield the mean difference of the cells' occupancy, 0..1: single cells mean little."""
    yield from _walk("origin", a.origin, b.origin)
    yield _text("size", (a.width, a.height, a.resolution), (b.width, b.height, b.resolution))
    if a.cells.shape == b.cells.shape:
        off = np.abs(a.cells.astype(np.float64) - b.cells)
        yield Difference(Kind.NUMBER, "cells", float(off.mean()) / 100)


UNREADABLE: Final = "not readable"


@dataclass(frozen=True, slots=True)
class GreatestDifference:
    """The greatest difference of a kind."""

    kind: Kind
    value: float
    """SI units; +inf for text."""
    field: str
    sequence: int
    at: float
    """Seconds after the log's begin."""


@dataclass(frozen=True, slots=True)
class FirstDifference:
    """The first output that differs by more than the tolerance."""

    topic: str
    sequence: int
    at: float
    """Seconds after the log's begin."""
    fields: tuple[str, ...]
    """Fields that differ by more than the tolerance; none = the header alone."""


@dataclass(frozen=True, slots=True)
class _TopicOutput:
    time: int
    """Daemon time of its delivery, ns."""
    payload: bytes


@dataclass(slots=True)
class TopicComparison:
    """Comparison of one topic. The n-th recorded output is compared with the n-th of the replay.

    Args:
        topic: row of the topic table.
        tolerance: maximum difference of an agreeing field, SI units; 0: equal bit for bit.
        begin: start of the log (ns).
        judged: whether a difference matters.
    """

    topic: Topic[Message]
    tolerance: float
    begin: int
    judged: bool = True
    compared: int = 0
    equal: int = 0
    differing: int = 0
    """Differ by more than the tolerance."""
    headers: int = 0
    """Differ in their stamps or number."""
    greatest: dict[Kind, GreatestDifference] = field(default_factory=dict)
    first: FirstDifference | None = None
    _count: int = 0
    _recorded: dict[int, _TopicOutput] = field(default_factory=dict)
    _again: dict[int, _TopicOutput] = field(default_factory=dict)

    def recorded(self, sequence: int, time: int, payload: bytes) -> None:
        """Add an output of the log: its number in the run, time (ns), bytes."""
        output = _TopicOutput(time, payload)
        if (again := self._again.pop(sequence, None)) is not None:
            self._compare(sequence, output, again)
        else:
            self._recorded[sequence] = output

    def recomputed(self, time: int, payload: bytes) -> None:
        """Add the next output of the replay."""
        sequence, output = self._count, _TopicOutput(time, payload)
        self._count += 1
        if (recorded := self._recorded.pop(sequence, None)) is not None:
            self._compare(sequence, recorded, output)
        else:
            self._again[sequence] = output

    @property
    def missing(self) -> int:
        """Number of recorded outputs that the replay did not produce."""
        return len(self._recorded)

    def surplus(self, end: int) -> int:
        """Return the number of unrecorded outputs of the replay until ``end`` (ns)."""
        return sum(output.time <= end for output in self._again.values())

    def agrees(self, end: int) -> bool:
        """Return whether every output until ``end`` (ns) was reproduced within the tolerance."""
        return not self.judged or self.differing == self.missing == self.surplus(end) == 0

    def within(self, end: int, limit: float) -> bool:
        """Whether it agrees or, with all outputs and headers as recorded, no field differs by more than ``limit``."""
        close = self.headers == 0 and all(one.value <= limit for one in self.greatest.values())
        return self.agrees(end) or (close and self.missing == self.surplus(end) == 0)

    def _compare(self, sequence: int, recorded: _TopicOutput, again: _TopicOutput) -> None:
        self.compared += 1
        if recorded.payload == again.payload:
            self.equal += 1
            return
        try:
            before, after = wire.decode(self.topic, recorded.payload), wire.decode(self.topic, again.payload)
        except InputError:
            found = [Difference(Kind.TEXT, UNREADABLE, math.inf)]
        else:
            # Another version of the codec may give equal values other bytes.
            if wire.encode(self.topic, before) == wire.encode(self.topic, after):
                self.equal += 1
                return
            self.headers += not same_header(before, after)
            found = differences(before, after)
        at = (recorded.time - self.begin) / SECOND
        self._keep(found, sequence, at)
        off = tuple(one.field for one in found if one.value > self.tolerance)
        if self.tolerance > 0 and not off:
            return
        self.differing += 1
        if self.first is None or at < self.first.at:
            self.first = FirstDifference(self.topic.name, sequence, at, off)

    def _keep(self, found: Iterable[Difference], sequence: int, at: float) -> None:
        for one in found:
            known = self.greatest.get(one.kind)
            if known is None or one.value > known.value:
                self.greatest[one.kind] = GreatestDifference(one.kind, one.value, one.field, sequence, at)
