"""Runs inside the virtual machine: every situation on the kernel's own ttys, and its effect on the event loop."""

import asyncio
import os
import subprocess
import sys

from benchmarks.usb_kernel_parts.inside import Loop, joystick, save, udev
from benchmarks.usb_kernel_parts.situations import run_all


def main() -> int:
    """Run everything; results are written to the share as they arise. Returns only on failure."""
    udev()
    joystick()
    subprocess.run(["udevadm", "settle"], check=True)
    Loop.measure()
    asyncio.run(run_and_leave())
    return 1


async def run_and_leave() -> None:
    """Run everything, and end the process at once: the thread of a wedged port would keep it alive for ever."""
    await run_all()
    save()
    sys.stdout.flush()
    os._exit(0)


if __name__ == "__main__":
    sys.exit(main())
