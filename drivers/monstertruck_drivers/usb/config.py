"""Configuration of the USB tree: device places, hub outages and port power."""

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
"""Rate of a serial line (bit/s)."""


class UsbPortConfig(Schema):
    """Place of a device, given by hub and port; it remains valid when ttyUSB numbers change."""

    hub: Annotated[
        str, Field(pattern=r"^(usb[0-9]+|[0-9]+-[0-9]+(\.[0-9]+)*|[a-zA-Z][^\s/\"]*-usb-0:(0|[0-9]+(\.[0-9]+)*))$")
    ]
    """Hub by topology, as ``find-port`` writes it: "pci-0000:00:14.0-usb-0:1", with "usb-0:0" for a root hub; or \
its kernel's name, which may change with the next boot: "1-1", or "usb1" for a root hub"""
    port: Annotated[int, Field(ge=1, le=31)]
    """Port number on the hub"""
    interface: Annotated[int, Field(ge=0, le=31)] = 0
    """USB interface of the serial line; a Maestro takes commands at 0"""
    baud: Baud | None = None
    """Baud rate (bit/s); null selects the device's default. USB-CDC devices ignore it"""
    dtr: bool = True
    """Level of the DTR line while the port is open; false lets an RPLIDAR's motor turn"""
    rts: bool = True
    """Level of the RTS line while the port is open"""
    framing: Framing | None = None
    """Format of a byte; null selects the device's default"""
    usb_id: Annotated[str, Field(pattern=r"^[0-9a-f]{4}:[0-9a-f]{4}$")] | None = None
    """Expected vendor:product, checked before the first byte is sent; None leaves the check to the handshake"""
    latency_ms: Annotated[int, Field(ge=1, le=255)] = 1
    """Latency timer of an FTDI adapter, set at every open"""

    @property
    def device(self) -> str:
        """Kernel name of a device plugged in at this place."""
        return device_name(self.hub, self.port)

    @property
    def label(self) -> str:
        """Hub and port in words."""
        return place(self.device)

    def at_present(self, sysfs: Sysfs) -> Self:
        """Return this place with current kernel names; or this place itself if its controller is absent."""
        name = at_present(sysfs, self.device)
        if name == self.device:
            return self
        return self.model_copy(update={"hub": str(parent_of(name)), "port": port_of(name)})


class CycleMethod(StrEnum):
    """Method for switching a port off and on."""

    AUTHORIZED = "authorized"
    """The kernel drops the device and enumerates it again; power stays on."""
    PORT = "port"
    """The kernel's port attribute ``disable`` (6.0 and later); cuts power where the hub can."""
    UHUBCTL = "uhubctl"
    """The program uhubctl, which must be installed; for hubs with power switches."""


class PowerConfig(Schema):
    """Power switching of individual ports."""

    method: CycleMethod | None = None
    """Method to switch ports; None disables switching"""
    after: Annotated[int, Field(ge=1, le=100)] | None = None
    """Number of consecutive short sessions before a port is cycled automatically; None: only on request"""
    off_time: Annotated[float, Field(ge=0.1, le=30)] = 2.0
    """Time without power (s)"""
    cut: Annotated[tuple[str, ...], Field(strict=False)] = ()
    """Roles of devices whose port is switched off, and stays off, when a motor turns and neither quick stop nor power
    stage off stops it; for ports that feed the motor's controller, or a relay in its supply"""

    @model_validator(mode="after")
    def _method_known(self) -> Self:
        if self.after is not None and self.method is None:
            raise ValueError("after: automatic power cycling of ports needs a method")
        if self.cut and self.method not in (CycleMethod.PORT, CycleMethod.UHUBCTL):
            raise ValueError("cut: expected method port or uhubctl, which switch a port's power")
        return self


class UsbConfig(Schema):
    """Settings for watching the USB tree."""

    rescan: Annotated[float, Field(ge=0.2, le=60)] = 5.0
    """Interval between reads of the tree without change notifications (s)"""
    together: Seconds = 0.2
    """Waiting time after the last loss before losses are judged (s): losses behind one hub are one loss of the hub"""
    settle: Seconds = 0.5
    """Time without change behind a returned hub before its devices start (s)"""
    empty_timeout: Seconds = 3.0
    """Maximum time for a returned hub to stay empty before its devices are considered unplugged (s)"""
    stagger: Seconds = 0.3
    """Delay of a device that loads the hub after the start of its predecessor (s)"""
    start_apart: tuple[str, ...] = Field(default_factory=started_apart)
    """Roles that load the hub when they start; all others start as soon as the hub's devices are stable"""
    start_order: tuple[str, ...] = Field(default_factory=start_order)
    """Start order of roles behind a returned hub: devices that stop the truck first, devices that load the bus last"""
    over_current_hold: Seconds = 10.0
    """Delay of a device's start after its port reported over-current (s)"""
    power: PowerConfig = PowerConfig()
