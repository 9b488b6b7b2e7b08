"""Configuration of a run in the simulated world: the daemon's own, and the world behind the emulators."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Final, Self

from pydantic import model_validator

from monstertruck_drivers.config import Monitors
from monstertruck_runtime.errors import ConfigError
from monstertruck_sim.computer import hangs_by_hub
from monstertruck_sim.config import SimConfig
from monstertruckd.config.load import Tree, calibrated, load_tree, validated
from monstertruckd.config.truck import TruckConfig
from monstertruckd.tools.simulation.as_built import as_built

DEADMAN_LINE: Final[Mapping[str, Any]] = {
    "devices": {"steering": {"driver": {"deadman_channel": 2}}},
    "sim": {"deadman_wired": True, "servo_timeout": 0.3},
}
"""Overlay that wires the deadman line: without it a truck drives on when its drive controller cannot be reached."""


class SimulatedTruckConfig(TruckConfig):
    """A truck whose devices are emulated."""

    FILE_KEYS: ClassVar[tuple[tuple[str, ...], ...]] = (
        *TruckConfig.FILE_KEYS,
        ("sim", "recording"),
        ("sim", "world", "mjcf"),
        ("sim", "world", "height_image", "file"),
    )

    sim: SimConfig

    @model_validator(mode="after")
    def _as_built(self) -> Self:
        if not self.sim.as_built:
            return self
        world = as_built(self.sim.world, self)
        return self.model_copy(update={"sim": self.sim.model_copy(update={"world": world, "as_built": False})})

    @model_validator(mode="after")
    def _same_kind(self) -> Self:
        if self.sim.world.truck.body.kind != self.body.kind:
            raise ValueError(f"sim.world.truck.body is {self.sim.world.truck.body.kind}, body is {self.body.kind}")
        return self


def load_simulated(path: Path) -> SimulatedTruckConfig:
    """Return the configuration of a simulated robot, without calibration.

    Raises:
        ConfigError: one line per mistake; or it describes a real robot.
    """
    tree = load_tree(path)
    if tree.data.get("sim") is None:
        raise ConfigError(f"{path}: describes a real robot: add a section `sim`, as in the bundled `full`")
    return validated(tree, path, SimulatedTruckConfig)[0]


def load_robot(path: Path) -> tuple[TruckConfig, Tree]:
    """Return the calibrated configuration of a robot; of a simulated one the section ``sim`` is checked, too.

    Raises:
        ConfigError: one line per mistake, in the file or in its calibration.
    """
    tree = load_tree(path)
    model = TruckConfig if tree.data.get("sim") is None else SimulatedTruckConfig
    return calibrated(*validated(tree, path, model))


def needs_computer(config: SimulatedTruckConfig) -> bool:
    """Return whether the daemon needs an emulated computer, for USB devices or for monitors."""
    return hangs_by_hub(config.devices) or config.monitors != Monitors()


def with_overlay(config: SimulatedTruckConfig, overlay: Mapping[str, Any]) -> SimulatedTruckConfig:
    """Return ``config`` with some values replaced."""
    return SimulatedTruckConfig.model_validate(_merged(config.model_dump(), overlay))


def _merged(base: Mapping[str, Any], top: Mapping[str, Any]) -> dict[str, Any]:
    if "kind" in top and top["kind"] != base.get("kind"):
        return dict(top)  # another kind has other keys
    deep = {
        k: _merged(base[k], v) if isinstance(v, Mapping) and isinstance(base.get(k), Mapping) else v
        for k, v in top.items()
    }
    return {**base, **deep}
