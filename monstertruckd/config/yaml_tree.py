"""YAML files as plain data that remember where each value came from, merged along ``include:``."""

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import yaml

from monstertruck_runtime.errors import ConfigError

Key = tuple[str | int, ...]


@dataclass(frozen=True, slots=True)
class Origin:
    """Place of a value in a file."""

    file: Path
    line: int

    def __str__(self) -> str:
        return f"{self.file}:{self.line}"


@dataclass(slots=True)
class Tree:
    """Merged data and the origin of every key in it."""

    data: dict[str, Any]
    origins: dict[Key, Origin] = field(default_factory=dict)
    calibration: Path | None = None
    """Calibration file whose values lie over those of the configuration, if there is one."""

    def origin(self, key: Key) -> Origin | None:
        """Origin of ``key``, or of its nearest parent that has one."""
        for length in range(len(key), -1, -1):
            if key[:length] in self.origins:
                return self.origins[key[:length]]
        return None


def load_tree(path: Path) -> Tree:
    """Read ``path`` and everything it includes; later values win over included ones, mappings merge.

    ``include`` is a file name or a list of them, relative to the including file.

    Raises:
        ConfigError: a file is missing, is not YAML, repeats a key or includes itself.
    """
    return _load(path, ())


def _load(path: Path, including: tuple[Path, ...]) -> Tree:
    if path.resolve() in including:
        raise ConfigError(f"{path}: includes itself through {' > '.join(map(str, including))}")
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
        raise ConfigError(f"{path}: cannot be read: {reason}") from error
    try:
        node = yaml.compose(text, Loader=yaml.SafeLoader)
    except yaml.MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 1
        raise ConfigError(f"{path}:{line}: not valid YAML: {error.problem}") from error
    own = Tree({})
    if node is not None:
        if not isinstance(node, yaml.MappingNode):
            raise ConfigError(f"{path}:1: expected a mapping of sections, found {_kind(node)}")
        own.data = _build(node, path, (), own.origins)
    return _with_includes(own, path, including)


def _with_includes(own: Tree, path: Path, including: tuple[Path, ...]) -> Tree:
    included = own.data.pop("include", [])
    where = own.origins.get(("include",))
    names = [included] if isinstance(included, str) else included
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ConfigError(f"{where}: include: expected a file name or a list of file names")
    merged = Tree({})
    for name in names:
        target = Path(os.path.normpath(path.parent / name))
        if not target.is_file():
            raise ConfigError(f"{where}: include: no such file: {target}")
        _merge(merged, _load(target, (*including, path.resolve())), ())
    _merge(merged, own, ())
    merged.origins = {key: origin for key, origin in merged.origins.items() if key[:1] != ("include",)}
    return merged


def _merge(base: Tree, top: Tree, prefix: Key) -> None:
    below, above = _at(base.data, prefix), _at(top.data, prefix)
    for name, value in above.items():
        key = (*prefix, name)
        if isinstance(value, dict) and isinstance(below.get(name), dict):
            _merge(base, top, key)
        else:
            below[name] = value
            base.origins = {k: o for k, o in base.origins.items() if k[: len(key)] != key}
            base.origins |= {k: o for k, o in top.origins.items() if k[: len(key)] == key}
        base.origins[key] = top.origins[key]


def _at(data: Any, key: Key) -> dict[str, Any]:
    for part in key:
        data = data[part]
    return cast("dict[str, Any]", data)


def _build(node: yaml.Node, path: Path, key: Key, origins: dict[Key, Origin]) -> Any:
    origins.setdefault(key, Origin(path, node.start_mark.line + 1))
    if isinstance(node, yaml.MappingNode):
        return _build_mapping(node, path, key, origins)
    if isinstance(node, yaml.SequenceNode):
        return [_build(item, path, (*key, index), origins) for index, item in enumerate(node.value)]
    try:
        return yaml.SafeLoader("").construct_object(node)
    except (yaml.YAMLError, ValueError) as error:
        raise ConfigError(f"{path}:{node.start_mark.line + 1}: cannot read the value: {error}") from error


def _build_mapping(node: yaml.MappingNode, path: Path, key: Key, origins: dict[Key, Origin]) -> dict[str, Any]:
    result: dict[str, Any] = {}
    for name_node, value_node in node.value:
        line = name_node.start_mark.line + 1
        name = name_node.value
        if not isinstance(name_node, yaml.ScalarNode):
            raise ConfigError(f"{path}:{line}: a key must be plain text, found {_kind(name_node)}")
        if name in result:
            raise ConfigError(f"{path}:{line}: {name}: given twice in one section")
        origins[*key, name] = Origin(path, line)
        result[name] = _build(value_node, path, (*key, name), origins)
    return result


def _kind(node: yaml.Node) -> str:
    return {"MappingNode": "a mapping", "SequenceNode": "a list"}.get(type(node).__name__, "a plain value")
