"""CARMEN text logs: lines ``FLASER`` and ``ROBOTLASER1`` (formats: head of CARMEN's own log files).

FLASER n RANGES x y theta odom_x odom_y odom_theta time host logger_time
ROBOTLASER1 type start field resolution range_max accuracy remission_mode n RANGES m REMISSIONS
    laser_x laser_y laser_theta robot_x robot_y robot_theta tv rv forward side axis time host logger_time
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import Pose2, between, wrap
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.outside import lines_of, reading
from monstertruckd.tools.logs.scan_log import BEGIN, LONGEST_RANGE, ScanLog, half_turn, missing, steady_clock, vector

KINDS: Final = {
    "ROBOTLASER1": "ROBOTLASER1 8 numbers, n ranges, m, m remissions, 11 numbers, time",
    "FLASER": "FLASER n, n ranges, 6 numbers, time",
}
"""Expected form of lines with scans; the first kind is preferred."""


@dataclass(frozen=True, slots=True)
class _LaserLine:
    ranges: Array
    robot: Pose2
    time: float
    logged: float
    """Time of the logger (s); infinite if the line has none."""
    laser: Pose2 | None = None
    geometry: tuple[tuple[str, float], ...] = ()


def read_carmen(path: Path, given: dict[str, Any], topics: tuple[str, ...] = ()) -> ScanLog:
    """Read the scans of a CARMEN log with raw odometry.

    Args:
        path: text file, or gzip-compressed text (``.gz``).
        given: geometry; overrides the log.
        topics: kind of line to read; empty: the one with the most scans.

    Raises:
        InputError: the log is damaged, or all scans have the same time.
    """
    found: dict[str, list[_LaserLine]] = {kind: [] for kind in KINDS}
    for number, line in enumerate(lines_of(path, "a log with scans (MCAP, bag, npz or text)"), start=1):
        kind, _, rest = line.strip().partition(" ")
        if kind in KINDS:
            with reading(f"{path}:{number}", KINDS[kind]):
                found[kind].append((_robotlaser if kind == "ROBOTLASER1" else _flaser)(rest.split()))
    for topic in topics:
        if not found.get(topic):
            held = ", ".join(kind for kind, lines in found.items() if lines) or "none"
            raise InputError(f"{path}: no lines {topic}; lines with scans: {held}")
    kind = topics[0] if topics else max(found, key=lambda kind: len(found[kind]))
    lines = found[kind]
    if not lines:
        return ScanLog("carmen", [])
    clocks = _clocks(lines)
    with reading(path, "increasing times"):
        number, stamps = steady_clock(*(np.round((times - times[0]) * SECOND).astype(np.int64) for times in clocks))
    mount = _mount(lines)
    brought = dict(lines[0].geometry) | ({} if mount is None else {"mount": mount})
    scans = [
        half_turn(
            BEGIN + stamp, line.ranges, line.robot, {"range_max": LONGEST_RANGE} | brought | dict(line.geometry) | given
        )
        for stamp, line in zip(stamps.tolist(), lines, strict=True)
    ]
    sources = {"scans": kind} | ({"times": "logger"} if number else {})
    return ScanLog(
        "carmen", scans, float(clocks[number][0]) - BEGIN / SECOND, missing(brought | given), sources=sources
    )


def _flaser(words: list[str]) -> _LaserLine:
    count = _count(words, 0)
    ranges = np.array(words[1 : 1 + count], np.float64)
    rest = words[1 + count :]
    return _LaserLine(ranges, vector(rest[3:6]), *_times(rest[6:]))


def _robotlaser(words: list[str]) -> _LaserLine:
    count = _count(words, 7)
    ranges = np.array(words[8 : 8 + count], np.float64)
    rest = words[8 + count :]
    rest = rest[1 + _count(rest, 0) :]
    start, increment, longest = float(words[1]), float(words[3]), float(words[4])
    geometry = (("start_angle", start), ("angle_increment", increment), ("range_max", longest))
    if not (all(math.isfinite(value) for _, value in geometry) and increment > 0 and longest > 0):
        raise ValueError(f"first beam at {start:g} rad, {increment:g} rad between beams, ranges up to {longest:g} m")
    return _LaserLine(ranges, vector(rest[3:6]), *_times(rest[11:]), laser=vector(rest[0:3]), geometry=geometry)


def _count(words: list[str], at: int) -> int:
    """Return the number of values that follow word ``at``."""
    count = int(words[at])
    if not 0 <= count <= len(words) - at - 1:
        raise ValueError(f"{count} values")
    return count


def _times(words: list[str]) -> tuple[float, float]:
    """Return the times of the message and of the logger (s)."""
    time, logged = float(words[0]), float(words[2]) if len(words) > 2 else math.inf
    if not math.isfinite(time):
        raise ValueError(f"time {time}")
    return time, logged


def _clocks(lines: list[_LaserLine]) -> list[Array]:
    """Return the clocks, each with one time per line."""
    clocks = np.array([(line.time, line.logged) for line in lines]).T
    return [times for times in clocks if np.isfinite(times).all()]


def _mount(lines: list[_LaserLine]) -> Pose2 | None:
    """Return the pose of the laser in the robot; None if the lines have none, or a changing one."""
    pairs = [(line.robot, line.laser) for line in lines if line.laser is not None]
    if not pairs:
        return None
    robots, lasers = (np.array(poses) for poses in zip(*pairs, strict=True))
    mounts = between(robots, lasers)
    off = mounts - mounts[0]
    off[:, 2] = wrap(off[:, 2])
    middle = np.median(off, axis=0)
    steady_mount = 0.01  # maximum change of the laser's pose relative to the robot for a fixed mount (m and rad)
    return vector(mounts[0] + middle) if np.abs(off - middle).max() < steady_mount else None
