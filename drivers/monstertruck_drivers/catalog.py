"""The table of device kinds: what ``kind:`` means, which module implements it, and what it is for.

Modules are loaded on use, so that listing kinds, checking a configuration and ``--help`` cost nothing.
"""

import importlib
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any, Literal, cast

from monstertruck_drivers.base import Emulator
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.base import Schema

Probe = Callable[..., Awaitable[dict[str, Any]]]


@dataclass(frozen=True, slots=True)
class Kind:
    """One kind of device."""

    name: str
    role: str
    """Place in the configuration's ``devices``, or ``monitors``."""
    package: str
    driver: str
    emulator: str
    config: str
    baud: int
    """Of its serial line; 0 = has none."""
    doc: str
    asked: Literal["port", "path", "machine"] = "port"
    """What ``probe`` takes: an open port and the clock, the path of a node, or nothing."""

    def driver_class(self) -> type[Any]:
        """Class of the driver (a ``Service``)."""
        return cast("type[Any]", self._load("driver", self.driver))

    def emulator_class(self) -> Callable[..., Emulator]:
        """Class of the emulator."""
        return cast("Callable[..., Emulator]", self._load("emulator", self.emulator))

    def config_class(self) -> type[Schema]:
        """Class of the driver's settings."""
        return cast("type[Schema]", self._load("config", self.config))

    def probe(self) -> Probe:
        """Coroutine function that identifies a device; its arguments depend on ``asked``."""
        return cast("Probe", self._load("probe", "probe"))

    def _load(self, module: str, attribute: str) -> Any:
        return getattr(importlib.import_module(f"{self.package}.{module}"), attribute)


KINDS = (
    Kind(
        "hokuyo_urg",
        "lidar",
        "monstertruck_drivers.hokuyo_urg",
        "HokuyoDriver",
        "HokuyoEmulator",
        "HokuyoConfig",
        115200,
        "Hokuyo URG-04LX laser scanner (SCIP 1.1 and 2.0)",
    ),
    Kind(
        "epos",
        "drive",
        "monstertruck_drivers.epos",
        "EposDriver",
        "EposEmulator",
        "EposConfig",
        38400,
        "maxon EPOS 24/1 motor controller (RS232)",
    ),
    Kind(
        "maestro",
        "steering",
        "monstertruck_drivers.maestro",
        "MaestroDriver",
        "MaestroEmulator",
        "MaestroConfig",
        115200,
        "Pololu Micro Maestro 6 servo controller with battery input",
    ),
    Kind(
        "ax12",
        "stabiliser",
        "monstertruck_drivers.ax12",
        "Ax12Driver",
        "Ax12Bus",
        "Ax12Config",
        1_000_000,
        "Two Dynamixel AX-12A on a USB2Dynamixel",
    ),
    Kind(
        "webcam",
        "camera",
        "monstertruck_drivers.webcam",
        "WebcamDriver",
        "WebcamEmulator",
        "WebcamConfig",
        115200,
        "V4L2 camera with motion JPEG",
        asked="path",
    ),
    Kind(
        "iio",
        "battery",
        "monstertruck_drivers.battery",
        "IioBatteryDriver",
        "IioEmulator",
        "IioConfig",
        0,
        "Battery voltage by a converter of Linux Industrial-IO",
        asked="machine",
    ),
    Kind(
        "link_quality",
        "link",
        "monstertruck_drivers.link_quality",
        "LinkQualityDriver",
        "NetworkEmulator",
        "LinkQualityConfig",
        0,
        "Wi-Fi and Ethernet links of the computer",
        asked="machine",
    ),
    Kind(
        "host_health",
        "host",
        "monstertruck_drivers.host_health",
        "HostHealthDriver",
        "HostEmulator",
        "HostHealthConfig",
        0,
        "Load, heat, memory and disk of the computer",
        asked="machine",
    ),
    Kind(
        "os4000",
        "compass",
        "monstertruck_drivers.os4000",
        "Os4000Driver",
        "Os4000Emulator",
        "Os4000Config",
        19200,
        "OceanServer OS4000 compass",
    ),
)
BY_NAME = {kind.name: kind for kind in KINDS}
BY_ROLE = {kind.role: kind for kind in KINDS}


def find_kind(name: str) -> Kind:
    """A kind by its name or by its role.

    Raises:
        InputError: there is none.
    """
    kind = BY_NAME.get(name) or BY_ROLE.get(name)
    if kind is None:
        known = ", ".join(f"{k.name} ({k.role})" for k in KINDS)
        raise InputError(f"unknown device {name!r}; known: {known}")
    return kind
