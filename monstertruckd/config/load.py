"""Loads a robot's configuration: YAML merged along ``include:``, validated, with saved settings and calibration on top.

Every value keeps its file and line; every error is one line with file, line, key and expected value. YAML is read as
version 1.2: ``true`` and ``false`` are the only booleans, ``1e-3`` is a number, ``0o17`` is octal.
"""

import difflib
import io
import json
import os
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Final, Literal, Self, TypeVar, get_args, get_origin

from pydantic import BaseModel, TypeAdapter, ValidationError
from pydantic_core import ErrorDetails
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.nodes import CollectionNode, MappingNode, Node, ScalarNode, SequenceNode
from ruamel.yaml.reader import ReaderError

from monstertruck_runtime.endpoints import emulated_ports
from monstertruck_runtime.errors import ConfigError, UnusableFileError
from monstertruck_runtime.map_folders import SAVES, folder_of
from monstertruck_runtime.map_folders import YAML as MAP_YAML
from monstertruck_runtime.outside import reading
from monstertruck_runtime.plugins import models_in
from monstertruck_runtime.small_files import make_folder, replace_file, require_file
from monstertruck_runtime.yaml_files import LARGEST_YAML, bounded_yaml, yaml_problem
from monstertruck_schemas.base import LiveValue, Schema, field_docs, live_settings
from monstertruck_schemas.entry_points import left_out
from monstertruckd.config.calibration import CalibrationStore, Result, WizardName, in_order, put_values, unused
from monstertruckd.config.real_ports import mixed
from monstertruckd.config.renamed import RENAMED
from monstertruckd.config.truck import ROBOT, TruckConfig

Key = tuple[str | int, ...]
S = TypeVar("S", bound=Schema)
T = TypeVar("T", bound=TruckConfig)

PLACEHOLDER = "{robot}"
"""Placeholder for the robot's name in values."""
HEAD: Final = (
    "Settings changed while the robot ran (monstertruckd set --save); they replace those of the configuration."
)
YAML_1_1 = ("yes", "no", "on", "off")
"""Lower-case booleans of YAML 1.1: text since 1.2."""


@dataclass(frozen=True, slots=True)
class Origin:
    """Position of a value in a file."""

    file: Path
    line: int

    def __str__(self) -> str:
        return f"{self.file}:{self.line}"


@dataclass(slots=True)
class Tree:
    """Merged data, and the origin of every key."""

    data: dict[str, Any]
    origins: dict[Key, Origin] = field(default_factory=dict)
    files: list[Path] = field(default_factory=list)
    """The file itself, then all files referenced by relative names; resolved."""
    maps: list[Path] = field(default_factory=list)
    """Folders and YAML files of maps referenced by relative names."""
    calibration: Path | None = None
    """Calibration file whose values replace the configuration's, if any."""
    unused: list[str] = field(default_factory=list)
    """Keys of the calibration file without a place in the configuration."""

    def origin(self, key: Key) -> Origin | None:
        """Origin of ``key``, or of its closest parent with an origin."""
        for length in range(len(key), -1, -1):
            if key[:length] in self.origins:
                return self.origins[key[:length]]
        return None


def load_truck(path: Path) -> tuple[TruckConfig, Tree]:
    """Load the configuration at ``path`` with its robot's saved settings and calibration.

    Raises:
        ConfigError: one line per error in the file, the saved settings or the calibration.
    """
    return calibrated(*load_config(path, TruckConfig))


def load_config(path: Path, model: type[S]) -> tuple[S, Tree]:
    """Read, merge and validate ``path``, without calibration.

    Returns:
        The frozen configuration, and the tree with the origin of every value.

    Raises:
        ConfigError: one line per error, with file, line, key and expected value.
    """
    return validated(load_tree(path), path, model)


def resolved(config: Schema) -> dict[str, Any]:
    """Return the complete configuration as plain data, including defaults."""
    dumped: dict[str, Any] = TypeAdapter(type(config)).dump_python(config, mode="json")
    return dumped


# Saved settings and calibration


def calibrated(config: T, tree: Tree, without: Collection[Path] = ()) -> tuple[T, Tree]:
    """Return the configuration with saved live settings and the latest calibration, and the tree.

    The tree contains each value's origin. Settings and calibration are validated together, as when they were saved,
    because a calibrated value may bound a setting.

    Args:
        config: configuration without settings and calibration.
        tree: tree of ``config``.
        without: files of settings or calibration to ignore.

    Raises:
        UnusableFileError: one of their files is damaged, or the configuration rejects a value.
        ConfigError: the calibration is of another truck, or its folder cannot be read.
    """
    saved = SavedSettings(config.state_directory, config.robot)
    settings = {} if saved.path in without else saved.values()
    store = CalibrationStore(config.calibration_folder, config.robot)
    path = next((path for path in reversed(store.files()) if path not in without), None)
    if path is None and not settings:
        return config, tree
    data, origins, sources, left = config.model_dump(), dict(tree.origins), list[str](), list[str]()
    if settings:
        saved.put(settings, config, data)
        origins |= {tuple(key.split(".")): Origin(saved.path, line) for key, (_, line) in settings.items()}
        sources.append(str(saved.path))
    results: Mapping[WizardName, Result] = {}
    if path is not None:
        results = store.load(path).results
        try:
            put_values(data, results.values(), path)
            left = unused(config, results.values())
            origins |= _calibrated_origins(results, load_tree(path).origins)
        except ConfigError as error:
            raise UnusableFileError(path, str(error)) from error
        sources.append(str(path))
    try:
        changed = type(config).model_validate(data)
    except ValidationError as error:
        refused = saved.path
        if path is not None and (not settings or not _is_valid(config, results.values(), path)):
            refused = path
        raise UnusableFileError(refused, f"{' with '.join(sources)}: {_first_mistake(data, error)}") from error
    return changed, replace(tree, origins=origins, calibration=path, unused=left)


def _is_valid(config: TruckConfig, results: Collection[Result], path: Path) -> bool:
    """Return whether the configuration accepts a calibration without saved settings."""
    data = config.model_dump()
    put_values(data, results, path)
    try:
        type(config).model_validate(data)
    except ValidationError:
        return False
    return True


def _calibrated_origins(results: Mapping[WizardName, Result], lines: Mapping[Key, Origin]) -> dict[Key, Origin]:
    return {
        tuple(estimate.key.split(".")): lines["results", result.wizard, "estimates", index, "value"]
        for result, index, estimate in in_order(results.values())
        if estimate.key is not None
    }


class SavedSettings:
    """File of live settings kept across restarts; its methods may block for file access.

    Keys of any version are read under their current names; the next save writes these.

    Args:
        folder: the robot's ``state_directory``; the file is created when the first setting is saved.
        robot: name of the robot.
    """

    def __init__(self, folder: Path, robot: str) -> None:
        self.path = folder / f"settings-{robot}.yaml"

    def values(self) -> dict[str, tuple[LiveValue, int]]:
        """Saved values by dotted key, each with its line; empty without a file.

        Raises:
            UnusableFileError: the file is damaged; the message names the line.
        """
        origins = dict[Key, Origin]()
        try:
            self.path.lstat()
        except FileNotFoundError:
            return {}
        except OSError:
            pass  # ``YamlText`` explains why
        try:
            root = self._text().root
            content = {} if root is None else _build(root, _Builder(self.path, origins), ())
        except ConfigError as error:
            raise UnusableFileError(self.path, str(error)) from error
        return {".".join(key): (value, origins[key].line) for key, value in _leaves(content, ())}

    def put(self, values: Mapping[str, tuple[LiveValue, int]], config: TruckConfig, data: dict[str, Any]) -> None:
        """Merge saved values into a configuration's data before validation.

        Raises:
            UnusableFileError: a value is not a live setting of the configuration; the message names the line.
        """
        known = {setting.key for setting in live_settings(config)}
        for key, (_, line) in values.items():
            if key not in known:
                wrong = "cannot be changed while the robot runs; remove it from this file"
                raise UnusableFileError(self.path, f"{self.path}:{line}: {key}: {wrong}")
        put_settings(data, {key: value for key, (value, _) in values.items()})

    def save(self, values: Mapping[str, LiveValue]) -> None:
        """Add or replace settings; the rest of the file, including comments, is kept.

        Raises:
            ConfigError: the file is damaged or cannot be written; nothing is changed.
        """
        content = _with_comments(self._text().text) if self.values() else None
        if content is None:
            content = CommentedMap()
            content.yaml_set_start_comment(HEAD)
        for key, value in values.items():
            *way, last = key.split(".")
            section = content
            for part in way:
                section = section.setdefault(part, CommentedMap())
                if not isinstance(section, CommentedMap):
                    raise ConfigError(f"{self.path}: {part}: expected a mapping of settings")
            section[last] = value
        out = io.StringIO()
        YAML(typ="rt", pure=True).dump(content, out)
        try:
            make_folder(self.path.parent)
            replace_file(self.path, out.getvalue())
        except OSError as error:
            raise ConfigError(f"{self.path}: settings cannot be saved: {error.strerror}") from error

    def _text(self) -> "YamlText":
        text = YamlText.read(self.path)
        bring_up_to_date(text, OLDEST)
        return text


def _with_comments(text: str) -> Any:
    return YAML(typ="rt", pure=True).load(text)


def _leaves(value: Any, key: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], LiveValue]]:
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from _leaves(inner, (*key, name))
    else:
        yield key, value


def put_settings(data: dict[str, Any], values: Mapping[str, Any]) -> None:
    """Merge live settings, by dotted key, into a configuration's data before validation."""
    for key, value in values.items():
        section = data
        *way, last = key.split(".")
        for part in way:
            section = section[part]
        section[last] = value


# Files that include others


def load_tree(path: Path) -> Tree:
    """Read ``path`` and everything it includes; later values win over included ones, mappings merge.

    ``include`` is a file name or a list of them, relative to the including file. Keys of older versions are read under
    their current names; files are not modified. ``{robot}`` in texts stands for the robot's name, so that robots that
    share a file have separate ports and folders.

    Raises:
        ConfigError: a file is missing, is not YAML, repeats a key or includes itself.
    """
    tree = _load(path, (), None)
    robot = tree.data.get("robot", ROBOT)
    if isinstance(robot, str):
        tree.data = {key: value if key == "robot" else _named(value, robot) for key, value in tree.data.items()}
    return tree


def _named(value: Any, robot: str) -> Any:
    """Replace the placeholder with the robot's name."""
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
    own, text = Tree({}), YamlText.read(path)
    if path.resolve() in including:
        raise ConfigError(f"{path}: includes itself through {' > '.join(map(str, including))}")
    version = bring_up_to_date(text, inherited)
    if text.root is not None:
        own.data = _build(text.root, _Builder(path, own.origins), ())
    return _with_includes(own, path, including, version)


def included(path: Path, name: str) -> Path:
    """Path of the file ``name`` included by the file ``path``: relative to its folder, with links resolved.

    Contains no ``..`` unless it follows a link to a folder.
    """
    joined = path.parent / name
    short = Path(os.path.normpath(joined))
    return short if os.path.realpath(short) == os.path.realpath(joined) else joined


def _with_includes(own: Tree, path: Path, including: tuple[Path, ...], version: int | None) -> Tree:
    given = own.data.pop("include", [])
    where = own.origins.get(("include",))
    names = [given] if isinstance(given, str) else given
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ConfigError(f"{where}: include: expected a file name or a list of file names")
    merged = Tree({}, files=[path.resolve()])
    for name in names:
        with reading(f"{where}: include", "a file name", ConfigError):
            target = included(path, name)
            there = target.is_file()
        if not there:
            raise ConfigError(f"{where}: include: no such file: {target}")
        tree = _load(target, (*including, path.resolve()), version)
        _merge(merged, tree)
        merged.files += [] if Path(name).is_absolute() else tree.files
    _merge(merged, own)
    merged.origins = {key: origin for key, origin in merged.origins.items() if key[:1] != ("include",)}
    return merged


def _merge(base: Tree, top: Tree) -> None:
    """Merge ``top`` over ``base``: values and origins."""
    replaced: set[Key] = set()
    _merge_values(base.data, top.data, (), replaced)
    kept = (
        (key, origin)
        for key, origin in base.origins.items()
        if replaced.isdisjoint(key[:length] for length in range(1, len(key) + 1))
    )
    base.origins = dict(kept) | {key: origin for key, origin in top.origins.items() if key}


def _merge_values(below: dict[str, Any], above: dict[str, Any], prefix: Key, replaced: set[Key]) -> None:
    """Merge ``above`` into ``below``; collect in ``replaced`` the keys whose complete value comes from ``above``."""
    for name, value in above.items():
        key = (*prefix, name)
        if isinstance(value, dict) and isinstance(below.get(name), dict) and not _other_kind(below[name], value):
            _merge_values(below[name], value, key, replaced)
        else:
            below[name] = value
            replaced.add(key)


def _other_kind(below: dict[str, Any], above: dict[str, Any]) -> bool:
    """Return whether ``above`` chooses another ``kind``, so that the keys ``below`` do not apply."""
    return "kind" in above and above["kind"] != below.get("kind", above["kind"])


@dataclass(slots=True)
class _Builder:
    """Builds the values of one file with their origins."""

    path: Path
    origins: dict[Key, Origin]
    scalar: Callable[[Node], Any] = field(default_factory=lambda: reader().constructor.construct_object)
    """Constructs the value of a scalar node."""
    around: list[Node] = field(default_factory=list)
    """Nodes that contain the current node."""
    count: int = 0
    """Number of values built."""


def _build(node: Node, builder: _Builder, key: Key) -> Any:
    where = Origin(builder.path, node.start_mark.line + 1)
    builder.origins.setdefault(key, where)
    builder.count += 1
    most_values = 20_000  # maximum number of values in one file; a full configuration has a few hundred
    if builder.count > most_values:
        raise ConfigError(f"{where}: more than {most_values} values, including those repeated by aliases")
    if node in builder.around:
        raise ConfigError(f"{where}: an alias in its own anchor: the value would contain itself")
    if isinstance(node, ScalarNode):
        try:
            return builder.scalar(node)
        except (YAMLError, ValueError, KeyError) as error:
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


# YAML text


def reader() -> YAML:
    """Return a reader for one document of plain data; ``_build`` bounds the expansion of aliases."""
    # 5_000: maximum number of keys and values in one file, read in a quarter of a second; a full configuration has a
    # few hundred
    return bounded_yaml(5_000, expand=False)


def node_kind(node: Node) -> str:
    """Description of a node for error messages."""
    kinds = ((MappingNode, "a mapping"), (SequenceNode, "a list"))
    return next((name for kind, name in kinds if isinstance(node, kind)), "a plain value")


def _compose(text: str, path: Path) -> MappingNode | None:
    _check_directives(text, path)
    try:
        node = reader().compose(text)
    except ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        raise ConfigError(
            f"{path}:{line}: not valid YAML: character {chr(error.character)!r} is not allowed"
        ) from error
    except MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 1
        raise ConfigError(f"{path}:{line}: {yaml_problem(error)}") from error
    except YAMLError as error:
        raise ConfigError(f"{path}:1: not valid YAML: {error}") from error
    if node is not None and not isinstance(node, MappingNode):
        raise ConfigError(f"{path}:1: expected a mapping of sections, found {node_kind(node)}")
    return node


def _check_directives(text: str, path: Path) -> None:
    for number, line in enumerate(text.removeprefix("\ufeff").splitlines(), 1):
        words = line.split()
        if words and not line.startswith(("%", "#")):
            return
        if words[:1] == ["%YAML"] and words[1:2] != ["1.2"]:
            raise ConfigError(f"{path}:{number}: {line.strip()}: expected YAML 1.2; remove this line")


def _meant(path: Path) -> Path | None:
    """Return a configuration with a similar name, in the same folder or among the shipped ones."""
    for folder in (path.parent, path.parent / "configs"):
        files = {file.name: file for file in sorted(folder.glob("*.yaml"))}
        for name in difflib.get_close_matches(path.name, files, 1):
            return files[name]
    return None


class YamlText:
    """A YAML mapping, or nothing, as text.

    Args:
        text: content.
        path: file of the text, for error messages.

    Raises:
        ConfigError: the text is not YAML 1.2, is nested too deeply, or is not a mapping.
    """

    def __init__(self, text: str, path: Path) -> None:
        self.path = path
        self._set(text)

    @classmethod
    def read(cls, path: Path) -> Self:
        """Content of a file.

        Raises:
            ConfigError: the file cannot be read, is longer than ``LARGEST_YAML``, or is refused as described above.
        """
        try:
            require_file(path, LARGEST_YAML)
            return cls(path.read_text(encoding="utf-8"), path)
        except (OSError, UnicodeDecodeError) as error:
            reason = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
            meant = _meant(path) if isinstance(error, FileNotFoundError) else None
            hint = f" (did you mean {meant}?)" if meant else ""
            raise ConfigError(f"{path}: cannot be read: {reason}{hint}") from error

    def _set(self, text: str) -> None:
        self.text = text
        self.root = _compose(text, self.path)

    def node(self, *key: str) -> Node | None:
        """Return the node at ``key``, or None."""
        return next((value for _, value in self._pairs(key)), None)

    def value(self, *key: str) -> str | None:
        """Return the plain value at ``key`` as written, without quotes; None for anything else."""
        node = self.node(*key)
        return node.value if isinstance(node, ScalarNode) else None

    def replace(self, key: tuple[str, ...], text: str) -> bool:
        """Replace the value at ``key`` with ``text``; return False if there is no value."""
        node = self.node(*key)
        if node is None:
            return False
        self._set(self.text[: node.start_mark.index] + text + self.text[_end(node) :])
        return True

    def rename(self, key: tuple[str, ...], name: str) -> bool:
        """Rename the last part of ``key`` (``*`` matches any name); return False if the key is missing."""
        text = self.text
        places = {(node.start_mark.index, node.end_mark.index) for node, _ in self._pairs(key)}
        for start, end in sorted(places, reverse=True):
            quoted = json.dumps(name) if text[start] in "\"'" else name
            text = text[:start] + quoted + text[end:]
        if places:
            self._set(text)
        return bool(places)

    def _pairs(self, key: tuple[str, ...]) -> list[tuple[Node, Node]]:
        """Name and value of all entries that match ``key``."""
        nodes: list[Node | None] = [self.root]
        pairs: list[tuple[Node, Node]] = []
        for part in key:
            sections = [node for node in nodes if isinstance(node, MappingNode)]
            pairs = [pair for section in sections for pair in section.value if part in ("*", pair[0].value)]
            nodes = list(dict.fromkeys(value for _, value in pairs))  # an alias repeats its node
        return pairs


def _end(node: Node) -> int:
    """Index after the node's last character; a block's end mark comes after the blanks and comments that follow it."""
    if isinstance(node, CollectionNode) and not node.flow_style and node.value:
        last = node.value[-1]
        return _end(last[1] if isinstance(last, tuple) else last)
    end: int = node.end_mark.index
    return end


# Keys of older versions


Step = Callable[[YamlText], None]
"""Function that edits one file from its version to the next; must be idempotent."""


def _rename_keys(names: Mapping[str, str], text: YamlText) -> None:
    for key, name in names.items():
        text.rename(tuple(key.split(".")), name)


FILE_VERSION: Final = 2
"""Version of the configuration files that this program writes."""
STEPS: Final[dict[int, Step]] = {version: partial(_rename_keys, names) for version, names in RENAMED.items()}
"""Migration steps by the version they start from."""
OLDEST: Final = min(STEPS)


def run_steps(text: YamlText, version: int, steps: Mapping[int, Step], target: int) -> None:
    """Migrate a text from ``version`` to ``target``.

    Raises:
        ConfigError: a version between them has no migration step.
    """
    for number in range(version, target):
        if number not in steps:
            raise ConfigError(f"{text.path}: cannot be migrated from version {number} to {number + 1}")
        steps[number](text)
        text.replace(("version",), str(number + 1))


def bring_up_to_date(text: YamlText, inherited: int | None) -> int | None:
    """Rename the keys of an older version to the current ones, in memory only.

    Args:
        text: content of the file.
        inherited: version of the file that includes it.

    Returns:
        Version before the renaming; None if it is missing or unknown, and no key was renamed.
    """
    said = text.value("version")
    version = inherited if text.node("version") is None else int(said) if said and said.isdecimal() else None
    if version is None or not OLDEST <= version <= FILE_VERSION:
        return None
    run_steps(text, version, STEPS, FILE_VERSION)
    return version


# Validation


def validated(tree: Tree, path: Path, model: type[S]) -> tuple[S, Tree]:
    """Validate the data merged from ``path``; see ``load_config``."""
    version = tree.data.get("version")
    if version != FILE_VERSION:
        if version is None:
            raise ConfigError(f"{path}:1: version: missing; write `version: {FILE_VERSION}`")
        origin = tree.origin(("version",)) or f"{path}:1"
        raise ConfigError(f"{origin}: version: expected {OLDEST} to {FILE_VERSION}, found {version!r}")
    _require_kind(tree.data, path, model)
    _locate_files(tree, getattr(model, "FILE_KEYS", ()))
    _give_ports(tree.data)
    try:
        text = json.dumps(tree.data)
    except TypeError as error:
        raise ConfigError(
            f"{path}: contains a value that is not text, a number, a list or a mapping: {error}"
        ) from error
    except ValueError as error:
        raise ConfigError(f"{path}: {error}") from error
    try:
        config = model.model_validate_json(text)
    except ValidationError as error:
        raise ConfigError("\n".join(_explain(tree, path, model, error))) from error
    if isinstance(config, TruckConfig) and (lines := list(_mixtures(config, tree, path))):
        raise ConfigError("\n".join(lines))
    return config, tree


def _mixtures(config: TruckConfig, tree: Tree, path: Path) -> Iterator[str]:
    """Report each simulation key in the configuration of a robot with real ports."""
    simulated = config.sim is not None
    for key, port, remedy in mixed(config.devices, config.machine, simulated=simulated, stand=config.stand):
        where, other = (tree.origin(place) or f"{path}:1" for place in (key, port))
        yield f"{where}: {'.'.join(key)}: a simulation cannot use the real port {'.'.join(port)} ({other}): {remedy}"


def _require_kind(data: dict[str, Any], path: Path, model: type[Schema]) -> None:
    """Report a mission file in one line, instead of an error for each of its keys."""
    found = [str(key) for key in data if key != "version"]
    strange = set(found) - set(model.model_fields)
    # 0.75: minimum fraction of unknown sections to reject the file as another kind of file
    if len(strange) > 1 and len(strange) >= 0.75 * len(found):
        expected = [name for name, field in model.model_fields.items() if field.is_required() and name != "version"]
        raise ConfigError(
            f"{path}:1: this is another kind of file: expected {', '.join(expected)}, found {', '.join(found)}"
        )


def _locate_files(tree: Tree, keys: tuple[tuple[str, ...], ...]) -> None:
    """Make the paths at ``keys`` absolute; in the file they are relative to it."""
    for key in keys:
        section: Any = tree.data
        for part in key[:-1]:
            section = section.get(part) if isinstance(section, dict) else None
        name = section.get(key[-1]) if isinstance(section, dict) else None
        if not isinstance(name, str):
            continue
        with reading(f"{tree.origins[key]}: {'.'.join(key)}", "a file name", ConfigError):
            section[key[-1]] = str(_located(tree, key, name))


def _located(tree: Tree, key: tuple[str, ...], name: str) -> Path:
    """Resolve the file ``name`` at ``key``, or the folder of a saved map; record it if it belongs to the robot.

    Raises:
        ConfigError: the file is missing, or is a folder.
        OSError, ValueError: the file name is impossible.
    """
    origin = tree.origins[key]
    file = (origin.file.parent / name).resolve()
    ours = origin.file.resolve() in tree.files and not Path(name).is_absolute()
    saved = folder_of(file) if key[-1] == "map" else None
    if saved is not None and ((saved / SAVES).is_dir() or (saved / MAP_YAML).is_file()):
        tree.maps += [saved] if ours else []
        return saved
    if not file.is_file():
        in_folder = "expected a file, found a folder" if saved is None else "no saved map in this folder"
        problem = in_folder if file.is_dir() else "no such file"
        raise ConfigError(f"{origin}: {'.'.join(key)}: {problem}: {file}")
    if ours:
        (tree.maps if key[-1] == "map" else tree.files).append(file)
    return file


def _give_ports(data: dict[str, Any]) -> None:
    """Set the port of every emulated device without a configured port to the port that `simulate` creates."""
    devices = data.get("devices")
    if data.get("sim") is None or not isinstance(devices, dict):
        return
    folder = emulated_ports(str(data.get("robot", ROBOT)))
    for role, device in devices.items():
        if isinstance(device, dict) and device.get("port") is None:
            device["port"] = {"path": str(folder / str(role))}


def _explain(tree: Tree, path: Path, model: type[Schema], error: ValidationError) -> Iterator[str]:
    details = error.errors(include_url=False)
    wrong = {detail["loc"][:depth] for detail in details for depth in range(len(detail["loc"]))}
    mistakes: dict[Key, ErrorDetails] = {}
    for detail in details:
        # invalid entries are not counted, so a list of them is "too short"
        if detail["type"] != "too_short" or detail["loc"] not in wrong:
            mistakes.setdefault(_data_key(tree.data, detail["loc"]), detail)  # for a union, the first member
    most_mistakes = 50  # reported as one
    for key, detail in list(mistakes.items())[:most_mistakes]:
        origin = tree.origin(key) or f"{path}:1"
        dotted = ".".join(map(str, key)) or "configuration"
        yield f"{origin}: {dotted}: {_sentence(detail, model, key)}"
    if (more := len(mistakes) - most_mistakes) > 0:
        yield f"{path}: {more} more mistakes"
    if {"extra_forbidden", "union_tag_invalid"} & {detail["type"] for detail in mistakes.values()}:
        yield from (f"plug-in skipped: {broken}" for broken in left_out())


def _first_mistake(data: Any, error: ValidationError) -> str:
    detail = error.errors(include_url=False)[0]
    key = ".".join(map(str, _data_key(data, detail["loc"])))
    text = detail["msg"].removeprefix("Value error, ")
    return f"{key}: {text}" if key else text


def _sentence(detail: ErrorDetails, model: type[Schema], key: Key) -> str:
    if detail["type"] == "extra_forbidden":
        known = _field_names(model, key[:-1], detail)
        close = difflib.get_close_matches(str(key[-1]), known, 1)
        return (
            f"unknown key (did you mean {close[0]}?)" if close else f"unknown key; expected one of {', '.join(known)}"
        )
    if detail["type"] == "missing":
        return "missing; it has no default"
    if detail["type"] == "union_tag_invalid":
        return f"unknown kind {detail['ctx']['tag']!r}; expected one of {detail['ctx']['expected_tags']}"
    if detail["type"] in ("too_short", "too_long"):
        limit = "at least {min_length}" if detail["type"] == "too_short" else "at most {max_length}"
        return f"expected {limit.format_map(detail['ctx'])} in number"
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
    """Return pydantic's location without the names of union members, which are not keys in the data."""
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
    kinds = {part for part in detail["loc"] if isinstance(part, str)}
    candidates = _reach(model, key)
    chosen = [model for model in candidates if _tags(model) & kinds] or candidates
    return sorted({name for candidate in chosen for name in candidate.model_fields})


def _tags(model: type[BaseModel]) -> set[str]:
    """Values of the model's keys with a single choice: the kind, or the action of a mission step."""
    fields = model.model_fields.values()
    choices = [get_args(field.annotation) for field in fields if get_origin(field.annotation) is Literal]
    return {some[0] for some in choices if len(some) == 1}


def _description(model: type[BaseModel], key: Key) -> str | None:
    if not key or isinstance(key[-1], int):
        return None
    for candidate in _reach(model, key[:-1]):
        if text := field_docs(candidate).get(key[-1]):
            return text.split("\n")[0].rstrip(".")
    return None
