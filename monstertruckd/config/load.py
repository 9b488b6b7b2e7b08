"""Loads a truck's configuration file, simulated or not, with the truck's calibration over it."""

from pathlib import Path

from monstertruckd.config.calibration.apply import calibrated
from monstertruckd.config.truck import TruckConfig
from monstertruckd.config.validate import load_config
from monstertruckd.config.yaml_tree import Tree, load_tree


def load_truck(path: Path) -> tuple[TruckConfig, Tree]:
    """The configuration at ``path``, calibrated; with a section ``sim`` the world's settings are checked too.

    Raises:
        ConfigError: one line per mistake, in the file or in its calibration.
    """
    return calibrated(*load_uncalibrated(path))


def load_uncalibrated(path: Path) -> tuple[TruckConfig, Tree]:
    """The configuration as written.

    Raises:
        ConfigError: one line per mistake.
    """
    model: type[TruckConfig] = TruckConfig
    if "sim" in load_tree(path).data:
        # Only a simulated run may load the world.
        from monstertruckd.tools.simulation.config import SimulatedTruckConfig  # noqa: PLC0415

        model = SimulatedTruckConfig
    return load_config(path, model)
