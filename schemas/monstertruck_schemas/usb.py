"""Messages of the USB tree: hubs, ports, devices, and why a device has not started."""

from enum import StrEnum
from typing import Annotated

from pydantic import Field

from monstertruck_schemas.base import Message, Schema


class UsbState(StrEnum):
    """Current state of a port of the tree."""

    PRESENT = "present"
    ABSENT = "absent"
    """Nothing plugged in where a device was, or should be."""
    WAITING = "waiting"
    """Gone together with its hub, or back and waiting for its turn to start."""
    HELD = "held"
    """The port reported over-current: not started for a while."""


class UsbNode(Schema):
    """One hub or device, named by its port."""

    name: str
    """Kernel's name of the place: ``usb1`` is a root hub, ``1-1.2`` is port 2 of the hub at root port 1."""
    parent: str | None = None
    """Name of the hub; None for a root hub."""
    title: str = ""
    """Product as the device calls itself."""
    usb_id: str | None = None
    """``vendor:product``, four hex digits each; None if it was never there."""
    serial: str | None = None
    """Serial number that it states; None if it states none, or was never there."""
    hub: bool = False
    """Whether it is a hub."""
    tty: str | None = None
    """Serial node at this moment, e.g. ``ttyUSB0``."""
    role: str | None = None
    """Place in the configuration's ``devices``."""
    state: UsbState
    """State of the place."""
    replugs: Annotated[int, Field(ge=0)] = 0
    """Times it came back since the daemon started."""
    over_current: Annotated[int, Field(ge=0)] = 0
    """Over-current conditions of its port since the hub appeared."""
    autosuspend: bool = False
    """The kernel may suspend it, which costs the first bytes or a reset."""
    latency_ms: int | None = None
    """FTDI latency timer; None for other chips."""


class UsbTree(Message):
    """All hubs and devices on the USB buses, and the missing configured devices; parents before children."""

    nodes: tuple[UsbNode, ...]
