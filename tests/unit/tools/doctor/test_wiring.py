"""What hangs where, against the configuration, on an emulated computer."""

from pathlib import Path

import pytest

from monstertruck_drivers.config import PortConfig
from monstertruck_schemas.reasons import Reason
from monstertruckd.tools.doctor.context import Level
from monstertruckd.tools.doctor.devices import handshakes, wiring
from monstertruckd.tools.doctor.software import rights
from tests.unit.tools.doctor.kit import EmulatedHost, bad, see
from tests.unit.tools.install.kit import TRUCK

FIND_LIDAR = f"/opt/monstertruckd/.venv/bin/python -m monstertruckd find-port lidar --write {TRUCK}"


def test_everything_in_its_place(tmp_path: Path):
    found = see(tmp_path, wiring)
    assert bad(found) == {}
    assert found["drive"].seen == "hub 1-1 port 1: 0403:6001 FT232R USB UART as ttyUSB0"
    assert sorted(found) == ["camera", "compass", "drive", "lidar", "stabiliser", "steering"]


def unplug(emulated: EmulatedHost) -> None:
    emulated.computer.usb.unplug("1-2.1")


def move(emulated: EmulatedHost) -> None:
    emulated.computer.usb.move("1-2.1", "1-2.4")


def swap(emulated: EmulatedHost) -> None:
    emulated.computer.usb.unplug("1-2.1")
    emulated.computer.usb.add_device("1-2.1", "1d50:6018", "Black Magic", node="ttyACM")


def lose(emulated: EmulatedHost) -> None:
    emulated.computer.usb.lose_hub("1-2")


@pytest.mark.parametrize(
    ("change", "reason", "seen", "fix"),
    [
        (unplug, Reason.DEVICE_LOST, "hub 1-2 port 1: not plugged in", FIND_LIDAR),
        (
            move,
            Reason.PORT_MOVED,
            "hub 1-2 port 1: not plugged in, but 15d1:0000 is at hub 1-2 port 4",
            FIND_LIDAR,
        ),
        (swap, Reason.DEVICE_WRONG, "hub 1-2 port 1: expected 15d1:0000, found 1d50:6018 Black Magic", FIND_LIDAR),
        (lose, Reason.HUB_LOST, "hub 1-2 port 1: hub 1-2 is missing", None),
    ],
)
def test_a_device_that_is_not_where_it_should_be(change, reason: Reason, seen: str, fix: str | None, tmp_path: Path):
    found = see(tmp_path, wiring, change)["lidar"]
    assert (found.level, found.reason, found.seen) == (Level.FAIL, reason, seen)
    assert fix in (None, found.fix)
    assert found.fix is not None


@pytest.mark.parametrize(
    ("role", "place", "usb_id", "module"),
    [
        ("drive", "1-1.1", "0403:6001", "ftdi_sio"),
        ("lidar", "1-2.1", "15d1:0000", "cdc_acm"),
        ("camera", "1-2.2", "046d:080a", "uvcvideo"),
    ],
)
def test_a_device_without_its_kernel_module(role: str, place: str, usb_id: str, module: str, tmp_path: Path):
    def change(emulated: EmulatedHost) -> None:
        emulated.computer.usb.unplug(place)
        emulated.computer.usb.add_device(place, usb_id)

    assert see(tmp_path, wiring, change)[role].fix == f"sudo modprobe {module}"


@pytest.mark.parametrize("runs", [True, False])
def test_an_adapter_that_brltty_or_another_program_holds(runs: bool, tmp_path: Path):
    def change(emulated: EmulatedHost) -> None:
        emulated.computer.usb.claim("1-1.1")
        if runs:
            emulated.put("proc/77/comm", "brltty\n")

    found = see(tmp_path, wiring, change)["drive"]
    assert found.reason is Reason.DEVICE_BUSY
    assert "a program holds interface 0 through usbfs" in found.seen
    assert found.fix is not None
    assert found.fix.startswith("sudo apt-get remove brltty" if runs else "sudo fuser -v /dev/bus/usb/001/")


def test_slow_sleepy_and_greedy_ports(tmp_path: Path):
    def change(emulated: EmulatedHost) -> None:
        emulated.latencies[0].write_text("16")
        emulated.computer.usb.suspend_when_idle("1-1.2")
        emulated.computer.usb.over_current("1-2.1")

    found = bad(see(tmp_path, wiring, change))
    assert {name: finding.reason for name, finding in found.items()} == {
        "drive latency": Reason.SLOW_LINK,
        "steering power": Reason.AUTOSUSPEND,
        "over-current": Reason.OVER_CURRENT,
    }
    assert all(finding.level is Level.WARN for finding in found.values())
    assert found["drive latency"].seen == "ttyUSB0 has a latency of 16 ms instead of 1 ms"
    assert found["drive latency"].fix == "echo 1 | sudo tee /sys/bus/usb/devices/1-1.1:1.0/ttyUSB0/latency_timer"
    assert found["steering power"].fix == "echo on | sudo tee /sys/bus/usb/devices/1-1.2/power/control"


def test_a_device_by_its_path(tmp_path: Path):
    def by_path(emulated: EmulatedHost) -> None:
        assert emulated.context.config is not None
        lidar = emulated.context.config.devices.lidar
        assert lidar is not None
        port = PortConfig(path=Path("/dev/truck/lidar"))
        devices = emulated.context.config.devices.model_copy(update={"lidar": lidar.model_copy(update={"port": port})})
        emulated.change(devices=devices.model_dump())

    def linked(emulated: EmulatedHost) -> None:
        by_path(emulated)
        emulated.put("dev/truck/lidar")

    missing = see(tmp_path / "a", wiring, by_path)["lidar"]
    assert (missing.seen, missing.fix) == ("/dev/truck/lidar: does not exist", FIND_LIDAR)
    assert see(tmp_path / "b", wiring, linked)["lidar"].level is Level.OK


def on_a_bus(emulated: EmulatedHost) -> None:
    """Steer by a PCA9685."""
    assert emulated.context.config is not None
    devices = emulated.context.config.devices.model_dump()
    devices["steering"] = {"port": {"path": Path("/dev/i2c-1")}, "driver": {"kind": "pca9685", "rear": {"channel": 4}}}
    emulated.change(devices=devices)


def test_a_device_on_an_i2c_bus(tmp_path: Path):
    found = see(tmp_path / "a", wiring, on_a_bus)["steering"]
    assert found.seen == "/dev/i2c-1: does not exist; enable the bus in the computer's settings"
    assert found.fix == "sudo modprobe i2c-dev"

    def closed(emulated: EmulatedHost) -> None:
        on_a_bus(emulated)
        emulated.put("dev/i2c-1")
        (emulated.folder / "dev/i2c-1").chmod(0o600)

    found = bad(see(tmp_path / "b", rights, closed))["user"]
    assert found.fix == "sudo usermod -aG i2c monstertruckd"
    shaken = see(tmp_path / "c", handshakes, closed)["steering handshake"]
    assert shaken.reason is Reason.DEVICE_LOST


@pytest.mark.parametrize("program", ["sh", "rpicam-vid-that-is-not-there"])
def test_a_camera_that_is_a_program(program: str, tmp_path: Path):
    def camera(emulated: EmulatedHost) -> None:
        assert emulated.context.config is not None
        devices = emulated.context.config.devices.model_dump()
        devices["camera"] = {"port": {"command": (program, "-c", "exit 3")}, "driver": {"kind": "mjpeg"}}
        emulated.change(devices=devices)

    found = see(tmp_path / "a", wiring, camera)["camera"]
    if program == "sh":
        assert found.seen == "output of sh -c 'exit 3'"
    else:
        assert (found.seen, found.fix) == (f"{program}: no such program", f"apt-file search bin/{program}")
