"""All robots at a glance: rows of those that answer, and of those that are gone."""

import asyncio
import json
from contextlib import contextmanager
from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest

from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import VirtualClock, WallClock, run_virtual
from monstertruck_runtime.errors import NotPermittedError
from monstertruck_schemas.roles import AccessRole
from monstertruck_schemas.sensor import Battery, BatteryLevel
from monstertruck_schemas.topics import GATE, POSE, Writer
from monstertruckd.station import fleet
from monstertruckd.station.address import RobotAddress
from monstertruckd.station.feed import RobotFeed
from monstertruckd.station.fleet import FleetBoard, RobotSnapshot
from monstertruckd.station.viewer import Viewer
from tests.bus_kit import gate_state, odometry, running_robot

GATE_FACTS = ("speed", "reverse_speed", "angle", "tilt", "leases")


async def _answer(value: dict[str, Any], _: dict[str, Any]) -> dict[str, Any]:
    return value


async def rows_of(viewer: Viewer) -> dict[str, dict[str, Any]]:
    frame = json.loads(await viewer.next())
    assert frame["kind"] == "fleet"
    return {row["name"]: row for row in frame["robots"]}


async def until(viewer: Viewer, condition) -> dict[str, dict[str, Any]]:
    async with asyncio.timeout(10):
        while not condition(rows := await rows_of(viewer)):
            pass
    return rows


async def test_every_robot_has_a_row_and_one_that_is_gone_keeps_its_last_place(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(fleet, "FLEET_PERIOD", 0.05)
    monkeypatch.setattr("monstertruckd.station.feed.PING", 0.1)
    clock = WallClock()
    async with running_robot(robot="ann") as robot:
        robot.bus.publisher(GATE, Writer.GATE).put(gate_state(1))
        robot.rpc.register("config", partial(_answer, {"gate": dict.fromkeys(GATE_FACTS, 0.1)}), AccessRole.OBSERVER)
        robot.rpc.register("versions", partial(_answer, {}), AccessRole.OBSERVER)
        poses = robot.bus.publisher(POSE, Writer.ESTIMATION)
        feeds = {
            name: RobotFeed(RobotAddress(name, endpoint), clock)
            for name, endpoint in (("ann", robot.endpoint), ("nobody", "tcp/127.0.0.1:1"))
        }
        board, viewer = FleetBoard(feeds, clock), Viewer()
        jobs = [asyncio.create_task(each.run()) for each in (*feeds.values(), board)]
        try:
            board.show(viewer, True)
            rows = await until(viewer, lambda rows: rows["ann"]["alive"])
            assert (rows["ann"]["mode"], rows["ann"]["pose"]) == ("armed", None)
            assert (rows["nobody"]["alive"], rows["nobody"]["mode"]) == (False, None)

            def driven(rows: dict[str, dict[str, Any]]) -> bool:
                poses.put(odometry(1, x=1.5))
                return rows["ann"]["pose"] is not None

            rows = await until(viewer, driven)
            assert rows["ann"]["pose"] == [1.5, 2.0, 0.0]
            assert not rows["ann"]["old"]
            await robot.bridge.close()
            rows = await until(viewer, lambda rows: not rows["ann"]["alive"])
            assert rows["ann"]["old"]
            assert rows["ann"]["pose"] == [1.5, 2.0, 0.0]
            board.show(viewer, False)
            await asyncio.sleep(0.15)
            viewer.forget()
            with pytest.raises(TimeoutError):
                async with asyncio.timeout(0.15):
                    await viewer.next()
        finally:
            for job in jobs:
                job.cancel()
            await asyncio.gather(*jobs, return_exceptions=True)


def test_a_battery_of_which_nothing_is_heard_any_longer_is_unknown():
    charged = Battery(stamp=5, received=5, seq=0, voltage=24.8, raw_voltage=24.8, cells=6, level=BatteryLevel.NORMAL)
    battery = SimpleNamespace(latest=charged)

    class Client:
        @contextmanager
        def watch(self, topic):
            yield SimpleNamespace(latest=None) if topic is POSE else battery

    async def main(clock: VirtualClock) -> None:
        snapshot = RobotSnapshot(Client(), clock)  # type: ignore[arg-type]
        assert snapshot.row()["voltage"] == 24.8
        await clock.sleep(1.0)
        battery.latest = charged.model_copy(update={"stamp": 6})
        assert snapshot.row()["voltage"] == 24.8
        await clock.sleep(1.9)
        assert snapshot.row()["voltage"] == 24.8
        await clock.sleep(0.2)
        row = snapshot.row()
        assert (row["voltage"], row["level"], row["old"]) == (None, None, True)

    run_virtual(main)


async def test_no_session_that_closes_is_offered(monkeypatch: pytest.MonkeyPatch):
    """A look at the fleet in that moment would end the looking for good."""
    offered = []

    class Client:
        def __init__(self, *_, **__):
            pass

        async def __aenter__(self):
            return self

        async def __aexit__(self, *_):
            offered.append(feed.client)

        async def get_retained(self, _):
            raise NotPermittedError("not for you")

        call = get_retained

        def subscribe(self, *_):
            raise NotPermittedError("not for you")

    monkeypatch.setattr("monstertruckd.station.feed.TruckClient", Client)
    feed = RobotFeed(RobotAddress("ann", "tcp/127.0.0.1:1"), WallClock())
    feed.attach(Viewer())
    running = asyncio.create_task(feed.run())
    try:
        async with asyncio.timeout(3):
            while not offered:
                await asyncio.sleep(0.01)
    finally:
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
    assert offered == [None]


async def test_a_watched_topic_is_decoded_when_it_is_asked_for(monkeypatch: pytest.MonkeyPatch):
    async with running_robot() as robot, TruckClient(endpoint=robot.endpoint) as client:
        poses = robot.bus.publisher(POSE, Writer.ESTIMATION)
        with client.watch(POSE) as watched:
            assert watched.latest is None
            await asyncio.sleep(0.05)
            for number in range(20):
                poses.put(odometry(number))
            async with asyncio.timeout(3):
                while watched.latest != odometry(19):
                    await asyncio.sleep(0.01)
            assert watched.latest is watched.latest
        poses.put(odometry(30))
        await asyncio.sleep(0.05)
        assert watched.latest == odometry(19)
