"""Bench for the compass: a world to point at, emulator, port, driver and what came out."""

import contextlib
from collections.abc import AsyncIterator
from dataclasses import replace
from typing import Any

from monstertruck_drivers.cable import EmulatedPort
from monstertruck_drivers.emulation import CompassReading
from monstertruck_drivers.os4000.config import Os4000Config
from monstertruck_drivers.os4000.driver import Os4000Driver
from monstertruck_drivers.os4000.emulator import Os4000Emulator
from monstertruck_runtime.clock import Clock
from monstertruck_schemas.sensor import Attitude
from tests.unit.drivers.kit import DriverRig, Kept

POSE = CompassReading(
    heading_deg=123.44,
    pitch_deg=5.0,
    roll_deg=-7.0,
    temperature_c=21.5,
    field=(-140.0, 210.0, -390.0),
    acceleration=(0.087, -0.122, 0.989),
)


class Table:
    """Attitude source that a test turns by hand; keeps the times it was asked for."""

    def __init__(self) -> None:
        self.reading = POSE
        self.times: list[int] = []

    def turn(self, **values: Any) -> None:
        self.reading = replace(self.reading, **values)

    def compass(self, time_ns: int) -> CompassReading:
        self.times.append(time_ns)
        return self.reading


class Rig(DriverRig):
    def __init__(self, clock: Clock, port: EmulatedPort | None, config: Os4000Config, **emulator: Any) -> None:
        super().__init__(clock, port)
        self.table = Table()
        self.emulator = Os4000Emulator(clock, self.table, **emulator)
        self.out: Kept[Attitude] = Kept()
        self.driver = Os4000Driver(config, self.port, clock, self.out, self.events)

    @property
    def sent(self) -> bytes:
        """What the host wrote."""
        return bytes(self.emulator.received)


@contextlib.asynccontextmanager
async def bench(
    clock: Clock, config: Os4000Config | None = None, *, port: EmulatedPort | None = None, **emulator: Any
) -> AsyncIterator[Rig]:
    """Emulator plugged in and running; the driver is started by the test."""
    rig = Rig(clock, port, config or Os4000Config(), **emulator)
    async with rig.plugged_in(rig.emulator.run(rig.port.device)):
        yield rig
