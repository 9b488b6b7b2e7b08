"""Construction of the configured drivers: their devices, and the read and write ends of their roles' topics."""

import asyncio
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from monstertruck_drivers.catalog import DEVICES, Duty, RoleSpec
from monstertruck_drivers.command import CommandPort
from monstertruck_drivers.computer import Computer, Machine
from monstertruck_drivers.config import AnyPort, CommandPortConfig, Device, TcpPortConfig, kind_of
from monstertruck_drivers.i2c.port import I2cPort
from monstertruck_drivers.link import BAUD, Port
from monstertruck_drivers.scanning.mounting import MountedScans, hangs
from monstertruck_drivers.tcp import TcpPort
from monstertruck_drivers.tty import SerialPort
from monstertruck_drivers.usb.config import UsbPortConfig
from monstertruck_drivers.usb.hub import HubCoordinator, UsbService
from monstertruck_drivers.usb.port import HubNode, HubPort, PortPower
from monstertruck_drivers.webcam.rendered_source import PathSource, RenderedSource
from monstertruck_drivers.webcam.source import FrameSource, FrameStream, Mode
from monstertruck_estimation.scan_tilt import ScanAngles, TiltStamper
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import DeviceError
from monstertruck_runtime.mailbox import Delivery, latest
from monstertruck_runtime.ports import Publisher
from monstertruck_runtime.service import Service
from monstertruck_schemas import topics
from monstertruck_schemas.base import Schema
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.roles import DeviceRole
from monstertruck_schemas.sensor import LaserScan
from monstertruck_schemas.topics import Topic, Writer
from monstertruckd.bus.local import Bus
from monstertruckd.config.device_safety import packs
from monstertruckd.config.truck import TruckConfig
from monstertruckd.gate.samples import STALE_TOPICS


class Cabling:
    """Ports of all devices. Those by hub and port share one coordinator, and a service that watches the tree.

    Args:
        config: the ports.
        computer: computer whose ports they are.
        bus: where tree and events go.
        given: ports by role that replace the configured ones.
    """

    def __init__(self, config: TruckConfig, computer: Computer, bus: Bus, given: Mapping[str, Port]) -> None:
        self._ports: dict[str, AnyPort] = {role: device.port for role, device in config.devices.present().items()}
        self._given = given
        self._machine = computer.machine
        self._events = bus.event_sink()
        places = {
            role: port for role, port in self._ports.items() if role not in given and isinstance(port, UsbPortConfig)
        }
        self.on_hubs = frozenset(places)
        """Roles of the devices that are named by hub and port."""
        self._hubs = HubCoordinator(config.usb, places, self._machine.clock, self._events)
        self._cut = config.usb.power.cut
        self._power = PortPower(config.usb.power, self._machine, self._events)
        self.service: UsbService | None = None
        """Watches the tree; None where no device hangs by hub and port."""
        if places:
            out = bus.publisher(topics.USB, Writer.DAEMON)
            self.service = UsbService(config.usb, self._machine, self._hubs, computer.watch(), out, self._events)

    def port(self, role: str) -> Port:
        """Serial port of a device."""
        port = self._ports[role]
        if role in self._given:
            return self._given[role]
        if isinstance(port, UsbPortConfig):
            return HubPort(port, self._machine, self._events, self._hubs, self._power, role)
        if isinstance(port, TcpPortConfig):
            return TcpPort(port.address, port.tcp)
        if isinstance(port, CommandPortConfig):
            return CommandPort(port.command)
        return SerialPort(port.path, port.baud or BAUD, dtr=port.dtr, rts=port.rts, framing=port.framing or "8N1")

    def bus(self, role: str) -> Port:
        """I2C bus of a device."""
        return self._given.get(role) or I2cPort(Path(self._ports[role].label))

    def camera(self, role: str) -> FrameSource:
        """Source of a camera's pictures."""
        port = self._ports[role]
        if role in self._given:
            return RenderedSource(self._given[role], self._machine.clock)
        if isinstance(port, UsbPortConfig):
            return HubCamera(HubNode(port, self._machine, self._hubs, role, "video4linux"), self._machine)
        return PathSource(port.label, self._machine.clock)

    async def cut(self) -> None:
        """Switch off the ports of ``usb.power.cut`` in parallel: one that hangs or refuses delays no other."""
        ports = {role: self._ports.get(role) for role in self._cut}
        async with asyncio.TaskGroup() as group:
            for role, port in ports.items():
                if isinstance(port, UsbPortConfig):
                    group.create_task(self._cut_port(role, port))

    async def _cut_port(self, role: str, port: UsbPortConfig) -> None:
        try:
            await self._power.switch_off(port.device)
        except DeviceError as error:
            self._events(Reason.DEVICE_FAULT, Severity.ERROR, role, str(error))

    def waiting(self, role: str) -> str | None:
        """Condition for the start of the device of ``role``, or None."""
        return self._hubs.waits_for(role)


class HubCamera:
    """The camera at a hub's port, whatever its node is at the moment.

    Args:
        node: finds it.
        machine: where it is.
    """

    def __init__(self, node: HubNode, machine: Machine) -> None:
        self.name = node.name
        self._node = node
        self._machine = machine

    async def open(self, mode: Mode, buffers: int) -> FrameStream:
        """Wait for the camera's turn, find its node, start it; see ``FrameSource``."""
        path = self._machine.dev / (await self._node.resolve()).name
        port = self._machine.serial(path, BAUD)
        if isinstance(port, SerialPort):
            return await PathSource(str(path), self._machine.clock).open(mode, buffers)
        # Only emulated devices of this process lead from a camera's node to a port.
        return await RenderedSource(port, self._machine.clock).open(mode, buffers)


RECENT = Delivery(16, counted=False)
"""Enough of the past for the tilt in the middle of a scan."""


def build_drivers(
    config: TruckConfig, cabling: Cabling, computer: Computer, clock: Clock, bus: Bus
) -> dict[str, Service]:
    """One driver per configured device and monitor, by role, in the order of the catalog."""
    settings: dict[str, Schema] = {role: device.driver for role, device in config.devices.present().items()}
    settings |= config.monitors.present()
    roles = {role: DEVICES.roles[role] for role in settings}
    drivers: dict[str, Service] = {}
    for role in roles.values():
        kind = kind_of(settings[role.name])
        match kind.opens:
            case "serial":
                where: Any = cabling.port(role.name)
            case "i2c":
                where = cabling.bus(role.name)
            case "video":
                where = cabling.camera(role.name)
            case "computer":
                where = computer
        ends: dict[str, Any] = {name: bus.subscribe(topic, latest()) for name, topic in role.reads.items()}
        written = {**role.writes, **kind.also}
        unmeasured = without(settings[role.name])
        ends |= {
            name: None if topic in unmeasured else _publisher(role, topic, roles, config, bus)
            for name, topic in written.items()
        }
        ends |= {"events": bus.event_sink(), "name": role.name}
        drivers[role.name] = kind.build(settings[role.name], where, clock, **ends)
    return drivers


def sensor_services(config: TruckConfig) -> dict[str, Reason]:
    """Services that write the gate's inputs, with the reason of their loss."""
    return {
        role: STALE_TOPICS[topic]
        for role, device in config.devices.present().items()
        for topic in reversed(_written(role, device, config))  # of several, for its own topic
        if topic in STALE_TOPICS
    }


def without(settings: Schema) -> tuple[Topic[Any], ...]:
    """Topics that a device does not write although others of its kind do, by its settings."""
    return (topics.BATTERY,) if getattr(settings, "battery", settings) is None else ()


def _written(role: str, device: Device[Any], config: TruckConfig) -> list[Topic[Any]]:
    """Topics that a device writes, its own first, without those that are another configured device's own."""
    others = {DEVICES.roles[other].topic.name for other in config.devices.present() if other != role}
    written = (*DEVICES.roles[role].writes.values(), *device.kind.also.values())
    return [topic for topic in written if topic.name not in others and topic not in without(device.driver)]


def measures_battery(config: TruckConfig) -> bool:
    """Return whether anything is configured to measure the battery."""
    return config.monitors.battery is not None or any(packs(config.devices, config.monitors))


def of_duty(drivers: Mapping[str, Service], *duties: Duty) -> dict[str, Service]:
    """Return the configured drivers with one of ``duties``."""
    return {role: driver for role, driver in drivers.items() if DEVICES.roles[role].duty in duties}


def _publisher(
    role: RoleSpec, topic: Topic[Any], roles: Mapping[str, RoleSpec], config: TruckConfig, bus: Bus
) -> Publisher[Any] | None:
    """Write end of a topic for the device of a role; None where it is another configured role's own."""
    owner = next((other for other in roles.values() if other.topic is topic), role)
    if owner is not role:
        return None
    if topic not in topics.SCANS:
        return bus.publisher(topic, Writer.DRIVER)
    lidar, out = config.devices.lidars()[role.name], scan_publisher(role.name, config, bus)
    hidden = getattr(lidar.driver, "hidden", ())
    return MountedScans(out, lidar.mount, hidden) if hidden or hangs(lidar.mount) else out


def scan_publisher(role: str, config: TruckConfig, bus: Bus) -> Publisher[LaserScan]:
    """Sink of a lidar's scans: adds the tilt of their plane, as measured by compass and stabiliser."""
    out = bus.publisher(DEVICES.roles[role].topic, Writer.DRIVER)
    angles = scan_angles(config, bus, RECENT, role)
    return out if angles is None else TiltStamper(out, angles)


def scan_angles(config: TruckConfig, bus: Bus, delivery: Delivery, role: str = DeviceRole.LIDAR) -> ScanAngles | None:
    """Angles of body and mount of the lidar ``role`` at the time of scans; None without a compass.

    The stabiliser carries the first lidar alone.
    """
    devices = config.devices
    if devices.compass is None:
        return None
    jointed = devices.stabiliser is not None and role == DeviceRole.LIDAR
    joints = bus.subscribe(topics.STABILISER, delivery) if jointed else None
    odometry = bus.subscribe(topics.ODOMETRY, delivery) if config.missing_actuators() is None else None
    return ScanAngles(bus.subscribe(topics.COMPASS, delivery), joints, odometry)
