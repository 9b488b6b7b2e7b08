"""Moves of a state lattice, made for one truck: from cell to cell, never tighter than its turning radius.

There are 16 headings, those of the grid's short vectors. A turn to the next heading is line, arc, line with the largest
radius that fits, and of all cells it could end at that with the shortest turn is taken. (Stored move sets that keep
their cells when the cell size changes turn tighter than the car: that is why these are computed.)
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

VECTORS = (
    (1, 0), (2, 1), (1, 1), (1, 2), (0, 1), (-1, 2), (-1, 1), (-2, 1),
    (-1, 0), (-2, -1), (-1, -1), (-1, -2), (0, -1), (1, -2), (1, -1), (2, -1),
)  # fmt: skip
ANGLES = np.array([math.atan2(y, x) for x, y in VECTORS])
LONG = 8
"""Cells of the long straight move, about."""
MOST_ROWS = 3


@dataclass(frozen=True)
class Moves:
    """All moves, by the heading they start at.

    ``rows[h, k]`` are up to three motion rows (unused ones of length 0), ``shift[h, k]`` the columns, rows and headings
    moved on, ``cost[h, k]`` the price in metres, ``number[h]`` their number.
    """

    rows: Array
    shift: IntArray
    cost: Array
    number: IntArray


def make_moves(
    radius: float, crab_angle: float, cell: float, factors: tuple[float, float, float] = (2.0, 3.0, 5.0)
) -> Moves:
    """Moves of one truck.

    Args:
        radius: least turning radius, m.
        crab_angle: largest angle of a translation, rad; 0: none.
        cell: m.
        factors: on the cost of a turn forward, a line backward, a turn or translation backward.
    """
    table = [_moves_from(h, radius, crab_angle, cell, factors) for h in range(len(VECTORS))]
    most = max(map(len, table))
    rows = np.zeros((len(VECTORS), most, MOST_ROWS, 3))
    shift, cost = np.zeros((len(VECTORS), most, 3), np.int64), np.zeros((len(VECTORS), most))
    for h, moves in enumerate(table):
        for k, (pieces, where, price) in enumerate(moves):
            rows[h, k, : len(pieces)] = pieces
            shift[h, k], cost[h, k] = where, price
    return Moves(rows, shift, cost, np.array([len(moves) for moves in table]))


Move = tuple[list[tuple[float, float, float]], tuple[int, int, int], float]


def _moves_from(h: int, radius: float, crab: float, cell: float, factors: tuple[float, float, float]) -> list[Move]:
    turn_factor, back_factor, back_turn_factor = factors
    x, y = VECTORS[h]
    moves: list[Move] = []
    for steps in (1, max(round(LONG / math.hypot(x, y)), 2)):
        length = steps * math.hypot(x, y) * cell
        moves.append(([(length, 0.0, 0.0)], (steps * x, steps * y, 0), length))
        if steps == 1:
            moves.append(([(-length, 0.0, 0.0)], (-x, -y, 0), back_factor * length))
    for turn in (1, -1):
        pieces, (dx, dy) = _turn(h, turn, radius, cell)
        length = sum(abs(row[0]) for row in pieces)
        moves.append((pieces, (dx, dy, turn), turn_factor * length))
    for turn in (1, -1):
        # Backward into the next heading: the way of a turn from there, driven back.
        pieces, (dx, dy) = _turn((h + turn) % 16, -turn, radius, cell)
        length = sum(abs(row[0]) for row in pieces)
        back = [(-s, k, b) for s, k, b in reversed(pieces)]
        moves.append((back, (-dx, -dy, turn), back_turn_factor * length))
    for side in (1, -1) if crab > 0.0 else ():
        for dx, dy, angle in _translations(h, side, crab):
            length = math.hypot(dx, dy) * cell
            moves.append(([(length, 0.0, angle)], (dx, dy, 0), length))
            moves.append(([(-length, 0.0, angle)], (-dx, -dy, 0), back_turn_factor * length))
    return moves


def _turn(h: int, turn: int, radius: float, cell: float) -> tuple[list[tuple[float, float, float]], tuple[int, int]]:
    """Shortest turn to the next heading that ends on a cell, with the largest radius that fits."""
    a, b = ANGLES[h], ANGLES[h] + math.remainder(ANGLES[(h + turn) % 16] - ANGLES[h], math.tau)
    lines = np.array([[math.cos(a), math.cos(b)], [math.sin(a), math.sin(b)]])
    arc = turn * np.array([math.sin(b) - math.sin(a), math.cos(a) - math.cos(b)])
    reach = math.ceil(2.0 * radius * abs(b - a) / cell) + 6
    best: tuple[float, Array, float, tuple[int, int]] | None = None
    for dx in range(-reach, reach + 1):
        for dy in range(-reach, reach + 1):
            fixed, slope = np.linalg.solve(lines, np.column_stack((np.array([dx, dy]) * cell, arc))).T
            least = fixed - radius * slope
            if (least < -1e-12).any():
                continue
            # Both lines shrink as the radius grows: to where the first is gone.
            widest = min((f / s for f, s in zip(fixed, slope, strict=True) if s > 1e-12), default=radius)
            widest = max(widest, radius)
            ends = np.maximum(fixed - widest * slope, 0.0)
            length = float(ends.sum() + widest * abs(b - a))
            if best is None or length < best[0] - 1e-9:
                best = (length, ends, widest, (dx, dy))
    assert best is not None
    _, ends, widest, where = best
    pieces = [(float(ends[0]), 0.0, 0.0), (widest * abs(b - a), turn / widest, 0.0), (float(ends[1]), 0.0, 0.0)]
    return [row for row in pieces if row[0] > 1e-9], where


def _translations(h: int, side: int, crab: float) -> list[tuple[int, int, float]]:
    """The steepest translation to one side within LONG cells: columns, rows, angle."""
    found = []
    for dx in range(-LONG, LONG + 1):
        for dy in range(-LONG, LONG + 1):
            angle = math.remainder(math.atan2(dy, dx) - ANGLES[h], math.tau)
            if (dx or dy) and 1e-9 < side * angle <= crab + 1e-12:
                found.append((-round(abs(angle), 9), math.hypot(dx, dy), dx, dy, angle))
    return [(dx, dy, angle) for _, _, dx, dy, angle in sorted(found)[:1]]
