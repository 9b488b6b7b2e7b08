"""Geometry and mounts from a robot's own URDF."""

import math
from pathlib import Path

import pytest
from typer.testing import CliRunner

from monstertruck_runtime.errors import InputError
from monstertruckd.config.load import load_config
from monstertruckd.config.truck import TruckConfig
from monstertruckd.tools.cli.main import app
from monstertruckd.tools.simulation.config import load_robot
from monstertruckd.tools.urdf import load_urdf

ROOT = Path(__file__).resolve().parents[3]


def wheel(name: str, x: float, y: float) -> str:
    return f"""
  <link name="{name}"><collision><origin rpy="1.5707963 0 0"/>
    <geometry><cylinder radius="0.05" length="0.04"/></geometry></collision></link>
  <joint name="{name}_joint" type="continuous"><parent link="chassis"/><child link="{name}"/>
    <origin xyz="{x} {y} 0.02"/><axis xyz="0 1 0"/></joint>"""


WHEELS = "".join(wheel(f"wheel_{x}_{y}", 0.1 + 0.15 * x, 0.1 * y) for x in (1, -1) for y in (1, -1))
ROVER = f"""<?xml version="1.0"?>
<robot name="rover">
  <link name="base_footprint"/>
  <link name="chassis"><visual><origin xyz="0.1 0 0.1"/><geometry><box size="0.4 0.2 0.1"/></geometry></visual></link>
  <joint name="base" type="fixed"><parent link="base_footprint"/><child link="chassis"/>
    <origin xyz="0 0 0.03"/></joint>{WHEELS}
  <link name="base_scan"/>
  <joint name="scan" type="fixed"><parent link="chassis"/><child link="base_scan"/>
    <origin xyz="0.2 0 0.15" rpy="3.1415927 0 0.5"/></joint>
  <link name="camera_link"/>
  <joint name="camera" type="fixed"><parent link="base_scan"/><child link="camera_link"/>
    <origin xyz="0 0 -0.1" rpy="3.1415927 0 0"/></joint>
</robot>
"""


def written(tmp_path: Path, text: str = ROVER) -> Path:
    (tmp_path / "rover.urdf").write_text(text)
    return tmp_path / "rover.urdf"


def test_dimensions_and_mounts_are_those_of_the_wheels_middle_on_the_ground(tmp_path: Path):
    robot = load_urdf(written(tmp_path))
    assert robot.geometry == {"wheelbase": 0.3, "track": 0.2, "wheel_radius": 0.05, "length": 0.4, "width": 0.24}
    lidar = robot.mounts["lidar"]
    assert abs(lidar.pop("roll")) == math.pi
    assert lidar == {"x": 0.1, "z": 0.18, "yaw": 0.5}
    assert robot.mounts["camera"] == {"x": 0.1, "z": 0.28, "yaw": 0.5}
    assert "imu" not in robot.mounts


def test_a_link_is_given_where_its_name_does_not_show_it(tmp_path: Path):
    assert load_urdf(written(tmp_path), {"imu": "chassis"}).mounts["imu"] == {"x": -0.1, "z": 0.03}
    with pytest.raises(InputError, match="no link nose for imu: expected one of base_footprint"):
        load_urdf(written(tmp_path), {"imu": "nose"})


def test_our_own_description_gives_our_own_dimensions(tmp_path: Path):
    config = ROOT / "configs/truck.yaml"
    done = CliRunner().invoke(app, ["description", str(config), "-o", str(tmp_path / "truck.urdf")])
    assert done.exit_code == 0, done.output
    robot, (truck, _) = load_urdf(tmp_path / "truck.urdf"), load_robot(config)
    for name in ("wheelbase", "track", "wheel_radius"):
        assert robot.geometry[name] == pytest.approx(getattr(truck.geometry, name), abs=1e-3)
    lidar = truck.devices.lidar
    assert lidar is not None
    assert robot.mounts["lidar"].get("x", 0.0) == pytest.approx(lidar.mount.x, abs=1e-3)
    assert robot.mounts["lidar"].get("z", 0.0) == pytest.approx(lidar.mount.z, abs=1e-3)


def test_the_command_writes_sections_of_a_configuration(tmp_path: Path):
    file = written(tmp_path)
    done = CliRunner().invoke(app, ["import-urdf", str(file), "--link", "imu=chassis"])
    assert done.exit_code == 0, done.output
    assert "geometry:\n  wheelbase: 0.3\n" in done.stdout
    (tmp_path / "robot.yaml").write_text("version: 5\n" + done.stdout.partition("devices:")[0])
    base = load_config(ROOT / "configs/truck.yaml", TruckConfig)[0]
    assert base.geometry.model_validate({**base.geometry.model_dump(), **load_urdf(file).geometry}).wheelbase == 0.3
    done = CliRunner().invoke(app, ["import-urdf", str(file), "--link", "nose=chassis"])
    assert (done.exit_code, "expected DEVICE=LINK" in done.stderr) == (3, True)


@pytest.mark.parametrize(
    ("text", "refusal"),
    [
        ("<robot", "expected URDF: "),
        ("<world/>", "expected an element robot, found world"),
        (ROVER.replace('"0.3 0', "${x}").replace("rover", "${r}"), "is xacro"),
        ('<!DOCTYPE robot [<!ENTITY a "b">]><robot/>', "declares entities"),
        (ROVER.replace("continuous", "fixed"), "expected four wheels .*, found none"),
        (ROVER.replace('xyz="0.25 0.1 ', 'xyz="-0.05 0.1 '), "expected a wheel at each corner"),
        (ROVER.replace('<child link="chassis"/>', ""), "joint base: expected a child link"),
        (ROVER.replace('<parent link="base_footprint"/>', '<parent link="camera_link"/>'), "is its own parent"),
        (
            ROVER.replace('xyz="0.2 0 0.15"', 'xyz="0.2 nan 0.15"'),
            "joint scan: xyz: expected three numbers, found '0.2 nan 0.15'",
        ),
        (
            ROVER.replace('xyz="0.2 0 0.15"', 'xyz="0,2 0 0.15"'),
            "joint scan: xyz: expected three numbers, found '0,2 0 0.15'",
        ),
        (ROVER.replace('radius="0.05"', 'radius="-1"'), "link wheel_1_1: radius: expected metres > 0, found '-1'"),
        (ROVER.replace('size="0.4 0.2 0.1"', 'size="0.4"'), "link chassis: size: expected three numbers, found '0.4'"),
        (
            ROVER.replace('<cylinder radius="0.05" length="0.04"/>', '<mesh filename="wheel.stl"/>'),
            "expected four wheels .*, found none; wheel_1_1 is a mesh; wheel_1_-1 is a mesh",
        ),
        (ROVER.replace('<child link="camera_link"/>', '<child link="base_scan"/>'), "base_scan has two parents"),
    ],
)
def test_what_is_no_robot_of_ours_is_refused(tmp_path: Path, text: str, refusal: str):
    with pytest.raises(InputError, match=rf"rover\.urdf: .*{refusal}"):
        load_urdf(written(tmp_path, text))


def test_a_file_in_the_encoding_that_it_declares_is_read(tmp_path: Path):
    text = ROVER.replace('<?xml version="1.0"?>', '<?xml version="1.0" encoding="ISO-8859-1"?><!-- Größe -->')
    (tmp_path / "rover.urdf").write_bytes(text.encode("latin-1"))
    assert load_urdf(tmp_path / "rover.urdf") == load_urdf(written(tmp_path))


def test_a_mesh_whose_size_is_unknown_is_named(tmp_path: Path):
    file = written(tmp_path, ROVER.replace('<box size="0.4 0.2 0.1"/>', '<mesh filename="chassis.stl"/>'))
    done = CliRunner().invoke(app, ["import-urdf", str(file)])
    assert done.exit_code == 0, done.output
    assert "size of chassis unknown (mesh): check geometry.length and geometry.width" in done.stderr
