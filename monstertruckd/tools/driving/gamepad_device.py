"""Gamepad of this computer: search, reading, rumble, and a new search after it was unplugged.

Kernel request numbers are from linux/input.h; ``struct ff_effect`` has 48 bytes on 64-bit kernels.
"""

import asyncio
import errno
import fcntl
import os
import struct
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Final

from monstertruck_runtime.clock import Clock
from monstertruck_runtime.readable import when_readable
from monstertruckd.tools.driving.gamepad import AXES, BUTTONS, EV_KEY, EVENT, Action, Pad, PadMapping

GAMEPAD_LOOK_PERIOD: Final = 1.0
"""Time between searches for a gamepad (s)."""
FOLDER: Final = Path("/dev/input")
STOPPING: Final = frozenset({"stop", "estop"})
"""Actions that remain valid however late they are read."""
EFFECT: Final = struct.Struct("HhHHHHHxxHH28x")
"""Type, number, direction, trigger (2), replay (length and delay, ms), strong and weak motor."""


class PadLink:
    """Keeps the link to a gamepad that fits a mapping.

    Args:
        mapping: device names and functions of sticks and buttons.
        clock: clock of the session.
        act: called with every action of a button.
        folder: folder of the kernel's input devices.
    """

    def __init__(
        self, mapping: PadMapping, clock: Clock, act: Callable[[Action], object], folder: Path = FOLDER
    ) -> None:
        self.pad: Pad | None = None
        """Connected gamepad, or None."""
        self.hint = ""
        """Reason for the missing gamepad."""
        self._mapping = mapping
        self._clock = clock
        self._act = act
        self._folder = folder
        self._file: int | None = None
        self._effect = -1
        """Kernel's number of the rumble effect; -1 before its first upload."""

    async def run(self) -> None:
        """Search for a gamepad, read it until it is gone, and search again, until cancelled."""
        try:
            while True:
                if self._file is None:
                    self._open()
                await self._clock.sleep(GAMEPAD_LOOK_PERIOD)
        finally:
            self._close()

    def rumble(self, strength: float, seconds: float) -> None:
        """Rumble with a strength of 0 to 1; no effect on a gamepad without rumble."""
        if self._file is None:
            return
        size = round(0xFFFF * strength)
        effect = bytearray(EFFECT.pack(0x50, self._effect, 0, 0, 0, round(seconds * 1000), 0, size, size))  # FF_RUMBLE
        with suppress(OSError):
            fcntl.ioctl(self._file, 0x4030_4580, effect)  # EVIOCSFF
            self._effect = EFFECT.unpack(effect)[1]
            os.write(self._file, EVENT.pack(0, 0, 0x15, self._effect, 1))  # EV_FF

    def flush(self) -> None:
        """Discard late input except for stop orders, and let go."""
        while self.pad is not None and self._read(act=False):
            pass
        if self.pad is not None:
            self.pad.release()

    def _open(self) -> None:
        self.hint = f"no gamepad in {self._folder}"
        for path in sorted(self._folder.glob("event*")):
            try:
                file = os.open(path, os.O_RDWR | os.O_NONBLOCK)
            except OSError as error:
                if error.errno == errno.EACCES:
                    self.hint = f"{path}: permission denied; add the user to the group input"
                continue
            pad = described(file, self._mapping)
            if pad is not None:
                self._file, self.pad, self._effect, self.hint = file, pad, -1, ""
                when_readable(file, self._read)
                return
            os.close(file)

    def _read(self, *, act: bool = True) -> bool:
        """Read a few waiting records; return False if there are none."""
        assert self._file is not None
        assert self.pad is not None
        try:
            data = os.read(self._file, 64 * EVENT.size)
        except BlockingIOError:
            return False
        except OSError:  # it was unplugged
            data = b""
        if not data:
            self._close()
            return False
        for action in self.pad.feed(data):
            if act or action in STOPPING:
                self._act(action)
        return True

    def _close(self) -> None:
        file, self._file, self.pad = self._file, None, None
        if file is not None:
            asyncio.get_running_loop().remove_reader(file)
            os.close(file)


def described(file: int, mapping: PadMapping) -> Pad | None:
    """Return the gamepad behind an open input device; None for another device or one outside the mapping."""
    try:
        name = fcntl.ioctl(file, _read_request(0x06, 256), bytes(256)).split(b"\0")[0].decode(errors="backslashreplace")
        keys = fcntl.ioctl(file, _read_request(0x20 + EV_KEY, 96), bytes(96))
        if not keys[BUTTONS["south"] // 8] >> BUTTONS["south"] % 8 & 1 or not mapping.fits(name):
            return None
    except OSError:
        return None
    ranges = {}
    for code in AXES.values():
        with suppress(OSError):  # the device lacks this axis
            _, low, high, *_ = struct.unpack("6i", fcntl.ioctl(file, _read_request(0x40 + code, 24), bytes(24)))
            if low < high:
                ranges[code] = (low, high)
    return Pad(name, mapping, ranges)


def _read_request(number: int, size: int) -> int:
    """Return the number of a read request to the input subsystem (``_IOC(_IOC_READ, 'E', number, size)``)."""
    return 2 << 30 | size << 16 | ord("E") << 8 | number
