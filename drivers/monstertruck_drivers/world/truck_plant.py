"""The truck's physics: motor, clutch, steering, tyres, body, battery; integrated lazily on a fixed grid.

Steps are 5 ms: a quarter of the fastest lag (which is integrated exactly anyway), a quarter of a servo frame, and at
0.22 m/s a body point moves less than 2 mm a step, so testing the footprint after each step misses no cell. A step
ends early at the instant somebody asks for; the grid itself never shifts.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from math import copysign, cos, exp, hypot, pi, sin

import numpy as np
from numpy.typing import NDArray

from monstertruck_drivers.base import PulseSource
from monstertruck_drivers.world.actuators import RPM, Servo, Shaft
from monstertruck_drivers.world.battery import Battery
from monstertruck_drivers.world.config import BatteryConfig, TruckConfig
from monstertruck_drivers.world.noise import SLIP, SlowNoise
from monstertruck_kinematics.motion import integrate
from monstertruck_kinematics.polynomials import SteeringPolynomials
from monstertruck_kinematics.truck import DriveTrain, FourWheelSteering

STEP_NS = 5_000_000
SERVO_FRAME_NS = 20_000_000
GRAVITY = 9.81
_HISTORY = 120
_FREED = 0.005
_SLIP_PERIOD_NS = 200_000_000

Pose = tuple[float, float, float]
Contact = Callable[[float, float, float], float]
"""How deep the footprint at (x, y, yaw) reaches into things, m; 0 = free."""
Tilt = Callable[[int, float, float, float], tuple[float, float]]
"""Pitch (nose down positive) and roll (right side down positive), rad, at (elapsed ns, x, y, yaw)."""


@dataclass(frozen=True, slots=True)
class TruthState:
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
    """Bicycle angle of the front wheels, left positive."""
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
    """One truck in its surroundings.

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
        config: TruckConfig,
        battery: BatteryConfig,
        start: Pose,
        contact: Contact,
        tilt: Tilt,
        seed: int | None,
    ) -> None:
        self.config = config
        self.battery = Battery(battery)
        self.shaft = Shaft(config.motor)
        self.current = 0.0
        self.pulses: PulseSource | None = None
        self.servo_supply = True
        """The steering servos have their 5 V."""
        self._kinematics = FourWheelSteering(config.wheelbase, config.track)
        self._drivetrain = DriveTrain(config.motor.ratio, config.wheel_radius)
        self._front, self._rear = Servo(config.front_servo), Servo(config.rear_servo)
        self._steering = _Steering(SteeringPolynomials.named(config.steering), self._kinematics)
        self._contact, self._tilt = contact, tilt
        self._noise = SlowNoise(seed, SLIP, 3, _SLIP_PERIOD_NS) if seed is not None else None
        self._start_ns: int | None = None
        self._elapsed = 0
        self._pose = start
        self._attitude = tilt(0, *start)
        self._wheel_speed = 0.0
        self._pull = 0.0
        self._slipping = False
        self._stuck_at: Pose | None = None
        self._twist = (0.0, 0.0, 0.0)
        self._trail: deque[tuple[float, ...]] = deque(maxlen=_HISTORY)

    @property
    def attitude(self) -> tuple[float, float]:
        """Pitch and roll."""
        return self._attitude

    @property
    def yaw(self) -> float:
        """Heading in the map frame, counting turns."""
        return self._pose[2]

    def advance(self, time_ns: int) -> None:
        """Integrate up to an instant; the first call sets the start, earlier instants change nothing."""
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

    def slot(self, time_ns: int, period_ns: int) -> int:
        """Number of the period since the start that an instant falls into: the index of its noise."""
        return max(0, time_ns - (self._start_ns or 0)) // period_ns

    def truth(self) -> TruthState:
        """State at the newest instant."""
        x, y, yaw = self._pose
        vx, vy, wz = self._twist
        return TruthState(
            time_ns=(self._start_ns or 0) + self._elapsed,
            x=x,
            y=y,
            yaw=pi - (pi - yaw) % (2 * pi),
            v=copysign(hypot(vx, vy), vx) if vx or vy else 0.0,
            wz=wz,
            front=self._steering.front,
            rear=self._steering.rear,
            pitch=self._attitude[0],
            roll=self._attitude[1],
            stuck=self._stuck_at is not None,
            clutch_slipping=self._slipping,
            charge=self.battery.charge,
            supply_v=self.battery.volts,
            motor_current=self.current,
        )

    def poses(self, times_ns: NDArray[np.int64]) -> NDArray[np.float64]:
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
        rows = np.array(trail).T
        return np.stack([np.interp(seconds, rows[0], row) for row in rows[1:]])

    def _remember(self) -> None:
        self._trail.append((self._elapsed * 1e-9, *self._pose, *self._attitude))

    def _step(self, dt: float) -> None:
        self._steer(dt)
        self.shaft.step(dt)
        self._drive(dt)
        self._move(dt)
        winding_w = self.current**2 * self.config.motor.winding_resistance
        shaft_w = abs(self.current * self.config.motor.torque_constant * self.shaft.rpm * RPM)
        self.battery.step(dt, winding_w + shaft_w)

    def _steer(self, dt: float) -> None:
        if self.pulses is not None and self._elapsed % SERVO_FRAME_NS == 0:
            now = (self._start_ns or 0) + self._elapsed
            for servo, config in ((self._front, self.config.front_servo), (self._rear, self.config.rear_servo)):
                servo.latch(self.pulses.pulse_us(config.channel, now) if self.servo_supply else None)
        self._front.step(dt)
        self._rear.step(dt)
        self._steering.follow(self._front.angle, self._rear.angle)

    def _drive(self, dt: float) -> None:
        """Wheels follow the motor as fast as the clutch can pull mass, slope and rolling resistance."""
        config, motor = self.config, self.config.motor
        wanted = self._drivetrain.speed(self.shaft.rpm * RPM)
        weight = config.mass * GRAVITY
        rolling = config.rolling_resistance * weight * min(max(self._wheel_speed / 0.01, -1.0), 1.0)
        resistance = rolling - weight * sin(self._attitude[0])
        followed = (wanted - self._wheel_speed) * (1.0 - exp(-dt / motor.drivetrain_lag))
        pull = config.mass * followed / dt + resistance
        if self._stuck_at is not None and self._wheel_speed == 0.0 and wanted != 0.0:
            pull = copysign(2 * motor.clutch_force, wanted)  # wound up until the clutch gives
        self._slipping = abs(pull) > motor.clutch_force
        if self._slipping:
            pull = copysign(motor.clutch_force, pull)
            change = (pull - resistance) * dt / config.mass
            followed = copysign(min(abs(change), abs(followed)), followed) if change * followed > 0 else change
        self._wheel_speed += followed
        self._pull = pull
        inertia = motor.rotor_inertia * self.shaft.slope * RPM
        load = pull * config.wheel_radius / (motor.ratio * motor.efficiency)
        idle = copysign(motor.idle_current, self.shaft.rpm) if self.shaft.rpm else 0.0
        self.current = idle + (load + inertia) / motor.torque_constant if self.shaft.powered else 0.0

    def _move(self, dt: float) -> None:
        config = self.config
        front_noise, rear_noise, slip_noise = self._noise.at(self._elapsed) if self._noise else (0.0, 0.0, 0.0)
        vx, _, wz = self._twist
        sense = copysign(1.0, self._wheel_speed)
        lateral = (vx * wz + GRAVITY * sin(self._attitude[1])) * sense
        front = self._steering.front - config.front_slip_angle * lateral + config.slip_angle_noise * front_noise
        rear = self._steering.rear - config.rear_slip_angle * lateral + config.slip_angle_noise * rear_noise
        slip = config.slip_per_newton * self._pull * sense + config.slip_noise * slip_noise
        speed = self._wheel_speed * self._steering.body_per_wheel * (1.0 - slip) * cos(self._attitude[0])
        twist = self._kinematics.body_twist(speed, front, rear)
        pose = integrate(self._pose, *twist, dt)
        depth = self._contact(*pose) if pose != self._pose else 0.0
        if depth > 0.0 and depth >= self._contact(*self._pose):
            self._stuck_at = self._pose
            self._wheel_speed = 0.0
            self._twist = (0.0, 0.0, 0.0)
        else:
            self._pose, self._twist = pose, twist
            if self._stuck_at and hypot(pose[0] - self._stuck_at[0], pose[1] - self._stuck_at[1]) > _FREED:
                self._stuck_at = None
        self._attitude = self._tilt(self._elapsed, *self._pose)


class _Steering:
    """Axle angles behind the linkage, and how fast the body goes per speed of the wheels; recomputed on change.

    One motor drives four wheels through open differentials: it turns with the mean of the four wheel speeds.
    """

    def __init__(self, linkage: SteeringPolynomials, kinematics: FourWheelSteering) -> None:
        self._linkage, self._kinematics = linkage, kinematics
        self._servos: tuple[float, float] | None = None
        self.follow(0.0, 0.0)

    def follow(self, front_servo: float, rear_servo: float) -> None:
        if (front_servo, rear_servo) == self._servos:
            return
        self._servos = (front_servo, rear_servo)
        self.front, self.rear = self._linkage.axles_from_servo(front_servo, rear_servo)
        self.body_per_wheel = 4.0 / sum(self._kinematics.wheel_speeds(1.0, self.front, self.rear))
