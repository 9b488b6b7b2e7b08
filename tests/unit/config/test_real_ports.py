"""A robot is real or emulated: which ports are real, and the refusal of a mixture."""

from pathlib import Path

import pytest

from monstertruck_runtime.errors import ConfigError
from monstertruck_runtime.yaml_files import read_yaml
from monstertruckd.config.load import load_tree, load_truck
from monstertruckd.config.real_ports import real_ports
from monstertruckd.config.truck import TruckConfig

CONFIGS = Path(__file__).resolve().parents[3] / "configs"
PARTS = sorted((CONFIGS / "parts").glob("*.yaml"))


def lidar_at(port: dict, **more: object) -> TruckConfig:
    lidar = {"port": port, "driver": {"kind": "hokuyo_urg"}}
    return TruckConfig.model_validate({"version": 2, "devices": {"lidar": lidar}, **more}, strict=False)


def roles_of(config: TruckConfig) -> tuple[str, ...]:
    return real_ports(config.devices, config.machine)


@pytest.mark.parametrize(
    ("port", "machine", "real"),
    [
        ({"hub": "1-1", "port": 1}, "/", True),
        ({"hub": "1-1", "port": 1}, "runs/machine", False),
        ({"path": "/dev/truck/lidar"}, "/", True),
        ({"path": "/dev/truck/lidar"}, "runs/machine", True),
        ({"path": "/dev/pts/7"}, "/", False),
        ({"path": "/dev/shm/ports/lidar"}, "/", False),
        ({"path": "/run/user/1000/monstertruckd/ports/truck/lidar"}, "/", False),
        ({"path": "/run/../dev/ttyACM0"}, "/", True),
        ({"address": "192.168.0.10", "tcp": 10940}, "/", True),
        ({"address": "127.0.0.2", "tcp": 10940}, "/", False),
    ],
)
def test_which_ports_are_real(port: dict, machine: str, real: bool):
    assert roles_of(lidar_at(port, machine=machine)) == (("lidar",) if real else ())


def test_a_link_is_where_it_leads(tmp_path: Path):
    for target, real in (("/dev/ttyUSB7", True), ("/dev/pts/7", False)):
        link = tmp_path / Path(target).name
        link.symlink_to(target)
        assert bool(roles_of(lidar_at({"path": str(link)}))) is real
    root = tmp_path / "machine"
    root.symlink_to("/")
    assert roles_of(lidar_at({"hub": "1-1", "port": 1}, machine=str(root))) == ("lidar",)


@pytest.mark.parametrize(
    ("text", "lines"),
    [
        ("include: [{0}/truck.yaml, {0}/demo.yaml]", ["{0}/demo.yaml:20: sim: a simulation cannot use the real port"]),
        (
            "include: [{0}/slam.yaml, {0}/truck.yaml]",
            ["{0}/slam.yaml:10: sim: a simulation cannot", "{0}/slam.yaml:6: stand: a simulation cannot"],
        ),
        ("include: {0}/truck.yaml\nstand: simulator", ["{1}:2: stand: a simulation cannot use the real port"]),
        ("include: {0}/truck.yaml\nsim: {{seed: 2}}", ["{1}:2: sim: a simulation cannot use the real port"]),
        (
            "include: {0}/demo.yaml\ndevices:\n  drive:\n    port: {{path: /dev/truck/drive}}",
            ["{0}/demo.yaml:20: sim: a simulation cannot use the real port devices.drive.port ({1}:4)"],
        ),
        ("include: {0}/full.yaml\nmachine: /", ["{0}/full.yaml:30: sim: a simulation cannot use the real port"]),
    ],
)
def test_a_simulation_with_real_ports_is_refused_by_file_and_line(text: str, lines: list[str], tmp_path: Path):
    file = tmp_path / "mine.yaml"
    file.write_text(text.format(CONFIGS) + "\nversion: 2\n")
    with pytest.raises(ConfigError) as refused:
        load_truck(file)
    said = str(refused.value).splitlines()
    assert len(said) == len(lines)
    for line, expected in zip(said, lines, strict=True):
        assert line.startswith(expected.format(CONFIGS, file)), line


def test_no_shipped_configuration_is_a_mixture():
    assert roles_of(load_truck(CONFIGS / "truck.yaml")[0])
    assert not roles_of(load_truck(CONFIGS / "truck_emulated.yaml")[0])


@pytest.mark.parametrize("part", PARTS, ids=lambda part: part.stem)
def test_a_part_has_no_simulation_no_path_and_no_place_to_start(part: Path):
    data = load_tree(part).data
    assert not {"sim", "stand", "machine"} & data.keys()
    assert data.get("path") is None, "null takes away the path of what includes it"
    assert "start" not in data.get("odometry", {})
    assert not any("port" in device for device in data.get("devices", {}).values())


def test_the_twin_differs_by_one_include():
    twin = read_yaml(CONFIGS / "truck_emulated.yaml")
    assert twin.keys() == {"include", "version"}
    assert twin["include"][0] == "truck.yaml"
    assert len(twin["include"]) == 2


def test_the_truck_can_do_what_it_was_built_for():
    config = load_truck(CONFIGS / "truck.yaml")[0]
    assert config.slam is not None
    assert config.slam.mode == "mapping"
    assert config.slam.save is not None
    for section in ("tracker", "planner", "explorer", "points", "recorder", "blackbox", "consistency"):
        assert getattr(config, section) is not None, section
    assert config.devices.camera is not None
    assert config.devices.stabiliser is not None
    assert config.path is None
    assert config.gate.speed < TruckConfig.model_fields["gate"].default.speed
    assert config.weakened() == ()
