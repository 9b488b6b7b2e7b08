"""Mapping through the whole daemon on the virtual clock: the demo's truck in its loop, its map against the world's."""

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.mailbox import fifo, latest
from monstertruck_runtime.map_files import OCCUPIED
from monstertruck_schemas import topics
from monstertruck_schemas.health import LocalisationStatus
from monstertruck_schemas.state import Grid, Odometry, Transforms
from monstertruck_sim.world.built_in import BUILT_IN
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(300)]

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "slam.yaml"
SECONDS = 18


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> dict:
    config, _ = load_config(CONFIG, SimulatedTruckConfig)
    folder = tmp_path_factory.mktemp("map") / "saved"
    slam = config.slam.model_copy(update={"save": folder, "map_period": 5.0})
    config = config.model_copy(update={"recorder": None, "map": None, "slam": slam})

    async def main(clock: VirtualClock) -> dict:
        rig = VirtualRig(config, clock)
        boxes = {
            topic.name: rig.bus.subscribe(topic, fifo(20_000))
            for topic in (topics.POSE, topics.ODOMETRY, topics.MAP, topics.MAP_TILES, topics.SLAM, topics.EVENT)
        }
        frames = rig.bus.subscribe(topics.TRANSFORMS, latest())
        operator = LocalOperator(rig.daemon, clock)
        async with rig.running():
            await clock.sleep(1.5)
            await operator.arm()
            await clock.sleep(SECONDS)
        return {
            **{name: box.drain() for name, box in boxes.items()},
            "truth": rig.truth.array(),
            "frames": frames.latest,
            "folder": folder,
        }

    return run_virtual(main, start=SECOND)


def off_truth(poses: list[Odometry], truth: np.ndarray) -> np.ndarray:
    stamps = np.array([pose.stamp for pose in poses]) / SECOND
    x, y = (np.interp(stamps, truth[:, 0], truth[:, k]) for k in (1, 2))
    return np.hypot([p.pose.x for p in poses] - x, [p.pose.y for p in poses] - y)


def test_the_pose_in_map_is_true_and_never_jumps(drive: dict):
    poses = drive["state/pose"]
    assert np.hypot(*(drive["truth"][-1, 1:3] - drive["truth"][0, 1:3])) > 2.0
    assert off_truth(poses, drive["truth"]).max() < 0.08
    assert all(pose.frame == "map" for pose in poses)
    assert len(poses) == len(drive["state/odometry"])
    steps = np.hypot(np.diff([p.pose.x for p in poses]), np.diff([p.pose.y for p in poses]))
    assert steps.max() < 0.02


def test_the_frames_agree_with_the_pose(drive: dict):
    tree: Transforms = drive["frames"]
    names = [(transform.parent, transform.child) for transform in tree.transforms]
    assert names.count(("map", "odom")) == 1
    assert names.count(("odom", "base")) == 1
    assert next(t for t in tree.transforms if t.child == "odom").translation != (0.0, 0.0, 0.0)


def test_what_it_mapped_stands_in_the_world(drive: dict):
    grid: Grid = drive["state/map"][-1]
    cells = grid.cells.reshape(grid.height, grid.width)
    rows, columns = np.nonzero(cells >= 65)
    assert len(rows) > 300
    x, y = (grid.origin.x + (columns + 0.5) * grid.resolution, grid.origin.y + (rows + 0.5) * grid.resolution)
    world = BUILT_IN["loop"]().map
    far = distance_transform_edt(world.cells != OCCUPIED) * world.resolution
    at = ((y - world.origin[1]) / world.resolution).astype(int), ((x - world.origin[0]) / world.resolution).astype(int)
    inside = (at[0] >= 0) & (at[0] < far.shape[0]) & (at[1] >= 0) & (at[1] < far.shape[1])
    wrong = far[np.clip(at[0], 0, far.shape[0] - 1), np.clip(at[1], 0, far.shape[1] - 1)] > 0.12
    assert (~inside | wrong).mean() < 0.03


def test_health_tiles_and_the_saved_map(drive: dict):
    health = drive["health/slam"]
    assert {message.standing for message in health} <= {LocalisationStatus.MAPPING, LocalisationStatus.DEGENERATE}
    assert health[-1].keys > 5
    assert health[-1].left_out == 0
    assert drive["state/map_tiles"]
    assert all((tile.width, tile.height) == (64, 64) for tile in drive["state/map_tiles"])
    assert {path.name for path in drive["folder"].iterdir()} == {"map.yaml", "map.png", "graph.npz"}
