"""Global localisation from starts by seed: in a map of one stretch of a log, robots begin anywhere in the rest of it.

The whole log is mapped first; that trajectory is the truth, and the frame of the maps. A stretch of it makes the map:
as keyframes with their grid, or as the grid alone. A start follows the log from a random scan outside that stretch,
with or without wheels, until it is placed and has driven on, for at most ``WAY`` metres or ``SECONDS``. Many begin in
rooms that are not on the map: those that never come to it are to be reported as outside. A pose behind the first one
that is off by no more than its covariance says, as along a corridor by scans alone, is neither right nor wrong.
"""

import math
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.slam_parts.logs import Log, load
from monstertruck_estimation.slam.config import GridConfig, MapperConfig
from monstertruck_estimation.slam.grid import GridBuilder
from monstertruck_estimation.slam.localisation import LocalisationEstimator, submap_of
from monstertruck_estimation.slam.mapping import Mapper
from monstertruck_estimation.slam.registration import measure
from monstertruck_estimation.slam.scans import prepare, prepare_input
from monstertruck_estimation.slam.storage import SavedGraph, SavedMap, trinary
from monstertruck_estimation.slam.worker_io import ScanInput, SlamEstimate
from monstertruck_kinematics.se2 import between
from monstertruck_schemas.health import MATCHED, LocalisationStatus

STRETCHES = ((0.0, 0.25), (0.3, 0.55))
"""Shares of the log that are mapped, one after the other for the variants."""
SECONDS, WAY = 90.0, 15.0
FOLLOWED = 3.5
"""Way after the first fix over which it must stay right, m."""
RIGHT = (0.5, math.radians(10))
COVERED = 3.0
"""Standard deviations of its own covariance by which a pose behind the first one may be off."""
ON_MAP = 0.9
"""A scan overlaps by this at its true pose where the place is on the map."""
OFF_MAP = 0.7
STARTS, QUICK_STARTS = 25, 5
PLACED = MATCHED | {LocalisationStatus.LOST}
GOALS = {"localise.wrong": 0, "localise.right_share": 0.85, "localise.outside_share": 0.9}
AT_LEAST = ("localise.right_share", "localise.outside_share")


@dataclass(frozen=True)
class Mapped:
    """A log with its truth, and a map of a part of it."""

    log: Log
    poses: np.ndarray
    """Shape (n, 3), base in map at every scan."""
    stretch: tuple[int, int]
    saved: SavedMap


def mapped(log: Log, poses: np.ndarray, share: tuple[float, float], *, graph: bool) -> Mapped:
    """Return the map of a ``share`` (from, to) of the log, made of keyframes or of its grid alone."""
    first, last = (round(part * len(poses)) for part in share)
    builder, kept, scans = GridBuilder(GridConfig()), [], []
    for k in range(first, last):
        scan = prepare(log.ranges[k], log.geometry, longest=30.0)
        builder.add(scan, int(log.stamps[k]), poses[k], log.geometry.mount)
        off = between(poses[kept[-1]], poses[k]) if kept else np.full(3, np.inf)
        if math.hypot(off[0], off[1]) >= 0.3 or abs(off[2]) >= 0.35:
            kept.append(k)
            scans.append(scan.downsampled(0.04, 360))
    grid = trinary(builder.grid.patch())
    saved = SavedMap(grid, SavedGraph(log.stamps[kept], poses[kept], tuple(scans), {}) if graph else None)
    return Mapped(log, poses, (first, last), saved)


def truth(log: Log) -> np.ndarray:
    """Return the poses, shape (n, 3), of all scans by mapper, wheels, and the joint registration of the whole log."""
    mapper = Mapper()
    for stamp, ranges, odom in zip(log.stamps.tolist(), log.ranges, log.odom, strict=True):
        mapper.step(prepare(ranges, log.geometry, longest=30.0), stamp, odom)
    mapper.finish()
    return mapper.trajectory()[1]


def error(pose: np.ndarray, estimate: SlamEstimate) -> tuple[bool, bool]:
    """Whether an estimate is off by more than ``RIGHT`` from ``pose``, (3,), and whether its covariance hides that."""
    off = np.array(estimate.pose) - pose
    yaw, way = abs(math.remainder(off[2], math.tau)), math.hypot(off[0], off[1])
    covariance = np.reshape(estimate.covariance, (3, 3))
    # Standard deviation in the direction of the error.
    deviation = math.sqrt(off[:2] @ covariance[:2, :2] @ off[:2]) / max(way, 1e-9)
    hidden = way > max(RIGHT[0], COVERED * deviation), yaw > max(RIGHT[1], COVERED * math.sqrt(covariance[2, 2]))
    return way > RIGHT[0] or yaw > RIGHT[1], any(hidden)


def followed(case: Mapped, start: int, *, wheels: bool) -> dict[str, float | str]:
    """Return one robot's result: outcome, distance and time of the fix.

    right; wrong at the first pose; lost after it; uncertain (off by no more than it stated); searching at a place of
    the map; between (along the edge of the map); outside; or silent about being outside.
    """
    log, geometry = case.log, case.log.geometry
    submap = submap_of(case.saved)
    estimator = LocalisationEstimator(case.saved, MapperConfig())
    way, fixed_at, seen, said = 0.0, None, [], Counter[LocalisationStatus]()
    errors: list[tuple[bool, bool]] = []
    for k in range(start, len(log.stamps)):
        way += math.hypot(*(case.poses[k] - case.poses[max(k - 1, start)])[:2])
        seconds = (log.stamps[k] - log.stamps[start]) * 1e-9
        if seconds > SECONDS or way > (WAY if fixed_at is None else fixed_at[0] + FOLLOWED):
            break
        odom = between(log.odom[start], log.odom[k]).tolist() if wheels else None
        inputs = ScanInput(
            int(log.stamps[k]) + 1,
            log.ranges[k],
            geometry.start_angle,
            geometry.angle_increment,
            geometry.range_min,
            geometry.range_max,
            odom=odom,
        )
        scan = prepare_input(inputs, 30.0, estimator.twist)
        estimate = estimator.step(scan, inputs)
        if estimate is None:
            continue
        said[estimate.status] += 1
        if fixed_at is None and k % 10 == 0:
            seen.append(measure(scan, submap.cloud, case.poses[k]).overlap)
        if estimate.status in PLACED:
            fixed_at = fixed_at or (way, seconds)
            errors.append(error(case.poses[k], estimate))
    if fixed_at is not None:
        off, hidden = np.array(errors).any(axis=0)
        outcome = "wrong" if errors[0][0] else "lost" if hidden else "uncertain" if off else "right"
        return {"outcome": outcome, "way": fixed_at[0], "seconds": fixed_at[1]}
    if np.mean(np.array(seen) > ON_MAP) > 0.2:
        return {"outcome": "searching"}
    if max(seen, default=0.0) > OFF_MAP and np.mean(np.array(seen) > OFF_MAP) > 0.5:
        return {"outcome": "between"}
    return {"outcome": "outside" if said[LocalisationStatus.OUTSIDE] else "silent"}


def run(folder: Path, *, quick: bool = False) -> tuple[dict[str, float], dict[str, float], bool]:
    """Run all variants; return figures, goals and whether they are met."""
    log = load(folder, "intel1")
    poses = truth(log)
    short = replace(log, geometry=replace(log.geometry, range_max=5.6))
    count = QUICK_STARTS if quick else STARTS
    every: list[dict[str, float | str]] = []
    rng = np.random.default_rng(19)
    variants = [(graph, wheels) for graph in (True, False) for wheels in (True, False)]
    for number, (graph, wheels) in enumerate(variants):
        # The lidar of 30 m in one half of the variants, that of 5.6 m in the other.
        case = mapped(log if graph == wheels else short, poses, STRETCHES[number % 2], graph=graph)
        first, last = case.stretch
        outside = np.setdiff1d(np.arange(len(poses) - 200), np.arange(first - 50, last))
        results = [followed(case, int(start), wheels=wheels) for start in rng.choice(outside, count, replace=False)]
        outcomes = Counter(str(result["outcome"]) for result in results)
        name = f"{'graph' if graph else 'grid'}, {'wheels' if wheels else 'scans alone'}"
        print(f"localise {name}: {dict(outcomes)}", flush=True)
        every += results
    outcomes = Counter(str(result["outcome"]) for result in every)
    ways = [float(result["way"]) for result in every if "way" in result]
    on_map = outcomes["right"] + outcomes["wrong"] + outcomes["lost"] + outcomes["uncertain"] + outcomes["searching"]
    off_map = outcomes["outside"] + outcomes["silent"]
    figures = {
        "localise.starts": len(every),
        "localise.wrong": outcomes["wrong"] + outcomes["lost"],
        "localise.right": outcomes["right"],
        "localise.uncertain": outcomes["uncertain"],
        "localise.searching": outcomes["searching"],
        "localise.right_share": round(outcomes["right"] / max(on_map, 1), 3),
        "localise.outside_share": round(outcomes["outside"] / off_map, 3) if off_map else 1.0,
        "localise.way_median_m": round(float(np.median(ways)), 2) if ways else math.inf,
    }
    met = True
    for key, goal in GOALS.items():
        good = figures[key] >= goal if key in AT_LEAST else figures[key] <= goal
        met &= good
        print(f"{key:24} {figures[key]:8.3f}  goal {goal}  {'met' if good else 'NOT MET'}")
    return figures, dict(GOALS), met
