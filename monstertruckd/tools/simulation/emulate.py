"""``monstertruckd emulate``: one emulated device on a pty, in the default world."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

from monstertruck_drivers.cable import PtyPort
from monstertruck_drivers.catalog import DEVICES, DeviceKind
from monstertruck_drivers.emulation import EmulatorSetup
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import InputError
from monstertruck_sim.console import Emulated
from monstertruck_sim.world.config import WorldConfig
from monstertruck_sim.world.world import World
from monstertruckd.tools.simulation.ports import claimed


@asynccontextmanager
async def emulate_device(device: str, link: Path, clock: Clock, seed: int) -> AsyncIterator[Emulated]:
    """Serve ``device`` (kind or role) behind the symlink ``link`` while the context lasts.

    Raises:
        InputError: unknown device, one without a port, or something that is no link has the name.
        NotPermittedError: this user may not make it there.
        BusyError: another program serves ``link``.
        OSError: it cannot be made.
    """
    kind = DEVICES.named(device)
    if kind.opens == "computer":
        raise InputError(f"{device}: the computer's own files, no device on a port; simulate emulates them")
    with claimed(link):
        port = PtyPort(link)
        async with _served(kind, device, port, clock, seed) as emulated:
            yield emulated


@asynccontextmanager
async def _served(kind: DeviceKind, device: str, port: PtyPort, clock: Clock, seed: int) -> AsyncIterator[Emulated]:
    setup = EmulatorSetup(kind.role.name, None, clock, World(WorldConfig(), seed), seed, port)
    emulator = kind.emulator_factory()(setup)
    task = asyncio.create_task(emulator.run(port.device), name=f"emulator {device}")
    port.plug()
    try:
        yield Emulated(emulator, port)
    finally:
        port.unplug()
        task.cancel()
        await asyncio.wait([task])
