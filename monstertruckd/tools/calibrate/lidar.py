"""Mount of the lidar on the body, and the offset of its clock, from scans between rests.

The lidar sees the same surroundings at both rests. Registration of its scans gives the motion of the lidar; wheels and
steering give the motion of the body. The mount X solves A X = X B (Tsai and Lenz, "A New Technique for Fully Autonomous
and Efficient 3D Robotics Hand/Eye Calibration", IEEE Transactions on Robotics and Automation, 1989), here in the plane.
The turn is taken from the scans, which measure it best, so errors of compass and steering have no effect. The fit
depends on the distance, whose scale is also fitted, and on the direction of travel.

Pitch and roll follow from the height of the beam above the floor: at the lidar, on a wall ahead and on a wall to the
left. The beam is infrared; a phone camera shows it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Final

import numpy as np

from monstertruck_drivers.scanning.mounting import hangs
from monstertruck_estimation.slam.motion import find_offset
from monstertruck_estimation.slam.registration import Cloud, register
from monstertruck_estimation.slam.scans import Scan, ScanGeometry, prepare
from monstertruck_kinematics.beams import nearest_beams
from monstertruck_kinematics.chassis import Chassis
from monstertruck_kinematics.elementary import Array, sinc
from monstertruck_kinematics.fitting import FitResult, least_squares
from monstertruck_kinematics.se2 import between, compose
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError, RequestRefusedError
from monstertruck_schemas import topics
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import VALID_BEAM, LaserScan
from monstertruckd.config.calibration import Estimate, Result, WizardName
from monstertruckd.config.wizards import LIDAR
from monstertruckd.tools.calibrate.assumed import ASSUMED
from monstertruckd.tools.calibrate.beams import stacked_ranges
from monstertruckd.tools.calibrate.statistics import NORMAL, Interval, correlation_factor, estimated, known_errors
from monstertruckd.tools.calibrate.steering_model import AXLES, EYE
from monstertruckd.tools.calibrate.steps import Collect, MoveRecord, MoveStep, Number, Plot
from monstertruckd.tools.calibrate.weave import weaves
from monstertruckd.tools.calibrate.wizard import CLEAR, WizardContext

ROOM: Final = (
    "3 m x 3 m, with walls visible on several sides; for heights a tape, a level floor, a wall straight "
    "ahead and one to the left"
)
QUARTER: Final = math.pi / 2
LEAST_OVERLAP: Final = 0.5
"""Minimum overlap of two registered scans."""
LEAST_SCANS: Final = 3
"""Minimum scans at each rest."""
MOST_TILT: Final = math.sin(math.radians(20.0))
"""Maximum rise of the beam per metre: more indicates a wrong reading."""
HEIGHTS: Final = (
    Number("centre", "Height of the lidar's beam above the floor, at its window, cm", 1.0, 200.0),
    Number("ahead", "Height of the beam on the wall straight ahead, cm", 1.0, 250.0),
    Number("left", "Height of the beam on the wall straight to the left, cm", 1.0, 250.0),
)


@dataclass(frozen=True, slots=True)
class LidarLeg:
    """One move between two rests."""

    distance: float
    """Distance of the body by the drive's count, m, negative backwards."""
    seen: tuple[float, float, float]
    """Motion of the lidar in its initial frame, m and rad."""
    sigma: float
    """Standard deviation of its position, m."""
    travel: float = 0.0
    """Direction of the body's travel by its steering, relative to its axis, rad."""

    @classmethod
    def of(cls, record: MoveRecord, chassis: Chassis, mount: tuple[float, float, float]) -> "LidarLeg":
        """Create a leg from a move with constant steering.

        Args:
            record: record with scans.
            chassis: kinematics, for distance and direction.
            mount: configured mount, used as the initial guess.

        Raises:
            InputError: there are too few scans at rest, or the scans do not match.
        """
        scans, after = (resting_scan(found) for found in record.at_rest(topics.SCAN))
        _, front, rear = record.steps()
        axles = chassis.steering(float(np.median(front)), float(np.median(rear)))
        distance = record.distance(chassis.drivetrain) / chassis.bicycle.drive_speed(1.0, *axles)
        ahead, aside, _ = chassis.bicycle.body_twist(1.0, *axles)
        turn = record.turned()
        believed = np.array(mount)
        body = _arc(distance, 0.0, turn)
        guess = between(believed, compose(body, believed))
        fit = register(after, Cloud.of(scans), guess, reach=0.3)
        fit = register(after, Cloud.of(scans), fit.pose)
        check_way_round(scans, after, (distance, turn), believed, fit.overlap)
        if fit.overlap < LEAST_OVERLAP:
            raise InputError(
                f"the scans before and after a leg overlap by {fit.overlap:.0%}: expected {LEAST_OVERLAP:.0%}"
            )
        errors = np.sqrt(np.diag(np.linalg.inv(fit.information)))
        x, y, yaw = fit.pose.tolist()
        least = 0.002  # minimum standard deviation of a registered position, m: walls are not perfectly straight
        return cls(distance, (x, y, yaw), math.hypot(least, float(np.max(errors[:2]))), math.atan2(aside, ahead))


@dataclass(frozen=True, slots=True)
class Offset:
    """Offset between the stamps of odometry and scans, measured by turning."""

    value: Interval
    """Offset, s; positive if odometry is ahead."""
    samples: int


@dataclass(frozen=True, slots=True)
class LidarWizard:
    """Wizard that drives quarter circles in both directions, straights and weaves; measures heights on request."""

    name: ClassVar[WizardName] = "lidar"
    doc: ClassVar[str] = (
        "pose of the lidar on the body, and offset of its clock, from scans at rest before and after each leg"
    )
    room: ClassVar[str] = ROOM
    rounds: int = 1
    """Number of full circles in each direction, driven in quarters"""
    heights: bool = False
    """Ask for the height of the beam, for pitch and roll"""
    tape_error: float = ASSUMED.tape_reading
    """Standard deviation of a height, m"""

    async def __call__(self, context: WizardContext) -> Result:
        """Measure."""
        if context.config.devices.compass is None:
            raise RequestRefusedError(Reason.NOT_SUPPORTED, "measuring the lidar's mount needs a compass")
        believed = tuple(float(context.value(f"{LIDAR}.{name}")) for name in ("x", "y", "yaw"))
        mount = (believed[0], believed[1], believed[2])
        # Ask first, so that a wrong number is refused before the robot drives.
        level = await self._level(context) if self.heights else ()
        await context.confirm(CLEAR)
        chassis = context.chassis
        legs = []
        for move in self._moves(chassis):
            legs.append(LidarLeg.of(await context.move(move), chassis, mount))
            context.plot(_plot(legs))
        also = topics.SCAN, topics.ODOMETRY
        weaving = [await context.move(replace(move, also=also)) for move in weaves(1)]
        context.plot(_plot(legs))
        crab = crab_error(context)
        offset = context.fit("offset of the clocks", lambda: time_offset(weaving))
        return context.fit("mount", lambda: result_of(legs, mount, crab, offset, level))

    def _moves(self, chassis: Chassis) -> list[MoveStep]:
        angle = 0.35  # angle of both axles, in opposite directions, rad
        arc = QUARTER / chassis.bicycle.curvature(angle, -angle)
        moves = []
        speed = 0.12
        for side, name in ((1, "left"), (-1, "right")):
            moves += [
                MoveStep(f"straight {word}", sign * speed, metres=1.0, also=(topics.SCAN,))  # m
                for sign, word in ((1, "ahead"), (-1, "back"))
            ]
            moves += [
                MoveStep(
                    f"quarter {k} of a circle to the {name}",
                    speed,
                    side * angle,
                    -side * angle,
                    arc,
                    also=(topics.SCAN,),
                )
                for k in range(1, 4 * self.rounds + 1)
            ]
        return moves

    async def _level(self, context: WizardContext) -> tuple[Estimate, ...]:
        scans = await context.collect(Collect("distances to the walls", topics.SCAN, 10))
        tilt = await context.collect(Collect("tilt of the robot", topics.COMPASS, 20))
        joints = await joint_angles(context)
        ahead, left = (beam_distance(scans, angle) for angle in (0.0, QUARTER))
        heights = [(await context.ask(step)) / 100 for step in HEIGHTS]
        pitch, roll = beam_tilt(heights, (ahead, left))
        body = tuple(float(np.mean([getattr(a, name) for a in tilt])) for name in ("pitch", "roll"))
        device = context.config.devices.lidar
        # the scans of a lidar that hangs are published as those of an upright one
        hanging = math.pi if device is not None and hangs(device.mount) else 0.0
        found = (
            ("pitch", pitch - body[0] - joints[0], ahead, "nose down positive"),
            ("roll", math.remainder(hanging + roll - body[1] - joints[1], math.tau), left, "right side down positive"),
        )
        return tuple(
            estimated(
                name,
                Interval(angle, NORMAL * ASSUMED.beam_angle(self.tape_error, distance)),
                "rad",
                2,
                f"{sign}; 95 % interval from two heights {distance:.1f} m apart and the compass's tilt",
                f"{LIDAR}.{name}",
            )
            for name, angle, distance, sign in found
        )


async def joint_angles(context: WizardContext) -> tuple[float, float]:
    """Current pitch and roll of the joints below the lidar (rad); 0 without joints.

    Raises:
        InputError: a servo does not answer.
    """
    if context.config.devices.stabiliser is None:
        return 0.0, 0.0
    joints = await context.collect(Collect("joint angles of the lidar's mount", topics.STABILISER, 20))
    read = [(j.pitch, j.roll) for j in joints if j.pitch is not None and j.roll is not None]
    if not read:
        raise InputError(
            "a servo of the stabiliser does not answer, so the direction of the lidar is unknown: check its "
            "cable and power"
        )
    pitch, roll = np.mean(np.array(read), axis=0).tolist()
    return pitch, roll


def crab_error(context: WizardContext) -> float:
    """Standard deviation of the crab angle (rad), from the steering calibration, or as judged by eye."""
    steering = context.known.get("steering")
    halves = []
    for axle in AXLES:
        centre = None if steering is None else steering.estimate(f"{axle}_centre")
        scale = context.config.devices.steering
        if centre is None or centre.low is None or centre.high is None or scale is None:
            return EYE / 2
        per_degree = getattr(scale.driver, axle).scale_us_per_deg
        halves.append(math.radians((centre.high - centre.low) / 2 / per_degree))
    return sum(halves) / len(halves) / NORMAL / 2


def result_of(
    legs: Sequence[LidarLeg],
    mount: tuple[float, float, float],
    crab: float,
    offset: Offset | None,
    level: tuple[Estimate, ...] = (),
) -> Result:
    """Fit the mount and check it.

    Args:
        legs: moves between rests.
        mount: configured mount (m and rad).
        crab: standard deviation of the direction of travel (rad).
        offset: offset between the clocks (s); None if not measured.
        level: pitch and roll, if measured.

    Raises:
        InputError: there are too few legs in one direction.
    """
    turned = np.array([leg.seen[2] for leg in legs])
    if not ((turned > 0.5).sum() >= 2 and (turned < -0.5).sum() >= 2 and (np.abs(turned) < 0.3).any()):
        raise InputError("expected two arcs in each direction and a straight")
    fit = fit_mount(legs, mount, crab)
    halves = known_errors(fit, 2 * len(legs) - 4)
    if not np.isfinite(halves[:3]).all():
        raise InputError("the legs do not determine the mount: it is more than 0.5 m off, or the scans do not match")
    x, y, yaw = (Interval(float(v), float(h)) for v, h in zip(fit.parameters[:3], halves[:3], strict=True))
    noise = "95 % interval from scans and slip"
    x = x.joined(NORMAL * ASSUMED.turning_centre)
    estimates = [
        estimated("x", x, "m", len(legs), f"in front of the middle of the body; {noise}", f"{LIDAR}.x"),
        estimated("y", y, "m", len(legs), f"left of it; {noise}", f"{LIDAR}.y"),
        estimated(
            "yaw", yaw, "rad", len(legs),
            f"relative to the direction of travel, left positive; {noise}, and the robot's possible "
                "sideways drift", f"{LIDAR}.yaw",
        ),
        *level,
    ]  # fmt: skip
    if offset is not None:
        text = "ratio of odometry to scan distance, for information"
        estimates.append(
            estimated("time_offset", offset.value, "s", offset.samples, f"{text}; 95 % interval of the turns")
        )
    return Result(
        wizard="lidar",
        measured=f"{len(legs)} legs between rests; residual {1000 * _unexplained(fit, legs):.1f} mm",
        estimates=tuple(estimates),
        unobserved=(
            "sideways drift: a robot that crabs looks like a rotated lidar",
            *(() if level else ("pitch and roll of the scan plane: measure heights (--heights)",)),
        ),
        partial=not level,
    )


def fit_mount(legs: Sequence[LidarLeg], mount: tuple[float, float, float], crab: float) -> FitResult:
    """Fit the lidar's translations by least squares; parameters x, y (m), yaw (rad), scale, crab (rad)."""
    distances, seen = np.array([leg.distance for leg in legs]), np.array([leg.seen for leg in legs])
    travels = np.array([leg.travel for leg in legs])
    sigmas = np.array([ASSUMED.place_of_leg(leg.sigma, leg.distance) for leg in legs])
    start = np.array((*mount, 1.0, 0.0))
    reach = np.array((0.5, 0.5, math.pi, 0.3, 0.3))

    def residual(parameters: Array) -> Array:
        found = seen_motion(parameters, distances, seen[:, 2], travels)
        off = (found[:, :2] - seen[:, :2]) / sigmas[:, None]
        # 0.02: standard deviation of the distance scale before the measurement
        return np.append(off.ravel(), ((parameters[3] - 1.0) / 0.02, parameters[4] / max(crab, 1e-6)))

    return least_squares(residual, start, start - reach, start + reach)


def seen_motion(parameters: Array, distances: Array, turns: Array, travels: Array) -> Array:
    """Predict the lidar's motion on legs, shape (n, 3); the parameters are those of ``fit_mount``.

    Distances are in m, turns and directions in rad.
    """
    x, y, yaw, scale, crab = parameters.tolist()
    mount = np.array((x, y, yaw))
    return np.array(
        [
            between(mount, compose(_arc(scale * distance, crab + travel, turn), mount))
            for distance, turn, travel in zip(distances, turns, travels, strict=True)
        ]
    )


def _arc(distance: float, crab: float, turn: float) -> Array:
    """Motion of the body along an arc if its axis is at the angle ``crab`` to its direction of travel."""
    half = turn / 2
    chord = distance * sinc(half)
    return np.array((chord * math.cos(half + crab), chord * math.sin(half + crab), turn))


def _unexplained(fit: FitResult, legs: Sequence[LidarLeg]) -> float:
    sigmas = np.array([ASSUMED.place_of_leg(leg.sigma, leg.distance) for leg in legs])
    off = fit.residuals[: 2 * len(legs)].reshape(-1, 2) * sigmas[:, None]
    return float(np.sqrt((off**2).sum(axis=1).mean()))


# Scans


def check_way_round(before: Scan, after: Scan, moved: tuple[float, float], mount: Array, overlap: float) -> None:
    """Raise InputError if scans match much better for a lidar that is upside down or faces backwards.

    Args:
        before: scan at the first rest.
        after: scan at the second rest.
        moved: distance (m) and turn (rad) of the body.
        mount: configured mount.
        overlap: overlap of the scans with the configured mount.

    Raises:
        InputError: the lidar is mounted upside down or facing backwards.
    """
    body = _arc(moved[0], 0.0, moved[1])
    mountings = (
        ("is upside down", _mirrored, mount),
        ("faces backwards: its mount's yaw is near 3.14", _as_seen, mount + np.array((0.0, 0.0, math.pi))),
    )
    for what, seen, turned in mountings:
        guess = between(turned, compose(body, turned))
        found = register(seen(after), Cloud.of(seen(before)), guess, reach=0.3)
        found = register(seen(after), Cloud.of(seen(before)), found.pose)
        # 0.2: minimum gain in overlap that shows a reversed mount
        if found.overlap > max(LEAST_OVERLAP, overlap + 0.2):
            raise InputError(
                f"the lidar {what}: the scans of a leg overlap by {found.overlap:.0%} with that mount and "
                f"by {overlap:.0%} as configured"
            )


def _as_seen(scan: Scan) -> Scan:
    return scan


def _mirrored(scan: Scan) -> Scan:
    flip = np.array((1.0, -1.0))
    return replace(scan, points=scan.points * flip, normals=scan.normals * flip)


def _geometry(scan: LaserScan) -> ScanGeometry:
    return ScanGeometry(scan.start_angle, scan.angle_increment, scan.range_min, scan.range_max)


def resting_scan(scans: Sequence[LaserScan]) -> Scan:
    """Points of the mean of several scans at rest, in the lidar frame.

    Raises:
        InputError: there are too few scans.
    """
    if len(scans) < LEAST_SCANS:
        raise InputError(f"only {len(scans)} scans at rest: expected {LEAST_SCANS} at each end")
    ranges = stacked_ranges(scans, np.nan)
    counts = np.isfinite(ranges).sum(axis=0)
    sums = np.where(np.isfinite(ranges), ranges, 0.0).sum(axis=0)
    spread = np.nanmax(np.where(counts > 0, ranges, 0.0), axis=0) - np.nanmin(np.where(counts > 0, ranges, 0.0), axis=0)
    steady = (counts > len(scans) / 2) & (spread < 0.15)
    return prepare(np.where(steady, sums / np.maximum(counts, 1), np.inf), _geometry(scans[0]))


def beam_distance(scans: Sequence[LaserScan], angle: float) -> float:
    """Median range around an angle (m).

    Raises:
        InputError: no wall is visible.
    """
    found = []
    for scan in scans:
        beam = int(nearest_beams(np.array([angle]), scan.start_angle, scan.angle_increment)[0])
        near = slice(max(beam - 2, 0), beam + 3)
        found += scan.ranges[near][scan.codes[near] == VALID_BEAM].tolist()
    if not found:
        raise InputError(f"no wall is visible at {math.degrees(angle):.0f} degrees: the heights need one there")
    return float(np.median(found))


def beam_tilt(heights: Sequence[float], walls: tuple[float, float]) -> tuple[float, float]:
    """Compute pitch (nose down positive) and roll (right side down positive) of the scan plane (rad).

    Args:
        heights: heights of the beam at the lidar, on the wall ahead and on the wall to the left (m).
        walls: distances to the two walls (m).

    Raises:
        InputError: the heights are impossible.
    """
    centre, ahead, left = heights
    falls, rises = (centre - ahead) / walls[0], (left - centre) / walls[1]
    for name, height, wall, slope in (("ahead", ahead, walls[0], falls), ("left", left, walls[1], rises)):
        if abs(slope) > MOST_TILT:
            raise InputError(
                f"{name}: a beam {100 * centre:.0f} cm high at the lidar and {100 * height:.0f} cm on a "
                f"wall {wall:.1f} m away is tilted by more than {math.degrees(math.asin(MOST_TILT)):.0f} "
                "degrees: measure again, in cm"
            )
    return math.asin(falls), math.asin(rises)


def time_offset(records: Sequence[MoveRecord]) -> Offset | None:
    """Estimate the offset between the odometry and scan clocks from weaving; None if it cannot be determined.

    The correlation of ``find_offset`` finds a large offset; a least-squares fit of the yaws refines it.
    """
    series = [found for record in records if (found := _yaws(record)) is not None]
    if not series:
        return None
    coarse = find_offset(*series[0][:3]) if len(series[0][0]) else None
    return fit_offset([(s / SECOND, m, t / SECOND, w) for s, m, _, t, w in series], coarse)


def fit_offset(series: Sequence[tuple[Array, Array, Array, Array]], coarse: float | None) -> Offset:
    """Fit the offset by least squares.

    Args:
        series: for each move, times (s) and yaws (rad) of the scans, and times and yaws of odometry.
        coarse: initial guess (s); None means 0.
    """

    def residual(parameters: Array) -> Array:
        (offset,) = parameters
        off = []
        for times, scan, stamps, wheel in series:
            inside = (times > stamps[0] + 0.7) & (times < stamps[-1] - 0.7)
            predicted = np.interp(times[inside] + offset, stamps, wheel)
            basis = np.column_stack((np.ones(predicted.size), predicted))
            off.append(scan[inside] - basis @ np.linalg.lstsq(basis, scan[inside], rcond=None)[0])
        return np.concatenate(off)

    fit = least_squares(residual, np.array((coarse or 0.0,)), np.array((-0.65,)), np.array((0.65,)))
    half = NORMAL * correlation_factor(fit.residuals) * float(fit.standard_errors[0])
    return Offset(Interval(float(fit.parameters[0]), half), fit.residuals.size)


def _yaws(record: MoveRecord) -> tuple[Array, Array, Array, Array, Array] | None:
    """Stamps and yaws of the scans, odometry yaws at these stamps, and the stamps and yaws of odometry.

    None if there are too few.
    """
    scans, odometry = record.of(topics.SCAN), record.of(topics.ODOMETRY)
    before = [scan for scan in scans if scan.stamp < record.left]
    if len(before) < LEAST_SCANS or len(odometry) < 2 or len(scans) < 4 * LEAST_SCANS:
        return None
    cloud = Cloud.of(resting_scan(before))
    pose, stamps, yaws = np.zeros(3), [], []
    for scan in scans:
        # A scan takes a tenth of a second; its middle counts as its time.
        points = prepare(np.where(scan.codes == VALID_BEAM, scan.ranges, np.inf), _geometry(scan))
        fit = register(points, cloud, pose, reach=0.3)
        if fit.overlap < LEAST_OVERLAP:
            continue
        pose = fit.pose
        stamps.append(scan.stamp + round((len(scan.ranges) - 1) * scan.time_increment / 2 * SECOND))
        yaws.append(float(pose[2]))
    times = np.array([o.stamp for o in odometry], dtype=np.float64)
    wheel = np.unwrap([o.pose.yaw for o in odometry])
    at = np.array(stamps, dtype=np.float64)
    return at, np.unwrap(yaws), np.interp(at, times, wheel), times, wheel


def _plot(legs: Sequence[LidarLeg]) -> Plot:
    seen = np.array([leg.seen[:2] for leg in legs])
    return Plot("motion between rests by the scans", "ahead (m)", "to the left (m)", seen)
