"""A calibration laid over a configuration: which value wins, where it comes from, what is refused."""

import json
import sys
from pathlib import Path

import pytest

from monstertruck_kinematics.truck import LinkedAxles, TurnDeficit
from monstertruck_runtime.errors import ConfigError
from monstertruckd.config.calibration import CalibrationStore, Estimate, Result, WizardName, value_at
from monstertruckd.config.load import load_truck, resolved
from monstertruckd.tools.cli.main import main

ROOT = Path(__file__).resolve().parents[3]


def result(wizard: WizardName, **values: bool | float) -> Result:
    estimates = tuple(
        Estimate(name=key, value=value, samples=1, meaning="test", key=key.replace("__", "."))
        for key, value in values.items()
    )
    return Result(wizard=wizard, measured="test", estimates=estimates)


DRIVE = result("drive", geometry__drive_ratio=600.5, devices__drive__driver__inverted=False)
STEERING = result(
    "steering", devices__steering__driver__front__centre_us=1450.0, devices__steering__driver__rear__direction=1
)
COMPASS = result("compass", devices__compass__driver__iron__hard_x=7.5)


@pytest.fixture
def config(tmp_path: Path) -> Path:
    file = tmp_path / "truck.yaml"
    file.write_text(f"include: {ROOT}/configs/truck.yaml\nversion: 1\nstate_directory: {tmp_path}/state\n")
    return file


def save(config: Path, *results: Result) -> Path:
    store = CalibrationStore(load_truck(config)[0].calibration_folder, "truck")
    return [store.save(one, 0) for one in results][-1]


def test_the_measured_turn_deficit_is_the_kinematics(config: Path):
    save(config, result("steering", body__turn_deficit__rear_left=0.2, body__turn_deficit__counter_right=-0.1))
    axles = load_truck(config)[0].chassis().linkage
    assert isinstance(axles, LinkedAxles)
    assert axles.deficit == TurnDeficit(rear_left=0.2, counter_right=-0.1)


def test_what_is_measured_of_a_part_that_has_another_name_now_is_not_silently_dropped(
    config: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    assert load_truck(config)[1].unused == []
    save(config, DRIVE, result("sonar", devices__sonar__driver__sonars__left__mount__x=0.3))
    assert load_truck(config)[1].unused == ["devices.sonar.driver.sonars.left.mount.x"]
    monkeypatch.setattr(sys, "argv", ["monstertruckd", "calibrate", "show", "--config", str(config)])
    with pytest.raises(SystemExit):
        main()
    said = "ignored, because the configuration has no such part: devices.sonar.driver.sonars.left.mount.x"
    assert said in capsys.readouterr().err


def test_measured_values_win_and_show_where_they_come_from(config: Path):
    path = save(config, DRIVE, STEERING, COMPASS)
    truck, tree = load_truck(config)
    assert truck.geometry.drive_ratio == 600.5
    assert truck.devices.drive is not None
    assert not truck.devices.drive.driver.inverted
    assert truck.devices.steering is not None
    assert truck.devices.steering.driver.front.centre_us == 1450.0
    assert truck.devices.steering.driver.front.channel == 1, "what stands next to it stays"
    assert truck.devices.steering.driver.rear.direction == 1
    assert truck.devices.compass is not None
    assert truck.devices.compass.driver.iron.hard_x == 7.5
    assert tree.calibration == path
    origin = tree.origins["geometry", "drive_ratio"]
    assert origin.file == path
    assert '"value":600.5' in path.read_text().splitlines()[origin.line - 1].replace(" ", "")


def test_without_a_calibration_nothing_changes(config: Path):
    truck, tree = load_truck(config)
    assert truck.geometry.drive_ratio == 644.0
    assert tree.calibration is None


def test_check_config_names_file_and_line(
    config: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    path = save(config, DRIVE)
    monkeypatch.setattr(sys, "argv", ["monstertruckd", "check-config", str(config)])
    with pytest.raises(SystemExit):
        main()
    shown = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("geometry.drive_ratio"))
    assert "600.5" in shown
    assert f"{path}:" in shown


def test_devices_that_are_not_there_are_left_out(config: Path):
    save(config, STEERING, COMPASS)
    text = config.read_text()
    config.write_text(text + "devices: {steering: null, compass: null}\ntracker: null\nplanner: null\nexplorer: null\n")
    assert load_truck(config)[0].devices.compass is None


def test_a_value_that_does_not_fit_is_refused_by_file_and_key(config: Path):
    path = save(config, result("steering", devices__steering__driver__front__centre_us=900.0))
    with pytest.raises(ConfigError, match=rf"{path}: devices\.steering\.driver\.front: expected min_us 1088"):
        load_truck(config)


def test_no_wizard_sets_anything_else(config: Path):
    path = save(config, result("drive", gate__speed=9.0))
    with pytest.raises(ConfigError, match=rf"{path}: the wizard drive may not set gate\.speed"):
        load_truck(config)


def test_value_at(config: Path):
    data = json.loads(json.dumps(resolved(load_truck(config)[0])))
    assert value_at(data, "geometry.drive_ratio") == 644.0
    assert value_at(data, "devices.steering.driver.front.direction") == -1
    assert value_at(data, "monitors.battery.divider") is None
    assert value_at(data, "devices.nothing.at.all") is None
