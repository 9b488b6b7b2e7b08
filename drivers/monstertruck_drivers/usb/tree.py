"""Read the USB tree from sysfs: names, parents, identities and nodes. The functions are stateless.

Names are kernel names: ``usb1`` is the root hub of bus 1, ``1-2`` is on its port 2, ``1-2.3`` on port 3 of the hub
there; ``1-2.3:1.0`` is interface 0 of that device in configuration 1, and ``1-2:1.0/1-2-port3`` is the port itself.

Bus numbers follow the order of controller detection, which may change at every boot and after a controller's restart.
Topology names do not change: they name the controller, as udev's ``ID_PATH`` does, as in
``pci-0000:00:14.0-usb-0:2.3``.
"""

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from monstertruck_drivers.computer import Sysfs

DEVICES = "bus/usb/devices"

_ROOT = re.compile(r"usb(\d+)")
_DEVICE = re.compile(r"(\d+)-(\d+(?:\.\d+)*)")
_PCI = re.compile(r"[0-9a-f]{4,}:[0-9a-f]{2}:[0-9a-f]{2}\.[0-9a-f]")
_BY_TOPOLOGY = re.compile(r"(?P<controller>[^ ]+)-usb-0:(?P<ports>0|[0-9]+(?:\.[0-9]+)*)")
_INTERFACE = re.compile(r"(?P<device>\d+-\d+(?:\.\d+)*):\d+\.(?P<number>\d+)")
_USB_SERIAL = re.compile(r"ttyUSB\d+")
_PORT = re.compile(r".+-port(\d+)")


@dataclass(frozen=True, slots=True)
class Node:
    """Device node of one interface."""

    name: str
    """``ttyUSB0``, ``ttyACM0``, ``video0``: never an identity, it changes with every replug."""
    kind: str
    """Device class: ``tty`` or ``video4linux``."""
    interface: int
    path: str
    """Folder of its driver in sysfs."""
    latency_ms: int | None = None
    """FTDI latency timer; None for other chips."""


@dataclass(frozen=True, slots=True)
class UsbDevice:
    """Snapshot of a hub or device."""

    name: str
    devnum: int
    """Address; every enumeration assigns a new one, so it distinguishes a replug from no change."""
    usb_id: str
    hub: bool
    title: str
    serial: str | None
    autosuspend: bool
    nodes: tuple[Node, ...]
    held: frozenset[int] = frozenset()
    """Interfaces that a program has claimed from the kernel's drivers through usbfs."""
    speed: int = 0
    """Speed (Mbit/s), 0 if unknown; distinguishes the two root hubs of a USB 3 controller."""

    def find(self, kind: str, interface: int = 0) -> Node | None:
        """Return the first node of ``kind`` on ``interface``."""
        return next((node for node in self.nodes if (node.kind, node.interface) == (kind, interface)), None)

    @property
    def tty(self) -> Node | None:
        """First serial node of any interface."""
        return next((node for node in self.nodes if node.kind == "tty"), None)


@dataclass(frozen=True, slots=True)
class TreeSnapshot:
    """Snapshot of the complete tree."""

    devices: dict[str, UsbDevice]
    over_current: dict[str, int]
    """Over-current events counted by each port since its hub appeared, by the name of a device there."""

    def at_present(self, name: str) -> str:
        """See the function of the same name."""
        return _at_present(name, self.roots(), lambda place: place in self.devices)

    def roots(self) -> "list[Root]":
        """Return the root hubs whose controller is known."""
        return [
            Root(device.speed, name, device.serial)
            for name, device in self.devices.items()
            if device.serial and _ROOT.fullmatch(name)
        ]


class Root(NamedTuple):
    """Root hub with its controller."""

    speed: int
    """Speed (Mbit/s)."""
    name: str
    controller: str


def device_name(hub: str, port: int) -> str:
    """Return the name of a device on ``port`` of ``hub``."""
    root = _ROOT.fullmatch(hub)
    if topology := _BY_TOPOLOGY.fullmatch(hub):
        ports = str(port) if topology["ports"] == "0" else f"{topology['ports']}.{port}"
        return f"{topology['controller']}-usb-0:{ports}"
    return f"{root[1]}-{port}" if root else f"{hub}.{port}"


def parent_of(name: str) -> str | None:
    """Return the parent hub of ``name``; None for a root hub."""
    if topology := _BY_TOPOLOGY.fullmatch(name):
        if topology["ports"] == "0":
            return None
        return f"{topology['controller']}-usb-0:{topology['ports'].rpartition('.')[0] or '0'}"
    bus, dash, ports = name.partition("-")
    if not dash:
        return None
    upstream, dot, _ = ports.rpartition(".")
    return f"{bus}-{upstream}" if dot else f"usb{bus}"


def ancestors(name: str) -> Iterator[str]:
    """Yield the hubs above ``name``, nearest first."""
    while (parent := parent_of(name)) is not None:
        yield parent
        name = parent


def port_of(name: str) -> int:
    """Return the port of ``name`` on its parent; 0 for a root hub."""
    return int(re.split(r"[.:-]", name)[-1]) if "-" in name else 0


def place(name: str) -> str:
    """Return the place of ``name`` as text."""
    hub = parent_of(name)
    return name if hub is None else f"hub {hub} port {port_of(name)}"


def port_directory(name: str) -> str:
    """Return the sysfs folder of the port of ``name``.

    Raises:
        ValueError: ``name`` is a root hub, which has no port.
    """
    hub = parent_of(name)
    if hub is None:
        raise ValueError(f"{name}: a root hub has no port")
    return f"{DEVICES}/{_hub_interface(hub)}/{hub}-port{port_of(name)}"


def sort_key(name: str) -> tuple[int, ...]:
    """Return a sort key that orders names by bus and ports, parents before children."""
    return tuple(int(number) for number in re.findall(r"\d+", name))


def is_topology(name: str) -> bool:
    """Whether a name is a topology name rather than a kernel name."""
    return _BY_TOPOLOGY.fullmatch(name) is not None


def topology_of(sysfs: Sysfs, name: str) -> str:
    """Return the topology name of a place; its kernel name if the controller is unknown."""
    root = next((hub for hub in ancestors(name) if _ROOT.fullmatch(hub)), name)
    controller = sysfs.text(f"{DEVICES}/{root}/serial")
    if not controller:
        return name
    kind = "pci" if _PCI.fullmatch(controller) else "platform"
    return f"{kind}-{controller}-usb-0:{'0' if root == name else name.partition('-')[2]}"


def at_present(sysfs: Sysfs, name: str) -> str:
    """Return the current kernel name of the port at a topology path.

    Returns ``name`` itself if it is not a topology name or the place is absent. Of the two root hubs of a USB 3
    controller, the hub with a device at that place is used, or otherwise the USB 2 hub.
    """
    if not is_topology(name):
        return name
    roots = [
        Root(sysfs.number(f"{DEVICES}/{root}/speed") or 0, root, controller)
        for root in sysfs.names(DEVICES)
        if _ROOT.fullmatch(root) and (controller := sysfs.text(f"{DEVICES}/{root}/serial"))
    ]
    return _at_present(name, roots, lambda place: sysfs.text(f"{DEVICES}/{place}/devnum") is not None)


def _at_present(name: str, roots: list[Root], is_there: Callable[[str], bool]) -> str:
    topology = _BY_TOPOLOGY.fullmatch(name)
    if topology is None:
        return name
    ports = topology["ports"]
    places = [
        root.name if ports == "0" else f"{root.name[3:]}-{ports}"
        for root in sorted(roots)
        if f"-{topology['controller']}".endswith(f"-{root.controller}")
    ]
    return next(filter(is_there, places), places[0] if places else name)


def renumbered(name: str, buses: Mapping[str, str]) -> str:
    """Return the name of a place after bus numbers have changed.

    Args:
        name: kernel name.
        buses: new bus number by old bus number.
    """
    prefix, number, ports = re.split(r"(\d+)", name, maxsplit=1)
    return f"{prefix}{buses.get(number, number)}{ports}"


def read_tree(sysfs: Sysfs) -> TreeSnapshot:
    """Read every hub and device; omit devices that vanish meanwhile."""
    entries = sysfs.names(DEVICES)
    interfaces: dict[str, list[str]] = {}
    for entry in entries:
        if match := _INTERFACE.fullmatch(entry):
            interfaces.setdefault(match["device"], []).append(entry)
    names = [entry for entry in entries if _ROOT.fullmatch(entry) or _DEVICE.fullmatch(entry)]
    devices = {}
    over_current: dict[str, int] = {}
    for name in sorted(names, key=sort_key):
        device = _read_device(sysfs, name, interfaces.get(name, []))
        if device is not None:
            devices[name] = device
            if device.hub:
                over_current |= _over_current(sysfs, name)
    return TreeSnapshot(devices, over_current)


def read_device(sysfs: Sysfs, name: str) -> UsbDevice | None:
    """Read one device; None if it is absent."""
    entries = sysfs.names(f"{DEVICES}/{name}")
    return _read_device(sysfs, name, [entry for entry in entries if _INTERFACE.fullmatch(entry)])


def _read_device(sysfs: Sysfs, name: str, interfaces: list[str]) -> UsbDevice | None:
    path = f"{DEVICES}/{name}"
    devnum = sysfs.number(f"{path}/devnum")
    vendor, product = sysfs.text(f"{path}/idVendor"), sysfs.text(f"{path}/idProduct")
    if devnum is None or vendor is None or product is None:
        return None
    return UsbDevice(
        name=name,
        devnum=devnum,
        usb_id=f"{vendor}:{product}",
        hub=sysfs.number(f"{path}/bDeviceClass", 16) == 0x09,  # class of hubs (USB 2.0, 11.23.1)
        title=sysfs.text(f"{path}/product") or "",
        serial=sysfs.text(f"{path}/serial"),
        autosuspend=sysfs.text(f"{path}/power/control") == "auto",
        nodes=tuple(node for entry in interfaces for node in _nodes(sysfs, entry, _number(entry))),
        held=frozenset(
            _number(entry)
            for entry in interfaces
            if "DRIVER=usbfs" in (sysfs.text(f"{DEVICES}/{entry}/uevent") or "").splitlines()
        ),
        speed=sysfs.number(f"{path}/speed") or 0,
    )


def _number(interface: str) -> int:
    return int(interface.rpartition(".")[2])


def _nodes(sysfs: Sysfs, entry: str, interface: int) -> Iterator[Node]:
    """Yield the nodes of one interface: below ``tty`` for CDC, one folder deeper for USB serial adapters."""
    path = f"{DEVICES}/{entry}"
    for kind in ("tty", "video4linux"):
        for name in sysfs.names(f"{path}/{kind}"):
            yield Node(name, kind, interface, path)
    for name in sysfs.names(path):
        if _USB_SERIAL.fullmatch(name):
            adapter = f"{path}/{name}"
            yield Node(name, "tty", interface, adapter, sysfs.number(f"{adapter}/latency_timer"))


def _over_current(sysfs: Sysfs, hub: str) -> dict[str, int]:
    path = f"{DEVICES}/{_hub_interface(hub)}"
    counts = {}
    for entry in sysfs.names(path):
        if match := _PORT.fullmatch(entry):
            count = sysfs.number(f"{path}/{entry}/over_current_count")
            if count is not None:
                counts[device_name(hub, int(match[1]))] = count
    return counts


def _hub_interface(hub: str) -> str:
    root = _ROOT.fullmatch(hub)
    return f"{root[1]}-0:1.0" if root else f"{hub}:1.0"
