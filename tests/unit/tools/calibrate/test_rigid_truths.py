"""By what calibrations are judged: hidden values in the plane, and how the robot really moves among rigid bodies."""

from math import pi
from pathlib import Path

import numpy as np
import pytest

from monstertruckd.config.calibration import Estimate, Result
from monstertruckd.config.load import load_config
from monstertruckd.tools.calibrate import odometry
from monstertruckd.tools.calibrate.assumed import ASSUMED
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from tests.calibration_kit import curvature_errors, hidden, truths, verdicts
from tests.calibration_rigid import HandDriven, rigid_truths
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


@pytest.mark.parametrize(("engine", "least", "most"), [("plane", 0.97, 1.0), ("mujoco", 0.92, 0.98)])
def test_where_something_stops_a_servo_its_axle_is_judged_by_the_curvature_too(tmp_path, engine, least, most):
    stops = {f"{axle}_servo": {"channel": i, "left_stop_deg": 26.0} for i, axle in ((1, "front"), (0, "rear"))}
    config = yard(tmp_path, engine=engine, truck=stops)
    known, found = truths(config)["steering"], rigid_truths("steering", config)
    assert [name for name in found if "travel" in name] == ["front_left_travel", "rear_left_travel"]
    for name in ("front_left_travel", "rear_left_travel"):
        assert least < found[name] / known[name] < most, name


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


@pytest.mark.parametrize("side", [1, -1])
def test_wheels_that_are_steered_while_the_truck_stands_turn_it(tmp_path, side):
    """By as much as the interval of the wheelbase allows for on a right angle: ``odometry.ON_THE_SPOT``."""
    config = yard(tmp_path, engine="mujoco")
    hands = HandDriven(config)
    hands.steer(config.sim.world.truck.chassis().linkage.servos(side * odometry.ANGLE, -side * odometry.ANGLE))
    hands.moved(odometry.CORNER, seconds=1.0)
    hands.drive(0.0)
    before = hands.wait(1.5)[-1].yaw
    hands.steer((0.0, 0.0))
    turned = side * (hands.wait(1.0)[-1].yaw - before)
    assert 0.002 < turned < ASSUMED.square_on_the_spot * pi / 2
