"""What the page asks beyond driving: paths that are drawn, missions, settings, recordings."""

import base64
import json
from types import SimpleNamespace

import aiohttp
import numpy as np
import pytest

from monstertruck_runtime.clock import WallClock
from monstertruck_runtime.errors import InputError, NotFoundError, RequestRefusedError
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.roles import AccessRole
from monstertruckd.station import commands, downloads
from monstertruckd.station.address import RobotAddress
from monstertruckd.station.pilot import SHORTEST, drawn_path, read_mission
from monstertruckd.station.server import Place, Station
from monstertruckd.tools.demo.runs import free_endpoint


@pytest.mark.parametrize(
    ("asked", "role"),
    [
        ({"do": "settings"}, AccessRole.OBSERVER),
        ({"do": "recordings"}, AccessRole.OBSERVER),
        ({"do": "explore", "order": "start"}, AccessRole.PILOT),
        ({"do": "mission", "order": "start", "text": "steps: []"}, AccessRole.PILOT),
        ({"do": "track", "points": [[0, 0], [1, 0]]}, AccessRole.PILOT),
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


def test_a_mission_is_read_and_a_wrong_one_refused_by_field():
    mission = read_mission("version: 2\nname: round\nsteps:\n  - {do: goto, x: 1, y: 2, yaw: 0}\n")
    assert mission.steps[0].x == 1.0
    for text, said in (
        ("version: 2\nname: round\nsteps: [{do: fly}]", "steps"),
        ("steps: [", "not valid YAML"),
        ("", "mission"),
    ):
        with pytest.raises(InputError, match=said):
            read_mission(text)


class Robot:
    """Client of a robot with one recording."""

    DATA = bytes(range(256)) * 4
    refuses: Exception | None = None

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
        data = self.DATA[payload["offset"] : payload["offset"] + 300]
        return {"data": base64.b64encode(data).decode(), "bytes": len(self.DATA)}


async def test_a_recording_is_downloaded_gone_on_with_and_refused_as_the_robot_says(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(downloads, "TruckClient", Robot)
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
            Robot.refuses = RequestRefusedError(Reason.BUSY, "bob downloads")
            assert (await get(url)).status == 429
            Robot.refuses = None
            for wrong in ("other.mcap", "..%2F..%2Fetc%2Fpasswd", "%2e%2e%2fsecret.mcap", "run.mcap%00"):
                assert (await get(f"{place.url}robots/truck/recordings/{wrong}")).status == 404, wrong
            foreign = await get(url, Origin="http://evil.example")
            assert foreign.status == 403
    finally:
        await runner.cleanup()
