"""What the page asks beyond driving: paths that are drawn, missions, settings, recordings."""

import asyncio
import base64
import contextlib
import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import aiohttp
import numpy as np
import pytest

from monstertruck_runtime.clock import SECOND, WallClock
from monstertruck_runtime.errors import InputError, NotFoundError, RequestRefusedError
from monstertruck_runtime.mailbox import Mailbox
from monstertruck_schemas import topics
from monstertruck_schemas.base import Pose2D, Twist2D
from monstertruck_schemas.event import Event, Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.roles import AccessRole
from monstertruck_schemas.state import Grid, Odometry
from monstertruckd.station import commands, downloads, recordings, server
from monstertruckd.station.address import RobotAddress
from monstertruckd.station.pilot import LONGEST_DRAWN_PATH, SHORTEST, Pilot, drawn_path, read_mission
from monstertruckd.station.replay import ReplayFeed
from monstertruckd.station.server import Place, Station
from monstertruckd.station.viewer import Viewer
from monstertruckd.tools.demo.runs import free_endpoint


@pytest.mark.parametrize(
    ("asked", "role"),
    [
        ({"do": "settings"}, AccessRole.OBSERVER),
        ({"do": "recordings"}, AccessRole.OBSERVER),
        ({"do": "explore", "order": "start"}, AccessRole.PILOT),
        ({"do": "mission", "order": "start", "text": "steps: []"}, AccessRole.PILOT),
        ({"do": "track", "points": [[0, 0], [1, 0]]}, AccessRole.PILOT),
        ({"do": "track_file", "name": "lap.csv", "text": "0,0\n1,0\n"}, AccessRole.PILOT),
        ({"do": "start_path", "path": "loop"}, AccessRole.PILOT),
        ({"do": "ask"}, AccessRole.PILOT),
        ({"do": "hand_over", "to": "bob"}, AccessRole.PILOT),
        ({"do": "acknowledge", "text": "seen"}, AccessRole.PILOT),
        ({"do": "set", "key": "gate.speed", "value": 0.1}, AccessRole.ENGINEER),
        ({"do": "delete_recording", "name": "a.mcap"}, AccessRole.ENGINEER),
    ],
)
def test_who_may_ask_for_what(asked: dict, role: AccessRole):
    assert commands.needed(commands.parse(json.dumps({"id": 1, **asked}))) is role


def test_a_drawn_line_becomes_an_even_smooth_path_with_its_own_ends():
    drawn = [(0.0, 0.0), (0.5, 0.02), (0.5, 0.02), (1.0, 0.0), (1.0, 1.0)]
    poses = drawn_path(drawn).poses.reshape(-1, 3)
    assert poses[0, :2] == pytest.approx(drawn[0])
    assert poses[-1, :2] == pytest.approx(drawn[-1])
    steps = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    assert steps.max() < 0.08
    assert np.abs(np.diff(np.unwrap(poses[:, 2]))).max() < 0.4, "the corner is rounded"
    assert poses[5, 2] == pytest.approx(0.0, abs=0.1)
    with pytest.raises(InputError, match=f"at least {SHORTEST}"):
        drawn_path([(0.0, 0.0), (0.1, 0.0)])
    with pytest.raises(InputError, match=f"at most {LONGEST_DRAWN_PATH:g}"):
        drawn_path([(0.0, 0.0), (1e12, 0.0)])


async def test_a_path_that_is_refused_by_the_station_is_answered():
    viewer = Viewer()
    pilot = Pilot(RobotAddress("truck", "tcp/127.0.0.1:1"), "page", viewer, WallClock())
    pilot._client = object()
    pilot.ask(commands.parse(json.dumps({"do": "track", "id": 7, "points": [[0, 0], [0.1, 0]]})))
    answer = await next_answer(viewer)
    assert (answer["kind"], answer["id"], answer["ok"]) == ("answer", 7, False)


@pytest.mark.parametrize("refused", [True, False])
async def test_a_drawn_path_is_answered_once_the_robot_follows_it_or_refuses_it(refused: bool):
    """The page arms after that: refused, the robot would drive along another one."""

    class Truck:
        source = "page"

        def subscribe(self, topic, delivery):
            return boxes.setdefault(topic.name, Mailbox(delivery))

        async def path(self, path):
            head = {"stamp": 0, "received": 0, "seq": 0}
            if refused:
                why = {"severity": Severity.WARNING, "reason": Reason.BUSY, "source": "page", "text": "path refused"}
                boxes[topics.EVENT.name].put(Event(**head, **why))
            else:
                boxes[topics.PATH.name].put(path)

    viewer, boxes = Viewer(), {}
    pilot = Pilot(RobotAddress("truck", "tcp/127.0.0.1:1"), "page", viewer, WallClock())
    pilot._client = Truck()
    pilot.ask(commands.parse(json.dumps({"do": "track", "id": 7, "points": [[0, 0], [1, 0]]})))
    answer = await next_answer(viewer)
    assert answer["ok"] is not refused
    assert not refused or answer["text"] == "path refused"
    boxes.clear()
    lap = {"do": "track_file", "id": 8, "name": "lap.csv", "text": "# x_m, y_m, vx_mps\n0,0,.1\n1,0,.2\n1,1,.1\n"}
    pilot.ask(commands.parse(json.dumps(lap | {"closed": True})))
    answer = await next_answer(viewer)
    assert answer["ok"] is not refused, answer
    sent = boxes[topics.PATH.name].latest
    assert refused or (sent.closed, sent.frame, sent.speeds.tolist()) == (True, "map", [0.1, 0.2, 0.1])
    pilot.ask(commands.parse(json.dumps(lap | {"text": "a,b\n"})))
    answer = await next_answer(viewer)
    assert "lap.csv:1: expected columns" in answer["text"]


async def test_a_mission_is_resumed_as_the_page_says():
    class Truck:
        async def mission(self, order, mission=None, *, moved=False):
            asked.append((order, mission, moved))
            return {"number": 1}

    viewer, asked = Viewer(), []
    pilot = Pilot(RobotAddress("truck", "tcp/127.0.0.1:1"), "page", viewer, WallClock())
    pilot._client = Truck()
    for more in ({}, {"moved": True}):
        pilot.ask(commands.parse(json.dumps({"do": "mission", "id": 7, "order": "resume", **more})))
        await shown(viewer)
    assert asked == [("resume", None, False), ("resume", None, True)]


def test_a_mission_is_read_and_a_wrong_one_refused_by_field():
    mission = read_mission("version: 2\nname: round\nsteps:\n  - {do: goto, x: 1, y: 2, yaw: 0}\n")
    assert mission.steps[0].x == 1.0
    assert read_mission("waypoints: [{x: 3, y: 2, yaw: 0}]").steps[0].x == 3.0
    for text, said in (
        ("version: 2\nname: round\nsteps: [{do: fly}]", "steps"),
        ("steps: [", "not valid YAML"),
        ("", "mission"),
        ("a: &a [1, 1]\nsteps: [*a, *a]", "alias"),
    ):
        with pytest.raises(InputError, match=said):
            read_mission(text)


class Robot:
    """Client of a robot with one recording."""

    DATA = bytes(range(256)) * 4
    LONGER = 0
    """Bytes that the robot promises beyond those it has."""
    refuses: Exception | None = None
    calls = 0

    def __init__(self, *args, **more):
        pass

    async def __aenter__(self):
        return self

    async def __aexit__(self, *error):
        pass

    async def call(self, name, payload):
        if payload["name"] != "run-000001-000.mcap":
            raise NotFoundError("none of this name")
        if self.refuses is not None:
            raise self.refuses
        Robot.calls += 1
        data = self.DATA[payload["offset"] : payload["offset"] + 300]
        return {"data": base64.b64encode(data).decode(), "bytes": len(self.DATA) + self.LONGER}


async def test_a_recording_is_downloaded_gone_on_with_and_refused_as_the_robot_says(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("monstertruckd.station.address.TruckClient", Robot)
    place = Place(port=int(free_endpoint().rpartition(":")[2]))
    station = Station([RobotAddress("truck", "tcp/127.0.0.1:1")], WallClock(), place)
    runner = aiohttp.web.AppRunner(station.application())
    await runner.setup()
    await aiohttp.web.TCPSite(runner, place.host, place.port).start()
    url = f"{place.url}robots/truck/recordings/run-000001-000.mcap"
    try:
        async with aiohttp.ClientSession() as session:

            async def get(url: str, **headers: str):
                async with session.get(url, headers=headers) as reply:
                    return SimpleNamespace(status=reply.status, headers=reply.headers, data=await reply.read())

            whole = await get(url)
            assert (whole.status, whole.data) == (200, Robot.DATA)
            assert whole.headers["Content-Length"] == "1024"
            assert whole.headers["X-Content-Type-Options"] == "nosniff"
            rest = await get(url, Range="bytes=1000-")
            assert (rest.status, rest.data) == (206, Robot.DATA[1000:])
            assert rest.headers["Content-Range"] == "bytes 1000-1023/1024"
            assert (await get(url, Range="bytes=5000-")).status == 416
            with monkeypatch.context() as patch:
                patch.setattr(Robot, "DATA", b"")
                assert (await get(url, Range="bytes=5-")).status == 416
            calls = Robot.calls
            async with session.head(url) as reply:
                assert (reply.status, reply.headers["Content-Length"]) == (200, "1024")
            assert Robot.calls == calls + 1, "who asks for the head gets no chunk"
            with monkeypatch.context() as patch:
                patch.setattr(Robot, "LONGER", 10)
                calls = Robot.calls
                with pytest.raises(aiohttp.ClientPayloadError):
                    await get(url)
                assert Robot.calls == calls + 5, "a file that became shorter is not asked for without end"
            Robot.refuses = RequestRefusedError(Reason.BUSY, "bob downloads")
            assert (await get(url)).status == 429
            Robot.refuses = None
            for wrong in ("other.mcap", "..%2F..%2Fetc%2Fpasswd", "%2e%2e%2fsecret.mcap", "run.mcap%00"):
                assert (await get(f"{place.url}robots/truck/recordings/{wrong}")).status == 404, wrong
            foreign = await get(url, Origin="http://evil.example")
            assert foreign.status == 403
    finally:
        await runner.cleanup()


async def test_a_recording_is_fetched_at_its_places_and_a_huge_one_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("monstertruckd.station.address.TruckClient", Robot)
    file, shares = tmp_path / "run.mcap", []

    async def fetch():
        address = RobotAddress("truck", "tcp/127.0.0.1:1")
        await downloads.fetch(address, "run-000001-000.mcap", "", WallClock(), file, shares.append)

    with monkeypatch.context() as patch:
        patch.setattr(downloads, "LARGEST_RECORDING", 1000)
        with pytest.raises(InputError, match="at most"):
            await fetch()
    assert not file.exists()
    file.write_bytes(Robot.DATA[:300])
    put = recordings.put

    def late(*args):  # a write that was given up by another browser ends now
        put(file, 300, Robot.DATA[300:600])
        put(*args)

    monkeypatch.setattr(recordings, "put", late)
    await fetch()
    assert (file.read_bytes(), shares[-1]) == (Robot.DATA, 1.0)


class Recorded:
    """One message of a log."""

    def __init__(self, topic, message, at):
        self.topic, self.log_time, self.payload = topic.name, at, b"x"
        self.decode = lambda: message


class RecordedDrive:
    """A log of 10 s: a pose each 0.1 s, a map at 0 and 5 s, a tile at 7 s, an event each second."""

    fault = None

    def __init__(self, _=None):
        pass

    def config(self):
        return {}

    def __iter__(self):
        for i in range(101):
            at = i * SECOND // 10
            header = {"stamp": at, "received": at, "seq": i}
            pose = Pose2D(x=i / 10, y=0.0, yaw=0.0)
            still = {"pose_covariance": np.zeros(9), "twist_covariance": np.zeros(9), "age": 0.0}
            twist = Twist2D(vx=1.0, vy=0.0, wz=0.0)
            odometry = Odometry(**header, frame="map", pose=pose, twist=twist, **still)
            yield Recorded(topics.POSE, odometry, at)
            if i in (0, 50, 70):
                width = 4 if i < 70 else 1
                grid = Grid(
                    **header,
                    frame="map",
                    resolution=0.1,
                    width=width,
                    height=1,
                    origin=Pose2D(x=float(i), y=0.0, yaw=0.0),
                    cells=np.zeros(width, np.int8),
                )
                yield Recorded(topics.MAP if i < 70 else topics.MAP_TILES, grid, at)
            if i % 10 == 0:
                event = Event(**header, reason=Reason.OK, severity=Severity.INFO, source="test", text=f"at {i // 10}")
                yield Recorded(topics.EVENT, event, at)


async def next_answer(viewer) -> dict:
    """The next frame, for which a thread may compute."""
    return json.loads(await asyncio.wait_for(viewer.next(), 10.0))


async def shown(viewer) -> list:
    """Everything that waits to be sent."""
    frames = []
    with contextlib.suppress(TimeoutError):
        while True:
            frames.append(await asyncio.wait_for(viewer.next(), 0.01))
    return [json.loads(frame) if isinstance(frame, str) else {"kind": "binary"} for frame in frames]


def of(frames: list, kind: str) -> list:
    return [frame for frame in frames if frame["kind"] == kind]


async def test_a_recording_is_played_paused_and_gone_through_by_its_time_bar():
    feed, viewer = ReplayFeed("truck run-1", Path("run-1.mcap"), RecordedDrive, WallClock()), Viewer()
    feed.attach(viewer)
    begun = await shown(viewer)
    assert of(begun, "pose")[0]["pose"][0] == 0.0
    assert of(begun, "replay")[0]["length"] == 10.0
    feed._play(2 * SECOND + SECOND // 20)
    played = await shown(viewer)
    assert of(played, "pose")[0]["pose"][0] == 2.0
    assert [frame["m"]["text"] for frame in of(played, "event")] == ["at 1", "at 2"]
    feed.control(8.0, None, None)
    jumped = await shown(viewer)
    assert jumped[0]["kind"] == "robot", "the page forgets what was"
    assert of(jumped, "pose")[0]["pose"][0] == 8.0
    assert (of(jumped, "map")[0]["origin"][0], len(of(jumped, "binary"))) == (50.0, 1), "the newest map and its change"
    assert of(jumped, "event")[-1]["m"]["text"] == "at 8"
    feed.control(1.0, False, 5.0)
    back = await shown(viewer)
    assert of(back, "map")[0]["origin"][0] == 0.0
    assert of(back, "binary") == []
    state = of(back, "replay")[-1]
    assert (state["at"], state["playing"], state["rate"]) == (1.0, False, 5.0)
    feed.detach(viewer)


async def test_a_cut_recording_is_called_so(monkeypatch):
    for fault in (None, "is damaged at byte 87 of 3000 (zeros)"):
        monkeypatch.setattr(RecordedDrive, "fault", fault)
        feed, viewer = ReplayFeed("truck run-1", Path("run-1.mcap"), RecordedDrive, WallClock()), Viewer()
        feed.attach(viewer)
        assert of(await shown(viewer), "replay")[0]["fault"] == fault


async def test_the_missing_end_of_a_recording_that_is_being_written_is_no_damage(monkeypatch):
    monkeypatch.setattr(RecordedDrive, "fault", "has no end")
    feed = ReplayFeed("truck run-1", Path("run-1.mcap"), RecordedDrive, WallClock(), growing=True)
    viewer = Viewer()
    feed.attach(viewer)
    state = of(await shown(viewer), "replay")[0]
    assert (state["growing"], state["fault"]) == (True, None)


async def test_a_damaged_event_of_a_recording_is_left_out():
    def damaged():
        raise InputError("cut off")

    feed, viewer = ReplayFeed("truck run-1", Path("run-1.mcap"), RecordedDrive, WallClock()), Viewer()
    feed._tracks[topics.EVENT.name].messages[1].decode = damaged
    feed.control(2.5, None, None)
    feed.attach(viewer)
    assert [frame["m"]["text"] for frame in of(await shown(viewer), "event")] == ["at 0", "at 2"]


async def test_a_recording_plays_by_itself_at_its_rate_to_its_end():
    feed, viewer = ReplayFeed("truck run-1", Path("run-1.mcap"), RecordedDrive, WallClock()), Viewer()
    feed.control(None, True, 20.0)
    feed.attach(viewer)
    playing = asyncio.create_task(feed.run())
    try:
        async with asyncio.timeout(10):
            while not (states := of(await shown(viewer), "replay")) or states[-1]["playing"]:
                await asyncio.sleep(0.05)
        assert states[-1]["at"] == 10.0
    finally:
        playing.cancel()


@pytest.mark.parametrize(
    ("asked", "obeyed"),
    [
        ({"do": "order", "id": 1, "order": "estop"}, True),
        ({"do": "seek", "at": 1.0}, True),
        ({"do": "watch", "robot": "truck"}, True),
        ({"do": "order", "id": 1, "order": "arm"}, False),
        ({"do": "drive", "heard": 0.0, "since": 0.0, "input": "keys", "speed": 0.1}, False),
        ({"do": "goal", "id": 1, "goal": [0, 0, 0]}, False),
        ({"do": "set", "id": 1, "key": "gate.speed", "value": 0.1}, False),
    ],
)
def test_while_a_recording_is_shown_nothing_but_a_stop_goes_to_the_robot(asked: dict, obeyed: bool):
    assert server._while_replaying(commands.parse(json.dumps(asked))) is obeyed


async def test_the_emergency_stop_of_a_recording_acts_on_its_robot_although_the_page_begins_with_it():
    station = Station([RobotAddress("ann", "tcp/127.0.0.1:1"), RobotAddress("bob", "tcp/127.0.0.1:1")], WallClock())
    station.replays["bob run-1"] = ReplayFeed("bob run-1", Path("run-1.mcap"), RecordedDrive, WallClock())
    browser = server._Browser("page", server.LOCAL, station, station._board, WallClock())
    try:
        browser.take('{"do": "watch", "robot": "bob run-1"}')
        begun = await shown(browser.viewer)
        assert of(begun, "stops") == [{"kind": "stops", "robot": "bob"}]
        browser.take('{"do": "order", "id": 5, "order": "estop"}')
        (answer,) = of(await shown(browser.viewer), "answer")
        assert answer["text"] == "no link to the robot", "and is not refused for want of one"
    finally:
        await browser.close()


async def test_a_recording_that_nobody_looks_at_makes_room_for_another(monkeypatch: pytest.MonkeyPatch):
    async def fetched(address, name, user, clock, file, progress):
        file.write_bytes(b"x")
        return recordings.Fetched(1, open=False)

    monkeypatch.setattr(server, "fetch", fetched)
    monkeypatch.setattr(server, "MOST_REPLAYS", 2)
    address, viewer = RobotAddress("truck", "tcp/127.0.0.1:1"), Viewer()
    station = Station([address], WallClock(), open_log=RecordedDrive)
    try:
        titles = [await station.replay(address, f"run-{number}.mcap", "", viewer) for number in range(2)]
        station.replays[titles[0]].attach(viewer)
        titles.append(await station.replay(address, "run-2.mcap", "", viewer))
        assert list(station.replays) == [titles[0], titles[2]]
        station.replays[titles[2]].attach(viewer)
        with pytest.raises(InputError, match="being replayed"):
            await station.replay(address, "run-3.mcap", "", viewer)
        station.replays[titles[2]].detach(viewer)

        begin = station.replays[titles[2]]._begin
        assert await station.replay(address, "run-2.mcap", "", viewer, begin + 7 * SECOND) == titles[2]
        station.replays[titles[2]].attach(viewer)
        state = of(await shown(viewer), "replay")[-1]
        assert (state["at"], state["playing"]) == (7.0, False)
        station.replays[titles[2]].detach(viewer)
        grown = station.replays[titles[2]]
        with pytest.raises(InputError, match="does not contain this time"):
            await station.replay(address, "run-2.mcap", "", viewer, begin + 70 * SECOND)
        assert station.replays[titles[2]] is not grown, "it was fetched again: it may have grown"

        def unreadable(file):
            raise InputError(f"{file.name}: no log")

        station._open_log = unreadable
        with pytest.raises(InputError, match="no log"):
            await station.replay(address, "run-4.mcap", "", viewer)
        assert list(station._folder.iterdir()) == [], "they are in memory, or cannot be shown"
    finally:
        for task in station._following.values():
            task.cancel()
        shutil.rmtree(station._folder)
