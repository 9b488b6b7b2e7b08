"""A robot's description in, its two configurations out."""

import math
from pathlib import Path

import pytest
from typer.testing import CliRunner

from monstertruck_drivers.usb.tree import Node, TreeSnapshot, UsbDevice
from monstertruck_runtime.errors import InputError
from monstertruckd.config.load import load_config
from monstertruckd.config.truck import TruckConfig
from monstertruckd.tools.cli import new as command
from monstertruckd.tools.cli.main import app
from monstertruckd.tools.new_robot.answers import Answers
from monstertruckd.tools.new_robot.write import next_commands, write_robot
from monstertruckd.tools.simulation.config import load_simulated

NOTHING = TreeSnapshot({}, {})
ANT = {
    "name": "ant",
    "body": "differential",
    "drive": "arduino_bridge",
    "wheelbase": 0.14,
    "track": 0.2,
    "wheel_radius": 0.035,
    "length": 0.3,
    "width": 0.26,
    "mass": 2.5,
    "speed": 0.5,
}
CAR = {"body": "ackermann", "drive_ratio": 12.0, "wheelbase": 0.33, "wheel_radius": 0.05, "length": 0.56}


def made(folder: Path, tree: TreeSnapshot = NOTHING, **more: object) -> Path:
    return write_robot(Answers.model_validate(ANT | more, strict=False), folder, tree)


@pytest.mark.parametrize(
    "more",
    [
        {"speed": 0.2},
        {"lidar": "ld19"},
        {"lidar": "hokuyo_lx:ust_10lx", "drive": "vesc", "speed": 3.0, "length": 0.6},
        {"lidar": "sheet_lidar", "beams": 721, "field_of_view": 180.0, "scan_rate": 25.0, "range_max": 8.0},
        {"body": "skid_steer", "drive": "steppers", "camera": "webcam", "lidar": "rplidar:a1", "speed": 0.2},
        CAR | {"drive": "vesc", "steering": "drive", "battery": "drive", "cells": 4, "lidar": "rplidar:c1"},
        CAR | {"drive": "vesc", "steering": "pca9685", "attitude": "bno085", "battery": "iio", "speed": 0.4},
        CAR | {"drive": "pca9685_esc", "steering": "drive", "camera": "mjpeg", "speed": 0.3},
        CAR | {"drive": "maestro_esc", "steering": "drive", "battery": "drive", "cells": 2, "lidar": "ld19"},
        CAR | {"body": "truck", "drive": "vesc", "steering": "maestro", "battery": "steering", "lidar": "ld19"},
        CAR | {"body": "tricycle", "drive": "vesc", "steering": "maestro", "lidar": "hokuyo_urg", "attitude": "os4000"},
        {"drive": "epos", "drive_ratio": 400.0, "attitude": "wt61", "speed": 0.2},
        {"body": "mecanum", "drive": "vesc", "drive_ratio": 12.0, "lidar": "ld19"},
        {"body": "omni", "drive": "steppers", "lidar": "rplidar:c1", "speed": 0.3},
        {"body": "synchro", "drive": "vesc", "drive_ratio": 12.0, "steering": "maestro", "lidar": "ld19"},
        {"body": "independent", "drive": "vesc", "drive_ratio": 12.0, "steering": "maestro", "lidar": "ld19"},
    ],
    ids=lambda more: "-".join(str(value) for value in more.values() if isinstance(value, str)) or "bare",
)
def test_robot_and_twin_are_valid_and_as_described(tmp_path: Path, more: dict[str, object]):
    folder = made(tmp_path, **more)
    robot, twin = load_config(folder / "robot.yaml", TruckConfig)[0], load_simulated(folder / "twin.yaml")
    wanted = Answers.model_validate(ANT | more, strict=False)
    assert not robot.emulated
    assert robot.gate.speed == twin.gate.speed == wanted.speed
    body = twin.sim.world.truck
    assert (body.body.kind, body.wheelbase, body.mass) == (wanted.body, wanted.wheelbase, wanted.mass)
    assert body.motor.ratio == wanted.drive_ratio
    assert twin.devices.present().keys() == robot.devices.present().keys()
    assert robot.missing_actuators() is None
    assert (robot.explorer is None) == (wanted.lidar == "none" or wanted.body == "synchro")


def test_the_twin_differs_by_one_include(tmp_path: Path):
    folder = made(tmp_path, lidar="ld19")
    text = (folder / "twin.yaml").read_text().splitlines()
    assert text[1:] == ["include:", "- robot.yaml", "- simulation.yaml", "version: 2"]


def test_geometry_is_stated_once(tmp_path: Path):
    folder = made(tmp_path, lidar="ld19", lidar_x=0.05)
    file = folder / "robot.yaml"
    file.write_text(file.read_text().replace("track: 0.2\n", "track: 0.21\n").replace("x: 0.05", "x: 0.07"))
    world = load_simulated(folder / "twin.yaml").sim.world
    assert (world.truck.track, world.lidar.x) == (0.21, 0.07)


def test_the_lidar_of_the_twin_is_that_of_the_data_sheet(tmp_path: Path):
    sheet = {"lidar": "sheet_lidar", "beams": 721, "field_of_view": 180.0, "scan_rate": 25.0, "range_max": 8.0}
    twin = load_simulated(made(tmp_path, **sheet) / "twin.yaml")
    assert twin.devices.lidar is not None
    driver = vars(twin.devices.lidar.driver)
    assert (driver["beams"], driver["rate"], driver["range_max"]) == (721, 25.0, 8.0)
    assert driver["field_of_view"] == pytest.approx(math.pi)


def usb(name: str, usb_id: str) -> UsbDevice:
    node = Node("ttyUSB0", "tty", 0, "")
    return UsbDevice(name, 3, usb_id, hub=False, title="", serial=None, autosuspend=False, nodes=(node,))


def test_the_only_device_of_its_kind_is_named_by_hub_and_port(tmp_path: Path):
    tree = TreeSnapshot({"1-1.3": usb("1-1.3", "1a86:7523"), "1-1.4": usb("1-1.4", "10c4:ea60")}, {})
    folder = made(tmp_path, tree, lidar="ld19")
    robot = load_config(folder / "robot.yaml", TruckConfig)[0]
    assert {role: device.port.label for role, device in robot.devices.present().items()} == {
        "lidar": "hub 1-1 port 4",
        "wheels": "hub 1-1 port 3",
    }
    assert not [line for line in next_commands(folder) if "find-port" in line]


def test_devices_that_look_alike_are_left_to_find_port(tmp_path: Path):
    tree = TreeSnapshot({name: usb(name, "10c4:ea60") for name in ("1-1.3", "1-1.4")}, {})
    commands = next_commands(made(tmp_path, tree, lidar="ld19"))
    assert [line.split()[2] for line in commands if "find-port" in line] == ["lidar", "wheels"]


@pytest.mark.parametrize(
    ("more", "complaint"),
    [
        ({"width": 0.1}, r"ant/robot\.yaml:\d+: geometry: .*less than the track"),
        ({"speed": 3.0, "length": 0.3}, "such a robot is impossible: "),
        ({"body": "mecanum"}, "drive arduino_bridge: drives 2 motors, body mecanum has 4"),
        (CAR | {"steering": "maestro"}, "drive arduino_bridge: drives 2 motors, body ackermann has 1"),
        ({"drive": "maestro_esc"}, "drive maestro_esc: drives one motor, body differential has 2"),
    ],
)
def test_impossible_robots_are_refused_and_nothing_is_written(tmp_path: Path, more: dict[str, object], complaint: str):
    with pytest.raises(InputError, match=complaint):
        made(tmp_path, **more)
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_overwritten(tmp_path: Path):
    folder = made(tmp_path, lidar="ld19")
    before = (folder / "robot.yaml").read_text()
    with pytest.raises(InputError, match="exists; choose another name"):
        made(tmp_path, speed=0.4)
    assert (folder / "robot.yaml").read_text() == before


def options(given: dict[str, object]) -> list[str]:
    return [
        word for name, value in given.items() if name != "name" for word in (f"--{name.replace('_', '-')}", str(value))
    ]


def test_the_command_takes_every_answer_as_an_option(tmp_path: Path):
    done = CliRunner().invoke(app, ["new-robot", "ant", "--folder", str(tmp_path), *options(ANT), "--lidar", "ld19"])
    assert done.exit_code == 0, done.output
    assert f"monstertruckd simulate --run --config {tmp_path}/ant/twin.yaml" in done.stdout
    shown = CliRunner().invoke(app, ["new-robot", "--help"]).stdout
    assert not [name for name in Answers.model_fields if name != "name" and f"--{name.replace('_', '-')}" not in shown]


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        ([], "missing --body, --wheelbase, --track"),
        ([*options(ANT), "--drive", "hamster"], "--drive: expected 'vesc', 'arduino_bridge'"),
        ([*options(ANT), "--speed", "fast"], "--speed: expected a number"),
        ([*options(ANT), "--lidar", "sick"], "lidar sick: expected none or one of hokuyo_urg"),
        ([*options(ANT), "--lidar", "rplidar:c9"], "lidar rplidar:c9: model: expected 'a1', 'a2'"),
        ([*options(ANT), "--lidar", "hokuyo_urg:04"], "lidar hokuyo_urg:04: hokuyo_urg has one model"),
        ([*options(ANT), "--steering", "maestro"], "steering maestro: body differential steers nothing; expected none"),
        (
            options(ANT | {"body": "truck", "drive": "vesc"}),
            "steering none: body truck with drive vesc expects maestro or pca9685",
        ),
        (
            options(ANT | CAR | {"drive": "pca9685_esc", "steering": "pca9685"}),
            "steering pca9685: body ackermann with drive pca9685_esc expects drive",
        ),
        (
            options(ANT | CAR | {"drive": "vesc"}),
            "steering none: body ackermann with drive vesc expects drive or maestro or pca9685",
        ),
    ],
)
def test_wrong_options_are_refused_in_one_line(tmp_path: Path, words: list[str], complaint: str):
    done = CliRunner().invoke(app, ["new-robot", "ant", "--folder", str(tmp_path), *words])
    assert done.exit_code == 3
    assert complaint in str(done.exception) + done.output
    assert list(tmp_path.iterdir()) == []


def test_what_no_option_says_is_asked_and_only_if_it_matters(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(command, "on_terminal", lambda _: True)
    given = {name: value for name, value in ANT.items() if name != "speed"}
    words = ["new-robot", "ant", "--folder", str(tmp_path), *options(given)]
    answers = ["fast", "0.4", "", "", "", "ld19", "", "", "", "", ""]
    done = CliRunner().invoke(app, words, input="\n".join(answers) + "\n")
    assert done.exit_code == 0, done.output
    assert "Input should be a valid number" in done.output
    assert "Beams of a scan" not in done.output
    assert "Height of the lidar's plane" in done.output
    assert load_config(tmp_path / "ant" / "robot.yaml", TruckConfig)[0].gate.speed == 0.4
