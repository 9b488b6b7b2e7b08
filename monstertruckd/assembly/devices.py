"""Builds the drivers of a configuration and gives each the ends of its role's topics."""

from collections.abc import Mapping
from typing import Any

from monstertruck_drivers.catalog import DEVICES, Duty, Role
from monstertruck_drivers.computer import Computer
from monstertruck_drivers.config import kind_of
from monstertruck_estimation.scan_tilt import TiltStamper
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.mailbox import Delivery, latest
from monstertruck_runtime.ports import Publisher
from monstertruck_runtime.service import Service
from monstertruck_schemas import topics
from monstertruck_schemas.base import Schema
from monstertruck_schemas.sensor import LaserScan
from monstertruck_schemas.topics import Writer
from monstertruckd.assembly.cabling import Cabling
from monstertruckd.bus.local import Bus
from monstertruckd.config.truck import TruckConfig

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
            case "video":
                where = cabling.camera(role.name)
            case "computer":
                where = computer
        ends: dict[str, Any] = {name: bus.subscribe(topic, latest()) for name, topic in role.reads.items()}
        ends |= {name: _publisher(role, name, roles, config, bus) for name in role.writes}
        driver = kind.implementation_class()
        drivers[role.name] = driver(settings[role.name], where, clock, **ends, events=bus.event_sink(), name=role.name)
    return drivers


def of_duty(drivers: Mapping[str, Service], *duties: Duty) -> dict[str, Service]:
    """Those of the drivers that are there for one of ``duties``."""
    return {role: driver for role, driver in drivers.items() if DEVICES.roles[role].duty in duties}


def _publisher(
    role: Role, name: str, roles: Mapping[str, Role], config: TruckConfig, bus: Bus
) -> Publisher[Any] | None:
    """Write end of one of a role's topics; None where it is another configured role's own."""
    topic = role.writes[name]
    owner = next((other for other in roles.values() if next(iter(other.writes.values())) is topic), role)
    if owner is not role:
        return None
    return scan_publisher(config, bus) if topic is topics.SCAN else bus.publisher(topic, Writer.DRIVER)


def scan_publisher(config: TruckConfig, bus: Bus) -> Publisher[LaserScan]:
    """Where scans go: with the tilt of their plane, as far as compass and stabiliser tell it."""
    out = bus.publisher(topics.SCAN, Writer.DRIVER)
    if config.devices.compass is None:
        return out
    stabiliser = config.devices.stabiliser
    joints = bus.subscribe(topics.STABILISER, RECENT) if stabiliser is not None else None
    return TiltStamper(out, bus.subscribe(topics.COMPASS, RECENT), joints)
