"""Scans with odometry from this program's MCAP logs, other MCAP files and bags, CARMEN, npz and URG text."""

import math
from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from monstertruck_drivers.hokuyo_urg.recording import RecordedRanges
from monstertruck_estimation.slam.worker_io import ScanInput
from monstertruck_kinematics.elementary import Array
from monstertruck_runtime import wire
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError, NotFoundError
from monstertruck_runtime.outside import arrays as arrays_of
from monstertruck_runtime.outside import reading
from monstertruck_runtime.small_files import require_file
from monstertruck_schemas.sensor import LaserScan
from monstertruck_schemas.topics import ODOMETRY, SCAN
from monstertruckd.recorder.frames import MAGIC
from monstertruckd.recorder.reader import STRANGERS, LogReader, open_log
from monstertruckd.tools.logs.bag_scans import scans_of
from monstertruckd.tools.logs.bags import METADATA, content_of, mcap_messages
from monstertruckd.tools.logs.carmen import read_carmen
from monstertruckd.tools.logs.scan_log import (
    BEGIN,
    LogGeometry,
    OdometryLog,
    ScanLog,
    half_turn,
    missing,
    no_return,
    vector,
)

BAG: Final = b"#ROSBAG V"
DATABASE: Final = b"SQLite format 3\0"
OWN_FIELD: Final = b"codes"
"""Name of a field that only this program's scans have."""
EXPECTED: Final = "MCAP, a ROS bag, CARMEN text, npz or URG text"


def read_scans(path: Path, geometry: LogGeometry | None = None, topics: tuple[str, ...] = ()) -> ScanLog:
    """Read any log with scans.

    Args:
        path: the log; for ROS 2, its folder.
        geometry: geometry of a log that lacks it; it overrides the one in an npz log or a bag.
        topics: topics of scans and odometry, for logs with several; for a CARMEN log the first word of its lines.

    Raises:
        NotFoundError: no such file.
        InputError: the log has an unknown format, is damaged, has no scans, or already defines the given geometry or
            topics.
    """
    given = {} if geometry is None else geometry.known
    if path.is_dir():
        if not (path / METADATA).is_file():
            raise InputError(f"{path}: a folder without {METADATA}: expected a ROS 2 bag, or one log")
        return _checked(path, _bag(path, 2, given, topics), given, topics)
    try:
        require_file(path)
        with path.open("rb") as file:
            head = file.read(32)
    except FileNotFoundError:
        raise NotFoundError(f"{path}: no such log") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    with reading(path, "a log with scans"):
        return _checked(path, _read(path, head, given, topics), given, topics)


def _checked(path: Path, log: ScanLog, given: dict[str, Any], topics: tuple[str, ...]) -> ScanLog:
    if not log.scans:
        raise InputError(f"{path}: no scans: expected {EXPECTED}")
    if given and log.make in ("mcap", "urg"):
        raise InputError(f"{path}: {next(iter(given))}: a log of this format ({log.make}) contains its geometry")
    if topics and not log.sources:
        raise InputError(f"{path}: {topics[0]}: a log of this format ({log.make}) has no topics to choose")
    return log


def _read(path: Path, head: bytes, given: dict[str, Any], topics: tuple[str, ...]) -> ScanLog:
    if head.startswith(MAGIC):
        return _mcap(path, given, topics)
    if head.startswith((BAG, DATABASE)):
        return _bag(path, 1 if head.startswith(BAG) else 2, given, topics)
    if head.startswith(b"PK"):
        return _arrays(path, given)
    for begin, text in STRANGERS.items():
        if head.startswith(begin) and not (path.suffix == ".gz" and begin == b"\x1f\x8b"):
            raise InputError(f"{path}: {text}")
    if path.name.removesuffix(".gz").endswith(".dat"):
        return ScanLog("urg", list(_urg(path)), -BEGIN / SECOND)
    return read_carmen(path, given, topics)


def _bag(path: Path, version: int, given: dict[str, Any], topics: tuple[str, ...]) -> ScanLog:
    from monstertruckd.tools.logs.ros_bags import ros_messages  # noqa: PLC0415 - comes with an extra

    content = content_of(path, ros_messages(path, version))
    return scans_of(path, f"bag of ROS {version}", content, given, topics)


def _mcap(path: Path, given: dict[str, Any], topics: tuple[str, ...]) -> ScanLog:
    """Read a log of this program or another MCAP file; ``topics`` applies only to the latter."""
    reader = open_log(path)
    if not topics and (scans := list(_own(reader))):
        return ScanLog("mcap", scans, fault=reader.fault)
    content = content_of(path, mcap_messages(reader.records()))
    try:
        log = scans_of(path, "mcap by others", content, given, topics)
    except InputError as error:
        raise InputError(f"{error}; it {reader.fault}" if reader.fault else str(error)) from error
    return replace(log, fault=reader.fault)


def _own(reader: LogReader) -> Iterator[ScanInput]:
    """Yield the scans of a log of this program; none for other logs."""
    scans: list[LaserScan] = []
    rows: list[tuple[int, float, float, float]] = []
    for raw in mcap_messages(reader.records()):
        if (raw.topic, raw.schema) == (SCAN.name, SCAN.schema_name) and OWN_FIELD in raw.definition:
            scans.append(wire.decode(SCAN, raw.data))
        elif (raw.topic, raw.schema) == (ODOMETRY.name, ODOMETRY.schema_name):
            content = wire.decode(ODOMETRY, raw.data)
            rows.append((content.stamp, content.pose.x, content.pose.y, content.pose.yaw))
    if not scans:
        return
    lidar = (reader.config().get("devices") or {}).get("lidar") or {}
    at = lidar.get("mount") or {}
    mount = (float(at.get("x", 0.0)), float(at.get("y", 0.0)), float(at.get("yaw", 0.0)))
    stamps = np.array([row[0] for row in rows], np.int64)
    odometry = OdometryLog(stamps, np.array([row[1:] for row in rows]).reshape(-1, 3))
    for scan in scans:
        yield odometry.attached(ScanInput.of(scan, mount))


def _arrays(path: Path, given: dict[str, Any]) -> ScanLog:
    """Read an npz log; its geometry is ``given``, otherwise from its arrays of the same names, otherwise assumed."""
    arrays = arrays_of(path, "arrays t, ranges and optionally odom")
    ranges = _array(path, arrays, "ranges", (-1, -1))
    times = _array(path, arrays, "t", (len(ranges),))
    odom = _array(path, arrays, "odom", (len(ranges), 3)) if "odom" in arrays else None
    if not len(times):
        return ScanLog("npz", [])
    bad = np.flatnonzero(~np.isfinite(times))
    if len(bad):
        raise InputError(f"{path}: t: expected finite seconds, got {times[bad[0]]} in row {bad[0]}")
    span = float(np.ptp(times))
    if span > 1e9:  # longer npz logs are in units other than seconds, s
        raise InputError(f"{path}: t: expected seconds, got a log of {span:g} s")
    if not (np.isfinite(ranges) & (ranges > 0)).any():
        raise InputError(f"{path}: ranges: expected metres, got no finite value above 0")
    shapes: dict[str, tuple[int, ...]] = {item.name: () for item in fields(LogGeometry)} | {"mount": (3,)}
    own = {name: _array(path, arrays, name, shape) for name, shape in shapes.items() if name in arrays}
    known = {name: vector(value) if name == "mount" else float(value) for name, value in own.items()} | given
    _check(path, known)
    scans = [
        half_turn(
            BEGIN + round((time - float(times[0])) * SECOND),
            row,
            None if odom is None or not np.isfinite(odom[i]).all() else vector(odom[i]),
            {"range_max": no_return(ranges)} | known,
        )
        for i, (time, row) in enumerate(zip(times.tolist(), ranges, strict=True))
    ]
    return ScanLog("npz", scans, float(times[0]) - BEGIN / SECOND, missing(known))


def _array(path: Path, arrays: dict[str, Any], name: str, shape: tuple[int, ...]) -> Array:
    """Return a numeric array with this shape (-1 = any length)."""
    wanted = f"{path}: {name}: expected numbers of shape ({', '.join('n' if k < 0 else str(k) for k in shape)})"
    if name not in arrays:
        raise InputError(f"{wanted}, got no such array")
    values = arrays[name]
    fits = values.ndim == len(shape) and all(k in (-1, n) for k, n in zip(shape, values.shape, strict=True))
    if values.dtype.kind not in "fiu" or not fits:
        raise InputError(f"{wanted}, got {values.dtype} of shape {values.shape}")
    return np.asarray(values, np.float64)


def _check(path: Path, geometry: dict[str, Any]) -> None:
    for name, value in geometry.items():
        if not np.isfinite(value).all() or (name == "angle_increment" and value == 0):
            wanted = "finite numbers, not 0" if name == "angle_increment" else "finite numbers"
            raise InputError(f"{path}: {name}: expected {wanted}, got {value}")


def _urg(path: Path) -> Iterator[ScanInput]:
    recording = RecordedRanges.load(path)
    urg_errors = 0.02  # shorter readings of a URG are error codes, m
    urg_step = math.tau / 1024
    urg_ahead = 341  # beam of a URG recording that points straight ahead
    for time, row in zip(recording.times.tolist(), recording.ranges, strict=True):
        yield ScanInput(
            stamp=BEGIN + time,
            ranges=np.where(row / 1000 >= urg_errors, row / 1000, np.inf),
            start_angle=-urg_ahead * urg_step,
            angle_increment=urg_step,
            range_min=urg_errors,
            range_max=5.6,  # m
            time_increment=0.1 / 1024,
            mount=(0.145, 0.0, 0.0),
        )
