"""Configuration of the USB tree: where a device hangs, how hubs are judged, what may be switched."""

from enum import StrEnum
from typing import Annotated, Self

from pydantic import Field, model_validator

from monstertruck_drivers.catalog import start_order, started_apart
from monstertruck_drivers.computer import Sysfs
from monstertruck_drivers.link import Framing
from monstertruck_drivers.usb.tree import at_present, device_name, parent_of, place, port_of
from monstertruck_schemas.base import Schema

Seconds = Annotated[float, Field(ge=0, le=60)]
Baud = Annotated[int, Field(ge=4800, le=1_000_000)]
"""Of a serial line, bits per second."""


class UsbPortConfig(Schema):
    """A device by hub and port: the place stays when ttyUSB numbers change."""

    hub: Annotated[
        str, Field(pattern=r"^(usb[0-9]+|[0-9]+-[0-9]+(\.[0-9]+)*|[a-zA-Z][^\s/\"]*-usb-0:(0|[0-9]+(\.[0-9]+)*))$")
    ]
    """The hub by topology, as ``find-port`` writes it: "pci-0000:00:14.0-usb-0:1", with "usb-0:0" for a root hub; or \
its kernel's name, which may change with the next boot: "1-1", or "usb1" for a root hub"""
    port: Annotated[int, Field(ge=1, le=31)]
    """Port of that hub"""
    interface: Annotated[int, Field(ge=0, le=31)] = 0
    """USB interface that is the serial line; a Maestro's commands are 0"""
    baud: Baud | None = None
    """Bits per second; null = the device's own. USB-CDC devices ignore it"""
    dtr: bool = True
    """Level of the line DTR while the port is open; false lets an RPLIDAR's motor turn"""
    rts: bool = True
    """Level of the line RTS while the port is open"""
    framing: Framing | None = None
    """Bits of a byte; null = the device's own"""
    usb_id: Annotated[str, Field(pattern=r"^[0-9a-f]{4}:[0-9a-f]{4}$")] | None = None
    """Expected vendor:product, checked before the first byte; None leaves it to the handshake"""
    latency_ms: Annotated[int, Field(ge=1, le=255)] = 1
    """Latency timer of an FTDI adapter, set at every open"""

    @property
    def device(self) -> str:
        """Kernel's name of whatever is plugged in there."""
        return device_name(self.hub, self.port)

    @property
    def label(self) -> str:
        """Hub and port in words."""
        return place(self.device)

    def at_present(self, sysfs: Sysfs) -> Self:
        """The same place by the kernel's names of this moment; itself if its controller is not there."""
        name = at_present(sysfs, self.device)
        if name == self.device:
            return self
        return self.model_copy(update={"hub": str(parent_of(name)), "port": port_of(name)})


class CycleMethod(StrEnum):
    """How a port is switched off and on."""

    AUTHORIZED = "authorized"
    """The kernel drops the device and enumerates it again; power stays on."""
    PORT = "port"
    """The kernel's port attribute ``disable`` (6.0 and later); cuts power where the hub can."""
    UHUBCTL = "uhubctl"
    """The program uhubctl, which must be installed; for hubs with power switches."""


class PowerConfig(Schema):
    """Switching of single ports."""

    method: CycleMethod | None = None
    """None = ports are never switched"""
    after: Annotated[int, Field(ge=1, le=100)] | None = None
    """Short sessions in a row after which a port is cycled unasked; None = only on request"""
    off_time: Annotated[float, Field(ge=0.1, le=30)] = 2.0
    """Seconds without power"""
    cut: Annotated[tuple[str, ...], Field(strict=False)] = ()
    """Roles of devices whose port is switched off, and stays off, when a motor turns and neither quick stop nor power
    stage off stops it: where the port feeds the motor's controller, or a relay in its supply"""

    @model_validator(mode="after")
    def _method_known(self) -> Self:
        if self.after is not None and self.method is None:
            raise ValueError("after: ports can be cycled unasked only by a method")
        if self.cut and self.method not in (CycleMethod.PORT, CycleMethod.UHUBCTL):
            raise ValueError("cut: expected method port or uhubctl, which switch a port's power")
        return self


class UsbConfig(Schema):
    """How the USB tree is watched."""

    rescan: Annotated[float, Field(ge=0.2, le=60)] = 5.0
    """Seconds between two checks of the tree when nothing is announced"""
    together: Seconds = 0.2
    """Seconds without a further loss after which losses are judged: those behind one hub are one loss of the hub"""
    settle: Seconds = 0.5
    """Seconds without change behind a returned hub before its devices start"""
    empty_timeout: Seconds = 3.0
    """Seconds a returned hub may stay empty until its devices count as unplugged"""
    stagger: Seconds = 0.3
    """Seconds between the start of a device that loads the hub and the one before it"""
    start_apart: tuple[str, ...] = Field(default_factory=started_apart)
    """Roles that load the hub when they start; all others start as soon as its devices keep still"""
    start_order: tuple[str, ...] = Field(default_factory=start_order)
    """Roles in the order they start behind a returned hub: what stops the truck first, what loads the bus last"""
    over_current_hold: Seconds = 10.0
    """Seconds a device is not started after its port reported over-current"""
    power: PowerConfig = PowerConfig()
