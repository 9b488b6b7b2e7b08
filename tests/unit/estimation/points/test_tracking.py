"""Readings become points of interest; they move with the map, and outliers do not count."""

import json
import math
import shutil
from dataclasses import replace

import numpy as np
import pytest

from monstertruck_estimation.points.config import PointsConfig
from monstertruck_estimation.points.exchange import TagReading
from monstertruck_estimation.points.files import load, save
from monstertruck_estimation.points.tracking import KEPT_SIGHTINGS, PointMap
from monstertruck_estimation.vision.mount import camera_axes
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.map_folders import SAVES, opened
from monstertruck_schemas.body import Mount
from monstertruck_schemas.points import PointKind

MOUNT = Mount(x=0.2, z=0.25, yaw=0.1, pitch=-0.05)
STILL = np.diag((1e-4, 1e-4, 1e-5))
SECOND = 1_000_000_000
TAG = (3.0, 1.0, 0.3, math.pi)
"""x, y, z and yaw in map."""


def reading(base, tag=TAG, number=7, **more) -> TagReading:
    """What an ideal camera on the robot at ``base`` reads."""
    c, s = math.cos(base[2]), math.sin(base[2])
    dx, dy = tag[0] - base[0], tag[1] - base[1]
    place = np.array((c * dx + s * dy, -s * dx + c * dy, tag[2])) - (MOUNT.x, MOUNT.y, MOUNT.z)
    facing = tag[3] - base[2]
    turned = camera_axes(MOUNT.yaw, MOUNT.pitch, MOUNT.roll).T
    normal = tuple(turned @ np.array((math.cos(facing), math.sin(facing), 0.0)))
    values = {
        "other_normal": normal,
        "doubt": 0.1,
        "pixels": 40.0,
        "margin": 0.8,
        "angle": 0.2,
        "spread": (0.0,) * 36,
        "picture": b"\xff\xd8x",
    }
    return TagReading(number, tuple(turned @ place), normal, **(values | more))


def seen_from(points: PointMap, bases, **more) -> list[bool]:
    return [
        points.see(reading(base, **more), (i + 1) * SECOND, base, STILL, 0.0) for i, base in enumerate(bases)
    ]  # fmt: skip


BASES = [(2.0, 1.0, 0.0), (2.1, 0.8, 0.1), (1.9, 1.2, -0.2), (2.2, 1.1, 0.0)]


def shown(points: PointMap, bases=None, name: str = "tag-7"):
    points.refresh(name, bases or {})
    return points.shown.get(name)


def test_a_tag_is_known_after_two_pictures_at_its_place():
    points = PointMap(PointsConfig(), MOUNT)
    assert seen_from(points, BASES[:1]) == [False]
    assert shown(points) is None
    assert points.see(reading(BASES[1]), SECOND + 1, BASES[1], STILL, 0.0) is False, "the same instant"
    assert points.see(reading(BASES[1]), 2 * SECOND, BASES[1], STILL, 0.0) is True
    point = shown(points)
    assert (point.x, point.y, point.z, abs(point.yaw)) == pytest.approx(TAG, abs=1e-6)
    assert (point.sightings, point.tag, point.picture) == (2, 7, True)
    assert math.sqrt(point.covariance[0]) < 0.03


def test_two_pictures_that_disagree_are_none():
    points = PointMap(PointsConfig(), MOUNT)
    seen_from(points, BASES[:1])
    assert not points.see(reading(BASES[1], (3.0, 2.0, 0.3, math.pi)), 9 * SECOND, BASES[1], STILL, 0.0)
    assert shown(points) is None


def test_an_outlier_does_not_move_it():
    points = PointMap(PointsConfig(), MOUNT)
    seen_from(points, BASES)
    points.see(reading((2.4, 1.0, 0.0), (4.0, 1.0, 0.3, 0.0)), 9 * SECOND, (2.4, 1.0, 0.0), STILL, 0.0)
    assert (shown(points).x, shown(points).y) == pytest.approx(TAG[:2], abs=1e-6)


def test_it_moves_with_what_the_mapper_corrects():
    points = PointMap(PointsConfig(), MOUNT)
    seen_from(points, BASES)
    moved = {(i + 1) * SECOND: (x + 0.5, y - 0.2, yaw) for i, (x, y, yaw) in enumerate(BASES)}
    point = shown(points, moved)
    assert (point.x, point.y) == pytest.approx((TAG[0] + 0.5, TAG[1] - 0.2), abs=1e-6)
    assert points.stamps() == tuple(moved)


def test_of_two_poses_of_a_square_the_upright_one_is_taken_and_a_doubt_is_reported():
    points = PointMap(PointsConfig(), MOUNT)
    right = reading(BASES[0])
    tilted = tuple(camera_axes(MOUNT.yaw, MOUNT.pitch, MOUNT.roll).T @ np.array((-0.8, 0.0, 0.6)))
    for i, base in enumerate(BASES[:2]):
        one = replace(reading(base), normal=tilted, other_normal=right.normal, doubt=0.9)
        points.see(one, (i + 1) * SECOND, base, STILL, 0.0)
    assert abs(shown(points).yaw) == pytest.approx(math.pi, abs=0.1)
    doubted = PointMap(PointsConfig(), MOUNT)
    seen_from(doubted, BASES[:2], doubt=0.9)
    assert shown(doubted).covariance[8] > 1.0


def test_a_robot_that_stands_keeps_one_sighting_and_a_long_drive_not_too_many():
    points = PointMap(PointsConfig(), MOUNT)
    seen_from(points, [BASES[0]] * 30)
    assert len(points.points["tag-7"].sightings) == 1
    assert shown(points).sightings == 30
    seen_from(
        points := PointMap(PointsConfig(), MOUNT), [(1.0 + 0.1 * (i % 9), 0.1 * (i // 9), 0.0) for i in range(60)]
    )
    assert len(points.points["tag-7"].sightings) == KEPT_SIGHTINGS


def test_a_mark_moves_with_the_map_near_it_and_what_is_saved_comes_back(tmp_path):
    points = PointMap(PointsConfig(), MOUNT)
    seen_from(points, BASES)
    points.mark("dock", 5 * SECOND, (1.0, 0.0, 0.0), (1.5, 0.5, 1.0), STILL)
    mark = shown(points, {5 * SECOND: (1.0, 1.0, 0.0)}, "dock")
    assert (mark.x, mark.y, mark.yaw) == pytest.approx((1.5, 1.5, 1.0))
    assert mark.kind is PointKind.MARK
    shown(points)
    save(tmp_path, points.pictured())
    again = PointMap(PointsConfig(), MOUNT)
    again.load(load(tmp_path))
    for name in points.shown:
        old, new = points.shown[name], shown(again, name=name)
        assert (new.x, new.y, new.yaw) == pytest.approx((old.x, old.y, old.yaw))
        assert new.kind is old.kind
    assert again.points["tag-7"].picture == b"\xff\xd8x"
    save(tmp_path, [row for row in points.pictured() if row[0].name == "dock"])
    with opened(tmp_path) as kept:
        left = {file.name for file in kept.folder.iterdir()}
    assert left == {"points.json", "manifest.json"}, "no picture of what was forgotten is left"
    shutil.rmtree(tmp_path / SAVES)
    (tmp_path / "points.json").write_text("[{}]")
    with pytest.raises(InputError, match=r"points\.json: expected points of interest"):
        load(tmp_path)


def test_a_mark_is_as_uncertain_along_the_maps_axes_as_the_robot_was():
    points = PointMap(PointsConfig(), MOUNT)
    points.mark("dock", SECOND, (1.0, 0.0, math.pi / 2), (1.0, 0.0, 0.0), np.diag((1.0, 1e-4, 1e-5)))
    assert shown(points, name="dock").covariance[[0, 4]] == pytest.approx((1.0, 1e-4), abs=2e-4)


def test_a_tag_of_a_saved_map_is_seen_after_a_restart_of_the_computer_and_no_one_picture_undoes_it(tmp_path):
    points, hours = PointMap(PointsConfig(), MOUNT), 36_000 * SECOND
    for i, base in enumerate(BASES):
        points.see(reading(base), hours + i * SECOND, base, STILL, 0.0)
    shown(points)
    save(tmp_path, points.pictured())
    again = PointMap(PointsConfig(), MOUNT)
    again.load(load(tmp_path))
    off = (4.0, 1.0, 0.3, math.pi)
    again.see(reading(BASES[0], off), SECOND, BASES[0], STILL, 0.0)
    assert shown(again).sightings == len(BASES) + 1, "its clock began anew"
    assert (shown(again).x, shown(again).y) == pytest.approx(TAG[:2], abs=1e-6)
    for i, base in enumerate(BASES[1:]):
        again.see(reading(base, off), (i + 2) * SECOND, base, STILL, 0.0)
    assert shown(again).x == pytest.approx(4.0, abs=1e-3), "it hangs elsewhere now"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"x": "left"}, r"0\.x: Input should be a valid number"),
        ({"x": 1e308}, "dock: expected at most 10000 m and rad"),
        ({"yaw": -1e300}, "dock: expected at most 10000 m and rad"),
        ({"covariance": [0.0] * 9}, "dock: covariance: expected a symmetric matrix of variances from 1e-12 to"),
        ({"covariance": [1e-320, 0, 0, 0, 1e-320, 0, 0, 0, 1]}, "dock: covariance: expected"),
        ({"covariance": [math.inf, 0, 0, 0, 1, 0, 0, 0, 1]}, "dock: covariance: expected"),
        ({"covariance": [-1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]}, "dock: covariance: expected"),
        ({}, "dock: expected unique names"),
    ],
)
def test_a_file_of_points_that_is_wrong_is_refused_with_the_place(tmp_path, change: dict, said: str):
    points = PointMap(PointsConfig(), MOUNT)
    points.mark("dock", SECOND, (1.0, 0.0, 0.0), (1.5, 0.5, 1.0), STILL)
    shown(points, name="dock")
    save(tmp_path, points.pictured())
    with opened(tmp_path) as kept:
        (row,) = json.loads(kept.file("points.json").read_text())
    shutil.rmtree(tmp_path / SAVES)
    (tmp_path / "points.json").write_text(json.dumps([row | change] if change else [row, row]))
    with pytest.raises(InputError, match=f"points.json: .*{said}"):
        load(tmp_path)
