"""The computer the hubs are plugged into, as far as this package uses it."""

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from monstertruck_drivers.link import Port, SerialPort
from monstertruck_drivers.usb.sysfs import Sysfs
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.threads import Offload, in_thread


async def run_command(arguments: Sequence[str]) -> tuple[int, str]:
    """Run a program without a shell.

    Returns:
        Its exit code and what it printed.

    Raises:
        OSError: it cannot be started.
    """
    process = await asyncio.create_subprocess_exec(
        *arguments, stdin=asyncio.subprocess.DEVNULL, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT
    )
    try:
        output, _ = await process.communicate()
    except asyncio.CancelledError:
        process.kill()
        await process.wait()
        raise
    return process.returncode or 0, output.decode(errors="replace").strip()


@dataclass(frozen=True, slots=True)
class Machine:
    """Files, nodes and programs; an emulated machine stands in for it in tests."""

    clock: Clock
    sysfs: Sysfs = field(default_factory=Sysfs)
    dev: Path = Path("/dev")
    beside: Offload = in_thread
    run: Callable[[Sequence[str]], Awaitable[tuple[int, str]]] = run_command
    serial: Callable[[Path, int], Port] = SerialPort
    """A serial node and a baud rate to a port."""
