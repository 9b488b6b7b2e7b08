"""Errors of a log's estimates relative to the stand: odometry, pose in map, tracker; and the stand's latency.

An estimate's frame is aligned with the stand's by least squares of the poses (rotation and translation, no scale). The
latency is the time shift with the best agreement between the turns of odometry and stand.
"""

from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.fitting import least_squares
from monstertruck_kinematics.se2 import interpolate, wrap
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.topics import ODOMETRY, POSE, STAND_POSE, TRACKER
from monstertruckd.recorder.reader import LogReader

LEAST_COMMON: Final = 40
"""Minimum number of common poses."""


@dataclass(frozen=True)
class EstimateError:
    """Error of an estimate against the stand."""

    what: str
    poses: int
    position_rms: float
    """RMS position error (m)"""
    position_end: float
    """Position error at the last pose, with the frames aligned at the first ones (m)"""
    heading_rms: float
    """RMS heading error (rad)"""
    latency: float | None
    """Delay of the stand's stamps relative to the estimate (s); None: too little rotation to determine it"""


def errors_of(log: LogReader) -> list[EstimateError]:
    """Return the errors of odometry and map pose; of a damaged log up to the damage.

    Raises:
        InputError: the log has no poses of a stand, or none of an estimate.
    """
    series: dict[str, list[tuple[float, float, float, float]]] = {n.name: [] for n in (STAND_POSE, ODOMETRY, POSE)}
    for entry in log:
        if entry.topic in series:
            message: Any = entry.decode()
            series[entry.topic].append((message.stamp, message.pose.x, message.pose.y, message.pose.yaw))
    seen = _array(series[STAND_POSE.name])
    if len(seen) < LEAST_COMMON:
        raise InputError(
            f"{log.path}: contains {len(seen)} poses of a stand: expected {LEAST_COMMON}, as with `stand: overhead`"
        )
    found = [
        error_of(topic.name, seen, rows)
        for topic in (ODOMETRY, POSE)
        if len(rows := _array(series[topic.name])) >= LEAST_COMMON
    ]
    if not found:
        raise InputError(f"{log.path}: contains no odometry")
    return found


def tracker_errors(log: LogReader) -> dict[str, float] | None:
    """Return the distance from the path as reported by the tracker (m); None if no tracker drove."""
    reports: list[Any] = [entry.decode() for entry in log if entry.topic == TRACKER.name]
    off = [abs(report.cross_track) for report in reports]
    if not off:
        return None
    return {"reports": float(len(off)), "rms": float(np.sqrt(np.mean(np.square(off)))), "worst": float(max(off))}


def error_of(what: str, seen: Array, estimate: Array) -> EstimateError:
    """Return the errors of one estimate; both (n, 4): stamp (s), x, y (m), yaw (rad)."""
    latency = latency_of(seen, estimate)
    at = seen[:, 0] - (latency or 0.0)
    inside = (at >= estimate[0, 0]) & (at <= estimate[-1, 0])
    if inside.sum() < LEAST_COMMON:
        raise InputError(f"{what}: {int(inside.sum())} poses at times covered by the stand: expected {LEAST_COMMON}")
    truth, there = seen[inside, 1:], interpolate(estimate[:, 0], estimate[:, 1:], at[inside])
    aligned = _laid_over(truth, there, slice(None))
    off = np.hypot(*(aligned[:, :2] - truth[:, :2]).T)
    first = _laid_over(truth, there, slice(0, max(LEAST_COMMON // 2, len(truth) // 20)))
    turn = wrap(aligned[:, 2] - truth[:, 2])
    return EstimateError(
        what,
        int(inside.sum()),
        float(np.sqrt(np.mean(off**2))),
        float(np.hypot(*(first[-1, :2] - truth[-1, :2]))),
        float(np.sqrt(np.mean(turn**2))),
        latency,
    )


def latency_of(seen: Array, estimate: Array) -> float | None:
    """Return the delay of the stand's stamps (s); None if the robot hardly turned."""
    yaw, other = np.unwrap(seen[:, 3]), np.unwrap(estimate[:, 3])
    if np.ptp(yaw) < 0.5:  # minimum rotation to determine the latency, rad
        return None
    times = seen[:, 0]
    reach = 0.5  # maximum latency, s
    inside = (times > estimate[0, 0] + reach) & (times < estimate[-1, 0] - reach)
    if inside.sum() < LEAST_COMMON:
        return None

    def residual(parameters: Array) -> Array:
        predicted = np.interp(times[inside] - parameters[0], estimate[:, 0], other)
        basis = np.column_stack((np.ones(predicted.size), predicted, times[inside] - times[0]))
        return np.asarray(yaw[inside] - basis @ np.linalg.lstsq(basis, yaw[inside], rcond=None)[0])

    fit = least_squares(residual, np.zeros(1), np.array((-reach,)), np.array((reach,)), huber=0.05)
    return float(fit.parameters[0])


def as_values(found: list[EstimateError]) -> list[dict[str, Any]]:
    """Return plain data."""
    return [asdict(row) for row in found]


def _laid_over(truth: Array, estimate: Array, part: slice) -> Array:
    """Return the estimate in the stand's frame: mean turn and translation over ``part``."""
    turns = truth[part, 2] - estimate[part, 2]
    yaw = float(np.arctan2(np.sin(turns).mean(), np.cos(turns).mean()))
    c, s = np.cos(yaw), np.sin(yaw)
    turned = estimate[:, :2] @ np.array(((c, s), (-s, c)))
    shift = (truth[part, :2] - turned[part]).mean(axis=0)
    return np.column_stack((turned + shift, estimate[:, 2] + yaw))


def _array(rows: list[tuple[float, float, float, float]]) -> Array:
    found = np.array(rows, dtype=np.float64).reshape(-1, 4)
    found = found[np.argsort(found[:, 0], kind="stable")]
    if len(found):
        found[:, 0] = found[:, 0] / SECOND
        found = found[np.concatenate(([True], np.diff(found[:, 0]) > 0))]
    return found
