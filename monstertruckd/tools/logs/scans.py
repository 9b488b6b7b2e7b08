"""Scans with odometry from logs of several formats: our MCAP, CARMEN text, arrays in npz, URG text."""

import gzip
import io
import math
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from monstertruck_drivers.hokuyo_urg.recording import RecordedRanges
from monstertruck_estimation.se2 import Vector, between, interpolate
from monstertruck_estimation.slam.worker_io import ScanInput
from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError, NotFoundError
from monstertruck_schemas.sensor import LaserScan
from monstertruck_schemas.state import Odometry
from monstertruckd.recorder.reader import MAGIC, open_log

BEGIN: Final = SECOND
"""Stamp of the first scan of a log with times of another origin, ns."""
LONGEST_RANGE: Final = 80.0
"""Ranges from here on are no-returns of the lasers that CARMEN logs come from, m."""
URG_STEP: Final = math.tau / 1024
URG_ERRORS: Final = 0.02
"""Shorter readings of a URG are error codes, m."""
URG_RANGE: Final = 5.6
URG_AHEAD: Final = 341
"""Beam of a URG recording that looks straight ahead."""


@dataclass(frozen=True, slots=True)
class ScanLog:
    """A log's scans, in order."""

    make: str
    scans: list[ScanInput]


def read_scans(path: Path) -> ScanLog:
    """Read any log with scans.

    Raises:
        NotFoundError: no such file.
        InputError: it is of no known format, damaged, or has no scans.
    """
    try:
        with path.open("rb") as file:
            head = file.read(16)
    except FileNotFoundError:
        raise NotFoundError(f"{path}: no such log") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    if head.startswith(MAGIC):
        log = ScanLog("mcap", list(_mcap(path)))
    elif head.startswith(b"PK"):
        log = ScanLog("npz", list(_arrays(path)))
    elif path.name.removesuffix(".gz").endswith(".dat"):
        log = ScanLog("urg", list(_urg(path)))
    else:
        log = ScanLog("carmen", list(_carmen(path)))
    if not log.scans:
        raise InputError(f"{path}: no scans: expected MCAP with sensor/scan, CARMEN text, npz or URG text")
    return log


def _mcap(path: Path) -> Iterator[ScanInput]:
    reader = open_log(path)
    lidar = (reader.config().get("devices") or {}).get("lidar") or {}
    at = lidar.get("mount") or {}
    mount = (float(at.get("x", 0.0)), float(at.get("y", 0.0)), float(at.get("yaw", 0.0)))
    scans: list[LaserScan] = []
    rows: list[tuple[int, float, float, float]] = []
    for message in reader:
        if message.topic not in ("sensor/scan", "state/odometry"):
            continue
        content = message.decode()
        if isinstance(content, LaserScan):
            scans.append(content)
        elif isinstance(content, Odometry):
            rows.append((content.stamp, content.pose.x, content.pose.y, content.pose.yaw))
    stamps = np.array([row[0] for row in rows], np.float64)
    poses = np.array([row[1:] for row in rows]).reshape(-1, 3)
    for scan in scans:
        end = scan.stamp + scan.time_increment * len(scan.ranges) * SECOND
        inputs = ScanInput.of(scan, mount)
        if len(stamps) and stamps[0] <= scan.stamp <= stamps[-1]:
            first, last = interpolate(stamps, poses, np.array((scan.stamp, end)))
            seconds = max((end - scan.stamp) / SECOND, 1e-3)
            inputs = replace(inputs, odom=_vector(first), twist=_vector(between(first, last) / seconds))
        yield inputs


def _arrays(path: Path) -> Iterator[ScanInput]:
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as file:
            times, ranges = file["t"], file["ranges"]
            odom = file["odom"] if "odom" in file.files else None
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: expected arrays t, ranges and perhaps odom: {error}") from error
    lengths = {len(times), len(ranges), len(times if odom is None else odom)}
    if ranges.ndim != 2 or len(lengths) != 1:
        raise InputError(f"{path}: expected t (n,), ranges (n, beams), odom (n, 3); got lengths {sorted(lengths)}")
    limit = min(math.floor(float(np.nanmax(ranges)) / 10) * 10.0, LONGEST_RANGE) or LONGEST_RANGE
    for i, row in enumerate(ranges):
        stamp = BEGIN + round((float(times[i]) - float(times[0])) * SECOND)
        yield _sick(stamp, np.asarray(row, np.float64), None if odom is None else _vector(odom[i]), limit)


def _carmen(path: Path) -> Iterator[ScanInput]:
    opener: Any = gzip.open if path.suffix == ".gz" else open
    begin: float | None = None
    try:
        with opener(path, "rt", encoding="ascii") as lines:
            for number, line in enumerate(lines, start=1):
                words = line.split()
                if not words or words[0] != "FLASER":
                    continue
                try:
                    count = int(words[1])
                    ranges = np.array(words[2 : 2 + count], np.float64)
                    rest = words[2 + count :]
                    odom = (float(rest[3]), float(rest[4]), float(rest[5]))
                    time = float(rest[6])
                except (ValueError, IndexError) as error:
                    raise InputError(f"{path}:{number}: expected FLASER n, n ranges, 6 numbers, time") from error
                begin = time if begin is None else begin
                yield _sick(BEGIN + round((time - begin) * SECOND), ranges, odom, LONGEST_RANGE)
    except (OSError, EOFError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not a log with scans: {error}") from error


def _sick(stamp: int, ranges: Array, odom: Vector | None, limit: float) -> ScanInput:
    """Half a turn ahead: n beams, or n + 1 with both ends."""
    count = len(ranges)
    return ScanInput(
        stamp=stamp,
        ranges=ranges,
        start_angle=-math.pi / 2,
        angle_increment=math.pi / max(count - count % 2, 1),
        range_min=0.02,
        range_max=limit,
        odom=odom,
    )


def _urg(path: Path) -> Iterator[ScanInput]:
    recording = RecordedRanges.load(path)
    for time, row in zip(recording.times.tolist(), recording.ranges, strict=True):
        yield ScanInput(
            stamp=BEGIN + time,
            ranges=np.where(row / 1000 >= URG_ERRORS, row / 1000, np.inf),
            start_angle=-URG_AHEAD * URG_STEP,
            angle_increment=URG_STEP,
            range_min=URG_ERRORS,
            range_max=URG_RANGE,
            time_increment=0.1 / 1024,
            mount=(0.145, 0.0, 0.0),
        )


def _vector(values: Any) -> Vector:
    x, y, yaw = (float(value) for value in values)
    return x, y, yaw
