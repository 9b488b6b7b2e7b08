"""The robot's physics: motors, clutches, steering, tyres, body, battery; integrated lazily on a fixed grid.

Steps are 5 ms: a quarter of the fastest lag (which is integrated exactly anyway), a quarter of a servo frame, and at
0.22 m/s a body point moves less than 2 mm a step, so testing the footprint after each step misses no cell. A step
ends early at the requested instant; the grid itself never shifts.
"""

from collections import deque
from collections.abc import Callable
from math import copysign, cos, exp, hypot, pi, sin
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from monstertruck_drivers.emulation import PulseSource
from monstertruck_kinematics.chassis import Chassis, TruckChassis
from monstertruck_kinematics.dynamics import SingleTrack
from monstertruck_kinematics.elementary import Array, integrate
from monstertruck_kinematics.linkage import dragged_speeds
from monstertruck_kinematics.truck import LinkedAxles
from monstertruck_sim.world.actuators import RPM, Servo, Shaft
from monstertruck_sim.world.battery import BatteryModel
from monstertruck_sim.world.config import BatteryModelConfig, SimTruckConfig
from monstertruck_sim.world.noise import SLIP, SlowNoise
from monstertruck_sim.world.skid import SkidEffects

STEP_NS = 5_000_000
SERVO_FRAME_NS = 20_000_000
GRAVITY = 9.81
_HISTORY = 120
_FREED = 0.005
_SLIP_PERIOD_NS = 200_000_000
_FELT = 0.05
"""Time constant with which an accelerometer feels the body's acceleration, s: its mount and filter."""

Pose = tuple[float, float, float]
Twist = tuple[float, float, float]
Contact = Callable[[float, float, float], float]
"""How deep the footprint at (x, y, yaw) reaches into things, m; 0 = free."""
Tilt = Callable[[int, float, float, float], tuple[float, float]]
"""Pitch (nose down positive) and roll (right side down positive), rad, at (elapsed ns, x, y, yaw)."""


class TruthState(NamedTuple):
    """What is really the case; SI units and radians, map frame, geometric centre."""

    time_ns: int
    x: float
    y: float
    yaw: float
    """In (-pi, pi]."""
    v: float
    """Along the direction of travel, negative backwards."""
    wz: float
    front: float
    """Angle of the equivalent bicycle's front axle, left positive; 0 for a motion that no bicycle makes."""
    rear: float
    pitch: float
    """Nose down positive (REP 103)."""
    roll: float
    """Right side down positive."""
    stuck: bool
    """Ran into something and has not got 5 mm away since."""
    clutch_slipping: bool
    charge: float
    """Of the battery, 0..1."""
    supply_v: float
    motor_current: float
    """A, forwards positive."""


class TruckPlant:
    """One robot in its surroundings: by default the truck, else the body that ``config`` names.

    Every driven shaft has its own motor, clutch and share of the mass.

    Args:
        config: true parameters.
        battery: the pack.
        start: pose of the geometric centre.
        contact: collision test.
        tilt: ground under the truck.
        seed: of the slip noise; None = none.
    """

    def __init__(
        self,
        config: SimTruckConfig,
        battery: BatteryModelConfig,
        start: Pose,
        contact: Contact,
        tilt: Tilt,
        seed: int | None,
    ) -> None:
        self.config = config
        self.battery = BatteryModel(battery)
        self._chassis = config.chassis()
        count = len(self._chassis.shafts)
        self._mass = config.mass / count
        """Share of every driven shaft, kg."""
        self._weight = self._mass * GRAVITY
        self._rolling = config.rolling_resistance * self._weight
        self._gearing = config.motor.ratio * config.motor.efficiency
        self._quiet = [0.0] * (2 + count)
        self.shafts = tuple(Shaft(config.motor) for _ in range(count))
        self.currents = [0.0] * count
        self.pulses: PulseSource | None = None
        self.servo_supply = True
        """The steering servos have their 5 V."""
        self._servos = tuple(map(Servo, config.servos))
        self._steering = _Steering(self._chassis)
        self._tyres = _tyres(config, self._chassis)
        self._skid = SkidEffects(config.skid, seed) if config.body.kind == "skid_steer" else None
        self._contact, self._tilt = contact, tilt
        self._noise = SlowNoise(seed, SLIP, 2 + count, _SLIP_PERIOD_NS) if seed is not None else None
        self._start_ns: int | None = None
        self._elapsed = 0
        self._pose = start
        self._attitude = tilt(0, *start)
        self._wheel_speeds = [0.0] * count
        self._pulls = [0.0] * count
        self._slipping = [False] * count
        self._stuck_at: Pose | None = None
        self._twist = (0.0, 0.0, 0.0)
        self.acceleration = (0.0, 0.0)
        """Of the body, forward and left, as a sensor on it feels it, m/s^2; gravity is not in it."""
        self._trail: deque[tuple[float, ...]] = deque(maxlen=_HISTORY)
        self.together: Callable[[int], None] = lambda _: None
        """Brings what else moves in the world to an instant (ns), before this robot is integrated to it."""
        self.on_blocked: Callable[[Pose, Twist], None] = lambda _pose, _twist: None
        """Gets a pose that something keeps the robot from, and the twist with which it went there."""

    @property
    def pose(self) -> Pose:
        """Of the geometric centre in the map frame, at the newest instant."""
        return self._pose

    @property
    def twist(self) -> Twist:
        """Velocity in the body frame: m/s, m/s, rad/s."""
        return self._twist

    @property
    def attitude(self) -> tuple[float, float]:
        """Pitch and roll."""
        return self._attitude

    @property
    def current(self) -> float:
        """Of all motors together, A."""
        return sum(self.currents)

    @property
    def yaw(self) -> float:
        """Heading in the map frame, counting turns."""
        return self._pose[2]

    def advance(self, time_ns: int) -> None:
        """Integrate up to an instant; the first call sets the start, earlier instants change nothing."""
        self.together(time_ns)
        self.integrate(time_ns)

    def integrate(self, time_ns: int) -> None:
        """``advance`` of this robot alone."""
        if self._start_ns is None:
            self._start_ns = time_ns
            self._remember()
        until = time_ns - self._start_ns
        while self._elapsed < until:
            end = min((self._elapsed // STEP_NS + 1) * STEP_NS, until)
            self._step((end - self._elapsed) * 1e-9)
            self._elapsed = end
            if end % STEP_NS == 0:
                self._remember()

    def carry(self, pose: Pose) -> None:
        """Put the robot down elsewhere, at rest; sensors see no way between the two places."""
        self._pose, self._twist, self._stuck_at = pose, (0.0, 0.0, 0.0), None
        self._wheel_speeds = [0.0] * len(self.shafts)
        self._attitude = self._tilt(self._elapsed, *pose)
        self._trail.clear()
        self._remember()

    def slot(self, time_ns: int, period_ns: int) -> int:
        """Number of the period since the start that an instant falls into: the index of its noise."""
        return max(0, time_ns - (self._start_ns or 0)) // period_ns

    def truth(self) -> TruthState:
        """State at the newest instant."""
        x, y, yaw = self._pose
        vx, vy, wz = self._twist
        front, rear = self._chassis.axle_angles(self._twist, self._steering.angles)
        return TruthState(
            time_ns=(self._start_ns or 0) + self._elapsed,
            x=x,
            y=y,
            yaw=pi - (pi - yaw) % (2 * pi),
            v=copysign(hypot(vx, vy), vx) if vx or vy else 0.0,
            wz=wz,
            front=front,
            rear=rear,
            pitch=self._attitude[0],
            roll=self._attitude[1],
            stuck=self._stuck_at is not None,
            clutch_slipping=any(self._slipping),
            charge=self.battery.charge,
            supply_v=self.battery.volts,
            motor_current=self.current,
        )

    def poses(self, times_ns: NDArray[np.int64]) -> Array:
        """Poses at instants of the last half second, (5, n): x, y, yaw, pitch, roll.

        Instants not yet integrated are extrapolated at the present velocity; none of them binds the future.
        """
        assert self._start_ns is not None
        seconds = (times_ns - self._start_ns) * 1e-9
        oldest = float(seconds[0]) - 2e-9 * STEP_NS
        trail = [row for row in self._trail if row[0] >= oldest]
        trail.append((self._elapsed * 1e-9, *self._pose, *self._attitude))
        if (ahead := float(seconds[-1]) - trail[-1][0]) > 0:
            for part in (0.5, 1.0):
                pose = integrate(self._pose, *self._twist, ahead * part)
                trail.append((self._elapsed * 1e-9 + ahead * part, *pose, *self._attitude))
        found = np.zeros((5, len(seconds)))
        level = not any(pitch or roll for *_, pitch, roll in trail)
        at, *rows = np.array(trail).T
        for i, row in enumerate(rows[:3] if level else rows):
            found[i] = np.interp(seconds, at, row)
        return found

    def _remember(self) -> None:
        self._trail.append((self._elapsed * 1e-9, *self._pose, *self._attitude))

    def _step(self, dt: float) -> None:
        self._steer(dt)
        resistance, constant, watts = self.config.motor.winding_resistance, self.config.motor.torque_constant, 0.0
        for i, shaft in enumerate(self.shafts):
            shaft.step(dt)
            current = self._drive(i, shaft, dt)
            watts += current**2 * resistance + abs(current * constant * shaft.rpm * RPM)
        before = self._twist
        self._move(dt)
        self._accelerate(before, dt)
        self.battery.step(dt, watts)

    def _steer(self, dt: float) -> None:
        if self.pulses is not None and self._elapsed % SERVO_FRAME_NS == 0:
            now = (self._start_ns or 0) + self._elapsed
            for servo, config in zip(self._servos, self.config.servos, strict=True):
                servo.latch(self.pulses.pulse_us(config.channel, now) if self.servo_supply else None)
        for servo in self._servos:
            servo.step(dt)
        self._steering.follow(*(servo.angle for servo in self._servos))

    def _drive(self, i: int, shaft: Shaft, dt: float) -> float:
        """Wheels follow their motor as fast as the clutch can pull mass, slope and rolling resistance; its current."""
        motor, speed = self.config.motor, self._wheel_speeds[i]
        wanted = self._chassis.drivetrain.speed(shaft.rpm * RPM)
        rolling = self._rolling * min(max(speed / 0.01, -1.0), 1.0)
        resistance = rolling - self._weight * sin(self._attitude[0])
        followed = (wanted - speed) * (1.0 - exp(-dt / motor.drivetrain_lag))
        pull = self._mass * followed / dt + resistance
        if self._stuck_at is not None and speed == 0.0 and wanted != 0.0:
            pull = copysign(2 * motor.clutch_force, wanted)  # wound up until the clutch gives
        slipping = self._slipping[i] = abs(pull) > motor.clutch_force
        if slipping:
            pull = copysign(motor.clutch_force, pull)
            change = (pull - resistance) * dt / self._mass
            followed = copysign(min(abs(change), abs(followed)), followed) if change * followed > 0 else change
        self._wheel_speeds[i] = speed + followed
        self._pulls[i] = pull
        current = 0.0
        if shaft.powered:
            inertia = motor.rotor_inertia * shaft.slope * RPM
            load = pull * self.config.wheel_radius / self._gearing
            idle = copysign(motor.idle_current, shaft.rpm) if shaft.rpm else 0.0
            current = idle + (load + inertia) / motor.torque_constant
            if shaft.blocked and shaft.demand_rpm:
                current = copysign(motor.peak_current, shaft.demand_rpm)
        self.currents[i] = current
        return current

    def _accelerate(self, before: tuple[float, float, float], dt: float) -> None:
        vx, vy, wz = self._twist
        true = (vx - before[0]) / dt - wz * vy, (vy - before[1]) / dt + wz * vx
        share = 1.0 - exp(-dt / _FELT)
        forward, left = self.acceleration
        self.acceleration = forward + share * (true[0] - forward), left + share * (true[1] - left)

    def _move(self, dt: float) -> None:
        config, steering, wheels = self.config, self._steering, self._wheel_speeds
        front_noise, rear_noise, *slip_noises = self._noise.at(self._elapsed) if self._noise else self._quiet
        lateral = 0.0
        if self._tyres is None:
            vx, _, wz = self._twist
            lateral = (vx * wz + GRAVITY * sin(self._attitude[1])) * copysign(1.0, wheels[0])
        front_slip = config.front_slip_angle * lateral - config.slip_angle_noise * front_noise
        rear_slip = config.rear_slip_angle * lateral - config.slip_angle_noise * rear_noise
        half = len(steering.angles) // 2
        angles = [angle - front_slip for angle in steering.angles[:half]]
        angles += [angle - rear_slip for angle in steering.angles[half:]]
        pace = []
        for wheel, pull, slip_noise in zip(wheels, self._pulls, slip_noises, strict=True):
            slip = config.slip_per_newton * pull * copysign(1.0, wheel) + config.slip_noise * slip_noise
            pace.append(wheel * steering.body_per_wheel * (1.0 - slip) * cos(self._attitude[0]))
        if self._skid is None:
            twist = self._chassis.twist(tuple(pace), *angles)
        else:
            rolled = self._chassis.twist(tuple(self._skid.wheel_speeds(pace)), *angles)
            twist = self._skid.twist(rolled, self._pose[2], dt)
        if self._tyres is not None:
            speed = copysign(hypot(twist[0], twist[1]), twist[0])
            front, rear = angles
            twist = self._tyres.step(self._twist, speed, front, rear if self._chassis.freedom == "both" else 0.0, dt)
        pose = integrate(self._pose, *twist, dt)
        depth = self._contact(*pose) if pose != self._pose else 0.0
        if depth > 0.0 and depth >= self._contact(*self._pose):
            self.on_blocked(pose, twist)
            self._stuck_at = self._pose
            self._wheel_speeds = [0.0] * len(self.shafts)
            self._twist = (0.0, 0.0, 0.0)
        else:
            self._pose, self._twist = pose, twist
            if self._stuck_at and hypot(pose[0] - self._stuck_at[0], pose[1] - self._stuck_at[1]) > _FREED:
                self._stuck_at = None
        self._attitude = self._tilt(self._elapsed, *self._pose)


class _Steering:
    """Steering angles behind the linkage, and how fast the body goes per speed of the wheels; recomputed on change.

    The truck's one motor drives four wheels through open differentials: it turns with the mean of the speeds at which
    the body drags them, each along its own angle.
    """

    def __init__(self, chassis: Chassis) -> None:
        self._chassis = chassis
        self._servos: tuple[float, ...] | None = None
        self.follow(*chassis.straight)

    def follow(self, *servos: float) -> None:
        if servos == self._servos:
            return
        self._servos = servos
        self.angles = self._chassis.steering(*servos)
        self.body_per_wheel = 1.0
        linkage = self._chassis.linkage
        if isinstance(self._chassis, TruckChassis) and isinstance(linkage, LinkedAxles):
            wheels = linkage.wheel_angles(*servos)
            self.body_per_wheel = 4.0 / sum(dragged_speeds(linkage.geometry, 1.0, wheels))


def _tyres(config: SimTruckConfig, chassis: Chassis) -> SingleTrack | None:
    if config.dynamics == "kinematic":
        return None
    return SingleTrack(chassis.bicycle, config.mass, config.yaw_inertia, config.front_stiffness, config.rear_stiffness)
