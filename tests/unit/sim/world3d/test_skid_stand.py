"""The small skid-steer robot of the test stand, whose mass is twice a lidar's: it carries none."""

from math import radians
from pathlib import Path

import numpy as np
import pytest

from monstertruck_runtime.clock import run_virtual
from monstertruck_sim.robot import SimulatedRobot
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from tests.calibration_rigid import HandDriven, rigid_truths

ROBOTS = Path(__file__).resolve().parents[4] / "configs" / "robots"


def robot(name):
    config = load_config(ROBOTS / f"{name}.yaml", SimulatedTruckConfig)[0]
    return with_overlay(config, {"sim": {"world": {"engine": "mujoco"}}})


def test_it_stands_level_and_turns_with_its_wheels():
    hands = HandDriven(robot("skid_stand"))
    states = hands.wait(0.5)
    hands.drive(-0.03, 0.03, -0.03, 0.03)
    states += hands.wait(2.0)
    assert np.abs([(s.pitch, s.roll) for s in states]).max() < radians(1.0)
    assert 0.6 < states[-1].wz / (0.06 / 0.105) < 0.8, "of what wheels turn by that do not skid"


def test_it_turns_about_centres_outside_its_wheels_as_a_body_that_skids():
    found = rigid_truths("slip", robot("skid_stand"))
    assert found["icr_left"] == pytest.approx(-found["icr_right"], rel=0.01)
    assert 1.2 < found["icr_left"] / 0.0525 < 1.6, "of half the track"
    assert abs(found["icr_x"]) < 0.002
    assert 0.95 < found["gain_left"] < 1.0, "loaded tyres roll less far, never further"


@pytest.mark.parametrize(("name", "carried"), [("skid_stand", False), ("skid_steer", True)])
def test_a_robot_carries_the_weight_of_a_lidar_if_it_has_one(tmp_path, name, carried):
    config = robot(name)

    async def made(clock):
        return SimulatedRobot(config.sim, config.devices, config.monitors, clock, {}, tmp_path)

    model = run_virtual(made).world.plant.model
    assert ("lidar_head" in [model.body(i).name for i in range(model.nbody)]) is carried
