"""The camera's wizard: what it keeps of a board that is held, what it says is missing or wrong, and what it saves."""

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("cv2")

import cv2
from pydantic import ValidationError

from monstertruck_drivers.webcam.emulator import jpeg
from monstertruck_estimation.vision.board import BoardReader, BoardSighting
from monstertruck_estimation.vision.lens import Lens, board_pose, fit_lens
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError, RequestRefusedError
from monstertruck_schemas import topics
from monstertruck_schemas.board import BoardConfig
from monstertruck_schemas.body import LensConfig, Mount
from monstertruck_schemas.sensor import VALID_BEAM, CompressedImage, LaserScan
from monstertruck_sim.world.config import CameraConfig, HeldBoard, WorldConfig
from monstertruck_sim.world.world import World
from monstertruckd.config.calibration import with_values
from monstertruckd.config.load import load_config
from monstertruckd.tools.calibrate import camera
from monstertruckd.tools.calibrate.board_mount import LidarPlace, fit_mount, in_board, line_on_board
from monstertruckd.tools.calibrate.board_views import BoardGuide, BoardView, averaged
from monstertruckd.tools.calibrate.camera import CameraWizard
from monstertruckd.tools.simulation.config import SimulatedTruckConfig
from tests.calibration_light import held_boards, true_lens

BOARD = BoardConfig()
READER = BoardReader(BOARD)
NOMINAL = Lens.of(LensConfig(), 640, 480)
MOUNT = np.array((0.18, 0.0, 0.25, 0.0, 0.0, 0.0))
LIDAR = LidarPlace.of(Mount(x=0.14, z=0.25))
TENTH = SECOND // 10
CONFIGS = Path(__file__).resolve().parents[4] / "configs"


def boards(seed, count=8, **more):
    return held_boards(READER, NOMINAL, MOUNT, LIDAR, np.random.default_rng(seed), count=count, **more)


def guide(*, beams=None, patience=20.0):
    return BoardGuide(BoardReader(BOARD), NOMINAL, beams, patience)


def scan_of(view, stamp):
    step = float(view.angles[1] - view.angles[0])
    return LaserScan(
        stamp=stamp, received=stamp, seq=1, start_angle=float(view.angles[0]), end_angle=float(view.angles[-1]),
        time_increment=0.1 / math.tau * step, scan_time=0.1, range_min=0.02, range_max=5.6, ranges=view.ranges,
        codes=np.full(view.angles.size, VALID_BEAM, np.uint8),
    )  # fmt: skip


def shown(one: BoardGuide, view, start: int, seconds: float = 1.0):
    """Hold a board still; returns the views that come of it."""
    stamps = range(start, start + round(seconds * SECOND), 2 * TENTH)
    return [found for t in stamps if (found := one.take(t, view.sighting, [scan_of(view, t - 2 * TENTH)])) is not None]


def shown_in_turn(one: BoardGuide, sightings):
    for k in range(200):
        one.take(k * 2 * TENTH, sightings[k % len(sightings)])


def test_a_board_that_is_held_still_is_a_view_once():
    one, (view, other) = guide(), boards(1, 2)
    (kept,) = shown(one, view, 0, 3.0)
    assert kept.sighting.corners == pytest.approx(view.sighting.corners)
    assert kept.ranges == pytest.approx(view.ranges)
    assert len(shown(one, other, 4 * SECOND)) == 1
    assert len(one.views) == 2


def test_one_that_moves_is_none_and_neither_is_one_without_scans_seen_by_the_lidar():
    one, (view,) = guide(), boards(1, 1)
    for k in range(20):
        drifting = view.sighting._replace(corners=view.sighting.corners + 0.6 * k)
        assert one.take(k * 2 * TENTH, drifting) is None
    alone = [found for k in range(6) if (found := one.take(10 * SECOND + k * 2 * TENTH, view.sighting)) is not None]
    assert alone[0].ranges.size == 0
    assert line_on_board(alone[0], READER, NOMINAL, MOUNT, LIDAR, known=False) is None


def test_what_is_missing_is_said_and_named_at_the_end():
    one = guide(beams=lambda view: False)
    held = [view for view in boards(2, 60) if view.sighting.corners[:, 0].max() < 320][:5]
    for k, view in enumerate(held):
        shown(one, view, 2 * k * SECOND)
    missing = one.missing()
    assert {"upper right", "right", "lower right"} <= set(one.uncovered())
    assert "the board in the right of the image" in missing
    assert f"{24 - len(held)} more views of the board" in missing
    assert "16 more views across the lidar's beam" in missing
    with pytest.raises(InputError, match=r"no new view in 20 s; still missing: the board in the .*right of"):
        shown(one, held[0], 20 * SECOND, 30.0)


def test_views_across_the_beam_have_to_lean_steeply_near_and_far():
    one = guide(beams=lambda view: True)
    steep = [view for view in boards(5, 120, steep=1.0) if abs(view.pose.lean) > math.radians(30)]
    near = [view for view in steep if view.pose.place[2] < 0.6]
    upper, lower = ([view for view in near if sign * view.pose.lean > 0] for sign in (1, -1))
    for view in upper[:8] + lower[:7]:
        one.keep(view)
    said = "its bottom edge closer by 30 degrees or more, across the lidar's beam (1 more)"
    assert [text for text in one.missing() if "degrees" in text] == [said]
    one.keep(lower[7])
    assert any(text.startswith("these tilts at more distances than 0.4") for text in one.missing())
    one.keep(max(steep, key=lambda view: view.pose.place[2]))
    assert not any(word in text for text in one.missing() for word in ("degrees", "it so"))


@pytest.mark.parametrize(
    ("sightings", "said"),
    [
        ([None], "no board of 8 x 6 squares was detected in 20 s"),
        ([BoardSighting(np.zeros((9, 2)), np.arange(9), 3.1)], r"blurred \(edges 3.1 pixels wide, expected 2\)"),
        ([view.sighting for view in boards(3, 4)], "never held still for 0.7 s"),
    ],
)
def test_what_is_wrong_is_named(sightings, said):
    one = guide()
    with pytest.raises(InputError, match=said):
        shown_in_turn(one, sightings)


def test_another_board_is_named():
    printed = cv2.aruco.CharucoBoard((12, 9), 0.02, 0.015, cv2.aruco.getPredefinedDictionary(20))
    one = guide()
    picture = np.pad(printed.generateImage((560, 420)), ((30, 30), (40, 40)), constant_values=255)
    one.reader.read(np.asarray(picture[200:], dtype=np.uint8))
    with pytest.raises(InputError, match=r"another board: marker [0-9]+ does not belong to 8 x 6 squares"):
        shown_in_turn(one, [None])


def test_corners_are_averaged():
    (view,) = boards(4, 1)
    noisy = [view.sighting._replace(corners=view.sighting.corners + d) for d in ((0.2, 0.0), (-0.2, 0.3), (0.0, -0.3))]
    part = BoardSighting(view.sighting.corners[:1] + 5.0, np.array([99]), 0.5)
    mean = averaged([*noisy, part])
    assert mean.corners == pytest.approx(view.sighting.corners)
    assert 99 not in mean.ids


def test_too_few_boards_and_boards_that_no_lens_explains_are_refused():
    views = boards(5, 10)
    with pytest.raises(InputError, match="visible in 3 images: expected 6"):
        fit_lens([view.sighting for view in views[:3]], READER, (640, 480))
    rng = np.random.default_rng(1)
    bent = [
        BoardSighting(v.sighting.corners + rng.normal(0, 3, v.sighting.corners.shape), v.sighting.ids, 0.5)
        for v in views
    ]
    with pytest.raises(InputError, match=r"corners deviate by [0-9.]+ pixels .*bent"):
        camera.lens_of([SimpleNamespace(sighting=view) for view in bent], READER, (640, 480))


def test_a_lidar_that_sees_no_board_is_named():
    away = LidarPlace.of(Mount(x=0.14, z=0.9))
    with pytest.raises(InputError, match="the lidar sees the board in 0 of 8 views"):
        fit_mount(boards(6), READER, NOMINAL, MOUNT, away, 0.001)


def test_the_simulated_world_shows_the_same_board_to_camera_and_lidar():
    world = World(WorldConfig(map="yard", camera=CameraConfig(k1=-0.1, noise=3.0), board=HeldBoard()), 7)
    world.truth(0)
    lens = Lens(NOMINAL.matrix, np.array((-0.1, 0.0, 0.0, 0.0, 0.0)), (640, 480))
    reader, crossed = BoardReader(BOARD), 0
    for k in range(2):
        stamp = round((1.5 * k + 0.7) * SECOND)
        picture = camera.decoded(
            SimpleNamespace(data=jpeg(world.view.exposure(stamp, (640, 480))(), k), sequence=k)  # type: ignore[arg-type]
        )
        sighting = reader.read(picture)
        assert sighting is not None
        assert 0.4 < sighting.blur < 1.0
        blurred = reader.read(cv2.GaussianBlur(picture, (0, 0), 2.5))
        assert blurred is None or blurred.blur > 2.0
        ranges = np.mean([world.lidar.scan(stamp + i * TENTH) for i in range(5)], axis=0) / 1000
        angles = (np.arange(769) - 384) * math.tau / 1024
        pose = board_pose(sighting, reader, lens)
        assert pose is not None
        assert pose.rms < 0.4
        view = BoardView(sighting, pose, angles, np.where(ranges > 0.02, ranges, np.inf))
        line = line_on_board(view, reader, lens, MOUNT, LIDAR, known=True)
        if line is not None:
            crossed += 1
            middle = np.mean(in_board(line.ends, pose, MOUNT, LIDAR), axis=0)
            assert abs(middle[2]) < 0.006
    assert crossed


class Session:
    """A context in which a board is held until the wizard has enough."""

    def __init__(self, config, views):
        self.config, self.known, self._views = config, {}, views
        self.said: list[str] = []
        self.joints: list[float] = []

    def say(self, text):
        self.said.append(text)

    def plot(self, plot):
        self.said.append(plot.name)

    async def confirm(self, step):
        return True

    async def collect(self, step):
        if step.topic is topics.STABILISER:
            return [SimpleNamespace(pitch=self.joints.pop(0), roll=0.0)]
        return [self._picture(0, 0)] * step.count

    async def watch(self, step):
        for k, view in enumerate(self._views):
            for j in range(6):
                stamp = 2 * k * SECOND + 2 * j * TENTH
                scans = [scan_of(view, stamp - 2 * TENTH)]
                done, total = step.take(self._picture(stamp, k), {topics.SCAN.name: scans} if step.also else {})
                if done >= total:
                    return
        raise AssertionError("it never has enough")

    def fit(self, name, function):
        return function()

    @staticmethod
    def _picture(stamp, number):
        return CompressedImage(stamp=stamp, received=stamp, seq=1, data=b"", sequence=number)


@pytest.fixture
def session(monkeypatch):
    """Of a robot with a camera; its pictures are numbers of views that were seen already."""
    config = load_config(CONFIGS / "board.yaml", SimulatedTruckConfig)[0]
    lens = true_lens(np.random.default_rng(8))
    mount = MOUNT + np.array((0.01, -0.02, 0.01, 0.03, 0.02, -0.03))
    views = held_boards(READER, lens, mount, LIDAR, np.random.default_rng(8), count=70, steep=0.6)

    def decoded(message: CompressedImage) -> Any:
        return np.full((480, 640), message.sequence, np.uint8)

    monkeypatch.setattr(camera, "decoded", decoded)
    monkeypatch.setattr(BoardReader, "read", lambda _, picture: views[int(picture[0, 0])].sighting)
    return Session(config, views), lens, mount


async def test_lens_and_mount_go_into_the_configuration(session):
    context, lens, mount = session
    result = await CameraWizard()(context)
    assert not result.partial
    assert any("still missing" in text for text in context.said)
    device = with_values(context.config, [result], "test").devices.camera
    assert device.driver.lens.focal_x == pytest.approx(lens.matrix[0, 0], abs=4.0)
    assert (device.driver.lens.width, device.driver.lens.height) == (640, 480)
    found = [getattr(device.mount, name) for name in ("x", "y", "z", "yaw", "pitch", "roll")]
    assert found == pytest.approx(mount, abs=0.02)


async def test_the_lens_alone_leaves_the_mount(session):
    context, _, _ = session
    result = await CameraWizard(lidar=False)(context)
    assert result.partial
    assert result.estimate("x") is None
    assert result.estimate("k1").key == "devices.camera.driver.lens.k1"


async def test_a_robot_without_a_camera_is_refused(session):
    context, _, _ = session
    context.config = load_config(CONFIGS / "yard.yaml", SimulatedTruckConfig)[0]
    with pytest.raises(RequestRefusedError, match="no camera whose driver takes lens parameters"):
        await CameraWizard()(context)


async def test_a_damaged_picture_now_and_then_does_not_end_it_and_a_camera_that_sends_no_others_is_named(
    session, monkeypatch: pytest.MonkeyPatch
):
    context, _, _ = session
    whole = camera.decoded
    monkeypatch.setattr(camera, "decoded", lambda m: None if m.stamp % (4 * SECOND) == 0 and m.stamp else whole(m))
    assert (await CameraWizard(lidar=False)(context)).estimate("k1") is not None
    assert camera.decoded(SimpleNamespace(stamp=4 * SECOND)) is None
    monkeypatch.setattr(camera, "decoded", lambda m: whole(m) if m.stamp == 0 else None)
    with pytest.raises(InputError, match=r"of \d+ images cannot be decoded: check the camera's cable"):
        await CameraWizard(lidar=False)(context)
    monkeypatch.setattr(camera, "decoded", lambda _: None)
    with pytest.raises(InputError, match="none of 3 images"):
        await CameraWizard(lidar=False)(context)


@pytest.mark.parametrize("data", [b"", b"\xff\xd8 torn", b"no picture"])
def test_bytes_that_are_no_picture_are_none(data: bytes):
    assert camera.decoded(SimpleNamespace(data=data)) is None


async def test_pictures_of_another_size_are_another_lens(session, monkeypatch: pytest.MonkeyPatch):
    context, _, _ = session
    whole = camera.decoded
    monkeypatch.setattr(camera, "decoded", lambda m: whole(m)[: 360 if m.stamp > 9 * SECOND else 480])
    with pytest.raises(InputError, match="changed from 640 x 480 to 640 x 360 pixels"):
        await CameraWizard(lidar=False)(context)


@pytest.mark.parametrize(("after", "refused"), [(0.004, False), (0.03, True)])
async def test_a_lidar_whose_joints_turn_meanwhile_tells_no_mount(session, after: float, refused: bool):
    context, _, _ = session
    stabiliser = load_config(CONFIGS / "full.yaml", SimulatedTruckConfig)[0].devices.stabiliser
    devices = context.config.devices.model_copy(update={"stabiliser": stabiliser})
    context.config, context.joints = context.config.model_copy(update={"devices": devices}), [0.0, after]
    if refused:
        with pytest.raises(InputError, match=r"lidar by 1\.7 degrees .* do not lean on it"):
            await CameraWizard()(context)
    else:
        assert (await CameraWizard()(context)).estimate("pitch") is not None


async def test_the_scans_of_a_lidar_that_hangs_are_those_of_an_upright_one(session):
    context, _, _ = session
    lidar = context.config.devices.lidar
    mount = lidar.mount.model_copy(update={"roll": math.pi})
    devices = context.config.devices.model_copy(update={"lidar": lidar.model_copy(update={"mount": mount})})
    upright = await CameraWizard()._lidar(context)
    context.config = context.config.model_copy(update={"devices": devices})
    hung = await CameraWizard()._lidar(context)
    assert hung.axes == pytest.approx(upright.axes)


def test_a_lidar_that_sends_nothing_is_named_before_everything_else():
    one = guide(beams=lambda view: False)
    for number, view in enumerate(boards(5)):
        one.keep(replace(view, angles=np.empty(0), ranges=np.empty(0)))
        assert one.missing()[0] == "scans of the lidar: 3 or more in 0.7 s", number


def test_corners_in_one_line_tell_no_place_of_the_board(monkeypatch: pytest.MonkeyPatch):
    long = BoardReader(BoardConfig(columns=12, rows=6))
    across = np.arange(10)
    found = np.column_stack((20.0 + 40.0 * across, np.full(10, 200.0))).reshape(-1, 1, 2)
    reads = {"across": across, "down": 11 * np.arange(5), "both": np.concatenate((across[:8], 11 + across[:2]))}
    seen = {}
    for name, ids in reads.items():
        corners = np.resize(found, (ids.size, 1, 2))
        detector = SimpleNamespace(detectBoard=lambda _, c=corners, i=ids: (c, i[:, None], None, None))
        monkeypatch.setattr(long, "_detector", detector)
        seen[name] = long.read(np.zeros((480, 640), np.uint8)) is not None
    assert seen == {"across": False, "down": False, "both": True}


def test_a_marker_as_large_as_its_square_is_refused():
    with pytest.raises(ValidationError, match="marker"):
        BoardConfig(square=0.03, marker=0.03)
