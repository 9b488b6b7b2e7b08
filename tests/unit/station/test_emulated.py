"""Faults and obstacles of an emulated robot, asked for by a browser."""

from typing import Any

import pytest

from monstertruck_runtime.clock import WallClock
from monstertruck_runtime.errors import InputError
from monstertruckd.station import commands
from monstertruckd.station.emulated import EmulatedWorld
from monstertruckd.station.server import Place, Station
from tests.unit.station.test_server import NOBODY, connected, free_port, running, serving


def test_a_fault_replaces_the_one_before_and_none_ends_all():
    lines: list[str] = []
    world = EmulatedWorld(("lidar", "drive"), lambda words: lines.append(" ".join(words)))
    well = ["lidar plug", "lidar line deaf off", "lidar line flip_rate 0"]
    world.inject("lidar", "unplugged")
    assert lines == [*well, "lidar unplug"]
    lines.clear()
    world.inject("lidar", "none")
    assert lines == well
    assert world.state() == {"faults": {"lidar": "none", "drive": "none"}, "obstacles": []}


def test_what_is_refused_changes_nothing():
    def refuse(_: list[str]) -> None:
        raise InputError("the robot is there")

    world = EmulatedWorld(("lidar",), refuse)
    with pytest.raises(InputError, match="'usb': expected one of lidar"):
        world.inject("usb", "deaf")
    with pytest.raises(InputError, match="the robot is there"):
        world.place((1.0, 2.0))
    assert world.state() == {"faults": {"lidar": "none"}, "obstacles": []}


@pytest.mark.parametrize("text", ['{"device": "a", "fault": "rm -rf"}', '{"device": "a"}'])
def test_only_known_faults_are_read(text: str):
    with pytest.raises(InputError):
        commands.parse('{"do": "fault", "id": 1, ' + text[1:])


async def test_every_browser_sees_what_one_of_them_changed():
    lines: list[str] = []
    world = EmulatedWorld(("lidar",), lambda words: lines.append(" ".join(words)))
    station = Station([NOBODY], WallClock(), Place(port=free_port()), emulated=world)
    async with running(station) as session, connected(station, session) as one, connected(station, session) as other:
        heard: dict[str, dict[str, Any]] = {}
        await one.send_json({"do": "fault", "id": 1, "device": "lidar", "fault": "deaf"})
        await one.send_json({"do": "obstacle", "id": 2, "at": [1.0, 2.5]})
        while heard.get("answer", {}).get("id") != 2:
            message = await one.receive_json()
            heard[message["kind"]] = message
        assert heard["answer"]["ok"]
        while True:
            message = await other.receive_json()
            if message["kind"] == "emulated" and message.get("obstacles"):
                break
        assert message == {"kind": "emulated", "faults": {"lidar": "deaf"}, "obstacles": [[1.0, 2.5]]}
        await one.send_json({"do": "obstacle", "id": 3, "at": None})
        while (message := await other.receive_json()).get("obstacles") != []:
            pass
    assert lines[-2:] == ["room post 1.0 2.5", "room clear"]


async def test_a_station_of_real_robots_refuses():
    async with serving() as (station, session), connected(station, session) as socket:
        await socket.send_json({"do": "obstacle", "id": 1, "at": [1.0, 2.5]})
        while (message := await socket.receive_json())["kind"] != "answer":
            assert message["kind"] != "emulated"
        assert (message["ok"], message["text"]) == (False, "no robot of this station is emulated")
