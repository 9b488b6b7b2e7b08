"""Frame tree: angles and quaternions, look-up between any two frames, and the service that publishes it.

map > odom > base > sensors (REP 105). The transform from map to odom is the identity unless the truck is localised. A
transform is the pose of ``child`` in ``parent``.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Final

from monstertruck_runtime.clock import Clock, Schedule
from monstertruck_runtime.errors import InputError, NotFoundError
from monstertruck_runtime.ports import Publisher, Ready, Subscription
from monstertruck_schemas.roles import ServiceName
from monstertruck_schemas.sensor import StabiliserFeedback
from monstertruck_schemas.state import Odometry, Transform, Transforms

Quaternion = tuple[float, float, float, float]
Xyz = tuple[float, float, float]

IDENTITY: Final[Quaternion] = (0.0, 0.0, 0.0, 1.0)

FIXED: Final = 0
"""Stamp of a transform that never changes."""


def wrap_angle(angle: float) -> float:
    """Return the angle wrapped to [-pi, pi] (rad)."""
    return math.remainder(angle, math.tau)


def quaternion_from_rpy(roll: float, pitch: float, yaw: float) -> Quaternion:
    """Return the unit quaternion (x, y, z, w) of turns about x, then y, then z of the parent frame (REP 103, rad)."""
    cr, sr = math.cos(roll / 2), math.sin(roll / 2)
    cp, sp = math.cos(pitch / 2), math.sin(pitch / 2)
    cy, sy = math.cos(yaw / 2), math.sin(yaw / 2)
    return (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )


def quaternion_from_yaw(yaw: float) -> Quaternion:
    """Return the unit quaternion of a turn about z (rad)."""
    return 0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)


def yaw_of(rotation: Quaternion) -> float:
    """Return the yaw of a unit quaternion (rad)."""
    x, y, z, w = rotation
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """Return rotation ``b`` followed by rotation ``a``, both in the parent frame."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def conjugate(rotation: Quaternion) -> Quaternion:
    """Return the inverse rotation."""
    x, y, z, w = rotation
    return -x, -y, -z, w


def rotate(rotation: Quaternion, vector: Xyz) -> Xyz:
    """Rotate a vector from the child frame to the parent frame."""
    x, y, z, _ = multiply(multiply(rotation, (*vector, 0.0)), conjugate(rotation))
    return x, y, z


def compose(outer: Transform, inner: Transform) -> Transform:
    """Return the pose of ``inner.child`` in ``outer.parent``, with the older stamp that is not ``FIXED``."""
    shifted = rotate(outer.rotation, inner.translation)
    return Transform(
        parent=outer.parent,
        child=inner.child,
        stamp=min(outer.stamp, inner.stamp) or max(outer.stamp, inner.stamp),
        translation=added(outer.translation, shifted),
        rotation=multiply(outer.rotation, inner.rotation),
    )


def invert(transform: Transform) -> Transform:
    """Return the pose of the parent in the child."""
    back = conjugate(transform.rotation)
    x, y, z = rotate(back, transform.translation)
    return Transform(
        parent=transform.child,
        child=transform.parent,
        stamp=transform.stamp,
        translation=(-x, -y, -z),
        rotation=back,
    )


def mount(child: str, position: Xyz, rpy: Xyz = (0.0, 0.0, 0.0), parent: str = "base") -> Transform:
    """Return the fixed pose of a sensor: position (m), and roll, pitch, yaw (rad)."""
    return Transform(parent=parent, child=child, stamp=FIXED, translation=position, rotation=quaternion_from_rpy(*rpy))


def planar(parent: str, child: str, stamp: int, pose: Xyz) -> Transform:
    """Return the transform of a planar pose (x, y, yaw)."""
    x, y, yaw = pose
    return Transform(
        parent=parent, child=child, stamp=stamp, translation=(x, y, 0.0), rotation=quaternion_from_yaw(yaw)
    )


def planar_pose(transform: Transform) -> Xyz:
    """Return x, y (m) and yaw (rad) of a transform, projected on the ground."""
    x, y, _ = transform.translation
    return x, y, yaw_of(transform.rotation)


def added(a: Xyz, b: Xyz) -> Xyz:
    """Return the sum of two vectors."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


class FrameTree:
    """Transforms between neighbouring frames, with look-up between any two frames.

    Args:
        transforms: initial transforms.
    """

    def __init__(self, transforms: Iterable[Transform] = ()) -> None:
        self._by_child: dict[str, Transform] = {}
        for transform in transforms:
            self.put(transform)

    def put(self, transform: Transform) -> None:
        """Add or update the pose of a frame in its parent.

        Raises:
            InputError: the frame already has another parent, or would be its own ancestor.
        """
        child, parent = transform.child, transform.parent
        known = self._by_child.get(child)
        if known is not None and known.parent != parent:
            raise InputError(
                f"frame {child!r} already has the parent {known.parent!r}: expected no second parent, got {parent!r}"
            )
        if known is None and (child == parent or child in self._ancestors(parent)):
            raise InputError(f"frame {child!r} on {parent!r} closes a loop: expected a tree")
        self._by_child[child] = transform

    def lookup(self, parent: str, child: str) -> Transform:
        """Return the pose of ``child`` in ``parent``, over any chain of frames between them.

        Raises:
            NotFoundError: a frame does not exist, or the two are not connected.
        """
        known = {*self._by_child, *(transform.parent for transform in self._by_child.values())}
        there = self._ancestors(parent)
        shared = next((frame for frame in self._ancestors(child) if frame in there and frame in known), None)
        if shared is None:
            names = ", ".join(sorted(known)) or "none"
            raise NotFoundError(f"no transform from {child!r} to {parent!r}: known frames are {names}")
        return compose(invert(self._chain(parent, shared)), self._chain(child, shared))

    def all(self, now: int) -> tuple[Transform, ...]:
        """Return the latest transform of each frame; fixed ones are stamped ``now``."""
        return tuple(
            transform.model_copy(update={"stamp": now}) if transform.stamp == FIXED else transform
            for transform in self._by_child.values()
        )

    def _ancestors(self, frame: str) -> list[str]:
        """Return the frame and its ancestors."""
        line = [frame]
        while (above := self._by_child.get(line[-1])) is not None:
            line.append(above.parent)
        return line

    def _chain(self, frame: str, ancestor: str) -> Transform:
        """Return the pose of ``frame`` in its ``ancestor``."""
        pose = Transform(parent=frame, child=frame, stamp=FIXED, translation=(0.0, 0.0, 0.0), rotation=IDENTITY)
        while frame != ancestor:
            step = self._by_child[frame]
            pose, frame = compose(step, pose), step.parent
        return pose


class TransformService:
    """Publish the whole frame tree.

    Args:
        mounts: fixed poses of the sensors, see ``mount``.
        clock: the service's clock.
        odometry: pose of base in odom.
        out: publisher of the tree.
        rate: publishing rate (1/s).
        joints: joints of a stabiliser: the pose of the point about which both turn, and their angles. Frames on the
            stabiliser have it as parent; while the angles are unknown, it is assumed level.
        localised: transforms above base from localisation, which replace odometry and the fixed map to odom.
    """

    name = ServiceName.TRANSFORMS.value

    def __init__(
        self,
        mounts: Sequence[Transform],
        clock: Clock,
        odometry: Subscription[Odometry],
        out: Publisher[Transforms],
        rate: float = 10.0,
        joints: tuple[Transform, Subscription[StabiliserFeedback]] | None = None,
        localised: Callable[[], Iterable[Transform]] = tuple,
    ) -> None:
        self._clock = clock
        self._odometry = odometry
        self._out = out
        self._rate = rate
        self._joints = joints
        self._localised = localised
        self._tree = FrameTree([planar("map", "odom", FIXED, (0.0, 0.0, 0.0)), *mounts])
        if joints is not None:
            self._tree.put(joints[0])

    async def run(self, ready: Ready) -> None:
        """Publish until cancelled."""
        ready()
        schedule = Schedule(self._clock, self._rate)
        while True:
            await schedule.next()
            self._refresh()
            now, seq = self._clock.now(), self._out.next_seq()
            frames = self._tree.all(now)
            self._out.put(Transforms(stamp=now, received=now, seq=seq, frame="map", transforms=frames))

    def _refresh(self) -> None:
        odometry = self._odometry.latest
        if odometry is not None:
            pose = (odometry.pose.x, odometry.pose.y, odometry.pose.yaw)
            self._tree.put(planar("odom", "base", odometry.stamp, pose))
        for transform in self._localised():
            self._tree.put(transform)
        if self._joints is None:
            return
        centre, feedback = self._joints[0], self._joints[1].latest
        if feedback is not None and feedback.pitch is not None and feedback.roll is not None:
            turn = quaternion_from_rpy(feedback.roll, feedback.pitch, 0.0)
            rotation = multiply(centre.rotation, turn)
            self._tree.put(centre.model_copy(update={"stamp": feedback.stamp, "rotation": rotation}))
