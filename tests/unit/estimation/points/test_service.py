"""The service: pictures in, points of interest out; marks, removal, what is saved, what is refused."""

import asyncio
import base64
import errno
import math
from contextlib import suppress
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.durability_parts import maps
from monstertruck_estimation.points import files
from monstertruck_estimation.points.config import PointsConfig
from monstertruck_estimation.points.service import (
    TARGET,
    PointFolders,
    PointInputs,
    PointService,
)
from monstertruck_estimation.slam import storage
from monstertruck_runtime.actors.actor import LoopActor
from monstertruck_runtime.clock import SECOND, run_virtual
from monstertruck_runtime.errors import InputError, NotFoundError, RequestRefusedError
from monstertruck_runtime.mailbox import Mailbox, fifo, latest
from monstertruck_runtime.map_folders import holds_map
from monstertruck_runtime.threads import inline
from monstertruck_schemas.base import Pose2D, Twist2D
from monstertruck_schemas.body import LensConfig, Mount
from monstertruck_schemas.health import LocalisationStatus
from monstertruck_schemas.points import PointKind, PointOrder
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Role
from monstertruck_schemas.sensor import Attitude, CompressedImage
from monstertruck_schemas.state import Odometry
from monstertruck_sim.world.config import TagConfig
from tests.unit.estimation.points.test_reader import picture

SEEN = picture(TagConfig(tag=3, x=1.0, y=0.1, z=0.3, yaw=math.pi))
"""From the camera, which is at (0.18, 0, 0.25) in base."""


class Kept(list):
    def next_seq(self) -> int:
        return len(self)

    put = list.append


class Calls(dict):
    def register(self, name, handler, role=None, *, recorded=True) -> None:
        self[name] = handler


class Rig:
    """A robot that creeps along x."""

    def __init__(self, clock, folder, ask=None, load=None, standing=None, run=None, save_map=None) -> None:
        self.clock, self.out, self.events, self.seq, self.speed = clock, Kept(), [], 0, 0.05
        self.tags, self.behaviour = Kept(), SimpleNamespace(latest=None)
        self.camera, self.pose, self.felt = Mailbox(latest()), Mailbox(fifo(256)), Mailbox(latest())
        self.gate = SimpleNamespace(latest=SimpleNamespace(nonce="n", stamp=0))
        self.calls = Calls()
        slam = None if standing is None else SimpleNamespace(latest=SimpleNamespace(standing=standing))
        self.service = PointService(
            PointsConfig(), (Mount(x=0.18, z=0.25), LensConfig(k1=-0.15, k2=0.03)), clock,
            LoopActor(TARGET, clock, 0.05),
            inputs=PointInputs(self.camera, self.pose, slam, self.felt, self.gate, self.behaviour), ask=ask,
            out=self.out, tags=self.tags,
            events=lambda reason, *args, **_: self.events.append((reason, args[-1])),
            folders=PointFolders(load=load, save=folder, run=run), save_map=save_map, offload=inline, max_age=5.0,
        )  # fmt: skip
        self.service.register(self.calls)

    async def drive(self, seconds: float, *, tilt: float = 0.0, show: bytes = SEEN) -> None:
        for i in range(round(seconds / 0.05)):
            now = self.clock.now()
            header = {"stamp": now, "received": now, "seq": i}
            self.pose.put(Odometry(
                **header, frame="map", pose=Pose2D(x=self.speed * now * 1e-9, y=0.0, yaw=0.0),
                twist=Twist2D(vx=self.speed, vy=0.0, wz=0.0), pose_covariance=np.full(9, 1e-6),
                twist_covariance=np.zeros(9), age=0.0, sources=(),
            ))  # fmt: skip
            self.felt.put(Attitude(**header, heading=0.0, roll=0.0, pitch=tilt))
            if i % 4 == 0:
                self.camera.put(CompressedImage(**header, frame="camera", data=show, sequence=i))
            await self.clock.sleep(0.05)

    async def ask(self, order: PointOrder, name: str, **more) -> dict[str, float]:
        self.seq += 1
        return await self.calls["points"]({
            "stamp": 0, "received": 0, "seq": self.seq, "source": "ann", "role": Role.STATION, "lease": 1.0,
            "nonce": "n", "order": order, "name": name, **more,
        })  # fmt: skip


def run_scenario(story, folder, **more) -> Rig:
    async def main(clock) -> Rig:
        rig = Rig(clock, folder, **more)
        serving = asyncio.create_task(rig.service.run(lambda: None))
        acting = asyncio.create_task(story(rig))
        await asyncio.wait([serving, acting], return_when=asyncio.FIRST_COMPLETED)
        serving.cancel()
        with suppress(asyncio.CancelledError):
            await serving
        await acting
        return rig

    return run_virtual(main)


def test_a_tag_in_pictures_becomes_a_point_with_a_picture_and_is_saved(tmp_path):
    async def story(rig: Rig) -> None:
        await rig.drive(2.5)
        data = base64.b64decode((await rig.calls["point_picture"]({"name": "tag-3"}))["jpeg"])
        assert data.startswith(b"\xff\xd8")
        with pytest.raises(NotFoundError):
            await rig.calls["point_picture"]({"name": "tag-4"})

    rig = run_scenario(story, tmp_path)
    assert not rig.out[0].points, "late joiners know that there is none"
    (point,) = rig.out[-1].points
    # The picture is always the same, so the tag goes along with the robot: sightings agree within what is allowed.
    assert (point.x, point.y, point.z) == pytest.approx((1.18 + 0.05, 0.1, 0.3), abs=0.08)
    assert [reason for reason, _ in rig.events] == [Reason.POINT_FOUND]
    ((saved, picture_),) = files.load(tmp_path)
    assert saved.name == "tag-3"
    assert picture_


def test_nothing_is_read_of_a_tilted_robot_and_a_standing_one_is_left_alone(tmp_path):
    async def tilted(rig: Rig) -> None:
        await rig.drive(1.5, tilt=0.3)

    assert not any(message.points for message in run_scenario(tilted, tmp_path).out)

    async def standing(rig: Rig) -> None:
        rig.speed = 0.0
        await rig.drive(3.0)

    assert run_scenario(standing, tmp_path).out[-1].points[0].sightings == 2


def test_places_are_marked_moved_with_the_map_and_removed(tmp_path):
    moved = {}

    async def story(rig: Rig) -> None:
        with pytest.raises(RequestRefusedError, match="no fresh pose"):
            await rig.ask(PointOrder.MARK, "dock")
        rig.speed = 1.0
        await rig.drive(2.0, show=b"")
        here = await rig.ask(PointOrder.MARK, "here")
        assert here["x"] > 1.0
        assert await rig.ask(PointOrder.MARK, "there", x=1.0, y=3.0, yaw=1.0) == {"x": 1.0, "y": 3.0, "yaw": 1.0}
        for wrong in ({"x": 1.0}, {"name": "tag-9"}):
            with pytest.raises(InputError):
                await rig.ask(PointOrder.MARK, **({"name": "odd"} | wrong))
        with pytest.raises(NotFoundError, match="no point of interest 'nowhere': expected one of here, there"):
            await rig.ask(PointOrder.REMOVE, "nowhere")
        await rig.drive(1.5, show=b"")
        before = {point.name: point for point in rig.out[-1].points}
        assert before["there"].kind is PointKind.MARK
        moved["asked"] = dict.fromkeys(rig.service._map.stamps(), (10.0, 0.0, 0.0))
        await rig.drive(1.5, show=b"")
        after = {point.name: point for point in rig.out[-1].points}
        assert after["here"].x == pytest.approx(10.0)
        assert after["there"].y == pytest.approx(3.0)
        await rig.ask(PointOrder.REMOVE, "here")
        await rig.drive(1.5, show=b"")

    rig = run_scenario(story, tmp_path, ask=lambda stamps: moved.get("asked", {}))
    assert [point.name for point in rig.out[-1].points] == ["there"]
    again = run_scenario(lambda rig: rig.drive(1.2, show=b""), None, load=tmp_path)
    assert [point.name for point in again.out[-1].points] == ["there"]


def test_a_place_far_from_here_is_marked_where_it_is_in_the_map_of_today(tmp_path):
    """The robot passed it before a loop was closed, by which the mapper has moved where it was then."""
    answers = {}

    async def story(rig: Rig) -> None:
        rig.speed = 1.0
        await rig.drive(2.0, show=b"")
        await rig.ask(PointOrder.MARK, "there", x=1.0, y=3.0, yaw=1.0)
        answers["now"] = dict.fromkeys(rig.service._map.stamps(), (1.0, 0.5, 0.2))
        await rig.drive(1.5, show=b"")
        (point,) = rig.out[-1].points
        assert (point.x, point.y, point.yaw) == pytest.approx((1.0, 3.0, 1.0))
        answers["now"] = dict.fromkeys(rig.service._map.stamps(), (1.0, 0.8, 0.2))
        await rig.drive(1.5, show=b"")
        assert rig.out[-1].points[0].y == pytest.approx(3.3), "from then on it goes along"

    run_scenario(story, tmp_path, ask=lambda stamps: answers.get("now", {}))


def test_what_cannot_be_read_is_not_written_over_and_the_last_mark_is_kept(tmp_path):
    (tmp_path / "points.json").write_text("[{}]")

    async def story(rig: Rig) -> None:
        await rig.drive(1.0, show=b"")
        await rig.ask(PointOrder.MARK, "dock")

    rig = run_scenario(story, tmp_path, load=tmp_path)
    assert (tmp_path / "points.json").read_text() == "[{}]"
    assert any("not saved over this file" in text for _, text in rig.events)
    run_scenario(story, tmp_path / "new")
    assert [point.name for point, _ in files.load(tmp_path / "new")] == ["dock"]


def test_files_are_written_by_a_thread_and_failures_are_reported_by_the_loop(tmp_path):
    (tmp_path / "file").touch()
    inside = []

    async def offload(work):
        inside.append(1)
        try:
            return work()
        finally:
            inside.pop()

    async def story(rig: Rig) -> None:
        rig.service._offload = offload
        rig.service._events = lambda reason, *args, **_: rig.events.append((len(inside), args[-1]))
        await rig.drive(1.0, show=b"")
        with pytest.raises(RequestRefusedError, match="a power cut would undo it"):
            await rig.ask(PointOrder.MARK, "dock")

    rig = run_scenario(story, tmp_path / "file" / "folder")
    assert [by for by, text in rig.events if "points not saved" in text] == [0, 0], "when asked, and at the end"


def test_points_that_were_not_saved_are_saved_later_though_nothing_changes(tmp_path):
    (tmp_path / "file").touch()

    async def story(rig: Rig) -> None:
        await rig.drive(1.0, show=b"")
        with pytest.raises(RequestRefusedError) as refused:
            await rig.ask(PointOrder.MARK, "dock")
        assert refused.value.refusal is Reason.RECORDING_FAILED
        await rig.drive(14.0, show=b"")
        assert any(reason is Reason.RECORDING_FAILED and "points not saved" in text for reason, text in rig.events)
        (tmp_path / "file").unlink()
        await rig.drive(11.0, show=b"")
        assert [point.name for point, _ in files.load(tmp_path / "file" / "map")] == ["dock"]

    run_scenario(story, tmp_path / "file" / "map")


def test_points_not_saved_for_want_of_space_say_so(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(files, "save", full)

    async def story(rig: Rig) -> None:
        await rig.drive(1.0, show=b"")
        with pytest.raises(RequestRefusedError) as refused:
            await rig.ask(PointOrder.MARK, "dock")
        assert refused.value.refusal is Reason.DISK_FULL
        await rig.drive(11.0, show=b"")

    rig = run_scenario(story, tmp_path)
    assert {reason for reason, text in rig.events if "not saved" in text} == {Reason.DISK_FULL}


def test_an_answered_request_is_on_the_disk(tmp_path):
    async def story(rig: Rig) -> None:
        await rig.drive(1.0, show=b"")
        await rig.ask(PointOrder.MARK, "dock")
        assert [point.name for point, _ in files.load(tmp_path)] == ["dock"]
        await rig.ask(PointOrder.REMOVE, "dock")
        assert files.load(tmp_path) == []

    run_scenario(story, tmp_path)


def test_a_mark_before_the_first_save_of_a_map_is_answered_once_its_map_is_saved(tmp_path):
    def save_map(run: int = 2) -> None:
        storage.save(tmp_path, maps._patch(run, 1), maps._graph(run, 1), str(run))

    async def story(rig: Rig) -> None:
        await rig.drive(1.0, show=b"")
        await rig.ask(PointOrder.MARK, "dock")
        assert [point.name for point, _ in files.load(tmp_path)] == ["dock"]
        assert holds_map(tmp_path, "2")

    save_map(1)
    run_scenario(story, tmp_path, run="2", save_map=save_map)


def test_a_mark_in_a_map_that_is_never_saved_is_refused(tmp_path):
    asked = []

    async def story(rig: Rig) -> None:
        await rig.drive(1.0, show=b"")
        begin = rig.clock.now()
        with pytest.raises(RequestRefusedError, match="the map is not saved yet") as refused:
            await rig.ask(PointOrder.MARK, "dock")
        assert refused.value.refusal is Reason.NO_MAP
        assert rig.clock.now() - begin < 4.2 * SECOND

    run_scenario(story, tmp_path, run="2", save_map=lambda: asked.append(True))
    assert asked == [True]


def test_a_robot_that_is_lost_marks_no_place_of_its_own_and_reads_no_tags(tmp_path):
    async def story(rig: Rig) -> None:
        await rig.drive(1.5)
        with pytest.raises(RequestRefusedError, match="unknown"):
            await rig.ask(PointOrder.MARK, "here")
        await rig.ask(PointOrder.MARK, "there", x=1.0, y=3.0)
        await rig.drive(1.5)

    rig = run_scenario(story, tmp_path, standing=LocalisationStatus.LOST)
    assert [point.name for point in rig.out[-1].points] == ["there"]


def test_a_robot_that_docks_reads_every_image_and_publishes_the_poses_of_its_tags(tmp_path):
    """Standing, tilted: no place for a point of the map."""

    async def story(rig: Rig) -> None:
        rig.speed = 0.0
        await rig.drive(2.0, tilt=0.5)
        assert not rig.tags
        rig.behaviour.latest = SimpleNamespace(running=True, kind="dock")
        await rig.drive(2.0, tilt=0.5)

    rig = run_scenario(story, tmp_path)
    assert len(rig.tags) > 7
    assert not [message for message in rig.out if message.points]
    for message in rig.tags:
        (tag,) = message.tags
        assert message.frame == "base"
        assert message.received > message.stamp
        assert (tag.tag, tag.x, tag.y, tag.z) == pytest.approx((3, 1.18, 0.1, 0.3), abs=0.03)
        assert tag.covariance.reshape(3, 3)[0, 0] < 0.03**2
