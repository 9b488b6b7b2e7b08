"""Physics of the sensors, for the emulators."""

from collections.abc import Callable
from math import atan2, degrees, hypot, pi, radians
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from monstertruck_drivers.emulation import (
    CompassReading,
    ImuReading,
    JointSource,
    MotorReading,
    PulseSource,
    RangeSheet,
)
from monstertruck_kinematics.elementary import Array, Real, cos, rotation, sin
from monstertruck_kinematics.se2 import Pose2
from monstertruck_runtime.clock import SECOND
from monstertruck_sim.world.board import panel_ranges
from monstertruck_sim.world.camera import FlatPanel
from monstertruck_sim.world.config import (
    BatteryModelConfig,
    CompassModelConfig,
    ImuModelConfig,
    LidarConfig,
    MotorConfig,
    SimTruckConfig,
)
from monstertruck_sim.world.noise import (
    ANALOG,
    COMPASS,
    COMPASS_FIXED,
    CURRENT,
    IMU,
    IMU_FIXED,
    LIDAR,
    LIDAR_BEAMS,
    WhiteNoise,
    generator,
)
from monstertruck_sim.world.plant import PLANT_GRAVITY, Caster, Plant, Xyz
from monstertruck_sim.world.terrain import Terrain

URG_SHEET = RangeSheet(0.02, 5.6, 0.01, 0.01)
"""URG-04LX: 10 mm to 1 m, 1 % beyond."""
SWEEP_STEPS = 769
SWEEP_NS = 100_000_000
NO_RETURN, TOO_NEAR, FAILED = 0, 6, 19
"""Error codes of the scanner: no return; other error (never "free"); step not measurable."""
BEAM_ANGLES = (np.arange(SWEEP_STEPS) - 384) * (2 * pi / 1024)
_BEAM_DELAYS = (np.arange(SWEEP_STEPS) * (SWEEP_NS // 1024)).astype(np.int64)

Beams = tuple[Array, Array, Array]
"""Directions: components x, y, z, each (n,)."""
LEVEL_BEAMS: Beams = np.cos(BEAM_ANGLES), np.sin(BEAM_ANGLES), np.zeros(SWEEP_STEPS)


class Sweep(Protocol):
    """Casts a lidar's beams through the world."""

    def __call__(self, poses: Array, beams: Beams | None, times_ns: NDArray[np.int64], reach: float, /) -> Array:
        """Ranges (m); inf without a return.

        Args:
            poses: robot poses at the beam times, (6, n): x, y, yaw, pitch, roll, height.
            beams: directions in the body frame; None for ``BEAM_ANGLES`` in the body's plane.
            times_ns: beam times, (n,), increasing.
            reach: maximum horizontal distance (m).
        """


class UnevenGround(Protocol):
    """Ground whose height varies."""

    def height(self, x: Array, y: Array) -> Array:
        """Return the heights at points in the map frame (m); all arrays have the same shape."""

    def cast(self, xs: Array, ys: Array, zs: Array, headings: Array, rises: Array, reach: float) -> Array:
        """Return horizontal distances along beams from points, all of shape (n,); inf beyond ``reach``."""


class PlaneSweep:
    """Beams over a plane with upright walls, or over uneven ground.

    A beam hits the ground, hits a wall, or passes over walls of finite height. The mount's height above the ground is
    taken to be the same as on level ground.

    Args:
        cast: casts rays to the walls.
        terrain: the ground; None if it is level.
        config: lidar configuration.
    """

    def __init__(self, cast: Caster, terrain: Terrain | None, config: LidarConfig) -> None:
        self._cast, self._terrain, self._config = cast, terrain, config

    def __call__(self, poses: Array, beams: Beams | None, times_ns: NDArray[np.int64], reach: float) -> Array:
        """See ``Sweep``."""
        x, y, yaw, pitch, roll, _ = poses
        xs, ys = self._places(x, y, yaw)
        # 1e-4: maximum tilt of a level robot, rad
        if beams is None and self._terrain is None and np.abs(poses[3:5]).max() < 1e-4:
            return self._cast(xs, ys, yaw + BEAM_ANGLES, reach, times_ns)
        beams = turned(LEVEL_BEAMS if beams is None else beams, pitch, roll)
        if self._terrain is None:
            return self._tilted(xs, ys, yaw, beams, times_ns, reach)
        return self._over(self._terrain, poses, beams, times_ns, reach)

    def _places(self, x: Array, y: Array, yaw: Array) -> tuple[Array, Array]:
        """Return the position of the mount in the map frame for a body at (x, y, yaw)."""
        ahead, aside, c, s = self._config.x, self._config.y, np.cos(yaw), np.sin(yaw)
        return x + ahead * c - aside * s, y + ahead * s + aside * c

    def _tilted(
        self, xs: Array, ys: Array, yaw: Array, beams: Beams, times_ns: NDArray[np.int64], reach: float
    ) -> Array:
        """Return ranges along beams whose directions are given in the robot's level frame."""
        config = self._config
        forward, left, up = beams
        level = np.hypot(forward, left)
        ranges = self._cast(xs, ys, yaw + np.arctan2(left, forward), reach, times_ns) / level
        with np.errstate(divide="ignore", invalid="ignore"):
            ground = np.where(up < 0, config.height / -up, np.inf)
            ranges[config.height + ranges * up > config.wall_height] = np.inf
        nearest: Array = np.minimum(ranges, ground)
        return nearest

    def _over(self, terrain: Terrain, poses: Array, beams: Beams, times_ns: NDArray[np.int64], reach: float) -> Array:
        """Return ranges over uneven ground; the arguments are those of ``_tilted``."""
        config, (x, y, yaw, pitch, *_) = self._config, poses
        xs, ys = self._places(x, y, yaw)
        zs = terrain.height(x, y) - config.x * np.sin(pitch) + config.height
        return over(self._cast, terrain, config, (xs, ys, zs), yaw, beams, times_ns, reach)


def over(
    cast: Caster,
    ground: UnevenGround,
    config: LidarConfig,
    origins: Beams,
    yaw: Array,
    beams: Beams,
    times_ns: NDArray[np.int64],
    reach: float,
) -> Array:
    """Return ranges to uneven ground and the walls on it (m); inf without a return.

    Args:
        cast: horizontal ranges to the walls.
        ground: the ground.
        config: lidar configuration.
        origins: beam origins in the map frame (m).
        yaw: yaw of the robot, (n,).
        beams: directions in the robot's level frame.
        times_ns: beam times.
        reach: maximum horizontal distance (m).
    """
    (xs, ys, zs), (forward, left, up) = origins, beams
    level = np.hypot(forward, left)
    headings, rises = yaw + np.arctan2(left, forward), up / level
    walls = cast(xs, ys, headings, reach, times_ns)
    hit = np.isfinite(walls)
    way = np.where(hit, walls, 0.0)
    foot = ground.height(xs + way * np.cos(headings), ys + way * np.sin(headings))
    walls[hit & (zs + rises * way > foot + config.wall_height)] = np.inf
    found = ground.cast(xs, ys, zs, headings, rises, reach)
    ranges: Array = np.minimum(walls, found) / level
    return ranges


class SimulatedLidar:
    """``ScannedRoom``: every beam starts at the truck's pose at the time of that beam.

    Noise is Gaussian, with two standard deviations equal to the data sheet's bound, because a manufacturer's accuracy
    figure covers nearly all readings. The joints of a mount turn the lidar about the mount's centre.

    Args:
        plant: the robot that carries the sensor.
        sweep: ranges along the beams.
        config: true parameters.
        seed: noise seed; None for no noise.
    """

    def __init__(self, plant: Plant, sweep: Sweep, config: LidarConfig, seed: int | None) -> None:
        self.joints: JointSource | None = None
        self.board_at: Callable[[int], FlatPanel | None] = lambda _: None
        """Board that a person holds in front of the robot."""
        self._plant, self._sweep, self._config, self._seed = plant, sweep, config, seed
        self._lost = (np.arange(SWEEP_STEPS) < config.first_step) | (np.arange(SWEEP_STEPS) > config.last_step)
        """Steps that never measure."""
        self._mounted = _mounted(config, LEVEL_BEAMS)

    def scan(self, time_ns: int) -> NDArray[np.int32]:
        """Return the distances (mm) of the revolution started at ``time_ns``, (769,); values below 20 are error codes.

        Call it up to half a second after the sweep for exact poses; an earlier call extrapolates the truck's motion
        during the sweep.
        """
        self._plant.advance(time_ns)
        sheet = self._sheet(URG_SHEET)
        ranges = self._cast(self._mounted, LEVEL_BEAMS, time_ns + _BEAM_DELAYS, sheet.greatest)
        return self._measure(ranges, time_ns, sheet)

    def beams(self, bearings: Array, times_ns: NDArray[np.int64], sheet: RangeSheet) -> Array:
        """See ``BeamSource``."""
        first = int(times_ns[0])
        self._plant.advance(int(times_ns[-1]))
        sheet = self._sheet(sheet)
        level = np.cos(bearings), np.sin(bearings), np.zeros(len(bearings))
        ranges = self._cast(_mounted(self._config, level) or level, level, times_ns, sheet.greatest)
        if self._seed is not None:
            noise = generator(self._seed, LIDAR_BEAMS, self._plant.slot(first, 1))
            ranges = ranges + self._sigma(ranges, sheet) * noise.standard_normal(len(ranges))
            ranges[noise.random(len(ranges)) < self._config.dropout] = np.nan
        ranges[ranges > sheet.greatest] = np.inf
        return ranges

    def _sheet(self, sheet: RangeSheet) -> RangeSheet:
        """Return the device's data sheet, with the ranges that the world's configuration overrides."""
        config = self._config
        least = sheet.least if config.min_range is None else config.min_range
        return sheet._replace(least=least, greatest=config.max_range or sheet.greatest)

    def _cast(self, mounted: Beams | None, level: Beams, times: NDArray[np.int64], reach: float) -> Array:
        """Return the true ranges (m), (n,), of beams in the frame of the lidar's carrier; None for ``LEVEL_BEAMS``."""
        poses, beams = self._plant.poses(times), mounted
        if self.joints is not None:
            beams = turned(level if beams is None else beams, *self.joints.angles(times))
        ranges = self._sweep(poses, beams, times, reach)
        if (board := self.board_at(int(times[0]))) is not None:
            ranges = np.minimum(ranges, self._held(board, poses[:, 0], level if beams is None else beams))
        return ranges

    def _sigma(self, ranges: Array, sheet: RangeSheet) -> Array:
        """Return the standard deviations, (n,) (m); 0 without a return."""
        met = np.where(np.isfinite(ranges), ranges, 0.0)
        sigma = np.maximum(sheet.error, sheet.relative_error * met) / self._config.accuracy_sigmas
        return np.where(np.isfinite(ranges), sigma, 0.0)

    def _held(self, board: FlatPanel, pose: Array, beams: Beams) -> Array:
        """Return the ranges to a board in front of a robot at rest (m); inf without a return."""
        x, y, yaw, pitch, roll, height = pose.tolist()
        body, config = rotation(yaw, pitch, roll), self._config
        origin = np.array((x, y, height)) + body @ np.array((config.x, config.y, config.height))
        return panel_ranges(board, origin, np.stack(beams, axis=1) @ body.T)

    def _measure(self, ranges: Array, time_ns: int, sheet: RangeSheet) -> NDArray[np.int32]:
        lost = self._lost
        if self._seed is not None:
            noise = generator(self._seed, LIDAR, self._plant.slot(time_ns, SWEEP_NS // 2))
            ranges = ranges + self._sigma(ranges, sheet) * noise.standard_normal(SWEEP_STEPS)
            lost = self._lost | (noise.random(SWEEP_STEPS) < self._config.dropout)
        seen = ranges <= sheet.greatest
        millimetres: NDArray[np.int32] = np.rint(np.where(seen, ranges, 0.0) * 1000).astype(np.int32)
        millimetres[seen & (ranges < sheet.least)] = TOO_NEAR
        millimetres[~seen] = NO_RETURN
        millimetres[lost] = FAILED
        return millimetres


class SimulatedMotor:
    """``MotorPlant`` for one driven shaft, with the controller's sign."""

    def __init__(self, plant: Plant, config: MotorConfig, seed: int | None, shaft: int = 0) -> None:
        self._plant, self._config, self._shaft = plant, config, shaft
        self._noise = WhiteNoise(seed, CURRENT, 1 + shaft) if seed is not None else None
        self._sign = -1.0 if config.inverted else 1.0

    def command(self, time_ns: int, target_rpm: float | None, accel_rpm_s: float) -> None:
        """Ramp towards ``target_rpm``, starting at ``time_ns``; None switches the power stage off (coasting)."""
        self._plant.advance(time_ns)
        self._plant.shafts[self._shaft].command(None if target_rpm is None else self._sign * target_rpm, accel_rpm_s)

    @property
    def target_rpm(self) -> float:
        """Speed that the controller commands (rpm); 0 while the power stage is off."""
        return self._sign * (self._plant.shafts[self._shaft].target or 0.0)

    def reading(self, time_ns: int) -> MotorReading:
        """State at ``time_ns``."""
        self._plant.advance(time_ns)
        shaft, current = self._plant.shafts[self._shaft], self._plant.currents[self._shaft]
        if self._noise is not None:
            current += self._config.current_noise * self._noise.at(self._plant.slot(time_ns, 1_000_000))[self._shaft]
        return MotorReading(
            turns=self._sign * shaft.turns,
            rpm=self._sign * shaft.rpm,
            demand_rpm=self._sign * shaft.demand_rpm,
            current_ma=self._sign * current * 1000,
            supply_v=self._plant.battery.volts,
        )


class SimulatedServos:
    """``ServoPlant``: both steering servos, and the battery at the analog input."""

    def __init__(self, plant: Plant, config: BatteryModelConfig, seed: int | None) -> None:
        self._plant, self._config = plant, config
        self._noise = WhiteNoise(seed, ANALOG) if seed is not None else None

    @property
    def inputs(self) -> frozenset[int]:
        """Analog inputs for battery voltage and current."""
        current = self._config.current_channel
        return frozenset({self._config.channel, *(() if current is None else (current,))})

    def attach(self, pulses: PulseSource) -> None:
        """Set the controller whose pulses move the servos."""
        self._plant.pulses = pulses

    def advance(self, time_ns: int) -> None:
        """Let the servos follow their pulses up to ``time_ns``."""
        self._plant.advance(time_ns)

    def analog_volts(self, channel: int, time_ns: int) -> float:
        """Return the voltage at an analog input; 0 except at the inputs for battery voltage and current."""
        config, battery = self._config, self._plant.battery
        if channel not in (config.channel, config.current_channel):
            return 0.0
        self._plant.advance(time_ns)
        volts = battery.analog_volts
        if channel == config.current_channel:
            volts = config.current_zero + battery.current * config.volts_per_amp
        if self._noise is not None:
            volts += self._config.analog_noise * self._noise.at(self._plant.slot(time_ns, 1_000_000))[0]
        return max(0.0, volts)


class SimulatedCompass:
    """``AttitudeSource``: a magnetometer and an accelerometer on the body, axes x forward, y left, z up.

    The accelerometer measures the reaction to gravity and to the body's own acceleration, from which the compass
    computes pitch and roll. The level field is rotated by the deviation curve and noise, tilted with the body, and
    distorted by the truck's iron and the motor's current. The heading is compensated using the true tilt: heading
    errors caused by acceleration are not modelled.
    """

    def __init__(self, plant: Plant, config: CompassModelConfig, seed: int | None) -> None:
        self._plant, self._config = plant, config
        self._noise = WhiteNoise(seed, COMPASS, 3) if seed is not None else None
        self._phases, self._bias = [0.0, 0.0], [0.0, 0.0]
        self._deviation = 0.0
        if seed is not None:
            fixed = generator(seed, COMPASS_FIXED)
            self._phases = fixed.uniform(0, 2 * pi, 2).tolist()
            self._bias = (radians(config.tilt_bias_deg) * fixed.uniform(-1, 1, 2)).tolist()
            self._deviation = radians(config.deviation_deg)

    def deviation(self, heading: float) -> float:
        """Return the fixed heading error (rad): a one-cycle and a two-cycle wave within the configured amplitude."""
        one, two = heading + self._phases[0], 2 * heading + self._phases[1]
        return self._deviation * (0.6 * sin(one) + 0.4 * sin(two))

    def compass(self, time_ns: int) -> CompassReading:
        """Reading at ``time_ns``."""
        self._plant.advance(time_ns)
        config = self._config
        noise = [0.0, 0.0, 0.0]
        if self._noise is not None:
            sigma = radians(config.noise_deg)
            noise = [sigma * value for value in self._noise.at(self._plant.slot(time_ns, 10_000_000))]
        pitch, roll = self._plant.attitude
        heading = config.north_yaw - self._plant.pose[2]
        heading += self.deviation(heading) + noise[0]
        level = (config.horizontal_field * cos(heading), config.horizontal_field * sin(heading), config.vertical_field)
        field = self._distorted(_to_body(level, pitch, roll))
        forward, left, up = self._plant.acceleration
        force = _to_body((forward / PLANT_GRAVITY, left / PLANT_GRAVITY, 1.0 + up / PLANT_GRAVITY), pitch, roll)
        x, y, _ = turned(field, pitch, roll)
        pitch, roll = atan2(-force[0], hypot(force[1], force[2])), atan2(force[1], force[2])
        pitch, roll = pitch + self._bias[0] + noise[1], roll + self._bias[1] + noise[2]
        return CompassReading(
            heading_deg=degrees(atan2(y, x)) % 360.0,
            pitch_deg=-degrees(pitch),
            roll_deg=degrees(roll),
            temperature_c=config.temperature_c,
            field=field,
            acceleration=_to_body((0.0, 0.0, hypot(*force)), pitch, roll),
        )

    def _distorted(self, field: Xyz) -> Xyz:
        iron = self._config.iron
        return (
            iron.soft_x * field[0] + iron.soft_xy * field[1] + iron.hard_x,
            iron.soft_xy * field[0]
            + iron.soft_y * field[1]
            + iron.hard_y
            + self._config.motor_field * self._plant.current,
            iron.soft_z * field[2] + iron.hard_z,
        )


class SimulatedImu:
    """``ImuSource``: gyroscopes and accelerometers at the geometric centre, axes x forward, y left, z up.

    The sensors measure the body's rotation (only its yaw rate in the plane engine), and gravity and the body's
    acceleration, rotated by the tilt.
    """

    def __init__(self, plant: Plant, config: ImuModelConfig, seed: int | None) -> None:
        self._plant, self._config = plant, config
        self._noise = WhiteNoise(seed, IMU, 6) if seed is not None else None
        self._bias = [0.0] * 6
        if seed is not None:
            self._bias = generator(seed, IMU_FIXED).uniform(-1, 1, 6).tolist()

    def imu(self, time_ns: int) -> ImuReading:
        """Reading at ``time_ns``."""
        self._plant.advance(time_ns)
        config, (pitch, roll), (forward, left, up) = self._config, self._plant.attitude, self._plant.acceleration
        x, y, z = _to_body(self._plant.rates, pitch, roll)
        rates = x, y, z * config.rate_scale
        forces = _to_body((forward, left, PLANT_GRAVITY + up), pitch, roll)
        noise = [0.0] * 6
        if self._noise is not None:
            noise = self._noise.at(self._plant.slot(time_ns, 1_000_000))
        biases, scales = (config.rate_bias, config.acceleration_bias), (config.rate_noise, config.acceleration_noise)
        felt = [
            value + biases[i // 3] * self._bias[i] + scales[i // 3] * noise[i]
            for i, value in enumerate((*rates, *forces))
        ]
        return ImuReading(
            angular_velocity=(felt[0], felt[1], felt[2]),
            acceleration=(felt[3], felt[4], felt[5]),
            temperature_c=config.temperature_c,
        )


class SimulatedRearWheels:
    """``WheelSource``: the wheels of the rear axle roll with the robot's motion, independently of the driven wheel.

    Args:
        plant: the robot's physics.
        config: track and radius.
    """

    def __init__(self, plant: Plant, config: SimTruckConfig) -> None:
        self._plant = plant
        self._half, self._radius = config.track / 2, config.wheel_radius
        self._pose: Pose2 | None = None
        self._at = 0
        self._rolled = [0.0, 0.0]

    def wheels(self, time_ns: int) -> tuple[float, float]:
        """Return the angles at ``time_ns`` (rad)."""
        self._plant.advance(time_ns)
        x, y, yaw = self._plant.pose
        if self._pose is not None:
            self._roll(self._pose, (x, y, yaw), time_ns - self._at)
        self._pose, self._at = (x, y, yaw), time_ns
        return self._rolled[0] / self._radius, self._rolled[1] / self._radius

    def _roll(self, before: Pose2, now: Pose2, dt: int) -> None:
        """Add the wheel rotation along an arc; skip it if the robot was carried."""
        way = hypot(now[0] - before[0], now[1] - before[1])
        if way > 5.0 * dt / SECOND:  # maximum speed between two samples of a robot that was not carried, m/s
            return
        turn, middle = now[2] - before[2], (now[2] + before[2]) / 2
        chord = (now[0] - before[0]) * cos(middle) + (now[1] - before[1]) * sin(middle)
        forward = chord * (turn / 2 / sin(turn / 2) if turn else 1.0)
        self._rolled[0] += forward - self._half * turn
        self._rolled[1] += forward + self._half * turn


def turned(vector: tuple[Real, Real, Real], pitch: Real, roll: Real) -> tuple[Real, Real, Real]:
    """Apply the inverse of ``_to_body`` to one vector, or to many vectors with individual angles."""
    x, y, z = vector
    y, z = cos(roll) * y - sin(roll) * z, sin(roll) * y + cos(roll) * z
    return cos(pitch) * x + sin(pitch) * z, y, cos(pitch) * z - sin(pitch) * x


def _mounted(config: LidarConfig, level: Beams) -> Beams | None:
    """Return the beams of a lidar in the frame of its carrier; None if the lidar is mounted without rotation.

    Args:
        config: the lidar's mount.
        level: the beams in the lidar's own frame.
    """
    if config.yaw == config.pitch == config.roll == 0.0:
        return None
    x, y, z = turned(level, np.full(len(level[0]), config.pitch), np.full(len(level[0]), config.roll))
    c, s = cos(config.yaw), sin(config.yaw)
    return c * x - s * y, s * x + c * y, z


def _to_body(v: Xyz, pitch: float, roll: float) -> Xyz:
    """Transform a vector from the level frame to the body frame: Rx(-roll) Ry(-pitch) v."""
    x = cos(pitch) * v[0] - sin(pitch) * v[2]
    z = sin(pitch) * v[0] + cos(pitch) * v[2]
    return x, cos(roll) * v[1] + sin(roll) * z, cos(roll) * z - sin(roll) * v[1]
