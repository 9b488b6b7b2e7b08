"""Scans of a bag: selection of topics, frames and odometry."""

import itertools
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_estimation.slam.config import SlamConfig
from monstertruck_estimation.slam.worker_io import ScanInput
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import Pose2
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.outside import reading
from monstertruckd.tools.logs.bags import SCANS, BagContent, BagPose, BagScan
from monstertruckd.tools.logs.scan_log import (
    BEGIN,
    SHORTEST_RANGE,
    OdometryLog,
    ScanLog,
    missing,
    no_return,
    steady_clock,
)

ODOM: Final = "odom"
"""Part of the name of an odometry frame (REP 105: ``odom``)."""
MAP: Final = "map"
"""Frame of poses that are not odometry (REP 105)."""
BASES: Final = ("base_footprint", "base_link", "base")
"""Names of the robot's frame (REP 105, and this project's)."""


def scans_of(path: Path, make: str, content: BagContent, given: dict[str, Any], topics: tuple[str, ...]) -> ScanLog:
    """Return the scans of a bag, with odometry at their times.

    Odometry comes from a topic, otherwise from the transforms between an odometry frame and base.

    Args:
        path: path of the bag, for error messages.
        make: kind of log.
        content: content of the bag.
        given: geometry; overrides the bag.
        topics: selection among several topics of scans and odometry.

    Raises:
        InputError: no scans, several topics of them, a topic of another type, or a lidar that is not level.
    """
    topic = _scan_topic(path, content, topics)
    found = content.scans[topic]
    with reading(f"{path}: {topic}", "increasing times"):
        clock, stamps = steady_clock(*(_times([scan.times for scan in found], clock) for clock in range(2)))
    frame = found[0].frame
    frames = _Frames.of(content.transforms, clock)
    chain = frames.chain(frame)
    source = _odometry_topic(content, topics, chain)
    child = None if source is None else content.odometry[source][0].child
    base = child if child in chain else _base(chain)
    known = len(chain) > 1 or child == frame
    pose = frames.pose(chain, base, stamps[:1])[0] @ found[0].pose
    mount, mirrored = _planar(pose), pose[2, 2] < 0
    tilt, limit = math.acos(min(abs(pose[2, 2]), 1.0)), SlamConfig().max_tilt
    if tilt > limit:
        text = f"{math.degrees(tilt):.1f} degrees in {base}: expected at most {math.degrees(limit):.1f}"
        raise InputError(f"{path}: {topic}: {frame} is tilted by {text}")
    odometry = frames.odometry(chain, base) if source is None else _odometry(content.odometry[source], clock)
    origin = int(stamps[0]) - BEGIN
    shifted = OdometryLog(odometry.stamps - origin, odometry.poses)
    brought = _limits(found) | ({"mount": mount} if known else {})
    geometry = {"range_min": SHORTEST_RANGE, "range_max": _furthest(found), "mount": mount} | brought | given
    scans = [
        shifted.attached(_scan(scan, stamp - origin, mirrored=bool(mirrored), geometry=geometry))
        for scan, stamp in zip(found, stamps.tolist(), strict=True)
    ]
    by_message = {"start_angle", "angle_increment", "time_increment"}
    sources = {"scans": topic}
    if len(odometry.stamps):
        sources["odometry"] = f"transforms of {base}" if source is None else source
    if known and frame != base and "mount" not in given:
        sources["mount"] = f"{frame} in {base}"
    if clock:
        sources["times"] = "recorder"
    return ScanLog(make, scans, origin / SECOND, missing(dict.fromkeys(by_message) | brought | given), sources=sources)


def _scan_topic(path: Path, content: BagContent, topics: tuple[str, ...]) -> str:
    """Return the topic of the scans.

    Raises:
        InputError: there is none, or more than one.
    """
    for topic in topics:
        if topic in content.others:
            raise InputError(f"{path}: {topic} contains {content.others[topic]}: expected {SCANS}, or odometry")
        if topic not in content.scans and topic not in content.odometry:
            raise InputError(f"{path}: no topic {topic}: it has {', '.join(content.topics) or 'none'}")
    found = [topic for topic in topics if topic in content.scans] or list(content.scans)
    if not found:
        held = ", ".join(f"{topic} ({schema})" for topic, schema in sorted(content.others.items()))
        raise InputError(f"{path}: no scans: expected a topic of {SCANS}; it has {held or 'no other topics'}")
    if len(found) > 1:
        counts = ", ".join(f"{topic} ({len(content.scans[topic])})" for topic in found)
        raise InputError(f"{path}: several topics of scans: {counts}: choose one with --topic")
    return found[0]


def _odometry_topic(content: BagContent, topics: tuple[str, ...], chain: list[str]) -> str | None:
    """Return the odometry topic: the selected one, otherwise that of the lidar's robot frame, otherwise the longest."""
    found = [topic for topic in topics if topic in content.odometry]
    local = [topic for topic, poses in content.odometry.items() if poses[0].parent != MAP]

    def worth(topic: str) -> tuple[bool, int]:
        poses = content.odometry[topic]
        return poses[0].child in chain, len(poses)

    return max(found or local, key=worth, default=None)


def _base(chain: list[str]) -> str:
    """Return the robot's frame in the lidar's chain: the one below ``odom``, otherwise by name, otherwise the last."""
    for below, above in itertools.pairwise(chain):
        if ODOM in above:
            return below
    return next((name for name in BASES if name in chain), chain[-1])


def _times(times: list[Any], clock: int) -> NDArray[np.int64]:
    return np.array([one.logged if clock else one.stamp for one in times], np.int64)


def _planar(pose: Array) -> Pose2:
    return float(pose[0, 3]), float(pose[1, 3]), math.atan2(pose[1, 0], pose[0, 0])


def _odometry(poses: list[BagPose], clock: int) -> OdometryLog:
    return _in_order(_times([pose.times for pose in poses], clock), np.array([_planar(pose.pose) for pose in poses]))


def _in_order(stamps: NDArray[np.int64], poses: Array) -> OdometryLog:
    """Return the odometry by increasing stamps; of several poses with one stamp, the first."""
    rising, kept = np.unique(stamps, return_index=True)
    return OdometryLog(rising, poses[kept].reshape(-1, 3))


def _limits(found: list[BagScan]) -> dict[str, float]:
    """Return minimum and maximum range from the first message; empty if it has none."""
    limits = found[0].limits
    return {} if limits is None or not limits[0] < limits[1] else {"range_min": limits[0], "range_max": limits[1]}


def _furthest(found: list[BagScan]) -> float:
    """Return the range that means no return, if no message gives it; infinity if all beams have returns."""
    ranges = np.concatenate([scan.ranges for scan in found])
    return no_return(ranges) if np.isfinite(ranges).any() else math.inf


def _scan(scan: BagScan, stamp: int, *, mirrored: bool, geometry: dict[str, Any]) -> ScanInput:
    """Convert a scan, with its own angles; for a lidar mounted upside down they are reversed."""
    sign = -1.0 if mirrored else 1.0
    own = {
        "start_angle": sign * scan.start_angle,
        "angle_increment": sign * scan.angle_increment,
        "time_increment": scan.time_increment,
    }
    return ScanInput(stamp=stamp, ranges=scan.ranges, **(own | geometry))


@dataclass(frozen=True, slots=True)
class _Edge:
    """Poses of a frame in its parent."""

    parent: str
    stamps: NDArray[np.int64]
    poses: Array
    """Shape (n, 4, 4)."""

    def at(self, stamps: NDArray[np.int64]) -> Array:
        """Return the latest poses at these times, or the first ones, shape (len(stamps), 4, 4)."""
        newest = np.searchsorted(self.stamps, stamps, side="right") - 1
        return self.poses[np.maximum(newest, 0)]


@dataclass(frozen=True, slots=True)
class _Frames:
    """Frame tree of a bag."""

    edges: dict[str, _Edge]

    @classmethod
    def of(cls, transforms: list[BagPose], clock: int) -> "_Frames":
        """Sort transforms by child; of several parents the most frequent one is used."""
        by_edge: dict[tuple[str, str], list[BagPose]] = {}
        for one in transforms:
            by_edge.setdefault((one.child, one.parent), []).append(one)
        edges: dict[str, _Edge] = {}
        for (child, parent), poses in sorted(by_edge.items(), key=lambda item: len(item[1])):
            stamps, kept = np.unique(_times([pose.times for pose in poses], clock), return_index=True)
            edges[child] = _Edge(parent, stamps, np.array([poses[i].pose for i in kept]))
        return cls(edges)

    def chain(self, frame: str) -> list[str]:
        """Return the frame, its parent, the parent's parent, and so on."""
        names = [frame]
        while (edge := self.edges.get(names[-1])) is not None and edge.parent not in names:
            names.append(edge.parent)
        return names

    def pose(self, chain: list[str], base: str, stamps: NDArray[np.int64]) -> Array:
        """Return the pose of the chain's first frame in ``base`` at these stamps, shape (n, 4, 4)."""
        poses = np.broadcast_to(np.eye(4), (len(stamps), 4, 4))
        for frame in chain[: chain.index(base)]:
            poses = self.edges[frame].at(stamps) @ poses
        return poses

    def odometry(self, chain: list[str], base: str) -> OdometryLog:
        """Return the poses of ``base`` in the odometry frame above it, at the stamps of the most frequent transform."""
        above = chain[chain.index(base) :]
        origin = next((frame for frame in above[1:] if ODOM in frame), None)
        if origin is None:
            return OdometryLog(np.empty(0, np.int64), np.empty((0, 3)))
        edges = [self.edges[frame] for frame in above[: above.index(origin)]]
        stamps = max((edge.stamps for edge in edges), key=len)
        return _in_order(stamps, np.array([_planar(pose) for pose in self.pose(above, origin, stamps)]))
