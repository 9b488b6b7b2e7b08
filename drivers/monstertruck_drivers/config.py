"""Devices of a robot, with their ports and settings: the sections ``devices`` and ``monitors``.

Both sections have a key for every role in the catalog and accept the settings of every kind that can fill that role.
"""

import math
import shlex
from collections.abc import Iterator
from functools import reduce
from ipaddress import IPv4Address
from operator import or_
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Generic, Self, TypeVar

from pydantic import Discriminator, Field, Tag, create_model, field_validator, model_validator

from monstertruck_drivers.catalog import DEVICES, DeviceKind, Duty, RoleSpec
from monstertruck_drivers.computer import Sysfs
from monstertruck_drivers.link import BAUD, Framing
from monstertruck_drivers.scanning.mounting import turned_by_roll
from monstertruck_drivers.shafts import SteeringOutputs, steering_outputs
from monstertruck_drivers.usb.config import Baud, UsbPortConfig
from monstertruck_runtime.service import RestartPolicy
from monstertruck_schemas.base import Schema
from monstertruck_schemas.body import Mount
from monstertruck_schemas.roles import SHAFTS
from monstertruck_schemas.topics import SCANS, Topic

if TYPE_CHECKING:
    from monstertruck_drivers.ax12.config import Ax12Config
    from monstertruck_drivers.battery.config import IioConfig
    from monstertruck_drivers.epos.config import EposConfig
    from monstertruck_drivers.host_health.config import HostHealthConfig
    from monstertruck_drivers.link_quality.config import LinkQualityConfig
    from monstertruck_drivers.maestro.config import MaestroConfig
    from monstertruck_drivers.srf08.config import Srf08Config
    from monstertruck_drivers.steppers.config import StepperConfig
    from monstertruck_drivers.vesc.config import VescConfig

C = TypeVar("C", bound=Schema)


class PortConfig(Schema):
    """Port of a device."""

    path: Path
    """Device node, preferably by hub port: /dev/truck/<role> or /dev/serial/by-path/..."""
    baud: Baud | None = None
    """Baud rate; null: the device's default. USB-CDC devices ignore it"""
    dtr: bool = True
    """Level of the DTR line while the port is open; false lets an RPLIDAR's motor turn"""
    rts: bool = True
    """Level of the RTS line while the port is open"""
    framing: Framing | None = None
    """Bits per byte; null: the device's default"""

    @property
    def label(self) -> str:
        """Path of the device node."""
        return str(self.path)


class TcpPortConfig(Schema):
    """Network address at which a device listens."""

    address: str
    """IPv4 address; an emulated device has one of 127.0.0.0/8"""
    tcp: Annotated[int, Field(ge=1, le=65535)]
    """TCP port"""

    @field_validator("address")
    @classmethod
    def _numeric(cls, address: str) -> str:
        return str(IPv4Address(address))

    @property
    def is_local(self) -> bool:
        """Whether the address belongs to this computer, as for an emulated device."""
        return IPv4Address(self.address).is_loopback

    @property
    def label(self) -> str:
        """Address and port as text."""
        return f"{self.address}:{self.tcp}"


class CommandPortConfig(Schema):
    """Program whose output replaces a device."""

    command: Annotated[tuple[str, ...], Field(min_length=1)]
    """Program and arguments, without a shell: [rpicam-vid, -t, "0", --codec, mjpeg, -o, "-"]"""

    @property
    def label(self) -> str:
        """The command line."""
        return shlex.join(self.command)


_WAYS: Final = {"hub": "port by hub", "address": "port by address", "command": "port by command"}


def _way(port: Any) -> str:
    """Return the union tag of ``port``; it is not one of its keys, so that error messages can find the line."""
    keys = port if isinstance(port, dict) else vars(port) if isinstance(port, Schema) else {}
    return next((way for key, way in _WAYS.items() if key in keys), "port by path")


AnyPort = Annotated[
    Annotated[PortConfig, Tag("port by path")]
    | Annotated[UsbPortConfig, Tag("port by hub")]
    | Annotated[TcpPortConfig, Tag("port by address")]
    | Annotated[CommandPortConfig, Tag("port by command")],
    Discriminator(_way),
]


class Device(Schema, Generic[C]):
    """One device: its port, mount and driver."""

    port: AnyPort
    """Where the device is connected."""
    mount: Mount = Mount()
    restart: RestartPolicy = RestartPolicy(max_delay=0.5)
    driver: C

    @property
    def kind(self) -> DeviceKind:
        """Device kind given by the driver's settings."""
        return kind_of(self.driver)

    @model_validator(mode="after")
    def _own_baud(self) -> Self:
        own = {"baud": getattr(self.driver, "own_baud", self.kind.baud) or BAUD, "framing": self.kind.framing}
        unset = {name for name, value in self.port if value is None}  # a network socket has no baud rate or DTR
        missing = {name: value for name, value in own.items() if value and name in unset}
        return self.model_copy(update={"port": self.port.model_copy(update=missing)}) if missing else self


def kind_of(settings: Schema) -> DeviceKind:
    """Device kind that has these settings."""
    return DEVICES[str(vars(settings)["kind"])]


class _Devices(Schema):
    """The robot's devices by role; an omitted role means no device."""

    def present(self) -> dict[str, Device[Any]]:
        """Configured devices by role."""
        return dict(_present(self))

    def at_present(self, sysfs: Sysfs) -> Self:
        """The same devices, with each port's hub replaced by the kernel's current name for it."""
        moved = {
            role: device.model_copy(update={"port": device.port.at_present(sysfs)})
            for role, device in self.present().items()
            if isinstance(device.port, UsbPortConfig)
        }
        return self.model_copy(update=moved)

    def lidars(self) -> dict[str, Device[Any]]:
        """The lidars by role, in the order of their topics (``SCANS``)."""
        return {role: device for role, device in self.present().items() if DEVICES.roles[role].topic in SCANS}

    def measures(self, topic: Topic[Any]) -> bool:
        """Whether a configured device publishes a sensor topic."""
        written = ((*DEVICES.roles[role].writes.values(), *d.kind.also.values()) for role, d in self.present().items())
        return any(topic in topics for topics in written)

    def shafts(self) -> dict[str, Device[Any]]:
        """Controllers of the driven shafts, by shaft; one device may control several shafts."""
        return {SHAFTS[i]: device for role, device in self.present().items() for i in _served(role, device)}

    def controller(self) -> str | None:
        """Role of the device that controls the first driven shaft; None if there is none."""
        return next((role for role, device in self.present().items() if 0 in _served(role, device)), None)

    def steers(self) -> tuple[str, SteeringOutputs] | None:
        """Role and steering outputs of the steering device; None if no device steers."""
        return next(self._steering(), None)

    def _steering(self) -> Iterator[tuple[str, SteeringOutputs]]:
        for role, device in self.present().items():
            if (outputs := steering_outputs(device.driver)) is not None:
                yield role, outputs

    @model_validator(mode="after")
    def _one_steers(self) -> Self:
        roles = [role for role, _ in self._steering()]
        if len(roles) > 1:
            raise ValueError(f"{roles[0]} and {roles[1]} both steer; remove the servos of one")
        return self

    @model_validator(mode="after")
    def _lidars_turned_over_by_roll(self) -> Self:
        for role, device in self.lidars().items():
            if abs(pitch := device.mount.pitch) > math.pi / 2:
                same = turned_by_roll(device.mount)
                raise ValueError(
                    f"{role}.mount.pitch {pitch:g}: expected -pi/2 to pi/2; the same orientation is "
                    f"roll {same.roll:.4f}, pitch {same.pitch:.4f}, yaw {same.yaw:.4f}"
                )
        return self

    @model_validator(mode="after")
    def _one_port_each(self) -> Self:
        taken: dict[str, str] = {}
        for role, device in self.present().items():
            port = device.port
            where = port.label
            if other := taken.get(where):
                raise ValueError(f"{other} and {role} have the same port {where}; expected a port for each")
            taken[where] = role
        return self

    @model_validator(mode="after")
    def _sensors_alone_on_the_network(self) -> Self:
        for role, device in self.present().items():
            if not isinstance(device.port, TcpPortConfig):
                continue
            if DEVICES.roles[role].duty is Duty.ACTUATOR:
                raise ValueError(
                    f"{role}: the stop script cannot stop it over the network; expected a path, or hub and port"
                )
            if device.kind.opens != "serial":
                raise ValueError(
                    f"{role}: a {device.kind.name} has no network address; expected a path, or hub and port"
                )
        return self

    @model_validator(mode="after")
    def _programs_give_pictures(self) -> Self:
        for role, device in self.present().items():
            if isinstance(device.port, CommandPortConfig) and device.kind.name != "mjpeg":
                raise ValueError(
                    f"{role}: only a camera of kind mjpeg may read the output of a program; expected another port"
                )
        return self

    @model_validator(mode="after")
    def _buses_by_path(self) -> Self:
        for role, device in self.present().items():
            if device.kind.opens == "i2c" and not isinstance(device.port, PortConfig):
                raise ValueError(f"{role}: a {device.kind.name} is on an I2C bus; expected a path such as /dev/i2c-1")
        return self

    @model_validator(mode="after")
    def _one_writer_each(self) -> Self:
        owners: dict[str, str] = {}
        for role, device in self.present().items():
            writes = [topic.name for topic in DEVICES.roles[role].writes.values()]
            for topic in writes[: len(_served(role, device)) or 1]:
                if other := owners.get(topic):
                    raise ValueError(f"{other} and {role} both publish {topic}; expected one writer for each topic")
                owners[topic] = role
        return self


def _served(role: str, device: Device[Any]) -> tuple[int, ...]:
    """Numbers of the driven shafts that a device controls."""
    return DEVICES.roles[role].shafts[: getattr(device.driver, "shafts", 1)]


class _Monitors(Schema):
    """Monitors of the computer itself, without a port; monitors that are omitted do not run."""

    def present(self) -> dict[str, Schema]:
        """Settings of the configured monitors, by role."""
        return dict(_present(self))


def _present(section: Schema) -> Iterator[tuple[str, Any]]:
    return ((role, found) for role in type(section).model_fields if (found := getattr(section, role)) is not None)


def _section(base: type[Schema], name: str, *, monitors: bool) -> Any:
    roles = [role for role in DEVICES.roles.values() if (role.duty is Duty.MONITOR) is monitors]
    fields: dict[str, Any] = {
        role.name: (_choice(role, monitors=monitors) | None, Field(None, description=role.doc)) for role in roles
    }
    return create_model(name, __base__=base, __module__=__name__, __doc__=base.__doc__, **fields)


def _choice(role: RoleSpec, *, monitors: bool) -> Any:
    """Union of the settings of all kinds that can fill a role."""
    kinds = {kind.name: kind.settings_class() for kind in DEVICES.of_role(role.name)}
    models = {name: model if monitors else Device[model] for name, model in kinds.items()}  # type: ignore[valid-type]
    if len(models) == 1:
        return next(iter(models.values()))
    default = next(iter(models))

    def tag(value: Any) -> str:
        if isinstance(value, dict):
            driver = value if monitors else value.get("driver")
            return str(driver.get("kind", default)) if isinstance(driver, dict) else default
        return str(vars(value if monitors else value.driver)["kind"])

    return Annotated[reduce(or_, (Annotated[model, Tag(name)] for name, model in models.items())), Discriminator(tag)]


if TYPE_CHECKING:

    class Devices(_Devices):
        """Devices by role; only roles used by the robot's code are declared."""

        lidar: Device[Schema] | None = None
        lidar_2: Device[Schema] | None = None
        drive: Device[EposConfig] | None = None
        steering: Device[MaestroConfig] | None = None
        compass: Device[Schema] | None = None
        stabiliser: Device[Ax12Config] | None = None
        camera: Device[Schema] | None = None
        sonar: Device[Srf08Config] | None = None
        imu: Device[Schema] | None = None
        encoders: Device[Schema] | None = None
        hand: Device[Schema] | None = None
        wheels: Device[StepperConfig] | None = None
        actuators: Device[VescConfig] | None = None

    class Monitors(_Monitors):
        """Monitors by role; only roles used by the robot's code are declared."""

        battery: IioConfig | None = None
        link: LinkQualityConfig | None = None
        host: HostHealthConfig | None = None

else:
    Devices = _section(_Devices, "Devices", monitors=False)
    Monitors = _section(_Monitors, "Monitors", monitors=True)
