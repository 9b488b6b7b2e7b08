"""Reproducible noise: every draw is a function of (seed, stream, index), independent of the order of requests."""

import numpy as np

LIDAR, CURRENT, COMPASS, COMPASS_FIXED, SLIP, ANALOG, SONAR, IMU, IMU_FIXED, SKID, STAND, CAMERA, BOARD, LIDAR_BEAMS = (
    range(14)
)
"""Streams of a robot."""

PEOPLE, GROUND_STREAM = range(100, 102)
"""Streams of a world."""

_BLOCK = 512


def generator(seed: int, stream: int, index: int = 0) -> np.random.Generator:
    """Return the generator for one block of draws, using a counter-based algorithm."""
    return np.random.Generator(np.random.Philox(key=[seed, stream], counter=[0, index, 0, 0]))


class WhiteNoise:
    """Standard normal noise in ``size`` channels, drawn in blocks of neighbouring indices.

    Args:
        seed: the world's seed.
        stream: one of the streams above.
        size: number of channels.
    """

    def __init__(self, seed: int, stream: int, size: int = 1) -> None:
        self._seed, self._stream, self._size = seed, stream, size
        self._block = -1
        self._values: list[float] = []

    def at(self, index: int) -> list[float]:
        """Return the values at an index (0 or more), one per channel."""
        block, row = divmod(index, _BLOCK)
        if block != self._block:
            drawn = generator(self._seed, self._stream, block).standard_normal(_BLOCK * self._size)
            self._block, self._values = block, drawn.tolist()
        return self._values[row * self._size : (row + 1) * self._size]


class SlowNoise:
    """White noise drawn every ``period_ns``, with linear interpolation.

    Args:
        seed: the world's seed.
        stream: one of the streams above.
        size: number of channels.
        period_ns: interval between draws (ns).
    """

    def __init__(self, seed: int, stream: int, size: int, period_ns: int) -> None:
        self._white = WhiteNoise(seed, stream, size)
        self._period = period_ns
        self._slot = -1
        self._lines: list[tuple[float, float]] = []
        """Value at the start of the slot and change over it, per channel."""

    def at(self, elapsed_ns: int) -> list[float]:
        """Return the values at a time since the start of the world, one per channel."""
        slot, rest = divmod(elapsed_ns, self._period)
        if slot != self._slot:
            ends = self._white.at(slot), self._white.at(slot + 1)
            self._lines = [(before, after - before) for before, after in zip(*ends, strict=True)]
            self._slot = slot
        part = rest / self._period
        return [before + change * part for before, change in self._lines]
