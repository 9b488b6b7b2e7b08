"""Reeds-Shepp motions against ompl's: equal lengths, time of a distance and of a sampled path."""

import math
import time

import numpy as np
from ompl import base as ob

from benchmarks.navigation_parts import Options, Part
from monstertruck_planners.route.api import Vehicle
from monstertruck_planners.route.reeds_shepp import ReedsShepp

PAIRS, PATHS = 10_000, 400
TWO, FOUR = Vehicle.truck("2ws"), Vehicle.truck("4ws")
RADIUS = TWO.radius


def run(options: Options) -> Part:
    part = Part()
    rng = np.random.default_rng(7)
    starts, goals = (
        np.column_stack((rng.uniform(-5, 5, (PAIRS, 2)), rng.uniform(-math.pi, math.pi, PAIRS))) for _ in range(2)
    )
    begin = time.perf_counter()
    ours, truck = ReedsShepp(RADIUS), ReedsShepp(FOUR.radius, FOUR.crab_angle)
    ours.path(starts[0], goals[0]).sample(0.1)
    ours.distance(starts, goals)
    truck.distance(starts, goals)
    part.add("warm_up_s", time.perf_counter() - begin)

    space, states = theirs()
    difference = np.abs(ours.distance(starts, goals) - lengths(space, states, starts, goals))
    part.add("difference_m", float(difference.max()), 1e-6)
    # Filling the states is not counted against ompl.
    queries = [(space.allocState(), space.allocState()) for _ in range(PATHS)]
    for (a, b), (start, goal) in zip(queries, pairs(starts, goals), strict=True):
        fill(a, start.tolist())
        fill(b, goal.tolist())
    mine, batch, script = [], [], []
    for _ in range(3 if options.quick else 7):
        mine.append(timed(lambda: ours.distance(starts, goals)) / PAIRS)
        batch.append(timed(lambda: truck.distance(starts, goals)) / PAIRS)
        script.append(timed(lambda: [space.distance(a, b) for _ in range(10) for a, b in queries]) / PATHS / 10)
    part.add("distance_us", min(mine) * 1e6)
    part.add("distance_4ws_us", min(batch) * 1e6)
    part.add("distance_ompl_us", min(script) * 1e6)
    part.add("distance_over_ompl", min(mine) / min(script), 1.0)

    mine, script = [], []
    for _ in range(3 if options.quick else 7):
        mine.append(timed(lambda: [ours.path(a, b).sample(0.1 * RADIUS) for a, b in pairs(starts, goals)]) / PATHS)
        script.append(timed(lambda: [sampled(space, states, a, b) for a, b in pairs(starts, goals)]) / PATHS)
    part.add("path_us", min(mine) * 1e6)
    part.add("path_ompl_us", min(script) * 1e6)
    part.add("path_over_ompl", min(mine) / min(script), 0.3)
    figures = part.figures
    print(f"Reeds-Shepp: difference {difference.max():.1e} m on {PAIRS} pairs")
    print(f"  distance {figures['distance_us']:.2f} us, with crab {figures['distance_4ws_us']:.2f} us")
    print(f"  ompl {figures['distance_ompl_us']:.2f} us")
    print(f"  sampled path {figures['path_us']:.0f} us, ompl {figures['path_ompl_us']:.0f} us")
    return part


def pairs(starts, goals):  # noqa: ANN001, ANN201
    return zip(starts[:PATHS], goals[:PATHS], strict=True)


def timed(call) -> float:  # noqa: ANN001
    begin = time.thread_time()
    call()
    return time.thread_time() - begin


def theirs():  # noqa: ANN201
    space = ob.ReedsSheppStateSpace(RADIUS)
    bounds = ob.RealVectorBounds(2)
    bounds.setLow(-100)
    bounds.setHigh(100)
    space.setBounds(bounds)
    return space, [space.allocState() for _ in range(3)]


def fill(state, pose) -> None:  # noqa: ANN001
    state.setX(pose[0])
    state.setY(pose[1])
    state.setYaw(pose[2])


def lengths(space, states, starts, goals):  # noqa: ANN001, ANN201
    a, b, _ = states
    result = np.empty(len(starts))
    for i, (start, goal) in enumerate(zip(starts.tolist(), goals.tolist(), strict=True)):
        fill(a, start)
        fill(b, goal)
        result[i] = space.distance(a, b)
    return result


def sampled(space, states, start, goal):  # noqa: ANN001, ANN201
    a, b, between = states
    fill(a, start)
    fill(b, goal)
    count = math.ceil(space.distance(a, b) / (0.1 * RADIUS))
    poses = np.empty((count + 1, 3))
    for i in range(count + 1):
        space.interpolate(a, b, i / max(count, 1), between)
        poses[i] = between.getX(), between.getY(), between.getYaw()
    return poses
