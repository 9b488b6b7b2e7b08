"""Rigid-body robot on MuJoCo's time grid of 2 ms; all engines share the motor, servo and battery models.

A command takes effect in the next integrated step: a step is integrated only when a time at or beyond its end is
requested, so that it includes every command up to that time.
"""

from collections.abc import Callable, Sequence
from math import asin, atan2, cos, degrees, exp, hypot, sin, tau
from typing import ClassVar, Final, NamedTuple

import mujoco
import numpy as np

from monstertruck_kinematics.description import HEAD_JOINTS, Mechanics
from monstertruck_kinematics.se2 import Pose2
from monstertruck_runtime.errors import CommandFailedError, InputError
from monstertruck_sim.world.actuators import RPM
from monstertruck_sim.world.config import BatteryModelConfig, SimTruckConfig
from monstertruck_sim.world.plant import Plant, Xyz
from monstertruck_sim.world3d.model import (
    CARRIES,
    HEAD_LAG,
    PARKED,
    SUPPORTS,
    TIMESTEP,
    UNTOUCHED,
    DriveLine,
    Group,
    Warnings,
)

_UNSTABLE: Final = (
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
)
"""Warnings that make MuJoCo silently reset the state to the model's initial state."""

Ground = Callable[[float, float], float]
"""Return the ground height at a point of the map (m)."""
Steering = Callable[[Sequence[float]], Sequence[float]]
"""Convert servo angles to the angles of the steered wheels, in the order of their joints (rad)."""


class _Tyres(NamedTuple):
    """Compliance of all tyres."""

    joints: tuple[tuple[int, int, int], ...]
    """For each wheel, the indices of position, speed and wheel speed among all joints."""
    spring: float
    """Spring rate (N/m)."""
    share: float
    """Fraction of the relaxation length that a wheel rolls in one step, per rad/s."""


def _tyres(model: mujoco.MjModel, parts: Mechanics, radius: float) -> _Tyres | None:
    found: list[tuple[int, int, int]] = []
    for index in range(model.njnt):
        joint = model.joint(index)
        wheel, _, kind = joint.name.rpartition("_")
        if kind in ("along", "across"):
            found.append((joint.qposadr[0], joint.dofadr[0], model.joint(f"{wheel}_spin").dofadr[0]))
    if not found:
        return None
    return _Tyres(tuple(found), parts.tyre_spring, radius * TIMESTEP / parts.relaxation)


class RigidPlant(Plant):
    """One rigid-body robot.

    Args:
        config: true parameters.
        battery: battery model parameters.
        start: initial pose of the geometric centre.
        model: MuJoCo model of the robot and its surroundings.
        drive: the robot's drive line.
        steering: converts servo angles to wheel angles.
        ground: returns the ground height at a point on the map (m).
        parts: masses and springs.
    """

    STEP_NS: ClassVar[int] = round(TIMESTEP * 1e9)
    WHOLE_STEPS: ClassVar[bool] = True

    def __init__(
        self,
        config: SimTruckConfig,
        battery: BatteryModelConfig,
        start: Pose2,
        model: mujoco.MjModel,
        drive: DriveLine,
        steering: Steering,
        ground: Ground,
        parts: Mechanics,
    ) -> None:
        super().__init__(config, battery, start, (0.0, 0.0))
        self.model = model
        self.data = mujoco.MjData(model)
        self._drive, self._steers, self.ground = drive, steering, ground
        self.before_steps: Callable[[], None] = lambda: None
        """Called before integration; moves the bodies around the robot to their current poses."""
        count = len(self.shafts)
        self._first_shaft = model.nu - count
        self._wound = [0.0] * count
        """Wind-up of each shaft (rad), as the mean of its wheels."""
        self._head = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_ACTUATOR, name) for name in HEAD_JOINTS]
        self._head_shafts = np.zeros(len(self._head))
        """Angles of the stabiliser's shafts at the latest step (rad)."""
        self._rolling = [model.jnt_qposadr[i] for i in range(model.njnt) if model.joint(i).name.endswith("_rollers")]
        """Balls in place of wheels with rollers; the axis across the rollers stays horizontal."""
        self._tyres = _tyres(model, parts, config.wheel_radius)
        self._deflection = [0.0] * (0 if self._tyres is None else len(self._tyres.joints))
        """Longitudinal and lateral deflection of the tyres (m)."""
        self._steered: list[float] = []
        """Servo angles that the steered wheels follow."""
        self._felt = self._turning = self._velocity = (0.0, 0.0, 0.0)
        self._on_blocks = 0.0, 0.0
        """Pitch and roll caused by blocks under the wheels (rad)."""
        self._solid = np.isin(model.geom_group, (Group.WALLS, Group.MOVING)).tolist()
        self._put(start)

    @property
    def acceleration(self) -> Xyz:
        """Acceleration without gravity, as sensed on the body: forward, left, up in its level frame (m/s^2)."""
        return self._felt

    @property
    def rates(self) -> Xyz:
        """Angular velocity about the level frame's forward, left and up axes (rad/s)."""
        return self._turning

    @property
    def height(self) -> float:
        """Height of the base above the map plane (m)."""
        return self._height

    def mount_torque(self, joint: int, /) -> float:
        """Return the latest load torque of the lidar on its pitch (0) or roll (1) joint (Nm)."""
        return -float(self.data.actuator_force[self._head[joint]])

    def integrate(self, time_ns: int) -> None:
        """Integrate this robot alone; see ``advance``."""
        self.before_steps()
        super().integrate(time_ns)

    def carry(self, pose: Pose2) -> None:
        """Move the robot to another pose, at rest; sensors see no motion between the two poses.

        Raises:
            InputError: the robot cannot stand at that pose; it remains in place.
        """
        before = self._pose
        try:
            self._put(pose)
        except InputError:
            self._put(before)
            raise
        self._trail.clear()
        self._remember()

    def stand(self, pitch: float, roll: float) -> None:
        """Put the robot onto blocks that tilt it (rad), or take it off them (0, 0); its position stays the same.

        Zero tilt leaves a robot that is not on blocks unchanged.

        Raises:
            InputError: the robot cannot stand at this tilt and is left unchanged.
        """
        if not any((pitch, roll, *self._on_blocks)):
            return
        before, self._on_blocks = self._on_blocks, (pitch, roll)
        try:
            self.carry(self._pose)
            # 0.1: maximum difference between the tilts of robot and blocks that its springs explain, rad
            if hypot(self._attitude[0] - pitch, self._attitude[1] - roll) > 0.1:
                wanted = f"pitch {degrees(pitch):.0f} deg and roll {degrees(roll):.0f} deg"
                raise InputError(f"tilt: the robot falls off blocks that tilt it by {wanted}")
        except InputError:
            self._on_blocks = before
            self.carry(self._pose)
            raise

    def _support(self, pose: Pose2) -> float:
        """Tilt the robot and put blocks below its wheels; return the height of its base (m)."""
        model, data = self.model, self.data
        x, y, yaw = pose
        (cy, sy), (cp, sp), (cr, sr) = ((cos(angle / 2), sin(angle / 2)) for angle in (yaw, *self._on_blocks))
        turned = (
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        )
        data.qpos[:7] = 0.0, 0.0, 0.0, *turned
        mujoco.mj_kinematics(model, data)
        wheels = np.flatnonzero((model.geom_type == mujoco.mjtGeom.mjGEOM_SPHERE) & (model.geom_group == Group.ROBOT))
        feet = data.geom_xpos[wheels] - np.outer(model.geom_size[wheels, 0], (0.0, 0.0, 1.0))
        base = -float(feet[:, 2].min())
        ground = self.ground(x, y)
        for i, name in enumerate(SUPPORTS):
            body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
            geom, mocap = model.body_geomadr[body], model.body_mocapid[body]
            ahead, aside, rise = (x, y, base) + feet[i] if i < len(feet) else np.zeros(3)
            used = rise > 0.002  # minimum height of a wheel with a block, m
            kind, affinity = CARRIES if used else UNTOUCHED
            model.geom_contype[geom] = model.body_contype[body] = kind
            model.geom_conaffinity[geom] = model.body_conaffinity[body] = affinity
            data.mocap_pos[mocap] = ahead, aside, (ground + rise if used else PARKED) - model.geom_size[geom][2]
            data.mocap_quat[mocap] = cy, 0.0, 0.0, sy
        return ground + base

    def _put(self, pose: Pose2) -> None:
        """Let the robot settle on its springs at a pose, held in x, y and yaw.

        Raises:
            InputError: the robot does not settle, because the ground or a geometry of an MJCF file penetrates it.
        """
        data = self.data
        around = data.mocap_pos.copy(), data.mocap_quat.copy()
        mujoco.mj_resetData(self.model, data)
        data.mocap_pos[:], data.mocap_quat[:] = around
        x, y, yaw = pose
        self._wound = [0.0] * len(self.shafts)
        data.qpos[:3] = x, y, self._support(pose) + 0.002
        self._steered = []
        self._deflection = [0.0] * len(self._deflection)
        self._command(0.0, [servo.angle for servo in self._servos])
        self._warned = Warnings.count
        for _ in range(400):  # number of steps for a robot that was put down to come to rest
            mujoco.mj_step(self.model, data)
            if Warnings.count != self._warned:
                break
            data.qpos[:2] = x, y
            data.qvel[:2] *= 0.5
        inside = data.ncon > 0 and data.contact.dist.min() < -0.03  # maximum plausible depth of a contact, m
        # 0.5: maximum vertical speed of a robot at rest, m/s
        if self._unstable() or inside or not abs(data.qvel[2]) < 0.5:
            raise InputError(
                f"the robot does not come to rest at ({x:.2f}, {y:.2f}): another object occupies this place"
            )
        data.qvel[:] = 0.0
        mujoco.mj_forward(self.model, data)
        self._twist, self._stuck_at = (0.0, 0.0, 0.0), None
        self._felt = self._turning = (0.0, 0.0, 0.0)
        self._wound = data.actuator_length[self._first_shaft :].tolist()
        self._pose = x, y, yaw
        self._read(data.qpos[:7].tolist(), data.qvel[:6].tolist())

    def _steering_angles(self) -> tuple[float, ...]:
        return self._chassis.steering(*(servo.angle for servo in self._servos))

    def _step(self, dt: float) -> None:
        servos = self._turn_servos(dt)
        self._turn_motors(dt)
        self._command(dt, servos)
        mujoco.mj_step(self.model, self.data)
        if Warnings.count != self._warned:
            self._require_stable()
        places, speeds = (
            self.data.qpos.tolist(),
            self.data.qvel.tolist(),
        )  # far faster than element access on the arrays
        self._roll(places, speeds)
        before = self._velocity
        self._read(places, speeds)
        self._feel(before)
        self._draw(dt, self._slip())
        self._touch()

    def _unstable(self) -> bool:
        return any(self.data.warning[which].number for which in _UNSTABLE)

    def _require_stable(self) -> None:
        """Check the state after a warning, which may come from another robot's model.

        Raises:
            CommandFailedError: the state of this robot has diverged.
        """
        self._warned = Warnings.count
        if self._unstable():
            x, y, _ = self._pose
            raise CommandFailedError(f"the simulation of the robot at ({x:.2f}, {y:.2f}) became unstable")

    def _roll(self, places: list[float], speeds: list[float]) -> None:
        """Update the tyre deflections at the contact; rolling replaces the deflected part of the tyre.

        The deflection d follows d' = u' - |v| d / relaxation, where u' is the slip velocity of the rolling wheel: the
        force settles at ``tyre_stiffness`` times the slip ratio or the tangent of the slip angle, and is bounded by dry
        friction (a relaxation length; e.g. Pacejka, Tyre and Vehicle Dynamics, chapter 7).
        """
        data, tyres = self.data, self._tyres
        if self._rolling:
            data.qpos[self._rolling] = 0.0
        if tyres is None:
            return
        moved, forces, deflection = data.qpos, data.qfrc_applied, self._deflection
        for i, (place, slip, spin) in enumerate(tyres.joints):
            given = deflection[i] = (deflection[i] + places[place]) * exp(-abs(speeds[spin]) * tyres.share)
            moved[place] = 0.0
            forces[slip] = -tyres.spring * given

    def _command(self, dt: float, servos: list[float]) -> None:
        controls, drive = self.data.ctrl, self._drive
        if servos != self._steered:
            angles = self._steers(servos)
            controls[: len(angles)] = angles
            self._steered = servos
        if self.joints is not None:
            shafts = np.concatenate(self.joints.angles(np.array([(self._start_ns or 0) + self._elapsed])))
            rates = (shafts - self._head_shafts) / TIMESTEP if dt else 0.0
            controls[self._head] = shafts + HEAD_LAG * rates
            self._head_shafts = shafts
        for i, shaft in enumerate(self.shafts):
            speed = shaft.rpm * RPM / self.config.motor.ratio
            self._wound[i] += speed * dt
            controls[self._first_shaft + i] = self._wound[i] + drive.damping / drive.stiffness * speed

    def _slip(self) -> list[float]:
        """Return every shaft's force at the ground (N); a slipping clutch prevents further wheel wind-up."""
        drive, data, pulls = self._drive, self.data, []
        for i, shaft in enumerate(self.shafts):
            index = self._first_shaft + i
            torque = float(data.actuator_force[index])
            slipping = self._slipping[i] = abs(torque) > drive.clutch * (1.0 - 1e-9)
            if slipping:
                speed = shaft.rpm * RPM / self.config.motor.ratio
                lag = drive.damping * (speed - float(data.actuator_velocity[index]))
                self._wound[i] = float(data.actuator_length[index]) + (torque - lag) / drive.stiffness
            pulls.append(torque / self.config.wheel_radius)
        return pulls

    def _read(self, places: list[float], speeds: list[float]) -> None:
        """Read the base's pose, twist and rates, which come first in the state."""
        x, y, z, qw, qx, qy, qz = places[:7]
        forward_x, forward_y = 1.0 - 2.0 * (qy * qy + qz * qz), 2.0 * (qx * qy + qw * qz)
        down = 2.0 * (qx * qz - qw * qy)
        left_up, up_up = 2.0 * (qy * qz + qw * qx), 1.0 - 2.0 * (qx * qx + qy * qy)
        heading = atan2(forward_y, forward_x)
        turned = self._pose[2]
        yaw = turned + (heading - turned + tau / 2) % tau - tau / 2
        pitch, roll = asin(max(-1.0, min(1.0, -down))), atan2(left_up, up_up)
        vx, vy, vz, wx, wy, wz = speeds[:6]
        c, s = cos(yaw), sin(yaw)
        # From the body's axes to its level frame, by pitch and roll.
        cr, sr, cp, sp = cos(roll), sin(roll), cos(pitch), sin(pitch)
        up = sr * wy + cr * wz
        self._turning = cp * wx + sp * up, cr * wy - sr * wz, cp * up - sp * wx
        self._pose, self._attitude, self._height = (x, y, yaw), (pitch, roll), z
        self._twist = c * vx + s * vy, c * vy - s * vx, self._turning[2]
        self._velocity = vx, vy, vz

    def _feel(self, before: Xyz) -> None:
        """Compute the acceleration of a step from the velocity before it, and pass it through the sensor's filter."""
        ax, ay, az = ((now - then) / TIMESTEP for now, then in zip(self._velocity, before, strict=True))
        c, s = cos(self._pose[2]), sin(self._pose[2])
        # 0.05: time constant of an accelerometer's mount and filter, s
        share = 1.0 - exp(-TIMESTEP / 0.05)
        forward, left, up = self._felt
        self._felt = (
            forward + share * (c * ax + s * ay - forward),
            left + share * (c * ay - s * ax - left),
            up + share * (az - up),
        )

    def _touch(self) -> None:
        """Detect contacts: walls, obstacles and people stop the robot; ground and blocks carry it."""
        solid = self._solid
        if self.data.ncon and any(solid[a] or solid[b] for a, b in self.data.contact.geom.tolist()):
            # 0.01: minimum speed of a collision, m/s
            if self._stuck_at is None and hypot(*self._twist[:2]) > 0.01:
                self.on_blocked(self._pose, self._twist)
            self._stuck_at = self._pose
        elif self._stuck_at is not None:
            x, y, _ = self._stuck_at
            # 0.005: minimum distance from the place of contact of a free robot, m
            if hypot(self._pose[0] - x, self._pose[1] - y) > 0.005:
                self._stuck_at = None
