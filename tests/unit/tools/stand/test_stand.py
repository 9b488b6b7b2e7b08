"""The test stand on rendered pictures: calibration by its own procedure, poses, hand-over, cameras that go or move."""

import csv
import math

import numpy as np
import pytest
from typer.testing import CliRunner

pytest.importorskip("cv2")

import cv2

from monstertruck_estimation.vision import tags
from monstertruck_estimation.vision.lens import LensFit
from monstertruck_estimation.vision.tags import Sighting, TagReader
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError
from monstertruckd.tools.cli.main import app
from monstertruckd.tools.stand import calibration
from monstertruckd.tools.stand.calibration import calibrate, check_places, place, save
from monstertruckd.tools.stand.config import MarkConfig, OverheadConfig, TaggedRobot
from monstertruckd.tools.stand.poses import MarkerPose, merged, tag_pose
from monstertruckd.tools.stand.tracking import StandTracker, shift_of
from tests.stand_kit import simulated, turned
from tests.stand_render import level_tag

pytestmark = pytest.mark.timeout(300)


@pytest.fixture(scope="module")
def stand():
    return simulated(3, cameras=2, boards=8)


def sightings(stand, x, y, yaw, height=0.08):
    _, config, _, renderers, floor = stand
    placards = [*floor, level_tag(0, config.mark_size, x, y, yaw, height)]
    return {name: TagReader(1).read(renderer.picture(placards)) for name, renderer in renderers.items()}


def projected(camera, places):
    """Tags of 8 cm at x, y, z, as a camera without noise sees them."""
    square = 0.04 * np.array([(1, 1, 0), (1, -1, 0), (-1, -1, 0), (-1, 1, 0)])
    seen = [Sighting(tag, camera.project(square + place)) for tag, place in places.items()]
    return [s for s in seen if (s.corners > 0).all() and (s.corners < camera.lens.size).all()]


def test_poses_are_right_to_millimetres(stand):
    _, config, found, _, _ = stand
    rng = np.random.default_rng(1)
    for _ in range(6):
        x, y, yaw = rng.uniform(-1.3, 0.4), rng.uniform(0.2, 1.2), rng.uniform(-3, 3)
        tracker = StandTracker(found.placed(), config.robots, config.marks)
        (pose,) = tracker.take(0, sightings(stand, x, y, yaw))
        assert math.hypot(pose.x - x, pose.y - y) < 0.006
        assert abs(math.remainder(pose.yaw - yaw, math.tau)) < math.radians(1.5)
        assert pose.sigma < 0.002


def test_cameras_agree_where_both_see_a_robot(stand):
    _, _, found, _, _ = stand
    seen = sightings(stand, -0.5, 0.75, 0.3)
    robot = {name: next(s for s in tags if s.tag == 0) for name, tags in seen.items()}
    poses = [tag_pose(found.placed()[name], sighting, 0.08) for name, sighting in robot.items()]
    assert len(poses) == 2
    assert math.hypot(poses[0].x - poses[1].x, poses[0].y - poses[1].y) < 0.005


def test_a_robot_near_a_border_counts_less():
    sure, faint = (
        MarkerPose(0.0, 0.0, 3.1, 1.0, 0.001, 0.01, 0.08),
        MarkerPose(0.1, 0.0, -3.1, 0.001, 0.001, 0.01, 0.08),
    )
    assert merged([sure, faint]).x < 0.001
    assert abs(merged([sure, sure._replace(yaw=-3.1)]).yaw) > 3.1, "headings are averaged across the turn"


def test_a_tag_is_followed_in_a_window(stand):
    _, _, _, renderers, floor = stand
    reader = TagReader(everywhere=1000)
    whole = TagReader(everywhere=1)
    for k in range(5):
        picture = renderers["c1"].picture([*floor, level_tag(0, 0.08, -1.0 + 0.01 * k, 0.7, 0.1, 0.08)])
        found, everywhere = ({s.tag: s.corners for s in one.read(picture)} for one in (reader, whole))
        assert 0 in found
        for tag in found.keys() & everywhere.keys():
            assert np.abs(found[tag] - everywhere[tag]).max() < 1.0


def test_tags_that_lie_still_are_read_in_whole_pictures_only(stand):
    _, config, _, renderers, floor = stand
    reader = TagReader(everywhere=3, still=config.marks)
    picture = renderers["c1"].picture([*floor, level_tag(0, 0.08, -1.0, 0.7, 0.1, 0.08)])
    seen = [{s.tag for s in reader.read(picture)} for _ in range(4)]
    assert seen[0] == seen[3] > {0}
    assert seen[1] == seen[2] == {0}


def test_a_tag_that_appears_is_found_in_eight_pictures_and_at_once_where_it_is_expected(stand):
    _, config, _, renderers, floor = stand
    empty = renderers["c1"].picture(floor)
    there = renderers["c1"].picture([*floor, level_tag(0, 0.08, -1.0, 0.7, 0.1, 0.08)])
    (corners,) = (s.corners for s in TagReader(1).read(there) if s.tag == 0)
    unexpected, expected = TagReader(still=config.marks, phase=5), TagReader(still=config.marks, phase=5)

    def found(reader, picture, places=()):
        return 0 in {s.tag for s in reader.read(picture, places)}

    assert not found(unexpected, empty)
    assert not found(expected, empty)
    pictures = next(k for k in range(1, 9) if found(unexpected, there))
    assert pictures == 5, "the turn of the sixth camera, though it had nothing in view"
    assert found(expected, there, [corners + 15.0, corners - 1000.0])
    assert not found(expected, empty)
    assert found(expected, there), "looked for where it was hidden"


def test_cameras_take_turns_to_be_searched_and_specks_take_no_time(stand, monkeypatch):
    sizes = []

    def detect(self, picture):
        sizes.append((picture.shape, self.getDetectorParameters().minMarkerPerimeterRate * max(picture.shape)))
        return (), None, ()

    readers = [TagReader(phase=k) for k in range(6)]
    empty = np.zeros((480, 640), np.uint8)
    monkeypatch.setattr(tags.cv2.aruco.ArucoDetector, "detectMarkers", detect, raising=False)
    searched = []
    for _ in range(17):
        sizes.clear()
        for reader in readers:
            reader.read(empty, [np.array(((50.0, 50), (70, 50), (70, 70), (50, 70)))])
        searched.append(sum(shape == (480, 640) for shape, _ in sizes))
        assert all(least == pytest.approx(32) for _, least in sizes)
    assert searched == [6, 1, 1, 1, 1, 1, 0, 0, 1, 1, 1, 1, 1, 1, 0, 0, 1]


def test_robots_are_expected_in_every_camera_where_their_speed_takes_them(stand):
    _, _, found, _, _ = stand
    cameras = found.placed()
    robot = TaggedRobot(tag=0, height=0.08, x=0.05, y=0.02, yaw=0.3)
    tracker = StandTracker(cameras, {"r1": robot}, {})
    square = 0.04 * np.array([(1, 1, 0), (1, -1, 0), (-1, -1, 0), (-1, 1, 0)])

    def corners(camera, k):
        c, s = math.cos(0.1 * k), math.sin(0.1 * k)
        turned = square @ np.array(((c, s, 0), (-s, c, 0), (0, 0, 1)))
        return camera.project(turned + np.array((-0.6 + 0.02 * k, 0.75, 0.08)))

    def where(late):
        """x at the end, of a robot of which one camera is half a picture behind the other."""
        tracker = StandTracker(cameras, {"r1": TaggedRobot(tag=0)}, {})
        for k in range(8):
            both = {
                "c1": [Sighting(0, corners(cameras["c1"], k))],
                "c2": [Sighting(0, corners(cameras["c2"], k - 0.5))],
            }
            (pose,) = tracker.take(k * SECOND // 25, both, {"c2": k * SECOND // 25 - late})
        return pose.x

    assert where(SECOND // 50) == pytest.approx(-0.46, abs=5e-4)
    assert where(0) < -0.462
    assert tracker.expected(0) == {}
    for k in range(10):
        tracker.take(k * SECOND // 25, {"c1": [Sighting(0, corners(cameras["c1"], k))]})
    for name, places in tracker.expected(10 * SECOND // 25).items():
        assert places[0] == pytest.approx(corners(cameras[name], 10), abs=1.0)
    assert tracker.expected(SECOND) == {}


@pytest.mark.parametrize("axis", ["right", "down", "ahead"])
def test_a_camera_that_is_turned_by_2_degrees_about_any_axis_is_named_and_left_out(stand, axis):
    _, config, found, _, _ = stand
    cameras = found.placed()
    places = {0: (-0.5, 0.75, 0.08), **{tag: (m.x, m.y, 0.0) for tag, m in config.marks.items()}}
    good = {name: projected(camera, places) for name, camera in cameras.items()}
    bumped = projected(turned(cameras["c1"], axis, math.radians(2.0)), places)
    tracker = StandTracker(found.placed(), config.robots, config.marks)
    for k in range(30):
        (pose,) = tracker.take(k * SECOND // 10, good)
    assert tracker.complaints(3 * SECOND) == []
    said = []
    for k in range(30, 130):
        tags = bumped[: None if k % 8 == 0 else 1]  # as the stand reads: marks in one picture of eight
        (pose,) = tracker.take(k * SECOND // 10, {"c1": tags, "c2": good["c2"]})
        said += tracker.complaints(k * SECOND // 10)
    assert len(said) == 1
    assert "c1 has moved: its marks are" in said[0]
    assert pose.cameras == ("c2",)
    assert math.hypot(pose.x + 0.5, pose.y - 0.75) < 0.006
    assert tracker.take(13 * SECOND, {"c1": good["c1"]}) == []
    for k in range(131, 230):
        tracker.take(k * SECOND // 10, good)
        said += tracker.complaints(k * SECOND // 10)
    assert said[1:] == ["camera c1 sees its marks in their places again"]


def test_a_lost_camera_and_one_that_looks_elsewhere_are_named(stand):
    _, config, found, renderers, floor = stand
    tracker = StandTracker(found.placed(), config.robots, config.marks)
    good = {name: TagReader(1).read(renderer.picture(floor)) for name, renderer in renderers.items()}
    said = []
    for k in range(100):
        tracker.take(k * SECOND // 10, good if k < 30 else {"c1": []})
        said += tracker.complaints(k * SECOND // 10)
    assert "camera c2 has sent no image for 1 s" in said
    assert "camera c1 has seen none of its marks for 5 s: it is ignored; calibrate the stand again" in said
    assert len(said) == 2
    tracker.take(10 * SECOND, good)
    assert "camera c2 sends images again" in tracker.complaints(10 * SECOND)


def test_errors_of_the_ruler_do_not_look_like_a_camera_that_has_moved():
    places = np.array([(x, y) for x in (-0.5, 0.0, 0.5) for y in (-0.5, 0.5)])
    ruler = np.array([(1, 0), (-1, 0), (0, 0), (0, 0), (-1, 0), (1, 0)])
    assert np.abs(shift_of(places + 0.01 * ruler, places)).max() < 1e-9
    assert shift_of(places + np.array((0.01, 0.0)), places) == pytest.approx((0.01, 0, 0, 0))
    assert shift_of(places[:1] + np.array((0.0, 0.01)), places[:1]) == pytest.approx((0, 0.01, 0, 0))
    assert shift_of(1.01 * places, places)[3] == pytest.approx(0.01 * math.hypot(0.5, 0.5 * math.sqrt(2 / 3)))


def test_a_robot_that_stands_there_meanwhile_is_no_mark(stand, monkeypatch):
    _, config, found, renderers, floor = stand
    lenses = iter([LensFit(c.lens, np.zeros(8), 0.3, 500, np.zeros(8)) for c in found.placed().values()])
    monkeypatch.setattr(calibration, "lens_from_pictures", lambda *_: (next(lenses), 8))
    placards = [*floor, level_tag(0, config.mark_size, -0.5, 0.75, 0.3, 0.3)]
    floors = {name: [renderer.picture(placards)] for name, renderer in renderers.items()}
    again = calibrate(config, dict.fromkeys(renderers, ()), floors)
    assert again.overlap_rms < 0.002
    for name, camera in again.placed().items():
        assert np.abs(camera.centre - found.placed()[name].centre).max() < 0.005


def test_what_no_robot_can_reach_is_left_out_until_it_stays(stand):
    _, _, found, _, _ = stand
    camera = found.placed()["c1"]
    tracker = StandTracker({"c1": camera}, {"r1": TaggedRobot(tag=0, height=0.0)}, {})

    def at(x, y):
        corners = np.array(
            [(x + 0.04, y + 0.04, 0), (x + 0.04, y - 0.04, 0), (x - 0.04, y - 0.04, 0), (x - 0.04, y + 0.04, 0)]
        )
        return {"c1": [Sighting(0, camera.project(corners))]}

    assert len(tracker.take(0, at(-1.0, 0.7))) == 1
    taken = [len(tracker.take((k + 1) * SECOND // 25, at(-0.5, 0.9))) for k in range(8)]
    assert taken[0] == 0
    assert taken[-1] == 1
    assert tracker.left_out == taken.index(1)


def test_too_few_marks_or_boards_are_named(stand):
    _, _, found, _, _ = stand
    lens = found.placed()["c1"].lens
    with pytest.raises(InputError, match="marks"):
        place(lens, {1: np.zeros(2)}, {1: MarkConfig(x=0.0, y=0.0)})


def test_a_mark_that_was_measured_wrong_is_named(stand):
    _, config, found, _, _ = stand
    camera = found.placed()["c1"]
    places = {tag: np.array([(m.x, m.y, 0.0)]) for tag, m in config.marks.items()}
    seen = {tag: camera.project(place)[0] for tag, place in places.items()}
    seen = {tag: px for tag, px in seen.items() if (px > 10).all() and (px < (630, 470)).all()}
    check_places(place(camera.lens, seen, config.marks), seen, config.marks, 0.0015)
    for tag in seen:
        wrong = {**config.marks, tag: MarkConfig(x=config.marks[tag].x + 0.05, y=config.marks[tag].y)}
        with pytest.raises(InputError, match=rf"a mark is not at its configured place, marks.{tag} by (49|50|51) mm"):
            check_places(place(camera.lens, seen, wrong), seen, wrong, 0.0015)
    first, second, *_ = seen
    swapped = {**config.marks, first: config.marks[second], second: config.marks[first]}
    with pytest.raises(InputError, match=r"marks are not at their configured places, marks\."):
        check_places(place(camera.lens, seen, swapped), seen, swapped, 0.0015)


def test_the_commands_calibrate_and_track_recorded_pictures(stand, tmp_path):
    _, config, found, renderers, floor = stand
    save(found, tmp_path / "calibration.json")
    for name, renderer in renderers.items():
        folder = tmp_path / name
        folder.mkdir()
        for k in range(4):
            placards = [*floor, level_tag(0, 0.08, -0.5 + 0.02 * k, 0.7, 0.0, 0.08)]
            cv2.imwrite(str(folder / f"{k}.png"), renderer.picture(placards))
    file = tmp_path / "stand.yaml"
    lines = ["version: 2", f"calibration: {tmp_path}/calibration.json", "robots: { r1: { tag: 0 } }", "cameras:"]
    for name in renderers:
        source = f"{{ kind: file, path: {tmp_path}/{name} }}"
        lines.append(f"  {name}: {{ source: {source}, boards: {tmp_path}/none, floor: {tmp_path}/{name} }}")
    lines += ["marks:", *(f"  {tag}: {{ x: {m.x}, y: {m.y} }}" for tag, m in config.marks.items())]
    file.write_text("\n".join(lines))
    out = tmp_path / "poses.csv"
    result = CliRunner().invoke(app, ["stand", "track", "-c", str(file), "--out", str(out)])
    assert result.exit_code == 0, result.output
    rows = list(csv.DictReader(out.read_text().splitlines()))
    assert [row["robot"] for row in rows] == ["r1"] * 4
    assert [float(row["x_m"]) for row in rows] == pytest.approx([-0.5, -0.48, -0.46, -0.44], abs=0.006)
    assert rows[0]["cameras"] == "c1 c2"
    again = CliRunner().invoke(app, ["stand", "calibrate", "-c", str(file)])
    assert again.exit_code != 0
    assert "no images" in again.output


def test_the_shipped_configuration_is_one():
    from pathlib import Path

    from monstertruckd.config.load import load_config

    config, _ = load_config(
        Path(__file__).resolve().parents[4] / "configs" / "stands" / "overhead.yaml", OverheadConfig
    )
    assert len(config.cameras) == 6
