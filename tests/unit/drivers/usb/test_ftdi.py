"""The latency timer: by attribute, else by the serial line's flag, else left and said."""

import fcntl
import os
import termios
from array import array
from pathlib import Path
from typing import Any

import pytest

from monstertruck_drivers.usb.emulated import EmulatedUsb
from monstertruck_drivers.usb.port import LOW_LATENCY, set_latency
from monstertruck_drivers.usb.tree import Node, read_device


def adapter(folder: Path, node: str = "ttyUSB") -> tuple[EmulatedUsb, Node]:
    usb = EmulatedUsb(folder)
    usb.add_hub("1-1")
    usb.add_device("1-1.1", "0403:6001", node=node)
    device = read_device(usb.sysfs, "1-1.1")
    assert device is not None
    assert device.tty is not None
    return usb, device.tty


def test_the_attribute_is_enough(tmp_path: Path):
    usb, node = adapter(tmp_path)
    assert set_latency(usb.sysfs, node, tmp_path / "nowhere", 1) == 1
    assert usb.sysfs.text(f"{node.path}/latency_timer") == "1"


def test_a_lower_timer_is_left_alone(tmp_path: Path):
    usb, node = adapter(tmp_path)
    assert set_latency(usb.sysfs, node, tmp_path / "nowhere", 20) == 16


def test_cdc_devices_have_none(tmp_path: Path):
    usb, node = adapter(tmp_path, "ttyACM")
    assert set_latency(usb.sysfs, node, tmp_path / "nowhere", 1) is None


def test_without_rights_the_lines_flag_is_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    usb, node = adapter(tmp_path)
    usb.refused.add("latency_timer")
    line = tmp_path / "line"
    line.touch()
    flags: list[int] = []

    def ioctl(fd: int, request: int, settings: "array[Any]") -> int:
        if request == termios.TIOCGSERIAL:
            settings[4] = 0x10
        elif request == termios.TIOCSSERIAL:
            flags.append(settings[4])
            (usb.sysfs.root / node.path / "latency_timer").write_text("1\n")  # as the driver does
        return 0

    monkeypatch.setattr(fcntl, "ioctl", ioctl)
    assert set_latency(usb.sysfs, node, line, 1) == 1
    assert flags == [0x10 | LOW_LATENCY]


def test_lines_without_the_flag_keep_their_timer(tmp_path: Path):
    usb, node = adapter(tmp_path)
    usb.refused.add("latency_timer")
    master, slave = os.openpty()
    try:
        assert set_latency(usb.sysfs, node, Path(os.ttyname(slave)), 1) == 16, "a pty knows no such flag"
        assert set_latency(usb.sysfs, node, tmp_path / "nowhere", 1) == 16
    finally:
        os.close(master)
        os.close(slave)
