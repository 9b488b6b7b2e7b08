"""Bench for the scanner: emulator, port, driver and what came out of it."""

import contextlib
from collections.abc import AsyncIterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from monstertruck_drivers.cable import EmulatedPort, MemoryPort
from monstertruck_drivers.hokuyo_urg.config import HokuyoConfig
from monstertruck_drivers.hokuyo_urg.driver import HokuyoDriver
from monstertruck_drivers.hokuyo_urg.emulator import HokuyoEmulator
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_schemas.sensor import LaserScan
from tests.unit.drivers.kit import DriverRig, Kept

STEP_NS = SECOND / 10 / 1024


class Pattern:
    """A revolution that tells its number, with every error code, and keeps the times it was asked for."""

    def __init__(self) -> None:
        self.times: list[int] = []

    def scan(self, time_ns: int) -> NDArray[np.int32]:
        self.times.append(time_ns)
        values = 500 + np.arange(769, dtype=np.int32) * 5 + len(self.times)
        values[100:120] = np.arange(20)
        return values


class Rig(DriverRig):
    """Everything on one bench."""

    def __init__(self, clock: Clock, port: EmulatedPort, emulator: HokuyoEmulator, config: HokuyoConfig) -> None:
        super().__init__(clock, port)
        self.emulator = emulator
        self.out: Kept[LaserScan] = Kept()
        self.driver = HokuyoDriver(config, port, clock, self.out, self.events)


@contextlib.asynccontextmanager
async def bench(
    clock: Clock,
    source: Any = None,
    *,
    port: EmulatedPort | None = None,
    config: HokuyoConfig | None = None,
    emulator: HokuyoEmulator | None = None,
    **kwargs: Any,
) -> AsyncIterator[Rig]:
    """Emulator plugged in and running."""
    port = port or MemoryPort("lidar")
    emulator = emulator or HokuyoEmulator(clock, source or Pattern(), **kwargs)
    rig = Rig(clock, port, emulator, config or HokuyoConfig())
    async with rig.plugged_in(emulator.run(port.device)):
        yield rig


async def talk(port: MemoryPort, clock: Clock, *requests: str, wait: float = 0.05) -> bytes:
    """What a plain terminal would see: send each line, collect what comes within ``wait`` seconds each."""
    heard = b""
    async with await port.open() as link:
        for line in requests:
            link.write(line.encode() + b"\n")
            with contextlib.suppress(TimeoutError):
                async with clock.deadline(wait):
                    while True:
                        heard += await link.read()
    return heard
