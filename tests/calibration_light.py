"""Measurements of hidden trucks by the wizards' own error models, without a daemon: many, for coverage of intervals."""

import math
from collections.abc import Callable
from typing import Final

import numpy as np

from monstertruck_kinematics.chassis import Dimensions, TruckChassis
from monstertruck_kinematics.elementary import integrate
from monstertruck_kinematics.truck import DriveTrain
from monstertruck_kinematics.unsteered import SkidSteer
from monstertruck_runtime.bodies import build_chassis
from monstertruck_schemas.body import TruckBody
from monstertruck_schemas.sensor import Attitude, Imu, Vector3
from monstertruckd.config.calibration import Result
from monstertruckd.tools.calibrate import imu, lidar, odometry, slip
from monstertruckd.tools.calibrate.statistics import NORMAL, Interval
from monstertruckd.tools.calibrate.steering_model import SLIP, Maps, SteeringModel, SteeringRun
from tests.calibration_kit import Verdict

CHASSIS: Final = build_chassis(TruckBody(), Dimensions(DriveTrain(644.0, 0.075), 0.32, 0.26))
MAPS: Final = Maps((1439.2, 1439.2), (-10.48, 10.48))
AHEAD: Final = 0.235


def judged(result: Result, truth: dict[str, float]) -> list[Verdict]:
    """Every estimate whose truth is known."""
    return [
        Verdict(f"{result.wizard}.{e.name}", e.value, e.low, e.high, truth[e.name])
        for e in result.estimates
        if e.name in truth
    ]


def odometry_fit(rng: np.random.Generator) -> list[Verdict]:
    """Squares to both sides."""
    assert isinstance(CHASSIS, TruckChassis)
    model = odometry.SquareModel(SteeringModel(CHASSIS), MAPS, AHEAD)
    true = np.array((rng.uniform(0.95, 1.05), rng.uniform(0.95, 1.05), rng.uniform(-0.04, 0.04)))
    # What the interval's bounds cover besides: linkage and floor.
    actual = true * (1 + odometry.FLOOR * rng.normal() / NORMAL, 1 + odometry.LINKAGE * rng.normal() / NORMAL, 1.0)
    squares = []
    for sense in (1, -1):
        legs = []
        for _ in range(4):
            for way, angle in ((1.5, 0.0), (0.74, sense * 0.35)):
                legs.append(_leg(model, actual, way, angle, rng))
        runs = tuple(legs)
        end = model.end(odometry.Square(runs, 0.0, (0.0, 0.0)), actual)
        side = actual[0] * 1.5 * math.sin(runs[0].turn / 2) / (runs[0].turn / 2)
        side += math.hypot(0.002 * math.sqrt(2), 0.003) * rng.normal()
        place = math.hypot(odometry.PLACE, 0.007)
        squares.append(odometry.Square(runs, side, (end[0] + place * rng.normal(), end[1] + place * rng.normal())))
    fit = model.fit(squares, 0.002, 0.0035)
    way, base, offset = odometry.intervals(fit, 16 + 6)
    found = {"way": way.joined(odometry.FLOOR), "wheelbase": base.joined(odometry.LINKAGE), "offset": offset}
    return [
        Verdict(f"odometry.{name}", i.value, i.low, i.high, float(t))
        for (name, i), t in zip(found.items(), true, strict=True)
    ]


def _leg(
    model: odometry.SquareModel, actual: np.ndarray, way: float, angle: float, rng: np.random.Generator
) -> SteeringRun:
    linkage = CHASSIS.linkage
    assert linkage is not None
    servos = CHASSIS.servos(angle, -angle)
    motor = np.full(20, CHASSIS.drivetrain.motor_rate(way) / 20)
    pulses = tuple(np.full(20, float(MAPS.pulses(axle, np.array(servos[axle])))) for axle in (0, 1))
    ideal = SteeringRun(motor, (pulses[0], pulses[1]), 0.0, 0.0)
    turn = float(model.turns([ideal], actual)[0])
    sigma = math.hypot(0.002, 0.006 * min(abs(turn), 1.0), 0.005 * turn)
    turn += math.hypot(sigma, SLIP * math.sqrt(way)) * rng.normal()
    return SteeringRun(motor, (pulses[0], pulses[1]), turn, sigma)


def lidar_fit(rng: np.random.Generator) -> list[Verdict]:
    """Quarters of circles and straights."""
    x, y, yaw = rng.uniform((0.10, -0.03, -0.05), (0.18, 0.03, 0.05))
    error = math.radians(0.15)
    true = np.array((x, y, yaw, 1 + 0.01 * rng.normal(), error * rng.normal()))
    centre = lidar.CENTRE * rng.normal()
    legs = []
    for side in (1, -1):
        for way, turn in ((1.0, 0.0), (-1.0, 0.0), *((0.665, side * 1.52),) * 4):
            turn = turn + 0.01 * rng.normal()
            sigma = 0.006
            actual = true + np.array((centre, 0.0, 0.0, lidar.DRIFT * rng.normal(), lidar.CRAB * rng.normal()))
            seen = lidar.seen_motion(actual, np.array((way,)), np.array((turn,)), np.zeros(1))[0]
            seen[:2] += sigma * rng.normal(size=2)
            legs.append(lidar.LidarLeg(way, (float(seen[0]), float(seen[1]), float(seen[2])), sigma))
    offset = lidar.Offset(Interval(0.0, 0.01), 100, None)
    result = lidar.result_of(legs, (0.14, 0.0, 0.0), error, offset)
    return judged(result, {"x": float(x), "y": float(y), "yaw": float(yaw)})


def imu_fit(rng: np.random.Generator) -> list[Verdict]:
    """A unit at rest, and full turns."""
    bias = dict(zip(("rate_x", "rate_y", "rate_z"), rng.uniform(-0.01, 0.01, 3).tolist(), strict=True))
    force = dict(zip(("force_x", "force_y"), rng.uniform(-0.1, 0.1, 2).tolist(), strict=True))
    gain = rng.uniform(0.95, 1.05)
    tilt = imu.TILT * rng.normal(size=2)
    lean = rng.uniform(-0.03, 0.03, 2)
    resting = [
        Imu(
            stamp=k, received=k, seq=k, frame="imu",
            angular_velocity=_vector([b + 0.003 * rng.normal() for b in bias.values()]),
            linear_acceleration=_vector(
                [
                    -imu.GRAVITY * math.sin(lean[0]) + force["force_x"] + 0.05 * rng.normal(),
                    imu.GRAVITY * math.cos(lean[0]) * math.sin(lean[1]) + force["force_y"] + 0.05 * rng.normal(),
                    imu.GRAVITY,
                ]
            ),
        )
        for k in range(200)
    ]  # fmt: skip
    compass = Attitude(stamp=1, received=1, seq=1, heading=0.0, pitch=lean[0] + tilt[0], roll=lean[1] + tilt[1])
    turns = []
    for side in (1, -1, 1, -1):
        turned = side * (math.tau + 0.05)
        seconds = 20.0
        sigma = 0.003
        integral = gain * turned + bias["rate_z"] * seconds + 0.003 * 0.02 * math.sqrt(1000) * rng.normal()
        turns.append(imu.Turn(integral, seconds, turned + sigma * rng.normal(), sigma))
    before = {**dict.fromkeys((*bias, *force), 0.0), "rate_scale": 1.0}
    result = imu.result_of(resting, [compass], turns, before)
    return judged(result, {**bias, **force, "rate_scale": 1 / gain})


def _vector(values: list[float]) -> Vector3:
    x, y, z = values
    return Vector3(x=x, y=y, z=z)


def slip_fit(rng: np.random.Generator) -> list[Verdict]:
    """Arcs of a skid-steer robot."""
    truth = {
        "icr_left": rng.uniform(0.06, 0.10), "icr_right": -rng.uniform(0.06, 0.10), "icr_x": rng.uniform(-0.02, 0.0),
        "gain_left": rng.uniform(0.95, 1.1), "gain_right": rng.uniform(0.95, 1.1),
    }  # fmt: skip
    robot = SkidSteer(0.021, **truth)
    arcs = []
    for left, right in ((8.0, 12.0), (12.0, 8.0), (5.0, 12.0), (12.0, 5.0), (20.0, 20.0)):
        for sign in (1, -1, 1, -1):
            vx, vy, wz = robot.forward((sign * left, sign * right))
            x, y, yaw = integrate((0.0, 0.0, 0.0), vx, vy, wz, 1.0)
            way = slip.SLIDING * 0.021 * max(left, right)
            place, aim = math.hypot(slip.FLOOR, way), math.hypot(slip.AIM, slip.SLIDING * abs(yaw))
            motion = x + place * rng.normal(), y + place * rng.normal(), yaw + aim * rng.normal()
            arcs.append(slip.SkidArc(sign * left, sign * right, motion, (0.0003, 0.0005)))
    return judged(slip.result_of(arcs, 0.021, 0.0525), truth)


LIGHT: Final[dict[str, Callable[[np.random.Generator], list[Verdict]]]] = {
    "odometry": odometry_fit,
    "lidar": lidar_fit,
    "imu": imu_fit,
    "slip": slip_fit,
}
"""By wizard."""


def coverage(wizard: str, fits: int) -> dict[str, tuple[float, float]]:
    """Share of true values inside, and median half-width, by estimate."""
    found: dict[str, list[Verdict]] = {}
    for seed in range(fits):
        for verdict in LIGHT[wizard](np.random.default_rng([seed, 26])):
            found.setdefault(verdict.name, []).append(verdict)
    return {
        name: (
            sum(v.holds for v in rows) / len(rows),
            float(np.median([(v.high - v.low) / 2 for v in rows if v.high is not None and v.low is not None])),
        )
        for name, rows in found.items()
    }
