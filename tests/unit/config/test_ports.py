"""Where devices hang: by path, or by hub and port, and one line for every mistake in it."""

from pathlib import Path

import pytest

from monstertruck_drivers.config import PortConfig, TcpPortConfig
from monstertruck_drivers.usb.config import UsbPortConfig
from monstertruck_runtime.errors import ConfigError
from monstertruckd.config.load import load_config
from monstertruckd.config.real_ports import real_ports
from monstertruckd.config.truck import TruckConfig

ROOT = Path(__file__).resolve().parents[3]


def truck(folder: Path, text: str) -> TruckConfig:
    file = folder / "truck.yaml"
    file.write_text("version: 1\n" + text)
    return load_config(file, TruckConfig)[0]


def lidar(port: str) -> str:
    return f"devices:\n  lidar:\n    port: {port}\n    driver: {{kind: hokuyo_urg}}\n"


def test_both_ways_to_name_a_port(tmp_path: Path):
    by_path = truck(tmp_path, lidar("{path: /dev/truck/lidar}")).devices.lidar
    by_hub = truck(tmp_path, lidar('{hub: "1-1", port: 3, baud: 19200}')).devices.lidar
    assert by_path is not None
    assert by_path.port == PortConfig(path=Path("/dev/truck/lidar"), baud=115200)
    assert by_hub is not None
    assert by_hub.port == UsbPortConfig(hub="1-1", port=3, baud=19200)


@pytest.mark.parametrize(
    ("port", "expected"),
    [
        ("{baud: 9600}", "devices.lidar.port.path: missing"),
        ('{hub: "1-1"}', "devices.lidar.port.port: missing"),
        ('{hub: "first", port: 1}', "devices.lidar.port.hub: "),
        ('{hub: "1-1", port: 77}', "devices.lidar.port.port: input should be less than or equal to 31, found 77"),
        ('{hub: "1-1", port: 1, path: /dev/x}', "devices.lidar.port.path: unknown key"),
        ("{path: /dev/x, speed: 5}", "devices.lidar.port.speed: unknown key"),
        ("{path: /dev/x, baud: 1}", "devices.lidar.port.baud: input should be greater than or equal to 4800"),
        ("{address: scanner, tcp: 10940}", "devices.lidar.port.address: "),
        ("{address: 192.168.0.300, tcp: 10940}", "devices.lidar.port.address: "),
        ("{address: 192.168.0.10}", "devices.lidar.port.tcp: missing"),
        ("{address: 192.168.0.10, tcp: 0}", "devices.lidar.port.tcp: input should be greater than or equal to 1"),
        ("{address: 192.168.0.10, tcp: 1, baud: 9600}", "devices.lidar.port.baud: unknown key"),
        ("7", "devices.lidar.port: "),
    ],
)
def test_a_mistake_is_one_line_that_names_its_key(port: str, expected: str, tmp_path: Path):
    with pytest.raises(ConfigError) as caught:
        truck(tmp_path, lidar(port))
    said = str(caught.value)
    assert expected in said
    assert len(said.splitlines()) == 1
    assert f"{tmp_path / 'truck.yaml'}:4" in said


def test_a_sensor_on_the_network(tmp_path: Path):
    found = truck(
        tmp_path, lidar("{address: 192.168.0.10, tcp: 10940}").replace("hokuyo_urg", "hokuyo_lx")
    ).devices.lidar
    assert found is not None
    assert found.port == TcpPortConfig(address="192.168.0.10", tcp=10940)
    assert not found.port.is_local
    assert found.port.label == "192.168.0.10:10940"


def test_motor_controllers_and_cameras_are_refused_on_the_network(tmp_path: Path):
    at = "{port: {address: 192.168.0.10, tcp: 10940}, driver: {kind: %s}}"
    for role, kind, expected in (
        ("drive", "epos", "drive: the stop script cannot stop it over the network"),
        ("steering", "maestro", "steering: the stop script cannot stop it over the network"),
        ("camera", "webcam", "camera: a webcam has no network address"),
    ):
        with pytest.raises(ConfigError, match=expected):
            truck(tmp_path, f"devices:\n  {role}: {at % kind}\n")


def test_no_two_devices_share_an_address(tmp_path: Path):
    port = "{address: 192.168.0.10, tcp: 10940}"
    with pytest.raises(ConfigError, match=r"lidar and compass have the same port 192\.168\.0\.10:10940"):
        truck(tmp_path, lidar(port) + f"  compass: {{port: {port}, driver: {{kind: os4000}}}}\n")


def test_no_two_devices_share_a_port(tmp_path: Path):
    two = lidar('{hub: "1-1", port: 3}') + '  compass: {port: {hub: "1-1", port: 3}, driver: {kind: os4000}}\n'
    with pytest.raises(ConfigError, match="lidar and compass have the same port hub 1-1 port 3"):
        truck(tmp_path, two)


def test_the_battery_is_measured_once(tmp_path: Path):
    steering = "devices:\n  steering: {{port: {{path: /dev/s}}, driver: {{kind: maestro{0}}}}}\n"
    text = steering + "monitors:\n  battery: {{kind: iio}}\n"
    with pytest.raises(ConfigError, match="both measure the battery"):
        truck(tmp_path, text.format(""))
    assert truck(tmp_path, text.format(", battery: null")).monitors.battery is not None


def test_the_shipped_truck_has_everything_on_two_hubs():
    config = load_config(ROOT / "configs" / "truck.yaml", TruckConfig)[0]
    ports = {role: device.port for role, device in config.devices.present().items()}
    assert set(ports) == {"lidar", "drive", "steering", "compass", "stabiliser", "camera"}
    assert {port.hub for port in ports.values() if isinstance(port, UsbPortConfig)} == {"1-1", "1-2"}
    assert ports["stabiliser"].baud == 1_000_000


def test_an_i2c_bus_has_a_path(tmp_path: Path):
    steering = "devices:\n  steering: {port: %s, driver: {kind: pca9685, rear: {channel: 4}}}\n"
    config = truck(tmp_path, steering % "{path: /dev/i2c-1}")
    assert config.devices.steering is not None
    assert config.devices.steering.port.label == "/dev/i2c-1"
    assert any("a PCA9685 has no watchdog" in text for text in config.weakened())
    with pytest.raises(ConfigError, match="steering: a pca9685 is on an I2C bus; expected a path such as /dev/i2c-1"):
        truck(tmp_path, steering % '{hub: "1-1", port: 1}')


def test_a_program_is_a_camera_only(tmp_path: Path):
    at = "devices:\n  %s: {port: {command: [rpicam-vid, -o, '-']}, driver: {kind: %s}}\n"
    config = truck(tmp_path, at % ("camera", "mjpeg"))
    assert config.devices.camera is not None
    assert config.devices.camera.port.label == "rpicam-vid -o -"
    assert real_ports(config.devices, config.machine) == ("camera",)
    for role, kind in (("drive", "epos"), ("camera", "webcam"), ("lidar", "ld19")):
        with pytest.raises(ConfigError, match=f"{role}: only a camera of kind mjpeg may read the output of a program"):
            truck(tmp_path, at % (role, kind))
