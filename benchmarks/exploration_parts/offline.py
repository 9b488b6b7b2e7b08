"""A peer that knows the world: viewpoints that cover all of it, in a short tour, with the same routes and scans."""

import math

import numpy as np
from numba import njit

from benchmarks.exploration_parts.arena import BODY, Arena
from benchmarks.exploration_parts.rover import DECIDE, Rover, Run
from monstertruck_estimation.slam.service import grid_message
from monstertruck_estimation.slam.worker_io import GridPatch
from monstertruck_planners.explore.api import ExplorationView, Remembered
from monstertruck_planners.explore.config import NearestConfig
from monstertruck_planners.explore.exchange import ExploreSetup
from monstertruck_planners.explore.frontier import FrontierMap
from monstertruck_planners.explore.kernels import sees
from monstertruck_planners.route.heuristic import UNIT, UNREACHED

SPACING = 0.8
"""Metres between places that are compared."""
COVER = 0.995
"""Share of the reachable area that the places show."""
DONE = 0.98
"""A place is left out once this share of what only it shows is known."""


@njit(cache=True)
def _seen(cells, places, points, reach):  # type: ignore[no-untyped-def] # noqa: ANN001, ANN202
    result = np.zeros((len(places), len(points)), np.bool_)
    for i in range(len(places)):
        for j in range(len(points)):
            dx, dy = points[j, 0] - places[i, 0], points[j, 1] - places[i, 1]
            if dx * dx + dy * dy <= reach * reach:
                result[i, j] = sees(cells, places[i, 0], places[i, 1], points[j, 0], points[j, 1])
    return result


class KnownWorld(ExplorationView):
    """The whole map, with the path lengths between places."""

    def path_lengths_between(self, places: list[tuple[float, float]]) -> np.ndarray:
        """Return the path lengths between all places (m), shape (n, n); inf if no path is known."""
        at = [self._open_cell(place) for place in places]
        result = np.full((len(places), len(places)), np.inf)
        for i, place in enumerate(places):
            if (to_go := self._flood(place)) is None:
                continue
            for j, there in enumerate(at):
                if there is not None and (cost := int(to_go.cost[there])) < UNREACHED:
                    result[i, j] = cost * self._cell / UNIT
        return np.minimum(result, result.T)


def offline_tour(arena: Arena, reach: float, seed: int) -> Run:
    """Drive the tour; coverage is judged as for the explorers, by the robot's own scans."""
    rover = Rover(arena, NearestConfig(reach=reach), seed)
    rover.run.kind = "offline"
    truth = np.where(arena.blocked, 100, 0).astype(np.int8)
    grid = grid_message(GridPatch(truth, arena.origin, arena.resolution), 0, 0)
    assert rover.setup is not None
    setup = ExploreSetup(NearestConfig(reach=reach), BODY, rover.setup.radius, 0.04)
    view = KnownWorld(FrontierMap(grid), setup, rover.home, (), (), Remembered())
    places = _places(arena, view)
    origin = np.array(arena.origin)
    points = rover.truth[:: max(len(rover.truth) // 12_000, 1)]
    seen = _seen(
        truth, (places - origin) / arena.resolution, (points - origin) / arena.resolution, reach / arena.resolution
    )
    chosen = _cover(seen)
    distance = np.minimum(view.path_lengths_between([(float(x), float(y)) for x, y in places[chosen]]), 1e4)
    first = np.array([view.path_length_to((x, y)) or 1e4 for x, y in places[chosen]])
    order = [chosen[k] for k in short_tour(distance, first)] if len(chosen) > 1 else list(chosen)
    shown = {i: points[seen[i]] for i in chosen}
    rover.map = grid
    rover.look()
    rover.take_stock()
    for k, i in enumerate(order):
        rest = shown[i]
        ahead = places[order[k + 1]] if k + 1 < len(order) else places[i]
        yaw = math.atan2(*(ahead - places[i])[::-1])
        rover.left = np.empty((0, 3))
        while _unknown(rover, rest) > 1.0 - DONE:
            if len(rover.left) < 2:
                if math.dist(rover.pose[:2], places[i]) < 0.1:
                    break
                rover.map = grid
                poses = rover.route((*places[i], yaw))
                if poses is None:
                    poses = rover.route((*places[i], yaw + math.pi / 2))
                if poses is None:
                    rover.run.failures += 1
                    break
                rover.left = poses
            if not rover.drive(rover.left, DECIDE):
                rover.run.failures += 1
                break
            rover.take_stock()
    rover.run.home = 0.0
    return rover.run


def _places(arena: Arena, view: ExplorationView) -> np.ndarray:
    """Return the centres of cells on a coarse lattice where the robot can stand."""
    size = np.array(arena.blocked.shape[::-1]) * arena.resolution
    x, y = (np.arange(o + SPACING / 2, o + s, SPACING) for o, s in zip(arena.origin, size, strict=True))
    places = np.column_stack([v.ravel() for v in np.meshgrid(x, y)])
    room = arena.truth.lookup(places) > BODY.circumscribed_radius + 0.06
    return np.array(
        [place for place in places[room] if view.path_length_to((float(place[0]), float(place[1]))) is not None]
    )


def _cover(seen: np.ndarray) -> list[int]:
    """Choose greedily the place that shows most of the area not yet seen."""
    left, chosen = np.ones(seen.shape[1], np.bool_), []
    while left.mean() > 1.0 - COVER:
        gain = (seen & left).sum(axis=1)
        best = int(np.argmax(gain))
        if gain[best] == 0:
            break
        chosen.append(best)
        left &= ~seen[best]
    return chosen


def _unknown(rover: Rover, points: np.ndarray) -> float:
    """Return the share of points that are unknown to the robot's map."""
    patch = rover.grid.patch()
    column, row = np.floor((points - patch.origin) / patch.resolution).astype(int).T
    rows, columns = patch.cells.shape
    inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    known = np.zeros(len(points), np.bool_)
    known[inside] = patch.cells[row[inside], column[inside]] >= 0
    return 1.0 - float(known.mean()) if len(points) else 0.0


@njit(cache=True)
def short_tour(distance: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Return the order of visiting n places on a short tour from the start, with a free end.

    The nearest-neighbour tour, improved by reversing and moving parts while that shortens it (2-opt, Or-opt;
    G. A. Croes 1958, I. Or 1976).

    Args:
        distance: distances between places, shape (n, n), symmetric.
        first: distances from the start, shape (n,).
    """
    n = len(first)
    order = np.empty(n, np.int64)
    used = np.zeros(n, np.bool_)
    for k in range(n):
        best, least = -1, np.inf
        for i in range(n):
            if not used[i]:
                d = first[i] if k == 0 else distance[order[k - 1], i]
                if d < least:
                    best, least = i, d
        order[k] = best
        used[best] = True
    for _ in range(60):
        if not (_reversed_parts(distance, first, order) | _moved_parts(distance, first, order)):
            break
    return order


@njit(cache=True)
def _reversed_parts(distance: np.ndarray, first: np.ndarray, order: np.ndarray) -> bool:
    """Reverse every part of a tour if that shortens the tour; return whether a part was reversed."""
    n, improved = len(order), False
    for i in range(n):
        for j in range(i + 1, n):
            here, there = order[i], order[j]
            old = first[here] if i == 0 else distance[order[i - 1], here]
            new = first[there] if i == 0 else distance[order[i - 1], there]
            if j < n - 1:
                old += distance[there, order[j + 1]]
                new += distance[here, order[j + 1]]
            if new < old - 1e-9:
                order[i : j + 1] = order[i : j + 1][::-1].copy()
                improved = True
    return improved


@njit(cache=True)
def _moved_parts(distance: np.ndarray, first: np.ndarray, order: np.ndarray) -> bool:
    """Move parts of up to three places if that shortens the tour; return whether a part was moved."""
    n, improved = len(order), False
    trial, least = order.copy(), tour_length(distance, first, order)
    for length in range(1, min(4, n)):
        for i in range(n - length + 1):
            part = order[i : i + length].copy()
            rest = np.concatenate((order[:i], order[i + length :]))
            for j in range(len(rest) + 1):
                trial[:j] = rest[:j]
                trial[j : j + length] = part
                trial[j + length :] = rest[j:]
                there = tour_length(distance, first, trial)
                if there < least - 1e-9:
                    least, improved = there, True
                    order[:] = trial
    return improved


@njit(cache=True)
def tour_length(distance: np.ndarray, first: np.ndarray, order: np.ndarray) -> float:
    """Length of a tour; see ``short_tour``."""
    total = first[order[0]]
    for k in range(1, len(order)):
        total += distance[order[k - 1], order[k]]
    return float(total)
