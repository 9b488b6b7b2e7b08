"""Odometry in the world: ten drives of every kind by every subset of sensors, against the truth.

Absolute error (ATE): root mean square of the position in odom, which begins at the truth; no alignment. Relative error
(RPE): of the motion over every metre driven. After a kidnapping odom goes on from where it was, so that part of the
drive counts from its own beginning. ``reckoning`` is the daemon's default: wheels, its heading held by the compass.
The scans are matched by the mapper itself, on the odometry under test (without wheels: on nothing), and reported
30 ms after their end; in kidnapped drives by the localisation in a map that another drive has saved, and by all
sensors once more in the plain grid the world is drawn from.
"""

import math
from collections import Counter, deque
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from benchmarks import ROOT
from benchmarks.slam_parts.world_drives import BEAM, SCENARIOS, SWEEP, Drive, draw_corridor, driven
from monstertruck_estimation.fusion.config import FusionConfig
from monstertruck_estimation.fusion.estimator import Fusion
from monstertruck_estimation.odometry import DeadReckoning, OdometryConfig, OdometryEstimator
from monstertruck_estimation.scan_tilt import AngleHistory, plane_slopes, plane_tilt
from monstertruck_estimation.slam.config import GridConfig, MapperConfig
from monstertruck_estimation.slam.localisation import LocalisationEstimator
from monstertruck_estimation.slam.mapping import Estimator, MappingEstimator
from monstertruck_estimation.slam.scans import prepare_input
from monstertruck_estimation.slam.storage import load, save
from monstertruck_estimation.slam.worker_io import ScanIncrement, ScanInput, SlamEstimate
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import between, compose, interpolate, inverse
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.health import MATCHED, LocalisationStatus
from monstertruck_schemas.sensor import Attitude, DriveFeedback, SteeringFeedback
from monstertruck_schemas.state import ScanMotion
from monstertruck_sim.world.config import SimTruckConfig
from monstertruckd.tools.figures import new_figure, write_figure

SEEDS, QUICK_SEEDS = 10, 2
LATENCY = 3 * SECOND // 100
MAX_TILT = 0.1
SUBSETS = {
    "reckoning": ("drive", "compass"),
    "wheels": ("drive",),
    "wheels+compass": ("drive", "compass"),
    "wheels+scans": ("drive", "scans"),
    "compass+scans": ("compass", "scans"),
    "scans": ("scans",),
    "all": ("drive", "compass", "scans"),
}
PLAIN = ROOT / "configs" / "worlds" / "rooms.yaml"
STARTED = 2.0
"""Seconds in which nothing is evaluated."""
GOALS = {
    "all_ate_over_reckoning": 1.0,
    "corridor_degenerate": 0.9,
    "corridor_nees": 8.0,
    "kidnap_found": 1.0,
    "kidnap_plain_found": 1.0,
    "slip_reported": 0.8,
    "slip_false": 0.0,
    "greatest_step_m": 0.025,
}
"""At most but for ``AT_LEAST``; degenerate is a share of the scans. NEES of 3 degrees of freedom, their mean."""
AT_LEAST = ("corridor_degenerate", "kidnap_found", "kidnap_plain_found", "slip_reported")


@dataclass
class Run:
    """Estimates of one robot on one drive."""

    stamps: list[float] = field(default_factory=list)
    poses: list[tuple[float, ...]] = field(default_factory=list)
    nees: list[float] = field(default_factory=list)
    standings: Counter[LocalisationStatus] = field(default_factory=Counter)
    slips: list[float] = field(default_factory=list)
    """Stamps of their onsets."""
    found: float | None = None
    """Seconds from the kidnapping to the first right pose in map."""


class Matching:
    """Scan matching, as in the estimation worker."""

    def __init__(self, drive: Drive, saved: Path | None = None) -> None:
        self._body = AngleHistory()
        self.newest: SlamEstimate | None = None
        if saved is None:
            self.estimator: Estimator = MappingEstimator(MapperConfig(), GridConfig(), start=drive.start)
        else:
            self.estimator = LocalisationEstimator(load(saved), MapperConfig(), drive.start)

    def heed(self, attitude: Attitude) -> None:
        """Set the tilt."""
        self._body.extend(((attitude.stamp, (attitude.roll, attitude.pitch)),))

    def match(self, stamp: int, ranges: Array, history: list[tuple[float, ...]] | None) -> ScanIncrement | None:
        """Return the motion up to the scan; ``history``: stamps (s) and poses of odometry, None without."""
        tilt = self._body.at(stamp + SWEEP // 2)
        if tilt is not None and plane_tilt(*tilt) > MAX_TILT:
            return None
        odom, twist = _motion(stamp, history)
        inputs = ScanInput(
            stamp=stamp,
            ranges=ranges,
            start_angle=-384 * BEAM,
            angle_increment=BEAM,
            range_min=0.02,
            range_max=5.6,
            time_increment=SWEEP / 1024 / SECOND,
            mount=(0.14, 0.0, 0.0),
            odom=odom,
            twist=twist,
            slopes=None if tilt is None else plane_slopes(*tilt),
            height=0.25,
        )
        self.newest = self.estimator.step(prepare_input(inputs, 30.0, self.estimator.twist), inputs)
        return None if self.newest is None else self.newest.moved


def _motion(
    stamp: int, history: list[tuple[float, ...]] | None
) -> tuple[tuple[float, float, float] | None, tuple[float, float, float]]:
    """Return base in odom at the start of a scan, and its velocity during the scan."""
    if history is None or not history or history[0][0] > stamp / SECOND:
        return None, (0.0, 0.0, 0.0)
    rows = np.array(history[-32:])
    begin, end = interpolate(rows[:, 0], rows[:, 1:], np.array((stamp, stamp + SWEEP)) / SECOND)
    x, y, yaw = begin.tolist()
    vx, vy, wz = (between(begin, end) / (SWEEP / SECOND)).tolist()
    return (x, y, yaw), (vx, vy, wz)


def run_drive(drive: Drive, subset: str, saved: Path | None = None, keep: Path | None = None) -> Run:
    """Run one robot with a subset of the sensors on one drive; it localises in ``saved``, or maps into ``keep``."""
    sensors, chassis = SUBSETS[subset], SimTruckConfig().chassis()
    x, y, yaw = drive.start
    start = Pose2D(x=x, y=y, yaw=yaw)
    fusion = Fusion(FusionConfig(kind="fusion", start=start), chassis)
    reckoner: OdometryEstimator = fusion
    if subset == "reckoning":
        reckoner = DeadReckoning(OdometryConfig(start=start), chassis)
    matching = Matching(drive, saved) if "scans" in sensors else None
    run, waiting, due, truth = Run(), deque[tuple[int, ScanMotion]](), SECOND, np.array(drive.truth)
    for now, message in drive.reported:
        while due <= now:
            while waiting and waiting[0][0] <= due:
                fusion.observe_scan(waiting.popleft()[1])
            run.slips += [change.since / SECOND for change in fusion.changes() if change.slipping]
            _tell(run, reckoner, due, truth, drive)
            due += SECOND // 50
        if isinstance(message, SteeringFeedback) and "drive" in sensors:
            reckoner.observe_steering(message)
        elif isinstance(message, DriveFeedback) and "drive" in sensors:
            reckoner.observe_drive(message)
        elif isinstance(message, Attitude) and "compass" in sensors:
            reckoner.observe_attitude(message)
            if matching is not None:
                matching.heed(message)
        elif isinstance(message, tuple) and matching is not None:
            history = [(t, *pose) for t, pose in zip(run.stamps[-32:], run.poses[-32:], strict=True)]
            stamp, ranges = message
            moved = matching.match(stamp, ranges, history if "drive" in sensors else None)
            _judge_match(run, matching, drive, stamp, truth)
            if moved is not None:
                waiting.append((now + LATENCY, _message(message[0], moved)))
    if keep is not None and matching is not None:
        matching.estimator.finish()
        save(keep, matching.estimator.patch(), matching.estimator.graph())
    return run


def _message(stamp: int, moved: ScanIncrement) -> ScanMotion:
    x, y, yaw = moved.motion
    return ScanMotion(
        stamp=stamp,
        received=stamp,
        seq=0,
        since=moved.since,
        motion=Pose2D(x=x, y=y, yaw=yaw),
        covariance=np.array(moved.covariance),
    )


def _tell(run: Run, reckoner: OdometryEstimator, now: int, truth: Array, drive: Drive) -> None:
    estimate = reckoner.estimate(now)
    if estimate is None:
        return
    run.stamps.append(now / SECOND)
    run.poses.append(estimate.pose)
    if (drive.carried is None or now < drive.carried) and now > (1 + STARTED) * SECOND:
        off = np.array(estimate.pose) - _at(truth, now / SECOND)
        off[2] = math.remainder(off[2], math.tau)
        run.nees.append(float(off @ np.linalg.solve(estimate.pose_covariance.reshape(3, 3) + 1e-10 * np.eye(3), off)))


def _judge_match(run: Run, matching: Matching, drive: Drive, stamp: int, truth: Array) -> None:
    estimate = matching.newest
    if estimate is None:
        return
    run.standings[estimate.status] += 1
    if drive.carried is None or stamp <= drive.carried or run.found is not None:
        return
    if estimate.status in MATCHED:
        off = np.array(estimate.pose) - _at(truth, stamp / SECOND)
        if math.hypot(off[0], off[1]) < 0.1:
            run.found = (stamp - drive.carried) / SECOND


def _at(truth: Array, second: float) -> Array:
    row: Array = truth[min(int(np.searchsorted(truth[:, 0], second - 1e-6)), len(truth) - 1), 1:]
    return row


def evaluated(run: Run, drive: Drive) -> dict[str, float]:
    """Return ATE (m), RPE (m and degrees per metre), NEES and the largest step of one run."""
    stamps, poses = np.array(run.stamps), np.array(run.poses)
    every = np.array(drive.truth)
    truth = np.array([_at(every, second) for second in stamps])
    carried = math.inf if drive.carried is None else drive.carried / SECOND
    errors, moves = [], []
    for leg in (stamps < carried, stamps >= carried):
        if leg.sum() > 1:
            mine, true = poses[leg], truth[leg]
            if stamps[leg][0] >= carried:
                mine = compose(compose(true[0], inverse(mine[0])), mine)
            errors.append(np.hypot(*(mine - true)[:, :2].T))
            moves.append(_per_metre(mine, true))
    moved = np.concatenate(moves)
    steps = np.hypot(*np.diff(poses, axis=0)[:, :2].T)
    return {
        "ate": float(np.sqrt(np.mean(np.square(np.concatenate(errors))))),
        "rpe": float(np.sqrt(np.mean(np.square(moved[:, :2]).sum(axis=1)))),
        "rpe_deg": math.degrees(float(np.sqrt(np.mean(np.square(moved[:, 2]))))),
        "nees": float(np.mean(run.nees)),
        "step": float(steps.max()),
    }


def _per_metre(poses: Array, truth: Array) -> Array:
    """Return the errors, shape (n, 3), of the motions over a metre of true distance."""
    way = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(truth, axis=0)[:, :2].T))))
    firsts = np.flatnonzero(way <= way[-1] - 1.0)[::5]
    lasts = np.searchsorted(way, way[firsts] + 1.0)
    lasts = np.minimum(lasts, len(way) - 1)
    off: Array = between(between(truth[firsts], truth[lasts]), between(poses[firsts], poses[lasts]))
    return off


def run(folder: Path, *, quick: bool = False) -> tuple[dict[str, float], dict[str, float], bool]:
    """Run all drives; return figures, goals and whether they are met."""
    draw_corridor(folder)
    seeds = QUICK_SEEDS if quick else SEEDS
    cells: dict[tuple[str, str], list[dict[str, float]]] = {}
    robots: dict[str, list[tuple[Drive, Run]]] = {}
    mapped = next(scenario for scenario in SCENARIOS if scenario.name == "rooms")
    run_drive(driven(mapped, 1000, folder), "all", keep=folder / "rooms")
    for scenario in SCENARIOS:
        saved = folder / "rooms" if scenario.carried is not None else None
        for seed in range(seeds):
            drive = driven(scenario, seed, folder)
            for subset in SUBSETS:
                done = run_drive(drive, subset, saved)
                cells.setdefault((scenario.name, subset), []).append(evaluated(done, drive))
                if subset == "all":
                    robots.setdefault(scenario.name, []).append((drive, done))
            if saved is not None:
                robots.setdefault("kidnap_plain", []).append((drive, run_drive(drive, "all", PLAIN)))
        _print(scenario.name, cells)
    figures = _figures(cells, robots)
    _draw(robots, folder / "world.png")
    met = all(figures[key] >= goal if key in AT_LEAST else figures[key] <= goal for key, goal in GOALS.items())
    return figures, dict(GOALS), met


def _mean(rows: list[dict[str, float]], key: str) -> float:
    return float(np.mean([row[key] for row in rows]))


def _print(name: str, cells: dict[tuple[str, str], list[dict[str, float]]]) -> None:
    for subset in SUBSETS:
        rows = cells[name, subset]
        text = f"{name:9} {subset:15} ATE {_mean(rows, 'ate'):.3f} m (worst {max(row['ate'] for row in rows):.3f})"
        text += f"  RPE {100 * _mean(rows, 'rpe'):.2f} % {_mean(rows, 'rpe_deg'):.2f} deg/m"
        text += f"  NEES {_mean(rows, 'nees'):.1f}  step {1e3 * max(row['step'] for row in rows):.0f} mm"
        print(text, flush=True)


def _figures(
    cells: dict[tuple[str, str], list[dict[str, float]]], robots: dict[str, list[tuple[Drive, Run]]]
) -> dict[str, float]:
    figures: dict[str, float] = {}
    for (name, subset), rows in cells.items():
        figures[f"world_{name}_{subset}_ate_m"] = round(_mean(rows, "ate"), 4)
        figures[f"world_{name}_{subset}_rpe"] = round(_mean(rows, "rpe"), 4)
    mean = {
        subset: np.mean([_mean(rows, "ate") for (_, which), rows in cells.items() if which == subset])
        for subset in SUBSETS
    }
    figures |= {f"world_{subset}_ate_m": round(float(value), 4) for subset, value in mean.items()}
    figures["all_ate_over_reckoning"] = round(float(mean["all"] / mean["reckoning"]), 4)
    corridor = sum((run.standings for _, run in robots["corridor"]), Counter[LocalisationStatus]())
    figures["corridor_degenerate"] = round(corridor[LocalisationStatus.DEGENERATE] / corridor.total(), 4)
    figures["corridor_nees"] = round(_mean(cells["corridor", "all"], "nees"), 3)
    for name in ("kidnap", "kidnap_plain"):
        found = [run.found for _, run in robots[name]]
        seconds = [second for second in found if second is not None]
        figures[f"{name}_found"] = round(len(seconds) / len(found), 4)
        figures[f"{name}_seconds"] = round(float(np.mean(seconds or [0.0])), 2)
    reported, bursts = _slips(robots["slip"])
    figures["slip_reported"] = round(reported / bursts, 4)
    others = (run for name, runs in robots.items() if name not in ("slip", "kidnap", "kidnap_plain") for _, run in runs)
    figures["slip_false"] = float(sum(len(run.slips) for run in others))
    steps = [row["step"] for (_, which), rows in cells.items() if which == "all" for row in rows]
    figures["greatest_step_m"] = round(max(steps), 4)
    return figures


def _slips(runs: list[tuple[Drive, Run]]) -> tuple[int, int]:
    """Return the numbers of reported slip bursts and of all."""
    reported = sum(any(abs(slip - burst) < 1.0 for slip in run.slips) for drive, run in runs for burst in drive.bursts)
    return reported, sum(len(drive.bursts) for drive, _ in runs)


def _draw(robots: dict[str, list[tuple[Drive, Run]]], file: Path) -> None:
    """Draw truth and odometry of the first drive of every kind."""
    figure = new_figure(16, 8)
    for axes, (name, runs) in zip(figure.subplots(2, 4).flat, robots.items(), strict=False):
        drive, done = runs[0]
        truth, poses = np.array(drive.truth), np.array(done.poses)
        axes.plot(truth[:, 1], truth[:, 2], color="0.6", lw=3, label="truth")
        axes.plot(poses[:, 0], poses[:, 1], color="tab:red", lw=0.9, label="odometry, all sensors")
        axes.set_title(name, fontsize=10)
        axes.set_aspect("equal", "datalim")
        axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    write_figure(figure, file)
