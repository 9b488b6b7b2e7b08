"""Trajectories by each method: wheels, kiss-icp seeded by them, ours, ours with kiss-icp as scan matcher."""

import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from benchmarks.slam_parts.kiss_alone import KissOdometry
from benchmarks.slam_parts.logs import Log, load, scored
from monstertruck_estimation.slam.config import MapperConfig
from monstertruck_estimation.slam.graph import optimise
from monstertruck_estimation.slam.kiss import KissMatcher
from monstertruck_estimation.slam.mapping import Mapper, MappingEvent
from monstertruck_estimation.slam.scan_matcher import PlanarMatcher, ScanMatcher
from monstertruck_estimation.slam.scans import prepare
from monstertruck_kinematics.se2 import between, compose, transform
from monstertruckd.tools.figures import new_figure, write_figure

GOALS = {
    "intel1.mean": 0.05,
    "intel.mean": 0.058,
    "intel.at_scans": 0.020,
    "intel4.mean": 0.08,
    "aces.median": 0.10,
    "aces.lost": 0,
    "csail.median": 0.12,
    "csail.lost": 0,
    "graph_ms": 40.0,
    **{f"{name}.scan_p99_ms": 50.0 for name in ("intel1", "intel4", "intel", "aces", "csail")},
    "differing_runs": 0,
}
AIMS = {"intel1.mean": 0.03, "intel.mean": 0.031, "intel4.mean": 0.045, "aces.median": 0.077, "csail.median": 0.096}
LOGS = ("intel1", "intel4", "aces", "csail", "intel")
QUICK = ("intel1", "aces")
NODES = 1000


@dataclass
class Run:
    """One method on one log."""

    log: str
    method: str
    stamps: np.ndarray
    poses: np.ndarray
    """Shape (n, 3), as finally optimised."""
    seconds: float
    """Processor time of the whole log."""
    scan_ms: float = 0.0
    """Median processor time of a scan."""
    notes: dict[str, float] = field(default_factory=dict)
    points: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    """Map points, for the plot."""


def wheels(log: Log) -> Run:
    """Return unmodified odometry."""
    return Run(log.name, "wheels", log.stamps, log.odom, 0.0)


def kiss(log: Log) -> Run:
    """Run kiss-icp, with all points, and guesses from the wheels."""
    odometry, poses, times = KissOdometry(), [np.zeros(3)], []
    for k, ranges in enumerate(log.ranges):
        delta = between(log.odom[k - 1], log.odom[k]) if k else np.zeros(3)
        begin = time.thread_time()
        moved = odometry.register(prepare(ranges, log.geometry).points, delta)
        times.append(time.thread_time() - begin)
        poses.append(compose(poses[-1], moved))
    return Run(log.name, "kiss-icp", log.stamps, np.array(poses[1:]), sum(times), 1e3 * float(np.median(times)))


def ours(log: Log, front: Callable[[], ScanMatcher] = PlanarMatcher, method: str = "ours") -> Run:
    """Run our mapper with its defaults, scan by scan, then the joint registration at the end."""
    warm = Mapper()
    for k in range(3):
        warm.step(prepare(log.ranges[0], log.geometry), k, np.zeros(3))
    mapper, times, events = Mapper(front=front()), [], []
    longest = mapper.config.longest
    for stamp, ranges, odom in zip(log.stamps.tolist(), log.ranges, log.odom, strict=True):
        begin = time.thread_time()
        step = mapper.step(prepare(ranges, log.geometry, longest=longest), stamp, odom)
        times.append(time.thread_time() - begin)
        events += step.events if step else []
    stamps, live = mapper.trajectory()
    online = scored(log, stamps, live)
    graph = graph_ms(mapper)
    begin = time.process_time()
    mapper.finish()
    polish = time.process_time() - begin
    stamps, poses = mapper.trajectory()
    name = "mean" if log.by_relations else "median"
    notes = {
        f"online_{name}": online[name],
        "keys": float(len(mapper.map)),
        "closures": float(events.count(MappingEvent.CLOSED)),
        "rejected": float(events.count(MappingEvent.REJECTED)),
        "scan_p95_ms": 1e3 * float(np.percentile(times, 95)),
        "scan_p99_ms": 1e3 * float(np.percentile(times, 99)),
        "finish_s": polish,
    }
    if graph is not None:
        notes["graph_ms"] = graph
    points = [
        transform(pose, key.scan.points[np.hypot(*key.scan.points.T) < 10.0])
        for pose, key in zip(mapper.map.poses, mapper.map.frames, strict=True)
    ]
    return Run(
        log.name,
        method,
        stamps,
        poses,
        sum(times) + polish,
        1e3 * float(np.median(times)),
        notes,
        np.concatenate(points),
    )


def graph_ms(mapper: Mapper) -> float | None:
    """Return the processor time (ms) to settle the graph of the first 1000 keyframes; None for fewer."""
    if len(mapper.map) < NODES:
        return None
    edges = mapper.map.edges.edges()
    edges = edges.chosen((edges.origin < NODES) & (edges.target < NODES))
    settled = optimise(mapper.map.poses[:NODES], edges)
    pushed = settled + np.random.default_rng(0).normal(0, (0.02, 0.02, 0.005), settled.shape)
    times = []
    for _ in range(5):
        begin = time.process_time()
        optimise(pushed, edges)
        times.append(time.process_time() - begin)
    return 1e3 * float(np.median(times))


def ours_by_kiss(log: Log) -> Run:
    """Run our mapper with kiss-icp as scan matcher (``front: kiss``)."""
    return ours(log, KissMatcher, "front: kiss")


COMPARED = {"wheels": wheels, "kiss-icp": kiss, "front: kiss": ours_by_kiss, "ours": ours}
METHODS = COMPARED | {"again": ours}


def job(folder: Path, name: str, method: str) -> Run:
    """Run one method on one log, in a separate process."""
    return METHODS[method](load(folder, name))


def run(folder: Path, out: Path, names: tuple[str, ...]) -> tuple[dict[str, float], dict[str, float], bool]:
    """Print a table and draw plots; return figures, goals, and whether all are met."""
    methods = [(name, method) for name in names for method in COMPARED]
    again = "aces" if "aces" in names else names[0]
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        tasks = {
            (name, method): pool.submit(job, folder, name, method) for name, method in [*methods, (again, "again")]
        }
        runs = {key: task.result() for key, task in tasks.items()}
    figures: dict[str, float] = {}
    print(f"one configuration: {MapperConfig()}")
    for name in names:
        log = load(folder, name)
        for method in COMPARED:
            done = runs[name, method]
            score = scored(log, done.stamps, done.poses)
            _tell(log, done, score)
            figures |= _named(name, method, score | done.notes | {"scan_ms": done.scan_ms, "cpu_s": done.seconds})
        draw(log, [runs[name, method] for method in COMPARED], out / f"{name}.png")
    first, second = runs[again, "ours"], runs[again, "again"]
    figures["differing_runs"] = float(first.poses.tobytes() != second.poses.tobytes())
    graphs = [done.notes["graph_ms"] for done in runs.values() if "graph_ms" in done.notes]
    if graphs:
        figures["graph_ms"] = max(graphs)
    goals = {key: goal for key, goal in GOALS.items() if key in figures}
    for key, goal in goals.items():
        aim = f", aim {AIMS[key]}" if key in AIMS else ""
        print(f"{key:16} {figures[key]:8.4f}  goal {goal}{aim}  {'met' if figures[key] <= goal else 'NOT MET'}")
    return figures, goals, all(figures[key] <= goal for key, goal in goals.items())


def _named(name: str, method: str, score: dict[str, float]) -> dict[str, float]:
    prefix = name if method == "ours" else f"{name}.{method.replace(': ', '_')}"
    return {f"{prefix}.{key}": round(value, 5) for key, value in score.items()}


def _tell(log: Log, done: Run, score: dict[str, float]) -> None:
    kind = "relations, m" if log.by_relations else "from RBPF, m"
    text = f"{log.name:7} {done.method:9} {kind}: {score['mean']:.4f} +- {score['std']:.4f}"
    text += f"  median {score['median']:.4f}  95% {score['p95']:.4f}"
    if log.by_relations:
        text += f"  under 10 s {score['short']:.4f}  at scan times {score['at_scans']:.4f}"
        text += f"  rotation {score['rotation']:.3f} +- {score['rotation_std']:.3f} deg"
    text += f"  lost {score['lost']:.0f}  {done.scan_ms:.2f} ms a scan, {done.seconds:.0f} s in all"
    print(text, *(f"{key} {value:.4g}" for key, value in done.notes.items()), flush=True)


def draw(log: Log, runs: list[Run], file: Path) -> None:
    """Draw the trajectories, and our map below ours."""
    figure = new_figure(15, 5.4)
    for axes, done in zip(figure.subplots(1, len(runs)), runs, strict=True):
        axes.plot(*done.points.T, "k,", alpha=0.4)
        axes.plot(done.poses[:, 0], done.poses[:, 1], lw=0.7, color="tab:red" if done.method == "ours" else "tab:blue")
        axes.set_title(f"{log.name}: {done.method}", fontsize=10)
        axes.set_aspect("equal", "datalim")
        axes.grid(alpha=0.3)
    file.parent.mkdir(parents=True, exist_ok=True)
    write_figure(figure, file)
