"""Maps drawn by seed, not used for tuning: rooms with doors, mazes, halls with boxes; and poses on them."""

from dataclasses import dataclass

import numpy as np

from monstertruck_planners.route.api import RouteMap, Vehicle

RESOLUTION = 0.05
NEAR = 0.02
"""Poses drawn keep this from obstacles, m."""


@dataclass(frozen=True)
class UnseenMap:
    """A map and its origin."""

    name: str
    occupied: np.ndarray
    """Shape (rows, columns), bool."""

    def route_map(self) -> RouteMap:
        """Input of planners."""
        return RouteMap.from_cells(np.where(self.occupied, 100, 0).astype(np.int8), RESOLUTION)


def unseen_map(kind: str, seed: int) -> UnseenMap:
    """A map of one kind: "rooms", "maze" or "boxes"."""
    rng = np.random.default_rng((seed, len(kind)))
    occupied = {"rooms": _rooms, "maze": _maze, "boxes": _boxes}[kind](rng)
    occupied[[0, -1]] = True
    occupied[:, [0, -1]] = True
    return UnseenMap(f"{kind} {seed}", occupied)


def _rooms(rng: np.random.Generator) -> np.ndarray:
    """A building of 3 by 4 rooms of 4 m with doors of 0.7 to 1.2 m and a few boxes."""
    size = round(4.0 / RESOLUTION)
    occupied = np.zeros((3 * size + 1, 4 * size + 1), dtype=bool)
    occupied[::size] = True
    occupied[:, ::size] = True
    for row in range(3):
        for column in range(4):
            for across in (False, True):
                if rng.random() < 0.8:
                    width = round(rng.uniform(0.7, 1.2) / RESOLUTION)
                    begin = rng.integers(3, size - width - 3)
                    opening = np.s_[begin : begin + width]
                    room = occupied[row * size : (row + 1) * size + 1, column * size : (column + 1) * size + 1]
                    (room.T if across else room)[opening, -1] = False
    _scatter(occupied, rng, 40)
    return occupied


def _maze(rng: np.random.Generator) -> np.ndarray:
    """A maze of 8 by 8 cells of 1.6 m, a fifth of its walls left out."""
    count, size = 8, round(1.6 / RESOLUTION)
    occupied = np.zeros((count * size + 1, count * size + 1), dtype=bool)
    occupied[::size] = True
    occupied[:, ::size] = True
    seen, stack = {(0, 0)}, [(0, 0)]
    while stack:
        row, column = stack[-1]
        around = [(row + 1, column), (row - 1, column), (row, column + 1), (row, column - 1)]
        around = [(r, c) for r, c in around if 0 <= r < count and 0 <= c < count and (r, c) not in seen]
        if not around:
            stack.pop()
            continue
        cell = around[rng.integers(len(around))]
        _open_wall(occupied, (row, column), cell, size)
        seen.add(cell)
        stack.append(cell)
    for row in range(count - 1):
        for column in range(count - 1):
            if rng.random() < 0.2:
                _open_wall(occupied, (row, column), (row + 1, column), size)
    return occupied


def _open_wall(occupied: np.ndarray, a: tuple[int, int], b: tuple[int, int], size: int) -> None:
    low, high = np.minimum(a, b), np.maximum(a, b)
    inner = np.s_[1:size]
    if high[0] > low[0]:
        occupied[high[0] * size, low[1] * size : (low[1] + 1) * size][inner] = False
    else:
        occupied[low[0] * size : (low[0] + 1) * size, high[1] * size][inner] = False


def _boxes(rng: np.random.Generator) -> np.ndarray:
    """A hall of 15 by 12 m full of boxes."""
    occupied = np.zeros((round(12 / RESOLUTION), round(15 / RESOLUTION)), dtype=bool)
    _scatter(occupied, rng, 130)
    return occupied


def _scatter(occupied: np.ndarray, rng: np.random.Generator, count: int) -> None:
    for _ in range(count):
        row, column = rng.integers(0, occupied.shape)
        height, width = rng.integers(3, 14, 2)
        occupied[row : row + height, column : column + width] = True


def free_pose(route_map: RouteMap, vehicle: Vehicle, rng: np.random.Generator) -> np.ndarray:
    """Draw poses until one is free."""
    rows, columns = (n - 2 for n in route_map.field.data().occupied.shape)
    size = np.array((columns, rows)) * route_map.field.resolution
    while True:
        pose = np.array((*rng.uniform(0.0, size), rng.uniform(-np.pi, np.pi)))
        if route_map.field.free(vehicle.footprint, pose[None], NEAR)[0]:
            return pose
