"""Smoothing of a drivable path: shortcuts, and the best headings along it. Loads numba.

Both kinds of shortcut trial use a random stretch of the path: the first replaces it by the best motion between its
ends; the second by the two best motions over a slightly moved pose in its middle. A trial is kept if it costs less and
is free. The path therefore stays drivable after every trial, and its curvature never exceeds the curvature of its arcs.

Shortcuts find only the nearest optimum: they never turn a truck around that drives a long distance forward where
backward is shorter. Dynamic programming over places along the path decides the truck's headings and its changes of
direction.
"""

from math import inf, pi, sqrt

import numpy as np
from numba import njit
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_planners.collision_kernels import FieldData, FootprintData
from monstertruck_planners.route.reeds_shepp import COST, MAX_SEGMENTS, connect
from monstertruck_planners.route.search import (
    CostLayer,
    VehicleMotions,
    count_cusps,
    many_cusps_cost,
    route_cost,
    segments_cost,
    segments_free,
)
from monstertruck_planners.route.segment_buffer import (
    MIN_SEGMENT,
    SegmentBuffer,
    pose_at,
    restore,
    segment_at,
    splice,
    stretch_segments,
)


@njit(cache=True)
def _cusps_with_ends(segments: Array, count: int, before: float, after: float) -> int:
    """Return the cusps of a stretch between segments of these directions (sign; 0: none)."""
    cusps = count_cusps(segments, count, before)
    last = segments[count - 1, 0] if count > 0 else before
    return cusps + (1 if last * after < 0.0 else 0)


@njit(cache=True)
def _around(path: SegmentBuffer, begin: float, i: int, end: float, j: int) -> tuple[float, float]:
    """Return the directions (sign; 0: none) before and after the stretch from ``begin`` (in i) to ``end`` (in j)."""
    before, after = path.segments[i, 0], path.segments[j, 0]
    if begin - path.travelled[i] <= MIN_SEGMENT:
        before = path.segments[i - 1, 0] if i > 0 else 0.0
    if path.travelled[j + 1] - end <= MIN_SEGMENT:
        after = path.segments[j + 1, 0] if j + 1 < path.used[0] else 0.0
    return before, after


@njit(cache=True)
def _whole_cost(field: FieldData, layer: CostLayer, model: VehicleMotions, path: SegmentBuffer) -> float:
    return route_cost(field, layer, model, path.poses[0], path.segments[: path.used[0]])


@njit(cache=True)
def shortcut(
    field: FieldData,
    footprint: FootprintData,
    layer: CostLayer,
    model: VehicleMotions,
    path: SegmentBuffer,
    reach: float,
    shift: float,
    random: Array,
) -> int:
    """Run shortcut trials, one for each row of ``random``.

    Args:
        field: distance field.
        footprint: footprint of the vehicle.
        layer: layer of extra costs.
        model: limits and costs of the vehicle.
        path: path, changed in place.
        reach: maximum length of a stretch (m).
        shift: maximum displacement of the middle pose, as a share of the stretch.
        random: uniform numbers in 0 to 1, shape (n, 6).

    Returns:
        Number of successful trials.
    """
    old, new, word = np.empty((len(path.segments), 3)), np.empty((2 * MAX_SEGMENTS, 3)), np.empty((MAX_SEGMENTS, 3))
    spare, best, scratch = np.empty((len(path.segments) + 12, 3)), np.empty(8), np.empty((4, 3))
    a, b, q = np.empty(3), np.empty(3), np.empty(3)
    before_trial = np.empty_like(path.segments)
    whole = _whole_cost(field, layer, model, path)
    kept, cusps = 0, count_cusps(path.segments, path.used[0], 0.0)
    for n in range(len(random)):
        total = path.travelled[path.used[0]]
        # Short stretches are tried more often than long ones.
        length = min(reach, total) * random[n, 0] ** 2 + 0.02
        begin = random[n, 1] * (total + length) - length
        end = min(begin + length, total)
        begin = max(begin, 0.0)
        if end - begin < 0.01:
            continue
        i, j = segment_at(path, begin), segment_at(path, end)
        pose_at(path, i, begin, a)
        pose_at(path, j, end, b)
        before, after = _around(path, begin, i, end, j)
        count = stretch_segments(path, begin, i, end, j, old)
        present = segments_cost(field, layer, model, a, old, count, before)
        if after * old[count - 1, 0] < 0.0:
            present += model.weights[1] * model.radius
        others = cusps - _cusps_with_ends(old, count, before, after)
        present += many_cusps_cost(model, others, cusps - others)
        many = 0
        if random[n, 2] < 0.35:
            many = connect(a, b, model.radius, model.crab, model.weights, new, best, scratch)
            if best[COST] * model.radius >= present - 1e-6:
                continue
        else:
            middle = 0.5 * (begin + end)
            pose_at(path, segment_at(path, middle), middle, q)
            size = shift * (end - begin) * random[n, 3] ** 2
            q[0] += size * (2.0 * random[n, 4] - 1.0)
            q[1] += size * (2.0 * random[n, 5] - 1.0)
            q[2] += 1.5 * min(size / max(end - begin, 1e-3), 0.5) * (2.0 * random[n, 2] - 1.35) / 0.65
            many = connect(a, q, model.radius, model.crab, model.weights, new, best, scratch)
            first = best[COST] * model.radius
            if first + sqrt((q[0] - b[0]) ** 2 + (q[1] - b[1]) ** 2) >= present - 1e-6:
                continue
            more = connect(q, b, model.radius, model.crab, model.weights, word, best, scratch)
            if first + best[COST] * model.radius >= present - 1e-6:
                continue
            for k in range(more):
                new[many, 0], new[many, 1], new[many, 2] = word[k, 0], word[k, 1], word[k, 2]
                many += 1
        cost = segments_cost(field, layer, model, a, new, many, before)
        if many > 0 and after * new[many - 1, 0] < 0.0:
            cost += model.weights[1] * model.radius
        new_cusps = _cusps_with_ends(new, many, before, after)
        cost += many_cusps_cost(model, others, new_cusps)
        if cost >= present - 1e-6 or not segments_free(field, footprint, model, a, new, many):
            continue
        # Costs are summed at places along each segment, so a stretch's cost differs slightly from its share of the
        # route.
        used = path.used[0]
        before_trial[:used] = path.segments[:used]
        splice(path, begin, i, end, j, new, many, spare)
        changed = _whole_cost(field, layer, model, path)
        if changed >= whole - 1e-6:
            restore(path, before_trial, used)
            continue
        whole = changed
        cusps = count_cusps(path.segments, path.used[0], 0.0)
        kept += 1
    return kept


@njit(cache=True)
def choose_headings(
    field: FieldData,
    footprint: FootprintData,
    layer: CostLayer,
    model: VehicleMotions,
    places: Array,
    travelled: Array,
    reach: float,
) -> Array:
    """Find the cheapest free chain of motions over places along a path, with either heading at each place.

    Args:
        field: distance field.
        footprint: footprint of the vehicle.
        layer: layer of extra costs.
        model: limits and costs of the vehicle.
        places: poses in driving order, shape (n, 3); the last one keeps its heading.
        travelled: distances along the path, shape (n,) (m).
        reach: maximum length of a motion along the path (m).

    Returns:
        Motion segments, shape (k, 3); empty if no chain is free.
    """
    n = len(places)
    cost, direction, cusps = np.full((n, 2), inf), np.zeros((n, 2)), np.zeros((n, 2), np.int64)
    before = np.full((n, 2), -1, np.int64)
    poses = np.empty((n, 2, 3))
    for i in range(n):
        for k in range(2):
            poses[i, k, 0], poses[i, k, 1], poses[i, k, 2] = places[i, 0], places[i, 1], places[i, 2] + k * pi
    segments, best, scratch = np.empty((MAX_SEGMENTS, 3)), np.empty(8), np.empty((4, 3))
    cost[0, 0] = 0.0
    for j in range(1, n):
        for i in range(j - 1, -1, -1):
            if travelled[j] - travelled[i] > reach and i < j - 1:
                break
            for k in range(4):
                # The final heading is given.
                if j == n - 1 and k >= 2:
                    continue
                a, b, limit = poses[i, k & 1], poses[j, k >> 1], cost[j, k >> 1] - cost[i, k & 1]
                if limit <= sqrt((b[0] - a[0]) ** 2 + (b[1] - a[1]) ** 2):
                    continue
                many = connect(a, b, model.radius, model.crab, model.weights, segments, best, scratch)
                if best[COST] * model.radius >= limit:
                    continue
                more = count_cusps(segments, many, direction[i, k & 1])
                total = segments_cost(field, layer, model, a, segments, many, direction[i, k & 1])
                total += many_cusps_cost(model, cusps[i, k & 1], more)
                if total < limit and segments_free(field, footprint, model, a, segments, many):
                    cost[j, k >> 1], before[j, k >> 1] = cost[i, k & 1] + total, 2 * i + (k & 1)
                    direction[j, k >> 1] = segments[many - 1, 0] if many > 0 else direction[i, k & 1]
                    cusps[j, k >> 1] = cusps[i, k & 1] + more
    return _chain_segments(model, poses, before)


@njit(cache=True)
def _chain_segments(model: VehicleMotions, poses: Array, before: NDArray[np.int64]) -> Array:
    """Return the segments of the chain that ends at the last place."""
    n = len(poses)
    if before[n - 1, 0] < 0:
        return np.empty((0, 3))
    segments, best, scratch = np.empty((MAX_SEGMENTS, 3)), np.empty(8), np.empty((4, 3))
    chain = np.empty(n, np.int64)
    chain[0] = 2 * (n - 1)
    depth = 1
    while chain[depth - 1] > 0:
        chain[depth] = before[chain[depth - 1] // 2, chain[depth - 1] % 2]
        depth += 1
    result = np.empty((depth * MAX_SEGMENTS, 3))
    used = 0
    for m in range(depth - 1, 0, -1):
        a, b = poses[chain[m] // 2, chain[m] % 2], poses[chain[m - 1] // 2, chain[m - 1] % 2]
        many = connect(a, b, model.radius, model.crab, model.weights, segments, best, scratch)
        for r in range(many):
            result[used, 0], result[used, 1], result[used, 2] = segments[r, 0], segments[r, 1], segments[r, 2]
            used += 1
    return result[:used].copy()
