"""Recorded logs whole and thinned: every 2nd, 5th, 10th and 20th scan, with the wheels between them.

Up to a spacing of ``SPACING``, a thinned log must be as good as the whole one: no scan is ``lost`` where the whole log
maps throughout, and the error is at most ``WORSE`` times as large. The whole log's motion leads from the scans of a
thinned log to references between them (``at_all_scans``). URG-04LX exp2 has no reference and no wheels: its thinned
logs are compared with the whole one.
"""

import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from benchmarks.slam_parts.logs import deviation, load, scored
from monstertruck_estimation.slam.config import GridConfig, MapperConfig
from monstertruck_estimation.slam.mapping import MappingEstimator
from monstertruck_estimation.slam.scans import prepare_input
from monstertruck_estimation.slam.worker_io import ScanInput
from monstertruck_kinematics.se2 import between, compose, interpolate
from monstertruck_schemas.health import LocalisationStatus
from monstertruckd.tools.logs.scans import read_scans

LOGS = ("aces", "csail", "exp2", "intel")
EXP2 = "urg04lx_exp2.dat.gz"
EVERY = (1, 2, 5, 10, 20)
SPACING = (1.0, math.radians(30))
"""Mean motion between scans, m and rad, up to which a thinned log is judged."""
WORSE = 1.5
Track = tuple[np.ndarray, np.ndarray]
"""Stamps (n,), ns, and poses (n, 3)."""


def inputs(folder: Path, name: str) -> tuple[list[ScanInput], Callable[[Track], float] | None]:
    """Return the scans of a log, and a function for the error of a trajectory, m; None if it has no reference."""
    if name == "exp2":
        return read_scans(folder / EXP2).scans, None
    log = load(folder, name)
    shape = log.geometry
    scans = [
        ScanInput(
            int(stamp), ranges, shape.start_angle, shape.angle_increment, shape.range_min, shape.range_max,
            odom=tuple(odom.tolist()),
        )
        for stamp, ranges, odom in zip(log.stamps, log.ranges, log.odom, strict=True)
    ]  # fmt: skip
    key = "at_scans" if log.by_relations else "median"
    return scans, lambda track: scored(log, *track)[key]


def at_all_scans(dense: Track, track: Track) -> Track:
    """Return poses at all scans of the whole log: those of the thinned ``track``, led on by the motion of ``dense``.

    Interpolation would measure how the robot drove between the scans: for every 5th scan of Intel, poses of the whole
    log are then off by 0.11 m, too.
    """
    (stamps, poses), (kept, placed) = dense, track
    nearest = np.searchsorted((kept[1:] + kept[:-1]) / 2, stamps)
    origins = interpolate(stamps.astype(float), poses, kept.astype(float))
    return stamps, compose(placed[nearest], between(origins[nearest], poses))


def mapped(scans: list[ScanInput]) -> tuple[Track, dict[str, float]]:
    """Return the trajectory after the joint registration, and figures of the run."""
    estimator, lost, off_map, times = MappingEstimator(MapperConfig(), GridConfig()), 0, 0, []
    for scan in scans:
        begin = time.thread_time()
        step = estimator.step(prepare_input(scan, 30.0, estimator.twist), scan)
        times.append(time.thread_time() - begin)
        lost += step is not None and step.status is LocalisationStatus.LOST
    estimator.finish()
    off_map = int((~estimator.on_map()).sum())
    p99 = 1e3 * float(np.percentile(times, 99))
    return estimator.trajectory(), {"lost": float(lost), "off_map": float(off_map), "scan_p99_ms": p99}


def run(folder: Path, names: Sequence[str]) -> tuple[dict[str, float], dict[str, float], bool]:
    """Return figures, goals, and whether all are met."""
    figures: dict[str, float] = {}
    goals: dict[str, float] = {}
    for name in names:
        scans, error = inputs(folder, name)
        dense: Track | None = None
        clean = False
        for every in EVERY:
            track, notes = mapped(scans[::every])
            if dense is None:
                dense, clean = track, notes["lost"] == 0
            place, turn = _spacing(track[1])
            notes["error"] = _from(dense, track) if error is None else error(at_all_scans(dense, track))
            key = f"thinned.{name}.{every}"
            figures |= {f"{key}.{what}": round(value, 5) for what, value in notes.items()}
            figures |= {f"{key}.spacing_m": round(place, 3), f"{key}.spacing_rad": round(turn, 3)}
            if every > 1 and place <= SPACING[0] and turn <= SPACING[1]:
                if clean:
                    goals[f"{key}.lost"] = 0
                if error is not None:
                    goals[f"{key}.error"] = round(WORSE * figures[f"thinned.{name}.1.error"], 5)
            print(
                key,
                {what: round(value, 4) for what, value in notes.items()},
                f"{place:.2f} m {turn:.2f} rad",
                flush=True,
            )
    for key, goal in goals.items():
        print(f"{key:28} {figures[key]:8.4f}  goal {goal}  {'met' if figures[key] <= goal else 'NOT MET'}")
    return figures, goals, all(figures[key] <= goal for key, goal in goals.items())


def _spacing(poses: np.ndarray) -> tuple[float, float]:
    """Return the mean motion between scans, m and rad."""
    steps = between(poses[:-1], poses[1:])
    return float(np.hypot(steps[:, 0], steps[:, 1]).mean()), float(np.abs(steps[:, 2]).mean())


def _from(dense: Track, track: Track) -> float:
    """Return the median distance of a trajectory from the dense one at its stamps, m."""
    return float(np.median(deviation(track[1], interpolate(dense[0].astype(float), dense[1], track[0].astype(float)))))
