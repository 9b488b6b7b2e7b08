"""Poses of robots from tags in several cameras' images, without jumps between cameras.

Each camera that sees a robot's tag gives a pose on the plane of the tag; they are averaged with weights that fall to
zero towards the image border, so that a robot leaves a camera's view gradually. Tags identify robots; robots with
coloured discs are identified by their motion. An implausible pose is dropped until it is seen repeatedly, as are the
results of a camera that has moved.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Final

import numpy as np

from monstertruck_estimation.vision.blobs import Blob
from monstertruck_estimation.vision.tags import EVERYWHERE, Sighting
from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.clock import SECOND
from monstertruckd.tools.stand.camera import PlacedCamera
from monstertruckd.tools.stand.config import BlobRobot, MarkConfig, TaggedRobot
from monstertruckd.tools.stand.identities import Identities
from monstertruckd.tools.stand.poses import MarkerPose, RobotPose, merged, robot_pose, tag_pose

EXPECTED: Final = 0.5
"""Time over which a robot's motion is extrapolated (s)."""
BLIND: Final = 5.0
"""Maximum time without a mark before a camera is considered moved (s)."""


@dataclass(slots=True)
class _Known:
    pose: RobotPose
    side: float
    """Side of the tag (m)."""
    doubts: int = 0
    rate: Array = field(default_factory=lambda: np.zeros(3))
    """Rates of x, y and yaw (m/s, rad/s)."""

    def at(self, stamp: int) -> Array:
        """Return the expected x, y and yaw, (3,)."""
        seconds = max((stamp - self.pose.stamp) / SECOND, 0.0)
        return np.array((self.pose.x, self.pose.y, self.pose.yaw)) + seconds * self.rate


@dataclass(slots=True)
class CameraState:
    """State of a camera."""

    heard: int
    """Stamp of its latest picture (ns)."""
    marked: int
    """Stamp of its latest picture with marks (ns)."""
    unmarked: int = 0
    """Number of pictures since then."""
    off: Array = field(default_factory=lambda: np.zeros(4))
    """Smoothed `shift_of` its marks (m)."""
    lost: bool = False
    moved: bool = False

    @property
    def distance(self) -> float:
        """Position error of its marks (m)."""
        return float(np.sqrt(self.off @ self.off))


def shift_of(seen: Array, places: Array) -> Array:
    """Return the common displacement of marks, (4,): in x, in y, by a turn and by a scale, m RMS over them.

    Errors of the ruler are independent.

    Args:
        seen: their seen places, (n, 2) (m).
        places: their given places, (n, 2) (m).
    """
    off, arms = seen - places, places - places.mean(axis=0)
    spread = math.sqrt(float(np.mean(np.sum(arms**2, axis=1))))
    if spread == 0.0:
        return np.append(off.mean(axis=0), np.zeros(2))
    turn = np.mean(arms[:, 0] * off[:, 1] - arms[:, 1] * off[:, 0]) / spread
    return np.append(off.mean(axis=0), (turn, np.mean(np.sum(arms * off, axis=1)) / spread))


class StandTracker:
    """Tracks the poses of all robots and the state of the cameras.

    Args:
        cameras: cameras with their poses.
        robots: robots with tags, by name.
        marks: tags on the table, by number.
        now: stamp of the start (ns).
        blobs: robots with coloured discs, by name.
    """

    def __init__(
        self,
        cameras: Mapping[str, PlacedCamera],
        robots: Mapping[str, TaggedRobot],
        marks: Mapping[int, MarkConfig],
        now: int = 0,
        blobs: Mapping[str, BlobRobot] | None = None,
    ) -> None:
        self._cameras = cameras
        self._robots = robots
        self._tagged = {robot.tag: (name, robot) for name, robot in robots.items()}
        self._blobs = blobs or {}
        self._identities = Identities(self._blobs)
        self.marks = marks
        self._known: dict[str, _Known] = {}
        self.cameras = {name: CameraState(now, now) for name in cameras}
        self.left_out = 0
        """Number of impossible poses dropped."""

    def take(
        self,
        stamp: int,
        pictures: Mapping[str, Sequence[Sighting | Blob]],
        taken: Mapping[str, int] = MappingProxyType({}),
    ) -> list[RobotPose]:
        """Return the poses at one instant.

        Args:
            stamp: stamp of the instant (ns).
            pictures: tags and discs in the cameras' images.
            taken: stamps of older images (ns): a robot's pose is extrapolated by its speed.
        """
        seen: dict[str, list[tuple[str, MarkerPose]]] = {}
        for camera, found in pictures.items():
            sightings = [one for one in found if isinstance(one, Sighting)]
            self._watch(camera, stamp, sightings)
            if self.cameras[camera].moved:
                continue
            placed = self._cameras[camera]
            for sighting in sightings:
                if (entry := self._tagged.get(sighting.tag)) is not None:
                    seen.setdefault(entry[0], []).append((camera, tag_pose(placed, sighting, entry[1].height)))
            discs = [one for one in found if isinstance(one, Blob)]
            for name, pose in self._identities.seen(stamp, placed, discs):
                seen.setdefault(name, []).append((camera, pose))
        poses = []
        for name, places in seen.items():
            whole = merged([self._carried(name, pose, stamp - taken.get(camera, stamp)) for camera, pose in places])
            if name in self._blobs:
                self._identities.learn(stamp, name, whole)
            robot = self._blobs.get(name) or self._robots[name]
            where = robot_pose(name, robot, stamp, whole, tuple(camera for camera, _ in places))
            if self._believed(where, whole.side):
                poses.append(where)
        return poses

    def expected(self, stamp: int) -> dict[str, list[Array]]:
        """Return the expected corners of the robots' tags at ``stamp`` (ns), by camera, (4, 2) each (pixels)."""
        squares = []
        for name, robot in self._robots.items():
            known = self._known.get(name)
            if known is None or stamp - known.pose.stamp > EXPECTED * SECOND:
                continue
            x, y, yaw = known.at(stamp)
            c, s = math.cos(yaw), math.sin(yaw)
            middle = np.array((x + c * robot.x - s * robot.y, y + s * robot.x + c * robot.y))
            c, s = (0.5 * known.side * turn(yaw + robot.yaw) for turn in (math.cos, math.sin))
            arms = np.array(((c - s, s + c), (c + s, s - c), (s - c, -s - c), (-c - s, c - s)))
            squares.append(np.column_stack((middle + arms, np.full(4, robot.height))))
        if not squares:
            return {}
        corners = np.concatenate(squares)
        return {name: list(camera.project(corners).reshape(-1, 4, 2)) for name, camera in self._cameras.items()}

    @property
    def tagged(self) -> bool:
        """Whether there are robots with tags."""
        return bool(self._tagged)

    def complaints(self, now: int) -> list[str]:
        """Return new and cleared faults of cameras, and robots that cannot be distinguished."""
        said = self._identities.complaints()
        silent = 1.0  # maximum gap between pictures before a camera is lost, s
        for name, state in self.cameras.items():
            lost = now - state.heard > silent * SECOND
            if lost != state.lost:
                said.append(
                    f"camera {name} " + (f"has sent no image for {silent:g} s" if lost else "sends images again")
                )
                state.lost = lost
            if lost:
                continue
            # 2 * EVERYWHERE: pictures that must have come meanwhile: in two of them at least marks were searched for
            blind = now - state.marked > BLIND * SECOND and state.unmarked > 2 * EVERYWHERE
            # 0.005: m: marks of a camera that are shifted, turned or scaled by this much, rms over the marks: the
            # camera has moved
            moved = bool(self.marks) and (blind or state.distance > 0.005)
            if moved and not state.moved:
                what = (
                    f"has seen none of its marks for {BLIND:g} s"
                    if blind
                    else f"has moved: its marks are {1000 * state.distance:.0f} mm from their places"
                )
                said.append(f"camera {name} {what}: it is ignored; calibrate the stand again")
            elif state.moved and not moved:
                said.append(f"camera {name} sees its marks in their places again")
            state.moved = moved
        return said

    def _carried(self, name: str, pose: MarkerPose, late: int) -> MarkerPose:
        """Extrapolate the pose of a robot's marker by ``late`` ns."""
        known = self._known.get(name)
        if known is None or not late:
            return pose
        x, y, turn = known.rate * late / SECOND
        return pose._replace(x=pose.x + x, y=pose.y + y, yaw=pose.yaw + turn)

    def _believed(self, pose: RobotPose, side: float) -> bool:
        known = self._known.get(pose.robot)
        if known is None:
            self._known[pose.robot] = _Known(pose, side)
            return True
        seconds = (pose.stamp - known.pose.stamp) / SECOND
        jump = math.hypot(pose.x - known.pose.x, pose.y - known.pose.y)
        # 3.0: maximum speed of a robot, m/s
        if jump > 3.0 * max(seconds, 0.0) + 0.05 and known.doubts < 5:
            known.doubts += 1
            self.left_out += 1
            return False
        turn = math.remainder(pose.yaw - known.pose.yaw, math.tau)
        if seconds >= EXPECTED or known.doubts:
            known.rate = np.zeros(3)
        elif seconds > 0.0:
            moved = np.array((pose.x - known.pose.x, pose.y - known.pose.y, turn))
            # Average over time: two cameras differ by about 1 mm for a robot at rest, at times 1 ms apart.
            known.rate = known.rate - math.expm1(-seconds / 0.1) * (moved / seconds - known.rate)
        known.pose, known.side, known.doubts = pose, side, 0
        return True

    def _watch(self, name: str, stamp: int, sightings: Sequence[Sighting]) -> None:
        """Check a camera's marks against their places at calibration."""
        state, camera = self.cameras[name], self._cameras[name]
        state.heard, state.unmarked = stamp, state.unmarked + 1
        seen = [s for s in sightings if s.tag in self.marks]
        if not seen:
            return
        seconds = (stamp - state.marked) / SECOND
        state.marked, state.unmarked = stamp, 0
        points = np.array([camera.on_plane(sighting.corners).mean(axis=0) for sighting in seen])
        places = np.array([(self.marks[s.tag].x, self.marks[s.tag].y) for s in seen])
        share = 1.0 - math.exp(-min(max(seconds, 0.0), 1.0) / 3.0)  # time constant of this average (s)
        state.off = state.off + share * (shift_of(points, places) - state.off)
