"""Generated worlds by number: offices, mazes and halls; the same number gives the same world.

They show whether settings chosen in some worlds are valid in others.
"""

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from benchmarks.exploration_parts.arena import BODY, Arena

RESOLUTION: Final = 0.05
DOOR, CORRIDOR = (0.9, 1.4), (1.3, 2.2)
"""Least and greatest width, m."""
SMALLEST: Final = 2.5
"""Rooms are not divided into smaller ones, m."""
Cells = NDArray[np.bool_]


def generated(name: str) -> Arena | None:
    """Return the world of a name like ``office3``; None for other names."""
    kind = name.rstrip("0123456789")
    if kind not in KINDS or kind == name:
        return None
    number = int(name.removeprefix(kind))
    rng = np.random.default_rng([list(KINDS).index(kind), number])
    cells = KINDS[kind](rng)
    cells[[0, -1]] = cells[:, [0, -1]] = True
    return Arena.of(name, cells, RESOLUTION, (0.0, 0.0))


def _office(rng: np.random.Generator) -> Cells:
    """Rooms on corridors, with doors and some furniture."""
    width, height = rng.uniform(14.0, 28.0), rng.uniform(10.0, 18.0)
    cells = np.zeros((_n(height), _n(width)), np.bool_)
    _divide(cells, rng, corridors=2)
    for _ in range(int(width * height / 12.0)):
        _box(cells, rng, (0.2, 1.2))
    return cells


def _divide(room: Cells, rng: np.random.Generator, corridors: int) -> None:
    """Halve a room by a wall with a door, or by a corridor with doors, and so on with both halves."""
    across = room.shape[0] > room.shape[1]
    cells = room if across else room.T  # views: the longer side is that of the rows
    length = cells.shape[0] * RESOLUTION
    corridor = rng.uniform(*CORRIDOR) if corridors > 0 else 0.0
    if length < 2 * SMALLEST + corridor or (corridors <= 0 and length < 5.0 and rng.random() < 0.3):
        return
    low = rng.uniform(SMALLEST, length - corridor - SMALLEST)
    walls = [low, low + corridor] if corridor else [low]
    for at in walls:
        cells[_n(at) : _n(at) + 2] = True
    _divide(cells[: _n(walls[0])], rng, corridors - 1)
    _divide(cells[_n(walls[-1]) + 2 :], rng, corridors - 1)
    for at in walls:
        for _ in range(1 + int(rng.random() < 0.35) + max(corridors, 0)):
            _door(cells, _n(at), rng)


def _door(cells: Cells, row: int, rng: np.random.Generator) -> None:
    """Open a wall where no other wall meets it."""
    wide = _n(rng.uniform(*DOOR))
    for _ in range(60):
        column = int(rng.integers(2, max(cells.shape[1] - wide - 2, 3)))
        sides = cells[[max(row - 4, 0), min(row + 5, cells.shape[0] - 1)], column : column + wide]
        if not sides.any():
            break
    cells[max(row - 1, 0) : row + 3, column : column + wide] = False


def _maze(rng: np.random.Generator) -> Cells:
    """Corridors of one width on a lattice: a tree, with some further walls removed."""
    rows, columns = int(rng.integers(5, 9)), int(rng.integers(6, 12))
    pitch = _n(rng.uniform(1.2, 1.9))
    cells = np.ones((rows * pitch + 2, columns * pitch + 2), np.bool_)
    seen = np.zeros((rows, columns), np.bool_)
    trail = [(int(rng.integers(rows)), int(rng.integers(columns)))]
    seen[trail[0]] = True
    while trail:
        here = trail[-1]
        near = [(here[0] + a, here[1] + b) for a, b in ((0, 1), (1, 0), (0, -1), (-1, 0))]
        near = [(a, b) for a, b in near if 0 <= a < rows and 0 <= b < columns]
        new = [place for place in near if not seen[place]]
        if rng.random() < 0.06:
            _join(cells, here, near[int(rng.integers(len(near)))], pitch)
        if not new:
            trail.pop()
            continue
        there = new[int(rng.integers(len(new)))]
        seen[there] = True
        _join(cells, here, there, pitch)
        trail.append(there)
    return cells


def _join(cells: Cells, here: tuple[int, int], there: tuple[int, int], pitch: int) -> None:
    """Free two places of the lattice and the passage between them; walls are 0.1 m thick."""
    top, left = min(here[0], there[0]) * pitch + 2, min(here[1], there[1]) * pitch + 2
    bottom, right = (max(here[0], there[0]) + 1) * pitch, (max(here[1], there[1]) + 1) * pitch
    cells[top:bottom, left:right] = False


def _hall(rng: np.random.Generator) -> Cells:
    """One large hall with shelves, boxes and posts."""
    width, height = rng.uniform(12.0, 26.0), rng.uniform(10.0, 20.0)
    cells = np.zeros((_n(height), _n(width)), np.bool_)
    view = cells.T if rng.random() < 0.5 else cells
    for _ in range(int(rng.integers(2, 7))):
        row = int(rng.integers(20, view.shape[0] - 30))
        length = _n(rng.uniform(2.0, 8.0))
        column = int(rng.integers(0, max(view.shape[1] - length, 1)))
        view[row : row + _n(rng.uniform(0.1, 0.8)), column : column + length] = True
    for _ in range(int(width * height / 8.0)):
        _box(cells, rng, (0.1, 2.0))
    return cells


def _box(cells: Cells, rng: np.random.Generator, sizes: tuple[float, float]) -> None:
    """Put a box at a random place, unless it would block the passage."""
    high, wide = (_n(v) for v in rng.uniform(*sizes, 2))
    row, column = (int(rng.integers(1, max(n - 1, 2))) for n in cells.shape)
    room = _n(BODY.width + 0.3)
    around = cells[max(row - room, 0) : row + high + room, max(column - room, 0) : column + wide + room]
    if not around.any():
        cells[row : row + high, column : column + wide] = True


def _n(metres: float) -> int:
    """Convert metres to cells."""
    return round(metres / RESOLUTION)


KINDS: Final[dict[str, Callable[[np.random.Generator], Cells]]] = {"office": _office, "maze": _maze, "hall": _hall}
