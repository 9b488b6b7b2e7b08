"""Runs inside the virtual machine: every situation on the kernel's own ttys, and what the event loop felt of it."""

import asyncio
import os
import subprocess
import sys

from usb_kernel_parts.inside import Loop, joystick, save, udev
from usb_kernel_parts.situations import run_all


def main() -> int:
    """Run everything; results go to the share as they come. Returns only if that fails."""
    udev()
    joystick()
    subprocess.run(["udevadm", "settle"], check=True)
    Loop.measure()
    asyncio.run(run_and_leave())
    return 1


async def run_and_leave() -> None:
    """Run all, and end the process at once: the thread of a port that is still wedged would hold it for ever."""
    await run_all()
    save()
    sys.stdout.flush()
    os._exit(0)


if __name__ == "__main__":
    sys.exit(main())
