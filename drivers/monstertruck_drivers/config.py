"""Which devices a robot has, where they hang, and how they are set: the sections ``devices`` and ``monitors``."""

from pathlib import Path
from typing import Annotated, Any, Generic, Self, TypeVar

from pydantic import Discriminator, Field, Tag, model_validator

from monstertruck_drivers.ax12.config import Ax12Config
from monstertruck_drivers.battery.config import IioConfig
from monstertruck_drivers.epos.config import EposConfig
from monstertruck_drivers.hokuyo_urg.config import HokuyoConfig
from monstertruck_drivers.host_health.config import HostHealthConfig
from monstertruck_drivers.link_quality.config import LinkQualityConfig
from monstertruck_drivers.maestro.config import MaestroConfig
from monstertruck_drivers.os4000.config import Os4000Config
from monstertruck_drivers.usb.config import UsbPortConfig
from monstertruck_drivers.usb.tree import place
from monstertruck_drivers.webcam.config import WebcamConfig
from monstertruck_runtime.service import RestartPolicy
from monstertruck_schemas.base import Schema
from monstertruck_schemas.body import Mount
from monstertruck_schemas.roles import SHAFTS

C = TypeVar("C", bound=Schema)


class PortConfig(Schema):
    """Where a device hangs."""

    path: Path
    """Device node, best by hub port: /dev/truck/<role> or /dev/serial/by-path/..."""
    baud: Annotated[int, Field(ge=4800, le=1_000_000)] = 115200
    """Bits per second; USB-CDC devices ignore it"""


def _way(port: Any) -> str:
    """Which of the two ways to name a port ``port`` is; not a key of either, so that complaints find their line."""
    by_hub = isinstance(port, UsbPortConfig) or (isinstance(port, dict) and "hub" in port)
    return "port by hub" if by_hub else "port by path"


AnyPort = Annotated[
    Annotated[PortConfig, Tag("port by path")] | Annotated[UsbPortConfig, Tag("port by hub")], Discriminator(_way)
]


class Device(Schema, Generic[C]):
    """One device: its port, its mount, its driver."""

    port: AnyPort
    mount: Mount = Mount()
    restart: RestartPolicy = RestartPolicy(max_delay=0.5)
    driver: C

    @property
    def kind(self) -> str:
        """What the driver's settings say it is."""
        return str(vars(self.driver)["kind"])


class Devices(Schema):
    """The robot's devices by role; a role that is left out is not there."""

    lidar: Device[HokuyoConfig] | None = None
    drive: Device[EposConfig] | None = None
    drive_2: Device[EposConfig] | None = None
    """Controller of the body's second driven shaft, if it has one"""
    drive_3: Device[EposConfig] | None = None
    drive_4: Device[EposConfig] | None = None
    steering: Device[MaestroConfig] | None = None
    compass: Device[Os4000Config] | None = None
    stabiliser: Device[Ax12Config] | None = None
    """Mount of the lidar; its own mount is the point both joints turn about, the lidar's is that with level joints"""
    camera: Device[WebcamConfig] | None = None

    def present(self) -> dict[str, Device[Schema]]:
        """The devices that are configured, by role."""
        return {role: device for role in type(self).model_fields if (device := getattr(self, role)) is not None}

    def shafts(self) -> dict[str, Device[EposConfig]]:
        """The controllers of the driven shafts, by role."""
        return {role: device for role in SHAFTS if (device := getattr(self, role)) is not None}

    @model_validator(mode="after")
    def _one_port_each(self) -> Self:
        taken: dict[str, str] = {}
        for role, device in self.present().items():
            port = device.port
            where = place(port.device) if isinstance(port, UsbPortConfig) else str(port.path)
            if other := taken.get(where):
                raise ValueError(f"{other} and {role} share the port {where}; every device needs its own")
            taken[where] = role
        return self


class Monitors(Schema):
    """What is read from the computer itself, without a port; what is left out is not watched."""

    battery: IioConfig | None = None
    """Pack voltage by a converter of the kernel's Industrial-IO; instead of the servo controller's input"""
    link: LinkQualityConfig | None = None
    host: HostHealthConfig | None = None
