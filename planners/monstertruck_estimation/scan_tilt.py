"""Tilt of a scan's plane: the body's tilt composed with the joints of the lidar's mount.

With the body's rotation R = Ry(pitch) Rx(roll) in a level frame and the mount's M = Ry(a) Rx(b) on the body, the
plane's normal is R M z. Its tilt is the angle to the vertical, acos(u . M z), with the vertical in the body's axes u =
R^T z = (-sin p, sin r cos p, cos r cos p). Compass and joints have other stamps than scans, so both are interpolated to
the middle of the scan.
"""

import math
from collections import deque
from collections.abc import Iterable
from typing import Final

from monstertruck_estimation.body_tilt import BodyAcceleration
from monstertruck_kinematics.se2 import to_body
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.mailbox import Mailbox
from monstertruck_runtime.ports import Publisher
from monstertruck_schemas.sensor import Attitude, LaserScan, StabiliserFeedback
from monstertruck_schemas.state import Odometry

NO_TILT: Final = math.pi / 2
"""Tilt of a scan with unknown mount or body angles, which rules out its use."""

Angles = tuple[float, float]


def plane_tilt(roll: float, pitch: float, joint_pitch: float = 0.0, joint_roll: float = 0.0) -> float:
    """Return the angle between the lidar's plane and the horizontal (rad); arguments in rad, REP 103."""
    x, y = math.sin(joint_pitch) * math.cos(joint_roll), -math.sin(joint_roll)
    z = math.cos(joint_pitch) * math.cos(joint_roll)
    up = -math.sin(pitch) * x + math.cos(pitch) * (math.sin(roll) * y + math.cos(roll) * z)
    return math.acos(min(max(up, -1.0), 1.0))


def plane_slopes(
    roll: float, pitch: float, joint_pitch: float = 0.0, joint_roll: float = 0.0, yaw: float = 0.0
) -> tuple[float, float]:
    """Return the rise per metre along the axes of a lidar at ``yaw``; the other arguments as in ``plane_tilt``.

    The slopes follow from the columns of M = Ry(a) Rx(b) Rz(yaw) and the vertical in the body's axes.
    """
    up = -math.sin(pitch), math.sin(roll) * math.cos(pitch), math.cos(roll) * math.cos(pitch)
    ca, sa, cb, sb = math.cos(joint_pitch), math.sin(joint_pitch), math.cos(joint_roll), math.sin(joint_roll)
    along = up[0] * ca - up[2] * sa
    across = up[0] * sa * sb + up[1] * cb + up[2] * ca * sb
    return to_body(yaw, along, across)


class AngleHistory:
    """Recent readings of two angles, interpolated between them and extrapolated shortly beyond."""

    def __init__(self) -> None:
        self._points: deque[tuple[int, Angles]] = deque(maxlen=16)

    def extend(self, points: Iterable[tuple[int, Angles]]) -> None:
        """Add later readings: stamp (ns) and angles."""
        self._points.extend(points)

    def at(self, time_ns: int) -> Angles | None:
        """Interpolate between the two readings around ``time_ns``, or extrapolate the latest two; None if unknown."""
        stale = SECOND // 4  # maximum extrapolation beyond the latest reading, ns
        if not self._points or time_ns - self._points[-1][0] > stale:
            return None
        if len(self._points) == 1:
            return self._points[0][1]
        after = next((i for i, (stamp, _) in enumerate(self._points) if i and stamp >= time_ns), len(self._points) - 1)
        (begin, old), (end, new) = self._points[after - 1], self._points[after]
        share = (time_ns - begin) / max(end - begin, 1)
        if not 0 <= end - begin <= stale or share < 0:
            return new
        return old[0] + share * (new[0] - old[0]), old[1] + share * (new[1] - old[1])


class ScanAngles:
    """Angles of body and mount at the time of a scan.

    Args:
        compass: tilt of the body.
        joints: joints of the mount; None if the lidar is fixed to the body.
        odometry: gives the body's acceleration for the correction of its tilt; None for no correction.
    """

    def __init__(
        self,
        compass: Mailbox[Attitude],
        joints: Mailbox[StabiliserFeedback] | None,
        odometry: Mailbox[Odometry] | None = None,
    ) -> None:
        self._compass = compass
        self._feedback = joints
        self._odometry = odometry
        self._moved = BodyAcceleration()
        self._body = AngleHistory()
        self._mount = AngleHistory()

    @property
    def jointed(self) -> bool:
        """Whether the mount has joints."""
        return self._feedback is not None

    def at(self, scan: LaserScan) -> tuple[float, float, float, float] | None:
        """Roll and pitch of the body, pitch and roll of the joints in the middle of ``scan``, rad; None: unknown."""
        for odometry in () if self._odometry is None else self._odometry.drain():
            self._moved.observe(odometry)
        self._body.extend((a.stamp, self._moved.tilt(a)) for a in self._compass.drain() if a.tilt_valid)
        middle = scan.stamp + round(scan.time_increment * len(scan.ranges) / 2 * SECOND)
        body = self._body.at(middle)
        if self._feedback is None:
            return None if body is None else (*body, 0.0, 0.0)
        self._mount.extend(
            (f.stamp, (f.pitch, f.roll)) for f in self._feedback.drain() if f.pitch is not None and f.roll is not None
        )
        joints = self._mount.at(middle)
        return None if body is None or joints is None else (*body, *joints)


class TiltStamper:
    """Publisher that adds the ``tilt`` to each scan.

    Args:
        out: publisher of the scans.
        angles: angles of body and mount.
    """

    def __init__(self, out: Publisher[LaserScan], angles: ScanAngles) -> None:
        self._out = out
        self._angles = angles

    def next_seq(self) -> int:
        """Sequence number of the next scan."""
        return self._out.next_seq()

    def put(self, message: LaserScan) -> None:
        """Publish a scan with the tilt of its plane at half time."""
        angles = self._angles.at(message)
        unknown = NO_TILT if self._angles.jointed else None
        self._out.put(message.model_copy(update={"tilt": unknown if angles is None else plane_tilt(*angles)}))
