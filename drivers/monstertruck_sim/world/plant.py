"""What a robot's physics offers to its sensors and actuators, whichever engine computes it, and what engines share."""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Sequence
from math import copysign, hypot, pi
from typing import ClassVar, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from monstertruck_drivers.emulation import JointSource, PulseSource
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import Pose2, Twist2, integrate
from monstertruck_sim.world.actuators import RPM, Servo, Shaft
from monstertruck_sim.world.battery import BatteryModel
from monstertruck_sim.world.config import BatteryModelConfig, SimTruckConfig

PLANT_GRAVITY = 9.81

Xyz = tuple[float, float, float]


class TruthState(NamedTuple):
    """What is really the case; SI units and radians, map frame, geometric centre."""

    time_ns: int
    x: float
    y: float
    yaw: float
    """Yaw in (-pi, pi]."""
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
    """Charge of the battery, 0..1."""
    supply_v: float
    motor_current: float
    """A, forwards positive."""


class Caster(Protocol):
    """Sight in the plane."""

    def __call__(
        self, xs: Array, ys: Array, angles: Array, reach: float, times_ns: NDArray[np.int64] | None = None, /
    ) -> Array:
        """Ranges along rays from (xs, ys) at angles up to a reach, in the map frame; inf = nothing.

        What moves is met where it was at ``times_ns``, one a ray and rising; None = now.
        """


class Plant(ABC):
    """One robot, as its sensors and actuators see it, integrated lazily on a fixed grid of time.

    Args:
        config: true parameters.
        battery: the pack.
        start: pose of the geometric centre.
        attitude: pitch and roll there.
    """

    STEP_NS: ClassVar[int]
    WHOLE_STEPS: ClassVar[bool]
    """Whether nothing is integrated between two points of the grid; else a step ends early at the requested instant."""

    def __init__(
        self, config: SimTruckConfig, battery: BatteryModelConfig, start: Pose2, attitude: tuple[float, float]
    ) -> None:
        self.config = config
        self.battery = BatteryModel(battery)
        self._chassis = config.chassis()
        count = len(self._chassis.shafts)
        self.shafts = tuple(Shaft(config.motor) for _ in range(count))
        """Driven ones."""
        self.currents = [0.0] * count
        """Currents of their motors, A."""
        self.pulses: PulseSource | None = None
        """Pulses of the controller that moves the steering servos."""
        self.servo_supply = True
        """The steering servos have their 5 V."""
        self._servos = tuple(map(Servo, config.servos))
        self._start_ns: int | None = None
        self._elapsed = 0
        self._pose = start
        self._twist: Twist2 = (0.0, 0.0, 0.0)
        self._attitude = attitude
        self._height = 0.0
        """Height of the base, m."""
        self._stuck_at: Pose2 | None = None
        self._slipping = [False] * count
        # 600_000_000: what the past of a robot's poses is kept for
        self._trail: deque[tuple[float, ...]] = deque(maxlen=600_000_000 // self.STEP_NS)
        self.joints: JointSource | None = None
        """Joints of the lidar's mount; None: it is fixed."""
        self.together: Callable[[int], None] = lambda _: None
        """Brings what else moves in the world to an instant (ns), before this robot is integrated to it."""
        self.on_blocked: Callable[[Pose2, Twist2], None] = lambda _pose, _twist: None
        """Gets a pose that something keeps the robot from, and the twist with which it went there."""

    @property
    def pose(self) -> Pose2:
        """Of the geometric centre in the map frame, at the newest instant; the heading counts turns."""
        return self._pose

    @property
    def twist(self) -> Twist2:
        """Velocity in the body frame: m/s, m/s, rad/s."""
        return self._twist

    @property
    def attitude(self) -> tuple[float, float]:
        """Pitch (nose down positive) and roll (right side down positive), rad."""
        return self._attitude

    @property
    @abstractmethod
    def acceleration(self) -> Xyz:
        """Of the body, forward, left and up in its level frame, as a sensor on it feels it, m/s^2; without gravity."""

    @property
    @abstractmethod
    def rates(self) -> Xyz:
        """Angular velocity about forward, left and up of the level frame, rad/s."""

    @property
    def current(self) -> float:
        """Of all motors together, A."""
        return sum(self.currents)

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
        if self.WHOLE_STEPS:
            until -= until % self.STEP_NS
        while self._elapsed < until:
            end = min((self._elapsed // self.STEP_NS + 1) * self.STEP_NS, until)
            self._step((end - self._elapsed) * 1e-9)
            self._elapsed = end
            if end % self.STEP_NS == 0:
                self._remember()

    def mount_torque(self, _joint: int, /) -> float:
        """With which the lidar pushes its pitch (0) or roll (1) joint at the newest instant, Nm; 0 in the plane."""
        return 0.0

    @abstractmethod
    def carry(self, pose: Pose2) -> None:
        """Put the robot down elsewhere, at rest; sensors see no way between the two places."""

    def slot(self, time_ns: int, period_ns: int) -> int:
        """Number of the period since the start that an instant falls into: the index of its noise."""
        return max(0, time_ns - (self._start_ns or 0)) // period_ns

    def truth(self) -> TruthState:
        """State at the newest instant."""
        x, y, yaw = self._pose
        vx, vy, wz = self._twist
        front, rear = self._chassis.axle_angles(self._twist, self._steering_angles())
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
        """Poses at instants of the last half second, (6, n): x, y, yaw, pitch, roll, and the base's height.

        The height is 0 in the plane, whatever its ground. Instants not yet integrated are extrapolated at the present
        velocity; none of them binds the future.
        """
        assert self._start_ns is not None
        seconds = (times_ns - self._start_ns) * 1e-9
        oldest = float(seconds[0]) - 2e-9 * self.STEP_NS
        trail = [row for row in self._trail if row[0] >= oldest]
        trail.append((self._elapsed * 1e-9, *self._pose, *self._attitude, self._height))
        if (ahead := float(seconds[-1]) - trail[-1][0]) > 0:
            for part in (0.5, 1.0):
                pose = integrate(self._pose, *self._twist, ahead * part)
                trail.append((self._elapsed * 1e-9 + ahead * part, *pose, *self._attitude, self._height))
        found = np.zeros((6, len(seconds)))
        level = not any(pitch or roll or height for *_, pitch, roll, height in trail)
        at, *rows = np.array(trail).T
        for i, row in enumerate(rows[:3] if level else rows):
            found[i] = np.interp(seconds, at, row)
        return found

    def _remember(self) -> None:
        self._trail.append((self._elapsed * 1e-9, *self._pose, *self._attitude, self._height))

    def _turn_servos(self, dt: float) -> list[float]:
        """Angles of the servos after dt, rad."""
        if self.pulses is not None and self._elapsed % 20_000_000 == 0:  # a servo frame, ns
            now = (self._start_ns or 0) + self._elapsed
            for servo, config in zip(self._servos, self.config.servos, strict=True):
                servo.latch(self.pulses.pulse_us(config.channel, now) if self.servo_supply else None)
        for servo in self._servos:
            servo.step(dt)
        return [servo.angle for servo in self._servos]

    def _turn_motors(self, dt: float) -> None:
        for shaft in self.shafts:
            shaft.step(dt)

    def _draw(self, dt: float, pulls: Sequence[float]) -> None:
        """The motors' currents at the pulls of their shafts (N at the ground), and the battery's charge."""
        motor, watts = self.config.motor, 0.0
        for i, (shaft, pull) in enumerate(zip(self.shafts, pulls, strict=True)):
            current = self.currents[i] = motor_current(self.config, shaft, pull)
            watts += current**2 * motor.winding_resistance + abs(current * motor.torque_constant * shaft.rpm * RPM)
        self.battery.step(dt, watts)

    @abstractmethod
    def _steering_angles(self) -> tuple[float, ...]: ...

    @abstractmethod
    def _step(self, dt: float) -> None: ...


def motor_current(config: SimTruckConfig, shaft: Shaft, pull: float) -> float:
    """Of a motor whose wheels pull with ``pull``, N at the ground; A, forwards positive."""
    motor = config.motor
    if not shaft.powered:
        return 0.0
    if shaft.blocked and shaft.demand_rpm:
        return copysign(motor.peak_current, shaft.demand_rpm)
    inertia = motor.rotor_inertia * shaft.slope * RPM
    load = pull * config.wheel_radius / (motor.ratio * motor.efficiency)
    idle = copysign(motor.idle_current, shaft.rpm) if shaft.rpm else 0.0
    return idle + (load + inertia) / motor.torque_constant
