"""Builds the device drivers of a configuration and gives each its ends of the bus."""

from collections.abc import Mapping

from monstertruck_drivers.link import Port, SerialPort
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.mailbox import latest
from monstertruck_runtime.service import Service
from monstertruck_schemas import topics
from monstertruck_schemas.topics import Writer
from monstertruckd.bus.local import Bus
from monstertruckd.catalog import BY_NAME
from monstertruckd.config.truck import Devices


def serial_ports(devices: Devices) -> dict[str, Port]:
    """The configured port of every device, by role."""
    return {role: SerialPort(device.port.path, device.port.baud) for role, device in devices.present().items()}


def build_drivers(devices: Devices, ports: Mapping[str, Port], clock: Clock, bus: Bus) -> dict[str, Service]:
    """One driver per configured device, by role."""
    events = bus.event_sink()
    drivers: dict[str, Service] = {}
    if devices.lidar is not None:
        drivers["lidar"] = BY_NAME[devices.lidar.driver.kind].driver_class()(
            devices.lidar.driver, ports["lidar"], clock, bus.publisher(topics.SCAN, Writer.DRIVER), events, "lidar"
        )
    if devices.compass is not None:
        drivers["compass"] = BY_NAME[devices.compass.driver.kind].driver_class()(
            devices.compass.driver,
            ports["compass"],
            clock,
            bus.publisher(topics.COMPASS, Writer.DRIVER),
            events,
            "compass",
        )
    if devices.drive is not None:
        drivers["drive"] = BY_NAME[devices.drive.driver.kind].driver_class()(
            devices.drive.driver,
            ports["drive"],
            clock,
            bus.subscribe(topics.CMD_DRIVE, latest()),
            bus.publisher(topics.DRIVE, Writer.DRIVER),
            events,
            "drive",
        )
    if devices.steering is not None:
        drivers["steering"] = BY_NAME[devices.steering.driver.kind].driver_class()(
            devices.steering.driver,
            ports["steering"],
            clock,
            bus.subscribe(topics.CMD_STEERING, latest()),
            bus.publisher(topics.STEERING, Writer.DRIVER),
            bus.publisher(topics.BATTERY, Writer.DRIVER),
            events,
            "steering",
        )
    return drivers
