"""Typed validation of a YAML tree: every complaint is one line with file, line, key and what was expected."""

import difflib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, TypeAdapter, ValidationError
from pydantic_core import ErrorDetails

from monstertruck_runtime.errors import ConfigError
from monstertruck_schemas.base import Schema
from monstertruckd.config.yaml_tree import Key, Tree, load_tree

S = TypeVar("S", bound=Schema)

VERSION = 1


def load_config(path: Path, model: type[S]) -> tuple[S, Tree]:
    """Read, merge and validate ``path``.

    Returns:
        The frozen configuration, and the tree with every value's origin.

    Raises:
        ConfigError: one line per mistake, each naming file, line, key and expectation.
    """
    return validated(load_tree(path), path, model)


def validated(tree: Tree, path: Path, model: type[S]) -> tuple[S, Tree]:
    """Validate what was read and merged from ``path``; see ``load_config``."""
    version = tree.data.get("version")
    if version != VERSION:
        origin = tree.origin(("version",)) or f"{path}:1"
        older = isinstance(version, int) and 0 <= version < VERSION
        advice = f"; `monstertruckd config migrate {path}` brings it up to date" if older else ""
        raise ConfigError(f"{origin}: version: expected {VERSION}, found {version!r}{advice}")
    _locate_files(tree, getattr(model, "FILE_KEYS", ()))
    try:
        text = json.dumps(tree.data)
    except TypeError as error:
        raise ConfigError(f"{path}: holds a value that is neither text, number, list nor mapping: {error}") from error
    except ValueError as error:
        raise ConfigError(f"{path}: {error}") from error
    try:
        return model.model_validate_json(text), tree
    except ValidationError as error:
        raise ConfigError("\n".join(_explain(tree, path, model, error))) from error


def _locate_files(tree: Tree, keys: tuple[tuple[str, ...], ...]) -> None:
    """Make the values at ``keys`` absolute, relative to the file that says them."""
    for key in keys:
        section: Any = tree.data
        for part in key[:-1]:
            section = section.get(part) if isinstance(section, dict) else None
        name = section.get(key[-1]) if isinstance(section, dict) else None
        if not isinstance(name, str):
            continue
        origin = tree.origins[key]
        file = (origin.file.parent / name).resolve()
        if not file.is_file():
            raise ConfigError(f"{origin}: {'.'.join(key)}: no such file: {file}")
        section[key[-1]] = str(file)


def _explain(tree: Tree, path: Path, model: type[Schema], error: ValidationError) -> Iterator[str]:
    for detail in error.errors(include_url=False):
        key = _data_key(tree.data, detail["loc"])
        origin = tree.origin(key) or f"{path}:1"
        dotted = ".".join(map(str, key)) or "configuration"
        yield f"{origin}: {dotted}: {_sentence(detail, model, key)}"


def _sentence(detail: ErrorDetails, model: type[Schema], key: Key) -> str:
    if detail["type"] == "extra_forbidden":
        known = _field_names(model, key[:-1], detail)
        close = difflib.get_close_matches(str(key[-1]), known, 1)
        return f"unknown key (did you mean {close[0]}?)" if close else f"unknown key; known here: {', '.join(known)}"
    if detail["type"] == "missing":
        return "missing; it has no default"
    message = detail["msg"].removeprefix("Value error, ")
    message = message[:1].lower() + message[1:]
    if detail["type"] == "value_error":
        return message
    found = detail["input"]
    text = f"{message}, found {found!r}" if not isinstance(found, dict | list) else message
    meaning = _description(model, key)
    return f"{text} ({meaning})" if meaning else text


def _data_key(data: Any, loc: tuple[int | str, ...]) -> Key:
    """Pydantic's location without the parts that name union members instead of keys of the data."""
    key: list[str | int] = []
    for index, part in enumerate(loc):
        last = index == len(loc) - 1
        if isinstance(data, dict) and (part in data or last):
            key.append(part)
            data = data.get(part)
        elif isinstance(data, list) and isinstance(part, int) and part < len(data):
            key.append(part)
            data = data[part]
    return tuple(key)


def _models(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in get_args(annotation):
        yield from _models(argument)


def _reach(model: type[BaseModel], key: Key) -> list[type[BaseModel]]:
    """All models that may describe the mapping at ``key``."""
    here: list[type[BaseModel]] = [model]
    for part in key:
        if isinstance(part, int):
            continue
        here = [
            inner
            for outer in here
            if part in outer.model_fields
            for inner in _models(outer.model_fields[part].annotation)
        ] or here
    return here


def _field_names(model: type[BaseModel], key: Key, detail: ErrorDetails) -> list[str]:
    kinds = [part for part in detail["loc"] if isinstance(part, str)]
    candidates = _reach(model, key)
    chosen = [m for m in candidates if getattr(m.model_fields.get("kind"), "default", None) in kinds] or candidates
    return sorted({name for candidate in chosen for name in candidate.model_fields})


def _description(model: type[BaseModel], key: Key) -> str | None:
    if not key or isinstance(key[-1], int):
        return None
    for candidate in _reach(model, key[:-1]):
        info = candidate.model_fields.get(key[-1])
        if info is not None and info.description:
            return info.description.split("\n")[0].rstrip(".")
    return None


def resolved(config: Schema) -> dict[str, Any]:
    """The whole configuration as plain data, defaults included."""
    dumped: dict[str, Any] = TypeAdapter(type(config)).dump_python(config, mode="json")
    return dumped
