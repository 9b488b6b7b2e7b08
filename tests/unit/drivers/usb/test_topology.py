"""Places by topology keep their names when the kernel numbers its buses in another order."""

from pathlib import Path

import pytest
from pydantic import ValidationError

from monstertruck_drivers.computer import Sysfs
from monstertruck_drivers.usb.config import UsbPortConfig
from monstertruck_drivers.usb.tree import (
    DEVICES,
    ancestors,
    at_this_boot,
    device_name,
    parent_of,
    place,
    port_of,
    topology_of,
)

BOARD, CARD = "pci-0000:00:14.0", "platform-fd500000.pcie-pci-0000:01:00.0"


def booted(folder: Path, *controllers: str) -> Sysfs:
    """Each controller with its two buses, in the order in which they were found; a hub at port 1 of the USB 2 ones."""
    for index, controller in enumerate(controllers):
        for half, speed in enumerate(("480", "5000")):
            root = folder / DEVICES / f"usb{2 * index + half + 1}"
            root.mkdir(parents=True)
            for name, text in (("serial", controller), ("speed", speed), ("devnum", "1")):
                (root / name).write_text(f"{text}\n")
        hub = folder / DEVICES / f"{2 * index + 1}-1"
        hub.mkdir()
        (hub / "devnum").write_text("2\n")
    return Sysfs(folder)


def test_names_are_cut_and_joined():
    hub = f"{BOARD}-usb-0:1"
    assert device_name(hub, 4) == f"{BOARD}-usb-0:1.4"
    assert device_name(f"{BOARD}-usb-0:0", 4) == f"{BOARD}-usb-0:4"
    assert parent_of(f"{BOARD}-usb-0:1.4") == hub
    assert parent_of(hub) == f"{BOARD}-usb-0:0"
    assert parent_of(f"{BOARD}-usb-0:0") is None
    assert port_of(f"{BOARD}-usb-0:1.4") == 4
    assert port_of(hub) == 1
    assert list(ancestors(f"{BOARD}-usb-0:1.4")) == [hub, f"{BOARD}-usb-0:0"]
    assert place(f"{BOARD}-usb-0:1.4") == f"hub {hub} port 4"


def test_a_place_is_found_whatever_the_order_of_the_controllers(tmp_path: Path):
    first = booted(tmp_path / "first", "0000:00:14.0", "0000:01:00.0")
    second = booted(tmp_path / "second", "0000:01:00.0", "0000:00:14.0")
    wanted = UsbPortConfig(hub=f"{BOARD}-usb-0:1", port=2)
    assert wanted.at_this_boot(first).device == "1-1.2"
    assert wanted.at_this_boot(second).device == "3-1.2"
    assert at_this_boot(second, f"{CARD}-usb-0:1.2") == "1-1.2", "what stands before the controller does not matter"
    assert at_this_boot(second, f"{BOARD}-usb-0:0") == "usb3"


def test_a_place_on_the_usb_3_half_is_found_where_something_is_there(tmp_path: Path):
    sysfs = booted(tmp_path, "0000:00:14.0")
    camera = tmp_path / DEVICES / "2-3"
    camera.mkdir()
    (camera / "devnum").write_text("2\n")
    assert at_this_boot(sysfs, f"{BOARD}-usb-0:3") == "2-3"
    assert at_this_boot(sysfs, f"{BOARD}-usb-0:2") == "1-2"


def test_a_controller_that_is_not_there_leaves_the_name(tmp_path: Path):
    port = UsbPortConfig(hub=f"{CARD}-usb-0:1", port=2)
    assert port.at_this_boot(booted(tmp_path, "0000:00:14.0")) is port


def test_names_lead_there_and_back(tmp_path: Path):
    sysfs = booted(tmp_path, "xhci-hcd.1.auto", "0000:00:14.0")
    for name, topology in (
        ("3-1.2", f"{BOARD}-usb-0:1.2"),
        ("usb3", f"{BOARD}-usb-0:0"),
        ("1-1", "platform-xhci-hcd.1.auto-usb-0:1"),
    ):
        assert topology_of(sysfs, name) == topology
        assert at_this_boot(sysfs, topology) == name
    assert topology_of(sysfs, "7-1") == "7-1", "no such bus"


@pytest.mark.parametrize("hub", ["pci-0000:00:14.0", "usb-0:1", "pci-0-usb-0:", 'a"b-usb-0:1', "a b-usb-0:1"])
def test_other_names_are_refused(hub: str):
    with pytest.raises(ValidationError):
        UsbPortConfig(hub=hub, port=1)
