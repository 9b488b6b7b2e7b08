"""Configurations that somebody gets wrong: one line with file, line, key and what was expected."""

from pathlib import Path

import pytest

from monstertruck_runtime.errors import ConfigError
from monstertruck_schemas.reasons import Reason
from monstertruckd.tools.simulation.config import load_simulated

DEMO = Path(__file__).resolve().parents[3] / "configs" / "demo.yaml"

WRONG = (
    ("robot: [a]", "robot: input should be a valid string"),
    ('robot: ""', "robot: string should match pattern '^[a-z][a-z0-9_-]{0,31}$', found ''"),
    ("robot: a/b", "robot: string should match pattern '^[a-z][a-z0-9_-]{0,31}$', found 'a/b'"),
    ("robot: 5", "robot: input should be a valid string, found 5"),
    ("robt: truck", "robt: unknown key (did you mean robot?)"),
    ("geometry: 3", "geometry: input should be an object, found 3"),
    ("geometry: {wheelbase: -0.3}", "geometry.wheelbase: input should be greater than 0, found -0.3"),
    ("geometry: {wheelbase: .nan}", "geometry.wheelbase: input should be a finite number, found nan"),
    ('geometry: {wheelbase: "0.3 m"}', "geometry.wheelbase: input should be a valid number, found '0.3 m'"),
    ("geometry: {wheelbas: 0.3}", "geometry.wheelbas: unknown key (did you mean wheelbase?)"),
    ("geometry: {wheel_radius: 0}", "geometry.wheel_radius: input should be greater than 0, found 0"),
    ("geometry: {drive_ratio: yes}", "geometry.drive_ratio: input should be a valid number, found 'yes'"),
    ("body: {kind: tank}", "body: unknown kind 'tank'; expected one of"),
    ("body: {kind: mecanum, wheel: 3}", "body.wheel: unknown key; expected one of"),
    ("devices: []", "devices: input should be an object"),
    ("devices: {lidr: {}}", "devices.lidr: unknown key (did you mean lidar?)"),
    (
        "zenoh: {listen: [nonsense]}",
        "zenoh.listen: 'nonsense' is not an endpoint: expected tcp/HOST:PORT or tls/HOST:PORT",
    ),
    (
        "zenoh: {connect: [tcp/router]}",
        "zenoh.connect: 'tcp/router' is not an endpoint: expected tcp/HOST:PORT or tls/HOST:PORT",
    ),
    (
        "devices: {lidar: {port: /dev/truck/lidar}}",
        "devices.lidar.port: input should be an object, found '/dev/truck/lidar'",
    ),
    (
        "devices: {lidar: {port: {path: /dev/truck/lidar, baud: 0}}}",
        "devices.lidar.port.baud: input should be greater than or equal to 4800, found 0",
    ),
    (
        "devices: {lidar: {port: {path: /dev/truck/lidar, baud: fast}}}",
        "devices.lidar.port.baud: input should be a valid integer, found 'fast'",
    ),
    (
        "devices: {lidar: {port: {path: /dev/truck/drive}}, drive: {port: {path: /dev/truck/drive}}}",
        "devices: lidar and drive have the same port /dev/truck/drive; expected a port for each",
    ),
    (
        "devices: {lidar: {driver: {kind: sick}}}",
        "devices.lidar: unknown kind 'sick'; expected one of 'hokuyo_urg', 'hokuyo_lx', 'ld19', 'rplidar'",
    ),
    (
        "devices: {lidar: {driver: {kind: epos}}}",
        "devices.lidar: unknown kind 'epos'; expected one of 'hokuyo_urg', 'hokuyo_lx', 'ld19', 'rplidar'",
    ),
    ("devices: {lidar: {mount: {x: far}}}", "devices.lidar.mount.x: input should be a valid number, found 'far'"),
    ("devices: {lidar: {mount: {x: .inf}}}", "devices.lidar.mount.x: input should be a finite number, found inf"),
    (
        "devices: {lidar: {mount: {pitch: 3.0, yaw: 0.5}}}",
        "devices: lidar.mount.pitch 3: expected -pi/2 to pi/2; "
        "the same orientation is roll 3.1416, pitch 0.1416, yaw -2.6416",
    ),
    (
        "devices: {drive: {driver: {node: 900}}}",
        "devices.drive.driver.node: input should be less than or equal to 127, found 900",
    ),
    (
        "devices: {drive: {driver: {inverted: on}}}",
        "devices.drive.driver.inverted: input should be a valid boolean, found 'on': writ",
    ),
    (
        "devices: {steering: {driver: {front: {channel: 99}}}}",
        "devices.steering.driver.front.channel: input should be less than 6, found 99",
    ),
    (
        "devices: {steering: {driver: {front: {channel: 0}}}}",
        "devices.steering.driver: every channel may have only one use, got {'front': 0, '",
    ),
    (
        "devices: {steering: {driver: {battery: {channel: 5, cells: 0}}}}",
        "devices.steering.driver.battery.cells: input should be greater than or equal to ",
    ),
    (
        "devices: {steering: {driver: {dead_time: -1}}}",
        "devices.steering.driver.dead_time: input should be greater than or equal to 0, f",
    ),
    (
        "devices: {compass: {driver: {rate: 10000}}}",
        "devices.compass.driver.rate: input should be less than or equal to 40, found 100",
    ),
    (
        "devices: {lidar: {restart: {factor: 0}}}",
        "devices.lidar.restart.factor: input should be greater than or equal to 1, found ",
    ),
    ("monitors: {host: yes please}", "monitors.host: input should be an object, found 'yes please'"),
    ("monitors: {printer: {}}", "monitors.printer: unknown key; expected one of"),
    ("gate: {rate: 0}", "gate.rate: input should be greater than or equal to 10, found 0"),
    ("gate: {rate: 1e9}", "gate.rate: input should be less than or equal to 200, found 1000000000.0"),
    ("gate: {max_speed: -1}", "gate.max_speed: unknown key (did you mean speed?)"),
    ("gate: {scan: {stale_after: 100}}", "gate.scan.stale_after: input should be less than or equal to 60, found 100"),
    ("gate: {scan: {stale_after: soon}}", "gate.scan.stale_after: input should be a valid number, found 'soon'"),
    ("gate: {leases: {pilot: 0}}", "gate.leases.pilot: unknown key; expected one of"),
    (
        "gate: {obstacle: {memory_distance: -1}}",
        "gate.obstacle.memory_distance: input should be greater than or equal to 0, found",
    ),
    ("gate: {unknown: 1}", "gate.unknown: unknown key; expected one of"),
    ("recorder: {directory: 5}", "recorder.directory: input should be a valid string, found 5"),
    ("recorder: {max_bytes: -1}", "recorder.max_bytes: unknown key (did you mean quota_bytes?)"),
    ("blackbox: {before: -5}", "blackbox.before: input should be greater than 0, found -5"),
    ("zenoh: {listen: tcp/127.0.0.1}", "zenoh.listen: input should be a valid array, found 'tcp/127.0.0.1'"),
    (
        'zenoh: {listen: ["tcp/0.0.0.0:7447"], gather_seconds: x}',
        "zenoh.gather_seconds: input should be a valid number, found 'x'",
    ),
    ("zenoh: {mode: boss}", "zenoh.mode: input should be 'router' or 'peer', found 'boss'"),
    ("path: {file: nowhere.csv}", "path.file: no such file"),
    ("path: {file: .}", "path.file: expected a file, found a folder: "),
    ("planner: {map: .}", "planner.map: no saved map in this folder: "),
    ("path: {closed: true, file: 3}", "path.file: input should be a valid string, found 3"),
    ("tracker: {kind: crystal_ball}", "tracker: unknown kind 'crystal_ball'; expected one of"),
    ("tracker: {kind: lqr, lookahead: 1}", "tracker.lookahead: unknown key; expected one of"),
    ("tracker: {goal_tolerance: -0.1}", "tracker.goal_tolerance: input should be greater than 0, found -0.1"),
    ("tracker: {speed: 1e400}", "tracker.speed: input should be a finite number, found inf"),
    ("planner: {route: {kind: teleport}}", "planner.route: unknown kind 'teleport'; expected one of"),
    ("planner: {local_planner: {kind: wizard}}", "planner.local_planner: unknown kind 'wizard'; expected one of"),
    ("odometry: {start: {x: here}}", "odometry.start.x: input should be a valid number, found 'here'"),
    ("odometry: {kind: guess}", "odometry: unknown kind 'guess'; expected one of"),
    ("map: {period: 0}", "map.period: input should be greater than or equal to 0.1, found 0"),
    ("sim: {seed: x}", "sim.seed: input should be a valid integer, found 'x'"),
    ("calibration_folder: 7", "calibration_folder: unknown key (did you mean calibration?)"),
    ("machine: [x]", "machine: input should be a valid string"),
    ("state_directory: {}", "state_directory: input should be a valid string"),
    ("include: missing.yaml", "include: no such file"),
    ("version: 99", "version: expected 1 to 2, found 99"),
    ("version: two", "version: expected 1 to 2, found 'two'"),
    ("placement: moon", "placement: input should be an object, found 'moon'"),
    ("tracker: {placement: moon}", "tracker.placement: unknown key; expected one of"),
    ("slam: {kind: psychic}", "slam.kind: unknown key; expected one of"),
)
"""What is laid over the demo's configuration, and the complaint after file and line."""


@pytest.mark.parametrize(("text", "expected"), WRONG, ids=[text for text, _ in WRONG])
def test_a_wrong_configuration_is_one_clear_line(text: str, expected: str, tmp_path: Path):
    file = tmp_path / "truck.yaml"
    above = {"include": str(DEMO), "version": "2"}
    above.pop(text.split(":", maxsplit=1)[0], None)
    file.write_text("".join(f"{key}: {value}\n" for key, value in above.items()) + text + "\n")
    with pytest.raises(ConfigError) as caught:
        load_simulated(file)
    line = len(above) + 1
    assert str(caught.value).startswith(f"{file}:{line}: {expected}")
    assert "\n" not in str(caught.value)
    assert caught.value.reason is Reason.BAD_CONFIG


def test_they_are_sixty_at_least():
    assert len({text for text, _ in WRONG}) >= 60
