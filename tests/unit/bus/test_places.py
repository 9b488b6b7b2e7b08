"""Places: sessions that hold all those of stations keep neither pilots nor the robot's own command line out."""

import asyncio
from pathlib import Path

import pytest

from monstertruck_runtime import endpoints
from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.endpoints import announce, announced_ports, local_endpoints, nearest, port_of
from monstertruck_runtime.errors import NotFoundError
from monstertruck_runtime.mailbox import fifo
from monstertruck_runtime.robots import robots_at
from monstertruck_schemas.roles import AccessRole
from monstertruck_schemas.topics import GATE, Writer
from monstertruckd.bus.port_holder import holder_of
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
    monkeypatch.setattr(endpoints, "announced_ports", set)  # those of other tests
    async with running_robot() as first, running_robot(robot="second") as second:
        monkeypatch.setattr(endpoints, "DEFAULT_ENDPOINT", first.endpoint)
        found = local_endpoints()
        assert found == [nearest(first.endpoint), nearest(second.endpoint)]
        assert [await asyncio.to_thread(robots_at, endpoint) for endpoint in found] == [["truck"], ["second"]]
        assert (await asyncio.to_thread(holder_of, found)).startswith("robot 'truck', robot 'second', process ")
        other = free_endpoint()
        monkeypatch.setattr(endpoints, "DEFAULT_ENDPOINT", other)
        assert sorted(local_endpoints()) == sorted(found), "nobody answers at the default port"
    assert local_endpoints() == []


async def test_daemons_of_other_users_are_found_by_what_they_announce(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """This user may not look into the folder of their sockets."""
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path / "theirs"))
    async with running_robot(robot="second") as foreign:
        monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path / "ours"))
        assert foreign.endpoint in local_endpoints()
        assert await asyncio.to_thread(robots_at, foreign.endpoint) == ["second"]
        (again,) = announce([foreign.endpoint, free_endpoint()])
        again.close()
    assert foreign.endpoint not in local_endpoints()


def test_only_what_can_be_asked_from_this_computer_is_announced():
    free = port_of(free_endpoint())
    before = announced_ports()
    assert announce([f"tls/127.0.0.1:{free}", f"tcp/192.0.2.7:{free}", f"unixsock-stream//run/{free}.sock"]) == []
    for host in ("0.0.0.0", "[::]", "localhost"):
        (held,) = announce([f"tcp/{host}:{free}"])
        with held:
            assert announced_ports() >= {str(free)}
    assert str(free) not in before | announced_ports()


def test_a_computer_without_the_kernels_table_shows_none(tmp_path: Path):
    assert announced_ports(tmp_path / "unix") == set()
