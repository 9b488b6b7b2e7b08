"""What a metre costs beyond its length, by place: clearance, tilt, roughness. Compiled."""

from math import ceil
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from monstertruck_planners.collision_kernels import FieldData
from monstertruck_planners.route.motion_rows import advance

FloatArray = NDArray[np.float64]

SPACING = 0.1
"""Between two looks at the layer, m."""


class Layer(NamedTuple):
    """Price per metre of every cell of a field's ringed grid; an empty array: nothing costs extra."""

    price: NDArray[np.float32]


@njit(cache=True)
def row_price(
    field: FieldData, layer: Layer, x: float, y: float, yaw: float, length: float, curvature: float, sideslip: float
) -> float:
    """Price of a motion row: the layer summed at the middles of pieces of about SPACING."""
    rows, columns = layer.price.shape
    pieces = max(ceil(abs(length) / SPACING), 1)
    total = 0.0
    for i in range(pieces):
        px, py, _ = advance(x, y, yaw, length * (i + 0.5) / pieces, curvature, sideslip)
        dx, dy = px - field.x, py - field.y
        r = int((dy * field.cos - dx * field.sin) / field.resolution)
        c = int((dx * field.cos + dy * field.sin) / field.resolution)
        if 0 <= r < rows and 0 <= c < columns:
            total += layer.price[r, c]
    return total * abs(length) / pieces
