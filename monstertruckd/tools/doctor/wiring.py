"""What hangs where, against the configuration."""

from collections.abc import Iterator
from typing import Any

from monstertruck_drivers.config import AnyPort, Device
from monstertruck_drivers.usb.config import UsbPortConfig
from monstertruck_drivers.usb.tree import DEVICES, Node, Snapshot, UsbDevice, ancestors, place, read_tree
from monstertruck_schemas.reasons import Reason
from monstertruckd.tools.doctor.finding import Finding, fail, fine, warn
from monstertruckd.tools.doctor.patient import Patient

MODULES = {"0403": "ftdi_sio", "10c4": "cp210x", "067b": "pl2303"}
"""Kernel modules by vendor; whoever is not here speaks USB-CDC."""


def wiring(patient: Patient) -> Iterator[Finding]:
    """Every configured device: is it where it should be, and as quick and as awake as it should be."""
    if patient.config is None:
        return
    tree = read_tree(patient.computer.machine.sysfs)
    devices = patient.config.devices.present()
    taken = {device.port.device for device in devices.values() if isinstance(device.port, UsbPortConfig)}
    for role, device in devices.items():
        if isinstance(device.port, UsbPortConfig):
            yield from _by_hub(patient, tree, role, device, taken)
        else:
            yield _by_path(patient, role, device.port)
    for name, count in tree.over_current.items():
        if count and name in taken:
            yield warn("over-current", Reason.OVER_CURRENT, f"{place(name)}: {count} times since its hub came")


def _by_path(patient: Patient, role: str, port: AnyPort) -> Finding:
    node = patient.node(port)
    if node is None:
        seen = f"{vars(port)['path']}: no such node"
        return fail(role, Reason.DEVICE_LOST, seen, patient.find_port_command(role))
    return fine(role, str(node))


def _by_hub(patient: Patient, tree: Snapshot, role: str, device: Device[Any], taken: set[str]) -> Iterator[Finding]:
    port, video = device.port, device.kind.opens == "video"
    assert isinstance(port, UsbPortConfig)
    where = place(port.device)
    found = tree.devices.get(port.device)
    if found is None:
        yield _absent(patient, tree, role, port, taken)
    elif port.usb_id is not None and found.usb_id != port.usb_id:
        seen = f"{where}: expected {port.usb_id}, found {found.usb_id} {found.title}"
        yield fail(role, Reason.DEVICE_WRONG, seen, patient.find_port_command(role))
    elif (node := found.find("video4linux" if video else "tty", port.interface)) is None:
        module = "uvcvideo" if video else MODULES.get(found.usb_id[:4], "cdc_acm")
        seen = f"{where}: {found.usb_id} {found.title} has no node at interface {port.interface}"
        yield fail(role, Reason.DEVICE_LOST, seen, f"sudo modprobe {module}")
    else:
        yield fine(role, f"{where}: {found.usb_id} {found.title} as {node.name}")
        yield from _settings(role, port, found, node)


def _absent(patient: Patient, tree: Snapshot, role: str, port: UsbPortConfig, taken: set[str]) -> Finding:
    where = place(port.device)
    gone = next((hub for hub in [*ancestors(port.device)][::-1] if hub not in tree.devices), None)
    if gone is not None:
        seen = f"{where}: hub {gone} is not there"
        return fail(role, Reason.HUB_LOST, seen, patient.command("usb", "--local"))
    alike = (name for name, device in tree.devices.items() if device.usb_id == port.usb_id and name not in taken)
    elsewhere = next(alike, None)
    if elsewhere is not None:
        seen = f"{where}: not plugged in, but {port.usb_id} is at {place(elsewhere)}"
        return fail(role, Reason.PORT_MOVED, seen, patient.find_port_command(role))
    return fail(role, Reason.DEVICE_LOST, f"{where}: not plugged in", patient.find_port_command(role))


def _settings(role: str, port: UsbPortConfig, device: UsbDevice, node: Node) -> Iterator[Finding]:
    if node.latency_ms is not None and node.latency_ms > port.latency_ms:
        seen = f"{node.name} answers after {node.latency_ms} ms instead of {port.latency_ms} ms"
        mend = f"echo {port.latency_ms} | sudo tee /sys/{node.path}/latency_timer"
        yield warn(f"{role} latency", Reason.SLOW_LINK, seen, mend)
    if device.autosuspend:
        seen = f"the kernel may suspend {place(device.name)}"
        mend = f"echo on | sudo tee /sys/{DEVICES}/{device.name}/power/control"
        yield warn(f"{role} power", Reason.AUTOSUSPEND, seen, mend)
