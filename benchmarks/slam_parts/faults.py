"""Mapping through what goes wrong: a robot that is carried, and odometry that is wrong. Parts kidnap, wrong_odometry.

``kidnap``: 60 s are cut out of a log, at instants drawn by seed, and odometry restarts behind the cut. In the time
after it the pose is wrong where it is more than ``WRONG`` from that of the uncut log; for no more than 3 s may it be
wrong without being reported lost. Poses count in the error once the submap is joined to the map; what is never joined
is counted apart. A reference of poses (rbpf) is itself some centimetres off, so there the error counts beyond that of
the uncut log. The processor time of a scan is the 99th percentile of the slowest run.

``wrong_odometry``: turns mirrored, stuck, not a number for 20 s, scaled by 0.5 and 2. The error counts against that of
scans alone, the report from the instant on at which wrong and right odometry differ by ``TELLING``.

Aces is no log for either: its scans are 3 s and a metre apart. Errors are those of the graph, before the joint
registration at a log's end.
"""

import math
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from benchmarks.slam_parts.logs import Log, load, scored
from monstertruck_estimation.slam.mapping import Mapper
from monstertruck_estimation.slam.scans import prepare
from monstertruck_kinematics.se2 import between, compose
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.health import OdometryUse

Found = tuple[dict[str, float], dict[str, float], bool]

LOGS = ("intel1", "csail", "intel")
QUICK_SCANS = 2500
"""Scans used of the first log, the only one with --quick."""
CUT, CUTS, QUICK_CUTS = 60.0, 20, 4
"""Seconds left out, cuts of each log."""
SHARES = (0.2, 0.85)
"""Range of the cuts as shares of a log's time: there is a map before, and a path behind."""
WATCHED, WRONG = 30.0, 0.5
"""Seconds after a cut in which wrong poses count, and how far off these are, m."""
UNREPORTED, ERROR, SCAN = 3.0, 0.06, 50.0
"""Goals of ``kidnap``: s, m, and ms per scan."""
FAULTS = ("mirrored", "stuck", "nan", "x0.5", "x2")
NAN = (0.4, 20.0)
"""Share of a log's time at which its odometry fails, and for how long, s."""
TELLING = (0.3, 0.3)
"""m and rad."""
REPORTED, OVER_SCANS = 5.0, 1.2
"""Goals of ``wrong_odometry``, s and a ratio."""
NEVER = 1e6
"""Stands for a report that never came, s."""


@dataclass(frozen=True)
class Mapping:
    """Output of the mapper, scan by scan."""

    live: np.ndarray
    """Shape (n, 3), as said at each scan."""
    poses: np.ndarray
    """Shape (n, 3), as the graph has them at the end."""
    lost: np.ndarray
    """Shape (n,), bool."""
    dropped: np.ndarray
    """Shape (n,), bool: odometry was contradicted or missing."""
    seconds: np.ndarray
    """Shape (n,), processor time of each scan."""


def kidnap(folder: Path, *, quick: bool, logs: Sequence[str] = LOGS) -> Found:
    """Return figures, goals, and whether all are met."""
    figures: dict[str, float] = {}
    goals: dict[str, float] = {}
    for name in LOGS[:1] if quick else logs:
        number = LOGS.index(name) if name in LOGS else len(LOGS)
        shares = np.random.default_rng((19, number)).uniform(*SHARES, QUICK_CUTS if quick else CUTS)
        whole = mapped(log := read(folder, name, quick=quick), log.odom)
        uncut = error(log, log.stamps, whole.poses)
        rows = in_parallel(partial(kidnapped, folder, name, quick, whole.poses), shares.tolist())
        for share, (unreported, lost, off, joined, scan) in zip(shares, rows, strict=True):
            print(
                f"kidnap {name} at {share:.3f}: wrong and unreported for {unreported:.1f} s, lost for {lost:.0f} s, "
                f"error {off:.4f} m (uncut {uncut:.4f}), p99 {scan:.1f} ms a scan{'' if joined else ', never joined'}",
                flush=True,
            )
        base = 0.0 if log.by_relations else uncut
        prefix = f"kidnap.{name}"
        figures[f"{prefix}.uncut_m"] = uncut
        figures[f"{prefix}.cuts"] = len(rows)
        figures[f"{prefix}.never_joined"] = sum(not row[3] for row in rows)
        figures[f"{prefix}.unreported_max_s"] = max(row[0] for row in rows)
        figures[f"{prefix}.error_median_m"] = float(np.median([row[2] for row in rows])) - base
        figures[f"{prefix}.error_max_m"] = max(row[2] for row in rows) - base
        figures[f"{prefix}.scan_p99_ms"] = max(row[4] for row in rows)
        goals |= {f"{prefix}.unreported_max_s": UNREPORTED, f"{prefix}.error_max_m": ERROR}
        goals[f"{prefix}.scan_p99_ms"] = SCAN
    return judged(figures, goals)


def kidnapped(
    folder: Path, name: str, quick: bool, whole: np.ndarray, share: float
) -> tuple[float, float, float, bool, float]:
    """Run one cut: time wrong and unreported (s), time lost (s), error (m), whether all was joined, ms per scan."""
    log, first, kept = cut(read(folder, name, quick=quick), share)
    found = mapped(log, log.odom)
    seconds = log.stamps / SECOND
    moved = between(found.live[first - 1], found.live), between(whole[kept[first - 1]], whole[kept])
    off = np.hypot(*(moved[0] - moved[1])[:, :2].T)
    watched = (np.arange(len(seconds)) >= first) & (seconds <= seconds[first] + WATCHED)
    unreported = seconds[watched & (off > WRONG) & ~found.lost]
    joined = not found.lost[-1]
    placed = np.ones(len(seconds), bool) if joined else ~found.lost
    after = seconds[first:][found.lost[first:]]
    return (
        float(unreported[-1] - seconds[first]) if len(unreported) else 0.0,
        float(after[-1] - after[0]) if len(after) else 0.0,
        error(log, log.stamps[placed], found.poses[placed]),
        joined,
        1e3 * float(np.percentile(found.seconds, 99)),
    )


def cut(log: Log, share: float) -> tuple[Log, int, np.ndarray]:
    """Return the log without ``CUT`` seconds, its first scan after the cut, and the indices of its scans."""
    seconds = log.stamps / SECOND
    first = int(np.searchsorted(seconds, share * seconds[-1]))
    last = int(np.searchsorted(seconds, seconds[first] + CUT))
    odom = log.odom.copy()
    odom[last:] = between(odom[last], odom[last:])
    kept = np.r_[0:first, last : len(seconds)]
    return replace(log, stamps=log.stamps[kept], ranges=log.ranges[kept], odom=odom[kept]), first, kept


def wrong_odometry(folder: Path, *, quick: bool, logs: Sequence[str] = LOGS) -> Found:
    """Return figures, goals, and whether all are met."""
    figures: dict[str, float] = {}
    goals: dict[str, float] = {}
    for name in LOGS[:1] if quick else logs:
        kinds = ("scans alone", "right", *FAULTS)
        rows = dict(zip(kinds, in_parallel(partial(misled, folder, name, quick), list(kinds)), strict=True))
        alone = rows["scans alone"][0]
        for kind, (off, reported) in rows.items():
            delay = f", reported after {reported:.1f} s" if kind in FAULTS else ""
            print(
                f"wrong_odometry {name} {kind}: error {off:.4f} m, {off / alone:.2f} of scans alone{delay}", flush=True
            )
            figures[f"wrong_odometry.{name}.{kind.replace(' ', '_')}_m"] = off
        prefix = f"wrong_odometry.{name}"
        figures[f"{prefix}.over_scans"] = max(rows[kind][0] for kind in FAULTS) / alone
        figures[f"{prefix}.reported_max_s"] = max(rows[kind][1] for kind in FAULTS)
        goals |= {f"{prefix}.over_scans": OVER_SCANS, f"{prefix}.reported_max_s": REPORTED}
    return judged(figures, goals)


def misled(folder: Path, name: str, quick: bool, kind: str) -> tuple[float, float]:
    """Return the error (m) with one kind of odometry, and the time until a fault was reported (s)."""
    log = read(folder, name, quick=quick)
    odom = None if kind == "scans alone" else wrong(log.odom, kind, log.stamps)
    found = mapped(log, odom)
    off = error(log, log.stamps, found.poses)
    if odom is None or kind == "right":
        return off, 0.0
    seconds = log.stamps / SECOND
    by_wrong, by_right = between(odom[0], odom), between(log.odom[0], log.odom)
    apart = np.abs(by_wrong - by_right)
    apart[:, 2] = np.abs(np.remainder(by_wrong[:, 2] - by_right[:, 2] + math.pi, math.tau) - math.pi)
    telling = ~((np.hypot(apart[:, 0], apart[:, 1]) <= TELLING[0]) & (apart[:, 2] <= TELLING[1]))
    reported = seconds[found.dropped]
    begin = seconds[int(np.argmax(telling))]
    if kind == "nan":
        reported = reported[reported >= begin]
    return off, max(float(reported[0] - begin), 0.0) if len(reported) else NEVER


def wrong(odom: np.ndarray, kind: str, stamps: np.ndarray) -> np.ndarray:
    """Return odometry, shape (n, 3), with a fault."""
    if kind == "nan":
        seconds = stamps / SECOND - NAN[0] * stamps[-1] / SECOND
        return np.where(((seconds >= 0.0) & (seconds < NAN[1]))[:, None], np.nan, odom)
    steps = between(odom[:-1], odom[1:])
    if kind == "mirrored":
        steps[:, 2] *= -1.0
    elif kind != "right":
        steps *= 0.0 if kind == "stuck" else float(kind[1:])
    poses = [odom[0]]
    for step in steps:
        poses.append(compose(poses[-1], step))
    return np.array(poses)


def mapped(log: Log, odom: np.ndarray | None) -> Mapping:
    """Run the mapper with its defaults."""
    mapper, rows = Mapper(), []
    for k, (stamp, ranges) in enumerate(zip(log.stamps.tolist(), log.ranges, strict=True)):
        begin = time.thread_time()
        scan = prepare(ranges, log.geometry, longest=mapper.config.longest)
        step = mapper.step(scan, stamp, None if odom is None else odom[k])
        spent = time.thread_time() - begin
        assert step is not None
        dropped = mapper.odometry in {OdometryUse.CONTRADICTED, OdometryUse.MISSING}
        rows.append((*step.pose, mapper.lost, dropped, spent))
    table = np.array(rows)
    return Mapping(table[:, :3], mapper.trajectory()[1], table[:, 3] > 0, table[:, 4] > 0, table[:, 5])


def read(folder: Path, name: str, *, quick: bool) -> Log:
    """Return a log, or its beginning."""
    log = load(folder, name)
    some = slice(QUICK_SCANS if quick else None)
    return replace(log, stamps=log.stamps[some], ranges=log.ranges[some], odom=log.odom[some])


def error(log: Log, stamps: np.ndarray, poses: np.ndarray) -> float:
    """Return the mean error by relations, or the median distance from poses, of the mapped references, m."""
    seconds, times = stamps / SECOND, log.reference[:, : 2 if log.by_relations else 1]
    after = np.clip(np.searchsorted(seconds, times), 1, len(seconds) - 1)
    inside = (times >= seconds[after - 1] - 1e-3) & (times <= seconds[after] + 1e-3)
    kept = (inside & (seconds[after] - seconds[after - 1] < CUT)).all(axis=1)
    score = scored(replace(log, reference=log.reference[kept]), stamps, poses)
    return score["mean" if log.by_relations else "median"]


def in_parallel(call, values: list) -> list:  # noqa: ANN001
    """Return results in the order of the values, computed by two processes."""
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        return list(pool.map(call, values))


def judged(figures: dict[str, float], goals: dict[str, float]) -> Found:
    figures = {name: round(value, 5) for name, value in figures.items()}
    return figures, goals, all(figures[name] <= goal for name, goal in goals.items())
