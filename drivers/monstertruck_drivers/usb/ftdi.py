"""Latency timer of FTDI adapters: 16 ms by default, which is longer than a whole exchange with a device.

The kernel forgets it with every replug, so it is set at every open. Two ways: the attribute ``latency_timer``
(root or a udev rule), or the low-latency flag of the serial line, which the node's owner may set and which means 1 ms.
"""

import fcntl
import os
import termios
from array import array
from pathlib import Path
from typing import Final

from monstertruck_drivers.usb.sysfs import Sysfs
from monstertruck_drivers.usb.tree import Node

LOW_LATENCY: Final = 0x2000
"""ASYNC_LOW_LATENCY of ``serial_struct.flags``."""
_FLAGS: Final = 4
_STRUCT_INTS: Final = 32

ADVICE: Final = (
    'udev rule: ACTION=="add", SUBSYSTEM=="usb-serial", DRIVER=="ftdi_sio", ATTR{latency_timer}="1" '
    "(or run as a user who may write it)"
)


def set_latency(sysfs: Sysfs, node: Node, device: Path, latency_ms: int) -> int | None:
    """Lower the latency timer of an adapter as far as permitted. Blocks; the node should be open already.

    Args:
        sysfs: where the adapter's attributes are.
        node: serial node, as just read.
        device: its path in ``/dev``.
        latency_ms: wanted.

    Returns:
        Milliseconds it has now; None if the chip has no such timer.
    """
    if node.latency_ms is None or node.latency_ms <= latency_ms:
        return node.latency_ms
    attribute = f"{node.path}/latency_timer"
    try:
        sysfs.write(attribute, str(latency_ms))
    except OSError:
        _set_flag(device)
    return sysfs.number(attribute)


def _set_flag(device: Path) -> None:
    """Set the low-latency flag; lines that know none refuse, which is no error."""
    try:
        line = os.open(device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    except OSError:
        return
    try:
        settings = array("i", [0] * _STRUCT_INTS)
        fcntl.ioctl(line, termios.TIOCGSERIAL, settings)
        settings[_FLAGS] |= LOW_LATENCY
        fcntl.ioctl(line, termios.TIOCSSERIAL, settings)
    except OSError:
        return
    finally:
        os.close(line)
