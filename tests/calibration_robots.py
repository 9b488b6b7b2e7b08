"""Simulated robots of which the value that one wizard measures is hidden, everything else as it is believed."""

from pathlib import Path
from typing import Any

import numpy as np

from monstertruckd.config.calibration import WizardName
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from tests.calibration_kit import hidden

CONFIGS = Path(__file__).resolve().parents[1] / "configs"


def robot_of(name: WizardName, folder: Path, seed: int) -> SimulatedTruckConfig:
    """The robot for a wizard; its calibrations go to ``folder``."""
    if name == "slip":
        return _skid_steer(folder, seed)
    return hidden(_believed(name, folder), np.random.default_rng(seed), seed, (name,))


def _believed(name: WizardName, folder: Path) -> SimulatedTruckConfig:
    quiet: dict[str, Any] = {"recorder": None, "state_directory": folder}
    if name == "stabiliser":
        full = load_config(CONFIGS / "full.yaml", SimulatedTruckConfig)[0]
        lean = {"devices": {"camera": None}, "monitors": {"link": None, "host": None}, "planner": None, "path": None}
        return with_overlay(full, quiet | {"blackbox": None, "sim": {"world": {"map": "yard"}}} | lean)
    if name == "sonar":
        robot = load_config(CONFIGS / "robots" / "sonar.yaml", SimulatedTruckConfig)[0]
        overlay = {"blackbox": None, "devices": {"sonar": {"driver": {"speed_of_sound": 340.0}}}}
        return with_overlay(robot, quiet | overlay)
    yard = load_config(CONFIGS / "yard.yaml", SimulatedTruckConfig)[0]
    plain = SimulatedTruckConfig.model_validate(yard.model_dump() | {"sim": {"world": {"map": "yard"}}} | quiet)
    if name == "imu":
        imu = {"port": {"path": Path("/tmp/monstertruck/imu")}, "driver": {"kind": "wt61"}}
        return with_overlay(plain, {"devices": {"imu": imu}})
    if name == "camera":
        camera = {"mount": {"x": 0.18, "z": 0.25}, "driver": {"kind": "webcam", "rate": 5}}
        camera["port"] = {"path": folder / "camera"}
        world = {"camera": {"noise": 3.0}, "board": {}}
        return with_overlay(plain, {"devices": {"camera": camera}, "sim": {"world": world}})
    return plain


def _skid_steer(folder: Path, seed: int) -> SimulatedTruckConfig:
    left, right, gain = np.random.default_rng([seed, 37]).uniform((0.06, 0.06, 0.95), (0.085, 0.085, 1.08)).tolist()
    body = {"kind": "skid_steer", "motors": "wheels", "icr_left": left, "icr_right": -right, "gain_left": gain}
    robot = load_config(CONFIGS / "robots" / "skid_stand.yaml", SimulatedTruckConfig)[0]
    quiet = {"recorder": None, "blackbox": None, "state_directory": folder}
    return with_overlay(robot, quiet | {"sim": {"seed": seed, "world": {"truck": {"body": body}}}})
