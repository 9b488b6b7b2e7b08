"""Maps of others, a grid and nothing else: surfaces with normals, tracking and the search for a kidnapped robot."""

import math
from pathlib import Path

import numpy as np
import pytest

from monstertruck_estimation.slam.config import MapperConfig, SlamConfig
from monstertruck_estimation.slam.localisation import LocalisationEstimator
from monstertruck_estimation.slam.scans import prepare_input
from monstertruck_estimation.slam.storage import load, surface_elements
from monstertruck_estimation.slam.worker import SlamWorker
from monstertruck_estimation.slam.worker_io import ScanInput, Start, WorkerInput
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.map_files import FREE, OCCUPIED, UNKNOWN, WorldMap, load_map, save_map
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.health import LocalisationStatus
from monstertruck_sim.world.config import WorldConfig
from monstertruck_sim.world.world import World

ROOMS = Path(__file__).parents[4] / "configs" / "worlds" / "rooms.yaml"
STEP = 0.05


def _grid(occupied: np.ndarray, free: np.ndarray) -> WorldMap:
    cells = np.full(occupied.shape, UNKNOWN, np.int8)
    cells[free] = FREE
    cells[occupied] = OCCUPIED
    return WorldMap(cells, STEP, (-2.0, -2.0))


def _plane() -> tuple[np.ndarray, np.ndarray]:
    """Middles of 80 x 80 cells, m."""
    axis = (np.arange(80) + 0.5) * STEP - 2.0
    return np.meshgrid(axis, axis)


@pytest.mark.parametrize("degrees", [0, 17, 45, 71, 90, 130])
@pytest.mark.parametrize("thick", [1, 2, 5])
def test_both_sides_of_a_wall_face_their_own_side(degrees: int, thick: int):
    x, y = _plane()
    normal = np.array((math.cos(math.radians(degrees)), math.sin(math.radians(degrees))))
    off = x * normal[0] + y * normal[1]
    wall = np.abs(off - 0.01) < thick * STEP * np.abs(normal).max() / 2
    surfaces = surface_elements(_grid(wall, ~wall))
    inner = np.abs(surfaces.points).max(axis=1) < 1.7
    facing = surfaces.normals[inner] @ normal
    place = surfaces.points[inner] @ normal
    for side in (1, -1):
        mine = np.sign(facing) == side
        assert np.median(np.abs(facing[mine])) > math.cos(math.radians(4))
        assert np.abs(facing[mine]).min() > math.cos(math.radians(25))
        outermost = 0.01 + side * (thick - 1) / 2 * STEP * np.abs(normal).max()
        assert np.median(place[mine]) == pytest.approx(outermost, abs=0.03)
        assert mine.sum() > 50


def test_what_nobody_can_see_is_no_surface():
    x, y = _plane()
    surfaces = surface_elements(_grid(x > 1.0, (x < 1.0) & (y > 0)))
    assert surfaces.points[:, 1].min() > -STEP
    assert np.all(surfaces.normals[:, 0] < -0.9)
    assert not len(surface_elements(_grid(x > 1.0, np.zeros_like(x, dtype=bool))))


@pytest.fixture(scope="module", params=["as drawn", "thin walls"])
def plain(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The rooms as they are, or with walls of single cells as mapping draws them."""
    if request.param == "as drawn":
        return ROOMS
    drawn = load_map(ROOMS)
    walls = drawn.cells == OCCUPIED
    inside = walls.copy()
    for axis in (0, 1):
        for way in (1, -1):
            inside &= np.roll(walls, way, axis)
    place = tmp_path_factory.mktemp("plain") / "rooms.yaml"
    save_map(WorldMap(np.where(inside, np.int8(UNKNOWN), drawn.cells), drawn.resolution, drawn.origin), place)
    return place


def _scans(start: tuple[float, float, float], count: int, *, odom: bool) -> list[tuple[ScanInput, np.ndarray]]:
    """Scans of a truck that is pushed on in a slight bow, 3 cm and at most 0.03 rad at a time, and its true poses."""
    reported, pose = [], np.array(start)
    for k in range(count):
        x, y, yaw = pose.tolist()
        world = World(WorldConfig(map="rooms", start=Pose2D(x=x, y=y, yaw=yaw)), 7 + k)
        ranges = world.lidar.scan(0).astype(np.float64) / 1000
        ranges[ranges < 0.02] = np.inf
        scan = ScanInput(
            stamp=SECOND + k * SECOND // 10,
            ranges=ranges,
            start_angle=-384 * math.tau / 1024,
            angle_increment=math.tau / 1024,
            range_min=0.02,
            range_max=5.6,
            mount=(0.14, 0.0, 0.0),
            odom=(x + 3.0, y - 1.0, yaw) if odom else None,
        )
        reported.append((scan, pose.copy()))
        pose += np.array((0.03 * math.cos(yaw), 0.03 * math.sin(yaw), 0.03 * math.sin(k / 3)))
    return reported


PLACES = [(1.5, 3.95, 0.0), (6.85, 4.6, 1.6), (4.5, 6.4, 0.0)]


@pytest.mark.parametrize("start", PLACES)
def test_a_robot_that_knows_its_place_keeps_it(plain: Path, start: tuple[float, float, float]):
    estimator = LocalisationEstimator(load(plain), MapperConfig(), start)
    for scan, truth in _scans(start, 20, odom=False):
        estimate = estimator.step(prepare_input(scan, 30.0, estimator.twist), scan)
        assert estimate is not None
        assert estimate.status is LocalisationStatus.LOCALISED
        assert estimate.overlap > 0.85
        assert np.hypot(*(np.array(estimate.pose[:2]) - truth[:2])) < 0.05


@pytest.mark.parametrize("start", PLACES)
def test_a_kidnapped_robot_finds_itself(plain: Path, start: tuple[float, float, float]):
    worker = SlamWorker()
    worker.step(WorkerInput(start=Start(SlamConfig(mode="localisation", map=plain))))
    found = False
    for scan, truth in _scans(start, 35, odom=True):
        estimate = worker.step(WorkerInput(scan=scan)).estimate
        assert estimate is not None
        if estimate.status is not LocalisationStatus.SEARCHING:
            found = True
            assert np.hypot(*(np.array(estimate.pose[:2]) - truth[:2])) < 0.08
    assert found
