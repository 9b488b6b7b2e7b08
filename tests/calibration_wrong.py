"""A swapped cable or a wrong sign that each wizard meets, and what it says, by its own error models: no daemon."""

import asyncio
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Final

import numpy as np

from monstertruck_drivers.ax12.config import Ax12Config
from monstertruck_drivers.srf08.config import Srf08Config
from monstertruck_estimation.slam.scans import Scan, ScanGeometry, prepare
from monstertruck_estimation.vision.board import BoardReader
from monstertruck_kinematics.se2 import between, compose, integrate
from monstertruck_kinematics.unsteered import SkidSteer
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.board import BoardConfig
from monstertruck_schemas.body import Mount
from monstertruckd.tools.calibrate import (
    battery,
    camera,
    compass,
    drive,
    imu,
    lidar,
    odometry,
    slip,
    sonar,
    stabiliser,
    steering,
)
from monstertruckd.tools.calibrate.board_mount import LidarPlace
from monstertruckd.tools.calibrate.statistics import Interval
from monstertruckd.tools.calibrate.steering_model import Maps, SteeringModel
from monstertruckd.tools.calibrate.steps import Confirm, MoveRecord, MoveStep
from tests.calibration_light import (
    AHEAD,
    CHASSIS,
    MAPS,
    held_boards,
    mounted,
    sonar_legs,
    square_legs,
    steered_leg,
    true_joints,
    true_lens,
)

Found = str
"""What the wizard said; empty: it noticed nothing."""


def complaint(attempt: Callable[[], Any]) -> Found:
    """What a refusal says."""
    try:
        attempt()
    except InputError as error:
        return str(error)
    return ""


def wrong_battery(rng: np.random.Generator) -> Found:
    """The battery's cable on another input: of a servo's supply, or of nothing."""
    volts = rng.uniform(21.0, 25.0)
    reading = battery.MeterReading(rng.choice((rng.uniform(4.8, 6.2), rng.uniform(0.05, 2.0))), volts, 0.003)
    return complaint(lambda: battery.check_input(reading, rng.uniform(0.94, 1.06)))


class _Rolls:
    """A context in which the truck rolls backward: of ``DriveWizard`` as far as it drives then."""

    def __init__(self, *, inverted: bool) -> None:
        self._inverted = inverted

    def value(self, _key: str) -> bool:
        return self._inverted

    async def confirm(self, step: Confirm) -> bool:
        return step.name != "forward"

    async def move(self, _step: MoveStep) -> MoveRecord:
        return MoveRecord()


def wrong_drive(rng: np.random.Generator) -> Found:
    """The motor's leads swapped: the sign is turned round, and nothing else is driven."""
    inverted = bool(rng.integers(2))
    result = asyncio.run(drive.DriveWizard()(_Rolls(inverted=inverted)))  # type: ignore[arg-type]
    sign = result.estimate("inverted")
    return result.again or "" if sign is not None and sign.value is not inverted else ""


def wrong_steering(rng: np.random.Generator) -> Found:
    """A servo of an axle turns the other way, or both do."""
    model, axle = SteeringModel(CHASSIS), int(rng.integers(3))  # type: ignore[arg-type]
    senses = (-1 if axle in (0, 2) else 1, -1 if axle in (1, 2) else 1)
    scales = (MAPS.scales[0] * senses[0] * rng.uniform(0.9, 1.1), MAPS.scales[1] * senses[1] * rng.uniform(0.9, 1.1))
    true = Maps((MAPS.centres[0] + rng.uniform(-40, 40), MAPS.centres[1] + rng.uniform(-40, 40)), scales)
    arcs = tuple(
        [
            steered_leg(model, true, side * 0.1 * (1 - i), side * 0.1 * i, way, rng)
            for side in (1, -1)
            for way in (0.4, -0.4)
        ]
        for i in (0, 1)
    )
    found = steering.steered_senses((arcs[0], arcs[1]))
    return " and ".join(name for name, sign in zip(("front", "rear"), found, strict=True) if sign < 0) * (
        found == senses
    )


def wrong_compass(rng: np.random.Generator) -> Found:
    """The unit upside down: its field turns against its heading."""
    count = 240
    heading = np.concatenate((np.linspace(0, 1.05 * math.tau, count // 2), np.linspace(1.05 * math.tau, 0, count // 2)))
    field = 25.0 * np.array((np.cos(heading), -np.sin(heading))) + rng.uniform(-7, 7, 2)[:, None]
    field += 0.03 * rng.standard_normal(field.shape)
    flat = np.zeros(count)
    circle = compass.FieldCircle(field[0], field[1], flat + 39.0, flat, flat, flat, heading)
    return complaint(lambda: compass.result_of(circle))


def wrong_odometry(rng: np.random.Generator) -> Found:
    """An axle steers the other way, or both."""
    model = odometry.SquareModel(SteeringModel(CHASSIS), MAPS, AHEAD)  # type: ignore[arg-type]
    squares = square_legs(model, np.array((rng.uniform(0.95, 1.05), rng.uniform(0.95, 1.05), 0.0)), rng)
    share = float(rng.choice((-1.0, rng.uniform(-0.1, 0.1))))  # of two axles, or of one
    turned = [
        odometry.Square(tuple(replace(leg, turn=share * leg.turn) for leg in square.legs), square.side, square.off)
        for square in squares
    ]
    return complaint(lambda: odometry.check_senses(model, turned))


def wrong_lidar(rng: np.random.Generator) -> Found:
    """The lidar upside down, or looking backwards."""
    upside_down = bool(rng.integers(2))
    mount = np.array((0.14, 0.0, 0.0 if upside_down else math.pi))
    pose = np.array((rng.uniform(-0.3, 0.3), rng.uniform(-0.3, 0.3), rng.uniform(-math.pi, math.pi)))
    believed, what = np.array((0.14, 0.0, 0.0)), "upside down" if upside_down else "backwards"
    for way, turn in ((1.0, 0.0), (-1.0, 0.0), (0.67, 1.5), (0.67, 1.5)):  # as the wizard begins
        half = turn / 2
        chord = way * (math.sin(half) / half if half else 1.0)
        end = compose(pose, np.array((chord * math.cos(half), chord * math.sin(half), turn)))
        before, after = (_room(compose(at, mount), rng, upside_down=upside_down) for at in (pose, end))
        guess = between(believed, compose(between(pose, end), believed))
        fit = lidar.register(after, lidar.Cloud.of(before), guess, reach=0.3)
        fit = lidar.register(after, lidar.Cloud.of(before), fit.pose)
        said = complaint(lambda: lidar.check_way_round(before, after, (way, turn), believed, fit.overlap))  # noqa: B023
        if said:
            return said if what in said else ""
        pose = end
    return ""


def _room(pose: np.ndarray, rng: np.random.Generator, *, upside_down: bool) -> Scan:
    """What a lidar at a pose sees of a room of 5 m x 4 m with a box in a corner and a pillar."""
    geometry = ScanGeometry(-2.09, 0.00614, 0.06, 5.6)
    angles = geometry.start_angle + geometry.angle_increment * np.arange(682)
    headings = pose[2] + (-angles if upside_down else angles)
    c, s = np.cos(headings), np.sin(headings)
    ranges = np.full(angles.size, np.inf)
    walls = (
        (-2.3, -1.8, 2.7, -1.8), (2.7, -1.8, 2.7, 2.2), (2.7, 2.2, -2.3, 2.2), (-2.3, 2.2, -2.3, -1.8),
        (1.6, 1.3, 2.7, 1.3), (1.6, 1.3, 1.6, 2.2), (-2.3, -0.9, -1.9, -0.9), (-1.9, -0.9, -1.9, -1.8),
    )  # fmt: skip
    for x1, y1, x2, y2 in walls:
        dx, dy = x2 - x1, y2 - y1
        cross = c * dy - s * dx
        with np.errstate(divide="ignore", invalid="ignore"):
            far = ((x1 - pose[0]) * dy - (y1 - pose[1]) * dx) / cross
            along = ((x1 - pose[0]) * s - (y1 - pose[1]) * c) / cross
        ranges = np.where((far > 0.0) & (along >= 0.0) & (along <= 1.0), np.minimum(ranges, far), ranges)
    return prepare(ranges + 0.003 * rng.standard_normal(ranges.size), geometry)


def wrong_imu(rng: np.random.Generator) -> Found:
    """The unit upside down."""
    turns = [
        imu.Turn(-side * (math.tau + 0.05) + 0.003 * rng.normal(), 20.0, side * (math.tau + 0.05), 0.003)
        for side in (1, -1, 1, -1)
    ]
    return complaint(lambda: imu.rate_scale(turns, Interval(rng.uniform(-0.01, 0.01), 0.0005)))


def wrong_slip(rng: np.random.Generator) -> Found:
    """Sides swapped, or one of them counts the other way."""
    fault = str(rng.choice(("swapped", "left", "right")))
    icr = rng.uniform(0.06, 0.1)
    robot = SkidSteer(0.021, icr_left=icr, icr_right=-icr, icr_x=0.0, gain_left=1.0, gain_right=1.0)
    arcs = []
    for left, right in ((8.0, 12.0), (12.0, 8.0), (5.0, 12.0), (12.0, 5.0), (20.0, 20.0)):
        for sign in (1, -1):
            x, y, yaw = integrate((0.0, 0.0, 0.0), *robot.forward((sign * left, sign * right)), 1.0)
            motion = x + 0.001 * rng.normal(), y + 0.001 * rng.normal(), yaw + 0.002 * rng.normal()
            counted = {"swapped": (right, left), "left": (-left, right), "right": (left, -right)}[fault]
            arcs.append(slip.SkidArc(sign * counted[0], sign * counted[1], motion, (0.0003, 0.0005)))
    said = complaint(lambda: slip.result_of(arcs, 0.021, 0.0525))
    return said if fault in said else ""


def wrong_sonar(rng: np.random.Generator) -> Found:
    """Two sonars swapped."""
    settings = Srf08Config()
    places = {name: sonar.SonarPose(*s.mount.planar) for name, s in settings.sonars.items()}
    first, second = rng.choice(list(places), 2, replace=False).tolist()
    crossed = {**places, first: places[second], second: places[first]}
    legs = sonar_legs(crossed, (1.7 + rng.uniform(-0.05, 0.05), rng.uniform(-0.06, 0.06)), 0.43, 1.0, rng, 3.5)
    said = complaint(lambda: sonar.result_of(legs, settings, 1.7, 0.002))
    return said if f"{first} receives the echoes expected at {second}" in said else ""


def wrong_stabiliser(rng: np.random.Generator) -> Found:
    """A servo turns the other way, or both do."""
    settings, which = Ax12Config(), int(rng.integers(3))
    senses = (-1 if which in (0, 2) else 1, -1 if which in (1, 2) else 1)
    zeros = 511 + rng.uniform(-8, 8), 204 + rng.uniform(-8, 8)
    stands = mounted(settings, zeros, senses, rng)
    true = true_joints(settings, stands[0][1], zeros, senses)
    body, walls = stands[0][0], (2.0, 2.5)
    heights = stabiliser.Heights(
        0.25, 0.25 - walls[0] * math.sin(body.pitch + true.pitch), 0.25 + walls[1] * math.sin(body.roll + true.roll)
    )
    flat, nose, side = (stand for _, _, stand in stands)
    result = stabiliser.result_of(flat, nose, side, heights, walls, settings, 0.002)
    found = tuple(result.estimate(f"{name}_direction").value for name in ("pitch", "roll"))  # type: ignore[union-attr]
    return (result.again or "") if found == senses else ""


def wrong_camera(rng: np.random.Generator) -> Found:
    """The board was printed at another scale: fitted to the page, or on paper of another size."""
    reader, lens, lidar = BoardReader(BoardConfig()), true_lens(rng), LidarPlace.of(Mount(x=0.14, z=0.25))
    mount = np.array((0.18, 0.0, 0.25, 0.0, 0.0, 0.0))
    size = float(rng.choice((0.94, 0.97 / 1.03, 1.06)))
    views = held_boards(reader, lens, mount, lidar, rng, size)
    found, kept = camera.lens_of(views, reader, lens.size)
    said = complaint(lambda: camera.mount_of(kept, reader, found, mount, lidar, {}))
    return said if "times as large as stated" in said else ""


WRONG: Final[Mapping[str, Callable[[np.random.Generator], Found]]] = {
    "battery": wrong_battery,
    "drive": wrong_drive,
    "compass": wrong_compass,
    "steering": wrong_steering,
    "odometry": wrong_odometry,
    "lidar": wrong_lidar,
    "imu": wrong_imu,
    "slip": wrong_slip,
    "sonar": wrong_sonar,
    "stabiliser": wrong_stabiliser,
    "camera": wrong_camera,
}
"""By wizard."""


def noticed(wizard: str, seeds: int) -> int:
    """How many of so many faults a wizard names."""
    return sum(bool(WRONG[wizard](np.random.default_rng([seed, 27]))) for seed in range(seeds))
