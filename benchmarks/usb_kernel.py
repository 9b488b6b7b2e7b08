"""Serial ports, hubs and udev on a Debian kernel in QEMU: behaviour that no pty and no emulator shows.

    python benchmarks/usb_kernel.py [--keep FOLDER]

Needs Debian's packages qemu-system-x86, busybox-static and udev, and the package index for linux-image-amd64, which is
downloaded and unpacked, not installed; without them the run is skipped with a message. The machine has two hubs, three
FTDI adapters, a CDC-ACM device whose device side runs in the machine, and a joystick; its file system is this
computer's, read-only. Takes some three minutes without KVM. The machine's times are no latencies: the event loop is
judged by how long its calls sleep in the kernel, from kernel traces.
"""

import argparse
import asyncio
import json
import socket
import sys
import threading
from contextlib import suppress
from pathlib import Path
from time import monotonic
from typing import Any

from benchmarks import ROOT
from benchmarks.usb_kernel_parts.machine import ADAPTERS, MissingError, booted, initramfs, kernel, require
from monstertruck_drivers.cable import DeviceEnd
from monstertruck_drivers.epos.emulator import EposEmulator
from monstertruck_runtime.clock import WallClock

FOLDER = ROOT / "runs" / "benchmarks" / "usb_kernel"
LIMIT = 600.0
"""Seconds for everything."""
CONTROL_MS = 40.0
"""What the measurement must find of a call that sleeps for 50 ms."""
GOAL_MS = 2.0
"""Longest that a callback of the event loop may wait."""


async def drive(path: Path) -> None:
    """Emulate an EPOS at the far end of an adapter's line."""
    end = DeviceEnd("drive")
    reader, writer = await asyncio.open_unix_connection(str(path))
    end.connect(writer.write)
    emulator = asyncio.create_task(EposEmulator(WallClock()).run(end))
    with suppress(OSError):
        while data := await reader.read(4096):
            end.take(data)
    emulator.cancel()


def serve_drive(path: Path) -> None:
    """Run in a thread until the machine ends."""

    async def connected() -> None:
        while True:
            try:
                return await drive(path)
            except OSError:
                await asyncio.sleep(0.05)

    threading.Thread(target=lambda: asyncio.run(connected()), daemon=True).start()


def swallow(path: Path) -> None:
    """Read the far end of a line without answers."""

    def run() -> None:
        line = socket.socket(socket.AF_UNIX)
        while line.connect_ex(str(path)):
            threading.Event().wait(0.1)
        with suppress(OSError):
            while line.recv(4096):
                pass

    threading.Thread(target=run, daemon=True).start()


def measure(folder: Path) -> dict[str, Any]:
    """Boot, run every situation, collect the results.

    Raises:
        MissingError: the machine cannot be made here.
    """
    require()
    unpacked = kernel(folder)
    command = f"cd {ROOT}/benchmarks && PYTHONDONTWRITEBYTECODE=1 {ROOT}/.venv/bin/python -m usb_kernel_parts.guest"
    image = initramfs(unpacked, folder, command)
    lines = {name: folder / f"line-{name}" for name in ADAPTERS}
    for path in lines.values():
        path.unlink(missing_ok=True)
    begin = monotonic()
    with booted(unpacked, image, folder, lines) as machine:
        serve_drive(lines["s1"])
        for name in ("s2", "s3"):
            swallow(lines[name])
        code = machine.serve(LIMIT)
        results = machine.share / "results.json"
        found = json.loads(results.read_text()) if results.exists() else {}
    return {"situations": found, "exit": code, "seconds": round(monotonic() - begin, 1)}


def main() -> int:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--keep", type=Path, default=FOLDER, help="folder of the kernel and of what the machine says")
    arguments = parser.parse_args()
    try:
        figures = measure(arguments.keep)
    except MissingError as error:
        print(f"usb_kernel: skipped: {error}", file=sys.stderr)
        print(json.dumps({"bench": "usb_kernel", "figures": {}, "goals": {}, "met": None, "skipped": str(error)}))
        return 0
    situations = figures["situations"]
    for name, found in situations.items():
        details = {key: value for key, value in found.items() if key not in ("ok", "calls", "in_kernel_ms")}
        print(f"{name:26} {'ok' if found['ok'] else 'FAILED':6} in kernel {found['in_kernel_ms']:6.2f} ms  {details}")
    control = situations.pop("control", {"in_kernel_ms": 0.0})
    judged = situations.values()
    figures["control_ms"] = control["in_kernel_ms"]
    figures["in_kernel_ms"] = max((found["in_kernel_ms"] for found in judged), default=None)
    seen = control["in_kernel_ms"] >= CONTROL_MS
    met = seen and figures["exit"] == 0 and all(one["ok"] and one["in_kernel_ms"] <= GOAL_MS for one in judged)
    goals = {"in_kernel_ms": GOAL_MS, "control_ms": f"at least {CONTROL_MS:g}", "situations": "all ok"}
    print(json.dumps({"bench": "usb_kernel", "figures": figures, "goals": goals, "met": bool(situations) and met}))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
