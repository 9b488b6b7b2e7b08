"""Covariance of a planar pose in plain numbers: of so few, numpy takes longer to look at them than to add them."""

import operator
from collections.abc import Iterable
from struct import Struct
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

_NINE: Final = Struct("9d")


class Spread(NamedTuple):
    """Covariance of (x, y, yaw), of which one half stands for both: m^2, m rad, rad^2."""

    xx: float = 0.0
    xy: float = 0.0
    yy: float = 0.0
    xw: float = 0.0
    yw: float = 0.0
    ww: float = 0.0

    def moved(self, dx: float, dy: float) -> "Spread":
        """After a way (dx, dy), m, in the frame of the pose: it swings with the uncertain yaw."""
        xx, xy, yy, xw, yw, ww = self
        ahead, aside = xw - dy * ww, yw + dx * ww
        return Spread(xx - dy * (xw + ahead), xy + dx * xw - dy * aside, yy + dx * (yw + aside), ahead, aside, ww)

    def plus(self, other: Iterable[float]) -> "Spread":
        """With another one added that is independent of it."""
        return Spread(*map(operator.add, self, other))

    def corrected(self, gain_x: float, gain_y: float, gain: float) -> "Spread":
        """After a yaw was taken in with these gains."""
        xx, xy, yy, xw, yw, ww = self
        return Spread(
            xx - gain_x * xw, xy - gain_x * yw, yy - gain_y * yw, xw - gain_x * ww, yw - gain_y * ww, ww - gain * ww
        )

    def matrix(self) -> NDArray[np.float64]:
        """All nine numbers, row-major; read-only."""
        xx, xy, yy, xw, yw, ww = self
        return np.frombuffer(_NINE.pack(xx, xy, xw, xy, yy, yw, xw, yw, ww))
