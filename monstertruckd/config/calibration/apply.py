"""Lays a truck's calibration over its configuration, value by value, each with its origin."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from monstertruck_runtime.errors import ConfigError
from monstertruckd.config.calibration.record import KEYS, Estimate, Result, Value
from monstertruckd.config.calibration.store import CalibrationStore
from monstertruckd.config.truck import TruckConfig
from monstertruckd.config.yaml_tree import Tree, load_tree

C = TypeVar("C", bound=TruckConfig)


def store_of(config: TruckConfig) -> CalibrationStore:
    """Where the calibration of a configured truck is kept."""
    return CalibrationStore(config.calibration or config.state_directory / "calibration", config.robot)


def calibrated(config: C, tree: Tree) -> tuple[C, Tree]:
    """The configuration with the newest calibration laid over it, and the tree that tells each value's origin.

    Raises:
        ConfigError: the file is damaged, of another truck, or its values do not fit the configuration.
    """
    store = store_of(config)
    path = store.newest()
    if path is None:
        return config, tree
    file = store.load(path)
    lines = load_tree(path).origins
    origins = dict(tree.origins)
    for wizard, result in file.results.items():
        for place, estimate in enumerate(result.estimates):
            if estimate.key is not None:
                origins[tuple(estimate.key.split("."))] = lines["results", wizard, "estimates", place, "value"]
    return with_values(config, file.results.values(), path), Tree(tree.data, origins, calibration=path)


def with_values(config: C, results: Iterable[Result], source: Path | str) -> C:
    """``config`` with the values of ``results``; values of devices that this truck has not are left out.

    Args:
        config: as configured, or calibrated before.
        results: of the wizards.
        source: named in complaints.

    Raises:
        ConfigError: a value that no wizard may set, or one that the configuration refuses.
    """
    data = config.model_dump()
    for result in results:
        for estimate in result.estimates:
            if estimate.key is not None:
                _set(data, estimate, result, source)
    try:
        return type(config).model_validate(data)
    except ValidationError as error:
        detail = error.errors(include_url=False)[0]
        where = ".".join(str(part) for part in detail["loc"])
        msg = f"{source}: {where}: {detail['msg'].removeprefix('Value error, ')}"
        raise ConfigError(msg) from error


def _set(data: dict[str, Any], estimate: Estimate, result: Result, source: Path | str) -> None:
    assert estimate.key is not None
    if estimate.key not in KEYS[result.wizard]:
        raise ConfigError(f"{source}: {estimate.key}: the wizard {result.wizard} has no business there")
    *way, last = estimate.key.split(".")
    section: Any = data
    for part in way:
        section = section.get(part)
        if not isinstance(section, dict):
            return
    section[last] = estimate.value


def value_at(config: Mapping[str, Any], key: str) -> Value | None:
    """A value of a resolved configuration; None where there is no such section."""
    section: Any = config
    for part in key.split("."):
        if not isinstance(section, Mapping):
            return None
        section = section.get(part)
    return section if isinstance(section, bool | int | float) else None
