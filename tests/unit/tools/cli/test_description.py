"""The robot as a file: its links, and sensors where the frame tree has them."""

from pathlib import Path
from xml.etree import ElementTree as ET

import mujoco
import pytest
from typer.testing import CliRunner

from monstertruckd.tools.cli.main import app

CONFIGS = Path(__file__).resolve().parents[4] / "configs"


def test_the_urdf_has_the_sensors_of_the_configuration(tmp_path):
    result = CliRunner().invoke(app, ["description", str(CONFIGS / "full.yaml"), "-o", str(tmp_path / "truck.urdf")])
    assert result.exit_code == 0
    robot = ET.parse(tmp_path / "truck.urdf").getroot()
    lidar = robot.find("joint[@name='lidar_mount']/origin")
    assert lidar.get("xyz") == "0.14 0 0.25"
    assert {"stabiliser", "camera", "compass"} <= {link.get("name") for link in robot.findall("link")}


def test_the_mjcf_is_a_model_of_the_same_mass():
    result = CliRunner().invoke(app, ["description", str(CONFIGS / "truck.yaml"), "--format", "mjcf"])
    assert result.exit_code == 0
    model = mujoco.MjModel.from_xml_string(result.stdout)
    assert model.body_subtreemass[model.body("base").id] == pytest.approx(7.25)


def test_a_body_without_description_is_refused():
    result = CliRunner().invoke(app, ["description", str(CONFIGS / "robots" / "synchro.yaml")])
    assert result.exit_code == 3
    assert "body synchro: cannot be described" in result.stderr


def test_the_small_robot_has_masses_of_its_own_and_those_of_the_truck_are_refused(tmp_path):
    small = CONFIGS / "robots" / "skid_stand.yaml"
    assert CliRunner().invoke(app, ["description", str(small)]).exit_code == 0
    heavy = tmp_path / "heavy.yaml"
    heavy.write_text(f"version: 2\ninclude: {small}\nsim: {{ world: {{ mechanics: {{ wheel_mass: 0.281 }} }} }}\n")
    result = CliRunner().invoke(app, ["description", str(heavy)])
    assert result.exit_code == 3
    assert result.stderr.startswith("sim.world.mechanics: mass is 0.6: expected more than the wheels and axles")


@pytest.mark.parametrize("robot", ["sonar", "omni"])
def test_a_platform_has_its_wheels_and_sensors(robot):
    result = CliRunner().invoke(app, ["description", str(CONFIGS / "robots" / f"{robot}.yaml")])
    assert result.exit_code == 0
    joints = {joint.get("name") for joint in ET.fromstring(result.stdout).findall("joint")}
    assert joints > (
        {"left_spin", "sonar_fl_mount", "rear_caster_suspension"} if robot == "sonar" else {"wheel_3_spin"}
    )
