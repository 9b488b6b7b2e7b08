"""Poses of the sonars, their cone angle, and the speed of sound, from arcs next to a flat wall.

A wall reflects the sound along its normal. A range is the sonar's distance from the wall while the normal lies within
the cone; beyond that, the edge of the cone meets the wall at a slightly larger range. Arcs in both directions sweep
every sonar past the wall and move it towards and away from the wall. So they determine the pose of the sonar, the edges
of its cone and, together with one taped distance, the speed of sound. A single circle would not suffice: rotating all
poses about its centre has the same effect as rotating the wall.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from monstertruck_drivers.srf08.config import Srf08Config
from monstertruck_kinematics.chassis import Chassis, TruckChassis
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.fitting import FitResult, least_squares
from monstertruck_kinematics.se2 import wrap
from monstertruck_runtime.errors import InputError, RequestRefusedError
from monstertruck_schemas import topics
from monstertruck_schemas.reasons import Reason
from monstertruckd.config.calibration import Result, WizardName
from monstertruckd.config.wizards import SONAR, TURN_IN_A_METRE
from monstertruckd.tools.calibrate.assumed import ASSUMED
from monstertruckd.tools.calibrate.statistics import Interval, estimated, known_errors, mean_angle
from monstertruckd.tools.calibrate.steps import Confirm, MoveRecord, MoveStep, Number, Plot
from monstertruckd.tools.calibrate.wizard import CLEAR, WizardContext

ROOM: Final = (
    "a flat wall 5 m long, as high as the sonars' cones reach, 1.7 m to the robot's left; no other "
    "object within 2 m in front, behind and to the right of the robot"
)
FIRST_RANGE_ERROR: Final = 0.2
"""Maximum error of a range to the wall before the fit, m."""
BEYOND: Final = 0.3
"""Maximum angle beyond the edge of the cone at which a sonar still receives the wall, rad: grazing sound is reflected
away.
"""
LEAST_ECHOES: Final = 12
"""Minimum number of echoes per sonar for the fit of its pose."""
COMMON: Final = 5
"""Parameters common to all arcs: distance and direction of the wall, half the cone angle, factors of ranges and of the
odometry distance.
"""

_PARK: Final = Confirm(
    "park", "Place the robot parallel to the wall, the wall 1.7 m to its left and the robot halfway along it. Done?"
)
_WALL: Final = Number("wall", "Distance from the wall to the middle of the robot's left side, m", 0.3, 3.0)


class SonarPose(NamedTuple):
    """Pose of one sonar on the body, or one pose for each echo (n,); m and rad."""

    x: float | Array
    y: float | Array
    yaw: float | Array


@dataclass(frozen=True, slots=True)
class SonarLeg:
    """One arc: robot poses at every ping, and the ranges."""

    poses: Mapping[str, Array]
    """Poses by sonar, (n, 3): x, y (m) and yaw (rad) in the frame of the robot as it was parked"""
    ranges: Mapping[str, Array]
    """Ranges by sonar, (n,), m; inf without an echo"""

    @classmethod
    def of(cls, record: MoveRecord, origin: tuple[float, float, float]) -> "SonarLeg":
        """Create an arc from a move.

        Args:
            record: record with odometry and sonars.
            origin: odometry pose of the parked robot: x, y (m) and yaw (rad).

        Raises:
            InputError: there is no odometry.
        """
        odometry = record.of(topics.ODOMETRY)
        if len(odometry) < 2:
            raise InputError("no odometry was received while the robot moved")
        stamps = np.array([o.stamp for o in odometry], dtype=np.float64)
        x = np.array([o.pose.x for o in odometry]) - origin[0]
        y = np.array([o.pose.y for o in odometry]) - origin[1]
        yaw = np.unwrap([o.pose.yaw for o in odometry]) - origin[2]
        c, s = math.cos(origin[2]), math.sin(origin[2])
        track = (c * x + s * y, c * y - s * x, yaw)
        rows: dict[str, list[tuple[float, float]]] = {}
        for message in record.of(topics.SONAR):
            for echo in message.sonars:
                if echo.answered and stamps[0] <= echo.stamp <= stamps[-1]:
                    distance = math.inf if echo.range is None else echo.range
                    rows.setdefault(echo.name, []).append((float(echo.stamp), distance))
        poses, ranges = {}, {}
        for name, found in rows.items():
            times, distances = np.array(found).T
            poses[name] = np.column_stack([np.interp(times, stamps, values) for values in track])
            ranges[name] = distances
        return cls(poses, ranges)


@dataclass(frozen=True, slots=True)
class SonarWizard:
    """Wizard that drives an arc in each direction, forward and back, next to a wall."""

    name: ClassVar[WizardName] = "sonar"
    doc: ClassVar[str] = "poses and cone angles of the sonars, and the speed of sound, from arcs along a wall"
    room: ClassVar[str] = ROOM
    turn: float = 2 * math.pi
    """Angle of each arc, rad"""
    tape_error: float = 0.002
    """Standard deviation of the taped distance, m"""
    speed: float = 0.12

    async def __call__(self, context: WizardContext) -> Result:
        """Measure."""
        config = context.config
        device = config.devices.sonar
        if device is None or not isinstance(device.driver, Srf08Config):
            raise RequestRefusedError(Reason.NOT_SUPPORTED, "this robot has no sonar array with configured mounts")
        if config.body.kind not in TURN_IN_A_METRE:
            raise RequestRefusedError(Reason.NOT_SUPPORTED, f"body {config.body.kind}: its smallest arcs are too wide")
        settings = device.driver
        await context.confirm(_PARK)
        wall = await context.ask(_WALL) + config.geometry.width / 2
        await context.confirm(CLEAR)
        front, rear, radius = arc(context.chassis, context.config.gate.angle)
        records = []
        for side, name in ((1, "left"), (-1, "right")):
            for direction in (1, -1):
                move = MoveStep(
                    f"an arc to the {name}, {'ahead' if direction > 0 else 'back'}",
                    direction * min(self.speed, config.gate.speed if direction > 0 else config.gate.reverse_speed),
                    side * front,
                    side * rear,
                    2.0 * self.turn * radius,
                    done=lambda record: abs(_turned(record)) >= self.turn,
                    also=(topics.SONAR, topics.ODOMETRY),
                )
                records.append(await context.move(move))
        origin = _start(records[0])
        legs = [SonarLeg.of(record, origin) for record in records]
        echoes = np.vstack(
            [
                np.column_stack((np.degrees(leg.poses[name][:, 2]), ranges))[np.isfinite(ranges)]
                for leg in legs
                for name, ranges in leg.ranges.items()
            ]
            or [np.empty((0, 2))]
        )
        context.plot(Plot("echoes of the arcs", "heading of the robot (deg)", "range (m)", echoes))
        return context.fit("places and cones", lambda: result_of(legs, settings, wall, self.tape_error))


def result_of(legs: Sequence[SonarLeg], settings: Srf08Config, wall: float, tape_error: float) -> Result:
    """Fit the parameters and check them.

    Args:
        legs: driven arcs; the first starts where the robot was parked.
        settings: sonar settings used by the daemon.
        wall: taped distance between the wall and the robot's middle (m).
        tape_error: standard deviation of ``wall`` (m).

    Raises:
        InputError: arcs were driven in only one direction, there are too few echoes, or sonars are swapped.
    """
    headings = np.concatenate([p[:, 2] for leg in legs for p in leg.poses.values()] or [np.zeros(1)])
    span = 1.0  # minimum turn in each direction, rad
    if headings.max() < span or headings.min() > -span:
        raise InputError(f"expected arcs of at least {span:g} rad in both directions, with echoes on the sonars")
    places = {n: SonarPose(*s.mount.planar) for n, s in settings.sonars.items()}
    _check_places(legs, places, wall, settings.field_of_view / 2)
    model = SonarModel(legs, settings, wall, tape_error)
    fit = model.fit()
    halves = known_errors(fit, model.kept.ranges.size - fit.parameters.size)
    if not np.isfinite(halves).all():
        raise InputError("the arcs do not determine the sonars' poses: one result is outside the permitted range")
    found = [Interval(float(v), float(h)) for v, h in zip(fit.parameters, halves, strict=True)]
    count, noise = model.kept.ranges.size, "95 % interval from ranges, odometry and tape"
    sound = found[3].times(settings.speed_of_sound)
    estimates = [
        estimated("cone", found[2].times(2.0), "rad", count, f"full opening angle, assuming hard edges; {noise}",
                  f"{SONAR}.field_of_view"),
        estimated("speed_of_sound", sound, "m/s", count, f"offset at which the wall is at the taped distance; {noise}",
                  f"{SONAR}.speed_of_sound"),
    ]  # fmt: skip
    meanings = {"x": "ahead of the robot's middle", "y": "to the left of it", "yaw": "of its axis, left positive"}
    for i, name in enumerate(model.order):
        base = model.first + 3 * i
        for j, (what, meaning) in enumerate(meanings.items()):
            key = f"{SONAR}.sonars.{name}.mount.{what}"
            unit = "rad" if what == "yaw" else "m"
            estimates.append(
                estimated(f"{name}_{what}", found[base + j], unit, model.samples(name), f"{meaning}; {noise}", key)
            )
    return Result(
        wizard="sonar",
        measured=f"{len(legs)} arcs along a wall, {count} echoes; residuals {fit.rms:.2f} times the expected noise",
        estimates=tuple(estimates),
        unobserved=(
            "height and tilt of the cones",
            "decrease of the sensitivity towards the edge of a cone: a hard edge is assumed",
            "how the speed of sound changes with temperature: by 0.6 m/s per degree Celsius",
        ),
    )


def arc(chassis: Chassis, limit: float) -> tuple[float, float, float]:
    """Return the axle angles of an arc to the left (rad) and its radius (m).

    A truck steers both axles, another body only the front axle.
    """
    angle = 0.35  # angle of both axles of a truck, in opposite directions, rad
    if isinstance(chassis, TruckChassis):
        angles = angle, -angle
    else:
        # 0.96: fraction of the maximum angle that the gate allows 0.4: minimum radius of the arcs, m
        angles = min(0.96 * limit, math.atan((chassis.bicycle.l_f + chassis.bicycle.l_r) / 0.4)), 0.0
    return (*angles, 1.0 / float(chassis.bicycle.curvature(*angles)))


def wall_range(
    poses: Array, place: SonarPose, wall: tuple[float | Array, float | Array], half: float
) -> tuple[Array, Array]:
    """Range to a wall (m), and angle of its normal beyond the edge of the cone (rad); (n,) each.

    Args:
        poses: robot poses, shape (n, 3).
        place: pose of the sonar.
        wall: distance from the origin (m), and clockwise angle from the x axis (rad).
        half: half angle of the cone (rad).
    """
    x, y, yaw = poses.T
    turned = yaw + wall[1]
    distance = (
        wall[0] - (np.sin(wall[1]) * x + np.cos(wall[1]) * y) - (np.sin(turned) * place.x + np.cos(turned) * place.y)
    )
    off = np.abs(wrap(turned + place.yaw - math.pi / 2))
    past = np.maximum(off - half, 0.0)
    return np.asarray(distance / np.cos(np.minimum(past, 1.2))), past


def swings(poses: Array) -> Array:
    """Derivative of an arc's poses with respect to the relative excess of its turn, to first order; shape (n, 3).

    Args:
        poses: odometry poses: x, y (m) and yaw (rad), shape (n, 3).
    """
    yaw = poses[:, 2] - poses[0, 2]
    across = (yaw[1:] + yaw[:-1])[:, None] / 2 * np.diff(poses[:, :2], axis=0)
    x, y = np.cumsum(np.vstack((np.zeros(2), across)), axis=0).T
    return np.column_stack((-y, x, yaw))


class SonarModel:
    """Model of the ranges to a wall along arcs.

    Parameters: ``COMMON``; for every arc except the first, the robot's shift towards the wall (m), its turn (rad)
    relative to odometry, and the relative excess of its turn; x, y and yaw of every sonar.

    Args:
        legs: driven arcs.
        settings: sonar settings used by the daemon.
        wall: taped distance from the wall (m).
        tape_error: standard deviation of ``wall`` (m).
    """

    def __init__(self, legs: Sequence[SonarLeg], settings: Srf08Config, wall: float, tape_error: float) -> None:
        self.order = tuple(settings.sonars)
        legs = [leg for leg in legs if leg.poses]
        self.first = COMMON + len(ASSUMED.sonar_arc) * len(legs) - 2
        rows = np.concatenate(
            [
                np.column_stack((np.full((len(at), 2), (i, k)), leg.ranges[name], at, swings(at)))
                for i, leg in enumerate(legs)
                for k, name in enumerate(self.order)
                if (at := leg.poses.get(name)) is not None
            ]
        )
        arcs, sonars, ranges, *poses = rows[np.isfinite(rows[:, 2])].T
        self._echoes = _Echoes(
            arcs.astype(np.int64), sonars.astype(np.int64), np.array(poses[:3]), np.array(poses[3:]), ranges
        )
        paths = [next(iter(leg.poses.values())) for leg in legs]
        self._begins, self._ends = np.array([path[0] for path in paths]), np.array([path[-1] for path in paths])
        self._swings = np.array([swings(path)[-1] for path in paths])
        self._wall, self._tape_error = wall, tape_error
        mounts = [s.mount.planar for s in settings.sonars.values()]
        self._start = np.concatenate(
            ((wall, 0.0, settings.field_of_view / 2, 1.0, 1.0), np.zeros(self.first - COMMON), np.ravel(mounts))
        )
        self._limits = 1.2 * settings.range_min, 0.95 * settings.range_max
        self.kept = self._chosen(self._start, FIRST_RANGE_ERROR, 0.0)

    def samples(self, name: str) -> int:
        """Return the number of a sonar's echoes from the wall."""
        return int((self.kept.sonars == self.order.index(name)).sum())

    def fit(self) -> FitResult:
        """Fit by least squares: first normals within the cones, then also the edges, finally without outliers.

        Raises:
            InputError: a sonar has too few echoes.
        """
        found = self._solve(self._start, edges=False)
        sigmas = 4.0 * _sigma(self._echoes.ranges)  # maximum residual in the final fit, in standard deviations
        for bounds in (FIRST_RANGE_ERROR / 2 + sigmas, sigmas):
            self.kept = self._chosen(found.parameters, bounds, BEYOND)
            found = self._solve(found.parameters)
        return found

    def _solve(self, start: Array, *, edges: bool = True) -> FitResult:
        """Fit, keeping the configured axes and cone if no edges determine them."""
        for name in self.order:
            if (count := self.samples(name)) < LEAST_ECHOES:
                raise InputError(
                    f"sonar {name}: {count} echoes of the wall: expected {LEAST_ECHOES}; drive longer arcs"
                )
        reach = np.concatenate(((0.3, 0.3, 0.25, 0.1, 0.05), np.full(self.first - COMMON, 0.4)))
        reach = np.concatenate((reach, np.tile((0.15, 0.15, 0.4 if edges else 0.0), len(self.order))))
        reach[2] *= edges
        return least_squares(self._residual, start, self._start - reach, self._start + reach)

    def _predicted(self, parameters: Array, echoes: "_Echoes") -> tuple[Array, Array]:
        """Predict the sonar ranges (m), and the angle of the normal beyond the edge of the cone (rad)."""
        distance, direction, half, factor, scale = parameters[:COMMON].tolist()
        nearer, turned, swung = self._drift(parameters)[echoes.arcs].T
        x, y, yaw = parameters[self.first :].reshape(-1, 3)[echoes.sonars].T
        poses = (echoes.poses + swung * echoes.swings).T * (scale, scale, 1.0)
        due, past = wall_range(poses, SonarPose(x, y, yaw), (distance - nearer, direction + turned), half)
        return due / factor, past

    def _drift(self, parameters: Array) -> Array:
        """Shift (m), turn (rad) and relative excess of the turn for every arc, shape (n, 3)."""
        return np.concatenate((np.zeros(2), parameters[COMMON : self.first])).reshape(-1, len(ASSUMED.sonar_arc))

    def _drifted(self, drift: Array) -> Array:
        """Return the drift in units of ``ARC_DRIFT``.

        Columns: shift and turn since the end of the previous arc, and relative excess of the turn; shape (n, 3).
        """
        nearer, turned, swung = drift.T
        ends = self._ends + swung[:, None] * self._swings
        at_end = nearer + np.sin(turned) * ends[:, 0] + np.cos(turned) * ends[:, 1]
        at_begin = nearer + np.sin(turned) * self._begins[:, 0] + np.cos(turned) * self._begins[:, 1]
        moved = self._begins[1:, 1] - self._ends[:-1, 1]
        came = np.column_stack(
            (at_begin[1:] - at_end[:-1] - moved, turned[1:] - turned[:-1] - swung[:-1] * self._swings[:-1, 2])
        )
        return np.column_stack((np.vstack((np.zeros(2), came)), swung))

    def _residual(self, parameters: Array) -> Array:
        kept = self.kept
        off = (kept.ranges - self._predicted(parameters, kept)[0]) / _sigma(kept.ranges)
        drift = self._drifted(self._drift(parameters)) / ASSUMED.sonar_arc
        taped, believed = (
            (parameters[0] - self._wall) / self._tape_error,
            (parameters[3:COMMON] - 1.0) / ASSUMED.sonar_scale,
        )
        return np.concatenate((off, drift.ravel(), believed, [taped]))

    def _chosen(self, parameters: Array, bounds: Array | float, beyond: float) -> "_Echoes":
        """Select echoes close to the expected wall.

        Args:
            parameters: model parameters.
            bounds: maximum difference from the expected range (m).
            beyond: maximum angle of the wall's normal beyond the cone (rad).
        """
        due, past = self._predicted(parameters, self._echoes)
        near = np.abs(self._echoes.ranges - due) < bounds
        near &= (past <= beyond) & (due > self._limits[0]) & (due < self._limits[1])
        e = self._echoes
        return _Echoes(e.arcs[near], e.sonars[near], e.poses[:, near], e.swings[:, near], e.ranges[near])


class _Echoes(NamedTuple):
    """Echoes from all sonars on all arcs; (n,) each."""

    arcs: NDArray[np.int64]
    sonars: NDArray[np.int64]
    poses: Array
    """x, y (m) and yaw (rad) of the robot, shape (3, n)"""
    swings: Array
    """Result of ``swings``, shape (3, n)"""
    ranges: Array
    """Measured range, m."""


def _check_places(legs: Sequence[SonarLeg], places: Mapping[str, SonarPose], wall: float, half: float) -> None:
    """Reject a sonar whose axis is wrong, judged by the mean direction in which it detects the wall.

    Raises:
        InputError: cables or addresses are swapped, or a sonar does not detect the wall.
    """
    wrong, deaf = [], []
    for name in places:
        bearings, near = _bearings(legs, name, wall)
        if near.sum() < LEAST_ECHOES:
            deaf.append(name)
            continue
        off = {}
        for at, place in places.items():
            due = np.abs(wrap(bearings - place.yaw)) <= half + BEYOND
            off[at] = abs(wrap(mean_angle(bearings[near]) - mean_angle(bearings[due]))) if due.any() else math.pi
        nearest = min(off, key=lambda at: off[at])
        # 0.4: maximum angle between the middles of the measured and the expected echoes for any mount, rad
        if off[name] > 0.4 and nearest != name:
            wrong.append(f"{name} receives the echoes expected at {nearest}")
    if deaf:
        raise InputError(
            f"sonar {', '.join(deaf)}: too few echoes of the wall: check that it is mounted where configured"
        )
    if wrong:
        raise InputError(f"{', '.join(wrong)}: check whether their addresses or cables, or left and right, are swapped")


def _bearings(legs: Sequence[SonarLeg], name: str, wall: float) -> tuple[Array, NDArray[np.bool_]]:
    """Bearing of the wall in the body frame at every ping (rad), and whether the sonar measured a matching range.

    Both have shape (n,).
    """
    poses = np.concatenate([leg.poses[name] for leg in legs if name in leg.poses] or [np.empty((0, 3))])
    ranges = np.concatenate([leg.ranges[name] for leg in legs if name in leg.poses] or [np.empty(0)])
    # 0.3: maximum difference between a range and the wall's distance from the robot's middle, m
    return math.pi / 2 - poses[:, 2], np.abs(ranges - (wall - poses[:, 1])) < 0.3


def _sigma(ranges: Array) -> Array:
    return np.asarray(np.hypot(ASSUMED.sonar_noise[0], ASSUMED.sonar_noise[1] * ranges))


def _turned(record: MoveRecord) -> float:
    """Turn measured by odometry (rad)."""
    yaws = np.unwrap([o.pose.yaw for o in record.of(topics.ODOMETRY)])
    return float(yaws[-1] - yaws[0]) if yaws.size else 0.0


def _start(record: MoveRecord) -> tuple[float, float, float]:
    """Odometry pose at rest before a move.

    Raises:
        InputError: no odometry was received.
    """
    resting = record.at_rest(topics.ODOMETRY)[0]
    if not resting:
        raise InputError("no odometry was received while the robot stood")
    pose = resting[-1].pose
    return pose.x, pose.y, pose.yaw
