"""Base of every message: strict frozen models, read-only arrays, one header.

Units are SI and radians everywhere; frames follow REP 103 (x forward, y left, z up) and REP 105 (map > odom > base >
sensors). A missing value is ``None``, never NaN.
"""

import ast
import inspect
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Annotated, Any, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    GetJsonSchemaHandler,
    PlainSerializer,
    PlainValidator,
    ValidationError,
    ValidationInfo,
    WithJsonSchema,
)
from pydantic.fields import FieldInfo
from pydantic_core import CoreSchema

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Name = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_-]{0,31}$")]
"""Name of a robot, a behaviour or a mission."""


class Live:
    """Marks a setting, in its ``Annotated`` type, that can be changed while the robot runs."""


LIVE: Final = Live()
LiveValue = float | int | bool | str


class Schema(BaseModel):
    """A strict, frozen record; unknown fields are rejected on construction, ignored on the wire."""

    model_config = ConfigDict(
        frozen=True,
        strict=True,
        extra="forbid",
        allow_inf_nan=False,
        ser_json_inf_nan="constants",  # a non-finite request must reach the gate, which refuses it by name
        arbitrary_types_allowed=True,
    )

    @classmethod
    def __get_pydantic_json_schema__(cls, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        """Schema with the docstrings of its fields as descriptions."""
        found = handler(schema)
        properties = handler.resolve_ref_schema(found).get("properties", {})
        for name, text in field_docs(cls).items():
            if name in properties:
                properties[name]["description"] = text
        return found

    def __eq__(self, other: object) -> bool:
        """Fieldwise equality that also compares arrays by value."""
        if type(other) is not type(self):
            return NotImplemented
        return all(_equal(a, b) for a, b in zip(self.__dict__.values(), other.__dict__.values(), strict=True))

    __hash__ = None  # type: ignore[assignment]  # messages carry arrays


def first_mistake(error: ValidationError, *before: str) -> str:
    """Key and text of the first validation error; ``before`` are the parent keys."""
    detail = error.errors(include_url=False)[0]
    where = ".".join(map(str, (*before, *detail["loc"])))
    text = detail["msg"].removeprefix("Value error, ")
    return f"{where}: {text}" if where else text


def field_docs(model: type[BaseModel]) -> dict[str, str]:
    """Description of each field, or the docstring after it.

    Read from the source on demand: pydantic's ``use_attribute_docstrings`` does so for every model definition, which
    takes a third of the start of every process.
    """
    found: dict[str, str | None] = {}
    for base in reversed(model.__mro__[: model.__mro__.index(BaseModel)]):
        found |= _docs_in(base.__module__).get(base.__qualname__, {})
    meant = {name: field.description or found.get(name) for name, field in model.model_fields.items()}
    return {name: text for name, text in meant.items() if text is not None}


@cache
def _docs_in(module: str) -> dict[str, dict[str, str | None]]:
    """Return the docstrings after annotated names, by qualified name of the class."""
    try:
        tree = ast.parse(inspect.getsource(sys.modules[module]))
    except (KeyError, OSError, TypeError):
        return {}  # no source: no docstrings
    found = {}

    def walk(node: ast.AST, path: str) -> None:
        for inner in ast.iter_child_nodes(node):
            if isinstance(inner, ast.ClassDef):
                found[path + inner.name] = dict(_docs_behind(inner.body))
                walk(inner, f"{path}{inner.name}.")
            elif isinstance(inner, ast.FunctionDef):
                walk(inner, f"{path}{inner.name}.<locals>.")

    walk(tree, "")
    return found


def _docs_behind(body: list[ast.stmt]) -> Iterator[tuple[str, str | None]]:
    for statement, following in pairwise([*body, ast.Pass()]):
        match statement:
            case ast.AnnAssign(target=ast.Name(id=name)):
                match following:
                    case ast.Expr(value=ast.Constant(value=str(text))):
                        yield name, inspect.cleandoc(text)
                    case _:
                        yield name, None


@dataclass(frozen=True, slots=True)
class LiveSetting:
    """One setting that can be changed while the robot runs."""

    key: str
    """Dotted key."""
    value: LiveValue
    meaning: str
    above: float | None = None
    """Bound of the value alone, exclusive; the whole configuration may allow less."""
    at_least: float | None = None
    below: float | None = None
    at_most: float | None = None


def live_settings(config: Schema, prefix: str = "") -> Iterator[LiveSetting]:
    """Yield all live settings of a configuration, in order."""
    for name, field in type(config).model_fields.items():
        value = getattr(config, name)
        if isinstance(value, Schema):
            yield from live_settings(value, f"{prefix}{name}.")
        elif LIVE in field.metadata:
            meaning = " ".join(field_docs(type(config)).get(name, "").replace("``", "").split())
            yield LiveSetting(f"{prefix}{name}", value, meaning, *_bounds(field))


def _bounds(field: FieldInfo) -> tuple[float | None, ...]:
    names = ("gt", "ge", "lt", "le")
    return tuple(next((getattr(m, name) for m in field.metadata if hasattr(m, name)), None) for name in names)


def _equal(a: object, b: object) -> bool:
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return a.dtype == b.dtype and np.array_equal(a, b)
    return bool(a == b)


def _frozen_array(dtype: type[np.generic], size: int | None) -> PlainValidator:
    exact = np.dtype(dtype)

    def freeze(value: Any, info: ValidationInfo) -> NDArray[Any]:
        if type(value) is np.ndarray and value.dtype is exact and value.ndim == 1:
            array = value
        else:
            array = _array(value, dtype, info)
        if size is not None and len(array) != size:
            raise ValueError(f"expected {size} numbers, got {len(array)}")
        return np.frombuffer(array.tobytes(), exact) if array.flags.writeable else array

    return PlainValidator(freeze)


def _array(value: Any, dtype: type[np.generic], info: ValidationInfo) -> NDArray[Any]:
    """Convert input to a one-dimensional array.

    Raises:
        ValueError: the input is not one.
    """
    # Checked first, because numpy is slow on strings and nested lists.
    if info.mode == "json" and not (isinstance(value, list) and {int, float}.issuperset(map(type, value))):
        raise ValueError("expected a list of numbers")
    try:
        array = np.asarray(value, dtype=dtype)
    except (TypeError, OverflowError) as error:
        raise ValueError(str(error)) from error
    if array.ndim != 1:
        raise ValueError(f"expected one dimension, got {array.ndim}")
    return array


def _array_type(dtype: type[np.generic], json_item: str, size: int | None = None) -> Any:
    return (
        _frozen_array(dtype, size),
        PlainSerializer(lambda a: a.tolist(), when_used="json"),
        WithJsonSchema({"type": "array", "items": {"type": json_item}}),
    )


Float64Array = Annotated[NDArray[np.float64], *_array_type(np.float64, "number")]
"""Read-only float64 array; JSON: list of numbers. May hold +inf for "no return" only where stated."""
Covariance = Annotated[NDArray[np.float64], *_array_type(np.float64, "number", 9)]
"""Covariance of three values, shape (9,), row-major."""
UInt8Array = Annotated[NDArray[np.uint8], *_array_type(np.uint8, "integer")]
Int8Array = Annotated[NDArray[np.int8], *_array_type(np.int8, "integer")]


def position_deviation(covariance: NDArray[np.float64]) -> float:
    """Standard deviation of a position along the axis where it is largest, m.

    Args:
        covariance: covariance of (x, y, yaw), shape (9,) or (3, 3).
    """
    xx, xy, _, _, yy, *_ = np.ravel(covariance).tolist()
    return math.sqrt(max((xx + yy) / 2 + math.hypot((xx - yy) / 2, xy), 0.0))


Nanoseconds = Annotated[int, Field(ge=-(2**63), lt=2**63)]
"""Time in nanoseconds of CLOCK_MONOTONIC (of the daemon's clock: wall, virtual or replay)."""
FrameId = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$", max_length=64)]


class Message(Schema):
    """Header of every topic."""

    stamp: Nanoseconds
    """Time of the measurement, mapped from the sensor's clock if it has one."""
    received: Nanoseconds
    """Time when the daemon had received it completely."""
    seq: Annotated[int, Field(ge=0, lt=2**63)]
    """Number of this message since the daemon started; a gap is a loss."""
    frame: FrameId = "base"
    """Coordinate frame of the values."""


class Pose2D(Schema):
    """Planar pose in the message's frame: metres, radians (counter-clockwise positive)."""

    x: float
    y: float
    yaw: float


class Twist2D(Schema):
    """Planar velocity in the base frame: m/s, m/s, rad/s."""

    vx: float
    vy: float
    wz: float


def servos_of(front: float, front_right: float | None, rear: float, rear_right: float | None) -> tuple[float, ...]:
    """Servo angles: front and rear, or front left, front right, rear left and rear right."""
    return (front, rear) if front_right is None or rear_right is None else (front, front_right, rear, rear_right)


def servo_fields(servos: Sequence[float], suffix: str = "") -> dict[str, Any]:
    """Fields of a message for its servo angles, two or four as in ``servos_of``, with the ``suffix`` of their names."""
    names = ("front", "front_right", "rear", "rear_right")
    return {f"{n}{suffix}": angle for n, angle in zip(names[:: len(names) // len(servos)], servos, strict=True)}
