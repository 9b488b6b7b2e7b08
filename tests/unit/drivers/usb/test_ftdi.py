"""The latency timer: by attribute, else by the serial line's flag, else left and said."""

import fcntl
import os
import termios
import tty
from array import array
from pathlib import Path
from typing import Any

import pytest

from monstertruck_drivers.tty import SerialPort
from monstertruck_drivers.usb.emulated import EmulatedUsb
from monstertruck_drivers.usb.port import lower_latency
from monstertruck_drivers.usb.tree import Node, read_device

LOW_LATENCY = 0x2000
"""ASYNC_LOW_LATENCY."""


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
    assert not lower_latency(usb.sysfs, node, 1)
    assert usb.sysfs.text(f"{node.path}/latency_timer") == "1"


def test_a_lower_timer_is_left_alone(tmp_path: Path):
    usb, node = adapter(tmp_path)
    assert not lower_latency(usb.sysfs, node, 20)
    assert usb.sysfs.text(f"{node.path}/latency_timer") == "16"


def test_cdc_devices_have_none(tmp_path: Path):
    usb, node = adapter(tmp_path, "ttyACM")
    assert not lower_latency(usb.sysfs, node, 1)


def test_without_rights_the_lines_flag_is_asked_for(tmp_path: Path):
    usb, node = adapter(tmp_path)
    usb.refused.add("latency_timer")
    assert lower_latency(usb.sysfs, node, 1)


async def test_the_flag_is_set_on_the_open_port(monkeypatch: pytest.MonkeyPatch):
    """A second open of the node would be refused: the port is exclusive."""
    master, slave = os.openpty()
    tty.setraw(slave)
    flags: list[int] = []
    ioctl = fcntl.ioctl

    def line(fd: int, request: int, argument: Any = 0) -> Any:
        if request == termios.TIOCGSERIAL:
            argument[4] = 0x10
        elif request == termios.TIOCSSERIAL:
            assert isinstance(argument, array)
            flags.append(argument[4])
        else:
            return ioctl(fd, request, argument)
        return 0

    monkeypatch.setattr(fcntl, "ioctl", line)
    try:
        (await SerialPort(Path(os.ttyname(slave)), low_latency=True).open()).close()
    finally:
        os.close(master)
        os.close(slave)
    assert flags == [0x10 | LOW_LATENCY]


async def test_lines_without_the_flag_open_all_the_same():
    master, slave = os.openpty()
    tty.setraw(slave)
    try:
        (await SerialPort(Path(os.ttyname(slave)), low_latency=True).open()).close()
    finally:
        os.close(master)
        os.close(slave)
