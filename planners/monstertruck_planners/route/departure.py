"""Departure: first motions of a route that starts nearer to an obstacle than the margin. Loads numba.

From a start without the margin a search finds nothing, because all its motions begin too near to the obstacle. The
route therefore begins with a few arcs and translations along which the footprint comes no nearer to any obstacle, up to
a pose that keeps the margin; the rest is planned as usual. If no such motion exists, the footprint may come nearer once
without touching, like the end of a car that leaves a wall at its side: first by half of the available clearance.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from heapq import heappop, heappush
from itertools import count
from typing import Final

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from monstertruck_kinematics.elementary import Array
from monstertruck_planners.collision_kernels import (
    FieldData,
    FootprintData,
    safe_distance,
    segment_free,
    unseen_distance,
)
from monstertruck_planners.route import heuristic
from monstertruck_planners.route.api import (
    Budget,
    Endpoints,
    RouteCosts,
    RouteMap,
    RouteResult,
    Vehicle,
    check_endpoints,
)
from monstertruck_planners.route.config import DriveCosts
from monstertruck_planners.route.motion import MotionPath, advance
from monstertruck_planners.route.search import CHECK_MARGIN, CHECK_STEP
from monstertruck_schemas.reasons import Reason

LEVEL: Final = 0.0005
"""Step for comparing clearances (m)."""
CHECK: Final = 0.004
"""Distance between two checked poses (m)."""
BRANCH: Final = 0.2
"""Distance between two branching poses on an arc (m)."""
SHORTEST: Final = 0.02
"""Minimum length of an arc (m): the truck cannot drive shorter arcs exactly."""
CURVATURES: Final = (0.0, *(0.5**k for k in range(7)))
"""Curvatures of the tried arcs, as fractions of the maximum: in wider turns the body's end stays clear of a wall."""
PLACE: Final = np.array([0.01, 0.01, 0.03])
"""Difference below which two poses are the same (m, m, rad)."""


@njit(cache=True)
def _level(
    field: FieldData, footprint: FootprintData, x: float, y: float, yaw: float, guess: int, least: int, most: int
) -> int:
    """Return the clearance of a pose in steps of LEVEL, up to ``most``, starting at ``guess``; -1 below ``least``."""
    level = guess
    if safe_distance(field, footprint, level * LEVEL, x, y, yaw) >= 0.0:
        while level < most and safe_distance(field, footprint, (level + 1) * LEVEL, x, y, yaw) >= 0.0:
            level += 1
        return level
    while level > least:
        level -= 1
        if safe_distance(field, footprint, level * LEVEL, x, y, yaw) >= 0.0:
            return level
    return -1


@njit(cache=True)
def _drive_off(
    field: FieldData, footprint: FootprintData, pose: Array, segment: Array, level: int, best: int, dip: int,
    wanted: int,
) -> tuple[float, int, int]:  # fmt: skip
    """Extend a segment up to a pose with the wanted clearance.

    Args:
        field: distance field.
        footprint: footprint of the vehicle.
        pose: start of the segment, shape (3,).
        segment: gives sign, curvature and sideslip.
        level: clearance of the pose, in steps of LEVEL.
        best: maximum clearance so far.
        dip: maximum fall below the best clearance.
        wanted: clearance that ends the motion.

    Returns:
        Free length (unsigned, m), the clearance at its end, and the maximum clearance so far.
    """
    sign = 1.0 if segment[0] > 0.0 else -1.0
    free, known = 0.0, level
    for k in range(1, int(1.0 / CHECK) + 1):  # maximum length of an arc, m
        x, y, yaw = advance(pose[0], pose[1], pose[2], sign * k * CHECK, segment[1], segment[2])
        now = _level(field, footprint, x, y, yaw, known, max(best - dip, 0), wanted)
        if now < 0 or (sign < 0.0 and unseen_distance(field, footprint, x, y, yaw) < 0.0):
            break
        free, known, best = k * CHECK, now, max(best, now)
        if now >= wanted and free >= SHORTEST:
            break
    return free, known, best


@njit(cache=True)
def _to_room(
    field: FieldData, footprint: FootprintData, start: Array, segments: Array, after: float, wanted: int
) -> tuple[float, int]:
    """Find the place from which a path has the wanted clearance, and the fall of the clearance before it.

    Args:
        field: distance field.
        footprint: footprint of the vehicle.
        start: initial pose of the path, shape (3,).
        segments: segments of the path, shape (n, 3).
        after: distance from the start within which the wanted clearance may be lost again (m).
        wanted: clearance, in steps of LEVEL.

    Returns:
        Distance from the start (m), -1 if the path touches an obstacle earlier or never has the clearance; and the
        maximum fall below the best clearance so far, in steps of LEVEL.
    """
    x, y, yaw = start[0], start[1], start[2]
    level = _level(field, footprint, x, y, yaw, 0, 0, wanted)
    best, fall, before = level, 0, 0.0
    for i in range(len(segments)):
        length, curvature, sideslip = segments[i, 0], segments[i, 1], segments[i, 2]
        pieces = max(math.ceil(abs(length) / CHECK), 1)
        for k in range(pieces + 1):
            travelled = before + abs(length) * k / pieces
            px, py, pyaw = advance(x, y, yaw, length * k / pieces, curvature, sideslip)
            level = _level(field, footprint, px, py, pyaw, max(level, 0), 0, wanted)
            if level < 0 or (length < 0.0 and unseen_distance(field, footprint, px, py, pyaw) < 0.0):
                return -1.0, fall
            best = max(best, level)
            fall = max(fall, best - level)
            if level >= wanted and travelled >= after:
                return travelled, fall
        x, y, yaw = advance(x, y, yaw, length, curvature, sideslip)
        before += abs(length)
    return -1.0, fall


@dataclass(frozen=True, slots=True)
class Departure:
    """Motions from a start to a pose that keeps the margin."""

    segments: Array
    """Segments, shape (n, 3), see ``motion``."""
    end: Array
    """Final pose of the reference point, shape (3,)."""
    cost: float
    """Cost (m)."""
    turns: bool
    """Whether a search may turn the vehicle or move it sideways there; otherwise it must continue straight."""


@dataclass(frozen=True, slots=True)
class _Node:
    pose: Array
    level: int
    best: int
    cost: float
    segments: tuple[tuple[float, float, float], ...]


@dataclass(frozen=True, slots=True)
class Departures:
    """Departures from a start to poses that keep the margin with a small reserve."""

    found: list[Departure]
    """Departures; first those from whose end a search can turn, then the others, each by cost."""
    exhausted: bool
    """Whether the list is complete; otherwise the budget has ended the search."""


def departures(
    route_map: RouteMap, vehicle: Vehicle, start: Array, config: DriveCosts, budget: Budget, reserve: float = 0.0
) -> Departures:
    """Return departures from a start to poses that keep the margin.

    Args:
        route_map: map with the obstacles.
        vehicle: the vehicle.
        start: pose of the reference point, shape (3,).
        config: margin, and cost per metre backward.
        budget: budget of the route; includes this work.
        reserve: share of the budget to keep; half of the rest is kept for the route.

    Returns:
        No departures if the start or all its motions touch an obstacle.
    """
    field, footprint = route_map.field.data(), vehicle.footprint.data()
    wanted = _wanted(config.margin)
    level = int(_level(field, footprint, start[0], start[1], start[2], 0, 0, wanted))
    if level < 0:
        return Departures([], exhausted=True)
    straight, exhausted, end = list[Departure](), True, 0.5 * (budget.remaining() + reserve)
    # (0.0, 0.125, 0.5, 1.0): permitted relative falls of the clearance during a departure, tried in turn, each with
    # half of the remaining budget
    dips = list(dict.fromkeys(math.ceil(level * share) for share in (0.0, 0.125, 0.5, 1.0)))
    for dip in dips:
        until = end if dip == dips[-1] else 0.5 * (budget.remaining() + end)
        result = _search(field, footprint, vehicle, _Node(start, level, level, 0.0, ()), dip, config, budget, until)
        if result.found and result.found[0].turns:
            return result
        straight, exhausted = straight or result.found, exhausted and result.exhausted
    return Departures(straight, exhausted=exhausted)


def _wanted(margin: float) -> int:
    """Return the clearance at the end, in steps of LEVEL."""
    # Extra margin at the end of a departure (m), because the first motion of a search may come a little nearer.
    return int(np.ceil((margin + CHECK_MARGIN + 0.002) / LEVEL))


def _arcs(vehicle: Vehicle) -> list[Array]:
    """Return segments of one metre, forward and backward: lines, arcs and translations to both sides."""
    shapes = [(share * side / vehicle.radius, 0.0) for share in CURVATURES for side in ((1, -1) if share else (1,))]
    if vehicle.crab_angle > 0.0:
        # (1.0, 0.5): angles of the tried translations, as shares of the maximum angle
        shapes += [(0.0, share * side * vehicle.crab_angle) for share in (1.0, 0.5) for side in (1, -1)]
    return [np.array([sign, *shape]) for shape in shapes for sign in (1.0, -1.0)]


def _search(
    field: FieldData, footprint: FootprintData, vehicle: Vehicle, start: _Node, dip: int, config: DriveCosts,
    budget: Budget, until: float,
) -> Departures:  # fmt: skip
    """Search best first over arcs and the places on them, while more than ``until`` of the budget remains."""
    margin, reverse = config.margin, config.reverse_cost
    arcs, wanted, most = _arcs(vehicle), _wanted(margin), np.inf
    lines = [arc for arc in arcs if not arc[1:].any()]
    turning = [arc for arc in arcs if arc[2] or abs(arc[1]) * vehicle.radius > 0.49]
    waiting: list[tuple[float, int, _Node]] = []
    number = count()

    def wait(node: _Node) -> None:
        # 3.0: approximate distance driven per metre of clearance: translations of 0.33 rad
        heappush(waiting, (node.cost + 3.0 * LEVEL * (wanted - node.level), next(number), node))

    wait(start)
    seen: set[tuple[int, ...]] = set()
    found: list[Departure] = []
    enough, exhausted = 20, True  # maximum number of departures from whose ends a route is searched
    while waiting and enough > 0:
        _, _, node = heappop(waiting)
        place = tuple(np.round(node.pose / PLACE).astype(int).tolist())
        if node.cost > most or place in seen:
            continue
        if budget.remaining() <= until:
            exhausted = False
            break
        seen.add(place)
        checked = 0
        for arc in arcs:
            length, level, best = _drive_off(field, footprint, node.pose, arc, node.level, node.best, dip, wanted)
            checked += 8 + round(length / CHECK)  # work per arc of a departure, in checked poses
            if length < SHORTEST:
                continue
            for travelled in np.arange(BRANCH, length - CHECK / 2, BRANCH).tolist():
                wait(_after(node, arc, travelled, min(node.level, level), best, reverse))
            after = _after(node, arc, length, level, best, reverse)
            turns = level >= wanted and _sets_off(field, footprint, turning, after.pose, margin)
            if turns or (level >= wanted and _sets_off(field, footprint, lines, after.pose, margin)):
                found.append(Departure(np.array(after.segments), after.pose, after.cost, turns))
            if turns:
                enough -= 1
                # 0.5: maximum extra cost of a useful departure over the cheapest one, m
                most = min(most, after.cost + 0.5)
            else:
                wait(after)
        # 60: number of checked poses equivalent to one node of a search, the unit of a planner's budget
        budget.work += checked // 60
    order = sorted(found, key=lambda departure: (not departure.turns, departure.cost))
    return Departures(order, exhausted=exhausted)


def _sets_off(field: FieldData, footprint: FootprintData, arcs: list[Array], pose: Array, margin: float) -> bool:
    """Whether a search with this margin can begin with any of the arcs."""
    x, y, yaw = pose.tolist()
    keep = margin + CHECK_MARGIN
    # 0.15: minimum free length of an arc after a departure, m: otherwise a search would end there
    return any(
        segment_free(field, footprint, keep, CHECK_STEP, x, y, yaw, 0.15 * sign, curvature, sideslip)
        for sign, curvature, sideslip in (arc.tolist() for arc in arcs)
    )


def _after(node: _Node, arc: Array, travelled: float, level: int, best: int, reverse: float) -> _Node:
    """Return the node at the given length of an arc (m)."""
    segment = (float(arc[0]) * travelled, float(arc[1]), float(arc[2]))
    cusp = bool(node.segments) and node.segments[-1][0] * segment[0] < 0.0
    cost = node.cost + travelled * (1.0 if arc[0] > 0.0 else reverse) + 0.1 * cusp  # cost of a change of direction, m
    x, y, yaw = node.pose.tolist()
    pose = np.array(advance(x, y, yaw, segment[0], segment[1], segment[2]))
    return _Node(pose, level, best, cost, (*node.segments, segment))


def plan_between(
    route_map: RouteMap, vehicle: Vehicle, config: DriveCosts, start: ArrayLike, goal: ArrayLike,
    search: Callable[[Endpoints], RouteResult], budget: Budget, *, reserve: float = 0.0, departs: bool = True,
) -> RouteResult:  # fmt: skip
    """Return a route between two poses, with a departure if the start is too near to an obstacle, or the failure.

    Args:
        route_map: map with obstacles and costs.
        vehicle: vehicle to drive.
        config: margin, tolerances, costs.
        start: pose of the reference point.
        goal: pose of the reference point.
        search: plans between two poses that keep the margin; ``statistics["exhausted"]`` is not 0 if no budget would
            help.
        budget: budget of the search, for the departure too.
        reserve: share of the budget to keep, see ``departures``.
        departs: whether departures are allowed; otherwise the start must keep the margin.
    """
    ends = _ends(route_map, vehicle, config, start, goal)
    if not departs:
        return search(ends) if isinstance(ends, Endpoints) else ends
    if isinstance(ends, Endpoints) and _room(route_map, vehicle, ends.start, config.margin):
        result = search(ends)
        confined = needs_departure(route_map, vehicle, ends.start, config.margin)
        if result.ok or not confined or not result.statistics.get("exhausted"):
            return result
    elif isinstance(ends, Endpoints):
        result = RouteResult(Reason.START_BLOCKED, text=f"start: every motion comes closer than {config.margin:g} m")
    elif ends.reason is Reason.START_BLOCKED:
        result = ends
    else:
        return ends
    free = _ends(route_map, vehicle, config, start, goal, start_margin=0.0)
    if isinstance(free, RouteResult):
        return free
    begin, end = np.array(start, dtype=np.float64), np.array(goal, dtype=np.float64)
    ways = departures(route_map, vehicle, begin, config, budget, reserve)
    if not ways.found and not ways.exhausted:
        away = f"no route found in time to a place with {config.margin:g} m of clearance"
        return RouteResult(Reason.ROUTE_TIMEOUT, text=f"start: {away}")
    for departure in _best(ways.found, route_map, vehicle, config, end):
        ends = _ends(route_map, vehicle, config, departure.end, end)
        result = search(ends) if isinstance(ends, Endpoints) else ends
        if result.path is not None:
            first = MotionPath(begin, departure.segments, vehicle.steering, vehicle.reference)
            return replace(result, path=first.then(result.path), cost=departure.cost + result.cost)
        if result.reason not in (Reason.ROUTE_TIMEOUT, Reason.GOAL_UNREACHABLE):
            break
    return result


def _ends(
    route_map: RouteMap, vehicle: Vehicle, config: DriveCosts, start: ArrayLike, goal: ArrayLike,
    *, start_margin: float | None = None,
) -> Endpoints | RouteResult:  # fmt: skip
    position, yaw = config.position_tolerance, config.yaw_tolerance
    return check_endpoints(
        route_map, vehicle, start, goal, position, yaw, config.margin, start_margin=start_margin
    )  # fmt: skip


def needs_departure(route_map: RouteMap, vehicle: Vehicle, start: Array, margin: float) -> bool:
    """Whether routes from a start may begin with a departure; otherwise they keep the margin throughout."""
    # 0.03: minimum reserve beyond the margin at a start without a departure, m: the end of a turning body comes that
    # much nearer to a wall at its side
    return not _room(route_map, vehicle, start, margin + 0.03)


@dataclass(frozen=True, slots=True)
class Leaving:
    """Departure of a path from a place nearer to an obstacle than the margin."""

    length: float
    """Distance from the start before the path keeps the margin up to its end (m)."""
    fall: float
    """Drop of the clearance below its previous maximum (m)."""


def leaving(
    route_map: RouteMap, vehicle: Vehicle, path: MotionPath, margin: float, free: Callable[[MotionPath], bool]
) -> Leaving | None:
    """Return how a path leaves its start for the margin; None if it touches an obstacle or never keeps the margin.

    Args:
        route_map: map with the obstacles.
        vehicle: vehicle to drive.
        path: path of the reference point.
        margin: clearance from obstacles (m).
        free: whether a path keeps the margin.
    """
    field, footprint = route_map.field.data(), vehicle.footprint.data()
    start, segments = path.copied()
    kept, length = math.ceil((margin + CHECK_MARGIN) / LEVEL), 0.0
    while length < 3.0:  # maximum length of a departure, m
        length, fall = _to_room(field, footprint, start, segments, length, kept)
        if length < 0.0:
            break
        if free(path.part(length, math.inf)):
            return Leaving(length, fall * LEVEL)
        length += BRANCH
    return None


def _room(route_map: RouteMap, vehicle: Vehicle, start: Array, margin: float) -> bool:
    """Whether a search with this margin has any first motion; without one, all begin too near to an obstacle."""
    return bool(route_map.field.free(vehicle.footprint, start[None], margin + CHECK_MARGIN)[0])


def _best(
    found: list[Departure], route_map: RouteMap, vehicle: Vehicle, config: DriveCosts, goal: Array
) -> list[Departure]:
    """Return the departures to use, ordered by the remaining path from their ends; no two end at one place."""
    if not found or not route_map.field.inside(goal[:2]):
        return found[:1]
    field, cell = route_map.field.data(), route_map.coarse_cell
    cells = [heuristic.cell_at(field, cell, pose[0], pose[1]) for pose in (goal, found[0].end)]
    to_go = heuristic.cost_to_go(route_map.cell_costs(RouteCosts.of(vehicle, config)), cell, cells[0], cells[1])
    table = heuristic.reeds_shepp_table(vehicle.crab_angle)

    def total(departure: Departure) -> float:
        x, y, yaw = departure.end.tolist()
        return departure.cost + heuristic.heuristic_cost(field, to_go, table, vehicle.radius, goal, x, y, yaw)

    chosen: list[Departure] = []
    for departure in sorted(found, key=lambda departure: (not departure.turns, total(departure))):
        if all((np.abs(departure.end - other.end) > 2 * PLACE).any() for other in chosen):
            chosen.append(departure)
    return chosen[:3]  # maximum number of departures tried for a route
