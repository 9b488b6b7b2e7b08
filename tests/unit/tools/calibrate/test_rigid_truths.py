"""By what calibrations are judged: hidden values in the plane, and how the robot really moves among rigid bodies."""

from pathlib import Path

import numpy as np
import pytest

from monstertruckd.config.calibration import Estimate, Result
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from tests.calibration_kit import curvature_errors, hidden, truths, verdicts
from tests.calibration_rigid import rigid_truths
from tests.calibration_robots import CONFIGS, robot_of


def yard(tmp_path: Path, *parts, **world) -> SimulatedTruckConfig:
    config = load_config(CONFIGS / "yard.yaml", SimulatedTruckConfig)[0]
    own = with_overlay(config, {"sim": {"world": world}, "state_directory": tmp_path, "recorder": None})
    return hidden(own, np.random.default_rng([5, 4]), 5, parts)


@pytest.mark.parametrize(
    ("wizard", "within"),
    [("drive", 0.004), ("steering", 0.003), ("odometry", 0.004), ("slip", 0.001)],
    ids=("drive", "steering", "odometry", "slip"),
)
def test_what_is_measured_by_hand_in_the_plane_is_what_is_hidden_there(tmp_path, wizard, within):
    config = robot_of("slip", tmp_path, 5) if wizard == "slip" else yard(tmp_path, wizard)
    known = truths(config)[wizard]
    for name, found in rigid_truths(wizard, config).items():
        assert found == pytest.approx(known[name], rel=0 if wizard == "steering" else within, abs=within), name


def test_rigid_bodies_are_judged_by_how_they_move(tmp_path):
    config = yard(tmp_path, "drive", engine="mujoco")
    loaded = rigid_truths("drive", config)["turns_per_metre"]
    assert 1.0005 < loaded / truths(config)["drive"]["turns_per_metre"] < 1.01, "loaded tyres roll less far"
    row = Estimate(
        name="turns_per_metre", value=loaded, low=0.9999 * loaded, high=1.0001 * loaded, samples=4, meaning="test"
    )
    (found,) = verdicts(Result(wizard="drive", measured="test", estimates=(row,)), config)
    assert found.holds


def test_a_truck_that_knows_its_linkage_is_wrong_about_the_curves_of_rigid_bodies():
    """Their tyres turn less than the linkage's least squares: docs/world3d.md."""
    config = load_config(CONFIGS / "demo.yaml", SimulatedTruckConfig)[0]
    plane, rigid = (with_overlay(config, {"sim": {"world": {"engine": name}}}) for name in ("plane", "mujoco"))
    assert max(curvature_errors(plane).values()) < 0.005
    assert 0.04 < max(curvature_errors(rigid).values()) < 0.08
