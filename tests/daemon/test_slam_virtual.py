"""Mapping through the whole daemon on the virtual clock: the demo's truck in its loop, its map against the world's."""

from pathlib import Path

import numpy as np
import pytest

from monstertruck_runtime.map_folders import opened
from monstertruck_schemas import topics
from monstertruck_schemas.health import LocalisationStatus
from monstertruck_schemas.state import Transforms
from tests.daemon.slam_kit import Drive, driven, lap, share_beside_walls

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(300)]

SECONDS = 18


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("map") / "saved"


@pytest.fixture(scope="module")
def drive(folder: Path) -> Drive:
    more = topics.ODOMETRY, topics.MAP, topics.MAP_TILES, topics.TRANSFORMS
    return driven("slam.yaml", lap(SECONDS), *more, slam={"save": folder, "map_period": 5.0})


def test_the_pose_in_map_is_true_and_never_jumps(drive: Drive):
    assert np.hypot(*(drive.truth[-1, 1:3] - drive.truth[0, 1:3])) > 2.0
    assert drive.off().max() < 0.08
    assert all(pose.frame == "map" for pose in drive.poses)
    assert len(drive.poses) == len(drive.said["state/odometry"])
    steps = np.hypot(np.diff([p.pose.x for p in drive.poses]), np.diff([p.pose.y for p in drive.poses]))
    assert steps.max() < 0.02


def test_the_frames_agree_with_the_pose(drive: Drive):
    tree: Transforms = drive.said["state/transforms"][-1]
    names = [(transform.parent, transform.child) for transform in tree.transforms]
    assert names.count(("map", "odom")) == 1
    assert names.count(("odom", "base")) == 1
    assert next(t for t in tree.transforms if t.child == "odom").translation != (0.0, 0.0, 0.0)


def test_what_it_mapped_stands_in_the_world(drive: Drive):
    assert share_beside_walls(drive.said["state/map"][-1], "loop") < 0.03


def test_health_tiles_and_the_saved_map(drive: Drive, folder: Path):
    assert {message.standing for message in drive.health} <= {LocalisationStatus.MAPPING, LocalisationStatus.DEGENERATE}
    assert drive.health[-1].keys > 5
    assert drive.health[-1].left_out == 0
    tiles = drive.said["state/map_tiles"]
    assert tiles
    assert all((tile.width, tile.height) == (64, 64) for tile in tiles)
    with opened(folder) as save:
        assert {path.name for path in save.folder.iterdir()} == {"map.yaml", "map.png", "graph.npz", "manifest.json"}


@pytest.mark.long
def test_a_robot_without_a_compass_maps_as_well():
    without = {"devices": {"compass": None}, "gate": {"attitude": None}}
    drive = driven("slam.yaml", lap(SECONDS), topics.MAP, topics.COMPASS, **without)
    assert drive.said["sensor/compass"] == []
    assert np.hypot(*(drive.truth[-1, 1:3] - drive.truth[0, 1:3])) > 2.0
    assert drive.off().max() < 0.08
    assert drive.health[-1].left_out == 0
    assert share_beside_walls(drive.said["state/map"][-1], "loop") < 0.03
