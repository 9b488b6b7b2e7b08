"""Watches the USB tree: publishes it, and keeps the ``HubCoordinator`` informed."""

import asyncio
from contextlib import suppress
from typing import Final

from monstertruck_drivers.usb.config import UsbConfig
from monstertruck_drivers.usb.hub import NAME, HubCoordinator
from monstertruck_drivers.usb.machine import Machine
from monstertruck_drivers.usb.power import keep_awake
from monstertruck_drivers.usb.tree import place, read_tree
from monstertruck_drivers.usb.watch import Watcher
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.ports import EventSink, Publisher, Ready
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.usb import UsbNode, UsbTree

BURST: Final = 0.02
"""Seconds in which announcements are gathered: a hub announces dozens at once."""
IMPATIENT: Final = 0.5
"""Seconds between two looks while somebody waits for a hub."""
PERIOD: Final = SECOND
"""Nanoseconds between two trees when nothing changes."""


class UsbService:
    """Looks at the tree when something is announced, missed or due, and every few seconds anyway.

    Without this service nobody waits for a hub.

    Args:
        config: times.
        machine: whose tree.
        hubs: gets every snapshot.
        watcher: source of announcements.
        out: the tree, on change and once a second.
        events: devices the kernel may suspend.
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
        self._told_asleep: dict[str, int] = {}

    @property
    def waiting(self) -> frozenset[str]:
        """Roles that may not start at this moment."""
        return self._hubs.waiting

    async def gate_start(self, role: str) -> None:
        """Wait until the device of ``role`` may start."""
        await self._hubs.wait_to_start(role)

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
        """Sleep until something is announced (True) or due (False)."""
        seconds = (min(self._next_look(), self._publish_at) - self._clock.now()) / SECOND
        with suppress(TimeoutError):
            async with self._clock.deadline(max(seconds, 0.0)):
                await self._wake.wait()
        if not self._wake.is_set():
            return False
        await self._clock.sleep(BURST)
        self._wake.clear()
        return True

    def _next_look(self) -> int:
        due = self._hubs.next_due()
        return self._look_at if due is None else min(self._look_at, due)

    async def _look(self) -> None:
        snapshot = await self._machine.beside(lambda: read_tree(self._machine.sysfs))
        self._hubs.update(snapshot)
        # Who waits for a hub does not ask for a look, so without announcements one has to be quick oneself.
        rescan = min(self._config.rescan, IMPATIENT) if self._hubs.waiting else self._config.rescan
        self._look_at = self._clock.now() + round(rescan * SECOND)
        for node in self._hubs.tree():
            if node.role is not None and node.autosuspend and self._told_asleep.get(node.name) != node.replugs:
                self._told_asleep[node.name] = node.replugs
                await self._keep_awake(node)

    async def _keep_awake(self, node: UsbNode) -> None:
        if await keep_awake(self._machine, node.name):
            severity, what = Severity.INFO, "the kernel might have suspended it: forbidden now"
        else:
            severity = Severity.WARNING
            what = 'the kernel may suspend it; udev rule: ACTION=="add", SUBSYSTEM=="usb", ATTR{power/control}="on"'
        self._events(Reason.AUTOSUSPEND, severity, node.role or NAME, f"{place(node.name)}: {what}")
        self._wake.set()  # the tree shows it

    def _publish(self) -> None:
        nodes, now = self._hubs.tree(), self._clock.now()
        if nodes == self._published and now < self._publish_at:
            return
        self._published, self._publish_at = nodes, now + PERIOD
        self._out.put(UsbTree(stamp=now, received=now, seq=self._out.next_seq(), nodes=nodes))
