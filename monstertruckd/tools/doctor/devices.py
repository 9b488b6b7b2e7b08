"""Checks of the devices: whether they are connected as configured, and answer."""

import asyncio
import shutil
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any, Final

from monstertruck_drivers.catalog import DeviceKind
from monstertruck_drivers.command import CommandPort
from monstertruck_drivers.config import CommandPortConfig, Device, PortConfig, TcpPortConfig
from monstertruck_drivers.i2c.port import I2cPort
from monstertruck_drivers.link import BAUD, Port
from monstertruck_drivers.tcp import TcpPort
from monstertruck_drivers.usb.config import UsbPortConfig
from monstertruck_drivers.usb.port import HubPort, why_no_node
from monstertruck_drivers.usb.tree import DEVICES, Node, TreeSnapshot, UsbDevice, ancestors, place, read_tree
from monstertruck_runtime.errors import DeviceError, PortBusyError, WrongDeviceError
from monstertruck_schemas.base import Schema
from monstertruck_schemas.reasons import Reason
from monstertruckd.tools.doctor.context import Finding, HostContext, fail, fine, warn

MODULES = {"0403": "ftdi_sio", "10c4": "cp210x", "067b": "pl2303"}
"""Kernel modules by vendor; all others are USB-CDC."""
MODPROBE_I2C: Final = "sudo modprobe i2c-dev"
SUPPLY: Final = "the devices there draw too much current, or the cable is damaged: use a self-powered hub"


def wiring(context: HostContext) -> Iterator[Finding]:
    """Check every configured device: its port, latency and power saving."""
    if context.config is None:
        return
    sysfs = context.computer.machine.sysfs
    tree = read_tree(sysfs)
    devices = context.config.devices.at_present(sysfs).present()
    taken = {device.port.device for device in devices.values() if isinstance(device.port, UsbPortConfig)}
    for role, device in devices.items():
        if isinstance(device.port, UsbPortConfig):
            yield from _by_hub(context, tree, role, device, taken)
        elif isinstance(device.port, TcpPortConfig):
            yield fine(role, f"at {device.port.label} on the network")
        elif isinstance(device.port, CommandPortConfig):
            yield _by_command(role, device.port)
        else:
            yield _by_path(context, role, device)
    for name, count in tree.over_current.items():
        if count and name in taken:
            yield warn(
                "over-current",
                Reason.OVER_CURRENT,
                f"{place(name)}: {count} times since its hub was connected: {SUPPLY}",
            )


def _by_command(role: str, port: CommandPortConfig) -> Finding:
    program = port.command[0]
    if shutil.which(program) is None:
        return fail(
            role, Reason.NOT_INSTALLED, f"{program}: no such program", f"apt-file search bin/{Path(program).name}"
        )
    return fine(role, f"output of {port.label}")


def _by_path(context: HostContext, role: str, device: Device[Any]) -> Finding:
    node = context.node(device.port)
    if node is None:
        seen = f"{device.port.label}: does not exist"
        if device.kind.opens == "i2c":
            return fail(role, Reason.DEVICE_LOST, f"{seen}; enable the bus in the computer's settings", MODPROBE_I2C)
        return fail(role, Reason.DEVICE_LOST, seen, context.find_port_command(role))
    return fine(role, str(node))


def _by_hub(
    context: HostContext, tree: TreeSnapshot, role: str, device: Device[Any], taken: set[str]
) -> Iterator[Finding]:
    port, video = device.port, device.kind.opens == "video"
    assert isinstance(port, UsbPortConfig)
    where = place(port.device)
    found = tree.devices.get(port.device)
    if found is None:
        yield _absent(context, tree, role, port, taken)
    elif port.usb_id is not None and found.usb_id != port.usb_id:
        seen = f"{where}: expected {port.usb_id}, found {found.usb_id} {found.title}"
        yield fail(role, Reason.DEVICE_WRONG, seen, context.find_port_command(role))
    elif (node := found.find("video4linux" if video else "tty", port.interface)) is None:
        module = "uvcvideo" if video else MODULES.get(found.usb_id[:4], "cdc_acm")
        seen = f"{where}: {why_no_node(found, 'node', port.interface)}"
        if port.interface in found.held:
            yield fail(role, Reason.DEVICE_BUSY, seen, _holder(context, found))
        else:
            yield fail(role, Reason.DEVICE_LOST, seen, f"sudo modprobe {module}")
    else:
        yield fine(role, f"{where}: {found.usb_id} {found.title} as {node.name}")
        yield from _settings(role, port, found, node)


def _holder(context: HostContext, device: UsbDevice) -> str:
    """Return the command that ends, or shows, the program that holds a device through usbfs."""
    if context.runs("brltty"):
        return "sudo apt-get remove brltty"
    return f"sudo fuser -v /dev/bus/usb/{int(device.name.partition('-')[0]):03d}/{device.devnum:03d}"


def _absent(context: HostContext, tree: TreeSnapshot, role: str, port: UsbPortConfig, taken: set[str]) -> Finding:
    where = place(port.device)
    gone = next((hub for hub in [*ancestors(port.device)][::-1] if hub not in tree.devices), None)
    if gone is not None:
        seen = f"{where}: hub {gone} is missing"
        return fail(role, Reason.HUB_LOST, seen, context.command("usb", "--local"))
    alike = (name for name, device in tree.devices.items() if device.usb_id == port.usb_id and name not in taken)
    elsewhere = next(alike, None)
    if elsewhere is not None:
        seen = f"{where}: not plugged in, but {port.usb_id} is at {place(elsewhere)}"
        return fail(role, Reason.PORT_MOVED, seen, context.find_port_command(role))
    return fail(role, Reason.DEVICE_LOST, f"{where}: not plugged in", context.find_port_command(role))


def _settings(role: str, port: UsbPortConfig, device: UsbDevice, node: Node) -> Iterator[Finding]:
    if node.latency_ms is not None and node.latency_ms > port.latency_ms:
        seen = f"{node.name} has a latency of {node.latency_ms} ms instead of {port.latency_ms} ms"
        fix = f"echo {port.latency_ms} | sudo tee /sys/{node.path}/latency_timer"
        yield warn(f"{role} latency", Reason.SLOW_LINK, seen, fix)
    if device.autosuspend:
        seen = f"the kernel may suspend {place(device.name)}"
        fix = f"echo on | sudo tee /sys/{DEVICES}/{device.name}/power/control"
        yield warn(f"{role} power", Reason.AUTOSUSPEND, seen, fix)


async def handshakes(context: HostContext) -> AsyncIterator[Finding]:
    """Yield one finding for each connected device; all are queried in parallel."""
    if context.config is None:
        return
    daemon = context.daemon()
    if daemon is not None:
        seen = f"not tested: the running daemon (process {daemon}) uses the ports"
        yield fine("handshakes", seen, context.command("status", "--once"))
        return
    plugged = {
        role: (device, place)
        for role, device in context.config.devices.at_present(context.computer.machine.sysfs).present().items()
        if (place := _reached(context, device)) is not None
    }
    for found in await asyncio.gather(*(_handshake(context, role, *ends) for role, ends in plugged.items())):
        yield found


def _reached(context: HostContext, device: Device[Schema]) -> str | None:
    """Return the device's node or address; None if it is not connected."""
    if isinstance(device.port, TcpPortConfig | CommandPortConfig):
        return device.port.label
    node = context.node(device.port, camera=device.kind.opens == "video")
    return None if node is None else str(node)


async def _handshake(context: HostContext, role: str, device: Device[Schema], place: str) -> Finding:
    check, kind = f"{role} handshake", device.kind
    again = context.command("probe", role, "--port", place)
    timeout = 15.0  # seconds for one device's whole answer; a scanner that measures has to be stopped first
    try:
        async with context.computer.machine.clock.deadline(timeout):
            answer = await _identify(context, role, device, kind, place)
    except TimeoutError:
        return fail(check, Reason.DEVICE_TIMEOUT, f"no complete answer within {timeout:g} s", again)
    except PortBusyError as error:
        return fail(check, error.reason, str(error), f"sudo fuser -v {place}")
    except WrongDeviceError as error:
        return fail(check, error.reason, str(error), context.find_port_command(role))
    except DeviceError as error:
        return fail(check, error.reason, str(error), again)
    if kind.opens == "video" and not any(one.get("mjpg_modes") for one in answer["nodes"]):
        return warn(check, Reason.DEVICE_WRONG, f"{place} does not offer motion JPEG", again)
    return fine(check, f"{kind.doc} answers")


async def _identify(
    context: HostContext, role: str, device: Device[Schema], kind: DeviceKind, place: str
) -> dict[str, Any]:
    port, machine = device.port, context.computer.machine
    if kind.opens == "video":
        return await kind.identify(place, machine.clock, device.driver)
    line: Port
    match port:
        case PortConfig() if kind.opens == "i2c":
            line = I2cPort(Path(place))
        case UsbPortConfig():
            line = HubPort(port, machine, lambda *_, **__: None, role=role)
        case CommandPortConfig():
            line = CommandPort(port.command)
        case TcpPortConfig():
            line = TcpPort(port.address, port.tcp)
        case _:
            framing = port.framing or "8N1"
            line = machine.serial(Path(place), port.baud or BAUD, dtr=port.dtr, rts=port.rts, framing=framing)
    return await kind.identify(line, machine.clock, device.driver)
