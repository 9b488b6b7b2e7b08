"""Real ports: devices connected to this computer, and settings that a robot with real ports must not have.

A robot is either emulated, with a section ``sim`` and every device behind an emulator, or real. A mixture would drive
the real motor with the start pose, path and timing of a simulation.
"""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from monstertruck_drivers.config import AnyPort, CommandPortConfig, Devices, TcpPortConfig
from monstertruck_drivers.usb.config import UsbPortConfig

PSEUDO: Final = (Path("/dev/pts"), Path("/dev/shm"))  # noqa: S108 - nothing is put there
"""Folders in /dev whose entries are not devices: pseudo terminals, used by emulators, and memory."""


def real_ports(devices: Devices, machine: Path) -> tuple[str, ...]:
    """Roles of the real devices, which are configured by USB hub and port, by a node in /dev, or by another address.

    Links are followed. A port that does not exist yet is judged by its name.

    Args:
        devices: devices with their ports.
        machine: root of the computer's file system.
    """
    own_tree = _resolved(machine) == Path("/")
    return tuple(role for role, device in devices.present().items() if _is_real(device.port, own_tree=own_tree))


def mixed(
    devices: Devices, machine: Path, *, simulated: bool, stand: str
) -> Iterator[tuple[tuple[str, ...], tuple[str, ...], str]]:
    """Simulation keys in a configuration with a real port.

    Args:
        devices: devices with their ports.
        machine: root of the computer's file system.
        simulated: whether there is a section ``sim``.
        stand: value of ``stand``.

    Yields:
        The key, the key of the first real port, and the remedy.
    """
    roles = real_ports(devices, machine)
    if not roles:
        return
    port = ("devices", roles[0], "port")
    if simulated:
        yield (
            ("sim",),
            port,
            "remove the files with `sim`, or give every device an emulated port, as configs/truck_emulated.yaml does",
        )
    if stand == "simulator":
        yield ("stand",), port, "for a real robot, expected none or overhead"


def _is_real(port: AnyPort, *, own_tree: bool) -> bool:
    match port:
        case UsbPortConfig():
            return own_tree
        case TcpPortConfig():
            return not port.is_local
        case CommandPortConfig():
            return True
        case _:
            return _is_device(port.path)


def _is_device(path: Path) -> bool:
    node = _resolved(path)
    return node.is_relative_to("/dev") and not any(node.is_relative_to(folder) for folder in PSEUDO)


def _resolved(path: Path) -> Path:
    return Path(os.path.realpath(path))
