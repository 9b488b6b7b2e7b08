"""Tracking across the edge of a map: localised robots leave the mapped ground.

Maps are of parts of a log, as in ``localisation``, and the whole log's trajectory is the truth. A robot starts at its
true pose on the map, with less than half of a scan on the map within ``SOON`` metres, and is followed over ``WAY``
metres until it reports that it is lost. A pose is hidden wrong if it is off by more than 0.5 m or 10 degrees, and by
more than three standard deviations of its own covariance.
"""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.slam_parts.localisation import PLACED, Mapped, error, mapped, truth
from benchmarks.slam_parts.logs import load
from monstertruck_estimation.slam.config import MapperConfig
from monstertruck_estimation.slam.localisation import LocalisationEstimator, submap_of
from monstertruck_estimation.slam.registration import measure
from monstertruck_estimation.slam.scans import prepare, prepare_input
from monstertruck_estimation.slam.worker_io import ScanInput
from monstertruck_kinematics.se2 import between

LOGS = ("intel1", "csail")
STRETCHES = ((0.0, 0.25), (0.3, 0.55), (0.5, 0.75))
SOON, SPACING, WAY = 6.0, 1.5, 12.0
"""Way to the edge at most, between two starts at least, and driven, m."""
SECONDS = 90.0
STARTS, QUICK_STARTS = 8, 2
"""Starts on every map, with and without wheels, by a lidar of 30 m and one of 5.6 m."""
GOALS = {f"map_edge.{log}.{kind}.hidden_share": 0.01 for log in LOGS for kind in ("wheels", "scans_alone")}


def overlaps(case: Mapped) -> np.ndarray:
    """Return the share of every scan of the log, shape (n,), that fits the map at its true pose."""
    cloud, geometry = submap_of(case.saved).cloud, case.log.geometry
    scans = (prepare(ranges, geometry, longest=30.0) for ranges in case.log.ranges)
    return np.array([measure(scan, cloud, pose).overlap for scan, pose in zip(scans, case.poses, strict=True)])


def starts(case: Mapped, count: int) -> list[int]:
    """Return the scans on the map from which the log soon leaves it."""
    overlap = overlaps(case)
    way = np.r_[0.0, np.cumsum(np.hypot(*np.diff(case.poses[:, :2], axis=0).T))]
    soon = np.searchsorted(way, way + SOON)
    known = [k for k in range(len(way) - 30) if overlap[k] >= 0.9 and (overlap[k : soon[k]] < 0.5).sum() >= 3]
    np.random.default_rng(7).shuffle(known)
    chosen: list[int] = []
    for k in known:
        if len(chosen) < count and all(abs(way[k] - way[other]) > SPACING for other in chosen):
            chosen.append(k)
    return chosen


def tracked(case: Mapped, start: int, *, wheels: bool) -> list[tuple[bool, bool]]:
    """Return, for every pose published by one robot, whether it is wrong, and whether its covariance hides that."""
    log, geometry = case.log, case.log.geometry
    estimator = LocalisationEstimator(case.saved, MapperConfig(), tuple(case.poses[start].tolist()))
    way, found = 0.0, []
    for k in range(start, len(log.stamps)):
        way += math.hypot(*(case.poses[k] - case.poses[max(k - 1, start)])[:2])
        if way > WAY or (log.stamps[k] - log.stamps[start]) * 1e-9 > SECONDS:
            break
        inputs = ScanInput(
            int(log.stamps[k]) + 1,
            log.ranges[k],
            geometry.start_angle,
            geometry.angle_increment,
            geometry.range_min,
            geometry.range_max,
            odom=between(log.odom[start], log.odom[k]).tolist() if wheels else None,
        )
        estimate = estimator.step(prepare_input(inputs, 30.0, estimator.twist), inputs)
        if estimate is None or estimate.status not in PLACED:
            break
        found.append(error(case.poses[k], estimate))
    return found


def run(folder: Path, *, quick: bool = False) -> tuple[dict[str, float], dict[str, float], bool]:
    """Run both logs; return figures, goals and whether they are met."""
    figures: dict[str, float] = {}
    for name in LOGS:
        log = load(folder, name)
        poses = truth(log)
        short = replace(log, geometry=replace(log.geometry, range_max=5.6))
        cases = [
            mapped(one, poses, share, graph=graph)
            for share in STRETCHES
            for one, graph in ((log, True), (log, False), (short, True), (short, False))
        ]
        chosen = [(case, k) for case in cases for k in starts(case, QUICK_STARTS if quick else STARTS)]
        for kind in ("wheels", "scans_alone"):
            robots = [tracked(case, k, wheels=kind == "wheels") for case, k in chosen]
            every = np.array([pose for robot in robots for pose in robot])
            prefix = f"map_edge.{name}.{kind}"
            figures[f"{prefix}.robots"] = len(robots)
            figures[f"{prefix}.poses"] = len(every)
            figures[f"{prefix}.wrong_share"] = round(float(every[:, 0].mean()), 4)
            figures[f"{prefix}.hidden_share"] = round(float(every[:, 1].mean()), 4)
            figures[f"{prefix}.hidden_robots"] = sum(any(hidden for _, hidden in robot) for robot in robots)
            print({key: value for key, value in figures.items() if key.startswith(prefix)}, flush=True)
    met = all(figures[key] <= goal for key, goal in GOALS.items())
    return figures, dict(GOALS), met
