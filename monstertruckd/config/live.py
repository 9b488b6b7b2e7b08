"""Settings that may be changed while the robot runs: which there are, and the file that keeps them.

A setting is live if its model marks it (``monstertruck_schemas.base.LIVE``). Whatever is changed, the whole
configuration is validated as at the start, so that nothing passes the ceilings of the body.
"""

import io
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeVar

from pydantic import ValidationError
from pydantic.fields import FieldInfo
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap

from monstertruck_runtime.errors import ConfigError, InputError
from monstertruck_runtime.small_files import replace_file
from monstertruck_schemas.base import LIVE, Schema
from monstertruckd.config.edit import YamlText
from monstertruckd.config.truck import TruckConfig

T = TypeVar("T", bound=TruckConfig)

Value = float | int | bool | str

HEAD: Final = (
    "Settings changed while the robot ran (monstertruckd set --save); they replace those of the configuration."
)


@dataclass(frozen=True, slots=True)
class LiveSetting:
    """One setting that may be changed while the robot runs."""

    key: str
    """Dotted."""
    value: Value
    meaning: str
    above: float | None = None
    """Bound of the value alone, exclusive; the whole configuration may allow less."""
    at_least: float | None = None
    below: float | None = None
    at_most: float | None = None


def live_settings(config: Schema, prefix: str = "") -> Iterator[LiveSetting]:
    """All live settings of a configuration, in its order."""
    for name, field in type(config).model_fields.items():
        value = getattr(config, name)
        if isinstance(value, Schema):
            yield from live_settings(value, f"{prefix}{name}.")
        elif LIVE in field.metadata:
            meaning = " ".join((field.description or "").replace("``", "").split())
            yield LiveSetting(f"{prefix}{name}", value, meaning, *_bounds(field))


def _bounds(field: FieldInfo) -> tuple[float | None, ...]:
    names = ("gt", "ge", "lt", "le")
    return tuple(next((getattr(m, name) for m in field.metadata if hasattr(m, name)), None) for name in names)


def with_settings(config: T, values: Mapping[str, Any]) -> T:
    """``config`` with other values of live settings, validated as a whole.

    Raises:
        InputError: a setting that is not there or not live, or a value that is refused, with what is possible.
    """
    known = {setting.key for setting in live_settings(config)}
    data = config.model_dump()
    for key in values:
        if key not in known:
            raise InputError(f"{key}: cannot be changed while the robot runs; there are {', '.join(sorted(known))}")
    _put(data, values)
    try:
        return type(config).model_validate(data)
    except ValidationError as error:
        detail = error.errors(include_url=False)[0]
        where = ".".join(map(str, detail["loc"]))
        text = detail["msg"].removeprefix("Value error, ")
        raise InputError(f"{where}: {text}" if where else text) from error


def _put(data: dict[str, Any], values: Mapping[str, Any]) -> None:
    """Put live settings, by dotted key, into a configuration's plain data, which is not validated."""
    for key, value in values.items():
        section = data
        *way, last = key.split(".")
        for part in way:
            section = section[part]
        section[last] = value


class SavedSettings:
    """The file of live settings that outlast the run; its methods may block for a file system's time.

    Args:
        folder: the robot's ``state_directory``; the file in it is made when the first setting is saved.
        robot: its name.
    """

    def __init__(self, folder: Path, robot: str) -> None:
        self.path = folder / f"settings-{robot}.yaml"

    def values(self) -> dict[str, tuple[Value, int]]:
        """Saved values by dotted key, each with its line; empty without a file.

        Raises:
            ConfigError: the file is damaged; names the line.
        """
        if not self.path.exists():
            return {}
        text = YamlText.read(self.path)
        content = _load(text.text) or {}
        found = {}
        for key, value in _leaves(content, ()):
            node = text.node(*key)
            found[".".join(key)] = value, 1 if node is None else node.start_mark.line + 1
        return found

    def put(self, values: Mapping[str, tuple[Value, int]], config: TruckConfig, data: dict[str, Any]) -> None:
        """Put saved values into a configuration's plain data, which is not validated.

        Raises:
            ConfigError: one is no live setting of the configuration; names the line.
        """
        known = {setting.key for setting in live_settings(config)}
        for key, (_, line) in values.items():
            if key not in known:
                raise ConfigError(f"{self.path}:{line}: {key}: is no setting that can be changed while running")
        _put(data, {key: value for key, (value, _) in values.items()})

    def save(self, values: Mapping[str, Value]) -> None:
        """Add settings, or replace them; whatever else is in the file stays, comments too.

        Raises:
            ConfigError: the file is damaged, or cannot be written; nothing has changed then.
        """
        content = _load(YamlText.read(self.path).text) if self.path.exists() else None
        if content is None:
            content = CommentedMap()
            content.yaml_set_start_comment(HEAD)
        for key, value in values.items():
            *way, last = key.split(".")
            section = content
            for part in way:
                section = section.setdefault(part, CommentedMap())
            section[last] = value
        out = io.StringIO()
        YAML(typ="rt", pure=True).dump(content, out)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            replace_file(self.path, out.getvalue())
        except OSError as error:
            raise ConfigError(f"{self.path}: settings cannot be saved: {error.strerror}") from error


def _load(text: str) -> Any:
    return YAML(typ="rt", pure=True).load(text)


def _leaves(value: Any, key: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Value]]:
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from _leaves(inner, (*key, str(name)))
    else:
        yield key, value
