"""What sysfs says is read as it is, wherever the root."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from monstertruck_drivers.computer import Sysfs
from monstertruck_drivers.usb.tree import (
    DEVICES,
    ancestors,
    device_name,
    parent_of,
    place,
    port_directory,
    port_of,
    read_device,
    read_tree,
    sort_key,
)
from tests.unit.drivers.usb.rig import emulated_truck


@pytest.mark.parametrize(
    ("hub", "port", "name"),
    [("usb1", 2, "1-2"), ("1-1", 2, "1-1.2"), ("1-1.4", 3, "1-1.4.3"), ("usb12", 10, "12-10")],
)
def test_a_name_is_its_hub_and_port(hub: str, port: int, name: str):
    assert device_name(hub, port) == name
    assert parent_of(name) == hub
    assert port_of(name) == port


def test_root_hubs_hang_on_nothing():
    assert parent_of("usb3") is None
    assert port_of("usb3") == 0
    assert place("usb3") == "usb3"
    with pytest.raises(ValueError, match="root hub"):
        port_directory("usb3")


@given(st.integers(1, 99), st.lists(st.integers(1, 31), min_size=1, max_size=6))
def test_names_go_up_to_the_root_hub(bus: int, ports: list[int]):
    name = f"usb{bus}"
    chain = [name]
    for port in ports:
        name = device_name(name, port)
        chain.append(name)
    assert list(ancestors(name)) == chain[-2::-1]
    assert sorted(chain, key=sort_key) == chain, "parents before children"


def test_ports_have_the_kernels_folders():
    assert port_directory("1-2") == f"{DEVICES}/1-0:1.0/usb1-port2"
    assert port_directory("1-1.2") == f"{DEVICES}/1-1:1.0/1-1-port2"


def test_the_whole_tree(tmp_path: Path):
    usb, _ = emulated_truck(tmp_path)
    seen = read_tree(usb.sysfs)
    assert list(seen.devices) == ["usb1", "1-1", "1-1.1", "1-1.2", "1-1.3", "1-1.4", "1-2", "1-2.1", "1-2.2"]
    assert [name for name, device in seen.devices.items() if device.hub] == ["usb1", "1-1", "1-2"]
    lidar = seen.devices["1-1.1"]
    assert (lidar.usb_id, lidar.title, lidar.serial) == ("15d1:0000", "URG-Series USB Driver", None)
    assert lidar.tty is not None
    assert (lidar.tty.name, lidar.tty.latency_ms) == ("ttyACM0", None)
    drive = seen.devices["1-1.3"]
    assert drive.serial == "A1"
    assert drive.tty is not None
    assert (drive.tty.name, drive.tty.latency_ms) == ("ttyUSB0", 16)
    camera = seen.devices["1-2.2"]
    assert camera.tty is None
    node = camera.find("video4linux")
    assert node is not None
    assert node.name == "video0"
    assert dict.fromkeys(seen.over_current, 0) == seen.over_current
    assert {"1-1", "1-8", "1-1.1", "1-2.4"} <= seen.over_current.keys()
    for name, device in seen.devices.items():
        assert read_device(usb.sysfs, name) == device, "one look at one device sees the same"


def test_the_interface_decides_between_two_nodes(tmp_path: Path):
    usb, _ = emulated_truck(tmp_path)
    usb.unplug("1-1.2")
    usb.add_device("1-1.2", "1ffb:0089", node="ttyACM", interface=2)
    device = read_device(usb.sysfs, "1-1.2")
    assert device is not None
    assert device.find("tty", 0) is None
    node = device.find("tty", 2)
    assert node is not None
    assert node.interface == 2


def test_devices_that_vanish_meanwhile_are_left_out(tmp_path: Path):
    usb, _ = emulated_truck(tmp_path)
    (usb.sysfs.root / DEVICES / "1-1.1" / "idProduct").unlink()
    (usb.sysfs.root / DEVICES / "1-1.2" / "devnum").write_text("")
    assert {"1-1.1", "1-1.2"}.isdisjoint(read_tree(usb.sysfs).devices)


def test_a_machine_without_usb_has_an_empty_tree(tmp_path: Path):
    seen = read_tree(Sysfs(tmp_path / "nowhere"))
    assert (seen.devices, seen.over_current) == ({}, {})
    assert read_device(Sysfs(tmp_path), "1-1") is None


def test_attributes_are_never_created(tmp_path: Path):
    with pytest.raises(FileNotFoundError):
        Sysfs(tmp_path).write("no_such_attribute", "1")
    (tmp_path / "attribute").write_text("16\n")
    Sysfs(tmp_path).write("attribute", "1")
    assert Sysfs(tmp_path).text("attribute") is not None
