"""``monstertruckd emulate``, one emulated device on a pty, and the names of all emulated devices on this computer."""

import asyncio
from collections.abc import AsyncIterator, Iterator
from contextlib import ExitStack, asynccontextmanager, closing, contextmanager
from pathlib import Path

from monstertruck_drivers.cable import EmulatedPort, PtyPort, SocketPort, reserved
from monstertruck_drivers.catalog import DEVICES, DeviceKind
from monstertruck_drivers.emulation import EmulatorSetup
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.endpoints import make_private, runtime_folder
from monstertruck_runtime.errors import InputError, NotPermittedError
from monstertruck_sim.console import Emulated
from monstertruck_sim.world.config import WorldConfig
from monstertruck_sim.world.world import World


@contextmanager
def claimed(*links: Path) -> Iterator[None]:
    """Reserve the names of links for this program while the context is open; their folders are created.

    The user's folder, for ports without a configured name, is closed to others.

    Raises:
        NotPermittedError: this user may not create a link there, or others may in this user's own folder.
        BusyError: another program serves one of them.
        InputError: the name belongs to something other than a link.
        OSError: a link cannot be created there.
    """
    with ExitStack() as stack:
        try:
            if any(runtime_folder() in link.parents for link in links):
                make_private(runtime_folder())
            for link in links:
                link.parent.mkdir(parents=True, exist_ok=True)
            stack.enter_context(reserved(*links))
        except PermissionError as error:
            raise NotPermittedError(f"{error.filename}: this user may not create a port there") from error
        except OSError as error:
            if error.errno is None:
                raise NotPermittedError(str(error)) from None
            raise
        yield


@asynccontextmanager
async def emulate_device(device: str, link: Path | tuple[str, int], clock: Clock, seed: int) -> AsyncIterator[Emulated]:
    """Serve ``device`` (kind or role) behind a symlink, or at an address and TCP port, while the context is open.

    Raises:
        InputError: unknown device, one without a port, or the name exists and is not a link.
        NotPermittedError: this user may not create it there.
        BusyError: another program serves ``link``.
        OSError: it cannot be created.
    """
    kind = DEVICES.named(device)
    if kind.opens == "computer":
        raise InputError(f"{device}: consists of files of the computer, not a device on a port; `simulate` emulates it")
    if isinstance(link, tuple):
        if kind.opens != "serial":
            raise InputError(f"{device}: is not a device on a network socket")
        with closing(SocketPort(*link)) as socket:
            async with _served(kind, device, socket, clock, seed) as emulated:
                yield emulated
        return
    with claimed(link):
        port = PtyPort(link)
        async with _served(kind, device, port, clock, seed) as emulated:
            yield emulated


@asynccontextmanager
async def _served(
    kind: DeviceKind, device: str, port: EmulatedPort, clock: Clock, seed: int
) -> AsyncIterator[Emulated]:
    setup = EmulatorSetup(kind.role.name, None, clock, World(WorldConfig(), seed), seed, port)
    emulator = kind.emulated(setup)
    async with asyncio.TaskGroup() as group:
        task = group.create_task(kind.serve(emulator, port.device), name=f"emulator {device}")
        port.plug()
        try:
            yield Emulated(emulator, port)
        finally:
            port.unplug()
            task.cancel()
