"""Inputs and outputs of steps as JSON, exactly, for another machine: only known classes are ever built."""

import base64
import dataclasses
from enum import Enum
from functools import cached_property
from pathlib import Path
from typing import Any, Final, get_type_hints

import numpy as np

from monstertruck_runtime.errors import InputError
from monstertruck_runtime.plugins import classes_in
from monstertruck_schemas.base import Schema

_DTYPES: Final = ("float64", "int8", "uint8", "int64")


class StepCodec:
    """Converts trees of known classes, arrays, tuples, lists, dicts with text keys, paths and scalars.

    Args:
        roots: dataclasses and ``Schema`` models that may travel. Known are these and every dataclass, model and enum
            that their fields hold, the settings of plug-ins included.
    """

    def __init__(self, *roots: type[Any]) -> None:
        self._roots = roots

    @cached_property
    def _classes(self) -> dict[str, type[Any]]:
        found: dict[str, type[Any]] = {}
        waiting = list(self._roots)
        while waiting:
            cls = waiting.pop()
            if found.setdefault(_name(cls), cls) is cls and not issubclass(cls, Enum):
                held = {inner for field in _annotations(cls) for inner in classes_in(field) if _travels(inner)}
                waiting += held - set(found.values())
        return found

    def to_json(self, value: Any) -> Any:
        """The value as what JSON can say.

        Raises:
            InputError: a class that is not known.
        """
        match value:
            case Enum() if self._knows(value):
                return {"enum": _name(type(value)), "value": value.value}
            case None | bool() | int() | float() | str():
                return value
            case np.ndarray() if str(value.dtype) in _DTYPES:
                data = base64.b64encode(np.ascontiguousarray(value).tobytes()).decode()
                return {"array": str(value.dtype), "shape": list(value.shape), "data": data}
            case Path():
                return {"path": str(value)}
            case tuple():
                return {"tuple": [self.to_json(inner) for inner in value]}
            case list():
                return [self.to_json(inner) for inner in value]
            case dict():
                return {"dict": [[key, self.to_json(inner)] for key, inner in value.items()]}
        if not self._knows(value):
            raise InputError(f"step: no {type(value).__name__} travels to another machine")
        names = type(value).model_fields if isinstance(value, Schema) else [f.name for f in dataclasses.fields(value)]
        return {
            "class": _name(type(value)),
            "fields": {field: self.to_json(getattr(value, field)) for field in names},
        }

    def from_json(self, value: Any) -> Any:
        """Back.

        Raises:
            InputError: nothing that ``to_json`` makes.
        """
        try:
            return self._back(value)
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"step: not readable: {type(error).__name__}: {error}") from error

    def _knows(self, value: Any) -> bool:
        return self._classes.get(_name(type(value))) is type(value)

    def _back(self, value: Any) -> Any:
        match value:
            case {"enum": name, "value": inner}:
                return self._named(name, Enum)(inner)
            case {"array": dtype, "shape": shape, "data": data} if dtype in _DTYPES:
                return np.frombuffer(base64.b64decode(data, validate=True), dtype).reshape(shape)
            case {"path": text}:
                return Path(text)
            case {"tuple": inner}:
                return tuple(map(self._back, inner))
            case {"dict": rows}:
                return {key: self._back(inner) for key, inner in rows}
            case {"class": name, "fields": fields}:
                return self._named(name, object)(**{field: self._back(inner) for field, inner in fields.items()})
            case list():
                return [self._back(inner) for inner in value]
            case None | bool() | int() | float() | str():
                return value
        raise ValueError(f"unknown object {str(value)[:64]}")

    def _named(self, name: str, base: type[Any]) -> type[Any]:
        found = self._classes[name]
        if not issubclass(found, base):
            raise TypeError(f"{name} is no {base.__name__}")
        return found


def _name(cls: type[Any]) -> str:
    """Plug-ins of two distributions may use one class name."""
    return f"{cls.__module__}.{cls.__qualname__}"


def _travels(cls: type[Any]) -> bool:
    return dataclasses.is_dataclass(cls) or issubclass(cls, Schema | Enum)


def _annotations(cls: type[Any]) -> list[Any]:
    """Of the fields of a dataclass or model."""
    if issubclass(cls, Schema):
        return [part for field in cls.model_fields.values() for part in (field.annotation, *field.metadata)]
    hints = get_type_hints(cls, include_extras=True)
    return [hints[field.name] for field in dataclasses.fields(cls)]
