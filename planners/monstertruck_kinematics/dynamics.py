"""Single-track dynamics with linear tyres and two steered axles, blended into the kinematic model at low speed.

m (dv_y/dt + v_x w) = F_f + F_r,  I_z dw/dt = l_f F_f - l_r F_r,  F = C alpha, alpha_f = d_f - atan((v_y + l_f w)/v_x),
alpha_r = d_r - atan((v_y - l_r w)/v_x). Singular as v_x -> 0, where tyres roll without slip anyway. No parameters of
the truck's tyres are published: the defaults are assumptions of the right magnitude.
"""

from dataclasses import dataclass, field

import numpy as np

from monstertruck_kinematics.elementary import Array, KinematicsError, Real, require_finite, require_positive
from monstertruck_kinematics.truck import FourWheelSteering


@dataclass(frozen=True)
class SingleTrack:
    """Lateral dynamics of the truck; the drivetrain imposes the speed.

    Args:
        geometry: wheelbase and centre of mass.
        mass: m, kg (the sum of the truck's parts).
        yaw_inertia: I_z, kg m^2 (a box of the footprint).
        front_stiffness: C of the front axle, N/rad (assumed).
        rear_stiffness: C of the rear axle, N/rad (assumed).
        blend_from: maximum forward speed of kinematic motion, m/s.
        blend_to: minimum forward speed of dynamic motion, m/s; between them it is mixed smoothly.

    Raises:
        KinematicsError: a field is not above 0, or blend_to is not above blend_from.
    """

    geometry: FourWheelSteering = field(default_factory=FourWheelSteering)
    mass: float = 7.25
    yaw_inertia: float = 0.20
    front_stiffness: float = 120.0
    rear_stiffness: float = 120.0
    blend_from: float = 0.05
    blend_to: float = 0.15

    def __post_init__(self) -> None:
        for name in ("mass", "yaw_inertia", "front_stiffness", "rear_stiffness", "blend_from"):
            require_positive(name, getattr(self, name))
        if not self.blend_to > self.blend_from:
            raise KinematicsError(f"blend_to is {self.blend_to}: expected more than blend_from, {self.blend_from}")

    def rates(self, vx: Array, vy: Array, wz: Array, front: Array, rear: Array) -> tuple[Array, Array]:
        """(dv_y/dt, dw_z/dt) of the tyre model alone, forward or backward; not for v_x = 0."""
        fast, facing = np.abs(vx), np.sign(vx)
        l_f, l_r = self.geometry.l_f, self.geometry.l_r
        force_f = self.front_stiffness * (facing * front - np.arctan((vy + l_f * wz) / fast))
        force_r = self.rear_stiffness * (facing * rear - np.arctan((vy - l_r * wz) / fast))
        return (force_f + force_r) / self.mass - vx * wz, (l_f * force_f - l_r * force_r) / self.yaw_inertia

    def step(
        self, twist: tuple[Real, Real, Real], speed: Real, front: Real, rear: Real, dt: float
    ) -> tuple[Real, Real, Real]:
        """Twist of the centre of mass after dt.

        The tyre model advances by the exact exponential of its linearisation, so that any dt is stable, however stiff
        the tyres are at low speed.

        Args:
            twist: (vx, vy, wz) at the start.
            speed: of the drivetrain, m/s, along the direction of travel; the forward speed follows it without lag.
            front: axle angle, rad.
            rear: axle angle, rad.
            dt: s, above 0.

        Raises:
            KinematicsError: NaN, a steering angle beyond the geometry's limit, or dt not above 0.
        """
        require_positive("dt", dt)
        for name, value in zip(("vx", "vy", "wz"), twist, strict=True):
            require_finite(name, value)
        rolled = self.geometry.body_twist(speed, front, rear)
        vx = np.asarray(rolled[0], np.float64)
        fast = np.maximum(np.abs(vx), self.blend_from)
        forward = np.where(vx < 0.0, -fast, fast)
        lateral = np.asarray(twist[1], np.float64), np.asarray(twist[2], np.float64)
        ahead = self._advanced(forward, *lateral, np.asarray(front, np.float64), np.asarray(rear, np.float64), dt)
        share = np.clip((np.abs(vx) - self.blend_from) / (self.blend_to - self.blend_from), 0.0, 1.0)
        share = share * share * (3.0 - 2.0 * share)
        vy = rolled[1] + share * (ahead[0] - rolled[1])
        wz = rolled[2] + share * (ahead[1] - rolled[2])
        if isinstance(rolled[0], np.ndarray):
            return rolled[0], np.asarray(vy), np.asarray(wz)
        return rolled[0], float(vy), float(wz)

    def _advanced(self, vx: Array, vy: Array, wz: Array, front: Array, rear: Array, dt: float) -> tuple[Array, Array]:
        """(vy, wz) after dt: x + phi(A dt) dt f(x), phi(z) = (e^z - 1)/z, A the Jacobian of f."""
        fast, l_f, l_r = np.abs(vx), self.geometry.l_f, self.geometry.l_r
        grip_f = self.front_stiffness / fast / (1.0 + ((vy + l_f * wz) / fast) ** 2)
        grip_r = self.rear_stiffness / fast / (1.0 + ((vy - l_r * wz) / fast) ** 2)
        cross = l_f * grip_f - l_r * grip_r
        a11, a12 = -(grip_f + grip_r) / self.mass, -cross / self.mass - vx
        a21, a22 = -cross / self.yaw_inertia, -(l_f**2 * grip_f + l_r**2 * grip_r) / self.yaw_inertia
        half = 0.5 * (a11 + a22)
        root = np.sqrt(0.25 * (a11 - a22) ** 2 + a12 * a21 + 0j)
        root = np.where(np.abs(root) * dt < 1e-7, 1e-7 / dt, root)
        plus, minus = (np.expm1(z * dt) / np.where(z == 0.0, 1.0, z) for z in (half + root, half - root))
        linear = ((plus - minus) / (2.0 * root)).real
        constant = (0.5 * (plus + minus)).real - linear * half
        rate_y, rate_w = self.rates(vx, vy, wz, front, rear)
        return (
            vy + constant * rate_y + linear * (a11 * rate_y + a12 * rate_w),
            wz + constant * rate_w + linear * (a21 * rate_y + a22 * rate_w),
        )
