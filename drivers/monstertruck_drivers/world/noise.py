"""Reproducible noise: every draw is a function of (seed, stream, index), never of who asked before."""

import numpy as np
from numpy.typing import NDArray

LIDAR, CURRENT, COMPASS, COMPASS_FIXED, SLIP, ANALOG = range(6)
"""Streams."""


def generator(seed: int, stream: int, index: int = 0) -> np.random.Generator:
    """Generator of one block of draws, by a counter-based algorithm."""
    return np.random.Generator(np.random.Philox(key=[seed, stream], counter=[0, index, 0, 0]))


class SlowNoise:
    """Standard normal noise of ``size`` channels: drawn every ``period_ns``, straight lines between.

    Args:
        seed: of the world.
        stream: one of the streams above.
        size: channels.
        period_ns: between draws.
    """

    def __init__(self, seed: int, stream: int, size: int, period_ns: int) -> None:
        self._seed, self._stream, self._size, self._period = seed, stream, size, period_ns
        self._slot = -1
        self._ends: tuple[NDArray[np.float64], NDArray[np.float64]] = (np.zeros(size), np.zeros(size))

    def at(self, elapsed_ns: int) -> list[float]:
        """Values at a time since the world's start, one a channel."""
        slot, rest = divmod(elapsed_ns, self._period)
        if slot != self._slot:
            self._ends = (self._draw(slot), self._draw(slot + 1))
            self._slot = slot
        before, after = self._ends
        values: list[float] = (before + (after - before) * (rest / self._period)).tolist()
        return values

    def _draw(self, slot: int) -> NDArray[np.float64]:
        return generator(self._seed, self._stream, slot).standard_normal(self._size)
