"""Loads a robot's configuration: YAML merged along ``include:``, validated, with the robot's calibration on top.

Every value remembers its file and line; every complaint is one line with file, line, key and what was expected.
YAML is read as version 1.2: ``true`` and ``false`` are the only booleans, ``1e-3`` is a number, ``0o17`` is octal.
"""

import difflib
import json
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, TypeAdapter, ValidationError
from pydantic_core import ErrorDetails
from ruamel.yaml.error import YAMLError
from ruamel.yaml.nodes import Node, ScalarNode, SequenceNode

from monstertruck_runtime.endpoints import emulated_ports
from monstertruck_runtime.errors import ConfigError
from monstertruck_runtime.plugins import kind_of, models_in
from monstertruck_schemas.base import Schema
from monstertruckd.config.calibration import CalibrationStore, Result, WizardName, put_values
from monstertruckd.config.edit import YamlText, node_kind, reader
from monstertruckd.config.live import SavedSettings
from monstertruckd.config.migrate import OLDEST, VERSION, bring_up_to_date
from monstertruckd.config.truck import ROBOT, TruckConfig

Key = tuple[str | int, ...]
S = TypeVar("S", bound=Schema)
T = TypeVar("T", bound=TruckConfig)

PLACEHOLDER = "{robot}"
"""In texts, for the robot's name."""
MOST_VALUES = 20_000
"""Of one file; a full configuration has a few hundred."""
MOST_MISTAKES = 50
"""Named at once."""
YAML_1_1 = ("yes", "no", "on", "off")
"""Booleans of YAML 1.1 in lower case: text since 1.2."""


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
    files: list[Path] = field(default_factory=list)
    """The file itself, then every file it depends on by relative names; resolved."""
    calibration: Path | None = None
    """Calibration file whose values replace those of the configuration, if there is one."""

    def origin(self, key: Key) -> Origin | None:
        """Origin of ``key``, or of its nearest parent that has one."""
        for length in range(len(key), -1, -1):
            if key[:length] in self.origins:
                return self.origins[key[:length]]
        return None


def load_truck(path: Path) -> tuple[TruckConfig, Tree]:
    """The configuration at ``path`` with the saved settings and the calibration of its robot.

    Raises:
        ConfigError: one line per mistake, in the file, in the saved settings or in the calibration.
    """
    return calibrated(*load_config(path, TruckConfig))


def load_config(path: Path, model: type[S]) -> tuple[S, Tree]:
    """Read, merge and validate ``path``, without calibration.

    Returns:
        The frozen configuration, and the tree with every value's origin.

    Raises:
        ConfigError: one line per mistake, each naming file, line, key and expectation.
    """
    return validated(load_tree(path), path, model)


def resolved(config: Schema) -> dict[str, Any]:
    """The whole configuration as plain data, defaults included."""
    dumped: dict[str, Any] = TypeAdapter(type(config)).dump_python(config, mode="json")
    return dumped


def calibrated(config: T, tree: Tree) -> tuple[T, Tree]:
    """The configuration with the settings that were saved while the robot ran and the newest calibration, and the tree.

    The tree has each value's origin. Both are validated together, as they were when they were saved: what bounds a
    setting may be a calibrated value.

    Raises:
        ConfigError: one of their files is damaged, or of another truck, or the configuration refuses a value.
    """
    saved = SavedSettings(config.state_directory, config.robot)
    settings = saved.values()
    store = CalibrationStore(config.calibration_folder, config.robot)
    path = store.newest()
    if path is None and not settings:
        return config, tree
    data, origins, sources = config.model_dump(), dict(tree.origins), []
    if settings:
        saved.put(settings, config, data)
        origins |= {tuple(key.split(".")): Origin(saved.path, line) for key, (_, line) in settings.items()}
        sources.append(str(saved.path))
    if path is not None:
        results = store.load(path).results
        put_values(data, results.values(), path)
        origins |= _calibrated_origins(results, load_tree(path).origins)
        sources.append(str(path))
    try:
        changed = type(config).model_validate(data)
    except ValidationError as error:
        detail = error.errors(include_url=False)[0]
        where = ".".join(map(str, detail["loc"]))
        text = detail["msg"].removeprefix("Value error, ")
        raise ConfigError(f"{' with '.join(sources)}: {where}{': ' if where else ''}{text}") from error
    return changed, Tree(tree.data, origins, tree.files, calibration=path)


def _calibrated_origins(results: Mapping[WizardName, Result], lines: Mapping[Key, Origin]) -> dict[Key, Origin]:
    return {
        tuple(estimate.key.split(".")): lines["results", wizard, "estimates", index, "value"]
        for wizard, result in results.items()
        for index, estimate in enumerate(result.estimates)
        if estimate.key is not None
    }


# YAML


def load_tree(path: Path) -> Tree:
    """Read ``path`` and everything it includes; later values win over included ones, mappings merge.

    ``include`` is a file name or a list of them, relative to the including file. Keys of older versions are read under
    their present names; the files stay as they are. In texts ``{robot}`` stands for the robot's name, so that robots
    that share a file have ports and folders of their own.

    Raises:
        ConfigError: a file is missing, is not YAML, repeats a key or includes itself.
    """
    tree = _load(path, (), None)
    robot = tree.data.get("robot", ROBOT)
    if isinstance(robot, str):
        tree.data = {key: value if key == "robot" else _named(value, robot) for key, value in tree.data.items()}
    return tree


def _named(value: Any, robot: str) -> Any:
    """The value with the robot's name in its texts."""
    match value:
        case str():
            return value.replace(PLACEHOLDER, robot)
        case dict():
            return {key: _named(inner, robot) for key, inner in value.items()}
        case list():
            return [_named(inner, robot) for inner in value]
        case _:
            return value


def _load(path: Path, including: tuple[Path, ...], inherited: int | None) -> Tree:
    if path.resolve() in including:
        raise ConfigError(f"{path}: includes itself through {' > '.join(map(str, including))}")
    own, text = Tree({}), YamlText.read(path)
    version = bring_up_to_date(text, inherited)
    if text.root is not None:
        own.data = _build(text.root, _Builder(path, own.origins), ())
    return _with_includes(own, path, including, version)


def _with_includes(own: Tree, path: Path, including: tuple[Path, ...], version: int | None) -> Tree:
    included = own.data.pop("include", [])
    where = own.origins.get(("include",))
    names = [included] if isinstance(included, str) else included
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ConfigError(f"{where}: include: expected a file name or a list of file names")
    merged = Tree({}, files=[path.resolve()])
    for name in names:
        target = Path(os.path.normpath(path.parent / name))
        if not target.is_file():
            raise ConfigError(f"{where}: include: no such file: {target}")
        tree = _load(target, (*including, path.resolve()), version)
        _merge(merged, tree)
        merged.files += [] if Path(name).is_absolute() else tree.files
    _merge(merged, own)
    merged.origins = {key: origin for key, origin in merged.origins.items() if key[:1] != ("include",)}
    return merged


def _merge(base: Tree, top: Tree) -> None:
    """Lay ``top`` over ``base``, values and origins."""
    replaced: set[Key] = set()
    _merge_values(base.data, top.data, (), replaced)
    kept = (
        (key, origin)
        for key, origin in base.origins.items()
        if replaced.isdisjoint(key[:length] for length in range(1, len(key) + 1))
    )
    base.origins = dict(kept) | {key: origin for key, origin in top.origins.items() if key}


def _merge_values(below: dict[str, Any], above: dict[str, Any], prefix: Key, replaced: set[Key]) -> None:
    """Collects in ``replaced`` the keys whose whole value comes from ``above``."""
    for name, value in above.items():
        key = (*prefix, name)
        if isinstance(value, dict) and isinstance(below.get(name), dict) and not _other_kind(below[name], value):
            _merge_values(below[name], value, key, replaced)
        else:
            below[name] = value
            replaced.add(key)


def _other_kind(below: dict[str, Any], above: dict[str, Any]) -> bool:
    """Whether ``above`` chooses another ``kind``, so that the keys of the one ``below`` mean nothing to it."""
    return "kind" in above and above["kind"] != below.get("kind", above["kind"])


@dataclass(slots=True)
class _Builder:
    """Of one file."""

    path: Path
    origins: dict[Key, Origin]
    scalar: Callable[[Node], Any] = field(default_factory=lambda: reader().constructor.construct_object)
    """Gives the value of a scalar node."""
    around: list[Node] = field(default_factory=list)
    """Nodes in which the present one lies."""
    count: int = 0
    """Values built."""


def _build(node: Node, builder: _Builder, key: Key) -> Any:
    where = Origin(builder.path, node.start_mark.line + 1)
    builder.origins.setdefault(key, where)
    builder.count += 1
    if builder.count > MOST_VALUES:
        raise ConfigError(f"{where}: more than {MOST_VALUES} values, those that aliases repeat included")
    if node in builder.around:
        raise ConfigError(f"{where}: an alias in its own anchor: the value would contain itself")
    if isinstance(node, ScalarNode):
        try:
            return builder.scalar(node)
        except (YAMLError, ValueError) as error:
            raise ConfigError(f"{where}: cannot read the value: {error}") from error
    builder.around.append(node)
    built: Any
    if isinstance(node, SequenceNode):
        built = [_build(item, builder, (*key, index)) for index, item in enumerate(node.value)]
    else:
        built = _build_mapping(node, builder, key)
    builder.around.pop()
    return built


def _build_mapping(node: Node, builder: _Builder, key: Key) -> dict[str, Any]:
    result: dict[str, Any] = {}
    for name_node, value_node in node.value:
        where = Origin(builder.path, name_node.start_mark.line + 1)
        name = name_node.value
        if not isinstance(name_node, ScalarNode):
            raise ConfigError(f"{where}: a key must be plain text, found {node_kind(name_node)}")
        if name in result:
            raise ConfigError(f"{where}: {name}: given twice in one section")
        builder.origins[*key, name] = where
        result[name] = _build(value_node, builder, (*key, name))
    return result


# Validation


def validated(tree: Tree, path: Path, model: type[S]) -> tuple[S, Tree]:
    """Validate what was read and merged from ``path``; see ``load_config``."""
    version = tree.data.get("version")
    if version != VERSION:
        origin = tree.origin(("version",)) or f"{path}:1"
        raise ConfigError(f"{origin}: version: expected {OLDEST} to {VERSION}, found {version!r}")
    _locate_files(tree, getattr(model, "FILE_KEYS", ()))
    _give_ports(tree.data)
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
        if origin.file.resolve() in tree.files and not Path(name).is_absolute():
            tree.files.append(file)


def _give_ports(data: dict[str, Any]) -> None:
    """Hang the devices of an emulated robot that name no port where `simulate` makes them: in a folder of the user."""
    devices = data.get("devices")
    if data.get("sim") is None or not isinstance(devices, dict):
        return
    folder = emulated_ports(str(data.get("robot", ROBOT)))
    for role, device in devices.items():
        if isinstance(device, dict) and device.get("port") is None:
            device["port"] = {"path": str(folder / str(role))}


def _explain(tree: Tree, path: Path, model: type[Schema], error: ValidationError) -> Iterator[str]:
    details = error.errors(include_url=False)
    for detail in details[:MOST_MISTAKES]:
        key = _data_key(tree.data, detail["loc"])
        origin = tree.origin(key) or f"{path}:1"
        dotted = ".".join(map(str, key)) or "configuration"
        yield f"{origin}: {dotted}: {_sentence(detail, model, key)}"
    if more := details[MOST_MISTAKES:]:
        yield f"{path}: {len(more)} more mistakes"


def _sentence(detail: ErrorDetails, model: type[Schema], key: Key) -> str:
    if detail["type"] == "extra_forbidden":
        known = _field_names(model, key[:-1], detail)
        close = difflib.get_close_matches(str(key[-1]), known, 1)
        return f"unknown key (did you mean {close[0]}?)" if close else f"unknown key; known here: {', '.join(known)}"
    if detail["type"] == "missing":
        return "missing; it has no default"
    if detail["type"] == "union_tag_invalid":
        return f"no kind {detail['ctx']['tag']!r}; expected one of {detail['ctx']['expected_tags']}"
    message = detail["msg"].removeprefix("Value error, ")
    message = message[:1].lower() + message[1:]
    if detail["type"] == "value_error":
        return message
    found = detail["input"]
    text = f"{message}, found {found!r}" if not isinstance(found, dict | list) else message
    if detail["type"] == "bool_type" and found in YAML_1_1:
        text += ": write true or false"
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


def _reach(model: type[BaseModel], key: Key) -> list[type[BaseModel]]:
    """All models that may describe the mapping at ``key``."""
    here: list[type[BaseModel]] = [model]
    for part in key:
        if isinstance(part, int):
            continue
        here = [
            inner for outer in here if part in outer.model_fields for inner in models_in(outer.model_fields[part])
        ] or here
    return here


def _field_names(model: type[BaseModel], key: Key, detail: ErrorDetails) -> list[str]:
    kinds = [part for part in detail["loc"] if isinstance(part, str)]
    candidates = _reach(model, key)
    chosen = [model for model in candidates if kind_of(model) in kinds] or candidates
    return sorted({name for candidate in chosen for name in candidate.model_fields})


def _description(model: type[BaseModel], key: Key) -> str | None:
    if not key or isinstance(key[-1], int):
        return None
    for candidate in _reach(model, key[:-1]):
        info = candidate.model_fields.get(key[-1])
        if info is not None and info.description:
            return info.description.split("\n")[0].rstrip(".")
    return None
