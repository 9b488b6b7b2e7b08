"""Inertial measurement unit for the odometry: its yaw rate over level ground, and the body's tilt.

The tilt is a complementary filter: the gyroscopes turn the vertical, the specific force draws it back (Mahony et al.
2008, the direct form with one vector). The body's own acceleration averages out over 2 s.
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
"""Maximum gap between measurements before it restarts, s."""
STEEPEST: Final = 0.7
"""Minimum vertical component of the body's z axis for a driving robot."""


class InertialTilt:
    """The vertical in base, by angular velocities and specific forces in base."""

    def __init__(self) -> None:
        self._up: Xyz | None = None
        self._stamp = 0
        self._felt = 0

    def observe(self, stamp: int, rate: Xyz, force: Xyz) -> None:
        """Take a measurement at ``stamp``, ns: rad/s and m/s^2; one that is not later is passed over."""
        dt = (stamp - self._stamp) / SECOND
        if self._up is not None and dt <= 0.0:
            return
        strength = math.hypot(*force)
        # 1.0: maximum difference between force and gravity for an update of the vertical, m/s^2
        felt = _scaled(force, 1.0 / strength) if abs(strength - GRAVITY) < 1.0 else None
        self._felt = self._felt if felt is None else stamp
        # 5.0: maximum time without a plausible force before the tilt is unknown, s
        if self._up is None or dt > LONGEST_SILENCE or stamp - self._felt > 5.0 * SECOND:
            up = felt
        else:
            up = added(self._up, _scaled(_cross(self._up, rate), dt))
            if felt is not None:
                vertical_time = 2.0  # time constant of the vertical towards the specific force, s
                up = added(_scaled(up, 1.0 - dt / vertical_time), _scaled(felt, dt / vertical_time))
        self._up = None if up is None else _scaled(up, 1.0 / math.hypot(*up))
        self._stamp = stamp

    def tilt(self, now: int) -> Tilt | None:
        """Tilt of the body at ``now``, ns; None if unknown."""
        if self._up is None or self._up[2] < STEEPEST or now - self._stamp > LONGEST_SILENCE * SECOND:
            return None
        x, y, z = self._up
        return Tilt(math.atan2(y, z), -math.asin(x))

    def yaw_rate(self, rate: Xyz) -> float:
        """Rate of the heading at an angular velocity of base, rad/s; about its z axis where the tilt is not known."""
        if self._up is None or self._up[2] < STEEPEST:
            return rate[2]
        _, y, z = self._up
        return (y * rate[1] + z * rate[2]) / (y * y + z * z)


class Inertial:
    """An inertial measurement unit in base.

    Args:
        config: trust in its yaw rate.
        mount: from its axes to base.
    """

    def __init__(self, config: GyroConfig, mount: Quaternion) -> None:
        self.gyro = Gyro(config)
        self.vertical = InertialTilt()
        self._axes = tuple(rotate(mount, axis) for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))

    def observe(self, imu: Imu) -> None:
        """Take a measurement."""
        self.gyro.observe(imu.stamp, self.turn_rate(imu))

    def turn_rate(self, imu: Imu) -> float:
        """Take a measurement; the rate of the heading with the gyroscope's bias, rad/s."""
        rate, force = self._in_base(imu.angular_velocity), self._in_base(imu.linear_acceleration)
        self.vertical.observe(imu.stamp, rate, force)
        return self.vertical.yaw_rate(rate)

    def _in_base(self, vector: Vector3) -> Xyz:
        x, y, z = self._axes
        return added(added(_scaled(x, vector.x), _scaled(y, vector.y)), _scaled(z, vector.z))


class InertialInput:
    """Feeds measurements of the bus to an ``Inertial``; reports when its yaw rate and the wheels disagree.

    Args:
        inertial: the unit.
        measured: its measurements.
        events: where a disagreement is reported.
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
        """Report a change of trust in its yaw rate."""
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
