"""Shortening a drivable path without leaving what is free: cut corners, and move poses in between. Compiled.

Two kinds of trial, both on a random stretch of the path: replace it by the best motion between its ends; or by the two
best motions over a pose in its middle, moved a little. A trial is kept if it costs less and is free, so the path stays
drivable after every trial and its curvature never exceeds that of its arcs.
"""

from math import inf, pi, sqrt
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_planners.collision_kernels import BodyData, FieldData
from monstertruck_planners.route.motion import advance
from monstertruck_planners.route.reeds_shepp import COST, MOST_ROWS, connect
from monstertruck_planners.route.search import Car, Layer, rows_cost, rows_free

IntArray = NDArray[np.int64]

LEAST_ROW = 1e-9
"""Shorter rows are dropped, m."""


class Draft(NamedTuple):
    """A path under work."""

    rows: Array
    """Shape (n, 3), of which ``used[0]`` are in use."""
    poses: Array
    """Shape (n + 1, 3), before each row and after the last."""
    travelled: Array
    """Shape (n + 1,)."""
    used: IntArray


@njit(cache=True)
def measure(draft: Draft, first: int) -> None:
    """Poses and lengths from row ``first`` on."""
    if first == 0:
        draft.travelled[0] = 0.0
    for i in range(first, draft.used[0]):
        length = draft.rows[i, 0]
        x, y, yaw = advance(
            draft.poses[i, 0], draft.poses[i, 1], draft.poses[i, 2], length, draft.rows[i, 1], draft.rows[i, 2]
        )
        draft.poses[i + 1, 0], draft.poses[i + 1, 1], draft.poses[i + 1, 2] = x, y, yaw
        draft.travelled[i + 1] = draft.travelled[i] + abs(length)


@njit(cache=True)
def _row_at(draft: Draft, s: float) -> int:
    low, high = 0, draft.used[0] - 1
    while low < high:
        middle = (low + high) >> 1
        if draft.travelled[middle + 1] > s:
            high = middle
        else:
            low = middle + 1
    return low


@njit(cache=True)
def _pose_at(draft: Draft, i: int, s: float, out: Array) -> None:
    part = min(s - draft.travelled[i], abs(draft.rows[i, 0]))
    if draft.rows[i, 0] < 0.0:
        part = -part
    x, y, yaw = advance(
        draft.poses[i, 0], draft.poses[i, 1], draft.poses[i, 2], part, draft.rows[i, 1], draft.rows[i, 2]
    )
    out[0], out[1], out[2] = x, y, yaw


@njit(cache=True)
def _append(out: Array, used: int, length: float, curvature: float, sideslip: float) -> int:
    """Add a row; one that only goes on as the last one did makes that longer."""
    if abs(length) < LEAST_ROW:
        return used
    if used > 0:
        k = used - 1
        same = abs(out[k, 1] - curvature) < 1e-12 and abs(out[k, 2] - sideslip) < 1e-12
        if same and out[k, 0] * length > 0.0:
            out[k, 0] += length
            return used
    out[used, 0], out[used, 1], out[used, 2] = length, curvature, sideslip
    return used + 1


@njit(cache=True)
def tidy(draft: Draft) -> None:
    """Join rows that go on alike, and measure the whole."""
    used = 0
    for k in range(draft.used[0]):
        used = _append(draft.rows, used, draft.rows[k, 0], draft.rows[k, 1], draft.rows[k, 2])
    draft.used[0] = used
    measure(draft, 0)


@njit(cache=True)
def _splice(draft: Draft, begin: float, i: int, end: float, j: int, middle: Array, many: int, spare: Array) -> None:
    """Replace the stretch from ``begin`` (in row i) to ``end`` (in row j)."""
    used = 0
    first = max(i - 1, 0)
    # Rows before the stretch stay; the last of them may grow.
    for k in range(first, i):
        used = _append(spare, used, draft.rows[k, 0], draft.rows[k, 1], draft.rows[k, 2])
    sign = 1.0 if draft.rows[i, 0] > 0.0 else -1.0
    used = _append(spare, used, sign * (begin - draft.travelled[i]), draft.rows[i, 1], draft.rows[i, 2])
    for k in range(many):
        used = _append(spare, used, middle[k, 0], middle[k, 1], middle[k, 2])
    sign = 1.0 if draft.rows[j, 0] > 0.0 else -1.0
    used = _append(spare, used, sign * (draft.travelled[j + 1] - end), draft.rows[j, 1], draft.rows[j, 2])
    for k in range(j + 1, draft.used[0]):
        used = _append(spare, used, draft.rows[k, 0], draft.rows[k, 1], draft.rows[k, 2])
    if first + used > len(draft.rows):
        return
    for k in range(used):
        draft.rows[first + k, 0] = spare[k, 0]
        draft.rows[first + k, 1] = spare[k, 1]
        draft.rows[first + k, 2] = spare[k, 2]
    draft.used[0] = first + used
    measure(draft, first)


@njit(cache=True)
def _stretch(draft: Draft, begin: float, i: int, end: float, j: int, out: Array) -> int:
    """Rows of the present stretch."""
    used = 0
    for k in range(i, j + 1):
        low, high = max(begin - draft.travelled[k], 0.0), min(end, draft.travelled[k + 1]) - draft.travelled[k]
        sign = 1.0 if draft.rows[k, 0] > 0.0 else -1.0
        used = _append(out, used, sign * (high - low), draft.rows[k, 1], draft.rows[k, 2])
    return used


@njit(cache=True)
def shorten(
    field: FieldData,
    body: BodyData,
    layer: Layer,
    car: Car,
    draft: Draft,
    reach: float,
    shift: float,
    random: Array,
) -> int:
    """As many trials as there are rows of ``random``.

    Args:
        field: the grid.
        body: the footprint.
        layer: prices.
        car: limits and costs.
        draft: the path, changed in place.
        reach: longest stretch, m.
        shift: a pose in between moves by up to this share of the stretch.
        random: shape (n, 6), uniform in 0 to 1.

    Returns:
        Number of trials kept.
    """
    old, new, word = np.empty((len(draft.rows), 3)), np.empty((2 * MOST_ROWS, 3)), np.empty((MOST_ROWS, 3))
    spare, best, scratch = np.empty((len(draft.rows) + 12, 3)), np.empty(8), np.empty((4, 3))
    a, b, q = np.empty(3), np.empty(3), np.empty(3)
    kept = 0
    for n in range(len(random)):
        total = draft.travelled[draft.used[0]]
        if total < 1e-6:
            break
        # Short stretches are tried oftener than long ones.
        length = min(reach, total) * random[n, 0] ** 2 + 0.02
        begin = random[n, 1] * (total + length) - length
        end = min(begin + length, total)
        begin = max(begin, 0.0)
        if end - begin < 0.01:
            continue
        i, j = _row_at(draft, begin), _row_at(draft, end)
        _pose_at(draft, i, begin, a)
        _pose_at(draft, j, end, b)
        before = (
            draft.rows[i, 0] if begin - draft.travelled[i] > LEAST_ROW else (draft.rows[i - 1, 0] if i > 0 else 0.0)
        )
        after = draft.rows[j, 0] if draft.travelled[j + 1] - end > LEAST_ROW else (
            draft.rows[j + 1, 0] if j + 1 < draft.used[0] else 0.0
        )  # fmt: skip
        count = _stretch(draft, begin, i, end, j, old)
        present = rows_cost(field, layer, car, a, old, count, before)
        if after * old[count - 1, 0] < 0.0:
            present += car.weights[1] * car.radius
        many = 0
        if random[n, 2] < 0.35:
            many = connect(a, b, car.radius, car.crab, car.weights, new, best, scratch)
            if best[COST] * car.radius >= present - 1e-6:
                continue
        else:
            middle = 0.5 * (begin + end)
            _pose_at(draft, _row_at(draft, middle), middle, q)
            size = shift * (end - begin) * random[n, 3] ** 2
            q[0] += size * (2.0 * random[n, 4] - 1.0)
            q[1] += size * (2.0 * random[n, 5] - 1.0)
            q[2] += 1.5 * min(size / max(end - begin, 1e-3), 0.5) * (2.0 * random[n, 2] - 1.35) / 0.65
            many = connect(a, q, car.radius, car.crab, car.weights, new, best, scratch)
            first = best[COST] * car.radius
            if first + sqrt((q[0] - b[0]) ** 2 + (q[1] - b[1]) ** 2) >= present - 1e-6:
                continue
            more = connect(q, b, car.radius, car.crab, car.weights, word, best, scratch)
            if first + best[COST] * car.radius >= present - 1e-6:
                continue
            for k in range(more):
                new[many, 0], new[many, 1], new[many, 2] = word[k, 0], word[k, 1], word[k, 2]
                many += 1
        cost = rows_cost(field, layer, car, a, new, many, before)
        if many > 0 and after * new[many - 1, 0] < 0.0:
            cost += car.weights[1] * car.radius
        if cost >= present - 1e-6 or not rows_free(field, body, car, a, new, many):
            continue
        _splice(draft, begin, i, end, j, new, many, spare)
        kept += 1
    return kept


@njit(cache=True)
def redraft(
    field: FieldData, body: BodyData, layer: Layer, car: Car, places: Array, travelled: Array, reach: float
) -> Array:
    """Cheapest free chain from the first place to the last.

    Args:
        field: the grid.
        body: the footprint.
        layer: prices.
        car: limits and costs.
        places: shape (n, 3), poses in the order driven.
        travelled: shape (n,), m.
        reach: a motion leads at most this far along the path, m.

    Returns:
        Motion rows, shape (k, 3); none if no chain is free.
    """
    n = len(places)
    cost, sense = np.full((n, 2), inf), np.zeros((n, 2))
    before = np.full((n, 2), -1, np.int64)
    poses = np.empty((n, 2, 3))
    for i in range(n):
        for k in range(2):
            poses[i, k, 0], poses[i, k, 1], poses[i, k, 2] = places[i, 0], places[i, 1], places[i, 2] + k * pi
    rows, best, scratch = np.empty((MOST_ROWS, 3)), np.empty(8), np.empty((4, 3))
    cost[0, 0] = 0.0
    for j in range(1, n):
        for i in range(j - 1, -1, -1):
            if travelled[j] - travelled[i] > reach and i < j - 1:
                break
            for k in range(4):
                # At the end the truck faces as it has to.
                if j == n - 1 and k >= 2:
                    continue
                a, b, limit = poses[i, k & 1], poses[j, k >> 1], cost[j, k >> 1] - cost[i, k & 1]
                if limit <= sqrt((b[0] - a[0]) ** 2 + (b[1] - a[1]) ** 2):
                    continue
                many = connect(a, b, car.radius, car.crab, car.weights, rows, best, scratch)
                if best[COST] * car.radius >= limit:
                    continue
                price = rows_cost(field, layer, car, a, rows, many, sense[i, k & 1])
                if price < limit and rows_free(field, body, car, a, rows, many):
                    cost[j, k >> 1], before[j, k >> 1] = cost[i, k & 1] + price, 2 * i + (k & 1)
                    sense[j, k >> 1] = rows[many - 1, 0] if many > 0 else sense[i, k & 1]
    return _spelled(car, poses, before)


@njit(cache=True)
def _spelled(car: Car, poses: Array, before: NDArray[np.int64]) -> Array:
    """Rows of the chain that ends at the last place."""
    n = len(poses)
    if before[n - 1, 0] < 0:
        return np.empty((0, 3))
    rows, best, scratch = np.empty((MOST_ROWS, 3)), np.empty(8), np.empty((4, 3))
    chain = np.empty(n, np.int64)
    chain[0] = 2 * (n - 1)
    depth = 1
    while chain[depth - 1] > 0:
        chain[depth] = before[chain[depth - 1] // 2, chain[depth - 1] % 2]
        depth += 1
    result = np.empty((depth * MOST_ROWS, 3))
    used = 0
    for m in range(depth - 1, 0, -1):
        a, b = poses[chain[m] // 2, chain[m] % 2], poses[chain[m - 1] // 2, chain[m - 1] % 2]
        many = connect(a, b, car.radius, car.crab, car.weights, rows, best, scratch)
        for r in range(many):
            result[used, 0], result[used, 1], result[used, 2] = rows[r, 0], rows[r, 1], rows[r, 2]
            used += 1
    return result[:used].copy()
