"""`config` and `topics` as a user sees them: one clear line per mistake, exit code 2."""

import json
import sys
from pathlib import Path

import pytest

from monstertruck_schemas.topics import TOPICS
from monstertruckd.config import migrate
from monstertruckd.tools.cli.main import main

ROOT = Path(__file__).resolve().parents[4]
SHIPPED = sorted((ROOT / "configs").glob("*.yaml"))


def run(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["monstertruckd", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    return int(ended.value.code or 0)


@pytest.mark.parametrize("config", SHIPPED, ids=lambda path: path.name)
def test_every_shipped_configuration_is_accepted(
    config: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    assert run(monkeypatch, "config", "show", str(config)) == 0
    out = capsys.readouterr().out
    assert f"{config}:" in out, "every value shows its origin"
    assert " default" in out


def test_json_output_has_values_and_origins(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    assert run(monkeypatch, "config", "show", "--json", str(ROOT / "configs" / "demo.yaml")) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["config"]["geometry"]["wheelbase"] == 0.32
    assert shown["origins"]["geometry.wheelbase"].endswith("chassis.yaml:7")


def test_a_key_chooses_what_is_shown(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    robot = str(ROOT / "configs" / "robots" / "mecanum.yaml")
    assert run(monkeypatch, "config", "show", robot, "-k", "geometry.track", "-k", "gate.leases") == 0
    lines = capsys.readouterr().out.splitlines()[1:]
    assert [line.split()[0] for line in lines] == [
        "geometry.track",
        *(f"gate.leases.{role}" for role in ("hand", "gamepad", "keyboard", "station", "tracker")),
    ]
    assert lines[0].endswith(f"{ROOT}/configs/parts/chassis.yaml:8"), "included files are named the short way"
    assert run(monkeypatch, "config", "show", robot, "--key", "geometry.track", "--json") == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["config"] == {"geometry": {"track": 0.26}}
    assert list(shown["origins"]) == ["geometry.track"]
    assert run(monkeypatch, "config", "show", robot, "--key", "geometry.tra") == 4
    assert "no settings at geometry.tra; sections: version, robot, body, geometry" in capsys.readouterr().err


def test_the_first_name_of_config_show_still_works(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    assert run(monkeypatch, "check-config", str(SHIPPED[0])) == 0
    assert capsys.readouterr().out.startswith("key ")


@pytest.fixture
def older(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file of a version 0 that called the robot otherwise."""
    monkeypatch.setitem(migrate.STEPS, 0, lambda text: text.rename(("bot",), "robot"))
    file = tmp_path / "old.yaml"
    file.write_text("version: 0\nbot: rover  # mine\n")
    return file


def test_migrate_writes_and_says_so(older: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    assert run(monkeypatch, "config", "migrate", str(older), "--dry-run") == 0
    assert "-bot: rover  # mine\n+version: 2\n+robot: rover  # mine\n" in capsys.readouterr().out
    assert run(monkeypatch, "config", "migrate", str(older), "--json") == 0
    (file,) = json.loads(capsys.readouterr().out)["files"]
    assert (file["version"], file["previous"]) == (0, f"{older}.v0")
    assert older.read_text() == "version: 2\nrobot: rover  # mine\n"
    assert run(monkeypatch, "config", "migrate", str(older)) == 0
    assert capsys.readouterr().err == f"{older}: up to date, version 2\n"


TRUCK = """version: 1
devices:
  lidar: {port: {path: /dev/a}, driver: {kind: hokuyo_urg}}
  compass: {port: {path: /dev/b}, driver: {kind: os4000}}
"""


@pytest.mark.parametrize(
    ("text", "where", "said"),
    [
        (TRUCK + "gaet: {}\n", "bad.yaml:5: gaet: unknown key (did you mean gate?)", ""),
        (
            TRUCK + "gate: {acceleraton: 1}\n",
            "gate.acceleraton: unknown key (did you mean acceleration?)",
            "",
        ),
        (
            TRUCK + "geometry: {wheelbase: 32 cm}\n",
            "bad.yaml:5: geometry.wheelbase: ",
            "Distance between front and rear",
        ),
        (
            TRUCK + "geometry: {wheelbase: 32}\n",
            "bad.yaml:5: geometry.wheelbase: ",
            "Distance between front and rear",
        ),
        (TRUCK + "path: {file: nowhere.csv}\n", "bad.yaml:5: path.file: no such file: ", "nowhere.csv"),
        ("include: gone.yaml\n" + TRUCK, "bad.yaml:1: include: no such file: ", "gone.yaml"),
        (
            TRUCK.replace("/dev/b", "/dev/a"),
            "bad.yaml:2: devices: lidar and compass have the same port /dev/a",
            "a port for each",
        ),
        (TRUCK + "geometry: {length: 0.3}\n", "bad.yaml:5: geometry: impossible geometry", "less than the wheelbase"),
        (TRUCK + "geometry: {width: 0.2}\n", "bad.yaml:5: geometry: impossible geometry", "less than the track"),
        (TRUCK + "geometry: {wheel_radius: 0.2}\n", "bad.yaml:5: geometry: impossible geometry", "touch"),
        (TRUCK.replace("hokuyo_urg", "sick"), "bad.yaml:3: devices.lidar: ", "hokuyo_urg"),
        (TRUCK + "tracker: {kind: pure_pursuit}\n", "a tracker needs the devices drive and steering", ""),
        ("version: 2\ndevices: {}\nlidar_sonars: {}\n", "lidar_sonars needs the device lidar, and no device sonar", ""),
        (TRUCK + "sim: {world: {map: loop, gravity: 1}}\n", "bad.yaml:5: sim.world.gravity: unknown key", ""),
    ],
)
def test_a_mistake_is_one_clear_line_and_exit_code_2(
    text: str,
    where: str,
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    bad = tmp_path / "bad.yaml"
    bad.write_text(text)
    assert run(monkeypatch, "config", "show", str(bad)) == 2
    streams = capsys.readouterr()
    assert streams.out == ""
    assert len(streams.err.strip().splitlines()) == 1
    assert where in streams.err
    assert said in streams.err


def test_the_gate_may_not_promise_more_braking_than_the_drive_has(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    config = tmp_path / "brave.yaml"
    config.write_text(
        f"include: {ROOT}/configs/truck.yaml\nversion: 1\ngate: {{deceleration: 1.0, quick_deceleration: 5}}\n"
    )
    assert run(monkeypatch, "config", "show", str(config)) == 2
    assert "gate.quick_deceleration 5.0 m/s^2: the drive is configured to brake with" in capsys.readouterr().err


def test_topics_prints_every_row(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.setenv("COLUMNS", "160")
    assert run(monkeypatch, "topics") == 0
    out = capsys.readouterr().out
    assert all(topic.name in out for topic in TOPICS)
    assert run(monkeypatch, "topics", "--json") == 0
    assert [row["name"] for row in json.loads(capsys.readouterr().out)] == [topic.name for topic in TOPICS]


def test_unknown_device_and_topic_are_named(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    assert run(monkeypatch, "probe", "toaster", "--port", "/dev/null") == 3
    assert "unknown device 'toaster'; known: hokuyo_urg (lidar)" in capsys.readouterr().err
    assert run(monkeypatch, "echo", "sensor/smell") == 4
    assert "no topic sensor/smell" in capsys.readouterr().err


@pytest.mark.parametrize("device", ["host", "link", "battery"])
def test_what_hangs_on_no_port_says_so(
    device: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    assert run(monkeypatch, "probe", device, "--port", "/dev/null") == 3
    assert "has no port" in capsys.readouterr().err


def test_version(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    assert run(monkeypatch, "--version") == 0
    assert capsys.readouterr().out.strip().count(".") == 2
