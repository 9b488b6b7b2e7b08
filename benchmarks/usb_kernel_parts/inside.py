"""Tools inside the virtual machine: requests to QEMU, what the event loop feels, results, udev, a joystick."""

import asyncio
import fcntl
import json
import os
import resource
import select
import subprocess
import sys
import termios
import threading
import time
import traceback
from asyncio import events
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
PORTS = ("/monstertruck_drivers/", "/serial/", "/serial_asyncio/")
"""Whose calls count."""
RESULTS: dict[str, Any] = {}


class Loop:
    """How long one callback of the event loop is inside the kernel by what drivers and libraries of ports call.

    The machine computes some thirty times slower than a computer, and stands while this computer does something else.
    So only calls count in which the thread slept: of the others it is not the kernel that was waited for.
    """

    longest = 0.0
    worst = ""
    _inside = 0.0
    _calls: ClassVar[list[str]] = []

    @classmethod
    def measure(cls) -> None:
        """From now on; call in the loop's thread."""
        sys.setswitchinterval(0.0005)  # a call's end waits for the interpreter, which threads of ports use too
        for module, names in CALLS.items():
            for name in names:
                setattr(module, name, cls._timed(getattr(module, name)))
        really = events.Handle._run  # noqa: SLF001  # asyncio has no other place to measure at

        def run(handle: Any) -> None:
            cls._inside, cls._calls = 0.0, []
            really(handle)
            if cls._inside > cls.longest:
                cls.longest, cls.worst = cls._inside, ", ".join(cls._calls[-20:])

        events.Handle._run = run  # type: ignore[method-assign]  # noqa: SLF001

    @classmethod
    def _timed(cls, call: Callable[..., Any], *, always: bool = False) -> Callable[..., Any]:
        main = threading.get_ident()

        def timed(*arguments: Any, **named: Any) -> Any:
            caller = sys._getframe(1).f_code.co_filename  # noqa: SLF001
            if threading.get_ident() != main or not (always or any(part in caller for part in PORTS)):
                return call(*arguments, **named)
            begin, sleeps = time.perf_counter(), resource.getrusage(resource.RUSAGE_THREAD).ru_nvcsw
            try:
                return call(*arguments, **named)
            finally:
                took = time.perf_counter() - begin
                if resource.getrusage(resource.RUSAGE_THREAD).ru_nvcsw > sleeps:
                    cls._inside += took
                    cls._calls.append(f"{call.__name__} {took * 1000:.2f} ms")

        return timed

    @classmethod
    def touch(cls, line: int) -> None:
        """One call that returns at once."""
        cls._timed(os.write, always=True)(line, b"x")

    @classmethod
    def take(cls) -> dict[str, Any]:
        """What was found since the last time."""
        figures = {"in_kernel_ms": cls.longest * 1000, "calls": cls.worst}
        cls.longest, cls.worst = 0.0, ""
        return figures


_asked = 0


async def ask(execute: str, **arguments: Any) -> Any:
    """Let QEMU do something."""
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
    """Wait; returns seconds."""
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
    """A HID joystick on the second emulated controller, by configfs."""
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
