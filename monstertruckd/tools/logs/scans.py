"""Scans with odometry from logs of several formats: our MCAP, CARMEN text, arrays in npz, URG text."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from monstertruck_drivers.hokuyo_urg.recording import RecordedRanges
from monstertruck_estimation.slam.worker_io import ScanInput
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import Pose2, between, interpolate
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError, NotFoundError
from monstertruck_runtime.outside import arrays as arrays_of
from monstertruck_runtime.outside import lines_of, reading
from monstertruck_runtime.small_files import require_file
from monstertruck_schemas.sensor import LaserScan
from monstertruck_schemas.state import Odometry
from monstertruckd.recorder.frames import MAGIC
from monstertruckd.recorder.reader import LogReader, open_log

BEGIN: Final = SECOND
"""Stamp of the first scan of a log with times of another origin, ns."""
LONGEST_RANGE: Final = 80.0
"""Ranges from here on are no-returns of the lasers that CARMEN logs come from, m."""
SHORTEST_RANGE: Final = 0.02
LONGEST_LOG: Final = 1e9
"""A longer npz log has other units than seconds, s."""
NO_RETURN_SHARE: Final = 0.001
"""The greatest range of an npz log means no return if at least this share of its beams has it."""
URG_STEP: Final = math.tau / 1024
URG_ERRORS: Final = 0.02
"""Shorter readings of a URG are error codes, m."""
URG_RANGE: Final = 5.6
URG_AHEAD: Final = 341
"""Beam of a URG recording that looks straight ahead."""


@dataclass(frozen=True, slots=True)
class LogGeometry:
    """Geometry of the scans of a log that does not hold it (npz, CARMEN); None = as in the log, or assumed."""

    start_angle: float | None = None
    """Angle of the first beam, rad, counter-clockwise from ahead."""
    angle_increment: float | None = None
    """Angle between neighbouring beams, rad."""
    range_min: float | None = None
    """Shorter ranges are no returns, m."""
    range_max: float | None = None
    """Ranges from here on are no returns, m."""
    time_increment: float | None = None
    """Seconds between neighbouring beams."""
    mount: Pose2 | None = None
    """Planar pose of the sensor in base, m and rad."""

    @property
    def known(self) -> dict[str, Any]:
        """Fields that are not None."""
        values = {item.name: getattr(self, item.name) for item in fields(self)}
        return {name: value for name, value in values.items() if value is not None}


@dataclass(frozen=True, slots=True)
class ScanLog:
    """A log's scans, in order."""

    make: str
    scans: list[ScanInput]
    begin: float = 0.0
    """Time of the log's own clock that is stamp 0 here, s."""
    assumed: tuple[str, ...] = field(default=())
    """Parts of the geometry that neither the log nor the caller gave."""
    fault: str | None = None
    """What is wrong with the file, whose end is missing perhaps."""


def read_scans(path: Path, geometry: LogGeometry | None = None) -> ScanLog:
    """Read any log with scans.

    Args:
        path: the log.
        geometry: of a log that does not hold it; it overrides what an npz log says.

    Raises:
        NotFoundError: no such file.
        InputError: it is of no known format, damaged, has no scans, or brings the geometry that was given.
    """
    try:
        require_file(path)
        with path.open("rb") as file:
            head = file.read(16)
    except FileNotFoundError:
        raise NotFoundError(f"{path}: no such log") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    given = {} if geometry is None else geometry.known
    with reading(path, "a log with scans"):
        return _read(path, head, given)


def _read(path: Path, head: bytes, given: dict[str, Any]) -> ScanLog:
    if head.startswith(MAGIC):
        reader = open_log(path)
        log = ScanLog("mcap", list(_mcap(reader)), fault=reader.fault)
    elif head.startswith(b"PK"):
        log = _arrays(path, given)
    elif path.name.removesuffix(".gz").endswith(".dat"):
        log = ScanLog("urg", list(_urg(path)), -BEGIN / SECOND)
    else:
        log = _carmen(path, given)
    if not log.scans:
        raise InputError(f"{path}: no scans: expected MCAP with sensor/scan, CARMEN text, npz or URG text")
    if given and log.make in ("mcap", "urg"):
        raise InputError(f"{path}: {next(iter(given))}: a log of this format ({log.make}) brings its geometry")
    return log


def _mcap(reader: LogReader) -> Iterator[ScanInput]:
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


def _arrays(path: Path, given: dict[str, Any]) -> ScanLog:
    """An npz log; its geometry is what is ``given``, else its arrays of the same names, else assumed."""
    arrays = arrays_of(path, "arrays t, ranges and perhaps odom")
    ranges = _array(path, arrays, "ranges", (-1, -1))
    times = _array(path, arrays, "t", (len(ranges),))
    odom = _array(path, arrays, "odom", (len(ranges), 3)) if "odom" in arrays else None
    if not len(times):
        return ScanLog("npz", [])
    bad = np.flatnonzero(~np.isfinite(times))
    if len(bad):
        raise InputError(f"{path}: t: expected finite seconds, got {times[bad[0]]} in row {bad[0]}")
    span = float(np.ptp(times))
    if span > LONGEST_LOG:
        raise InputError(f"{path}: t: expected seconds, got a log of {span:g} s")
    if not (np.isfinite(ranges) & (ranges > 0)).any():
        raise InputError(f"{path}: ranges: expected metres, got no finite value above 0")
    shapes: dict[str, tuple[int, ...]] = {item.name: () for item in fields(LogGeometry)} | {"mount": (3,)}
    own = {name: _array(path, arrays, name, shape) for name, shape in shapes.items() if name in arrays}
    known = {name: _vector(value) if name == "mount" else float(value) for name, value in own.items()} | given
    _check(path, known)
    scans = [
        _sick(
            BEGIN + round((time - float(times[0])) * SECOND),
            row,
            None if odom is None or not np.isfinite(odom[i]).all() else _vector(odom[i]),
            {"range_max": _no_return(ranges)} | known,
        )
        for i, (time, row) in enumerate(zip(times.tolist(), ranges, strict=True))
    ]
    return ScanLog("npz", scans, float(times[0]) - BEGIN / SECOND, _missing(known))


def _array(path: Path, arrays: dict[str, Any], name: str, shape: tuple[int, ...]) -> Array:
    """An array of numbers of this shape (-1 = any length)."""
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


def _no_return(ranges: Array) -> float:
    """The range from which on there was no return: a greatest one that recurs, or infinity."""
    finite = ranges[np.isfinite(ranges)]
    greatest = float(finite.max())
    recurs = np.count_nonzero(finite == greatest) >= max(NO_RETURN_SHARE * finite.size, 3)
    return min(greatest if recurs else math.inf, LONGEST_RANGE)


def _missing(known: dict[str, Any]) -> tuple[str, ...]:
    return tuple(item.name for item in fields(LogGeometry) if item.name not in known)


def _carmen(path: Path, given: dict[str, Any]) -> ScanLog:
    _check(path, given)
    begin: float | None = None
    scans: list[ScanInput] = []
    for number, line in enumerate(lines_of(path, "a log with scans (MCAP, npz or text)"), start=1):
        words = line.split()
        if not words or words[0] != "FLASER":
            continue
        with reading(f"{path}:{number}", "FLASER n, n ranges, 6 numbers, time"):
            count = int(words[1])
            if not 0 <= count <= len(words):
                raise ValueError(f"{count} ranges")
            ranges = np.array(words[2 : 2 + count], np.float64)
            rest = words[2 + count :]
            odom = (float(rest[3]), float(rest[4]), float(rest[5]))
            time = float(rest[6])
            begin = time if begin is None else begin
            stamp = BEGIN + round((time - begin) * SECOND)
            scans.append(_sick(stamp, ranges, odom, {"range_max": LONGEST_RANGE} | given))
    return ScanLog("carmen", scans, (begin or 0.0) - BEGIN / SECOND, _missing(given))


def _sick(stamp: int, ranges: Array, odom: Pose2 | None, geometry: dict[str, Any]) -> ScanInput:
    """A scan of this ``geometry``; by default half a turn ahead: n beams, or n + 1 with both ends."""
    count = len(ranges)
    assumed = {
        "start_angle": -math.pi / 2,
        "angle_increment": math.pi / max(count - count % 2, 1),
        "range_min": SHORTEST_RANGE,
    }
    return ScanInput(stamp=stamp, ranges=ranges, odom=odom, **(assumed | geometry))


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


def _vector(values: Any) -> Pose2:
    x, y, yaw = (float(value) for value in values)
    return x, y, yaw
