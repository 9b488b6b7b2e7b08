"""Measurements of hidden trucks by the wizards' own error models, without a daemon: many, for coverage of intervals."""

import math
from collections.abc import Callable, Mapping
from typing import Final

import cv2
import numpy as np

from monstertruck_drivers.ax12.config import Ax12Config
from monstertruck_drivers.ax12.protocol import STEP
from monstertruck_drivers.srf08.config import Srf08Config
from monstertruck_estimation.vision.board import BoardReader, BoardSighting
from monstertruck_estimation.vision.lens import PARAMETERS, Lens, board_pose
from monstertruck_kinematics.chassis import Dimensions, TruckChassis
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import integrate
from monstertruck_kinematics.truck import DriveTrain
from monstertruck_kinematics.unsteered import SkidSteer
from monstertruck_runtime.bodies import build_chassis
from monstertruck_schemas.board import BoardConfig
from monstertruck_schemas.body import Mount, TruckBody
from monstertruck_schemas.sensor import Attitude, Imu, Vector3
from monstertruckd.config.calibration import Estimate, Result
from monstertruckd.tools.calibrate import (
    battery,
    board_mount,
    camera,
    compass,
    drive,
    imu,
    lidar,
    odometry,
    slip,
    sonar,
    stabiliser,
    weave,
)
from monstertruckd.tools.calibrate.assumed import ASSUMED
from monstertruckd.tools.calibrate.board_mount import LidarPlace
from monstertruckd.tools.calibrate.board_views import BoardGuide, BoardView
from monstertruckd.tools.calibrate.response import ResponseFit, Steps
from monstertruckd.tools.calibrate.statistics import NORMAL, Interval
from monstertruckd.tools.calibrate.steering import BAND, SPAN
from monstertruckd.tools.calibrate.steering_model import Maps, SteeringModel, SteeringRun, half_widths
from tests.calibration_kit import Verdict

BASE = 0.3

WEAVE = (0.3, 0.3, 0.3, 0.3, 1.2)

CHASSIS: Final = build_chassis(TruckBody(), Dimensions(DriveTrain(644.0, 0.075), 0.32, 0.26))
MAPS: Final = Maps((1439.2, 1439.2), (-10.48, 10.48))
AHEAD: Final = 0.235
ARC: Final = 0.67
"""Radius in which the robot with sonars drives its arcs, m."""


def judged(result: Result, truth: dict[str, float]) -> list[Verdict]:
    """Every estimate whose truth is known."""
    return [
        Verdict(f"{result.wizard}.{e.name}", e.value, e.low, e.high, truth[e.name])
        for e in result.estimates
        if e.name in truth
    ]


def battery_fit(rng: np.random.Generator) -> list[Verdict]:
    """A multimeter at a full and at an emptier pack."""
    wizard = battery.BatteryWizard()
    gain, offset = rng.uniform(0.94, 1.06), rng.uniform(-battery.EARTHING, battery.EARTHING)
    share, readings = wizard.meter_share * rng.uniform(-1, 1), []
    for volts in (16.4, 13.4):
        raw, noise = (volts - offset) / gain, 0.003
        shown = volts * (1 + share) + wizard.meter_digits * rng.uniform(-1, 1)
        readings.append(battery.MeterReading(raw + noise * rng.normal(), shown, noise))
    found = wizard.scale(readings)
    return [
        Verdict(f"battery.{name}", i.value, i.low, i.high, t)
        for name, i, t in zip(("gain", "offset"), found, (gain, offset), strict=True)
    ]


def drive_fit(rng: np.random.Generator) -> list[Verdict]:
    """Taped runs."""
    wizard = drive.DriveWizard()
    turns = rng.uniform(1000.0, 1600.0)
    tape = 1 + ASSUMED.tape_scale * rng.normal() / NORMAL
    values = []
    for _ in range(wizard.runs):
        shown = wizard.metres * tape + math.sqrt(2) * wizard.tape_error * rng.normal()
        values.append(turns * wizard.metres / shown)
    found = drive.turns_per_metre(values, wizard.tape_error, wizard.metres, 0.0)
    # On another floor.
    ratio, true = drive.on_any_floor(found), turns * (1 + ASSUMED.floor_slip * rng.normal() / NORMAL)
    return [
        Verdict("drive.turns_per_metre", found.value, found.low, found.high, turns),
        Verdict("drive.drive_ratio", ratio.value / turns, ratio.low / turns, ratio.high / turns, true / turns),
    ]


def compass_fit(rng: np.random.Generator) -> list[Verdict]:
    """A flat circle there and back."""
    count, up = 240, -39.0
    there = np.linspace(0, 1.05 * math.tau, count // 2)
    heading = np.concatenate((there, there[::-1]))
    current = np.repeat((0.25, -0.25), count // 2) + 0.02 * rng.standard_normal(count)
    hard, motor = rng.uniform(-7, 7, 2), rng.uniform(-0.5, 0.5, 2)
    xy = rng.uniform(-0.06, 0.06)
    iron = np.array(((rng.uniform(0.88, 1.12), xy), (xy, rng.uniform(0.88, 1.12))))
    soft = np.linalg.inv(iron)
    soft /= math.sqrt(np.linalg.det(soft))
    # The unit's own tilt errs, and its sensors bend.
    tilt = compass.TILT * rng.normal(size=2) / NORMAL
    bend = 1 + compass.LINEARITY * rng.normal(size=2) / NORMAL
    level = 25.0 * np.array((np.cos(heading), np.sin(heading)))
    level += up * np.sin(tilt)[:, None]
    field = (iron @ level) * bend[:, None] + hard[:, None] + motor[:, None] * current
    field += 0.03 * rng.standard_normal(field.shape)
    believed = np.unwrap(np.arctan2(field[1], field[0]))
    flat = np.zeros(count)
    circle = compass.FieldCircle(field[0], field[1], np.full(count, up), flat, flat, current, believed)
    return judged(
        compass.result_of(circle),
        {
            **dict(zip(("hard_x", "hard_y", "motor_x", "motor_y"), (*hard, *motor), strict=True)),
            "soft_xx": soft[0, 0],
            "soft_xy": soft[0, 1],
            "soft_yy": soft[1, 1],
        },
    )


def steering_fit(rng: np.random.Generator) -> list[Verdict]:
    """Straights along a string, arcs and full circles; then weaves."""
    assert isinstance(CHASSIS, TruckChassis)
    model = SteeringModel(CHASSIS)
    true = Maps(
        (1439.2 + rng.uniform(-40, 40), 1439.2 + rng.uniform(-40, 40)),
        (-10.48 * rng.uniform(0.9, 1.1), 10.48 * rng.uniform(0.9, 1.1)),
    )
    arcs = [(sign * 0.18 * (1 - i), sign * 0.18 * i, way) for i in (0, 1) for sign in (1, -1) for way in (1.0, -1.0)]
    circles = [(s * 0.35, 0.0, 5.6) for s in (1, -1)] + [(0.0, s * 0.35, 5.6) for s in (1, -1)]
    both = [(s * 0.35, -s * 0.35, 2.8) for s in (1, -1)]
    straights = [(0.0, 0.0, sign * 2.0) for _ in range(3) for sign in (1, -1)]
    legs = [steered_leg(model, true, *leg, rng) for leg in (*arcs, *circles, *both, *straights)]
    fit = model.fit(legs, MAPS)
    halves = half_widths(fit)
    names = ("front_centre", "front_scale", "rear_centre", "rear_scale")
    bands = (BAND, BAND / SPAN) * 2
    # A servo stops anywhere in its dead band: the interval covers it, the mean of many moves has little of it.
    found = [Interval(float(fit.parameters[i]), math.hypot(float(halves[i]), bands[i])) for i in range(len(names))]
    actual = true.parameters[:4] + np.array(bands) * rng.normal(size=4) / NORMAL
    pulse_maps = [
        Verdict(f"steering.{name}", i.value, i.low, i.high, float(t))
        for name, i, t in zip(names, found, actual, strict=True)
    ]
    return [*pulse_maps, *_weaves(rng)]


def steered_leg(
    model: SteeringModel, true: Maps, front: float, rear: float, way: float, rng: np.random.Generator
) -> SteeringRun:
    motor = np.full(16, CHASSIS.drivetrain.motor_angle(way) / 16)
    linkage = CHASSIS.linkage
    assert linkage is not None
    servos = CHASSIS.servos(front, rear)
    pulses = tuple(np.full(16, float(MAPS.pulses(axle, np.array(servos[axle])))) for axle in (0, 1))
    (ideal,), (aside,) = model.predict([SteeringRun(motor, (pulses[0], pulses[1]), 0.0, 0.0)], true)
    part = min(abs(math.remainder(float(ideal), math.tau)), 1.0)
    sigma = math.hypot(ASSUMED.turn_heading, ASSUMED.turn_compass * part, ASSUMED.turn_linkage * float(ideal))
    turn = float(ideal) + math.hypot(sigma, ASSUMED.turn_slip * math.sqrt(abs(way))) * rng.normal()
    string = front == rear == 0.0 and way > 0.0
    offset = float(aside) + 0.0076 * rng.normal() if string else None
    return SteeringRun(motor, (pulses[0], pulses[1]), turn, sigma, offset, 0.0076)


def _weaves(rng: np.random.Generator) -> list[Verdict]:
    """Delay of the steering from three weaves ahead and back."""
    delay, lag = rng.uniform(0.02, 0.15), rng.uniform(0.0, 0.06)
    dead = max(delay - lag, 0.0)
    late = ASSUMED.servo_wait * rng.uniform(-1, 1)  # how long commands wait for a pulse since this start
    at = np.arange(0.0, 12.0, 0.04)
    changes = np.cumsum(WEAVE * 4)
    sides = np.array([1.0 if k % 2 else -1.0 for k in range(len(changes))])
    seen = []
    for sign in (1, -1):
        for _ in range(3):
            commanded = Steps(0.6, changes, 1.2 * sides)
            turned = 0.15 * sign * commanded.integral(at, dead + lag + late, lag**2)
            turned = turned + 0.01 * rng.normal() * at + 0.003 * rng.standard_normal(at.size)
            stride = round(BASE / 0.04)
            ways = 0.15 * sign * at
            seen.append(weave.Weave(commanded, at, ways, stride, turned[stride:] - turned[:-stride]))

    def residuals(delay: float, squared: float) -> np.ndarray:
        return np.concatenate([one.residuals(delay, squared) for one in seen])

    found: dict[str, Estimate] = {
        e.name: e for e in weave.estimates(ResponseFit.of(residuals, ASSUMED.servo_wait, ASSUMED.weave_linearity))
    }
    e = found["delay"]
    return [Verdict("steering.delay", e.value, e.low, e.high, dead + lag)]


def odometry_fit(rng: np.random.Generator) -> list[Verdict]:
    """Squares to both sides."""
    assert isinstance(CHASSIS, TruckChassis)
    model = odometry.SquareModel(SteeringModel(CHASSIS), MAPS, AHEAD)
    true = np.array((rng.uniform(0.95, 1.05), rng.uniform(0.95, 1.05), rng.uniform(-0.04, 0.04)))
    # What the interval's bounds cover besides: floor, linkage and wheels that are steered while the truck stands.
    besides = ASSUMED.floor_slip, math.hypot(ASSUMED.square_linkage, ASSUMED.square_on_the_spot), 0.0
    actual = true * (1 + np.array(besides) * rng.normal(size=3) / NORMAL)
    squares = square_legs(model, actual, rng)
    fit = model.fit(squares, 0.002, 0.0035)
    way, base, offset = odometry.intervals(fit, 16 + 6)
    found = {"way": way.joined(besides[0]), "wheelbase": base.joined(besides[1]), "offset": offset}
    return [
        Verdict(f"odometry.{name}", i.value, i.low, i.high, float(t))
        for (name, i), t in zip(found.items(), true, strict=True)
    ]


def square_legs(model: odometry.SquareModel, actual: np.ndarray, rng: np.random.Generator) -> list[odometry.Square]:
    """A square to each side of a truck whose parameters are ``actual``, as it is measured."""
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
        place = math.hypot(ASSUMED.square_place, 0.007)
        squares.append(odometry.Square(runs, side, (end[0] + place * rng.normal(), end[1] + place * rng.normal())))
    return squares


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
    turn += math.hypot(sigma, ASSUMED.turn_slip * math.sqrt(way)) * rng.normal()
    return SteeringRun(motor, (pulses[0], pulses[1]), turn, sigma)


def lidar_fit(rng: np.random.Generator) -> list[Verdict]:
    """Quarters of circles and straights."""
    x, y, yaw = rng.uniform((0.10, -0.03, -0.05), (0.18, 0.03, 0.05))
    error = math.radians(0.15)
    true = np.array((x, y, yaw, 1 + 0.01 * rng.normal(), error * rng.normal()))
    centre = ASSUMED.turning_centre * rng.normal()
    legs = []
    for side in (1, -1):
        for way, turn in ((1.0, 0.0), (-1.0, 0.0), *((0.665, side * 1.52),) * 4):
            turn = turn + 0.01 * rng.normal()
            sigma = 0.006
            actual = true + np.array(
                (centre, 0.0, 0.0, ASSUMED.leg_distance * rng.normal(), ASSUMED.leg_direction * rng.normal())
            )
            seen = lidar.seen_motion(actual, np.array((way,)), np.array((turn,)), np.zeros(1))[0]
            seen[:2] += sigma * rng.normal(size=2)
            legs.append(lidar.LidarLeg(way, (float(seen[0]), float(seen[1]), float(seen[2])), sigma))
    offset = lidar.Offset(Interval(0.0, 0.01), 100)
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
                    -imu.ONE_G * math.sin(lean[0]) + force["force_x"] + 0.05 * rng.normal(),
                    imu.ONE_G * math.cos(lean[0]) * math.sin(lean[1]) + force["force_y"] + 0.05 * rng.normal(),
                    imu.ONE_G,
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
            way = ASSUMED.sliding * 0.021 * max(left, right)
            place, aim = (
                math.hypot(ASSUMED.rest_position, way),
                math.hypot(ASSUMED.rest_heading, ASSUMED.sliding * abs(yaw)),
            )
            motion = x + place * rng.normal(), y + place * rng.normal(), yaw + aim * rng.normal()
            arcs.append(slip.SkidArc(sign * left, sign * right, motion, (0.0003, 0.0005)))
    return judged(slip.result_of(arcs, 0.021, 0.0525), truth)


def sonar_fit(rng: np.random.Generator) -> list[Verdict]:
    """Four arcs beside a wall."""
    settings = Srf08Config()
    cone, factor = rng.uniform(0.75, 0.95), 1 + 0.01 * rng.normal()
    wall, turned = 1.7 + rng.uniform(-0.05, 0.05), rng.uniform(-0.06, 0.06)
    true = {
        name: sonar.SonarPose(*(np.array(s.mount.planar) + rng.uniform(-1, 1, 3) * (0.03, 0.03, 0.1)))
        for name, s in settings.sonars.items()
    }
    legs = sonar_legs(true, (wall, turned), cone / 2, factor, rng)
    result = sonar.result_of(legs, settings, wall + 0.002 * rng.normal(), 0.002)
    truth = {"cone": cone, "speed_of_sound": settings.speed_of_sound * factor}
    truth |= {f"{n}_{what}": float(v) for n, p in true.items() for what, v in zip(("x", "y", "yaw"), p, strict=True)}
    return judged(result, truth)


def sonar_legs(
    places: Mapping[str, sonar.SonarPose],
    wall: tuple[float, float],
    half: float,
    factor: float,
    rng: np.random.Generator,
    turn: float = math.tau,
) -> list[sonar.SonarLeg]:
    """Arcs ahead and back to both sides, 5 pings a second: ranges with the sonars' noise, over ``factor``.

    Odometry turns too little by another share on every arc, drifts between, and errs in the way.
    """
    legs: list[sonar.SonarLeg] = []
    aside, turned, further = 0.0, 0.0, 1.0 + ASSUMED.sonar_scale[1] * rng.normal()
    step = 0.2 * sonar.SonarWizard().speed / ARC
    for side in (1, -1):
        for way in (1, -1):
            angles = np.arange(0.0, turn, step)[::way] * side
            radius = side * ARC
            poses = np.column_stack((radius * np.sin(angles), radius * (1 - np.cos(angles)), angles))
            nearer, drift, more = (np.array(ASSUMED.sonar_arc) * rng.normal(size=3)).tolist()
            nearer, drift = (nearer, drift) if legs else (0.0, 0.0)
            actual = _drifted(poses, aside + nearer, turned + drift, more, further)
            aside, turned = (actual[-1] - poses[-1])[1:].tolist()
            ranges = {}
            for name, place in places.items():
                due, past = sonar.wall_range(actual, place, wall, half)
                heard = due / factor + np.hypot(ASSUMED.sonar_noise[0], ASSUMED.sonar_noise[1] * due) * rng.normal(
                    size=due.size
                )
                ranges[name] = np.where((past <= 0.45) & (due <= 3.0), heard, np.inf)
            legs.append(sonar.SonarLeg(dict.fromkeys(places, poses), ranges))
    return legs


def _drifted(poses: Array, aside: float, turned: float, more: float, further: float) -> Array:
    """Where a robot is that begins an arc off by so many m and rad, turns by a share more than ``poses`` say, and comes
    ``further`` times as far."""
    x, y, yaw = poses.T
    off = turned + more * (yaw - yaw[0])
    rolled = further * np.exp(1j * (off[1:] + off[:-1]) / 2) * (np.diff(x) + 1j * np.diff(y))
    at = x[0] + 1j * (y[0] + aside) + np.cumsum(np.append(0.0, rolled))
    return np.column_stack((at.real, at.imag, yaw + off))


def stabiliser_fit(rng: np.random.Generator) -> list[Verdict]:
    """Heights of the beam, and the floor on blocks."""
    settings = Ax12Config()
    zeros = 511 + rng.uniform(-8, 8), 204 + rng.uniform(-8, 8)
    directions = int(rng.choice((-1, 1))), int(rng.choice((-1, 1)))
    stands = mounted(settings, zeros, directions, rng)
    height, walls = 0.25, (2.0, 2.5)
    true = true_joints(settings, stands[0][1], zeros, directions)
    sigma = math.hypot(0.002 * math.sqrt(2), ASSUMED.tape_floor * 0.002) / math.sqrt(2)
    centre, ahead, left = (
        height,
        height - walls[0] * math.sin(stands[0][0].pitch + true.pitch),
        height + walls[1] * math.sin(stands[0][0].roll + true.roll),
    )
    heights = stabiliser.Heights(*(h + sigma * rng.normal() for h in (centre, ahead, left)))
    flat, nose, side = (stand for _, _, stand in stands)
    result = stabiliser.result_of(flat, nose, side, heights, walls, settings, 0.002)
    truth = {"pitch_zero": zeros[0], "pitch_direction": directions[0]}
    return judged(result, truth | {"roll_zero": zeros[1], "roll_direction": directions[1]})


def true_joints(
    settings: Ax12Config, said: stabiliser.RollPitch, zeros: tuple[float, float], directions: tuple[int, int]
) -> stabiliser.RollPitch:
    """What joints really are that the driver says to be at ``said``, rad."""
    pitch, roll = (
        direction * (joint.zero + joint.direction * angle / STEP - zero) * STEP
        for joint, angle, zero, direction in zip((settings.pitch, settings.roll), said, zeros, directions, strict=True)
    )
    return stabiliser.RollPitch(pitch, roll)


def mounted(
    settings: Ax12Config, zeros: tuple[float, float], directions: tuple[int, int], rng: np.random.Generator
) -> list[tuple[stabiliser.RollPitch, stabiliser.RollPitch, stabiliser.RestMeasurement]]:
    """The truck level, nose low, right side low: its true tilt, what the driver says of the joints, what was read."""
    angles = np.linspace(-2.09, 2.09, 682)
    found = []
    for pitch, roll in ((0.01, -0.005), (0.155, 0.0), (0.0, 0.185)):
        body = stabiliser.RollPitch(pitch, roll)
        seen = stabiliser.RollPitch(
            pitch + stabiliser.ASSUMED.compass_tilt * rng.normal(),
            roll + stabiliser.ASSUMED.compass_tilt * rng.normal(),
        )
        said = stabiliser.RollPitch(round(-pitch / STEP) * STEP, round(-roll / STEP) * STEP)
        really = true_joints(settings, said, zeros, directions)
        up = stabiliser.beams_up(body, really, angles)
        ranges = np.minimum(np.where(up < 0.0, 0.25 / np.maximum(-up, 1e-9), np.inf), 3.5)
        ranges = ranges * (1 + 0.01 * rng.normal(size=angles.size))
        found.append((body, said, stabiliser.RestMeasurement(seen, said, angles, ranges)))
    return found


def camera_fit(rng: np.random.Generator) -> list[Verdict]:
    """A board held before camera and lidar: corners with noise, and the lidar's line on it."""
    reader = BoardReader(BoardConfig())
    lens = true_lens(rng)
    believed = np.array((0.18, 0.0, 0.25, 0.0, 0.0, 0.0))
    true = believed + rng.uniform(-1, 1, 6) * (0.03, 0.03, 0.03, 0.06, 0.06, 0.06)
    lidar = LidarPlace.of(Mount(x=0.14, z=0.25, yaw=0.02))
    size, far = 1 + ASSUMED.board_size * rng.normal(), ASSUMED.board_range * rng.normal()
    guide = BoardGuide(
        reader, lens, lambda v: board_mount.line_on_board(v, reader, lens, true, lidar, known=True) is not None, 60.0
    )
    while guide.missing():
        guide.keep(held_boards(reader, lens, true, lidar, rng, size, far, count=1, steep=0.5)[0])
    found, kept = camera.lens_of(guide.views, reader, lens.size)
    result = camera.result_of(found, len(kept), camera.mount_of(kept, reader, found, believed, lidar, {}))
    values = dict(zip((*PARAMETERS, *board_mount.NAMES), (*lens.parameters, *true), strict=True))
    return judged(result, {name: float(value) for name, value in values.items()})


def true_lens(rng: np.random.Generator) -> Lens:
    """A webcam's, about as nominal."""
    focal, off = 522.2 * rng.uniform(0.94, 1.06), rng.uniform(-1, 1, 7)
    middle = 319.5 + 8 * off[0], 239.5 + 8 * off[1]
    matrix = np.array(((focal, 0.0, middle[0]), (0.0, focal * (1 + 0.003 * off[2]), middle[1]), (0.0, 0.0, 1.0)))
    distortion = np.array((-0.1 + 0.1 * off[3], 0.03 * off[4], 0.001 * off[5], 0.001 * off[6], 0.0))
    return Lens(matrix, distortion, (640, 480))


def held_boards(
    reader: BoardReader,
    lens: Lens,
    mount: Array,
    lidar: LidarPlace,
    rng: np.random.Generator,
    size: float = 1.0,
    far: float = 0.0,
    count: int = 28,
    steep: float = 0.0,
) -> list[BoardView]:
    """Views of a board, as a camera with ``lens`` at ``mount`` and a lidar see them.

    Args:
        reader: of the board.
        lens: true one.
        mount: true one, as ``NAMES``.
        lidar: where it is.
        rng: of how it is held, and of the noise.
        size: of the board, as a share of what is stated.
        far: what the lidar measures too far, m.
        count: views.
        steep: share of views that lean by 30 to 37 degrees, as the wizard asks for.
    """
    angles = np.linspace(-2.09, 2.09, 682)
    origin = board_mount.in_camera(np.zeros((1, 3)), mount, lidar)[0]
    beams = board_mount.in_camera(board_mount.directions(angles), mount, lidar) - origin
    found: list[BoardView] = []
    while len(found) < count:
        lean, turn = rng.uniform(-0.55, 0.55, 2)
        if steep and rng.random() < steep:
            lean = math.copysign(rng.uniform(0.53, 0.65), lean)
        axes = cv2.Rodrigues(np.array((lean, turn, 0.0)))[0]
        axes = axes @ cv2.Rodrigues(np.array((0.0, 0.0, rng.uniform(-0.35, 0.35))))[0]
        middle = rng.uniform(0.45, 0.9) * np.array((*(rng.uniform(-1, 1, 2) * (0.31, 0.2)), 1.0))
        wide, high = size * reader.board.width, size * reader.board.height
        place = middle - axes @ (wide / 2, high / 2, 0.0)
        shown, _ = cv2.projectPoints(size * reader.points, cv2.Rodrigues(axes)[0], place, lens.matrix, lens.distortion)
        pixels = np.asarray(shown).reshape(-1, 2) + 0.15 * rng.standard_normal((len(reader.points), 2))
        ids = np.flatnonzero(((pixels > 4) & (pixels < np.array(lens.size) - 5)).all(axis=1))
        if ids.size < 8:
            continue
        away = beams @ axes[:, 2]
        on = (origin + (axes[:, 2] @ (place - origin) / away)[:, None] * beams - place) @ axes
        met = (away > 0) & (on[:, 0] > 0) & (on[:, 0] < wide) & (on[:, 1] > 0) & (on[:, 1] < high)
        # The board is no plane: its middle is off, and it is warped.
        off = ASSUMED.board_flatness * rng.normal() + ASSUMED.board_warp * rng.normal() * (on[:, 0] - wide / 2)
        noise = 0.005 / math.sqrt(5) * rng.standard_normal(angles.size)
        ranges = np.where(met, (axes[:, 2] @ (place - origin) + off) / away + far + noise, 3.0)
        sighting = BoardSighting(pixels[ids], ids, 0.5)
        pose = board_pose(sighting, reader, lens)
        assert pose is not None
        found.append(BoardView(sighting, pose, angles, ranges))
    return found


LIGHT: Final[dict[str, Callable[[np.random.Generator], list[Verdict]]]] = {
    "battery": battery_fit,
    "drive": drive_fit,
    "compass": compass_fit,
    "steering": steering_fit,
    "odometry": odometry_fit,
    "lidar": lidar_fit,
    "imu": imu_fit,
    "slip": slip_fit,
    "sonar": sonar_fit,
    "stabiliser": stabiliser_fit,
    "camera": camera_fit,
}
"""By wizard."""
HALF_WIDTHS: Final = {
    "battery.offset": 0.1,
    "drive.drive_ratio": 0.01,
    "compass.hard_x": 0.87,
    "compass.hard_y": 0.87,
    "compass.soft_xx": 0.035,
    "compass.soft_yy": 0.035,
    "steering.front_centre": 8.5,
    "steering.rear_centre": 8.5,
    "steering.delay": 0.010,
    "odometry.way": 0.01,
    "odometry.wheelbase": 0.01,
    "odometry.offset": math.radians(0.5),
    "lidar.x": 0.010,
    "lidar.y": 0.010,
    "lidar.yaw": math.radians(0.5),
    "imu.rate_scale": 0.01,
    "slip.icr_left": 0.002,
    "slip.gain_left": 0.01,
    "slip.gain_right": 0.01,
    "stabiliser.pitch_zero": 3.4,
    "stabiliser.roll_zero": 3.4,
    "sonar.cone": math.radians(2.0),
    "sonar.speed_of_sound": 3.4,
    **{
        f"sonar.{name}_{what}": half
        for name in ("l", "fl", "f", "fr", "r")
        for what, half in (("x", 0.015), ("y", 0.015), ("yaw", math.radians(3.0)))
    },
    "camera.focal_x": 5.2,
    "camera.focal_y": 5.2,
    "camera.centre_x": 4.6,
    "camera.centre_y": 4.6,
    **{f"camera.{name}": 0.015 for name in ("x", "y", "z")},
    **{f"camera.{name}": math.radians(half) for name, half in (("yaw", 0.5), ("pitch", 0.5), ("roll", 0.5))},
}
"""Median half-widths at most: 0.1 V, 1 % of ways and wheels, 2 degrees by iron in 25 uT, 0.5 degrees of an axle (8.5
us), 10 ms, 10 mm and 0.5 degrees of the lidar, 2 mm of turning centres, 15 mm and 3 degrees of sonars, 1 % of the
speed of sound, 1 degree (3.4 steps) of the stabiliser."""


def coverage(wizard: str, fits: int) -> dict[str, tuple[float, float]]:
    """Share of true values inside, and median half-width, by estimate."""
    found: dict[str, list[Verdict]] = {}
    for seed in range(fits):
        for verdict in LIGHT[wizard](np.random.default_rng([seed, 26])):
            if verdict.low is not None:  # what has none is a choice, no number
                found.setdefault(verdict.name, []).append(verdict)
    return {
        name: (
            sum(v.holds for v in rows) / len(rows),
            float(np.median([(v.high - v.low) / 2 for v in rows if v.high is not None and v.low is not None])),
        )
        for name, rows in found.items()
    }
