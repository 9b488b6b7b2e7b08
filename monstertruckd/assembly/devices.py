"""Builds the device drivers of a configuration and gives each its ends of the bus."""

from collections.abc import Iterator
from typing import Any

from monstertruck_drivers.battery.driver import IioBatteryDriver
from monstertruck_drivers.battery.iio import CONVERTERS
from monstertruck_drivers.catalog import BY_NAME
from monstertruck_drivers.computer import Computer
from monstertruck_drivers.host_health.driver import HostHealthDriver
from monstertruck_drivers.link_quality.driver import LinkQualityDriver
from monstertruck_estimation.scan_tilt import TiltStamper
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.mailbox import Delivery, latest
from monstertruck_runtime.ports import Publisher
from monstertruck_runtime.service import Service
from monstertruck_schemas import topics
from monstertruck_schemas.roles import SHAFTS
from monstertruck_schemas.sensor import LaserScan
from monstertruck_schemas.topics import CMD_DRIVES, DRIVES, Writer
from monstertruckd.assembly.cabling import Cabling
from monstertruckd.bus.local import Bus
from monstertruckd.config.truck import TruckConfig

RECENT = Delivery(16, counted=False)
"""Enough of the past for the tilt in the middle of a scan."""


def build_drivers(config: TruckConfig, cabling: Cabling, clock: Clock, bus: Bus) -> dict[str, Service]:
    """One driver per configured device, by role."""
    drivers: dict[str, Service] = {}
    for role, device in config.devices.present().items():
        driver: Any = BY_NAME[device.kind].driver_class()
        where = cabling.camera(role) if role == "camera" else cabling.port(role)
        ends = _ends(role, config, bus)
        # The motor's current explains the sag of the battery the servo controller measures.
        sag = {"drive": bus.subscribe(topics.DRIVE, latest())} if role == "steering" else {}
        drivers[role] = driver(device.driver, where, clock, *ends, bus.event_sink(), role, **sag)
    return drivers


def _ends(role: str, config: TruckConfig, bus: Bus) -> tuple[Any, ...]:
    """What a driver reads and writes, in the order its constructor takes them."""
    match role:
        case "lidar":
            return (scan_publisher(config, bus),)
        case "compass":
            return (bus.publisher(topics.COMPASS, Writer.DRIVER),)
        case "camera":
            return (bus.publisher(topics.CAMERA, Writer.DRIVER),)
        case "drive" | "drive_2" | "drive_3" | "drive_4":
            shaft = SHAFTS.index(role)
            return bus.subscribe(CMD_DRIVES[shaft], latest()), bus.publisher(DRIVES[shaft], Writer.DRIVER)
        case "stabiliser":
            return bus.subscribe(topics.PLAN_STABILISER, latest()), bus.publisher(topics.STABILISER, Writer.DRIVER)
        case _:
            battery = bus.publisher(topics.BATTERY, Writer.DRIVER) if config.monitors.battery is None else None
            commands = bus.subscribe(topics.CMD_STEERING, latest())
            return commands, bus.publisher(topics.STEERING, Writer.DRIVER), battery


def scan_publisher(config: TruckConfig, bus: Bus) -> Publisher[LaserScan]:
    """Where scans go: with the tilt of their plane, as far as compass and stabiliser tell it."""
    out = bus.publisher(topics.SCAN, Writer.DRIVER)
    if config.devices.compass is None:
        return out
    stabiliser = config.devices.stabiliser
    joints = bus.subscribe(topics.STABILISER, RECENT) if stabiliser is not None else None
    return TiltStamper(out, bus.subscribe(topics.COMPASS, RECENT), joints)


def build_monitors(config: TruckConfig, computer: Computer, clock: Clock, bus: Bus) -> Iterator[Service]:
    """What is read from the computer itself."""
    monitors, events, beside = config.monitors, bus.event_sink(), computer.machine.beside
    if monitors.battery is not None:
        yield IioBatteryDriver(
            monitors.battery,
            clock,
            bus.publisher(topics.BATTERY, Writer.DRIVER),
            events,
            bus.subscribe(topics.DRIVE, latest()),
            root=computer.root / CONVERTERS,
            offload=beside,
        )
    if monitors.link is not None:
        link = bus.publisher(topics.LINK, Writer.DRIVER)
        yield LinkQualityDriver(monitors.link, clock, link, events, root=computer.root, offload=beside)
    if monitors.host is not None:
        host = bus.publisher(topics.HOST, Writer.DRIVER)
        yield HostHealthDriver(
            monitors.host, clock, host, events, root=computer.root, disk=computer.disk, offload=beside
        )
