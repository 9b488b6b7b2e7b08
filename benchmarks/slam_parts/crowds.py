"""Mapping among walking people in drawn logs (``drawn``): along with the robot, against it and across its path.

People are discs that walk along the robot's own path, so no wall is in their way: ahead or behind at its speed, in the
opposite direction, or across. Their number hides ``SHARES`` of the beams; in logs of an odd seed they appear after a
third of the time. Wheels are right, so every scan at which they are rejected counts; a live pose that is wrong by more
than ``WRONG`` must be reported within ``UNREPORTED``.
"""

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.slam_parts.drawn import PERIOD, REACH, over_drives
from monstertruck_estimation.slam.config import GridConfig, MapperConfig
from monstertruck_estimation.slam.mapping import MappingEstimator
from monstertruck_estimation.slam.scans import ScanGeometry, prepare_input
from monstertruck_estimation.slam.worker_io import ScanInput
from monstertruck_kinematics.se2 import between, compose
from monstertruck_schemas.health import LocalisationStatus, OdometryUse

SHARES = (0.1, 0.2, 0.3, 0.4)
SEEDS = 5
SCANS = 400
"""Scans of a log."""
RADIUS = 0.25
"""Radius of a person, m."""
KINDS = ("along", "against", "across")
MOST = 60
"""People of a log."""
WRONG, UNREPORTED = 0.10, 3.0
"""Greatest error of a live pose, m, and how long it may be greater without a report, s."""


def run(folder: Path, *, quick: bool) -> tuple[dict[str, float], dict[str, float], bool]:
    """Return figures, goals, and whether all are met."""

    def cases(log: tuple, name: str, seed: int) -> Iterator[tuple[str, dict[str, float], dict[str, float]]]:
        for share in (0.0, *SHARES):
            goals = {"unreported_s": UNREPORTED, "dropped": 0.0} if share else {}
            yield f"{100 * share:.0f}", followed(log, name, seed, share), goals

    return over_drives(folder, "crowds", 1 if quick else SEEDS, cases)


def followed(
    log: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, ScanGeometry], name: str, seed: int, share: float
) -> dict[str, float]:
    """Return errors of the live pose (m), time wrong and unreported (s), and the number of scans without wheels."""
    stamps, ranges, odometry, poses, geometry = log
    rng = np.random.default_rng((seed, len(name), round(100 * share)))
    seen, hidden = among(ranges[:SCANS], poses, geometry, share, rng, SCANS // 3 * (seed % 2))
    estimator, rows = MappingEstimator(MapperConfig(), GridConfig(), start=tuple(poses[0].tolist())), []
    fields = geometry.start_angle, geometry.angle_increment, geometry.range_min, geometry.range_max
    for stamp, row, odom, pose in zip(stamps.tolist(), seen, odometry, poses, strict=False):
        inputs = ScanInput(stamp, row, *fields, odom=tuple(odom.tolist()))
        estimate = estimator.step(prepare_input(inputs, MapperConfig().longest), inputs)
        assert estimate is not None
        off = between(pose, np.array(estimate.pose))
        reported = estimate.status in {LocalisationStatus.UNCERTAIN, LocalisationStatus.LOST}
        rows.append((math.hypot(off[0], off[1]), reported, estimate.odometry is not OdometryUse.USED))
    off, reported, dropped = np.array(rows[1:]).T
    return {
        "beams": hidden,
        "max_m": float(off.max()),
        "mean_m": float(off.mean()),
        "reported": float(reported.mean()),
        "unreported_s": longest((off > WRONG) & ~reported.astype(bool)) * PERIOD,
        "dropped": float(dropped.sum()),
    }


def longest(marks: np.ndarray) -> int:
    """Return the length of the longest run of marks."""
    best = row = 0
    for mark in marks.tolist():
        row = row + 1 if mark else 0
        best = max(best, row)
    return best


def among(
    ranges: np.ndarray, poses: np.ndarray, geometry: ScanGeometry, share: float, rng: np.random.Generator, since: int
) -> tuple[np.ndarray, float]:
    """Return ranges, shape (n, beams), among people from scan ``since`` on, and the share of beams that hit one."""
    seen = ranges.copy()
    here = poses[: len(ranges)]
    hidden = 0.0
    for number in range(MOST):
        if hidden >= share:
            break
        people = _walk(poses, len(ranges), KINDS[number % len(KINDS)], rng)
        seen[since:] = np.minimum(seen[since:], _met(people, here, geometry, ranges.shape[1])[since:])
        hidden = float((seen[since:] < ranges[since:]).mean())
    met = seen < ranges
    return np.where(met, seen + rng.normal(0.0, 0.01, seen.shape), seen), hidden


def _walk(poses: np.ndarray, count: int, kind: str, rng: np.random.Generator) -> np.ndarray:
    """Return the places, shape (count, 2), of a person at every scan, m."""
    scans = np.arange(count)
    lead, aside = rng.integers(8, 40), rng.uniform(-0.6, 0.6)
    at = np.full(count, 0)
    if kind == "along":
        at = scans + lead
    elif kind == "against":
        at = scans + lead - 2 * ((scans + rng.integers(60)) % 60)
    else:
        at = (scans // 40 + 1) * 40 - lead // 4
        aside = 1.5 * np.sin(scans * PERIOD * rng.uniform(0.4, 0.9) + rng.uniform(0, math.tau))
    at = np.clip(at, 0, len(poses) - 1)
    offset = np.zeros((count, 3))
    offset[:, 1] = aside
    return compose(poses[at], offset)[:, :2]


def _met(people: np.ndarray, poses: np.ndarray, geometry: ScanGeometry, beams: int) -> np.ndarray:
    """Return the distance, shape (n, beams), of every beam to the person; ``REACH`` + 1 if it misses."""
    place = between(poses, np.column_stack((people, np.zeros(len(people)))))[:, :2]
    angles = geometry.start_angle + geometry.angle_increment * np.arange(beams)
    ahead = place @ np.stack((np.cos(angles), np.sin(angles)))
    across = (place**2).sum(axis=1)[:, None] - ahead**2
    far = ahead - np.sqrt(np.maximum(RADIUS**2 - across, 0.0))
    inside = (across < RADIUS**2) & (far > geometry.range_min)
    return np.where(inside & (far < REACH), far, REACH + 1.0)
