"""A Hybrid-A* search for a first way, which can be interrupted and gone on with. Compiled."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from monstertruck_planners.collision_kernels import BodyData, FieldData
from monstertruck_planners.route import hybrid_search as search
from monstertruck_planners.route.api import Budget
from monstertruck_planners.route.distance_to_go import ToGo
from monstertruck_planners.route.pricing import Layer

Array = NDArray[np.float64]

CHUNK = 256
"""Nodes expanded between two looks at the budget."""

MOST_NODES = 400_000
"""In one search."""


MOST_POSES = 1 << 26
"""Told apart in one search: a table of 256 MB, of which only what is visited takes memory."""


@dataclass(frozen=True)
class Level:
    """How finely poses are told apart."""

    cell: float
    """In turning radii."""
    move: float
    """The same."""
    headings: int = 36

    def fitting(self, field: FieldData, radius: float) -> "Level":
        """This level, or on a map too large for it a coarser one.

        Args:
            field: the map.
            radius: turning radius, m.
        """
        poses = field.occupied.size * (field.resolution / (self.cell * radius)) ** 2 * self.headings
        factor = max(math.sqrt(poses / MOST_POSES), 1.0)
        return Level(self.cell * factor, self.move * factor, self.headings)


LEVELS = (Level(0.35, 0.55), Level(0.15, 0.25), Level(0.06, 0.1, 72))
"""The second one is for narrow places, where the first finds nothing soon; the third where that is at its end."""


@dataclass(frozen=True)
class Question:
    """What is looked for."""

    field: FieldData
    body: BodyData
    layer: Layer
    table: NDArray[np.float32]
    """See ``turning_table``."""
    start: Array
    goal: Array
    """Poses, shape (3,)."""
    greed: float
    budget: Budget
    """Takes down the nodes expanded."""
    statistics: dict[str, float]
    """The same, under "expanded"."""


class Hunt:
    """One search.

    Args:
        question: what is looked for.
        car: what may be driven, with moves of the level.
        go: ways to the goal.
        level: how fine.
        sight: the goal is tried directly from this near, m.
    """

    def __init__(self, question: Question, car: search.Car, go: ToGo, level: Level, sight: float = np.inf) -> None:
        self._asked, self._car, self._go, self._sight = question, car, go, sight
        self._nodes = _room(question.field, level.cell * car.radius, level.headings)
        self.exhausted = False
        """Whether there is nothing left to look at."""
        (x, y, yaw), greed = question.start, question.greed
        search.add(
            question.field, go, question.table, car, question.goal, self._nodes, greed, x, y, yaw, 0.0, -1,
            search.LEAP, 0.0, np.inf,
        )  # fmt: skip

    def go_on(self, count: int, reserve: float = 0.0) -> Array | None:
        """Expand about ``count`` more nodes, while more than ``reserve`` of the budget is left.

        Returns:
            Motion rows from start to goal, if they were found.
        """
        asked, nodes = self._asked, self._nodes
        first = int(nodes.counts[search.EXPANDED])
        status = search.EXHAUSTED if self.exhausted else search.RUNNING
        while status == search.RUNNING and asked.budget.left() > reserve:
            before = int(nodes.counts[search.EXPANDED])
            if before - first >= count:
                break
            status = search.expand(
                asked.field, asked.body, asked.layer, self._go, asked.table, self._car, asked.goal, nodes, asked.greed,
                np.inf, self._sight, CHUNK,
            )  # fmt: skip
            done = int(nodes.counts[search.EXPANDED]) - before
            asked.budget.work += done
            asked.statistics["expanded"] += done
        self.exhausted = status == search.EXHAUSTED
        return search.trace(self._car, asked.goal, nodes) if status == search.FOUND else None


def _room(field: FieldData, cell: float, headings: int) -> search.Nodes:
    """Memory for the nodes of a search."""
    n = MOST_NODES
    rows, columns = (int(count * field.resolution / cell) + 1 for count in field.occupied.shape)
    return search.Nodes(
        np.empty((n, 3)), np.empty(n), np.empty(n, np.int64), np.empty(n, np.int64), np.empty(n),
        np.empty(n, np.bool_), np.empty(n), np.empty(n, np.int64),
        np.zeros((rows, columns, headings), np.int32), cell, np.zeros(4, np.int64),
    )  # fmt: skip
