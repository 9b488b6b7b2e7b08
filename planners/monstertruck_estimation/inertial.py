"""Inertial measurement unit for odometry: yaw rate over level ground, and tilt of the body.

The tilt comes from a complementary filter: the gyroscopes rotate the vertical, and the specific force corrects it
(Mahony et al. 2008, the direct form with one vector). The body's own acceleration averages out over 2 s.
"""

import math
from typing import Final

from monstertruck_estimation.body_tilt import Tilt
from monstertruck_estimation.gyro import Gyro, GyroConfig
from monstertruck_estimation.transforms import Quaternion, Xyz, added, rotate
from monstertruck_kinematics.description import GRAVITY
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.mailbox import Mailbox
from monstertruck_runtime.ports import EventSink
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import Imu, Vector3

LONGEST_SILENCE: Final = 0.5
"""Maximum gap between measurements before the filter restarts (s)."""
STEEPEST: Final = 0.7
"""Minimum vertical component of the body's z axis of a driving robot."""


class InertialTilt:
    """Estimate the vertical in base from angular velocities and specific forces."""

    def __init__(self) -> None:
        self._up: Xyz | None = None
        self._stamp = 0
        self._felt = 0

    def observe(self, stamp: int, rate: Xyz, force: Xyz) -> None:
        """Add a measurement at ``stamp`` (ns), in rad/s and m/s^2; ignore it unless later than the last."""
        dt = (stamp - self._stamp) / SECOND
        if self._up is not None and dt <= 0.0:
            return
        strength = math.hypot(*force)
        # 1.0: maximum difference of force and gravity in a correction of the vertical, m/s^2
        felt = _scaled(force, 1.0 / strength) if abs(strength - GRAVITY) < 1.0 else None
        self._felt = self._felt if felt is None else stamp
        # 5.0: maximum time without a plausible force, s; then the tilt is unknown
        if self._up is None or dt > LONGEST_SILENCE or stamp - self._felt > 5.0 * SECOND:
            up = felt
        else:
            up = added(self._up, _scaled(_cross(self._up, rate), dt))
            if felt is not None:
                vertical_time = 2.0  # time constant of the correction of the vertical by the specific force, s
                up = added(_scaled(up, 1.0 - dt / vertical_time), _scaled(felt, dt / vertical_time))
        self._up = None if up is None else _scaled(up, 1.0 / math.hypot(*up))
        self._stamp = stamp

    def tilt(self, now: int) -> Tilt | None:
        """Return the body's tilt at ``now`` (ns); None if unknown."""
        if self._up is None or self._up[2] < STEEPEST or now - self._stamp > LONGEST_SILENCE * SECOND:
            return None
        x, y, z = self._up
        return Tilt(math.atan2(y, z), -math.asin(x))

    def yaw_rate(self, rate: Xyz) -> float:
        """Return the heading rate for an angular velocity of base (rad/s); its z component if the tilt is unknown."""
        if self._up is None or self._up[2] < STEEPEST:
            return rate[2]
        _, y, z = self._up
        return (y * rate[1] + z * rate[2]) / (y * y + z * z)


class Inertial:
    """Inertial measurement unit in the base frame.

    Args:
        config: trust in its yaw rate.
        mount: rotation from the unit's axes to base.
    """

    def __init__(self, config: GyroConfig, mount: Quaternion) -> None:
        self.gyro = Gyro(config)
        self.vertical = InertialTilt()
        self._axes = tuple(rotate(mount, axis) for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))

    def observe(self, imu: Imu) -> None:
        """Add a measurement."""
        self.gyro.observe(imu.stamp, self.turn_rate(imu))

    def turn_rate(self, imu: Imu) -> float:
        """Add a measurement; return the heading rate including the gyroscope's bias (rad/s)."""
        rate, force = self._in_base(imu.angular_velocity), self._in_base(imu.linear_acceleration)
        self.vertical.observe(imu.stamp, rate, force)
        return self.vertical.yaw_rate(rate)

    def _in_base(self, vector: Vector3) -> Xyz:
        x, y, z = self._axes
        return added(added(_scaled(x, vector.x), _scaled(y, vector.y)), _scaled(z, vector.z))


class InertialInput:
    """Pass IMU messages to an ``Inertial``, and report disagreement between its yaw rate and the wheels.

    Args:
        inertial: the unit.
        measured: messages of the unit.
        events: sink of the reports.
        source: source of the events.
    """

    def __init__(self, inertial: Inertial, measured: Mailbox[Imu], events: EventSink, source: str) -> None:
        self.inertial = inertial
        self._measured = measured
        self._events = events
        self._source = source
        self._trusted = True

    def take(self) -> None:
        """Pass new measurements on."""
        for imu in self._measured.drain():
            self.inertial.observe(imu)

    def report(self) -> None:
        """Report a change of trust in the yaw rate."""
        gyro = self.inertial.gyro
        if gyro.trusted is self._trusted:
            return
        self._trusted, off = gyro.trusted, round(gyro.difference, 3)
        if gyro.trusted:
            self._events(Reason.IMU_AGREES, Severity.INFO, self._source, "the IMU is used again", difference=off)
        else:
            text = f"the IMU turned {off:+.2f} rad more than the wheels: the heading follows the wheels"
            self._events(Reason.IMU_DISAGREES, Severity.WARNING, self._source, text, difference=off)


def _scaled(vector: Xyz, by: float) -> Xyz:
    return vector[0] * by, vector[1] * by, vector[2] * by


def _cross(a: Xyz, b: Xyz) -> Xyz:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
