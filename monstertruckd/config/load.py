"""Loads a robot's configuration file, with the robot's calibration over it."""

from pathlib import Path

from monstertruckd.config.calibration.apply import calibrated
from monstertruckd.config.truck import TruckConfig
from monstertruckd.config.validate import load_config
from monstertruckd.config.yaml_tree import Tree


def load_truck(path: Path) -> tuple[TruckConfig, Tree]:
    """The configuration at ``path``, calibrated.

    Raises:
        ConfigError: one line per mistake, in the file or in its calibration.
    """
    return calibrated(*load_uncalibrated(path))


def load_uncalibrated(path: Path) -> tuple[TruckConfig, Tree]:
    """The configuration as written.

    Raises:
        ConfigError: one line per mistake.
    """
    return load_config(path, TruckConfig)
