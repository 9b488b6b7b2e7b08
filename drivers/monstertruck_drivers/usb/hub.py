"""Combine simultaneous losses behind a hub into one event, and restart the hub's devices in sequence.

A ``HubCoordinator`` compares snapshots and evaluates losses together after a short delay. If a hub has vanished, or all
of its several devices have, the topmost such hub is reported, and all devices behind it wait for the hub. Once the tree
behind the returned hub is stable, its devices may start in order of safety. A device that puts a load on the hub starts
after a delay: a lidar or camera draws its in-rush current when it is started, whereas an interface draws it when
plugged in. A device may also have to wait because its port reported over-current.
"""

import asyncio
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from itertools import accumulate
from typing import Final

from monstertruck_drivers.computer import Machine, Watcher
from monstertruck_drivers.usb.config import UsbConfig, UsbPortConfig
from monstertruck_drivers.usb.tree import (
    DEVICES,
    TreeSnapshot,
    UsbDevice,
    ancestors,
    parent_of,
    place,
    read_tree,
    renumbered,
    sort_key,
)
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.ports import EventSink, Publisher, Ready
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.roles import ServiceName
from monstertruck_schemas.usb import UsbNode, UsbState, UsbTree

NAME: Final = ServiceName.USB.value


@dataclass(slots=True)
class _Slot:
    """State of one place in the tree."""

    device: UsbDevice | None = None
    """Device last seen here."""
    present: bool = False
    replugs: int = 0
    free_at: int | None = 0
    """Earliest start of its device (ns); None while it waits for its hub."""
    held_until: int = 0
    over_current: int = 0


@dataclass(slots=True)
class _HubOutage:
    """Outage of a hub or of all its devices; it ends when the devices may start."""

    hub: str
    since: int
    changed: int
    members: set[str]
    announced: bool


class HubCoordinator:
    """Decides which devices must wait for a hub.

    Args:
        config: timing and start order.
        ports: configured place of every role.
        clock: the daemon's clock.
        events: sink for events: hubs lost and returned, devices moved, over-current.
    """

    def __init__(self, config: UsbConfig, ports: Mapping[str, UsbPortConfig], clock: Clock, events: EventSink) -> None:
        self._config = config
        self._ports = ports
        self._places: dict[str, str] = {}
        """Place of each role by its kernel name; the configured name before the first look-up."""
        self._roles: dict[str, str] = {}
        """Role of each place."""
        self._locate(lambda name: name)
        self._clock = clock
        self._events = events
        self._slots: dict[str, _Slot] = {}
        self._judging: dict[str, int] = {}
        self._outages: dict[str, _HubOutage] = {}
        self._looked = False
        self._roots: dict[tuple[str, int], str] = {}
        """Root hubs by controller and speed, as last seen."""
        self._turn = asyncio.Event()
        self.on_miss: Callable[[], None] = lambda: None
        """Called when a port finds no device plugged in, to request a read of the tree."""

    # Queries of a port

    async def wait_to_start(self, role: str) -> None:
        """Wait until the device of ``role`` may start; return immediately for roles without a USB port."""
        slot = self._slots.get(self._places.get(role, ""))
        while slot is not None and self._waits(slot):
            if slot.free_at is None:
                await self._turn.wait()
            else:
                await self._clock.sleep_until(max(slot.free_at, slot.held_until))

    @property
    def waiting(self) -> frozenset[str]:
        """Roles whose devices may not start yet."""
        slots = ((role, self._slots.get(name)) for role, name in self._places.items())
        return frozenset(role for role, slot in slots if slot is not None and self._waits(slot))

    def waits_for(self, role: str) -> str | None:
        """Return the reason why the device of ``role`` may not start, as text; None if it may start."""
        name = self._places.get(role, "")
        slot = self._slots.get(name)
        if slot is None or not self._waits(slot):
            return None
        if slot.held_until > self._clock.now():
            return f"held after over-current at {place(name)}"
        outage = self._outage_of(name)
        return f"waits for hub {outage.hub if outage is not None else parent_of(name)}"

    def _waits(self, slot: _Slot) -> bool:
        return slot.free_at is None or max(slot.free_at, slot.held_until) > self._clock.now()

    # Called by the watching service

    def update(self, snapshot: TreeSnapshot) -> None:
        """Process a new snapshot of the tree, and everything that has become due since the last one."""
        now = self._clock.now()
        self._follow_buses(snapshot)
        self._locate(snapshot.at_present)
        for name in sorted(self._slots.keys() | snapshot.devices.keys(), key=sort_key):
            slot = self._slots.setdefault(name, _Slot())
            seen = snapshot.devices.get(name)
            if slot.present and slot.device is not None and (seen is None or seen.devnum != slot.device.devnum):
                self._depart(name, slot, now)
            if seen is not None:
                before, slot.device = slot.device, seen
                if not slot.present:
                    self._arrive(name, slot, before, now)
        self._count_over_current(snapshot.over_current, now)
        self._judge(now)
        self._release(now)
        self._looked = True
        self._call_turn()

    def next_due(self) -> int | None:
        """Return when ``update`` must decide even without a change in the tree (ns); None if never."""
        dues = [max(self._judging.values()) + _ns(self._config.together)] if self._judging else []
        dues += [
            outage.changed + self._pause(outage) for outage in self._outages.values() if self._slots[outage.hub].present
        ]
        return min(dues, default=None)

    def stop_watching(self) -> None:
        """Release all waiting devices, because the tree is no longer read."""
        self._judging.clear()
        self._outages.clear()
        self._looked = False
        for slot in self._slots.values():
            slot.free_at, slot.held_until = 0, 0
        self._call_turn()

    def tree(self) -> tuple[UsbNode, ...]:
        """Return all present nodes and all absent configured devices, parents before children."""
        names = sorted({*self._slots, *self._places.values()}, key=sort_key)
        return tuple(node for name in names if (node := self._node(name)) is not None)

    # Where the roles are

    def _locate(self, at_present: Callable[[str], str]) -> None:
        self._places = {role: at_present(port.device) for role, port in self._ports.items()}
        self._roles = {name: role for role, name in self._places.items()}

    def _follow_buses(self, snapshot: TreeSnapshot) -> None:
        """Transfer the state of places whose controller came back with other bus numbers."""
        roots = {(root.controller, root.speed): root.name for root in snapshot.roots()}
        buses = {
            before.removeprefix("usb"): root.removeprefix("usb")
            for key, root in roots.items()
            if (before := self._roots.get(key, root)) != root
        }
        self._roots = {key: root for key, root in self._roots.items() if root not in roots.values()} | roots
        if not buses:
            return
        gone = {name for name in self._slots if _bus(name) not in buses and _bus(name) in buses.values()}
        for name in gone:
            self._forget(name)
        self._slots = {renumbered(name, buses): slot for name, slot in self._slots.items()}
        self._judging = {renumbered(name, buses): since for name, since in self._judging.items()}
        for outage in self._outages.values():
            outage.hub = renumbered(outage.hub, buses)
            outage.members = {renumbered(name, buses) for name in outage.members}
        self._outages = {outage.hub: outage for outage in self._outages.values()}

    def _forget(self, name: str) -> None:
        """Drop the state of a place whose name another place has taken."""
        del self._slots[name]
        self._judging.pop(name, None)
        self._outages.pop(name, None)
        for outage in self._outages.values():
            outage.members.discard(name)

    # Arrivals and losses

    def _depart(self, name: str, slot: _Slot, now: int) -> None:
        slot.present, slot.free_at = False, None
        outage = self._outage_of(name)
        if outage is None:
            self._judging[name] = now
        else:
            outage.members.add(name)
            outage.changed = now

    def _arrive(self, name: str, slot: _Slot, before: UsbDevice | None, now: int) -> None:
        assert slot.device is not None
        slot.present = True
        slot.replugs += before is not None
        outage = self._outage_of(name)
        if outage is not None:
            slot.free_at = None
            outage.members.add(name)
            outage.changed = now
        elif name not in self._judging:
            slot.free_at = now
            if self._looked:
                if before is None or not _alike(before, slot.device):
                    self._report_if_moved(name, slot.device)
                if slot.device.hub:  # the devices of a new hub also start in sequence
                    self._outages[name] = _HubOutage(name, now, now, {name}, announced=False)

    def _outage_of(self, name: str) -> _HubOutage | None:
        return next((self._outages[hub] for hub in (name, *ancestors(name)) if hub in self._outages), None)

    def _judge(self, now: int) -> None:
        """Evaluate recent losses once all related losses have arrived."""
        if not self._judging or now - max(self._judging.values()) < _ns(self._config.together):
            return
        lost, self._judging = self._judging, {}
        groups: dict[str, set[str]] = {}
        for name in lost:
            hub = self._lost_hub(name, lost)
            if hub is None:
                self._slots[name].free_at = now
            else:
                groups.setdefault(hub, set()).add(name)
        for hub, group in groups.items():
            inner = [self._outages.pop(name) for name in list(self._outages) if hub in ancestors(name)]
            members = group.union(*(outage.members for outage in inner))
            since = min(lost[name] for name in group)
            self._outages[hub] = _HubOutage(hub, since, now, members, announced=True)
            self._report_lost(hub, members)

    def _lost_hub(self, name: str, lost: Mapping[str, int]) -> str | None:
        """Return the topmost hub whose loss explains the loss of ``name``; None if it vanished alone."""
        device = self._slots[name].device
        top = name if device is not None and device.hub else None
        for hub in ancestors(name):
            children = [n for n, slot in self._slots.items() if parent_of(n) == hub and (slot.present or n in lost)]
            if hub in lost or (len(children) > 1 and all(child in lost for child in children)):
                top = hub
        return top

    def _back(self, outage: _HubOutage) -> list[str]:
        """Return the devices behind the hub that have returned, in start order."""
        back = [name for name in outage.members if self._slots[name].present and not self._is_hub(name)]
        return sorted(back, key=self._start_rank)

    def _pause(self, outage: _HubOutage) -> int:
        """Return how long the tree must be stable before the devices of a returned hub may start (ns)."""
        return _ns(self._config.settle if self._back(outage) else self._config.empty_timeout)

    def _release(self, now: int) -> None:
        for outage in list(self._outages.values()):
            if not self._slots[outage.hub].present or now - outage.changed < self._pause(outage):
                continue
            back = self._back(outage)
            del self._outages[outage.hub]
            for name in outage.members:
                self._slots[name].free_at = now
            starting = [name for name in back if name in self._roles]
            for hub in dict.fromkeys(map(parent_of, starting)):
                self._stagger([name for name in starting if parent_of(name) == hub], now)
            if outage.announced or starting:
                self._report_returned(outage, back, now)

    def _stagger(self, starting: list[str], now: int) -> None:
        """Schedule one hub's devices; a device that puts a load on the hub starts after a delay."""
        turns = accumulate(name != starting[0] and self._loads(name) for name in starting)
        for turn, name in zip(turns, starting, strict=True):
            self._slots[name].free_at = now + turn * _ns(self._config.stagger)

    def _loads(self, name: str) -> bool:
        return self._roles.get(name) in self._config.start_apart

    def _start_rank(self, name: str) -> tuple[int, tuple[int, ...]]:
        order = self._config.start_order
        role = self._roles.get(name)
        return order.index(role) if role in order else len(order), sort_key(name)

    def _count_over_current(self, counts: Mapping[str, int], now: int) -> None:
        hit = []
        for name in sorted(counts, key=sort_key):
            slot = self._slots.setdefault(name, _Slot())
            if self._looked and counts[name] > slot.over_current:
                slot.held_until = now + _ns(self._config.over_current_hold)
                hit.append(name)
            slot.over_current = counts[name]
        if hit:
            ports = ", ".join(self._describe(name) for name in hit)
            text = f"over-current at {ports}: not started for {self._config.over_current_hold:g} s, check the cables"
            self._events(
                Reason.OVER_CURRENT, Severity.ERROR, NAME, text, ports=",".join(hit), roles=self._roles_at(hit)
            )

    # Reports

    def _report_lost(self, hub: str, members: set[str]) -> None:
        devices = sorted((name for name in members if not self._is_hub(name)), key=sort_key)
        what = "vanished" if hub in members else "is present, but all devices behind it disappeared"
        self._events(
            Reason.HUB_LOST,
            Severity.WARNING,
            NAME,
            f"hub {hub} {what}: {self._names(devices) or 'no devices'}",
            hub=hub,
            devices=len(devices),
            roles=self._roles_at(devices),
        )

    def _report_returned(self, outage: _HubOutage, back: list[str], now: int) -> None:
        missing = sorted((m for m in outage.members if not self._slots[m].present), key=sort_key)
        text = f"hub {outage.hub} is back with {self._names(back) or 'no devices'}"
        if missing:
            text += f"; missing: {self._names(missing)}"
        self._events(
            Reason.HUB_RETURNED,
            Severity.WARNING if missing else Severity.INFO,
            NAME,
            text,
            hub=outage.hub,
            devices=len(back),
            missing=len(missing),
            seconds=(now - outage.since) / SECOND,
        )

    def _report_if_moved(self, name: str, device: UsbDevice) -> None:
        """Report a device that looks like a missing one but is at another place, where it is not used."""
        for other, slot in self._slots.items():
            known = slot.device
            wanted = other in self._roles or other in self._outages
            if not slot.present and wanted and known is not None and _alike(known, device):
                text = (
                    f"{self._describe(other)} seems to be at {place(name)} now: plug it into its port, or run find-port"
                )
                self._events(Reason.PORT_MOVED, Severity.WARNING, NAME, text, configured=other, found=name)

    def _describe(self, name: str) -> str:
        role = self._roles.get(name)
        return f"{place(name)} ({role})" if role else place(name)

    def _names(self, devices: Iterable[str]) -> str:
        return ", ".join(self._roles.get(name, name) for name in devices)

    def _roles_at(self, devices: Iterable[str]) -> str:
        return ",".join(self._roles[name] for name in devices if name in self._roles)

    def _is_hub(self, name: str) -> bool:
        device = self._slots[name].device
        return device is not None and device.hub

    def _node(self, name: str) -> UsbNode | None:
        slot = self._slots.get(name, _Slot())
        role = self._roles.get(name)
        waits = self._waits(slot)
        if not (slot.present or role or (waits and slot.device is not None)):
            return None
        held = slot.held_until > self._clock.now()
        there = UsbState.PRESENT if slot.present else UsbState.ABSENT
        device = slot.device
        # Before the first look a configured device is unknown.
        now_there = device if slot.present else None
        tty = now_there.tty if now_there is not None else None
        return UsbNode(
            name=name,
            parent=parent_of(name),
            title=device.title if device is not None else "",
            usb_id=device.usb_id if device is not None else None,
            serial=device.serial if device is not None else None,
            hub=device is not None and device.hub,
            tty=tty.name if tty is not None else None,
            role=role,
            state=UsbState.HELD if held else UsbState.WAITING if waits else there,
            replugs=slot.replugs,
            over_current=slot.over_current,
            autosuspend=now_there is not None and now_there.autosuspend,
            latency_ms=tty.latency_ms if tty is not None else None,
        )

    def _call_turn(self) -> None:
        self._turn.set()
        self._turn = asyncio.Event()


def _alike(a: UsbDevice, b: UsbDevice) -> bool:
    return (a.usb_id, a.serial) == (b.usb_id, b.serial)


def _bus(name: str) -> str:
    return str(sort_key(name)[0])


def _ns(seconds: float) -> int:
    return round(seconds * SECOND)


PERIOD: Final = SECOND
"""Interval between published trees without a change (ns)."""


class UsbService:
    """Reads the tree on a change notification, a missing device or a due decision, and at least every few seconds.

    Without this service, devices do not wait for their hubs.

    Args:
        config: timing.
        machine: computer with the tree.
        hubs: receives every snapshot.
        watcher: source of change notifications.
        out: publisher of the tree; it publishes on change and once per second.
        events: sink for events about devices that the kernel may suspend.
    """

    name = NAME

    def __init__(
        self,
        config: UsbConfig,
        machine: Machine,
        hubs: HubCoordinator,
        watcher: Watcher,
        out: Publisher[UsbTree],
        events: EventSink,
    ) -> None:
        self._config = config
        self._machine = machine
        self._clock = machine.clock
        self._hubs = hubs
        self._watcher = watcher
        self._out = out
        self._events = events
        self._wake = asyncio.Event()
        self._published: tuple[UsbNode, ...] = ()
        self._publish_at = 0
        self._look_at = 0
        self._reported_asleep: dict[str, int] = {}

    async def run(self, ready: Ready) -> None:
        """Watch until cancelled."""
        self._watcher.start(self._wake.set)
        self._hubs.on_miss = self._wake.set
        try:
            await self._look()
            self._publish()
            ready()
            while True:
                if await self._woken() or self._clock.now() >= self._next_look():
                    await self._look()
                self._publish()
        finally:
            self._watcher.stop()
            self._hubs.stop_watching()

    async def _woken(self) -> bool:
        """Sleep until a change notification (True) or a due time (False)."""
        seconds = (min(self._next_look(), self._publish_at) - self._clock.now()) / SECOND
        with suppress(TimeoutError):
            async with self._clock.deadline(max(seconds, 0.0)):
                await self._wake.wait()
        if not self._wake.is_set():
            return False
        await self._clock.sleep(0.02)  # time to gather announcements (s): a hub sends dozens at once
        self._wake.clear()
        return True

    def _next_look(self) -> int:
        due = self._hubs.next_due()
        return self._look_at if due is None else min(self._look_at, due)

    async def _look(self) -> None:
        snapshot = await self._machine.offload(lambda: read_tree(self._machine.sysfs))
        self._hubs.update(snapshot)
        waiting_rescan = 0.5  # interval between reads of the tree while a driver waits for a hub (s)
        # A driver waiting for a hub does not request a read, so without announcements the service must read often.
        rescan = min(self._config.rescan, waiting_rescan) if self._hubs.waiting else self._config.rescan
        self._look_at = self._clock.now() + round(rescan * SECOND)
        for node in self._hubs.tree():
            if node.role is not None and node.autosuspend and self._reported_asleep.get(node.name) != node.replugs:
                self._reported_asleep[node.name] = node.replugs
                await self._keep_awake(node)

    async def _keep_awake(self, node: UsbNode) -> None:
        if await keep_awake(self._machine, node.name):
            severity, what = Severity.INFO, "the kernel was allowed to suspend it: now forbidden"
        else:
            severity = Severity.WARNING
            what = 'the kernel may suspend it; udev rule: ACTION=="add", SUBSYSTEM=="usb", ATTR{power/control}="on"'
        self._events(Reason.AUTOSUSPEND, severity, node.role or NAME, f"{place(node.name)}: {what}")
        self._wake.set()  # to publish the change in the tree

    def _publish(self) -> None:
        nodes, now = self._hubs.tree(), self._clock.now()
        if nodes == self._published and now < self._publish_at:
            return
        self._published, self._publish_at = nodes, now + PERIOD
        self._out.put(UsbTree(stamp=now, received=now, seq=self._out.next_seq(), nodes=nodes))


async def keep_awake(machine: Machine, name: str) -> bool:
    """Prevent the kernel from suspending a device; return False if not permitted."""

    def write() -> bool:
        with suppress(OSError):
            machine.sysfs.write(f"{DEVICES}/{name}/power/control", "on")
        return machine.sysfs.text(f"{DEVICES}/{name}/power/control") == "on"

    return await machine.offload(write)
