"""The truck in the plane: motors, clutches, steering, tyres, body, battery; integrated lazily on a fixed grid.

Steps are 5 ms: a quarter of the fastest lag (which is integrated exactly), a quarter of a servo frame, and short enough
that at 0.22 m/s a body point moves less than 2 mm, so that testing the footprint after each step misses no cell. A step
ends early at the requested instant; the time grid itself never shifts.
"""

from collections.abc import Callable
from math import copysign, cos, exp, hypot, sin
from typing import ClassVar

from monstertruck_kinematics.chassis import Chassis, TruckChassis
from monstertruck_kinematics.dynamics import SingleTrack
from monstertruck_kinematics.linkage import dragged_speeds
from monstertruck_kinematics.se2 import Pose2, Twist2, integrate
from monstertruck_kinematics.truck import LinkedAxles
from monstertruck_sim.world.actuators import RPM, Shaft
from monstertruck_sim.world.config import BatteryModelConfig, SimTruckConfig, SkidModelConfig
from monstertruck_sim.world.noise import SKID, SLIP, SlowNoise, generator
from monstertruck_sim.world.plant import PLANT_GRAVITY, Plant, Xyz

STEP_NS = 5_000_000

Contact = Callable[[float, float, float], float]
"""Penetration of the footprint at (x, y, yaw) into its surroundings (m); 0 if free."""
Tilt = Callable[[int, float, float, float], tuple[float, float]]
"""Pitch (nose down positive) and roll (right side down positive), rad, at (elapsed ns, x, y, yaw)."""


class TruckPlant(Plant):
    """One robot in its surroundings: the truck by default, or the body in ``config``.

    Every driven shaft has its own motor, clutch and share of the mass.

    Args:
        config: true parameters.
        battery: battery model parameters.
        start: initial pose of the geometric centre.
        contact: collision test.
        tilt: ground under the truck.
        seed: seed for the slip noise, or None for no noise.
    """

    STEP_NS: ClassVar[int] = STEP_NS
    WHOLE_STEPS: ClassVar[bool] = False

    def __init__(
        self,
        config: SimTruckConfig,
        battery: BatteryModelConfig,
        start: Pose2,
        contact: Contact,
        tilt: Tilt,
        seed: int | None,
    ) -> None:
        super().__init__(config, battery, start, tilt(0, *start))
        count = len(self.shafts)
        self._mass = config.mass / count
        """Share of the mass per driven shaft (kg)."""
        self._weight = self._mass * PLANT_GRAVITY
        self._rolling = config.rolling_resistance * self._weight
        self._quiet = [0.0] * (2 + count)
        self._steering = _Steering(self._chassis)
        self._tyres = _tyres(config, self._chassis)
        self._skid = SkidEffects(config.skid, seed) if config.body.kind == "skid_steer" else None
        self._contact, self._tilt = contact, tilt
        # 200_000_000: period of the slip, ns
        self._noise = SlowNoise(seed, SLIP, 2 + count, 200_000_000) if seed is not None else None
        self._wheel_speeds = [0.0] * count
        self._pulls = [0.0] * count
        self._felt = (0.0, 0.0)

    @property
    def acceleration(self) -> Xyz:
        """Acceleration without gravity, as sensed on the body: forward, left, up in its level frame (m/s^2)."""
        return *self._felt, 0.0

    @property
    def rates(self) -> Xyz:
        """Angular velocity about the level frame's forward, left and up axes (rad/s), ignoring changes of the tilt."""
        return 0.0, 0.0, self._twist[2]

    def carry(self, pose: Pose2) -> None:
        """Move the robot to another pose, at rest; sensors see a jump, not a path between the two places."""
        self._pose, self._twist, self._stuck_at = pose, (0.0, 0.0, 0.0), None
        self._wheel_speeds = [0.0] * len(self.shafts)
        self._attitude = self._tilt(self._elapsed, *pose)
        self._trail.clear()
        self._remember()

    def _steering_angles(self) -> tuple[float, ...]:
        return self._steering.angles

    def _step(self, dt: float) -> None:
        self._steering.follow(*self._turn_servos(dt))
        self._turn_motors(dt)
        for i, shaft in enumerate(self.shafts):
            self._drive(i, shaft, dt)
        before = self._twist
        self._move(dt)
        self._accelerate(before, dt)
        self._draw(dt, self._pulls)

    def _drive(self, i: int, shaft: Shaft, dt: float) -> None:
        """Let the wheels follow their motor within the force that the clutch can transmit."""
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

    def _accelerate(self, before: tuple[float, float, float], dt: float) -> None:
        vx, vy, wz = self._twist
        true = (vx - before[0]) / dt - wz * vy, (vy - before[1]) / dt + wz * vx
        # 0.05: time constant of the accelerometer's response, s: its mount and filter
        share = 1.0 - exp(-dt / 0.05)
        forward, left = self._felt
        self._felt = forward + share * (true[0] - forward), left + share * (true[1] - left)

    def _move(self, dt: float) -> None:
        config, steering, wheels = self.config, self._steering, self._wheel_speeds
        front_noise, rear_noise, *slip_noises = self._noise.at(self._elapsed) if self._noise else self._quiet
        lateral = 0.0
        if self._tyres is None:
            vx, _, wz = self._twist
            pressed = vx * wz + PLANT_GRAVITY * sin(self._attitude[1])
            grip = PLANT_GRAVITY  # maximum lateral acceleration of tyres with a friction coefficient of 1
            lateral = min(max(pressed, -grip), grip) * copysign(1.0, wheels[0])
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
            self._hold_wheels()
            self._twist = (0.0, 0.0, 0.0)
        else:
            self._pose, self._twist = pose, twist
            # 0.005: minimum distance from the place of contact of a free robot, m
            if self._stuck_at and hypot(pose[0] - self._stuck_at[0], pose[1] - self._stuck_at[1]) > 0.005:
                self._stuck_at = None
        self._attitude = self._tilt(self._elapsed, *self._pose)

    def _hold_wheels(self) -> None:
        """Stop the wheels of a blocked body: the motors keep turning and wind up until their clutches slip."""
        for i, speed in enumerate(self._wheel_speeds):
            if speed:
                self._pulls[i], self._slipping[i] = copysign(self.config.motor.clutch_force, speed), True
        self._wheel_speeds = [0.0] * len(self.shafts)


class _Steering:
    """Steering angles after the linkage, and body speed per wheel speed; recomputed on change.

    The truck's one motor drives four wheels through open differentials: it turns at the mean of the wheel speeds
    imposed by the body's motion, each along its own steering angle.
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


class SkidEffects:
    """Skid-steer effects beyond the kinematic model: unequal wheels, a turn at each reversal, a slow slide.

    The skid-steer paper observed all three effects: the robot curved within a pass although its motors had equal
    commands, it turned slightly at every reversal, and its circles drifted. Parameters such as turning centres and
    effective radii belong to the body. Every draw is a function of the seed and the number of the reversal.

    Args:
        config: parameters of the effects.
        seed: seed for the turns at reversals; None makes every reversal turn by the mean.
    """

    def __init__(self, config: SkidModelConfig, seed: int | None) -> None:
        self._config = config
        self._seed = seed
        self._direction = 0.0
        self._reversals = 0
        self._rate = 0.0
        self._left = 0.0
        """Remaining time of the turn (s)."""

    def wheel_speeds(self, speeds: list[float]) -> list[float]:
        """Return the effective speed of each wheel over the ground (m/s)."""
        gains = self._config.wheel_gains
        return [speed * gain for speed, gain in zip(speeds, gains, strict=True)] if gains else speeds

    def twist(self, twist: Twist2, yaw: float, dt: float) -> Twist2:
        """Return the velocity of the body that results from its wheels (m/s, rad/s)."""
        vx, vy, wz = twist
        turning_time = 0.2  # seconds that the turn at a reversal takes
        if abs(vx) > 1e-3:  # maximum speed of a robot at rest, m/s
            direction = copysign(1.0, vx)
            if direction == -self._direction:
                self._rate, self._left = self._turn() / turning_time, turning_time
                self._reversals += 1
            self._direction = direction
            x, y = self._config.drift_x, self._config.drift_y
            vx, vy = vx + x * cos(yaw) + y * sin(yaw), vy - x * sin(yaw) + y * cos(yaw)
        if self._left > 0.0:
            wz += self._rate * min(dt, self._left) / dt
            self._left -= dt
        return vx, vy, wz

    def _turn(self) -> float:
        config = self._config
        if self._seed is None:
            return config.reversal_turn
        drawn = float(generator(self._seed, SKID, self._reversals).standard_normal())
        return config.reversal_turn + config.reversal_spread * drawn
