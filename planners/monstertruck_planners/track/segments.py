"""A path prepared for tracking: runs of one direction, all crab or none of it, measured by arc length.

Progress only increases and is searched near its current value, so a path may cross or repeat itself.
"""

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final, NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.pose_path import PosePath, stops
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.plan import MAX_COORDINATE, MAX_POSES, MAX_RUNS, Path, Steering
from monstertruck_schemas.reasons import Reason

LEAST_STEP: Final = 1e-6
"""Minimum step between two poses (m); shorter steps are dropped."""

MAX_NAME: Final = 128
MANY: Final = 40
"""Number of steps above which arrays find the nearest step faster than floats."""


@dataclass(frozen=True, slots=True)
class PathProgress:
    """Position on a segmented path."""

    run: int = 0
    """Index of the run."""
    s: float = 0.0
    """Distance from the run's start (m)."""
    outcome: Reason = Reason.DRIVING
    """Outcome at the end of the path, once judged."""


class Projection(NamedTuple):
    """Point of a run closest to the truck."""

    s: float
    point: tuple[float, float]
    tangent: float
    """Direction of travel there (rad)."""


class PathRun:
    """Part of a path driven without a stop, with a straight or given extension past its end.

    Args:
        points: points, shape (n, 2), n >= 2 (m); from index ``last`` on they are the extension.
        last: index of the run's own last point.
        direction: +1 forward, -1 backward.
        before: total length of the previous runs (m).
        yaws: yaws at the run's points, shape (last + 1,) (rad).
        steering: steering mode of each step of the run, or empty.
        lap: whether the extension is the start of the same path.
        clearance: clearance between footprint and obstacles at the end (m).
        speeds: maximum speeds at the run's points, shape (last + 1,) (m/s); None without limits on the path.
    """

    def __init__(
        self,
        points: Array,
        last: int,
        direction: float,
        before: float,
        yaws: Array | None = None,
        steering: tuple[Steering, ...] = (),
        *,
        lap: bool = False,
        clearance: float = math.inf,
        speeds: Array | None = None,
    ) -> None:
        steps = np.diff(points, axis=0)
        lengths, tangents = np.hypot(steps[:, 0], steps[:, 1]), np.arctan2(steps[:, 1], steps[:, 0])
        self._points = points
        self._s = np.concatenate(([0.0], np.cumsum(lengths)))
        self._steps = np.column_stack((points[:-1], steps, lengths, self._s[:-1], tangents))
        self.direction = direction
        self.before = before
        self.length = float(self._s[last])
        self.end = float(self._s[-1]) if lap else self.length
        """Length that belongs to the path (m)."""
        self.yaws = np.zeros(last + 1) if yaws is None else yaws
        self.steering = steering
        self.clearance = clearance
        self._speeds = speeds

    @property
    def vertices(self) -> Array:
        """Distance from the start to each point of the run (m)."""
        return self._s[: len(self.yaws)]

    def points(self, s: Array) -> Array:
        """Return the points at ``s`` m, shape (m, 2)."""
        x, y = self._points.T
        return np.column_stack((np.interp(s, self._s, x), np.interp(s, self._s, y)))

    def speeds(self, s: Array) -> Array:
        """Return the path's speed limits at ``s`` m (m/s); +inf without limits."""
        if self._speeds is None:
            return np.full(len(s), math.inf)
        return np.interp(np.remainder(s, self.length) if self.end > self.length else s, self.vertices, self._speeds)

    def at(self, s: float) -> Projection:
        """Return the point at ``s`` m."""
        i = min(max(int(self._s.searchsorted(s, "right")) - 1, 0), len(self._steps) - 1)
        x, y, dx, dy, length, begin, tangent = self._steps[i].tolist()
        share = (s - begin) / length
        return Projection(s, (x + share * dx, y + share * dy), tangent)

    def project(self, x: float, y: float, low: float, high: float) -> Projection:
        """Return the nearest point between ``low`` and ``high`` m."""
        first = max(int(self._s.searchsorted(low, "right")) - 1, 0)
        end = max(int(self._s.searchsorted(high, "left")), first + 1)
        steps = self._steps[first:end]
        if len(steps) > MANY:
            steps = steps[_nearest_step(steps, x, y, low, high)]
        best, nearest = math.inf, (0.0, x, y, 0.0)
        for px, py, dx, dy, length, begin, tangent in steps.tolist():
            along = ((x - px) * dx + (y - py) * dy) / length
            along = 0.0 if along < 0.0 else min(along, length)
            s = min(max(begin + along, low), high)
            share = (s - begin) / length
            fx, fy = px + share * dx, py + share * dy
            gap = math.hypot(fx - x, fy - y)
            if gap < best:
                best, nearest = gap, (s, fx, fy, tangent)
        return Projection(nearest[0], nearest[1:3], nearest[3])


def _nearest_step(steps: Array, x: float, y: float, low: float, high: float) -> list[int]:
    """Return the index of the step nearest to the point, as a list of one, for runs of many steps."""
    px, py, dx, dy, length, begin, _ = steps.T
    along = np.minimum(np.maximum(((x - px) * dx + (y - py) * dy) / length, 0.0), length)
    share = (np.minimum(np.maximum(begin + along, low), high) - begin) / length
    return [int(np.argmin(np.hypot(px + share * dx - x, py + share * dy - y)))]


class SegmentedPath:
    """Whole path, to be driven from its vertex nearest to the start pose.

    A closed path is driven once around from there, an open path to its end.

    Args:
        path: poses and directions.
        start: pose (x, y, yaw) of the truck in the path's frame.
        beyond: length of the extension at each end (m), at least the look-ahead.

    Raises:
        InputError: see ``check_path``.
    """

    def __init__(self, path: Path, start: tuple[float, float, float], beyond: float) -> None:
        check_path(path)
        vertices = PosePath.of(path)
        vertices = _distinct(_lap(vertices) if path.closed else vertices, path)
        first = _nearest(vertices.poses[:, :2], vertices.directions[1:], start, closed=path.closed)
        if path.closed:
            vertices = _distinct(_rolled(vertices, first), path)
            first = 0
        self.name = path.name
        self.frame = path.frame
        self.closed = path.closed
        self.runs = _runs(vertices, beyond, closed=path.closed)
        self.length = sum(run.length for run in self.runs)
        self.start = self._progress_of(vertices.poses[:, :2], first)

    def along(self, progress: PathProgress) -> float:
        """Return the distance from the start of the path (m)."""
        return self.runs[progress.run].before + progress.s

    def ahead(self, progress: PathProgress, horizon: float, count: int) -> Array:
        """Return the truck poses along the next ``horizon`` m of the current run, shape (count, 3)."""
        run = self.runs[progress.run]
        turned = 0.0 if run.direction > 0 else math.pi
        projections = [run.at(progress.s + horizon * i / (count - 1)) for i in range(count)]
        return np.array([(*nearest.point, nearest.tangent + turned) for nearest in projections])

    def _progress_of(self, points: Array, vertex: int) -> PathProgress:
        steps = np.diff(points[: vertex + 1], axis=0)
        along = float(np.hypot(steps[:, 0], steps[:, 1]).sum())
        i = max(i for i, run in enumerate(self.runs) if run.before <= along)
        return PathProgress(i, along - self.runs[i].before)


def check_path(path: Path) -> None:
    """Reject untrackable paths: paths come from files and from outside.

    Raises:
        InputError: shape, size or numbers are out of bounds; the message gives the expected values.
    """
    if len(path.poses) % 3 or not 2 <= len(path.poses) // 3 <= MAX_POSES:
        _refuse(path, f"{len(path.poses)} numbers: expected 2 to {MAX_POSES} rows of x, y, yaw")
    poses = path.poses.reshape(-1, 3)
    count = len(poses)
    if len(path.directions) not in (0, count) or not (np.abs(path.directions) == 1.0).all():
        _refuse(path, f"directions: expected +1 or -1 for each of the {count} poses, or none at all")
    if len(path.steering) not in (0, count):
        _refuse(path, f"{len(path.steering)} steering modes: expected one for each of the {count} poses, or none")
    if len(path.clearance) not in (0, count) or np.isnan(path.clearance).any():
        _refuse(path, f"{len(path.clearance)} clearances: expected a number for each of the {count} poses, or none")
    if len(path.speeds) not in (0, count) or not (np.isfinite(path.speeds) & (path.speeds >= 0.0)).all():
        _refuse(path, f"{len(path.speeds)} speeds: expected one, at least 0, for each of the {count} poses, or none")
    if np.count_nonzero(stops(path.directions[1:], path.steering[1:])) >= MAX_RUNS:
        _refuse(path, f"direction or crab changes too often: expected at most {MAX_RUNS} runs")
    if not np.isfinite(poses).all() or np.abs(poses).max() > MAX_COORDINATE:
        _refuse(path, f"poses: expected finite ones, at most {MAX_COORDINATE:g} m and rad")
    step = np.diff(poses[:, :2], axis=0, append=poses[:1, :2] if path.closed else poses[-1:, :2])
    length = np.hypot(step[:, 0], step[:, 1])
    max_step = 100.0  # maximum distance between two poses, m
    if not LEAST_STEP < length.max() <= max_step:
        _refuse(path, f"steps of up to {length.max():g} m: expected different poses, at most {max_step:g} m apart")
    if len(path.name) > MAX_NAME:
        _refuse(path, f"name: expected at most {MAX_NAME} characters")


def _refuse(path: Path, text: str) -> NoReturn:
    raise InputError(f"path {path.name[:MAX_NAME]!r}: {text}")


def _lap(path: PosePath) -> PosePath:
    """Return a closed path that ends at its start."""
    return path.at(np.append(np.arange(len(path.poses)), 0))


def _distinct(vertices: PosePath, path: Path) -> PosePath:
    """Drop points less than ``LEAST_STEP`` from the previously kept point; make yaws continuous.

    Raises:
        InputError: only one point is left.
    """
    points, kept = vertices.poses[:, :2], np.arange(len(vertices.poses))
    while True:
        step = np.diff(points[kept], axis=0)
        real = np.hypot(step[:, 0], step[:, 1]) > LEAST_STEP
        if real.all():
            break
        kept = kept[np.concatenate(([True], real))]
    if len(kept) < 2:
        _refuse(path, "expected different poses, all are at one position")
    found = vertices.at(kept)
    return replace(found, poses=np.column_stack((found.poses[:, :2], np.unwrap(found.poses[:, 2]))))


def _rolled(lap: PosePath, first: int) -> PosePath:
    """Return a closed path that starts at another vertex."""
    last = len(lap.poses) - 1
    begin, rest = np.arange(first, last), np.arange(1, first + 1)
    arriving = lap.at(np.concatenate((begin, [last], rest)))
    places = lap.at(np.concatenate((begin, [0], rest)))
    return replace(places, directions=arriving.directions, steering=arriving.steering)


def _nearest(points: Array, directions: Array, start: tuple[float, float, float], *, closed: bool) -> int:
    """Return the start vertex: the nearest; of equally near ones, the first with the truck's heading."""
    step = np.diff(points, axis=0)
    tangents = np.arctan2(step[:, 1], step[:, 0]) + np.where(directions > 0, 0.0, math.pi)
    distance = np.hypot(points[:, 0] - start[0], points[:, 1] - start[1])
    headings = tangents if closed else np.append(tangents, tangents[-1])
    distance = distance[: len(headings)]
    # 0.1: vertices this much further than the nearest one count as equally near when a start is chosen, m
    near = np.flatnonzero(distance <= distance.min() + 0.1)
    turned = np.abs(np.remainder(headings[near] - start[2] + math.pi, math.tau) - math.pi)
    headed = near[turned <= turned.min() + 0.3]  # headings this close count as equal when a start is chosen, rad
    # Neighbours of the nearest vertex are near, too: of each such group the nearest one counts.
    groups = np.split(headed, np.flatnonzero(np.diff(headed) > 1) + 1)
    return int(groups[0][np.argmin(distance[groups[0]])])


def _runs(path: PosePath, beyond: float, *, closed: bool) -> tuple[PathRun, ...]:
    points = path.poses[:, :2]
    cuts = [0, *path.stops.tolist(), len(points) - 1]
    lap = closed and len(cuts) == 2
    runs: list[PathRun] = []
    before = 0.0
    for begin, end in pairwise(cuts):
        own = points[begin : end + 1]
        if lap:
            extension = own[1 : 1 + _reach(own, beyond)]
        else:
            way = own[-1] - own[-2]
            extension = own[-1:] + beyond * way / np.hypot(*way)
        run = PathRun(
            np.concatenate((own, extension)),
            end - begin,
            float(path.directions[end]),
            before,
            path.poses[begin : end + 1, 2],
            path.steering[begin + 1 : end + 1],
            lap=lap,
            clearance=math.inf if path.clearance is None else float(path.clearance[end]),
            speeds=None if path.speeds is None else path.speeds[begin : end + 1],
        )
        runs.append(run)
        before += run.length
    return tuple(runs)


def _reach(points: Array, beyond: float) -> int:
    """Return the number of steps from the start that cover ``beyond`` m, or all."""
    step = np.diff(points, axis=0)
    travelled = np.cumsum(np.hypot(step[:, 0], step[:, 1]))
    return int(np.searchsorted(travelled, beyond)) + 1


PATH_GRID: Final = 0.025
"""Spacing of the reference, and half the chord for computing a heading (m)."""
QUANTILES: Final = -np.log1p(-(np.arange(16) + 0.5) / 16)
"""Quantiles of the exponential distribution: a mean over them is a first-order lag."""


class ReferenceStates(NamedTuple):
    """Values at positions on a run, arrays of equal shape."""

    heading: Array
    """Direction of the body-forward motion (rad): the path tangent, reversed when driving backwards."""
    yaw: Array
    """Yaw of the body (rad)."""
    slip: Array
    """Heading minus yaw: sideslip at C (rad)."""
    turn: Array
    """Yaw per distance of forward motion (1/m)."""
    curvature: Array
    """Path curvature in the direction of travel (1/m)."""


class ReferenceState(NamedTuple):
    """``ReferenceStates`` at one position."""

    heading: float
    yaw: float
    slip: float
    turn: float
    curvature: float


class RunStates:
    """Reference states of a tracker along one run.

    Args:
        run: part of a path.
        geometry: geometry of the truck.
        steering: steering mode where the run specifies none.
    """

    def __init__(self, run: PathRun, geometry: FourWheelSteering, steering: Steering) -> None:
        self._segment = run
        self._default: Steering = steering
        count = min(max(math.ceil(run.end / PATH_GRID), 4), 5000) + 1  # maximum number of reference points of a run
        self._s = np.linspace(0.0, run.end, count)
        tangent, curvature = _tangents(run, self._s)
        heading = tangent if run.direction > 0 else tangent + math.pi
        self.given = bool(run.steering)
        names: list[Steering] = sorted(set(run.steering)) if self.given else [steering]
        number = {mode: i for i, mode in enumerate(names)}
        modes = np.array([number[mode] for mode in run.steering] if self.given else [0])
        self._changes = run.vertices[np.flatnonzero(np.diff(modes)) + 1]
        modes = modes[self._step_at(self._s)] if self.given else np.zeros(count, np.intp)
        yaw, turn = heading.copy(), run.direction * curvature
        for mode in names:
            where = modes == number[mode]
            if self.given and mode in ("crab", "hybrid"):
                own = np.interp(self._s, run.vertices, run.yaws)
                yaw[where] = own[where]
                turn[where] = (run.direction * np.gradient(own, self._s))[where]
            elif mode != "crab":
                lagged, bend = self._lagged(heading, curvature, _slip_free(mode, geometry))
                yaw[where], turn[where] = lagged[where], bend[where]
        slip = np.remainder(heading - yaw + math.pi, math.tau) - math.pi
        self._table = ReferenceStates(heading, yaw, slip, turn, curvature)
        self._rows = np.column_stack((self._s, *self._table))
        side = np.tan(slip)
        lever = turn / np.cos(slip)
        self._axles = np.arctan([side + geometry.l_f * lever, side - geometry.l_r * lever])

    @property
    def places(self) -> Array:
        """Reference positions, as distance from the start of the run (m): from 0 to the end of the extension."""
        return self._s

    def steering(self, s: float) -> Steering:
        """Return the steering mode at ``s`` m; a crabbing path sets the yaws: axle angles may differ to keep them."""
        return self._modes(np.array([s]))[0] if self.given else self._default

    def has_yaw(self, s: float) -> bool:
        """Whether the path prescribes the body yaw at ``s`` m: not where the tracker chose to crab."""
        return self.steering(s) != "crab"

    def steerings(self, s: Array) -> list[Steering]:
        """Return the steering mode at each of the positions ``s`` (m)."""
        return self._modes(s) if self.given else [self._default] * len(s)

    def at(self, s: Array) -> ReferenceStates:
        """Return the values at ``s`` m, clamped to the ends of the run."""
        return ReferenceStates(*(np.asarray(np.interp(s, self._s, column)) for column in self._table))

    def state(self, s: float) -> ReferenceState:
        """Return the values at one place, clamped to the ends of the run."""
        last = len(self._rows) - 1
        i = int(self._s.searchsorted(s, "right")) - 1
        if not 0 <= i < last:
            return ReferenceState(*self._rows[min(max(i, 0), last)].tolist()[1:])
        (begin, *here), (end, *there) = self._rows[i : i + 2].tolist()
        width, past = end - begin, s - begin
        return ReferenceState(*[(b - a) / width * past + a for a, b in zip(here, there, strict=True)])

    def axle_change(self, ahead: float) -> Array:
        """Return the larger of both axles' required turns in the ``ahead`` m after each position (rad)."""
        change = [np.abs(np.interp(self._s + ahead, self._s, axle) - axle) for axle in self._axles]
        return np.asarray(np.maximum(*change))

    def section_end(self, s: float) -> float:
        """Return the position of the next steering change (m), else the end of the extension."""
        i = int(self._changes.searchsorted(s, "right"))
        return float(self._changes[i]) if i < len(self._changes) else self._segment.end

    def _modes(self, s: Array) -> list[Steering]:
        modes = [self._segment.steering[i] for i in self._step_at(s).tolist()]
        return ["hybrid" if mode == "crab" else mode for mode in modes]

    def _step_at(self, s: Array) -> NDArray[np.intp]:
        """Return the index of the run's step at each position."""
        run = self._segment
        index = np.searchsorted(run.vertices, np.remainder(s, run.length) if run.end > run.length else s, side="right")
        return np.clip(index - 1, 0, len(run.steering) - 1)

    def _lagged(self, heading: Array, curvature: Array, a: float) -> tuple[Array, Array]:
        """Return yaw and turn of a body without sideslip at its point ``a``."""
        direction = self._segment.direction
        if abs(a) < 1e-9:
            return heading, direction * curvature
        back = math.copysign(abs(a), -a * direction)
        yaw, turn = np.zeros_like(heading), np.zeros_like(heading)
        for quantile in QUANTILES.tolist():
            s = self._s - back * quantile
            inside = np.clip(s, 0.0, self._s[-1])
            bend = np.interp(inside, self._s, curvature)
            yaw += np.interp(inside, self._s, heading) + bend * (s - inside)
            turn += bend
        slip = np.arcsin(np.clip(heading - yaw / len(QUANTILES), -1.0, 1.0))
        return heading - slip, direction * turn / len(QUANTILES)


def _slip_free(mode: Steering, geometry: FourWheelSteering) -> float:
    """Return x of the point that never slips sideways (m)."""
    if mode == "front":
        return -geometry.l_r
    return geometry.l_f if mode == "rear" else 0.5 * (geometry.l_f - geometry.l_r)


def _tangents(run: PathRun, s: Array) -> tuple[Array, Array]:
    """Return tangent (continuous) and curvature from chords."""
    half = min(PATH_GRID, run.end / 4)
    at = np.clip(s, half, run.end - half)
    tangent = np.unwrap(_chord(run, at - half, at + half))
    middle = np.clip(s, 2 * half, run.end - 2 * half)
    change = _chord(run, middle, middle + 2 * half) - _chord(run, middle - 2 * half, middle)
    curvature = (np.remainder(change + math.pi, math.tau) - math.pi) / (2 * half)
    return tangent + curvature * (s - at), curvature


def _chord(run: PathRun, begin: Array, end: Array) -> Array:
    x, y = (run.points(end) - run.points(begin)).T
    return np.asarray(np.arctan2(y, x))
