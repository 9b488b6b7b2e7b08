"""Places: sessions that hold all those of stations keep neither pilots nor the robot's own command line out."""

import asyncio
import socket
import threading
from pathlib import Path

import pytest

from monstertruck_runtime import endpoints, robots
from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.endpoints import Announced, announce, announced, local_endpoints, nearest, port_of
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
    monkeypatch.setattr(endpoints, "announced", list)  # those of other tests
    async with running_robot() as first, running_robot(robot="second") as second:
        found = local_endpoints(near=first.endpoint)
        assert found == [nearest(first.endpoint), nearest(second.endpoint)]
        assert [await asyncio.to_thread(robots_at, endpoint) for endpoint in found] == [["truck"], ["second"]]
        assert (await asyncio.to_thread(holder_of, found)).startswith("robot 'truck', robot 'second', process ")
        other = free_endpoint()
        assert sorted(local_endpoints(near=other)) == sorted(found), "nobody answers at this port"
    assert local_endpoints(near=other) == []


async def test_daemons_of_other_users_are_found_by_what_they_announce(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """This user may not look into the folder of their sockets."""
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path / "theirs"))
    async with running_robot(robot="second") as foreign:
        monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path / "ours"))
        assert foreign.endpoint in local_endpoints()
        assert await asyncio.to_thread(robots_at, foreign.endpoint) == ["second"]
        assert announce("second", [foreign.endpoint]) is None, "it holds its name"
    assert foreign.endpoint not in local_endpoints()


def test_only_what_can_be_asked_from_this_computer_is_announced():
    free = port_of(free_endpoint())
    assert announce("a", [f"tcp/192.0.2.7:{free}", f"unixsock-stream//run/{free}.sock"]) is None
    for host in ("0.0.0.0", "[::]", "localhost"):
        for protocol in ("tcp", "tls"):
            with announce("rover-1_b", [f"udp/{host}:1", f"{protocol}/{host}:{free}", "tcp/localhost:1"]):
                (shown,) = [one for one in announced() if one.port == free]
                assert shown == (free, protocol, "rover-1_b", (1,))
                assert shown.endpoint == f"{protocol}/127.0.0.1:{free}"
    assert free not in {one.port for one in announced()}


def test_a_daemon_with_several_local_endpoints_is_found_once(tmp_path: Path):
    where = {"RUNTIME_DIRECTORY": str(tmp_path)}
    with socket.create_server(("127.0.0.1", 0)) as one, socket.create_server(("127.0.0.1", 0)) as other:
        first, second = one.getsockname()[1], other.getsockname()[1]
        with announce("rover", [f"tls/127.0.0.1:{first}", f"tcp/127.0.0.1:{second}"]):
            ends = {f"tls/127.0.0.1:{first}", f"tcp/127.0.0.1:{second}"}
            assert ends & {*local_endpoints(where)} == {f"tls/127.0.0.1:{first}"}
            near = f"tcp/127.0.0.1:{second}"
            assert ends & {*local_endpoints(where, near=near)} == {near}, "where the caller is already"
            with socket.socket(socket.AF_UNIX) as unix:
                unix.bind(str(tmp_path / f"{second}.sock"))
                unix.listen()
                here = f"unixsock-stream/{tmp_path}/{second}.sock"
                assert {*ends, here} & {*local_endpoints(where)} == {here}


@pytest.mark.parametrize("name", ["7447", "7447,/tcp/truck", "x/tcp/truck", "7447/tcp/", "7447/udp/truck", "7447/tcp"])
def test_names_that_are_no_daemons_are_passed_over(tmp_path: Path, name: str):
    table = tmp_path / "unix"
    rows = (f"0: 00000002 00000000 00010000 0001 01 42 @monstertruckd/{each}" for each in (name, "7448/tls/rover"))
    table.write_text("\n".join(("Num RefCount Protocol Flags Type St Inode Path", *rows, "")))
    assert announced(table) == [Announced(7448, "tls", "rover")]


def test_a_computer_without_the_kernels_table_shows_none(tmp_path: Path):
    assert announced(tmp_path / "unix") == []


def test_all_robots_of_this_computer_are_asked_at_once(monkeypatch: pytest.MonkeyPatch):
    """A program at such a port that does not answer costs its timeout once, however many there are."""
    monkeypatch.setattr(robots, "local_endpoints", lambda near: ["tcp/a:1", "tcp/b:2", "tcp/c:3"])
    together = threading.Barrier(3, timeout=5)

    def asked(endpoint: str) -> list[str]:
        together.wait()
        return [endpoint[4]]

    monkeypatch.setattr(robots, "robots_at", asked)
    assert robots.robots_here() == [("a", "tcp/a:1"), ("b", "tcp/b:2"), ("c", "tcp/c:3")]
