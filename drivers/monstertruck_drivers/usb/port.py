"""A port named by hub and port number: whatever node the device there has at the moment is opened."""

from typing import Final

from monstertruck_drivers.link import BAUD, Link
from monstertruck_drivers.usb.config import UsbPortConfig
from monstertruck_drivers.usb.ftdi import ADVICE, set_latency
from monstertruck_drivers.usb.hub import HubCoordinator
from monstertruck_drivers.usb.machine import Machine
from monstertruck_drivers.usb.power import PortPower
from monstertruck_drivers.usb.tree import Node, place, read_device
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import BusyError, DeviceError, DeviceLostError, PortBusyError, WrongDeviceError
from monstertruck_runtime.ports import EventSink
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason

OPEN_PATIENCE: Final = 2.0
"""Seconds a fresh node may refuse: it is announced before its driver and permissions are in place."""
RETRY: Final = 0.05
SHORT_SESSION: Final = 10 * SECOND


class HubNode:
    """Resolves hub and port to the present node of one kind; never looks anywhere else.

    Args:
        config: the place.
        machine: where it is looked up.
        hubs: who must wait for a hub; None = nobody waits.
        role: the device's role, for ``hubs``.
        kind: ``tty`` or ``video4linux``.
    """

    def __init__(
        self,
        config: UsbPortConfig,
        machine: Machine,
        hubs: HubCoordinator | None = None,
        role: str = "",
        kind: str = "tty",
    ) -> None:
        self.name = place(config.device)
        self._config = config
        self._machine = machine
        self._hubs = hubs
        self._role = role
        self._kind = kind

    async def resolve(self) -> Node:
        """Wait for the device's turn to start, then find its node.

        Raises:
            DeviceLostError: nothing is plugged in, or it has no such node (yet).
            WrongDeviceError: another kind of device is plugged in.
        """
        if self._hubs is not None:
            await self._hubs.wait_to_start(self._role)
        try:
            return await self._look()
        except DeviceLostError:
            if self._hubs is not None:
                self._hubs.on_miss()
            raise

    async def _look(self) -> Node:
        config = self._config
        device = await self._machine.beside(lambda: read_device(self._machine.sysfs, config.device))
        if device is None:
            raise DeviceLostError(f"{self.name}: not plugged in")
        if config.usb_id is not None and device.usb_id != config.usb_id:
            raise WrongDeviceError(
                f"{self.name}: expected USB device {config.usb_id}, found {device.usb_id} {device.title}".rstrip()
            )
        node = device.find(self._kind, config.interface)
        if node is None:
            raise DeviceLostError(
                f"{self.name}: {device.usb_id} {device.title} has no {self._kind} at interface {config.interface}"
            )
        return node


class HubPort:
    """Serial port of the device at a hub's port; implements ``Port``.

    Args:
        config: the place.
        machine: where it is looked up.
        events: an adapter's latency that cannot be lowered.
        hubs: who must wait for a hub; None = nobody waits.
        power: switches the port after several short sessions, where configured.
        role: the device's role.
    """

    def __init__(
        self,
        config: UsbPortConfig,
        machine: Machine,
        events: EventSink,
        hubs: HubCoordinator | None = None,
        power: PortPower | None = None,
        role: str = "",
    ) -> None:
        self._node = HubNode(config, machine, hubs, role)
        self.name = self._node.name
        self._config = config
        self._machine = machine
        self._events = events
        self._power = power
        self._role = role
        self._opened_at: int | None = None
        self._short_sessions = 0
        self._told_slow = False

    async def open(self) -> Link:
        """Wait for the device's turn, find its node, open it.

        Raises:
            DeviceLostError: nothing is plugged in.
            WrongDeviceError: another kind of device is plugged in.
            PortBusyError: another process holds it.
        """
        await self._cycle_if_hopeless()
        give_up = self._machine.clock.now() + round(OPEN_PATIENCE * SECOND)
        while True:
            node = await self._node.resolve()
            device = self._machine.dev / node.name
            try:
                link = await self._machine.serial(device, self._config.baud or BAUD).open()
            except (DeviceLostError, PortBusyError):
                if self._machine.clock.now() >= give_up:
                    raise
            else:
                break
            await self._machine.clock.sleep(RETRY)
        self._opened_at = self._machine.clock.now()
        try:
            await self._lower_latency(node)
        except BaseException:
            link.close()
            raise
        return link

    async def _lower_latency(self, node: Node) -> None:
        wanted = self._config.latency_ms
        device = self._machine.dev / node.name
        latency = await self._machine.beside(lambda: set_latency(self._machine.sysfs, node, device, wanted))
        slow = latency is not None and latency > wanted
        if slow and not self._told_slow:
            text = f"{self.name}: latency stays at {latency} ms instead of {wanted} ms; {ADVICE}"
            self._events(Reason.SLOW_LINK, Severity.WARNING, self._role or "usb", text, latency_ms=latency)
        self._told_slow = slow

    async def _cycle_if_hopeless(self) -> None:
        """Switch the port off and on when sessions on it keep ending early."""
        opened, self._opened_at = self._opened_at, None
        if opened is None:
            return
        short = self._machine.clock.now() - opened < SHORT_SESSION
        self._short_sessions = self._short_sessions + 1 if short else 0
        power = self._power
        if power is None or power.config.after is None or self._short_sessions < power.config.after:
            return
        try:
            await power.cycle(self._config.device)
        except DeviceError as error:
            self._events(Reason.DEVICE_FAULT, Severity.WARNING, self._role or "usb", f"{self.name}: {error}")
        except BusyError:  # too soon after the last cycle
            return
        self._short_sessions = 0
