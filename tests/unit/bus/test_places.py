"""Places: sessions that hold all those of stations keep neither pilots nor the robot's own command line out."""

import asyncio
from pathlib import Path

import pytest

from monstertruck_runtime import endpoints
from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.endpoints import local_endpoints, nearest
from monstertruck_runtime.errors import NotFoundError
from monstertruck_runtime.mailbox import fifo
from monstertruck_schemas.roles import AccessRole
from monstertruck_schemas.topics import GATE, Writer
from monstertruckd.bus.port_holder import holder_of, robots_at
from tests.bus_kit import free_endpoint, gate_state, running_robot
from tests.unit.bus.test_zenoh_session import raw_session


async def test_an_emergency_stop_gets_through_when_strangers_hold_all_places():
    async with running_robot(max_sessions=3) as robot:
        robot.bus.publisher(GATE, Writer.GATE).put(gate_state(1))
        callers: list[str] = []

        async def take(payload):
            callers.append(payload["source"])
            return gate_state(2).model_dump(mode="json")

        robot.rpc.register("estop", take, AccessRole.OBSERVER)
        strangers = [await asyncio.to_thread(raw_session, robot.endpoint) for _ in range(3)]
        with pytest.raises(NotFoundError):
            async with TruckClient(endpoint=robot.endpoint, timeout=0.5):
                pass
        async with TruckClient(endpoint=nearest(robot.endpoint), timeout=1.0) as client, asyncio.timeout(3):
            assert await client.get_retained(GATE) == gate_state(1)
            assert await client.estop() == gate_state(2)
            assert callers == [client.source]
        for stranger in strangers:
            await asyncio.to_thread(stranger.close)


async def test_state_and_liveliness_are_the_same_at_every_listener():
    async with running_robot() as robot:
        socket = nearest(robot.endpoint)
        assert socket.startswith("unixsock-stream/")
        path = Path(socket.removeprefix("unixsock-stream/"))
        assert path.stat().st_mode & 0o777 == 0o660
        for endpoint in (robot.endpoint, socket):
            async with TruckClient(endpoint=endpoint) as client, asyncio.timeout(3):
                box = client.subscribe(GATE, fifo(9))
                assert await client.alive()
                robot.bus.hand_over(GATE, gate_state(7))
                assert (await box.next()).seq == 7
    assert not path.exists()


async def test_without_a_socket_there_is_none():
    async with running_robot(local_socket=False) as robot:
        assert nearest(robot.endpoint) == robot.endpoint


async def test_a_socket_left_over_is_taken_again():
    endpoint = free_endpoint()
    async with running_robot(endpoint) as robot:
        path = Path(nearest(robot.endpoint).removeprefix("unixsock-stream/"))
    path.touch()
    async with running_robot(endpoint):
        assert nearest(endpoint).startswith("unixsock-stream/")


async def test_two_daemons_on_one_computer_are_both_found(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path))
    async with running_robot() as first, running_robot(robot="second") as second:
        monkeypatch.setattr(endpoints, "DEFAULT_ENDPOINT", first.endpoint)
        found = local_endpoints()
        assert found == [nearest(first.endpoint), nearest(second.endpoint)]
        assert [await asyncio.to_thread(robots_at, endpoint) for endpoint in found] == [["truck"], ["second"]]
        assert (await asyncio.to_thread(holder_of, found)).startswith("robot 'truck', robot 'second', process ")
        other = free_endpoint()
        monkeypatch.setattr(endpoints, "DEFAULT_ENDPOINT", other)
        assert len(local_endpoints()) == 2, "nobody answers at the default port"
    assert local_endpoints() == []
    async with running_robot(local_socket=False) as foreign:
        monkeypatch.setattr(endpoints, "DEFAULT_ENDPOINT", foreign.endpoint)
        assert local_endpoints() == [foreign.endpoint], "of another user, without a socket for this one"
