"""Engine-independent interface between a robot's physics and its sensors and actuators; code shared by the engines."""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Sequence
from math import copysign, hypot, pi, remainder
from typing import ClassVar, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from monstertruck_drivers.emulation import JointSource, PulseSource
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import Pose2, Twist2, integrate
from monstertruck_sim.world.actuators import RPM, Servo, Shaft
from monstertruck_sim.world.battery import BatteryModel
from monstertruck_sim.world.config import BatteryModelConfig, ChargerConfig, SimTruckConfig

PLANT_GRAVITY = 9.81

Xyz = tuple[float, float, float]


class TruthState(NamedTuple):
    """Ground truth at the geometric centre, in the map frame; SI units and radians."""

    time_ns: int
    x: float
    y: float
    yaw: float
    """Yaw in (-pi, pi]."""
    v: float
    """Speed along the direction of travel, negative backwards."""
    wz: float
    front: float
    """Front axle angle of the equivalent bicycle, left positive; 0 for motion impossible for a bicycle."""
    rear: float
    pitch: float
    """Pitch, nose down positive (REP 103)."""
    roll: float
    """Roll, right side down positive."""
    stuck: bool
    """The robot ran into something and has not moved 5 mm away since."""
    clutch_slipping: bool
    charge: float
    """State of charge of the battery, 0..1."""
    supply_v: float
    motor_current: float
    """Total motor current, forwards positive (A)."""


class Caster(Protocol):
    """Ray caster in the plane."""

    def __call__(
        self, xs: Array, ys: Array, angles: Array, reach: float, times_ns: NDArray[np.int64] | None = None, /
    ) -> Array:
        """Return ranges along rays from (xs, ys) at ``angles`` in the map frame, up to ``reach``; inf without a hit.

        Moving objects are hit where they were at ``times_ns``: increasing times, one per ray, or None for the current
        time.
        """


class Plant(ABC):
    """Physics of one robot as seen by its sensors and actuators, integrated lazily on a fixed time grid.

    Args:
        config: true parameters.
        battery: battery model parameters.
        start: initial pose of the geometric centre.
        attitude: initial pitch and roll (rad).
    """

    STEP_NS: ClassVar[int]
    WHOLE_STEPS: ClassVar[bool]
    """Whether to integrate whole grid steps only; otherwise a step ends early at the requested instant."""

    def __init__(
        self, config: SimTruckConfig, battery: BatteryModelConfig, start: Pose2, attitude: tuple[float, float]
    ) -> None:
        self.config = config
        self.battery = BatteryModel(battery)
        self._chassis = config.chassis()
        count = len(self._chassis.shafts)
        self.shafts = tuple(Shaft(config.motor) for _ in range(count))
        """Driven shafts."""
        self.currents = [0.0] * count
        """Motor current of each shaft (A)."""
        self.pulses: PulseSource | None = None
        """Pulse output of the steering servo controller."""
        self.chargers: tuple[ChargerConfig, ...] = ()
        """Charging contacts in the world."""
        self.servo_supply = True
        """Whether the steering servos have their 5 V supply."""
        self._servos = tuple(map(Servo, config.servos))
        self._start_ns: int | None = None
        self._elapsed = 0
        self._pose = start
        self._twist: Twist2 = (0.0, 0.0, 0.0)
        self._attitude = attitude
        self._height = 0.0
        """Height of the base (m)."""
        self._stuck_at: Pose2 | None = None
        self._slipping = [False] * count
        # 600_000_000: length of the pose history, ns
        self._trail: deque[tuple[float, ...]] = deque(maxlen=600_000_000 // self.STEP_NS)
        self.joints: JointSource | None = None
        """Joints of the lidar mount, or None for a fixed mount."""
        self.together: Callable[[int], None] = lambda _: None
        """Advances the rest of the world to an instant (ns) before this robot is integrated to it."""
        self.on_blocked: Callable[[Pose2, Twist2], None] = lambda _pose, _twist: None
        """Called with the blocked pose and the robot's twist when something stops the robot."""

    @property
    def pose(self) -> Pose2:
        """Latest pose of the geometric centre in the map frame, with unwrapped yaw."""
        return self._pose

    @property
    def twist(self) -> Twist2:
        """Velocity in the body frame: m/s, m/s, rad/s."""
        return self._twist

    @property
    def attitude(self) -> tuple[float, float]:
        """Pitch (nose down positive) and roll (right side down positive) (rad)."""
        return self._attitude

    @property
    @abstractmethod
    def acceleration(self) -> Xyz:
        """Acceleration without gravity, as sensed on the body: forward, left, up in its level frame (m/s^2)."""

    @property
    @abstractmethod
    def rates(self) -> Xyz:
        """Angular velocity about the forward, left and up axes of the level frame (rad/s)."""

    @property
    def current(self) -> float:
        """Total current of all motors (A)."""
        return sum(self.currents)

    def advance(self, time_ns: int) -> None:
        """Integrate up to a time; the first call sets the start, and earlier times have no effect."""
        self.together(time_ns)
        self.integrate(time_ns)

    def integrate(self, time_ns: int) -> None:
        """Advance this robot alone."""
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
        """Return the latest load torque of the lidar on its pitch (0) or roll (1) joint (Nm); 0 in the plane."""
        return 0.0

    @abstractmethod
    def carry(self, pose: Pose2) -> None:
        """Move the robot to another pose, at rest; sensors see a jump, not a path between the two places."""

    def slot(self, time_ns: int, period_ns: int) -> int:
        """Return the index, counted from the start, of the period that contains a time; the index selects the noise."""
        return max(0, time_ns - (self._start_ns or 0)) // period_ns

    def truth(self) -> TruthState:
        """Return the latest ground truth."""
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
        """Return poses at times within the last half second, (6, n): x, y, yaw, pitch, roll, height of the base.

        In the plane the height is 0 on any ground. Poses at times not yet integrated are extrapolated at the current
        velocity, without affecting the integration.
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
        """Advance the servos by ``dt`` and return their angles (rad)."""
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
        """Update the motor currents from the pull of each shaft (N at the ground), and the battery charge."""
        motor, watts = self.config.motor, 0.0
        for i, (shaft, pull) in enumerate(zip(self.shafts, pulls, strict=True)):
            current = self.currents[i] = motor_current(self.config, shaft, pull)
            watts += current**2 * motor.winding_resistance + abs(current * motor.torque_constant * shaft.rpm * RPM)
        self.battery.step(dt, watts, self._charging())

    def _charging(self) -> float:
        """Return the current (A) from the charger on whose contacts the robot stands."""
        x, y, yaw = self._pose
        for charger in self.chargers:
            off, turn = hypot(x - charger.x, y - charger.y), remainder(yaw - charger.yaw, 2 * pi)
            if off <= charger.tolerance and abs(turn) <= charger.turn_tolerance:
                return charger.current
        return 0.0

    @abstractmethod
    def _steering_angles(self) -> tuple[float, ...]: ...

    @abstractmethod
    def _step(self, dt: float) -> None: ...


def motor_current(config: SimTruckConfig, shaft: Shaft, pull: float) -> float:
    """Return the current (A, forwards positive) of a motor whose wheels pull with ``pull`` (N at the ground)."""
    motor = config.motor
    if not shaft.powered:
        return 0.0
    if shaft.blocked and shaft.demand_rpm:
        return copysign(motor.peak_current, shaft.demand_rpm)
    inertia = motor.rotor_inertia * shaft.slope * RPM
    load = pull * config.wheel_radius / (motor.ratio * motor.efficiency)
    idle = copysign(motor.idle_current, shaft.rpm) if shaft.rpm else 0.0
    return idle + (load + inertia) / motor.torque_constant
