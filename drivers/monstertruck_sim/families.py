"""Fault families generated from the emulated devices' own signals: one family for each way of falsifying a signal.

The catalog in ``faults`` lists known faults. This module lists no faults: it derives families from the signals that
devices declare, including devices from plug-ins.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from monstertruck_drivers.emulation import signals_of
from monstertruck_sim.faults import Fault, SimContext
from monstertruck_sim.robot import SimulatedRobot

MESSAGE: Final = "message"
"""Signal name that stands for the messages of a device as a whole."""

Draw = Callable[[np.random.Generator, float], float]
"""Draws the argument of a signal's fault; takes the maximum magnitude of the signal so far."""


def _of_extent(least: float, greatest: float, *, signed: bool = False) -> Draw:
    """Return a draw of a fraction of the signal's extent, or of 1 if the signal was always 0."""

    def draw(rng: np.random.Generator, extent: float) -> float:
        sign = float(rng.choice((-1.0, 1.0))) if signed else 1.0
        return sign * float(rng.uniform(least, greatest)) * (extent or 1.0)

    return draw


def _between(least: float, greatest: float) -> Draw:
    return lambda rng, _: float(rng.uniform(least, greatest))


def _factor(rng: np.random.Generator, _: float) -> float:
    """Draw a factor: 0, below 1 or above 1."""
    return (0.0, float(rng.uniform(0.2, 0.9)), float(rng.uniform(1.1, 3.0)))[rng.integers(3)]


def _seconds(rng: np.random.Generator, _: float) -> float:
    return float(10 ** rng.uniform(-1.0, 0.3))


ARGUMENTS: Final[Mapping[str, Draw]] = {
    "scaled": _factor,
    "offset": _of_extent(0.05, 0.6, signed=True),
    "quantised": _of_extent(0.1, 1.0),
    "noisy": _of_extent(0.02, 0.3),
    "delayed": _seconds,
    "late": _seconds,
    "dropped": _between(0.2, 0.95),
    "lost": _between(0.2, 0.95),
    "repeated": lambda rng, _: float(rng.integers(2, 20)),
    "shifted": lambda rng, _: float(rng.choice((-1, 1)) * rng.integers(5, 120)),
}
"""Arguments of the faults, by fault."""

MESSAGES: Final[Mapping[str, Draw]] = {
    "lose_rate": _between(0.1, 0.8),
    "double_rate": _between(0.1, 1.0),
    "delay": _between(0.02, 0.5),
}
"""Faults of whole messages, by their names on the console of the cable."""


@dataclass(frozen=True, slots=True)
class Family:
    """One way of falsifying one signal of one device."""

    role: str
    signal: str
    """Name of the signal, or ``MESSAGE``."""
    fault: str

    @property
    def name(self) -> str:
        """Name for reports."""
        return f"{self.role} {self.signal} {self.fault}"

    def draw(self, rng: np.random.Generator, hold: float) -> Fault[SimContext]:
        """Return one fault from the family that lasts ``hold`` seconds."""
        if self.signal == MESSAGE:
            return self._message(MESSAGES[self.fault](rng, 0.0), hold)
        draw, own = ARGUMENTS.get(self.fault), rng.spawn(1)[0]

        def start(context: SimContext) -> None:
            signals = context.signals(self.role)
            words = () if draw is None else (f"{draw(own, signals.extent(self.signal)):.6g}",)
            signals.inject(self.signal, self.fault, *words)

        return Fault(self.name, start, lambda context: context.signals(self.role).inject(self.signal, "off"), hold)

    def _message(self, value: float, hold: float) -> Fault[SimContext]:
        def put(value: float) -> Callable[[SimContext], None]:
            return lambda context: context.command(self.role, f"line {self.fault} {value:.3f}")

        return Fault(f"{self.name} {value:.3f}", put(value), put(0.0), hold)


def families(robot: SimulatedRobot, *, used: bool = False) -> tuple[Family, ...]:
    """Return all families of a robot's devices and monitors, in a fixed order.

    Args:
        robot: the robot.
        used: restrict to signals that drivers have read or written so far; faults in other signals have no effect.
    """

    def of(devices: Mapping[str, Any]) -> Iterator[Family]:
        for role, emulator in devices.items():
            if (signals := signals_of(emulator)) is not None:
                for signal, fault in signals.faults():
                    if not used or signals.used(signal):
                        yield Family(role, signal, fault)

    messages = (Family(role, MESSAGE, fault) for role in robot.emulators for fault in MESSAGES)
    return (*of(robot.emulators), *of(robot.monitored), *messages)
