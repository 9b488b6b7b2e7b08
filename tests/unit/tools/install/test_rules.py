"""The udev rules: every device by hub and port gets its link, its settings, and no modem manager."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from monstertruck_runtime.yaml_files import yaml_text
from monstertruckd.config.load import load_truck
from monstertruckd.tools.install.files import rules_text
from tests.unit.tools.install.kit import TRUCK

UDEVADM = shutil.which("udevadm")


PCI = "pci-0000:00:14.0-usb-0"
SWITCH = "RUN+=\"/bin/sh -c 'for file in /sys%p/*-port1/{}; do chgrp dialout $$file; chmod g+w $$file; done'\""


def rules_of(config: Path = TRUCK) -> str:
    return rules_text(load_truck(config)[0])


def section(text: str, role: str) -> list[str]:
    after = text.partition(f"# {role}: ")[2]
    return re.split(r"\n\n|\nLABEL", after)[0].splitlines()[1:]


def test_a_serial_device_by_hub_and_port():
    assert section(rules_of(), "drive") == [
        'SUBSYSTEM=="usb", ENV{DEVTYPE}=="usb_device", KERNEL=="1-1.1", ENV{ID_MM_DEVICE_IGNORE}="1", '
        'ENV{PRODUCT}="truck/drive", ATTR{power/control}="on"',
        'SUBSYSTEM=="tty", KERNELS=="1-1.1:*", ENV{ID_MM_PORT_IGNORE}="1"',
        'SUBSYSTEM=="tty", KERNELS=="1-1.1:*.0", ENV{ID_VENDOR_ID}=="0403", ENV{ID_MODEL_ID}=="6001", '
        'SYMLINK+="truck/drive"',
        'SUBSYSTEM=="usb-serial", DRIVER=="ftdi_sio", KERNELS=="1-1.1:*.0", ATTR{latency_timer}="1", '
        'RUN+="/bin/chgrp dialout /sys%p/latency_timer", RUN+="/bin/chmod g+w /sys%p/latency_timer"',
    ]


def test_a_device_by_topology_is_found_whatever_the_number_of_its_bus(tmp_path: Path):
    file = tmp_path / "truck.yaml"
    drive = {"port": {"hub": f"{PCI}:1", "port": 2}, "driver": {"kind": "epos"}}
    file.write_text(yaml_text({"version": 2, "devices": {"drive": drive}}))
    assert section(rules_of(file), "drive") == [
        f'SUBSYSTEM=="usb", ENV{{DEVTYPE}}=="usb_device", ENV{{ID_PATH}}=="*{PCI}:1.2", '
        'ENV{ID_MM_DEVICE_IGNORE}="1", ENV{PRODUCT}="truck/drive", ATTR{power/control}="on"',
        f'SUBSYSTEM=="tty", ENV{{ID_PATH}}=="*{PCI}:1.2:*", ENV{{ID_MM_PORT_IGNORE}}="1"',
        f'SUBSYSTEM=="tty", ENV{{ID_PATH}}=="*{PCI}:1.2:*.0", SYMLINK+="truck/drive"',
        f'SUBSYSTEM=="usb-serial", DRIVER=="ftdi_sio", ENV{{ID_PATH}}=="*{PCI}:1.2:*.0", ATTR{{latency_timer}}="1", '
        'RUN+="/bin/chgrp dialout /sys%p/latency_timer", RUN+="/bin/chmod g+w /sys%p/latency_timer"',
    ]
    assert 'IMPORT{builtin}="path_id"' in rules_of(file)


def test_the_camera_is_its_first_node():
    rules = section(rules_of(), "camera")
    assert 'SUBSYSTEM=="video4linux", KERNELS=="1-2.2:*.0", ATTR{index}=="0", SYMLINK+="truck/camera"' in rules
    assert not any("tty" in rule for rule in rules)


def test_every_role_has_one_link_and_paths_have_none(tmp_path: Path):
    links = re.findall(r'SYMLINK\+="truck/(\w+)"', rules_of())
    assert sorted(links) == ["camera", "compass", "drive", "lidar", "stabiliser", "steering"]
    file = tmp_path / "truck.yaml"
    file.write_text("version: 1\ndevices:\n  lidar: {port: {path: /dev/x}, driver: {kind: hokuyo_urg}}\n")
    assert "SYMLINK" not in rules_of(file)
    assert 'ATTR{idVendor}=="15d1|1ffb", ENV{ID_MM_DEVICE_IGNORE}="1"' in rules_of(file)


@pytest.mark.parametrize(
    ("hub", "method", "expected"),
    [
        ("1-1", "authorized", 'KERNEL=="1-1.1", RUN+="/bin/chgrp dialout /sys%p/authorized"'),
        ("1-1", "port", f'KERNEL=="1-1:1.0", {SWITCH.format("disable")}'),
        ("1-1", "port", f'KERNEL=="1-1:1.0", {SWITCH.format("peer/disable")}'),
        ("usb3", "port", f'KERNEL=="3-0:1.0", {SWITCH.format("disable")}'),
        (f"{PCI}:1.2", "port", f'ENV{{ID_PATH}}=="*{PCI}:1.2:1.0", {SWITCH.format("disable")}'),
        (f"{PCI}:0", "port", f'ENV{{ID_PATH}}=="*{PCI}:0:1.0", {SWITCH.format("peer/disable")}'),
        ("1-1", None, None),
    ],
)
def test_what_switches_a_port_is_writable_where_configured(
    hub: str, method: str | None, expected: str | None, tmp_path: Path
):
    file = tmp_path / "truck.yaml"
    lidar = {"port": {"hub": hub, "port": 1}, "driver": {"kind": "hokuyo_urg"}}
    power = {"power": {"method": method}}
    file.write_text(yaml_text({"version": 1, "usb": power, "devices": {"lidar": lidar}}))
    rules = rules_of(file)
    assert expected in rules if expected is not None else "authorized" not in rules and "disable" not in rules


def verifies() -> bool:
    """Whether there is a udev that can check rules (version 254)."""
    return UDEVADM is not None and not subprocess.run([UDEVADM, "verify", "--help"], capture_output=True).returncode


@pytest.mark.skipif(not verifies(), reason="no udev here that can verify")
def test_udev_reads_them_without_complaint(tmp_path: Path):
    file = tmp_path / "70-monstertruckd.rules"
    file.write_text(rules_of())
    done = subprocess.run([UDEVADM, "verify", str(file)], capture_output=True, text=True, timeout=30, check=False)
    assert done.returncode == 0, done.stderr
