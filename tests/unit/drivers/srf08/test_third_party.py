"""A client that is not ours, usb-iss (MIT licence), at the emulated USB-ISS with its sonars, over a pty.

It counts I2C addresses in seven bits, the modules' maker in eight.
"""

import asyncio
import contextlib
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import pytest
from usb_iss import UsbIss
from usb_iss.exceptions import UsbIssError

from monstertruck_drivers.cable import PtyPort
from monstertruck_drivers.srf08.emulator import Srf08Emulator
from monstertruck_runtime.clock import WallClock

T = TypeVar("T")
LEFT, NOBODY = 0xE0 >> 1, 0xFE >> 1
FLIGHT = 2.0 / 343.0 * 1e6
"""Microseconds to a wall one metre away and back."""

pytestmark = pytest.mark.wall


class Wall:
    """A wall one metre from every sonar."""

    def fire(self, name: str, time_ns: int) -> None:
        pass

    def range(self, name: str) -> float:
        return 1.0


async def use(folder: Path, work: Callable[[UsbIss], T]) -> T:
    """Let a thread work with a client while the emulator runs on this loop."""
    port, emulator = PtyPort(folder / "iss"), Srf08Emulator(WallClock(), Wall())
    running = asyncio.create_task(emulator.run(port.device))
    await asyncio.sleep(0)
    port.plug()

    def run() -> T:
        iss = UsbIss()
        with contextlib.closing(iss.open(port.name)):
            return work(iss)

    try:
        return await asyncio.to_thread(run)
    finally:
        port.unplug()
        running.cancel()
        await asyncio.wait([running])


async def test_a_sonar_ranges_in_microseconds(tmp_path):
    def work(iss: UsbIss) -> tuple[int, list[int]]:
        assert iss.read_module_id() == 7
        iss.setup_i2c(100)
        software = iss.i2c.read(LEFT, 0, 1)[0]
        iss.i2c.write(LEFT, 1, [16, 69])
        iss.i2c.write(LEFT, 0, [0x52])
        time.sleep(0.1)
        return software, iss.i2c.read(LEFT, 2, 2)

    software, (high, low) = await use(tmp_path, work)
    assert software == 10
    assert (high << 8) + low == pytest.approx(FLIGHT, abs=20)


async def test_nobody_answers_at_an_address_without_a_module_nor_before_i2c_is_set_up(tmp_path):
    def work(iss: UsbIss) -> None:
        with pytest.raises(UsbIssError, match="NACK"):
            iss.i2c.write(LEFT, 0, [0x52])
        iss.setup_i2c(100)
        iss.i2c.write(LEFT, 0, [0x52])
        with pytest.raises(UsbIssError, match="NACK"):
            iss.i2c.write(NOBODY, 0, [0x52])

    await use(tmp_path, work)
