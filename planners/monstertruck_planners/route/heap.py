"""A binary heap of numbered entries, smallest key first, compiled. Ties leave in the order of their numbers."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@njit(cache=True)
def push(keys: FloatArray, items: IntArray, size: int, key: float, item: int) -> int:
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
def drop(keys: FloatArray, items: IntArray, size: int) -> int:
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
