"""Drives in the emulators' world without daemon or serial lines: all measurements, and the truth.

The truck follows a polyline by its true pose; wheels and compass are read 20 times a second, the scanner ten times.
"""

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from monstertruck_drivers.emulation import CompassReading
from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.map_files import FREE, OCCUPIED, WorldMap, save_map
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.sensor import Attitude, DriveFeedback, DriveMode, SteeringFeedback, Vector3
from monstertruck_sim.world.config import MotorConfig, SimTruckConfig, WorldConfig
from monstertruck_sim.world.noise import generator
from monstertruck_sim.world.world import World

Route = tuple[tuple[float, float], ...]

TICK = SECOND // 100
SPEED, LOOKAHEAD = 0.3, 0.45
BEAM = 2 * math.pi / 1024
SWEEP = SECOND // 10
RIG_NOISE = 9
"""Stream of the noise that is not the world's own."""
ROOMS: Route = (
    (1.0, 3.95), (5.9, 3.95), (6.85, 4.5), (6.85, 5.5), (6.3, 6.4), (5.5, 6.65), (4.5, 6.6), (3.85, 5.8), (3.85, 4.6),
    (3.2, 4.0), (1.5, 3.95),
)  # fmt: skip
MAZE: Route = tuple(
    (1.4 * column, 1.4 * row)
    for column, row in (
        (0, 0), (1, 0), (2, 0), (3, 0), (3, 1), (4, 1), (4, 2), (5, 2), (6, 2), (6, 1), (5, 1), (5, 0), (4, 0),
    )
)  # fmt: skip


@dataclass(frozen=True)
class Scenario:
    """A kind of drive."""

    name: str
    map: str
    route: Route
    seconds: float
    slips: bool = False
    """Bursts in which the wheels turn faster than the truck drives."""
    magnet: tuple[float, float] | None = None
    """Place of a magnet."""
    carried: tuple[tuple[float, float, float], Route] | None = None
    """Half-way the truck is carried to this pose and follows another route."""


SCENARIOS = (
    Scenario("rooms", "rooms", ROOMS, 36),
    Scenario("maze", "corridor_maze", MAZE, 36),
    Scenario("corridor", "corridor", ((6.0, 0.0), (16.0, 0.0)), 24),
    Scenario("ramp", "ramp", ((0.0, 0.0), (7.6, 0.0)), 22),
    Scenario("slip", "rooms", ROOMS, 36, slips=True),
    Scenario("kidnap", "rooms", ROOMS, 36, carried=((6.3, 5.5, 1.5), ((6.3, 5.5), *ROOMS[4:]))),
    Scenario("magnet", "rooms", ROOMS, 36, magnet=(4.0, 4.5)),
)


@dataclass
class Drive:
    """All measurements in the order of their reports, and the truth."""

    start: tuple[float, float, float]
    reported: list[tuple[int, object]] = field(default_factory=list)
    """Instant at which it was reported, ns; message, or stamp and ranges (769,), m, of a scan."""
    truth: list[tuple[float, ...]] = field(default_factory=list)
    """Stamp in s, x, y, yaw."""
    carried: int | None = None
    """Instant, ns."""
    bursts: list[float] = field(default_factory=list)
    """Stamps at which the wheels begin to slip, s."""
    stuck: bool = False


class Pilot:
    """Servo pulses and motor speed by pure pursuit on the true pose, both axles alike."""

    def __init__(self, config: SimTruckConfig) -> None:
        self.config = config
        self.chassis = config.chassis()
        self.servos = (0.0, 0.0)

    def pulse_us(self, channel: int, time_ns: int) -> float:
        """See ``PulseSource``."""
        pairs = zip((self.config.front_servo, self.config.rear_servo), self.servos, strict=True)
        servo, angle = next(pair for pair in pairs if pair[0].channel == channel)
        return servo.centre_us + servo.us_per_degree * math.degrees(angle)

    def steer(self, pose: tuple[float, float, float], line: Array) -> float:
        """Set the servos; return the motor's speed, rpm."""
        nearest = int(np.argmin(np.hypot(*(line - pose[:2]).T)))
        ahead = min(nearest + round(LOOKAHEAD / 0.05), len(line) - 1)
        dx, dy = line[ahead] - pose[:2]
        side = -math.sin(pose[2]) * dx + math.cos(pose[2]) * dy
        curvature = 2 * side / max(dx * dx + dy * dy, 0.01)
        angle = math.atan(curvature * self.chassis.bicycle.wheelbase / 2)
        angles = self.chassis.reached((angle, -angle))
        self.servos = self.chassis.servos(*angles)
        speed = 0.0 if nearest >= len(line) - 3 else self.chassis.shaft_speeds(SPEED, *angles)[0]
        return self.chassis.drivetrain.motor_angle(speed) * 30 / math.pi


def driven(scenario: Scenario, seed: int, folder: Path) -> Drive:
    """Return one drive."""
    rng = generator(seed, RIG_NOISE)
    start = (*scenario.route[0], 0.0)
    bursts = [float(rng.uniform(4 + 8 * k, 9 + 8 * k)) for k in range(4)] if scenario.slips else []
    drive = Drive(start, bursts=[1.0 + burst for burst in bursts])
    half = scenario.seconds / 2 if scenario.carried is not None else scenario.seconds
    turns = _leg(drive, scenario, seed, folder, (start, scenario.route), (0.0, half), bursts, 0.0)
    if scenario.carried is not None:
        drive.carried = SECOND + round(half * SECOND)
        _leg(drive, scenario, seed + 100, folder, scenario.carried, (half, scenario.seconds), bursts, turns)
    return drive


def _leg(
    drive: Drive,
    scenario: Scenario,
    seed: int,
    folder: Path,
    way: tuple[tuple[float, float, float], Route],
    span: tuple[float, float],
    bursts: list[float],
    turns: float,
) -> float:
    """Drive ``way`` (start and route) for some seconds; ``turns`` of the motor before; return those after."""
    (x, y, yaw), route = way
    place = str(folder / "corridor.yaml") if scenario.map == "corridor" else scenario.map
    truck = SimTruckConfig(motor=MotorConfig(inverted=False))
    world = World(WorldConfig(map=place, start=Pose2D(x=x, y=y, yaw=yaw), truck=truck), seed)
    pilot, line = Pilot(truck), _dense(route)
    world.servos.attach(pilot)
    begin, end = (SECOND + round(second * SECOND) for second in span)
    slipped, before, swept = 0.0, 0.0, begin
    for count in range((end - begin) // TICK):
        now = begin + count * TICK
        state = world.truth(now)
        pose = (state.x, state.y, state.yaw)
        drive.truth.append((now / SECOND, *pose))
        drive.stuck |= state.stuck
        if count % 5 == 0:
            world.motors[0].command(now, pilot.steer(pose, line), 20_000.0)
            reading = world.motors[0].reading(now)
            seconds = now / SECOND
            if any(burst <= seconds - 1.0 < burst + 0.8 for burst in bursts):
                slipped += 0.9 * (reading.turns - before)
            before = reading.turns
            angle = (turns + reading.turns + slipped) * 2 * math.pi
            drive.reported.append((now, _steering(now, pilot.servos)))
            drive.reported.append((now, _drive(now, angle, reading.rpm * math.pi / 30)))
        if count % 5 == 2:
            compass = world.compass.compass(now)
            north = pose[2] + math.radians(compass.heading_deg)
            drive.reported.append((now, _attitude(now, compass, _magnet(scenario.magnet, pose, north))))
        if now >= swept + SWEEP:
            ranges = world.lidar.scan(swept).astype(np.float64) / 1000
            ranges[ranges < 0.02] = np.inf
            drive.reported.append((now, (swept, ranges)))
            swept = now
    return turns + before + slipped


def _magnet(
    place: tuple[float, float] | None, pose: tuple[float, float, float], north: float
) -> tuple[float, float, float]:
    """Return the heading (rad), and a magnet's addition to the level field along and across it, mG."""
    heading = north - pose[2]
    if place is None:
        return heading, 0.0, 0.0
    dx, dy = place[0] - pose[0], place[1] - pose[1]
    strength = 60.0 / max(math.hypot(dx, dy), 0.3) ** 3
    towards = math.atan2(dy, dx)
    x = 250.0 * math.cos(north) + strength * math.cos(towards)
    y = 250.0 * math.sin(north) + strength * math.sin(towards)
    return math.atan2(y, x) - pose[2], strength * math.cos(towards - north), strength * math.sin(towards - north)


def _attitude(now: int, reading: CompassReading, field_: tuple[float, float, float]) -> Attitude:
    heading, along, across = field_
    x, y, z = 25.0 + along / 10, across / 10, -39.0
    return Attitude(
        stamp=now,
        received=now,
        seq=0,
        heading=heading % (2 * math.pi),
        roll=math.radians(reading.roll_deg),
        pitch=-math.radians(reading.pitch_deg),
        magnetic_field=Vector3(x=x, y=y, z=z),
    )


def _drive(now: int, angle: float, velocity: float) -> DriveFeedback:
    return DriveFeedback(stamp=now, received=now, seq=0, position=angle, velocity=velocity, mode=DriveMode.ENABLED)


def _steering(now: int, servos: tuple[float, float]) -> SteeringFeedback:
    return SteeringFeedback(stamp=now, received=now, seq=0, front=servos[0], rear=servos[1])


def _dense(route: Route) -> Array:
    corners = np.array(route)
    lengths = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(corners, axis=0).T))))
    stations = np.arange(0.0, lengths[-1], 0.05)
    return np.stack([np.interp(stations, lengths, corners[:, k]) for k in (0, 1)], axis=-1)


def draw_corridor(folder: Path) -> None:
    """Write a map file of a featureless corridor, 22 m long and 1.6 m wide."""
    resolution = 0.025
    cells = np.full((round(2.0 / resolution), round(22.4 / resolution)), FREE, dtype=np.int8)
    skin = round(0.2 / resolution)
    cells[:skin], cells[-skin:], cells[:, :skin], cells[:, -skin:] = OCCUPIED, OCCUPIED, OCCUPIED, OCCUPIED
    save_map(WorldMap(cells, resolution, (-0.2, -1.0)), folder / "corridor.yaml")
