"""Routes over waypoints, and reuse of a previous route that is still good. Loads numba."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from monstertruck_kinematics.elementary import Array
from monstertruck_planners.route.api import Clock, RouteMap, RoutePlanner, RouteResult, make_planner
from monstertruck_planners.route.config import HybridConfig
from monstertruck_planners.route.departure import needs_departure
from monstertruck_planners.route.hybrid import HybridPlanner
from monstertruck_planners.route.motion import MotionPath, joined
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.reasons import Reason

PASSING = 0.1
"""Maximum distance of a route from its waypoints (m)."""


@dataclass(frozen=True, slots=True)
class ViaPoint:
    """Waypoint; without a heading it gets the heading of the path through it."""

    x: float
    y: float
    yaw: float | None = None


def plan_through(
    planner: RoutePlanner,
    route_map: RouteMap,
    start: ArrayLike,
    waypoints: Sequence[ViaPoint],
    now: Clock | None = None,
) -> RouteResult:
    """Plan a route over all waypoints in turn, with a shared budget; the last waypoint is the goal.

    Raises:
        InputError: there is no waypoint.
    """
    if not waypoints:
        raise InputError("route over waypoints: expected at least one waypoint")
    share = 1.0 / len(waypoints)
    config = planner.config
    leg_config = config.model_copy(
        update={"budget": config.budget * share, "effort": max(int(config.effort * share), 1)}
    )
    leg_planner = make_planner(planner.vehicle, leg_config)
    here = np.asarray(start, dtype=np.float64)
    legs: list[RouteResult] = []
    cost, statistics = 0.0, dict[str, float]()
    for number, goal in enumerate(with_headings(here, waypoints), start=1):
        result = leg_planner.plan(route_map, here, goal, now)
        for name, value in result.statistics.items():
            known = statistics.get(name)
            statistics[name] = value if known is None else min(known, value) if name == "margin" else known + value
        if not result.ok:
            leg = f"waypoint {number} of {len(waypoints) - 1}: " if number < len(waypoints) else ""
            return replace(result, text=leg + result.text, statistics=statistics)
        legs.append(result)
        cost += result.cost
        here = result.end
    return replace(_joined(legs), cost=cost, statistics=statistics)


def _joined(legs: Sequence[RouteResult]) -> RouteResult:
    """Join the legs to one path if all are paths, else to poses."""
    paths = [leg.path for leg in legs if leg.path is not None]
    if len(paths) == len(legs):
        return RouteResult(Reason.OK, joined(paths))
    poses = [leg.poses if leg.path is None else leg.path.sample(PASSING / 2).poses for leg in legs]
    return RouteResult(Reason.OK, poses=np.vstack([part for part in poses if part is not None]))


def with_headings(start: ArrayLike, waypoints: Sequence[ViaPoint]) -> list[Array]:
    """Return the poses of all waypoints; a missing heading points from the previous to the next waypoint."""
    start = np.asarray(start, dtype=np.float64)
    places = [(float(start[0]), float(start[1])), *((w.x, w.y) for w in waypoints)]
    goals = []
    for i, waypoint in enumerate(waypoints, start=1):
        yaw = waypoint.yaw
        if yaw is None:
            (x0, y0), (x1, y1) = places[i - 1], places[min(i + 1, len(places) - 1)]
            yaw = math.atan2(y1 - y0, x1 - x0)
        goals.append(np.array([waypoint.x, waypoint.y, yaw]))
    return goals


@dataclass(frozen=True, slots=True)
class KeepPolicy:
    """Conditions for keeping a route."""

    reach: float = 0.5
    """Maximum distance of the truck from the route (m)."""
    gain: float = 0.1
    """Minimum cost reduction of a new route, as a fraction of the old cost."""
    fall: float = 0.005
    """Maximum difference in clearance between a kept and a new route before the margin is kept (m)."""


def replan(
    planner: RoutePlanner,
    route_map: RouteMap,
    previous: MotionPath | None,
    pose: ArrayLike,
    goal: ArrayLike,
    now: Clock | None = None,
    policy: KeepPolicy | None = None,
    via: Sequence[Array] = (),
) -> RouteResult:
    """Return the rest of the previous route while it is free and leads to the goal, unless a new one is much better.

    This hysteresis keeps a truck before an obstacle from changing sides.
    ``statistics["kept_route"]`` is 1 if the route is kept. Only paths are kept; routes of mere poses are replanned.

    Args:
        planner: planner of both routes.
        route_map: latest map.
        previous: route so far.
        pose: pose of the reference point.
        goal: goal of the reference point.
        now: see ``plan``.
        policy: conditions for keeping a route.
        via: poses of the reference point to pass before the goal.
    """
    policy = policy or KeepPolicy()
    stops = [ViaPoint(*place.tolist()) for place in (*via, np.asarray(goal, dtype=np.float64))] if via else []
    fresh = plan_through(planner, route_map, pose, stops, now) if stops else planner.plan(route_map, pose, goal, now)
    judge = _judge(planner)
    keeper = judge.planner_for(fresh.statistics.get("margin", judge.config.margin))
    kept = None
    if previous is not None:
        fall = _fall_allowed(keeper, route_map, fresh, pose, policy)
        kept = remaining_route(keeper, route_map, previous, pose, goal, policy.reach, fall)
    if kept is not None and not all(_passes(kept, place) for place in via):
        kept = None
    cost = fresh.cost if judge is planner or fresh.path is None else keeper.cost(route_map, fresh.path)
    if kept is None or (fresh.ok and cost < (1.0 - policy.gain) * keeper.cost(route_map, kept)):
        return replace(fresh, statistics={**fresh.statistics, "kept_route": 0.0})
    return RouteResult(
        Reason.OK, kept, cost=keeper.cost(route_map, kept), statistics={**fresh.statistics, "kept_route": 1.0}
    )


def _fall_allowed(
    keeper: HybridPlanner, route_map: RouteMap, fresh: RouteResult, pose: ArrayLike, policy: KeepPolicy
) -> float | None:
    """See ``remaining_route``; if the route begins with a departure, it takes about as long as planning a new one."""
    if not needs_departure(route_map, keeper.vehicle, np.asarray(pose, dtype=np.float64), keeper.config.margin):
        return None
    if fresh.path is None:
        return math.inf
    left = None if keeper.free(route_map, fresh.path) else keeper.leaving(route_map, fresh.path)
    return None if left is None else left.fall + policy.fall


def _judge(planner: RoutePlanner) -> HybridPlanner:
    """Judge whether paths are free, and their cost with the settings shared with hybrid A*."""
    if isinstance(planner, HybridPlanner):
        return planner
    shared = (set(type(planner.config).model_fields) & set(HybridConfig.model_fields)) - {"kind"}
    return HybridPlanner(planner.vehicle, HybridConfig(**{name: getattr(planner.config, name) for name in shared}))


def remaining_route(
    planner: HybridPlanner, route_map: RouteMap, path: MotionPath, pose: ArrayLike, goal: ArrayLike, reach: float,
    fall: float | None = None,
) -> MotionPath | None:  # fmt: skip
    """Return a free path from the pose back to the route and along it to its end, or None.

    If the pose is nearer to an obstacle than the margin, the rest of the route's departure is driven unchanged, or
    skipped by a motion to the route beyond it. Such a path touches no obstacle, and keeps the margin from its first
    pose with the margin on.

    Args:
        planner: planner of the path.
        route_map: latest map.
        path: route so far.
        pose: pose of the reference point.
        goal: required end of the path.
        reach: maximum distance of the pose from the path (m).
        fall: maximum fall of the clearance on a departure (m); None: the path must keep the margin throughout.
    """
    here, there = np.asarray(pose, dtype=np.float64), np.asarray(goal, dtype=np.float64)
    # 1e-3: maximum difference of equal goals, m and rad
    if not np.isfinite(here).all() or not len(path.segments) or _apart(path.end, there) > planner.tolerance + 1e-3:
        return None
    samples = path.sample(0.01)
    away = np.hypot(samples.poses[:, 0] - here[0], samples.poses[:, 1] - here[1])
    turned = np.abs(np.remainder(samples.poses[:, 2] - here[2] + math.pi, math.tau) - math.pi)
    nearest = int(np.argmin(away + planner.vehicle.radius * turned))
    if away[nearest] > reach:
        return None
    begin = float(samples.travelled[nearest])
    reeds_shepp = planner.vehicle.reeds_shepp(planner.config)

    def joined_at(first: MotionPath, begin: float) -> list[MotionPath]:
        rests = [path.part(begin + ahead * planner.vehicle.radius, math.inf) for ahead in (0.0, 0.5, 1.0, 2.0, 4.0)]
        return [first.then(reeds_shepp.path(first.end, rest.start)).then(rest) for rest in rests]

    ways = joined_at(replace(path, start=here, segments=np.empty((0, 3)), steering=()), begin)
    if fall is None:
        ways = [way for way in ways if planner.free(route_map, way)]
    else:
        left = planner.leaving(route_map, path.part(begin, math.inf))
        if left is not None:
            rest = path.part(begin, begin + left.length)
            ways += joined_at(replace(rest, start=here), begin + left.length)
        ways = [way for way in ways if (left := planner.leaving(route_map, way)) is not None and left.fall <= fall]
    return min(ways, key=lambda way: planner.cost(route_map, way), default=None)


def _passes(path: MotionPath, place: Array) -> bool:
    poses = path.sample(PASSING / 2).poses
    return bool(np.hypot(*(poses[:, :2] - place[:2]).T).min() < PASSING)


def _apart(a: Array, b: Array) -> float:
    return float(max(math.hypot(a[0] - b[0], a[1] - b[1]), abs(math.remainder(a[2] - b[2], math.tau))))
