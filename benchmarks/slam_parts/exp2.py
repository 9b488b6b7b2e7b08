"""The recorded URG-04LX end to end: emulator, driver, daemon and worker on the virtual clock, compared with kiss-icp.

Both trajectories are drawn by one renderer: 5 cm cells, points within 4 m, every beam from where the trajectory was
when it was measured. kiss-icp never learns of the sweep, so its poses are those of the middle. Fewer occupied cells,
lower entropy and fewer points that were later seen through mean a sharper map; the free area must not be bought by
leaving out. A wall that falls on the edge of a cell is two cells wide, and seen through or not by chance: every map is
drawn in ``PLACEMENTS`` random places of the grid, the figures are means, ``spread`` their standard deviation. Ours is
the trajectory as the saved graph has it at the end, the correction of its keyframes spread over the scans between; what
was seen while driving is drawn too (``online``), and ours with every scan drawn at the pose of its middle (``rigid``).

Entropy is that of all cells of one frame round both maps, a bit for each that was not seen: it is lower by
``information``, the bits that the known cells say. ``known_entropy`` leaves the unknown cells out, so that whoever saw
more has more of it.

``dithered`` are means and standard deviations of the same ratios when the recording's whole millimetres get back, by
chance, what rounding took (``DITHERS`` runs of mapper and kiss-icp without the daemon): what comes of such a trifle is
luck, not merit.

Neither method hears the wheels, whose ticks are in the recording. They are a witness: the turn and the way over
``SPAN`` scans, after the scale and the delay that suit each method best (root mean squares of the differences), and
``scale``, the whole way over that by the ticks and the wheels as they were published. A small map looks sharp.
"""

import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from kiss_icp.config import KISSConfig
from kiss_icp.kiss_icp import KissICP

from benchmarks import ROOT
from monstertruck_drivers.hokuyo_urg.recording import RecordedRanges
from monstertruck_estimation.slam.config import GridConfig, SlamConfig
from monstertruck_estimation.slam.grid import OccupancyGrid
from monstertruck_estimation.slam.mapping import MappingEstimator
from monstertruck_estimation.slam.scans import prepare_input
from monstertruck_estimation.slam.storage import load
from monstertruck_estimation.slam.worker import matcher_of
from monstertruck_estimation.slam.worker_io import ScanInput
from monstertruck_kinematics.se2 import between, compose, interpolate, transform, wrap
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.mailbox import fifo
from monstertruck_schemas import topics
from monstertruck_schemas.sensor import LaserScan
from monstertruckd.config.load import load_config
from monstertruckd.tools.figures import new_figure, write_figure
from monstertruckd.tools.simulation.config import SimulatedTruckConfig
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

CONFIG = ROOT / "configs" / "recorded-urg.yaml"
RENDERED = 4.0
"""Longest range that is drawn, m."""
PLACEMENTS = 8
APART = 1e-6
"""Two runs with the front end ``kiss`` differ by this at most, m and rad."""
Track = tuple[np.ndarray, np.ndarray]
"""Stamps (n,), ns, and poses (n, 3) of base."""
Figures = dict[str, float]
DITHERS = 6
"""Runs of the recording with other tenths of millimetres."""
SPAN = 5
"""Scans."""
DELAYS = np.arange(0.0, 0.4, 0.01)
"""Delays of the scans behind the ticks, s."""
METRES_PER_TICK = 2 * np.pi * 0.077 / 2000
"""The robot of the recording: wheels of 77 mm, 2000 ticks a turn (BreezySLAM, examples/mines.py)."""
MOST = {"occupied_ratio": 1.0, "seen_through_ratio": 1.0}
LEAST = {"information_ratio": 1.0, "free_ratio": 1.0}
"""Ours over kiss-icp's."""


def played(folder: Path) -> tuple[list[LaserScan], np.ndarray, np.ndarray, float]:
    """Return the daemon's scans, their stamps (n,) and reported poses (n, 3), and seconds of real time per second."""
    config, _ = load_config(CONFIG, SimulatedTruckConfig)
    config = config.model_copy(update={"recorder": None, "slam": SlamConfig(save=folder)})
    assert config.sim.recording is not None
    recording = RecordedRanges.load(config.sim.recording)
    seconds = recording.times[-1] / SECOND

    async def main(clock: VirtualClock) -> tuple[list[LaserScan], list, float]:
        rig = VirtualRig(config, clock)
        scans, poses = (rig.bus.subscribe(topic, fifo(4096)) for topic in (topics.SCAN, topics.POSE))
        async with rig.running():
            begin = time.perf_counter()
            await clock.sleep(seconds + 2.0)
            took = time.perf_counter() - begin
        return scans.drain(), poses.drain(), (seconds + 2.0) / took

    scans, poses, speed = run_virtual(main, start=SECOND)
    rows = np.array([(pose.pose.x, pose.pose.y, pose.pose.yaw) for pose in poses])
    return scans, np.array([pose.stamp for pose in poses], float), rows, speed


def settled(folder: Path, stamps: np.ndarray, reported: np.ndarray) -> np.ndarray:
    """Return the reported poses, corrected as the saved graph has corrected the adjacent keyframes."""
    graph = load(folder).graph
    at = np.clip(np.searchsorted(graph.stamps, stamps, side="right") - 1, 0, len(graph.stamps) - 2)
    then = interpolate(stamps, reported, graph.stamps.astype(float))
    before, after = (compose(graph.poses[k], between(then[k], reported)) for k in (at, at + 1))
    share = np.clip((stamps - graph.stamps[at]) / (graph.stamps[at + 1] - graph.stamps[at]), 0.0, 1.0)
    off = after - before
    off[:, 2] = wrap(off[:, 2])
    return before + share[:, None] * off


def points_of(scan: LaserScan, longest: float, mount: float) -> tuple[np.ndarray, np.ndarray]:
    """Return points, shape (n, 2), in base, and the time of each, ns."""
    angles = scan.start_angle + scan.angle_increment * np.arange(len(scan.ranges))
    good = np.flatnonzero((scan.ranges >= scan.range_min) & (scan.ranges <= min(scan.range_max, longest)))
    r, a = scan.ranges[good], angles[good]
    points = np.stack((r * np.cos(a) + mount, r * np.sin(a)), axis=-1)
    return points, scan.stamp + SECOND * scan.time_increment * good


def middle(scan: LaserScan) -> float:
    """Return the time of the middle of the sweep, ns."""
    return scan.stamp + SECOND * scan.time_increment * (len(scan.ranges) - 1) / 2


def kiss_poses(scans: list[LaserScan], mount: float) -> np.ndarray:
    """Run kiss-icp with all points, without its second downsampling; return poses (n, 3) of base."""
    config = KISSConfig()
    config.data.max_range, config.data.min_range, config.data.deskew = 5.6, 0.0, False
    config.mapping.voxel_size = 0.1
    config.registration.max_num_threads = 1
    odometry = KissICP(config)
    odometry.voxelize = lambda points: (points, points)
    result = []
    for scan in scans:
        points, _ = points_of(scan, 5.6, mount)
        odometry.register_frame(np.column_stack((points, np.zeros(len(points)))), np.zeros(len(points)))
        pose = odometry.last_pose
        result.append((pose[0, 3], pose[1, 3], np.arctan2(pose[1, 0], pose[0, 0])))
    return np.array(result)


def drawn(scans: list[LaserScan], track: Track, mount: float, *, rigid: bool = False) -> tuple[Figures, np.ndarray]:
    """Return the figures of a trajectory's map, and the map."""
    stamps, poses = track
    grid = OccupancyGrid(GridConfig(limit=0.999))
    ends = []
    for scan in scans:
        points, at = points_of(scan, RENDERED, mount)
        at = np.full(len(at), middle(scan)) if rigid else at
        ends.append(compose(interpolate(stamps, poses, at), np.pad(points, ((0, 0), (0, 1))))[:, :2])
        centre = interpolate(stamps, poses, np.array([middle(scan)]))[0]
        grid.add(transform(centre, np.array([[mount, 0.0]]))[0], ends[-1])
    patch = grid.patch()
    p = np.clip(patch.cells / 100.0, 0.001, 0.999)
    known = patch.cells >= 0
    entropy = -(p * np.log2(p) + (1 - p) * np.log2(1 - p))[known].sum()
    at = np.floor((np.concatenate(ends) - patch.origin) / patch.resolution + 1e-9).astype(int)
    at = np.clip(at, 0, np.array(patch.cells.shape[::-1]) - 1)
    final = patch.cells[at[:, 1], at[:, 0]]
    return {
        "occupied": float((patch.cells >= 65).sum()),
        "information": float(known.sum() - entropy),
        "known_entropy": float(entropy),
        "seen_through": float((final < 50).mean()),
        "free": float(((patch.cells >= 0) & (patch.cells <= 19)).sum() * patch.resolution**2),
    }, patch.cells


def rendered(scans: list[LaserScan], track: Track, mount: float, *, rigid: bool = False) -> dict[str, np.ndarray]:
    """Return the figures of a trajectory's map, each with shape (PLACEMENTS,)."""
    rng = np.random.default_rng(0)
    places = rng.uniform((0.0, 0.0, -np.pi), (0.05, 0.05, np.pi), (PLACEMENTS, 3))
    stamps, poses = track
    rows = [drawn(scans, (stamps, compose(place[None], poses)), mount, rigid=rigid)[0] for place in places]
    return {key: np.array([row[key] for row in rows]) for key in rows[0]}


def compared(ours: dict[str, np.ndarray], kiss: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the ratios of our figures to kiss-icp's, for every placement of the grid."""
    return {f"{key}_ratio": value / np.maximum(kiss[key], 1e-12) for key, value in ours.items()}


def mapped(scans: list[LaserScan], mount: float, front: str = "planar") -> Track:
    """Run the mapper with this front end on ``scans``, without the daemon."""
    estimator = MappingEstimator(SlamConfig().mapper, GridConfig(), matcher_of(front))
    for scan in scans:
        inputs = ScanInput.of(scan, (mount, 0.0, 0.0))
        estimator.step(prepare_input(inputs, estimator.mapper.config.longest, estimator.twist), inputs)
    estimator.finish()
    stamps, poses = estimator.mapper.trajectory()
    return stamps.astype(float), poses


def dithered(scans: list[LaserScan], mount: float, seed: int) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return the figures of our and kiss-icp's maps of ``scans`` with random rounding residuals."""
    rng = np.random.default_rng(seed)
    others = [
        scan.model_copy(update={"ranges": scan.ranges + rng.uniform(-5e-4, 5e-4, len(scan.ranges))}) for scan in scans
    ]
    at = np.array([middle(scan) for scan in others])
    tracks = mapped(others, mount), (at, kiss_poses(others, mount))
    ours, kiss = (rendered(others, track, mount) for track in tracks)
    return ours, kiss


def against_wheels(recording: Path, poses: np.ndarray) -> tuple[float, float, float]:
    """Return differences of turn (rad) and distance (m) over ``SPAN`` scans from the ticks, and the scale."""
    time_us, left, right = np.loadtxt(recording, usecols=(0, 2, 3), unpack=True)
    yaw = np.unwrap(poses[:, 2])
    way = np.append(0.0, np.cumsum(between(poses[:-1], poses[1:])[:, 0]))
    residuals = []
    for reported, ticks in ((yaw, right - left), (way, (right + left) / 2)):
        moved = reported[SPAN:] - reported[:-SPAN]
        rows = []
        for delay in DELAYS:
            then = np.interp(time_us / 1e6 - delay, time_us / 1e6, ticks)
            counted = then[SPAN:] - then[:-SPAN]
            rows.append(np.std(moved - counted * (moved @ counted) / (counted @ counted)))
        residuals.append(float(min(rows)))
    ticks = (right + left) / 2
    return residuals[0], residuals[1], float((way[-1] - way[0]) / (METRES_PER_TICK * (ticks[-1] - ticks[0])))


def draw(maps: dict[str, np.ndarray], file: Path) -> None:
    """Draw the maps side by side."""
    figure = new_figure(11, 5.2)
    for axes, (name, cells) in zip(figure.subplots(1, len(maps)), maps.items(), strict=True):
        shades = np.where(cells < 0, 0.8, 1 - cells / 100)
        axes.imshow(shades, cmap="gray", vmin=0, vmax=1, origin="lower", interpolation="nearest")
        axes.set_title(name, fontsize=10)
        axes.set_axis_off()
    file.parent.mkdir(parents=True, exist_ok=True)
    write_figure(figure, file)


def run(picture: Path | None = None) -> tuple[dict[str, float], dict[str, float], bool]:
    """Return figures, goals, and whether all are met."""
    mount = 0.145
    with TemporaryDirectory() as folder:
        scans, stamps, reported, speed = played(Path(folder))
        final = settled(Path(folder), stamps, reported)
    at = np.array([middle(scan) for scan in scans])
    tracks = {"ours": (stamps, final), "online": (stamps, reported), "kiss": (at, kiss_poses(scans, mount))}
    results = {name: rendered(scans, track, mount) for name, track in tracks.items()}
    results["rigid"] = rendered(scans, tracks["ours"], mount, rigid=True)
    figures = {f"exp2_{who}_{key}": value.mean() for who, values in results.items() for key, value in values.items()}
    ratios = compared(results["ours"], results["kiss"])
    luck = [compared(*dithered(scans, mount, seed)) for seed in range(DITHERS)]
    for key, ratio in ratios.items():
        figures[f"exp2_{key}"] = ratio.mean()
        figures[f"exp2_{key}_spread"] = ratio.std()
        means = [other[key].mean() for other in luck]
        figures[f"exp2_{key}_dithered"], figures[f"exp2_{key}_dithered_std"] = np.mean(means), np.std(means)
    recording = load_config(CONFIG, SimulatedTruckConfig)[0].sim.recording
    assert recording is not None
    for name, track in tracks.items():
        turn, way, scale = against_wheels(recording, interpolate(*track, at))
        figures |= {f"exp2_{name}_wheels_turn": turn, f"exp2_{name}_wheels_way": way, f"exp2_{name}_scale": scale}
    figures |= {"exp2_scans": len(scans), "exp2_reported": len(reported), "exp2_daemon_speed": speed}
    (_, one), (_, other) = (mapped(scans, mount, "kiss") for _ in range(2))
    figures["exp2_kiss_runs_apart"] = np.abs(one - other).max()
    if picture is not None:
        names = {"ours": "monstertruckd, scans alone", "kiss": "kiss-icp, all points"}
        draw({title: drawn(scans, tracks[name], mount)[1] for name, title in names.items()}, picture)
    met = all(ratios[key].mean() <= goal for key, goal in MOST.items()) and all(
        ratios[key].mean() >= goal for key, goal in LEAST.items()
    )
    met &= bool(figures["exp2_kiss_runs_apart"] <= APART)
    return (
        {key: float(value) for key, value in figures.items()},
        {f"exp2_{key}": goal for key, goal in (MOST | LEAST | {"kiss_runs_apart": APART}).items()},
        met,
    )
