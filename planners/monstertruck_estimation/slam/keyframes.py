"""Keyframe map: keyframes with their pose graph, the trajectory, pruning, and joint registration at the end."""

import itertools
import math
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from monstertruck_estimation.slam.config import MapperConfig
from monstertruck_estimation.slam.correlation import Submap, merged
from monstertruck_estimation.slam.graph import Edges, drift, optimise, parts
from monstertruck_estimation.slam.registration import CELL, Cloud, normal_equations, register
from monstertruck_estimation.slam.scan_matcher import deviations
from monstertruck_estimation.slam.scans import Scan
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import between, compose, compose_jacobians, inverse, wrap
from monstertruck_runtime.clock import SECOND


class GrowingArray:
    """Array that grows by rows in amortised constant time."""

    def __init__(self, *shape: int, dtype: type = float) -> None:
        self._data: NDArray[Any] = np.zeros((64, *shape), dtype)
        self._count = 0

    def append(self, row: object) -> None:
        """Add one row."""
        if self._count == len(self._data):
            self._data = np.concatenate((self._data, np.zeros_like(self._data)))
        self._data[self._count] = row
        self._count += 1

    def set(self, rows: NDArray[Any]) -> None:
        """Replace all rows."""
        data = np.zeros((max(len(rows), 1), *self._data.shape[1:]), self._data.dtype)
        data[: len(rows)] = rows
        self._data, self._count = data, len(rows)

    @property
    def view(self) -> NDArray[Any]:
        """Return the rows without a copy."""
        return self._data[: self._count]

    def __len__(self) -> int:
        return self._count


@dataclass(frozen=True, slots=True)
class Keyframe:
    """A scan that is part of the map."""

    stamp: int
    """Stamp (ns)."""
    scan: Scan
    """Downsampled points in base."""
    cloud: Cloud
    """The same points with a hash for neighbour search."""


class EdgeList:
    """``Edges`` that grow."""

    def __init__(self) -> None:
        self._ends = GrowingArray(2, dtype=np.int64)
        self._measured = GrowingArray(3)
        self._information = GrowingArray(3, 3)
        self._spread = GrowingArray(2)
        self._loop = GrowingArray(dtype=bool)
        self._odometry = GrowingArray(dtype=bool)
        self.revision = 0
        """Number of changes so far."""

    def add(
        self,
        origin: int,
        target: int,
        measured: Array,
        information: Array,
        spread: tuple[float, float],
        *,
        loop: bool = False,
        odometry: bool = False,
    ) -> None:
        """Add an edge; ``spread`` are its variances (m^2, rad^2) in the bound of the drift."""
        self.revision += 1
        self._ends.append((origin, target))
        self._measured.append(measured)
        self._information.append(information)
        self._spread.append(spread)
        self._loop.append(loop)
        self._odometry.append(odometry)

    def keep(self, kept: NDArray[np.bool_] | slice) -> None:
        """Remove all edges but the marked ones."""
        self.revision += 1
        for rows in (self._ends, self._measured, self._information, self._spread, self._loop, self._odometry):
            rows.set(rows.view[kept])

    def loosen(self, kept: NDArray[np.bool_]) -> None:
        """Multiply the standard deviations of the marked edges by ``LOOSENED``."""
        self.revision += 1
        self._information.view[kept] /= LOOSENED**2
        self._spread.view[kept] *= LOOSENED**2

    def replace(self, edges: Edges, spread: Array, odometry: NDArray[np.bool_]) -> None:
        """Replace all edges."""
        self.revision += 1
        self._ends.set(np.stack((edges.origin, edges.target), axis=1))
        self._measured.set(edges.measured)
        self._information.set(edges.information)
        self._spread.set(spread)
        self._loop.set(edges.loop)
        self._odometry.set(odometry)

    def edges(self) -> Edges:
        """Views of all edges."""
        ends = self._ends.view
        return Edges(ends[:, 0], ends[:, 1], self._measured.view, self._information.view, self._loop.view)

    @property
    def spread(self) -> Array:
        """Shape (n, 2)."""
        return self._spread.view

    @property
    def odometry(self) -> NDArray[np.bool_]:
        """Shape (n,): whether the edge is from odometry."""
        return self._odometry.view

    def __len__(self) -> int:
        return len(self._ends)


class Trajectory:
    """Poses of all scans relative to keyframes, so that the whole trajectory moves with the graph.

    A scan that becomes a keyframe is stored twice: relative to the previous keyframe, and relative to itself.
    Optimisation may move one against the other. Their offset is distributed over the scans between them, so that the
    trajectory has no jumps at keyframes.

    Args:
        most: maximum number of scans stored; beyond it, every second one is dropped.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._stamps = GrowingArray(dtype=np.int64)
        self._keys = GrowingArray(dtype=np.int64)
        self._relative = GrowingArray(3)

    def append(self, stamp: int, key: int, relative: Array) -> None:
        """Add a scan."""
        self._stamps.append(stamp)
        self._keys.append(key)
        self._relative.append(relative)
        if len(self._stamps) > self._most:
            for rows in (self._stamps, self._keys, self._relative):
                rows.set(rows.view[::2])

    def reattach(self, since: int, keys: Array, key: int) -> None:
        """Attach scans from ``since`` (ns) to keyframe ``key``, at their poses by ``keys``, shape (n, 3)."""
        late = np.flatnonzero(self._stamps.view >= since)
        poses = compose(keys[self._keys.view[late]], self._relative.view[late])
        self._relative.view[late] = between(keys[key], poses)
        self._keys.view[late] = key

    def move(self, stand_in: NDArray[np.int64], offset: Array) -> None:
        """Replace keyframe k by ``stand_in[k]``, in whose frame it was at ``offset[k]``."""
        keys = self._keys.view
        self._relative.set(compose(offset[keys], self._relative.view))
        self._keys.set(stand_in[keys])

    def poses(self, keys: Array) -> tuple[NDArray[np.int64], Array]:
        """Return stamps (n,) and poses (n, 3) of all scans, given the poses of the keyframes."""
        stamps = self._stamps.view.copy()
        poses = compose(keys[self._keys.view], self._relative.view)
        joints = self._joints()
        apart = poses[joints + 1] - poses[joints]
        apart[:, 2] = wrap(apart[:, 2])
        begins = np.append(0, joints + 1)[: len(joints)]
        for begin, end, off in zip(begins, joints, apart, strict=True):
            share = (stamps[begin:end] - stamps[begin]) / max(stamps[end] - stamps[begin], 1)
            poses[begin:end] += share[:, None] * off
        return np.delete(stamps, joints), np.delete(poses, joints, axis=0)

    def at(self, stamps: NDArray[np.int64], keys: Array, joined: NDArray[np.bool_]) -> Array:
        """Return poses (n, 3) at any instants, interpolated between scans; NaN outside, and for submaps off the map.

        Args:
            stamps: (n,), ns.
            keys: poses of the keyframes.
            joined: which of them belong to the map.
        """
        mine = self._stamps.view
        found = np.full((len(stamps), 3), np.nan)
        if len(mine) < 2:
            return found
        before = np.clip(np.searchsorted(mine, stamps, side="right") - 1, 0, len(mine) - 2)
        known = joined[self._keys.view]
        inside = (stamps >= mine[0]) & (stamps <= mine[-1]) & known[before] & known[before + 1]
        before = before[inside]
        ends = [compose(keys[self._keys.view[rows]], self._relative.view[rows]) for rows in (before, before + 1)]
        share = (stamps[inside] - mine[before]) / np.maximum(mine[before + 1] - mine[before], 1)
        found[inside] = compose(ends[0], between(ends[0], ends[1]) * share[:, None])
        return found

    def marked(self, keys: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return marks of all scans, shape (n,), given the marks of the keyframes."""
        return np.asarray(np.delete(keys[self._keys.view], self._joints()))

    def _joints(self) -> NDArray[np.intp]:
        """Return rows of scans that became keyframes, relative to the previous keyframe."""
        stamps = self._stamps.view
        return np.flatnonzero(stamps[1:] == stamps[:-1])


Numbers = NDArray[np.intp]

LOOSENED: Final = 30.0
"""Factor on the standard deviation of an edge of odometry that the scans contradict."""
TURN_LEVER: Final = 0.7
"""Weight of one radian between two views (m)."""


@dataclass(frozen=True, slots=True, eq=False)
class Join:
    """Provisional join of two submaps."""

    own: int
    """Number of the robot's submap, to which later keyframes belong."""
    other: int
    """Number of the other submap."""
    others: Numbers
    """Keyframes of the other submap, in rising order."""
    since: int
    """Number of keyframes at the join."""


class _Drift(NamedTuple):
    """Drift bound against one keyframe, and its inputs."""

    poses: Array
    """Poses of the keyframes; every change replaces the array."""
    revision: int
    """Revision of the edges."""
    source: int
    bound: tuple[Array, Array]


class KeyframeMap:
    """Keyframes with their poses in map and the pose graph between them.

    Args:
        config: noise and limits.
    """

    def __init__(self, config: MapperConfig) -> None:
        self.config = config
        self.frames: list[Keyframe] = []
        self.poses: Array = np.zeros((0, 3))
        self.edges = EdgeList()
        self.part: NDArray[np.int64] = np.zeros(0, np.int64)
        """Submap of every keyframe, by the number of its first keyframe, shape (n,); 0 is the map."""
        self.doubtful: list[Join] = []
        """Joins, in their order, not yet confirmed by later observations."""
        self._drift: _Drift | None = None

    def __len__(self) -> int:
        return len(self.frames)

    def add(self, scan: Scan, stamp: int, pose: Array, *, apart: bool = False) -> None:
        """Add a keyframe, without edges; ``apart`` starts a submap that only loop closures may join to the rest."""
        self.part = np.append(self.part, len(self) if apart or not len(self) else self.part[-1])
        kept = scan.downsampled(self.config.key_cell, self.config.key_points)
        self.frames.append(Keyframe(stamp, kept, Cloud.of(kept)))
        self.poses = np.vstack((self.poses, pose))

    def place(self, at: int, pose: Array, part: int) -> None:
        """Align the submap of keyframe ``at`` with submap ``part``, in whose frame ``at`` is at ``pose``, shape (3,).

        The map itself never moves.
        """
        own = int(self.part[at])
        origin, target = (self.poses[at], pose) if own else (pose, self.poses[at])
        moved = self.part == (own or part)
        self.poses = self.poses.copy()
        self.poses[moved] = compose(target, between(origin, self.poses[moved]))

    def join(self, one: int, other: int) -> None:
        """Merge submaps ``one`` and ``other``, now related by edges; the join awaits confirmation."""
        own, other = (one, other) if one == self.part[-1] else (other, one)
        self.doubtful.append(Join(own, other, np.flatnonzero(self.part == other), len(self)))
        self.part[self.part == max(own, other)] = min(own, other)

    def sides(self, join: Join) -> tuple[Numbers, Numbers]:
        """Return the keyframes, rising, of both sides of a join in doubt: the robot's with later ones, and the other's.

        Keyframes of later joins belong to neither side.
        """
        later = self.doubtful[self.doubtful.index(join) :]
        apart = np.concatenate([each.others for each in later])
        return np.setdiff1d(np.flatnonzero(self.part == self.part[join.others[0]]), apart), join.others

    def separate(self, join: Join) -> None:
        """Undo a ``join`` in doubt, and later ones: no edge then relates the submaps they joined."""
        while join in self.doubtful:
            own, others = self.sides(self.doubtful[-1])
            last = self.doubtful.pop()
            self.part[own], self.part[others] = last.own, last.other
        edges = self.edges.edges()
        self.edges.keep(self.part[edges.origin] == self.part[edges.target])
        self.optimise()

    def joined(self) -> NDArray[np.bool_]:
        """Whether each keyframe belongs to the map, shape (n,)."""
        return np.asarray(self.part == 0)

    def add_odometry_edge(self, delta: Array, covariance: Array) -> None:
        """Add the edge between the last two keyframes."""
        new = len(self) - 1
        place, turn = deviations(covariance)
        information: Array = np.asarray(np.linalg.inv(covariance + 1e-6 * np.eye(3)), dtype=np.float64)
        self.edges.add(new - 1, new, delta, information, (place**2, turn**2), odometry=True)

    def loosen_odometry(self, since: int) -> None:
        """Loosen the edges of odometry to keyframes after ``since`` (ns)."""
        after = np.array([key.stamp for key in self.frames]) > since
        self.edges.loosen(self.edges.odometry & after[self.edges.edges().target])

    def add_scan_edges(self, local: Numbers) -> None:
        """Add edges from the latest keyframe to those of ``local`` that it overlaps, the nearest first."""
        new = len(self) - 1
        order = local[np.argsort(self._closeness(local, self.poses[new]), kind="stable")]
        linked = 0
        for other in (new - 1, *(int(k) for k in order if k != new - 1)):
            linked += self._link(other, new)
            if linked == self.config.neighbours:
                break

    def _link(self, origin: int, target: int) -> bool:
        """Register two keyframes from their current poses and add the edge; return False if they do not fit."""
        config = self.config
        guess = between(self.poses[origin], self.poses[target])
        fit = register(self.frames[target].scan, self.frames[origin].cloud, guess)
        off = between(guess, fit.pose)
        # Maximum correction of an edge between keyframes that were matched to one submap (m, rad).
        link_max_correction = (0.15, 0.1)
        far = math.hypot(off[0], off[1]) > link_max_correction[0] or abs(off[2]) > link_max_correction[1]
        link_overlap = 0.4
        link_pairs = 20
        if far or fit.overlap < link_overlap or fit.pairs < link_pairs:
            return False
        place = config.drift_distance[0] + config.drift_distance[1] * math.hypot(guess[0], guess[1])
        turn = config.drift_turn[0] + config.drift_turn[1] * abs(float(guess[2]))
        covariance: Array = np.asarray(np.linalg.inv(fit.information + np.eye(3)), dtype=np.float64)
        weakest, _ = deviations(covariance)
        link_floor = (0.005, 0.005, 0.002)  # minimum standard deviation of an edge between scans, m and rad
        information = np.linalg.inv(covariance + np.diag(np.square(link_floor)))
        spread = (place**2 + weakest**2, turn**2)
        recent = 5  # maximum distance in keyframes of neighbours in time: an edge between them is not a loop closure
        self.edges.add(origin, target, fit.pose, information, spread, loop=origin < target - recent)
        return True

    def drift(self, source: int) -> tuple[Array, Array]:
        """Return the bound of the drift against ``source``: covariances in its frame, and summed variances.

        The latest result is kept, because a step needs it several times.
        """
        known, revision = self._drift, self.edges.revision
        if known is None or known.poses is not self.poses or known[1:3] != (revision, source):
            bound = drift(self.poses, self.edges.edges(), self.edges.spread, source)
            known = self._drift = _Drift(self.poses, revision, source, bound)
        return known.bound

    def well_known(self, source: int) -> Numbers:
        """Return the numbers, rising, of the keyframes whose drift against ``source`` is below ``local_spread``."""
        _, far = self.drift(source)
        return np.asarray(np.flatnonzero(far <= self.config.local_spread**2))

    def around(self, source: int, most: int, reach: float | None = None) -> Numbers:
        """Return the numbers of the well-known keyframes near ``source``, nearest first."""
        near, centre = self.well_known(source), self.poses[source]
        off = self.poses[near, :2] - centre[:2]
        near = near[np.hypot(off[:, 0], off[:, 1]) <= (reach or self.config.local_reach)]
        order = np.argsort(self._closeness(near, centre), kind="stable")
        return np.asarray(near[order][:most])

    def local(self) -> Numbers:
        """Return the numbers, rising, of the keyframes of the submap around the latest one."""
        newest = len(self) - 1
        recent = np.flatnonzero(self.part == self.part[newest])[-3:]
        return np.union1d(self.around(newest, self.config.local_keys), recent)

    def submap(self, numbers: Numbers) -> Submap:
        """Return the numbered keyframes, merged in map."""
        return Submap(Cloud.of(merged([self.frames[k].scan for k in numbers], self.poses[numbers])))

    def optimise(self) -> None:
        """Optimise the pose graph; the first pose is fixed."""
        self.poses = optimise(self.poses, self.edges.edges())

    def refine(self) -> bool:
        """Register all keyframes jointly (seconds of work), if those far apart in time agree better afterwards.

        Returns:
            Whether the poses come from the joint registration; otherwise they come from the graph.
        """
        if len(self) < 2:
            return False
        edges = self.edges.edges()
        poses = refine(self.frames, self.poses, edges.chosen(self.edges.odometry), edges.chosen(edges.loop))
        pairs = witnesses(self.frames, self.poses, self.part)
        if agreement(self.frames, poses, pairs) <= agreement(self.frames, self.poses, pairs):
            return False
        self.poses = poses
        return True

    def prune(self) -> tuple[NDArray[np.bool_], NDArray[np.int64], Array]:
        """Remove redundant keyframes.

        Returns:
            Three arrays by former keyframe: whether it is kept (n,), the number of the keyframe that represents it
            (n,), and its pose in that keyframe's frame (n, 3).
        """
        gone, stand_in, edges, spread, odometry = pruned(
            self.poses, self.part, self.edges.edges(), self.edges.spread, self.edges.odometry, self.config.pruning
        )
        offset = between(self.poses[stand_in], self.poses)
        number = np.cumsum(~gone) - 1
        self.edges.replace(edges.renumbered(number), spread, odometry)
        self.frames = [key for key, left_out in zip(self.frames, gone.tolist(), strict=True) if not left_out]
        self.poses = self.poses[~gone]
        self.part = number[stand_in[self.part]][~gone]
        self.doubtful.clear()
        return ~gone, number[stand_in], offset

    def _closeness(self, numbers: Numbers, pose: Array) -> Array:
        off = between(pose, self.poses[numbers])
        return np.asarray(np.hypot(off[:, 0], off[:, 1]) + TURN_LEVER * np.abs(off[:, 2]))


def redundancy(poses: Array, part: NDArray[np.int64]) -> Array:
    """Return the distance (m) of every pose to the most similar view of its submap, shape (n,): small is redundant."""
    result = np.full(len(poses), np.inf)
    for k in range(1, len(poses)):
        off = between(poses[k], poses)
        distance = np.hypot(off[:, 0], off[:, 1]) + TURN_LEVER * np.abs(off[:, 2])
        distance[k] = np.inf
        distance[part != part[k]] = np.inf
        result[k] = distance.min()
    return result


def pruned(
    poses: Array,
    part: NDArray[np.int64],
    edges: Edges,
    spread: Array,
    odometry: NDArray[np.bool_],
    share: float,
) -> tuple[NDArray[np.bool_], NDArray[np.int64], Edges, Array, NDArray[np.bool_]]:
    """Select the most redundant ``share`` of the poses for removal: no two neighbours in the graph, never the first.

    Every edge of a removed pose is composed with that pose's most certain edge, and then attached to the neighbour at
    its other end: marginalisation along one edge.

    Returns:
        Marks of the removed poses (n,), the neighbour that represents each (itself if it stays) (n,), and the edges of
        the rest with their ``spread`` and ``odometry`` marks, in the old numbering.
    """
    count = len(poses)
    surest = np.linalg.det(edges.information)
    gone = np.zeros(count, bool)
    stand_in = np.arange(count)
    link = np.full(count, -1)
    touching: list[list[int]] = [[] for _ in range(count)]
    for k, (i, j) in enumerate(zip(edges.origin.tolist(), edges.target.tolist(), strict=True)):
        touching[i].append(k)
        touching[j].append(k)
    allowance = int(share * count)
    for node in np.argsort(redundancy(poses, part), kind="stable").tolist():
        if not allowance:
            break
        if node == 0 or node >= count - 60 or not touching[node]:  # the latest keyframes are never removed
            continue
        others = {int(edges.origin[k] + edges.target[k] - node) for k in touching[node]}
        if any(gone[other] for other in others):
            continue
        best = max(touching[node], key=lambda k: float(surest[k]))
        gone[node], link[node] = True, best
        stand_in[node] = int(edges.origin[best] + edges.target[best] - node)
        allowance -= 1
    return (gone, stand_in, *_handed_over(edges, spread, odometry, gone, stand_in, link))


def _handed_over(
    edges: Edges,
    spread: Array,
    odometry: NDArray[np.bool_],
    gone: NDArray[np.bool_],
    stand_in: NDArray[np.int64],
    link: NDArray[np.int64],
) -> tuple[Edges, Array, NDArray[np.bool_]]:
    origin, target = edges.origin.copy(), edges.target.copy()
    measured, information, spread = edges.measured.copy(), edges.information.copy(), spread.copy()
    for k in np.flatnonzero(gone[origin] | gone[target]).tolist():
        node = int(origin[k] if gone[origin[k]] else target[k])
        best = int(link[node])
        if k == best:
            continue
        far = int(origin[k] + target[k] - node)
        first, first_spread = _seen_from(edges, best, int(stand_in[node]))
        second, second_spread = _seen_from(edges, k, node)
        by_first, by_second = compose_jacobians(first, second)
        covariance = by_first @ first_spread @ by_first.T + by_second @ second_spread @ by_second.T
        origin[k], target[k] = stand_in[node], far
        measured[k], information[k] = compose(first, second), np.linalg.inv(covariance)
        spread[k] += spread[best]
    kept = (origin != target) & ~gone[origin] & ~gone[target]
    kept &= _surest(origin, target, odometry, np.linalg.det(information))
    moved = Edges(origin[kept], target[kept], measured[kept], information[kept], edges.loop[kept])
    return moved, spread[kept], odometry[kept]


def _surest(
    origin: NDArray[np.int64], target: NDArray[np.int64], odometry: NDArray[np.bool_], sureness: Array
) -> NDArray[np.bool_]:
    """Mark the most certain edge of each kind between two keyframes.

    Composed edges share an edge and are therefore correlated: together they would be overconfident, and their number
    would grow with the length of the run.
    """
    low, high = np.minimum(origin, target), np.maximum(origin, target)
    order = np.lexsort((-sureness, odometry, high, low))
    keys = np.stack((low, high, odometry))[:, order]
    first = np.ones(len(order), bool)
    first[1:] = (keys[:, 1:] != keys[:, :-1]).any(axis=0)
    result = np.zeros(len(order), bool)
    result[order[first]] = True
    return result


def _seen_from(edges: Edges, k: int, node: int) -> tuple[Array, Array]:
    """Return measurement and covariance of edge ``k`` with ``node`` as origin."""
    measured, covariance = edges.measured[k], np.linalg.inv(edges.information[k])
    if edges.origin[k] == node:
        return measured, covariance
    c, s = np.cos(measured[2]), np.sin(measured[2])
    back = inverse(measured)
    turn = -np.array(((c, s, -back[1]), (-s, c, back[0]), (0.0, 0.0, 1.0)))
    return back, turn @ covariance @ turn.T


REFINE_NEIGHBOURS: Final = 2
"""Number of preceding keyframes that each is always paired with."""
REFINE_PARTNERS: Final = 12
"""Maximum number of earlier keyframes that each is paired with."""
REFINE_REACH: Final = 4.5
"""Maximum distance of a partner (m); one radian between the views adds one metre."""
REFINE_OVERLAP: Final = 0.4


def partners(poses: Array) -> NDArray[np.int64]:
    """Return pairs (earlier, later), shape (n, 2): the two preceding keyframes, and the nearest of every stretch."""
    result: list[tuple[int, int]] = []
    steps = np.hypot(*np.diff(poses[:, :2], axis=0, prepend=poses[:1, :2]).T)
    # Minimum length of trajectory per partner keyframe, apart from the neighbours in time, m.
    refine_spacing = 1.0
    stretch = np.floor(np.cumsum(steps) / refine_spacing).astype(np.int64)
    for k in range(1, len(poses)):
        result += [(j, k) for j in range(max(k - REFINE_NEIGHBOURS, 0), k)]
        off = between(poses[k], poses[: max(k - REFINE_NEIGHBOURS, 0)])
        cost = np.hypot(off[:, 0], off[:, 1]) + np.abs(off[:, 2])
        near = np.flatnonzero(cost < REFINE_REACH)
        near = near[np.argsort(cost[near], kind="stable")]
        _, first = np.unique(stretch[near], return_index=True)
        result += [(int(j), k) for j in near[np.sort(first)][:REFINE_PARTNERS]]
    return np.array(result, dtype=np.int64).reshape(-1, 2)


def witnesses(keys: list[Keyframe], poses: Array, part: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return pairs (earlier, later), shape (n, 2), of one place at times far apart that are not ``partners``.

    The joint registration has no term for these pairs, so they can check it.
    """
    stamps = np.array([key.stamp for key in keys])
    witness_pause = 60.0  # seconds between two views of a place that are used to check the joint registration
    pause = min(witness_pause * SECOND, 0.25 * float(stamps[-1] - stamps[0]))  # the same as a share of a shorter run
    used = {(i, j) for i, j in partners(poses).tolist()}
    result: list[tuple[int, int]] = []
    for k in range(1, len(poses)):
        before = np.flatnonzero((stamps[:k] <= stamps[k] - pause) & (part[:k] == part[k]))
        off = between(poses[k], poses[before])
        near = before[np.hypot(off[:, 0], off[:, 1]) + np.abs(off[:, 2]) < REFINE_REACH]
        near = near[np.linspace(0, len(near) - 1, min(len(near), REFINE_PARTNERS)).astype(np.intp)]
        others = [int(j) for j in near if (int(j), k) not in used]
        result += [(j, k) for j in others if _share(keys, poses, j, k) > REFINE_OVERLAP]
    # Maximum number of pairs that check it, evenly chosen.
    chosen = np.linspace(0, len(result) - 1, min(len(result), 1500)).astype(np.intp)
    return np.array(result, dtype=np.int64).reshape(-1, 2)[chosen]


def agreement(keys: list[Keyframe], poses: Array, pairs: NDArray[np.int64]) -> float:
    """Return the sum over ``pairs`` of the share of points within 5 cm of the other scan's surfaces."""
    witness_reach = 0.05  # distance within which a point agrees with the other scan, m
    return float(sum(_share(keys, poses, i, j, witness_reach) for i, j in pairs.tolist()))


def _share(keys: list[Keyframe], poses: Array, i: int, j: int, reach: float = CELL) -> float:
    """Return the share of the points of keyframe ``j`` with a partner in ``i`` nearer than ``reach`` (m)."""
    _, _, found = normal_equations(keys[j].scan, keys[i].cloud, between(poses[i], poses[j]), reach)
    return found / max(len(keys[j].scan), 1)


def refine(keys: list[Keyframe], poses: Array, steady: Edges, loops: Edges, rounds: int = 8) -> Array:
    """Return the poses, shape (n, 3), at which all scans fit each other best.

    Args:
        keys: keyframes.
        poses: current poses, shape (n, 3).
        steady: edges that are always used (odometry).
        loops: edges of loop closures, used unless a registered pair replaces them: two views of one place from opposite
            sides overlap too little for a pair.
        rounds: maximum number of rounds.
    """
    pairs = partners(poses)
    part = parts(steady.joined(loops), len(poses))
    pairs = pairs[part[pairs[:, 0]] == part[pairs[:, 1]]]
    for turn in range(rounds):
        reach = CELL if turn < rounds // 2 else CELL / 2
        pair_edges = _linearised(keys, poses, pairs, reach)
        missed = loops.chosen(~_covered(loops, pair_edges))
        moved = optimise(poses, steady.joined(missed).joined(pair_edges), iterations=3)
        change = float(np.abs(between(poses, moved)[:, :2]).max())
        poses = moved
        if change < 5e-4 and reach < CELL:
            break
    return poses


def _covered(loops: Edges, pair_edges: Edges) -> NDArray[np.bool_]:
    """Whether each of ``loops`` has a registered pair within about four keyframes of both ends."""
    known = np.unique(_stretches(pair_edges.origin, pair_edges.target, 0, 0))
    result = np.zeros(len(loops), bool)
    for i, j in itertools.product((-1, 0, 1), repeat=2):
        result |= np.isin(_stretches(loops.origin, loops.target, i, j), known)
    return result


def _stretches(origin: NDArray[np.int64], target: NDArray[np.int64], i: int, j: int) -> NDArray[np.int64]:
    """Return one number for the two stretches that an edge joins, shifted by ``i`` and ``j``."""
    refine_stretch = 4  # keyframes within which a registered pair replaces the edge of a loop closure
    return np.asarray((origin // refine_stretch + i) * (1 << 32) + target // refine_stretch + j)


def _linearised(keys: list[Keyframe], poses: Array, pairs: NDArray[np.int64], reach: float) -> Edges:
    """Return one edge per overlapping pair: pose after a Gauss-Newton step, and information."""
    places = between(poses[pairs[:, 0]], poses[pairs[:, 1]])
    measured, information, kept = np.zeros((len(pairs), 3)), np.zeros((len(pairs), 3, 3)), np.zeros(len(pairs), bool)
    for k, (i, j) in enumerate(pairs.tolist()):
        h, g, found = normal_equations(keys[j].scan, keys[i].cloud, places[k], reach)
        if found < REFINE_OVERLAP * len(keys[j].scan):
            continue
        step = -np.linalg.solve(h + np.diag((1.0, 1.0, 1.0)), g)
        refine_max_step = 0.2  # maximum Gauss-Newton step (m) of a pair that is used in this round
        if np.hypot(step[0], step[1]) > refine_max_step:
            continue
        measured[k], information[k], kept[k] = places[k] + step, h, True
    measured[:, 2] = wrap(measured[:, 2])
    return Edges(pairs[:, 0], pairs[:, 1], measured, information, pairs[:, 1] - pairs[:, 0] > REFINE_NEIGHBOURS).chosen(
        kept
    )
