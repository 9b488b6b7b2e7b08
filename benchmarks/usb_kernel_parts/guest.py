"""Runs inside the virtual machine: every situation on the kernel's own ttys, and what the event loop felt of it."""

import asyncio
import subprocess
import sys

from usb_kernel_parts.inside import Loop, joystick, save, udev
from usb_kernel_parts.situations import run_all


def main() -> int:
    """Everything; results go to the share as they come."""
    udev()
    joystick()
    subprocess.run(["udevadm", "settle"], check=True)
    Loop.measure()
    asyncio.run(run_all())
    save()
    return 0


if __name__ == "__main__":
    sys.exit(main())
