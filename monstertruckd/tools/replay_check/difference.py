"""How far two messages of one topic are apart, in words an operator knows: metres, angles, other numbers, else text."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any, Final

import numpy as np

from monstertruck_estimation.transforms import conjugate, multiply, wrap_angle
from monstertruck_schemas.base import Message, Pose2D, Schema
from monstertruck_schemas.plan import Path
from monstertruck_schemas.state import Grid, Transform

HEADER: Final = frozenset({"stamp", "received", "seq"})
ANGLES: Final = frozenset({"yaw", "roll", "pitch", "tilt", "front", "rear", "heading_error", "direction"})
LENGTHS: Final = frozenset({"cross_track", "along", "length"})


class Kind(StrEnum):
    """What a difference is measured in."""

    LENGTH = "m"
    ANGLE = "rad"
    NUMBER = "number"
    TEXT = "text"


@dataclass(frozen=True, slots=True)
class Difference:
    """Of one field."""

    kind: Kind
    field: str
    value: float
    """In SI units; +inf where the two cannot be subtracted."""


def differences(before: Message, after: Message) -> list[Difference]:
    """Every field in which two messages differ, but for their headers; NaN is infinitely far from any number."""
    found = (replace(one, value=math.inf) if math.isnan(one.value) else one for one in _walk("", before, after))
    return [one for one in found if one.value > 0]


def same_header(before: Message, after: Message) -> bool:
    """Whether stamps and number are the same."""
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
    """Of what is more than its fields."""
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
    """Between two angles, rad; infinite if one of them alone is no finite number."""
    if _same(a, b):
        return 0.0
    return abs(wrap_angle(b - a)) if math.isfinite(b - a) else math.inf


def _distance(a: Sequence[float], b: Sequence[float]) -> float:
    """Between two points; coordinates that are the same, or NaN both, are no distance."""
    return math.hypot(*(0.0 if _same(one, other) else other - one for one, other in zip(a, b, strict=True)))


def _same(a: Any, b: Any) -> Any:
    """Equal, or NaN both; of arrays for each element."""
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
    """How far the two lead apart: Hausdorff distance of their poses, and the angle between the nearest ones."""
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
    """Cells as mean difference of occupancy, 0..1: one cell says little."""
    yield from _walk("origin", a.origin, b.origin)
    yield _text("size", (a.width, a.height, a.resolution), (b.width, b.height, b.resolution))
    if a.cells.shape == b.cells.shape:
        off = np.abs(a.cells.astype(np.float64) - b.cells)
        yield Difference(Kind.NUMBER, "cells", float(off.mean()) / 100)
