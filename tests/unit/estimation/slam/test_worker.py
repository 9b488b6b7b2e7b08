"""Worker, saved maps, localisation, time offset, levelling, correction: on a room of boxes, cast exactly."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from monstertruck_estimation.correction import SmoothedCorrection
from monstertruck_estimation.scan_tilt import plane_slopes, plane_tilt
from monstertruck_estimation.slam import storage
from monstertruck_estimation.slam import worker as estimation
from monstertruck_estimation.slam.config import MapperConfig, SlamConfig
from monstertruck_estimation.slam.motion import find_offset
from monstertruck_estimation.slam.scans import level_ranges
from monstertruck_estimation.slam.worker import SlamWorker
from monstertruck_estimation.slam.worker_io import ScanInput, Start, WorkerInput, WorkerOutput
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.map_folders import opened
from monstertruck_schemas.health import MATCHED

ANGLES = np.linspace(-2.1, 2.1, 400)
WALLS = np.array(
    [
        *[(-3, -2, 4, -2), (4, -2, 4, 1), (4, 1, 2, 1), (2, 1, 2, 3), (2, 3, -3, 3), (-3, 3, -3, -2)],
        *[(0, 1.2, 0.6, 1.2), (0.6, 1.2, 0.6, 1.8), (0.6, 1.8, 0, 1.8), (0, 1.8, 0, 1.2)],
    ],
    float,
)


def cast(pose: np.ndarray, angles: np.ndarray = ANGLES) -> np.ndarray:
    direction = np.stack((np.cos(pose[2] + angles), np.sin(pose[2] + angles)), axis=-1)
    best = np.full(len(angles), np.inf)
    for x0, y0, x1, y1 in WALLS:
        edge, to = np.array((x1 - x0, y1 - y0)), np.array((x0, y0)) - pose[:2]
        cross = direction[:, 0] * edge[1] - direction[:, 1] * edge[0]
        with np.errstate(divide="ignore", invalid="ignore"):
            along = (to[0] * edge[1] - to[1] * edge[0]) / cross
            part = (to[0] * direction[:, 1] - to[1] * direction[:, 0]) / cross
        best = np.where((along > 0) & (part >= 0) & (part <= 1), np.minimum(best, along), best)
    return best


def pose_at(i: int) -> np.ndarray:
    turn = i * 0.05
    return np.array((0.5 + 1.3 * math.cos(turn), 0.2 + 1.0 * math.sin(turn) - 0.3, turn + math.pi / 2))


def scan_at(i: int, rng: np.random.Generator, *, odom: bool = True) -> ScanInput:
    pose = pose_at(i)
    ranges = cast(pose) + rng.normal(0, 0.01, len(ANGLES))
    return ScanInput(
        stamp=SECOND + i * SECOND // 10,
        ranges=ranges,
        start_angle=float(ANGLES[0]),
        angle_increment=float(ANGLES[1] - ANGLES[0]),
        range_min=0.02,
        range_max=5.6,
        odom=tuple(pose.tolist()) if odom else None,  # type: ignore[arg-type]
    )


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("map") / "room"
    worker, rng = SlamWorker(), np.random.default_rng(1)
    start = tuple(pose_at(0).tolist())
    worker.step(WorkerInput(start=Start(SlamConfig(), start)))
    for i in range(130):
        outputs = worker.step(WorkerInput(scan=scan_at(i, rng)))
        assert np.hypot(*(np.array(outputs.estimate.pose[:2]) - pose_at(i)[:2])) < 0.05
    assert worker.step(WorkerInput(save=folder)).saved == str(folder)
    return folder


def test_the_worker_gives_memory_back_when_the_map_is_thinned(monkeypatch: pytest.MonkeyPatch):
    given = []
    monkeypatch.setattr(estimation, "give_back", lambda: given.append(True))
    worker, rng = SlamWorker(), np.random.default_rng(1)
    config = SlamConfig(mapper=MapperConfig(most_keys=10))
    worker.step(WorkerInput(start=Start(config, tuple(pose_at(0).tolist()))))
    pruned = 0
    for i in range(100):
        estimate = worker.step(WorkerInput(scan=scan_at(i, rng))).estimate
        assert estimate is not None
        pruned += "pruned" in estimate.events
        assert len(given) == pruned
    assert pruned > 2


def test_a_map_without_a_scan_ends_with_a_sentence(tmp_path: Path):
    worker = SlamWorker()
    worker.step(WorkerInput(start=Start(SlamConfig())))
    done = worker.step(WorkerInput(finish=True, whole=True, save=tmp_path / "map", trajectory=True))
    assert done.saved is None
    assert done.error == f"{tmp_path / 'map'}: the map is still empty"
    assert not (tmp_path / "map").exists()


def test_a_saved_map_reads_back(saved: Path):
    loaded = storage.load(saved)
    assert loaded.graph is not None
    assert len(loaded.graph.scans) == len(loaded.graph.poses) > 10
    again = saved.parent / "again"
    patch = storage.GridPatch(loaded.grid.cells, loaded.grid.origin, loaded.grid.resolution)
    storage.save(again, patch, loaded.graph)
    assert np.array_equal(storage.load(again).grid.cells, loaded.grid.cells)
    other = storage.load(again).graph
    assert other is not None
    assert np.array_equal(other.scans[3].points, loaded.graph.scans[3].points)


@pytest.mark.parametrize("harm", ["cut", "pickle", "shape"])
def test_a_damaged_graph_is_refused_by_name(saved: Path, tmp_path: Path, harm: str):
    with opened(saved) as whole:  # as earlier versions saved it, without a manifest
        for file in whole.folder.glob("[!m]*"), whole.folder.glob("map.*"):
            for one in file:
                (tmp_path / one.name).write_bytes(one.read_bytes())
    graph = tmp_path / "graph.npz"
    if harm == "cut":
        graph.write_bytes(graph.read_bytes()[:500])
    elif harm == "pickle":
        np.savez(graph, version=np.array([{}], dtype=object))
    else:
        with np.load(graph) as file:
            np.savez(graph, **{name: file[name] for name in file.files} | {"poses": np.zeros((3, 2))})
    loaded = storage.load(tmp_path)
    assert loaded.graph is None
    assert np.array_equal(loaded.grid.cells, storage.load(saved).grid.cells)
    (remark,) = loaded.grid.remarks
    assert "graph.npz" in remark
    assert remark.endswith("; the map is used without keyframes")


@pytest.mark.parametrize("begin", [0, 40, 90])
@pytest.mark.parametrize("odom", [True, False])
def test_a_kidnapped_robot_finds_itself(saved: Path, begin: int, odom: bool):
    worker, rng = SlamWorker(), np.random.default_rng(2)
    worker.step(WorkerInput(start=Start(SlamConfig(mode="localisation", map=saved))))
    last: WorkerOutput | None = None
    for i in range(begin, begin + 30):
        last = worker.step(WorkerInput(scan=scan_at(i, rng, odom=odom)))
    assert last is not None
    assert last.estimate is not None
    assert last.estimate.status in MATCHED
    assert np.hypot(*(np.array(last.estimate.pose[:2]) - pose_at(begin + 29)[:2])) < 0.08


def _bad(kind: str, good: ScanInput) -> ScanInput:
    count = len(good.ranges)
    return {
        "empty": replace(good, ranges=np.zeros(0)),
        "no returns": replace(good, ranges=np.full(count, np.inf)),
        "nan": replace(good, ranges=np.full(count, np.nan)),
        "two points": replace(good, ranges=np.where(np.arange(count) < 2, 1.0, np.inf)),
        "backwards": replace(good, stamp=good.stamp - 2 * SECOND),
        "twice": replace(good, stamp=good.stamp - SECOND // 10),
        "geometry": replace(good, ranges=good.ranges[:200]),
    }[kind]


@pytest.mark.parametrize("kind", ["empty", "no returns", "nan", "two points", "backwards", "twice", "geometry"])
def test_bad_scans_are_left_out_with_a_reason_and_nothing_jumps(kind: str):
    worker, rng = SlamWorker(), np.random.default_rng(3)
    worker.step(WorkerInput(start=Start(SlamConfig(), tuple(pose_at(0).tolist()))))
    for i in range(20):
        worker.step(WorkerInput(scan=scan_at(i, rng)))
    outputs = worker.step(WorkerInput(scan=_bad(kind, scan_at(20, rng))))
    assert outputs.refused
    assert outputs.estimate is None
    after = worker.step(WorkerInput(scan=scan_at(21, rng)))
    assert after.estimate is not None
    assert np.hypot(*(np.array(after.estimate.pose[:2]) - pose_at(21)[:2])) < 0.05


def test_scans_with_a_few_beams_more_or_less_are_matched():
    worker, rng = SlamWorker(), np.random.default_rng(3)
    worker.step(WorkerInput(start=Start(SlamConfig(), tuple(pose_at(0).tolist()))))
    for i in range(30):
        good = scan_at(i, rng)
        kept = np.linspace(0, len(good.ranges) - 1, len(good.ranges) - i % 5).round().astype(int)
        increment = good.angle_increment * (len(good.ranges) - 1) / (len(kept) - 1)
        output = worker.step(WorkerInput(scan=replace(good, ranges=good.ranges[kept], angle_increment=increment)))
        assert output.refused is None
    assert output.estimate is not None
    assert np.hypot(*(np.array(output.estimate.pose[:2]) - pose_at(29)[:2])) < 0.05


def test_whole_circles_of_different_speed_and_first_beam_are_matched():
    worker, rng = SlamWorker(), np.random.default_rng(3)
    worker.step(WorkerInput(start=Start(SlamConfig(), tuple(pose_at(0).tolist()))))
    for i in range(30):
        count = 606 if i == 0 else 500 + i % 5  # the first revolution while the head still accelerates
        step = math.tau / count
        angles = rng.uniform(-math.pi, math.pi) + step * np.arange(count)
        ranges = cast(pose_at(i), angles) + rng.normal(0, 0.01, count)
        whole = replace(scan_at(i, rng), ranges=ranges, start_angle=angles[0], angle_increment=step)
        assert worker.step(WorkerInput(scan=whole)).refused is None
    half = replace(whole, stamp=whole.stamp + SECOND, ranges=ranges[:250])
    assert str(worker.step(WorkerInput(scan=half)).refused).startswith("another geometry: 250 beams")


@pytest.mark.parametrize("rates", [(1.1, 2.7), (0.5, 1.2)])
def test_an_offset_between_wheels_and_scans_is_found_to_10_ms_and_none_invented(rates: tuple[float, float]):
    rng = np.random.default_rng(4)
    times = np.arange(0, 20, 0.1)

    def yaw(t: np.ndarray) -> np.ndarray:
        return 0.6 * np.sin(t * rates[0]) + 0.3 * np.sin(t * rates[1])

    stamps = (times * SECOND).astype(np.int64)
    scans = yaw(times) + rng.normal(0, 0.002, len(times))
    assert find_offset(stamps, scans, yaw(times + 0.2)) == pytest.approx(0.2, abs=0.01)
    assert find_offset(stamps, scans, yaw(times)) is None
    assert find_offset(stamps, rng.normal(0, 0.001, len(times)), np.zeros(len(times))) is None


def test_ground_and_ceiling_are_discarded_and_the_rest_levelled():
    flat = scan_at(0, np.random.default_rng(5))
    nose_down = replace(
        flat, ranges=np.full(400, 4.0), slopes=plane_slopes(0.0, math.radians(5)), height=0.2, ceiling=0.5
    )
    ranges = level_ranges(nose_down)
    ahead, behind = np.argmin(np.abs(ANGLES)), np.argmin(np.abs(ANGLES - 2.1))
    assert np.isnan(ranges[ahead])
    assert ranges[behind] == pytest.approx(4.0, abs=0.02)
    assert np.isnan(level_ranges(replace(nose_down, slopes=plane_slopes(0.0, -math.radians(5))))[ahead])


def test_the_slopes_are_those_of_the_plane():
    for roll, pitch, a, b in np.random.default_rng(6).uniform(-0.4, 0.4, (20, 4)):
        x, y = plane_slopes(roll, pitch, a, b)
        assert math.sqrt(1 - x * x - y * y) == pytest.approx(math.cos(plane_tilt(roll, pitch, a, b)), abs=1e-9)


def test_a_correction_is_approached_without_a_jump_and_a_great_one_at_once():
    correction = SmoothedCorrection((0.3, 0.5), 1.0)
    base = (10.0, 5.0, 1.0)
    assert correction.pose(base, 0.02) == pytest.approx(base)
    correction.set_target((0.1, 0.0, 0.02))
    poses = [correction.pose(base, 0.02) for _ in range(100)]
    steps = np.hypot(*np.diff(np.array([base, *poses])[:, :2], axis=0).T)
    assert 0 < steps.max() <= 0.3 * 0.02 + 1e-9
    assert correction.value == pytest.approx((0.1, 0.0, 0.02))
    correction.set_target((5.0, 0.0, 0.0))
    assert correction.pose(base, 0.02) == pytest.approx((15.0, 5.0, 1.0))
