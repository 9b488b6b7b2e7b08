"""Which files a configuration is made of, and where they go: all keep their place to each other."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from monstertruck_runtime.errors import ConfigError
from monstertruckd.config.load import load_truck
from monstertruckd.config.truck import TruckConfig

FOLDER = Path("/etc/monstertruckd")


def load_real(config_file: Path) -> TruckConfig:
    """The configuration of a truck that is no simulation.

    Raises:
        ConfigError: it is one, or it was refused.
    """
    config, tree = load_truck(config_file)
    if "sim" in tree.data:
        raise ConfigError(f"{config_file}: sim: is a simulated truck; a service drives a real one")
    return config


def files_of(config_file: Path) -> dict[Path, Path]:
    """Every file a valid configuration is made of, by its path below ``FOLDER``; the given one comes first.

    What it names absolutely stays where it is.
    """
    files = list(dict.fromkeys(_files(config_file.resolve())))
    common = Path(os.path.commonpath([file.parent for file in files]))
    return {file.relative_to(common): file for file in files}


def _files(file: Path) -> Iterator[Path]:
    yield file
    data = yaml.safe_load(file.read_text(encoding="utf-8")) or {}
    included = data.get("include", [])
    for name in [included] if isinstance(included, str) else included:
        if not Path(name).is_absolute():
            yield from _files((file.parent / name).resolve())
    for key in TruckConfig.FILE_KEYS:
        name = _at(data, key)
        if name is not None and not Path(name).is_absolute():
            yield (file.parent / name).resolve()


def _at(data: Any, key: tuple[str, ...]) -> str | None:
    for part in key:
        data = data.get(part) if isinstance(data, dict) else None
    return None if data is None else str(data)
