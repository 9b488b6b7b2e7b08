"""Turning head of an emulated scanner: its motor, its clock, and covers on its window."""

import math
from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_drivers.emulation import Array, BeamSource, RangeSheet
from monstertruck_drivers.fault_table import FaultRows
from monstertruck_runtime.clock import SECOND, Clock

TURNING: Final = 0.5
"""Minimum speed for measurements, as a fraction of the set speed."""


class TurningHead:
    """Head that turns clockwise and has its own clock; it must be queried at increasing times of that clock.

    Faults (``fault_rows``): ``cover`` covers the window between two directions (degrees from straight ahead, left
    positive): all beams there, or a random fraction of them, return the value (below 20: no return, otherwise mm).
    ``mirror`` puts a mirror in that sector. ``drift`` sets the rate of the head's clock relative to the world clock.
    ``blocked`` stops the head. ``frequency`` changes its speed.

    Args:
        clock: world clock.
        source: source of beam ranges.
        sheet: range limits from the data sheet.
        frequency: speed (turns/s).
        rng: random generator for the covers.
    """

    def __init__(
        self, clock: Clock, source: BeamSource, sheet: RangeSheet, frequency: float, rng: np.random.Generator
    ) -> None:
        self.sheet = sheet
        self.frequency = frequency
        """Set speed of the motor (turns/s); 0 = off."""
        self._clock, self._source, self._rng = clock, source, rng
        self._rate = 1.0
        self._born, self._elapsed = clock.now(), 0
        self._blocked = False
        self._at, self._turned, self._speed = 0.0, 0.3, 0.0
        """Latest instant (s, its own clock), with the angle (turns) and speed (turns/s) reached there."""
        self._covers: list[tuple[float, float, Callable[[Array], Array]]] = []

    # Time

    def now(self) -> int:
        """Return the head's clock time since its creation (ns)."""
        return self._elapsed + round((self._clock.now() - self._born) * self._rate)

    def world_time(self, time: int) -> int:
        """Return the world time (ns) at a time of the head's clock."""
        return self._born + round((time - self._elapsed) / self._rate)

    # Motor

    @property
    def speed(self) -> float:
        """Speed at the latest queried time (turns/s)."""
        return self._speed

    def stop(self) -> None:
        """Stop the head immediately, because its supply is off."""
        self._speed = 0.0

    def turn(self, times: NDArray[np.int64]) -> Array:
        """Return the head's angles (n,) at times of its clock (turns); the last becomes the latest queried time."""
        target = 0.0 if self._blocked else self.frequency
        passed = times / SECOND - self._at
        spin_up = 0.4  # time constant of the motor, s
        fading = np.exp(-np.maximum(passed, 0.0) / spin_up)
        turned: Array = self._turned + target * passed + (self._speed - target) * spin_up * (1.0 - fading)
        self._at, self._turned = float(times[-1]) / SECOND, float(turned[-1]) % 1.0
        self._speed = target + (self._speed - target) * float(fading[-1])
        return turned

    # Beams

    def measure(self, times: NDArray[np.int64]) -> tuple[Array, Array]:
        """Return angles (turns) and ranges (m, 0 = no return) at past times of the head's clock, shape (n,)."""
        turned = self.turn(times)
        return turned, self.look(turned, times)

    def look(self, turned: Array, times: NDArray[np.int64]) -> Array:
        """Return the ranges (m, 0 = no return), shape (n,), at angles (turns) and times."""
        bearings = -math.tau * turned
        at = np.array([self.world_time(int(time)) for time in times], np.int64)
        ranges = self._source.beams(bearings, at, self.sheet)
        if self._speed < TURNING * max(self.frequency, 0.1):
            ranges = np.zeros(len(ranges))
        for begin, width, cover in self._covers:
            behind = np.mod(bearings - begin, math.tau) <= width
            ranges[behind] = cover(ranges[behind])
        return np.where(np.isfinite(ranges) & (ranges >= self.sheet.least), ranges, 0.0)

    # Faults

    def fault_rows(self) -> FaultRows:
        """Return the head's faults for the scanner's fault table."""
        return {
            "cover FROM TO VALUE [SHARE]|off": self._set_cover,
            "mirror FROM TO": lambda begin, end: self._cover(begin, end, self._mirrored),
            "drift PPM": self._set_drift,
            "blocked on|off": self._block,
            "frequency HZ": self._set_frequency,
        }

    def _set_cover(self, begin: str, end: str = "", value: str = "", share: str = "1") -> None:
        if begin == "off":
            self._covers.clear()
        else:
            self._cover(begin, end, self._covered(int(value), float(share)))

    def _set_drift(self, ppm: str) -> None:
        rate = 1.0 + float(ppm) * 1e-6
        self._elapsed, self._born = self.now(), self._clock.now()
        self._rate = rate

    def _block(self, blocked: bool) -> None:
        self._blocked = blocked

    def _set_frequency(self, hertz: str) -> None:
        self.frequency = float(hertz)

    def _cover(self, begin: str, end: str, cover: Callable[[Array], Array]) -> None:
        first, last = math.radians(float(begin)), math.radians(float(end))
        if not 0.0 < last - first <= math.tau:
            raise ValueError(f"{begin}..{end} degrees")
        self._covers.append((first, last - first, cover))

    def _covered(self, value: int, share: float) -> Callable[[Array], Array]:
        least_code = 20  # ``cover`` values below are URG codes: no return; others are millimetres
        shown = 0.0 if value < least_code else value / 1000
        return lambda ranges: np.where(self._rng.random(len(ranges)) < share, shown, ranges)

    def _mirrored(self, ranges: Array) -> Array:
        specular = 0.2  # fraction of a mirror, at its centre, that reflects straight back and dazzles
        dazzled = self._rng.random(len(ranges)) < specular
        return np.where(dazzled | (2 * ranges > self.sheet.greatest), 0.0, 2 * ranges)
