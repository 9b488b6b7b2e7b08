"""Finds the port of a cable that the user unplugs, and writes it to a configuration file."""

from collections.abc import Callable
from pathlib import Path
from typing import Final

from monstertruck_drivers.catalog import DEVICES
from monstertruck_drivers.computer import Machine
from monstertruck_drivers.usb.config import UsbPortConfig
from monstertruck_drivers.usb.tree import (
    TreeSnapshot,
    UsbDevice,
    parent_of,
    place,
    port_of,
    read_device,
    read_tree,
    topology_of,
)
from monstertruck_runtime.errors import ConfigError, InputError, NoAnswerError
from monstertruck_runtime.small_files import replace_file
from monstertruckd.config.load import YamlText

POLL: Final = 0.2


async def find_cable(role: str, machine: Machine, say: Callable[[str], None], timeout: float) -> UsbPortConfig:
    """Ask the user to unplug a cable and plug it in again; return its port.

    Args:
        role: device at the cable, for the messages and the baud rate.
        machine: computer whose ports are watched.
        say: shows one line to the user.
        timeout: timeout for unplugging and for plugging in (s).

    Raises:
        NoAnswerError: no cable was unplugged in time.
    """
    say(f"unplug the USB cable of: {role}")
    try:
        async with machine.clock.deadline(timeout):
            device = await _unplugged(machine, say)
    except TimeoutError:
        raise NoAnswerError(f"no cable was unplugged within {timeout:g} s") from None
    say(f"{role}: {place(device.name)}, {device.usb_id} {device.title}".rstrip())
    say("plug it in again")
    try:
        async with machine.clock.deadline(timeout):
            while await machine.offload(lambda: read_device(machine.sysfs, device.name)) is None:
                await machine.clock.sleep(POLL)
    except TimeoutError:
        say("still not plugged in there; the port is used all the same")
    node = device.nodes[0]
    kinds = DEVICES.of_role(role)
    name = await machine.offload(lambda: topology_of(machine.sysfs, device.name))
    return UsbPortConfig(
        hub=str(parent_of(name)),
        port=port_of(name),
        interface=node.interface,
        baud=kinds[0].baud if kinds else None,
        usb_id=device.usb_id,
    )


async def _unplugged(machine: Machine, say: Callable[[str], None]) -> UsbDevice:
    """Wait until exactly one device with a node disappears."""

    async def look() -> TreeSnapshot:
        return await machine.offload(lambda: read_tree(machine.sysfs))

    before = await look()
    while True:
        await machine.clock.sleep(POLL)
        now = await look()
        if not _lost(before, now):
            before = now
            continue
        # 0.4: seconds after the first loss until all losses are known: a hub takes its devices with it
        await machine.clock.sleep(0.4)
        now = await look()
        lost = _lost(before, now)
        if len(lost) == 1 and lost[0].nodes:
            return lost[0]
        if any(device.hub for device in lost):
            say("a whole hub disappeared: plug it in again and unplug the device's own cable")
        elif len(lost) > 1:
            say("several devices disappeared: unplug one cable only")
        elif lost:
            say(
                f"{lost[0].usb_id} {lost[0].title} at {place(lost[0].name)} is not a serial port or camera: "
                "try another cable"
            )
        before = now


def _lost(before: TreeSnapshot, now: TreeSnapshot) -> list[UsbDevice]:
    """Ports that disappeared, even briefly."""
    return [
        device
        for name, device in before.devices.items()
        if name not in now.devices or now.devices[name].devnum != device.devnum
    ]


def config_line(port: UsbPortConfig) -> str:
    """Format the line for ``devices.<role>`` in the configuration."""
    return f"port: {_flow(port)}"


def _flow(port: UsbPortConfig) -> str:
    parts = [f'hub: "{port.hub}"', f"port: {port.port}"]
    if port.interface:
        parts.append(f"interface: {port.interface}")
    if port.baud is not None:
        parts.append(f"baud: {port.baud}")
    if port.usb_id is not None:
        parts.append(f'usb_id: "{port.usb_id}"')
    return f"{{ {', '.join(parts)} }}"


def require_place(path: Path, role: str) -> YamlText:
    """Check that the file ``path`` contains ``devices.<role>.port``.

    Raises:
        InputError: it cannot be read, is not YAML, or does not contain the key.
    """
    try:
        text = YamlText.read(path)
    except ConfigError as error:
        raise InputError(str(error)) from error
    if text.node("devices", role, "port") is None:
        raise InputError(
            f"{path}: no devices.{role}.port to replace; edit the file that defines devices.{role} by hand"
        )
    return text


def write_port(path: Path, role: str, port: UsbPortConfig) -> None:
    """Replace ``devices.<role>.port`` in a configuration file; everything else, including comments, is kept.

    A configured baud rate is kept. The file is replaced atomically.

    Raises:
        InputError: see ``require_place``; or the file cannot be written.
    """
    text = require_place(path, role)
    key = ("devices", role, "port")
    baud = text.value(*key, "baud")
    if baud is not None and baud.isdecimal():
        port = port.model_copy(update={"baud": int(baud)})
    text.replace(key, _flow(port))
    try:
        replace_file(path, text.text)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from error
