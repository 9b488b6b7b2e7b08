"""Heading from the measured field, the truck's own iron taken out; for single readings and for arrays of them."""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from monstertruck_drivers.os4000.config import IronConfig

Real = TypeVar("Real", float, NDArray[np.float64])


def level_field(field: tuple[Real, Real, Real], pitch: Real, roll: Real, iron: IronConfig) -> tuple[Real, Real]:
    """Horizontal part of the earth's field, forward and left, as it would be felt on level ground.

    The heading, clockwise from magnetic north, is its angle: north lies to the left of a truck that has turned right.

    Args:
        field: measured along the device's x (forward), y (left), z (up).
        pitch: nose down positive (REP 103), rad.
        roll: right side down positive, rad.
        iron: what to take out; hard iron in the unit of ``field``.
    """
    x, y = field[0] - iron.hard_x, field[1] - iron.hard_y
    x, y = iron.soft_xx * x + iron.soft_xy * y, iron.soft_xy * x + iron.soft_yy * y
    left = np.cos(roll) * y - np.sin(roll) * field[2]
    up = np.sin(roll) * y + np.cos(roll) * field[2]
    return np.cos(pitch) * x + np.sin(pitch) * up, left
