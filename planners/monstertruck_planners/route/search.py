"""What the searches share: binary heap, prices of places, costs and free ways of motions. Loads numba."""

from math import ceil
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_planners.collision_kernels import BodyData, FieldData, row_free
from monstertruck_planners.route.motion import advance

IntArray = NDArray[np.int64]


@njit(cache=True)
def push(keys: Array, items: IntArray, size: int, key: float, item: int) -> int:
    """Add an entry to a heap of ``size`` entries in two arrays long enough; returns the new size."""
    i = size
    while i > 0:
        above = (i - 1) >> 1
        if keys[above] < key or (keys[above] == key and items[above] < item):
            break
        keys[i], items[i] = keys[above], items[above]
        i = above
    keys[i], items[i] = key, item
    return size + 1


@njit(cache=True)
def drop(keys: Array, items: IntArray, size: int) -> int:
    """Remove the first entry (look at index 0 before); returns the new size."""
    size -= 1
    key, item = keys[size], items[size]
    i = 0
    while True:
        child = 2 * i + 1
        if child >= size:
            break
        right = child + 1
        if right < size and (keys[right] < keys[child] or (keys[right] == keys[child] and items[right] < items[child])):
            child = right
        if key < keys[child] or (key == keys[child] and item < items[child]):
            break
        keys[i], items[i] = keys[child], items[child]
        i = child
    keys[i], items[i] = key, item
    return size


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


RUNNING, FOUND, EXHAUSTED = 0, 1, 2


class Car(NamedTuple):
    """What may be driven and what it costs."""

    radius: float
    crab: float
    weights: Array
    """Shape (3,): per metre backward, of a cusp in turning radii, per metre of translation."""
    swing: float
    """Of every row, whose beginning turns the wheels, m."""
    moves: Array
    """Shape (p, 3): the short moves, as motion rows."""
    leaps: Array
    """Lengths of the leaps along the way, m, longest first."""
    step: float
    """Of the collision check, m."""
    margin: float
    """Kept on all sides of the footprint, m."""


@njit(cache=True)
def rows_cost(field: FieldData, layer: Layer, car: Car, pose: Array, rows: Array, count: int, sense: float) -> float:
    """Cost of rows driven from a pose after a row of direction ``sense``, m."""
    total = 0.0
    x, y, yaw = pose[0], pose[1], pose[2]
    for i in range(count):
        length = rows[i, 0]
        weight = 1.0 if length > 0.0 else car.weights[0]
        if rows[i, 2] != 0.0:
            weight *= car.weights[2]
        total += abs(length) * weight + car.swing
        if length * sense < 0.0:
            total += car.weights[1] * car.radius
        sense = length
        if layer.price.size > 0:
            total += row_price(field, layer, x, y, yaw, length, rows[i, 1], rows[i, 2])
        x, y, yaw = advance(x, y, yaw, length, rows[i, 1], rows[i, 2])
    return total


@njit(cache=True)
def rows_free(field: FieldData, body: BodyData, car: Car, pose: Array, rows: Array, count: int) -> bool:
    """Whether the footprint may drive the rows from a pose."""
    x, y, yaw = pose[0], pose[1], pose[2]
    for i in range(count):
        if not row_free(field, body, car.margin, car.step, x, y, yaw, rows[i, 0], rows[i, 1], rows[i, 2]):
            return False
        x, y, yaw = advance(x, y, yaw, rows[i, 0], rows[i, 1], rows[i, 2])
    return True
