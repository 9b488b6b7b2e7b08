"""Inputs and outputs of steps as JSON, exactly, for another machine: only registered classes are ever built."""

import base64
import dataclasses
from collections.abc import Iterable
from enum import Enum
from pathlib import Path
from typing import Any, Final

import numpy as np

from monstertruck_runtime.errors import InputError
from monstertruck_schemas.base import Schema

_DTYPES: Final = ("float64", "int8", "uint8", "int64")


class StepCodec:
    """Converts trees of registered classes, arrays, tuples, lists, dicts with text keys, paths and scalars.

    Args:
        classes: dataclasses and ``Schema`` models that may travel; enums too.
    """

    def __init__(self, classes: Iterable[type[Any]]) -> None:
        self._classes = {cls.__name__: cls for cls in classes}

    def to_json(self, value: Any) -> Any:
        """The value as what JSON can say.

        Raises:
            InputError: a class that is not registered.
        """
        match value:
            case Enum() if self._knows(value):
                return {"enum": type(value).__name__, "value": value.value}
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
            "class": type(value).__name__,
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
        return self._classes.get(type(value).__name__) is type(value)

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
