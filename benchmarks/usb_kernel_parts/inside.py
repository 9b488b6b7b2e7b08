"""Tools inside the virtual machine: requests to QEMU, load of the event loop, results, udev, a joystick."""

import asyncio
import fcntl
import json
import os
import re
import select
import subprocess
import sys
import termios
import threading
import time
import traceback
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any, ClassVar

SHARE = Path("/run/share")
CALLS = {
    os: ("open", "close", "read", "write"),
    fcntl: ("ioctl", "flock", "fcntl"),
    termios: ("tcsetattr", "tcgetattr", "tcflush", "tcdrain"),
    select: ("select",),
}
"""Calls that may wait for a device."""
SYSTEM_CALLS = ("openat", "close", "read", "write", "ioctl", "flock", "fcntl", "pselect6", "select")
"""What the kernel traces of them."""
TRACE = Path("/sys/kernel/tracing")
TRACED = re.compile(r"\] \S+ +(?P<time>[0-9.]+): sys_\w+(?:\(| (?P<exit>->))")
"""Line of the trace."""
PORTS = ("/monstertruck_drivers/", "/site-packages/serial/", "/site-packages/serial_asyncio/")
"""Whose calls count."""
LIMIT = 120.0
"""Longest a situation may take (s); the whole run takes 240 s."""
RESULTS: dict[str, Any] = {}


class Loop:
    """Time that the event loop's thread spends in the kernel in calls of drivers and port libraries.

    The machine is some thirty times slower than a computer, so the duration of a callback means nothing; and after a
    call the thread waits for the interpreter, which other threads hold. The kernel itself therefore traces when the
    thread enters and leaves it, and whether it slept: other calls are long because this computer was busy.
    """

    _calls: ClassVar[list[tuple[float, float, str]]] = []
    """Begin and end, s of CLOCK_MONOTONIC, and the name."""

    @classmethod
    def measure(cls) -> None:
        """Start measuring; must be called in the loop's thread."""
        for module, names in CALLS.items():
            for name in names:
                setattr(module, name, cls._timed(getattr(module, name)))
        (TRACE / "trace_clock").write_text("mono")
        (TRACE / "set_event_pid").write_text(str(threading.get_native_id()))
        (TRACE / "buffer_size_kb").write_text("8192")
        (TRACE / "events/sched/sched_switch/enable").write_text("1")
        for name in SYSTEM_CALLS:
            for way in ("enter", "exit"):
                (TRACE / f"events/syscalls/sys_{way}_{name}/enable").write_text("1")

    @classmethod
    def _timed(cls, call: Callable[..., Any]) -> Callable[..., Any]:
        main = threading.get_ident()

        def timed(*arguments: Any, **named: Any) -> Any:
            caller = sys._getframe(1).f_code.co_filename  # noqa: SLF001
            if threading.get_ident() != main or not any(part in caller for part in PORTS):
                return call(*arguments, **named)
            begin = time.monotonic()
            try:
                return call(*arguments, **named)
            finally:
                cls._calls.append((begin, time.monotonic(), call.__name__))

        return timed

    @classmethod
    def take(cls) -> dict[str, Any]:
        """Return the results since the last call."""
        (TRACE / "tracing_on").write_text("0")  # reading would be traced, without end
        text = (TRACE / "trace").read_text()
        (TRACE / "trace").write_text("")
        (TRACE / "tracing_on").write_text("1")
        asleep, entered, slept, traced = [], 0.0, False, 0
        leaves = f"prev_pid={threading.get_native_id()} "
        for line in text.splitlines():
            if leaves in line:
                slept |= "prev_state=R" not in line
            elif match := TRACED.search(line):
                if match["exit"] is None:
                    entered, slept = float(match["time"]), False
                elif slept:
                    asleep.append((entered, float(match["time"])))
                traced += match["exit"] is not None
        found = [
            (1000 * (left - come), name)
            for come, left in asleep
            for begin, end, name in cls._calls
            if begin <= come and left <= end
        ]
        calls, cls._calls = len(cls._calls), []
        longest, name = max(found, default=(0.0, ""))
        return {"in_kernel_ms": longest, "calls": name, "slept": len(found), "counted": calls, "traced": traced}


_asked = 0


async def ask(execute: str, **arguments: Any) -> Any:
    """Send a request to QEMU."""
    global _asked
    number, _asked = _asked, _asked + 1
    scratch = SHARE / "ask" / f".{number}"
    scratch.write_text(json.dumps({"execute": execute, "arguments": arguments}))
    scratch.rename(SHARE / "ask" / str(number))
    answer = SHARE / "answer" / str(number)
    while not answer.exists():
        await asyncio.sleep(0.05)
    return json.loads(answer.read_text())


async def until(condition: Callable[[], bool], seconds: float = 60.0) -> float:
    """Wait; return the seconds."""
    begin = time.monotonic()
    while not condition():
        if time.monotonic() - begin > seconds:
            raise TimeoutError
        await asyncio.sleep(0.05)
    return time.monotonic() - begin


def save() -> None:
    (SHARE / "results.json").write_text(json.dumps(RESULTS, indent=1))


async def situation(name: str, act: Callable[[], Awaitable[dict[str, Any]]]) -> None:
    Loop.take()
    begin = time.monotonic()
    try:
        async with asyncio.timeout(LIMIT):
            found = await act()
    except Exception as error:  # noqa: BLE001  # the next situation is independent
        traceback.print_exc()
        found = {"ok": False, "error": f"{type(error).__name__}: {error}"}
    RESULTS[name] = found | Loop.take() | {"seconds": time.monotonic() - begin}
    print(name, RESULTS[name], flush=True)
    save()


def udev() -> None:
    subprocess.Popen(["/lib/systemd/systemd-udevd", "--daemon"]).wait()
    subprocess.run(["udevadm", "trigger", "--action=add"], check=True)
    subprocess.run(["udevadm", "settle"], check=True)


def joystick() -> None:
    """Create a HID joystick on the second emulated controller by configfs."""
    gadget = Path("/sys/kernel/config/usb_gadget/joystick")
    (gadget / "strings/0x409").mkdir(parents=True)
    (gadget / "idVendor").write_text("0x1d6b")
    (gadget / "idProduct").write_text("0x0104")
    (gadget / "strings/0x409/product").write_text("Joystick")
    function = gadget / "functions/hid.0"
    function.mkdir()
    (function / "report_length").write_text("4")
    descriptor = "05010904a1010501093009310932 1581257f750895038102 050919012908 15002501750195088102c0"
    (function / "report_desc").write_bytes(bytes.fromhex(descriptor.replace(" ", "")))
    (gadget / "configs/c.1").mkdir()
    (gadget / "configs/c.1/MaxPower").write_text("100")
    (gadget / "configs/c.1/hid.0").symlink_to(function)
    free = max(entry.name for entry in Path("/sys/class/udc").iterdir())
    (gadget / "UDC").write_text(free)
