"""USB port given by hub and port number: opens its current node, lowers its adapter's latency, switches its power."""

from collections import defaultdict
from threading import Lock
from typing import Final

from monstertruck_drivers.computer import Machine, Sysfs
from monstertruck_drivers.link import BAUD, Link
from monstertruck_drivers.usb.config import CycleMethod, PowerConfig, UsbPortConfig
from monstertruck_drivers.usb.hub import HubCoordinator
from monstertruck_drivers.usb.tree import (
    DEVICES,
    Node,
    UsbDevice,
    at_present,
    parent_of,
    place,
    port_directory,
    port_of,
    read_device,
    topology_of,
)
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import (
    BusyError,
    DeviceError,
    DeviceLostError,
    DeviceWedgedError,
    PortBusyError,
    WrongDeviceError,
)
from monstertruck_runtime.ports import EventSink
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason

ADVICE: Final = (
    'udev rule: ACTION=="add", SUBSYSTEM=="usb-serial", DRIVER=="ftdi_sio", ATTR{latency_timer}="1" '
    "(or run as a user who may write it)"
)


def lower_latency(sysfs: Sysfs, node: Node, latency_ms: int) -> bool:
    """Lower the latency timer of an adapter; blocks.

    Args:
        sysfs: sysfs with the adapter's attributes.
        node: serial node, as just read.
        latency_ms: desired latency (ms).

    Returns:
        True if writing is not permitted, so that the port must be opened with low latency instead.
    """
    if node.latency_ms is None or node.latency_ms <= latency_ms:
        return False
    try:
        sysfs.write(_timer(node), str(latency_ms))
    except OSError:
        return True
    return False


def _timer(node: Node) -> str:
    return f"{node.path}/latency_timer"


class PortPower:
    """Cycles ports; the minimum interval per port grows: 1, 2, 4 ... 60 s.

    Args:
        config: method and timing.
        machine: computer with the ports.
        events: sink for reports of every power cycle.
    """

    def __init__(self, config: PowerConfig, machine: Machine, events: EventSink) -> None:
        self.config = config
        self._machine = machine
        self._events = events
        self._cycles: dict[str, tuple[int, int]] = {}
        """Number of cycles and time of the latest (ns), by the port's topology name, because bus numbers change."""
        self._writing: defaultdict[str, Lock] = defaultdict(Lock)
        """Locks by first attribute; they keep the writes of one port in order, even after a caller was cancelled."""

    async def cycle(self, name: str) -> None:
        """Switch the port of ``name`` off and on; its device vanishes and returns.

        Args:
            name: topology name or kernel name of the device's place.

        Raises:
            DeviceError: switching is not configured, the device is a hub, or the machine refuses to switch.
            BusyError: the last power cycle of this port was too recent.
        """
        method = self.config.method
        if method is None:
            raise DeviceError("no method to switch USB ports is configured (power.method)")
        name = await self._present_name(name)
        device = await self._machine.offload(lambda: read_device(self._machine.sysfs, name))
        if parent_of(name) is None or (device is not None and device.hub):
            raise DeviceError(f"{name} is a hub: only ports of single devices can be switched")
        self._pace(name, await self._machine.offload(lambda: topology_of(self._machine.sysfs, name)))
        try:
            if method is CycleMethod.UHUBCTL:
                await self._cycle_by_uhubctl(name)
            elif method is CycleMethod.PORT:
                await self._toggle(await self._halves(name), "1", "0", self.config.off_time)
            else:
                settled = 0.5  # time without authorization (s)
                await self._toggle([f"{DEVICES}/{name}/authorized"], "0", "1", settled)
        except OSError as error:
            raise DeviceError(f"{place(name)} cannot be switched by {method.value!r}: {error}") from error
        self._events(
            Reason.PORT_CYCLED, Severity.WARNING, "usb", f"{place(name)} was switched off and on", method=method.value
        )

    async def switch_off(self, name: str) -> None:
        """Cut the power of the port of ``name`` until the port is cycled; ``name`` as in ``cycle``.

        Raises:
            DeviceError: the machine refuses to switch.
        """
        name = await self._present_name(name)
        try:
            if self.config.method is CycleMethod.UHUBCTL:
                await self._uhubctl(name, "off")
            else:
                await self._write_all(await self._halves(name), "1")
        except OSError as error:
            raise DeviceError(f"{place(name)} cannot be switched off: {error}") from error
        self._events(Reason.PORT_OFF, Severity.WARNING, "usb", f"{place(name)} was switched off, and stays off")

    async def _present_name(self, name: str) -> str:
        return await self._machine.offload(lambda: at_present(self._machine.sysfs, name))

    def _pace(self, name: str, topology: str) -> None:
        now = self._machine.clock.now()
        count, last = self._cycles.get(topology, (0, now))
        if now - last > 600 * SECOND:  # time without a cycle that resets the pause (s)
            count = 0
        longest_pause = 60  # maximum pause between cycles of one port (s)
        if count:
            pause = min(1 << (count - 1), longest_pause)
            left = pause - (now - last) / SECOND
            if left > 0:
                raise BusyError(f"{place(name)} was switched moments ago; possible again in {left:.1f} s")
        self._cycles[topology] = (min(count + 1, longest_pause), now)

    async def _halves(self, name: str) -> list[str]:
        """Return the port's attributes: the kernel sees a USB 3 hub as two hubs, and both ports must be off."""
        sysfs, port = self._machine.sysfs, port_directory(name)
        peer = f"{port}/peer/disable"
        there = await self._machine.offload(lambda: sysfs.text(peer))
        return [f"{port}/disable", *([peer] if there is not None else [])]

    async def _write_all(self, attributes: list[str], value: str) -> None:
        sysfs, in_order = self._machine.sysfs, self._writing[attributes[0]]

        def write() -> None:
            with in_order:
                for attribute in attributes:
                    sysfs.write(attribute, value)

        await self._machine.offload(write)

    async def _toggle(self, attributes: list[str], off: str, on: str, seconds: float) -> None:
        try:
            await self._write_all(attributes, off)
            await self._machine.clock.sleep(seconds)
        finally:
            await self._write_all(attributes, on)

    async def _cycle_by_uhubctl(self, name: str) -> None:
        """Switch off and on in two runs: an interrupted uhubctl ``cycle`` would leave the port without power."""
        try:
            await self._uhubctl(name, "off")
            await self._machine.clock.sleep(self.config.off_time)
        finally:
            await self._uhubctl(name, "on")

    async def _uhubctl(self, name: str, action: str) -> None:
        hub = str(parent_of(name)).removeprefix("usb")
        code, output = await self._machine.run(["uhubctl", "-l", hub, "-p", str(port_of(name)), "-a", action])
        if code:
            raise DeviceError(f"{place(name)}: uhubctl failed with {code}: {output}")


BRAILLE: Final = frozenset(("0403:6001", "10c4:ea60", "1a86:7523"))
"""Adapters that brltty of Ubuntu 22.04 mistakes for braille displays."""


def why_no_node(device: UsbDevice, kind: str, interface: int) -> str:
    """Return the reason why a plugged-in device has no node, as text."""
    who = f"{device.usb_id} {device.title}".rstrip()
    if interface not in device.held:
        return f"{who} has no {kind} at interface {interface}"
    text = f"{who}: a program holds interface {interface} through usbfs, so no {kind} exists"
    brltty = "; brltty does this with such adapters, and install-service prevents it"
    return text + brltty * (device.usb_id in BRAILLE)


OPEN_TIMEOUT: Final = 2.0
"""Maximum time for a fresh node to refuse (s): it is announced before its driver and permissions are in place."""


class HubNode:
    """Resolves hub and port to the current node of one kind; it never searches other places.

    Args:
        config: place of the device.
        machine: computer for the look-up.
        hubs: coordinator of waiting devices; None if the port does not wait.
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
            DeviceLostError: no device is plugged in, or it has no such node (yet).
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
        config, sysfs = self._config, self._machine.sysfs
        device = await self._machine.offload(lambda: read_device(sysfs, at_present(sysfs, config.device)))
        if device is None:
            raise DeviceLostError(f"{self.name}: not plugged in")
        if config.usb_id is not None and device.usb_id != config.usb_id:
            raise WrongDeviceError(
                f"{self.name}: expected USB device {config.usb_id}, found {device.usb_id} {device.title}".rstrip()
            )
        node = device.find(self._kind, config.interface)
        if node is None:
            raise DeviceLostError(f"{self.name}: {why_no_node(device, self._kind, config.interface)}")
        return node


class HubPort:
    """Serial port of the device at a hub port; implements ``Port``.

    Args:
        config: place of the device.
        machine: computer for the look-up.
        events: sink for reports of an adapter whose latency cannot be lowered.
        hubs: coordinator of waiting devices; None if the port does not wait.
        power: power-cycles the port after several short sessions, if configured.
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
        self._reported_slow = False

    async def open(self) -> Link:
        """Wait for the device's turn, find its node and open it.

        Raises:
            DeviceLostError: no device is plugged in.
            DeviceWedgedError: the kernel does not finish opening or closing the port.
            WrongDeviceError: another kind of device is plugged in.
            PortBusyError: another process holds the port.
        """
        await self._cycle_if_hopeless()
        give_up = self._machine.clock.now() + round(OPEN_TIMEOUT * SECOND)
        while True:
            node = await self._node.resolve()
            try:
                link = await self._open(node)
            except DeviceWedgedError:
                raise
            except (DeviceLostError, PortBusyError) as error:
                if self._machine.clock.now() >= give_up:
                    raise
                retry = 0.05
                # Retry interval for a port held by another program (s); each attempt searches all processes.
                busy_retry = 0.5
                pause = busy_retry if isinstance(error, PortBusyError) else retry
            else:
                break
            await self._machine.clock.sleep(pause)
        self._opened_at = self._machine.clock.now()
        try:
            await self._judge_latency(node)
        except BaseException:
            link.close()
            raise
        return link

    async def _open(self, node: Node) -> Link:
        config, machine = self._config, self._machine
        by_flag = await machine.offload(lambda: lower_latency(machine.sysfs, node, config.latency_ms))
        port = machine.serial(
            machine.dev / node.name,
            config.baud or BAUD,
            dtr=config.dtr,
            rts=config.rts,
            low_latency=by_flag,
            framing=config.framing or "8N1",
        )
        return await port.open()

    async def _judge_latency(self, node: Node) -> None:
        wanted = self._config.latency_ms
        latency = await self._machine.offload(lambda: self._machine.sysfs.number(_timer(node)))
        slow = latency is not None and latency > wanted
        if slow and not self._reported_slow:
            text = f"{self.name}: latency stays at {latency} ms instead of {wanted} ms; {ADVICE}"
            self._events(Reason.SLOW_LINK, Severity.WARNING, self._role or "usb", text, latency_ms=latency)
        self._reported_slow = slow

    async def _cycle_if_hopeless(self) -> None:
        """Switch the port off and on when sessions on it keep ending early."""
        opened, self._opened_at = self._opened_at, None
        if opened is None:
            return
        short_session = 10 * SECOND
        short = self._machine.clock.now() - opened < short_session
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
