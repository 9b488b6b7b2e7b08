"""Rows of the BNO085 and of the radio receivers."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.devices_today_parts.kit import Bench, Newest, on_bench, running, score, stranger_refused, survived
from monstertruck_drivers.bno085.config import Bno085Config
from monstertruck_drivers.bno085.driver import Bno085Driver
from monstertruck_drivers.bno085.emulator import Bno085Emulator
from monstertruck_drivers.emulation import ImuReading
from monstertruck_drivers.receiver.config import CrsfConfig, ReceiverConfig, SbusConfig
from monstertruck_drivers.receiver.driver import ReceiverDriver
from monstertruck_drivers.receiver.emulator import ReceiverEmulator
from monstertruck_runtime.clock import SECOND, VirtualClock
from monstertruck_schemas.sensor import HandControls, Imu

SWING = 0.5
"""Hz of the turn rate."""
TRIES = 20
RATE = 2.0
"""Its amplitude, rad/s."""


class Swinging:
    """A unit that swings to and fro."""

    def imu(self, time_ns: int) -> ImuReading:
        """See ``ImuSource``."""
        return ImuReading((0.0, 0.0, turn_rate(time_ns / SECOND)), (0.0, 0.0, 9.80665), 25.0)


def turn_rate(seconds: float | np.ndarray) -> Any:
    """True turn rate, rad/s."""
    return RATE * np.sin(math.tau * SWING * np.asarray(seconds))


class SensorBench(Bench):
    """A sensor and its latest messages."""

    def __init__(self, clock: VirtualClock, emulator: Any, driver: Callable[..., Any]) -> None:
        self.out: Newest[Any] = Newest()
        super().__init__(clock, emulator, lambda port, events: driver(port, events, self.out))

    def healthy(self) -> bool:
        """Whether a message was received recently."""
        return bool(self.out.kept) and self.clock.now() - self.out.kept[-1].received < 0.2 * SECOND


def trouble(
    make: Callable[[VirtualClock], SensorBench], healthy: str, *stalls: tuple[str, str], mute: str = "silent on"
) -> str:
    """Return the passed tests; ``mute`` is the fault that silences the emulator."""

    async def all_of_it(bench: SensorBench) -> dict[str, bool]:
        async with running(bench.serve()):
            await bench.clock.sleep(2.0)
            return await survived(bench, getattr(bench, healthy), *stalls)

    async def refused(bench: SensorBench) -> bool:
        bench.emulator.inject(*mute.split())
        return await stranger_refused(bench)

    found = on_bench(make, all_of_it)
    found["stranger"] = on_bench(make, refused)
    return score(found)


def bno085() -> dict[str, Any]:
    """A unit that swings at 0.5 Hz with up to 2 rad/s."""

    def make(clock: VirtualClock) -> SensorBench:
        def driver(port: Any, events: Any, out: Newest[Imu]) -> Bno085Driver:
            return Bno085Driver(Bno085Config(), port, clock, out, None, events)

        return SensorBench(clock, Bno085Emulator(clock, Swinging()), driver)

    async def clock_error(bench: SensorBench) -> float:
        """Return the delay (ms) with the best fit between measured and true turn rates."""
        async with running(bench.serve()):
            await bench.clock.sleep(22.0)
        stamps = np.array([one.stamp for one in bench.out.kept[50:]]) / SECOND
        rates = np.array([one.angular_velocity.z for one in bench.out.kept[50:]])
        delays = np.arange(-20.0, 20.5, 0.5)
        misfit = [float(np.mean((rates - turn_rate(stamps - delay / 1000)) ** 2)) for delay in delays]
        return abs(float(delays[int(np.argmin(misfit))]))

    return {
        "clock_ms": on_bench(make, clock_error),
        "trouble": trouble(make, "healthy", ("silent on", "silent off"), ("frozen on", "frozen off")),
        "foreign": "tests/unit/drivers/bno085/test_bno085.py",
    }


class HandBench(SensorBench):
    """A receiver with its stick at the end stop and its switch on."""

    def held(self) -> bool:
        """Whether stick and switch are reported correctly."""
        return self.healthy() and self.out.kept[-1].arm and self.out.kept[-1].speed > 0.99


def receiver(config: ReceiverConfig, foreign: str) -> dict[str, Any]:
    """A receiver: latency of a stick's movement, and detection of its loss."""

    def make(clock: VirtualClock) -> HandBench:
        def driver(port: Any, events: Any, out: Newest[HandControls]) -> ReceiverDriver:
            return ReceiverDriver(config, port, clock, out, events)

        bench = HandBench(clock, ReceiverEmulator(clock, config), driver)
        bench.emulator.move(config.speed, 1.0)
        bench.emulator.move(config.arm, 1.0)
        return bench

    async def lost(bench: HandBench, after: float) -> float:
        """Return the time (ms) from the loss of the transmitter to the message that reports it."""
        async with running(bench.serve()):
            await bench.clock.sleep(2.0 + after)
            bench.emulator.inject("transmitter", "off")
            since = bench.clock.now()
            while not bench.out.kept[-1].lost:
                await bench.clock.sleep(0.001)
            return (bench.clock.now() - since) / 1e6

    stalls = (("silent on", "silent off"), ("damage 200", "damage 0"), ("transmitter off", "transmitter on"))
    return {
        "lost_ms": round(max(on_bench(make, lambda bench, i=i: lost(bench, i * 0.0173)) for i in range(TRIES)), 1),
        "trouble": trouble(make, "held", *stalls),
        "foreign": foreign,
    }


ROWS = {
    "bno085": bno085,
    "crsf": lambda: receiver(CrsfConfig(), "tests/unit/drivers/receiver/test_receiver.py"),
    "sbus": lambda: receiver(SbusConfig(), "none found as a package"),
}
