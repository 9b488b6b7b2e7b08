"""Common parts of the searches: binary heap, cost layer, cost and collision check of motions. Loads numba."""

from math import ceil
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_planners.collision_kernels import (
    FieldData,
    FootprintData,
    safe_distance,
    segment_free,
    unseen_distance,
)
from monstertruck_planners.route.motion import advance

IntArray = NDArray[np.int64]

RUNNING, FOUND, EXHAUSTED = 0, 1, 2
"""State of a search after an ``expand``."""

CHUNK = 256
"""Number of nodes expanded between two checks of the budget."""

CHECK_STEP = 0.01
"""Distance between two collision checks close to obstacles (m)."""

CHECK_MARGIN = 1e-3
"""Allowance in the margin for an approach between two checks (m)."""


@njit(cache=True)
def push(keys: Array, items: IntArray, size: int, key: float, item: int) -> int:
    """Add an entry to a binary heap of ``size`` entries in two sufficiently long arrays; return the new size.

    The smallest key is at index 0; entries of equal keys leave in the order of their numbers.
    """
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
def drop(keys: Array, items: IntArray, size: int) -> int:
    """Remove the first entry of a heap (read index 0 before); return the new size."""
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


class CostLayer(NamedTuple):
    """Layer of extra costs per metre in the cells of a field's ringed grid."""

    terrain: NDArray[np.float32]
    """Cost of the ground in each cell; an empty array for none."""
    contact: float
    """Distance to an obstacle's centre at contact of the footprint's side (m)."""
    clearance: float
    """Further distance within which motion costs extra, positive (m)."""
    clearance_cost: float
    """Cost per metre in contact."""


@njit(cache=True)
def clearance_cost(layer: CostLayer, distance: float) -> float:
    """Return the extra cost per metre at a distance from obstacles."""
    near = 1.0 - (distance - layer.contact) / layer.clearance
    return layer.clearance_cost * min(max(near, 0.0), 1.0)


@njit(cache=True)
def extra_cost(distance: NDArray[np.float32], layer: CostLayer, row: int, column: int) -> float:
    """Return the extra cost per metre in a cell."""
    cost = clearance_cost(layer, distance[row, column])
    if layer.terrain.size > 0:
        cost += layer.terrain[row, column]
    return cost


@njit(cache=True)
def layer_cost(
    field: FieldData, layer: CostLayer, x: float, y: float, yaw: float, length: float, curvature: float, sideslip: float
) -> float:
    """Return the extra cost of a motion segment: the layer summed at the middles of pieces of about 0.1 m."""
    if layer.terrain.size == 0 and layer.clearance_cost == 0.0:
        return 0.0
    rows, columns = field.distance.shape
    pieces = max(ceil(abs(length) / 0.1), 1)  # distance between samples of the cost layer, m
    total = 0.0
    for i in range(pieces):
        px, py, _ = advance(x, y, yaw, length * (i + 0.5) / pieces, curvature, sideslip)
        dx, dy = px - field.x, py - field.y
        r = int((dy * field.cos - dx * field.sin) / field.resolution)
        c = int((dx * field.cos + dy * field.sin) / field.resolution)
        if 0 <= r < rows and 0 <= c < columns:
            total += extra_cost(field.distance, layer, r, c)
    return total * abs(length) / pieces


class VehicleMotions(NamedTuple):
    """Limits, costs and motion primitives of the vehicle."""

    radius: float
    """Minimum turning radius (m)."""
    crab: float
    """Maximum angle of a translation (rad); 0 for none."""
    weights: Array
    """Costs per metre backward, of a cusp (turning radii) and per metre of translation, shape (3,)."""
    steering_change_cost: float
    """Cost of every segment (m), because the wheels turn at its start."""
    primitives: Array
    """Motion primitives, one segment each, shape (p, 3)."""
    expansion_lengths: Array
    """Distances along the cost-to-go path to the targets of analytic expansions (m), longest first."""
    check_step: float
    """Step of the collision check (m)."""
    margin: float
    """Margin on all sides of the footprint (m)."""
    free_cusps: int
    """Number of cusps in a route without extra cost."""
    many_cusps_cost: float
    """Extra cost of each further cusp (m)."""
    max_cusps: int
    """Maximum number of cusps in a route."""
    strokes: bool
    """Whether a search also drives arcs as far as they are free, which saves cusps in narrow places."""


@njit(cache=True)
def count_cusps(segments: Array, count: int, direction: float) -> int:
    """Return the changes of direction in ``count`` segments after one of this direction (sign; 0: none)."""
    cusps = 0
    for i in range(count):
        if segments[i, 0] * direction < 0.0:
            cusps += 1
        direction = segments[i, 0]
    return cusps


@njit(cache=True)
def many_cusps_cost(model: VehicleMotions, before: int, more: int) -> float:
    """Return the extra cost of ``more`` cusps after earlier ones in a route (m)."""
    free = model.free_cusps
    return model.many_cusps_cost * (max(before + more - free, 0) - max(before - free, 0))


@njit(cache=True)
def segments_cost(
    field: FieldData,
    layer: CostLayer,
    model: VehicleMotions,
    pose: Array,
    segments: Array,
    count: int,
    direction: float,
) -> float:
    """Return the cost of ``count`` segments from a pose after a segment of this direction (sign; 0: none) (m).

    It excludes the extra cost of many cusps, see ``many_cusps_cost``.
    """
    total = 0.0
    x, y, yaw = pose[0], pose[1], pose[2]
    for i in range(count):
        length = segments[i, 0]
        weight = 1.0 if length > 0.0 else model.weights[0]
        if segments[i, 2] != 0.0:
            weight *= model.weights[2]
        total += abs(length) * weight + model.steering_change_cost
        if length * direction < 0.0:
            total += model.weights[1] * model.radius
        direction = length
        total += layer_cost(field, layer, x, y, yaw, length, segments[i, 1], segments[i, 2])
        x, y, yaw = advance(x, y, yaw, length, segments[i, 1], segments[i, 2])
    return total


@njit(cache=True)
def route_cost(field: FieldData, layer: CostLayer, model: VehicleMotions, start: Array, segments: Array) -> float:
    """Return the cost of a whole route (m)."""
    count = len(segments)
    cost = segments_cost(field, layer, model, start, segments, count, 0.0)
    return cost + many_cusps_cost(model, 0, count_cusps(segments, count, 0.0))


@njit(cache=True)
def free_length(
    field: FieldData, footprint: FootprintData, model: VehicleMotions, pose: Array, segment: Array, longest: float
) -> float:
    """Return the collision-free length (m, unsigned) of an extended segment; 0 beyond ``longest``."""
    sign = 1.0 if segment[0] > 0.0 else -1.0
    pace = 1.0 + abs(segment[1]) * footprint.reach
    step = model.check_step if segment[2] == 0.0 else 0.25 * model.check_step
    free, travelled = 0.0, 0.0
    while travelled <= longest:
        x, y, yaw = advance(pose[0], pose[1], pose[2], sign * travelled, segment[1], segment[2])
        safe = safe_distance(field, footprint, model.margin, x, y, yaw)
        if safe >= 0.0 and sign < 0.0:
            safe = min(safe, unseen_distance(field, footprint, x, y, yaw))
        if safe < 0.0:
            break
        free = travelled
        travelled += max(step, safe / pace)
    return free if travelled <= longest else 0.0


@njit(cache=True)
def segments_free(
    field: FieldData, footprint: FootprintData, model: VehicleMotions, pose: Array, segments: Array, count: int
) -> bool:
    """Whether ``count`` segments driven from a pose are free of collisions."""
    x, y, yaw = pose[0], pose[1], pose[2]
    margin, step = model.margin, model.check_step
    for i in range(count):
        length, curvature, sideslip = segments[i, 0], segments[i, 1], segments[i, 2]
        if not segment_free(field, footprint, margin, step, x, y, yaw, length, curvature, sideslip):
            return False
        x, y, yaw = advance(x, y, yaw, length, curvature, sideslip)
    return True
