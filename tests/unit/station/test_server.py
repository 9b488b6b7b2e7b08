"""The station's web server against browsers and against others; no robot is there."""

import asyncio
import contextlib
import json
import logging
from collections.abc import AsyncIterator, Sequence
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from typing import Any

import aiohttp
import pytest
import zenoh
from yarl import URL

from monstertruck_runtime.clock import WallClock
from monstertruck_runtime.errors import BusyError, InputError
from monstertruckd.station import commands, remarks, server
from monstertruckd.station.address import RobotAddress
from monstertruckd.station.server import Place, Station
from monstertruckd.tools.demo.runs import free_endpoint

BURST, MOST_PEERS = 20, 32

NOBODY = RobotAddress("truck", "tcp/127.0.0.1:1")


def free_port() -> int:
    return int(free_endpoint().rpartition(":")[2])


@asynccontextmanager
async def serving(
    robots: Sequence[RobotAddress] = (NOBODY,), routers: Sequence[str] = ()
) -> AsyncIterator[tuple[Station, aiohttp.ClientSession]]:
    station = Station(robots, WallClock(), Place(port=free_port()), routers)
    async with running(station) as session:
        yield station, session


@asynccontextmanager
async def running(station: Station) -> AsyncIterator[aiohttp.ClientSession]:
    ready = asyncio.Event()
    serves = asyncio.create_task(station.run(ready.set))
    try:
        await ready.wait()
        async with aiohttp.ClientSession(station.place.url) as session:
            yield session
    finally:
        serves.cancel()
        await asyncio.gather(serves, return_exceptions=True)


def connected(station: Station, session: aiohttp.ClientSession) -> AbstractAsyncContextManager[Any]:
    return session.ws_connect("/socket", origin=station.place.url.rstrip("/"))


async def test_the_page_its_files_and_texts_are_served_with_a_policy_that_lets_nothing_else_in():
    async with serving() as (_, session):
        for path in ("/", "/page/main.js", "/page/style.css", "/page/truck.svg", "/strings.json"):
            async with session.get(path) as reply:
                assert reply.status == 200, path
                assert "default-src 'self'" in reply.headers["Content-Security-Policy"]
                assert "://" not in (await reply.text()).replace("http://www.w3.org/", ""), "no request leaves the page"
        async with session.get("/strings.json") as reply:
            assert "reason.scan_stale" in await reply.json()


async def test_what_is_no_file_of_the_page_and_no_recording_is_not_found_and_who_tries_is_logged(
    caplog: pytest.LogCaptureFixture,
):
    recordings = ("..%2f..%2fetc%2fpasswd", "..%5crun.mcap", "%2fetc%2fshadow.mcap", "run.mcap%00", "..%2frun.mcap")
    async with serving() as (_, session):
        for name in recordings:
            path = URL(f"/robots/truck/recordings/{name}", encoded=True)
            async with session.get(path, allow_redirects=False) as reply:
                assert reply.status == 404, name
        for path in (
            "..%2fserver.py",
            "%2e%2e/server.py",
            "strings%2fen.json",
            "..%5cserver.py",
            "x.js",
            "../../etc/passwd",
        ):
            async with session.get(URL(f"/page/{path}", encoded=True), allow_redirects=False) as reply:
                assert reply.status == 404, path
        for path in ("/robots/a/map/1", "/robots/truck/map/1", "/etc"):
            async with session.get(path) as reply:
                assert reply.status == 404, path
    refused = [text for record in caplog.records if "refused" in (text := record.getMessage())]
    assert len(refused) == len(recordings)
    assert "/robots/truck/recordings/..%2f..%2fetc%2fpasswd from 127.0.0.1 refused: expected" in refused[0]


async def test_other_sites_and_other_names_are_refused_and_logged(caplog: pytest.LogCaptureFixture):
    async with serving() as (station, session):
        ours = f"127.0.0.1:{station.place.port}"
        for path, headers in (
            ("/", {"Host": "evil.example"}),
            ("/socket", {"Origin": "http://evil.example"}),
            ("/socket", {}),
            ("/socket", {"Origin": f"http://{ours}.evil.example"}),
            ("/robots/truck/recordings/run.mcap", {"Origin": "http://evil.example"}),
            ("/socket", {"Origin": f"https://{ours}"}),
            ("/robots/truck/recordings/run.mcap", {"Sec-Fetch-Site": "cross-site"}),
            ("/robots/truck/map/1", {"Sec-Fetch-Site": "same-site"}),
        ):
            async with session.get(path, headers=headers) as reply:
                assert reply.status == 403, (path, headers)
        assert caplog.text.count("refused") == 8
        async with session.get("/", headers={"Sec-Fetch-Site": "cross-site"}) as reply:
            assert reply.status == 200, "a link to the page"
        for method in ("POST", "PUT", "DELETE"):
            async with session.request(method, "/robots/truck/recordings/run.mcap", data=b"x=1") as reply:
                assert reply.status == 405, "what a form of another site can send changes nothing"
        assert "127.0.0.1" in caplog.text
        async with session.ws_connect("/socket", origin=f"http://{ours}") as socket:
            assert (await socket.receive_json())["kind"] == "hello"
            assert (await socket.receive_json())["names"] == ["truck"]


async def test_a_browser_is_answered_although_the_robot_is_absent_and_wrong_messages_are_refused():
    async with serving() as (station, session), connected(station, session) as socket:
        hello = await socket.receive_json()
        assert hello["kind"] == "hello"
        await socket.receive_json()
        await socket.send_json({"do": "order", "id": 1, "order": "estop"})
        assert (await socket.receive_json())["id"] == 1, "whatever is asked is answered"
        assert (await socket.receive_json())["kind"] == "trouble"
        await socket.send_json({"do": "watch", "robot": "truck"})
        await socket.send_json({"do": "order", "id": 2, "order": "estop"})
        await socket.send_json({"do": "ping", "at": 12.5})
        kinds = {}
        while "pong" not in kinds or "answer" not in kinds:
            message = await socket.receive_json()
            kinds[message["kind"]] = message
        assert kinds["answer"] == {
            "kind": "answer",
            "id": 2,
            "ok": False,
            "reason": "not_found",
            "text": "no link to the robot",
        }


async def test_an_oversized_message_ends_the_connection(caplog: pytest.LogCaptureFixture):
    async with serving() as (station, session):
        async with connected(station, session) as socket:
            await socket.receive_json()
            await socket.receive_json()
            await socket.send_str(json.dumps({"do": "x" * commands.LONGEST_MESSAGE}))
            ended = await socket.receive()
            assert ended.type is aiohttp.WSMsgType.CLOSE
            assert ended.data == 1009
        async with asyncio.timeout(5):
            while "exceeds" not in caplog.text:
                await asyncio.sleep(0.01)


async def test_a_taken_port_and_two_robots_of_one_name_are_refused():
    async with serving() as (station, _):
        with pytest.raises(BusyError, match=str(station.place.port)):
            await Station([NOBODY], WallClock(), station.place).run()
    with pytest.raises(InputError, match="the same name"):
        Station([NOBODY, NOBODY], WallClock())


async def test_robots_of_a_router_appear_in_every_browser():
    endpoint = free_endpoint()
    scouting = {"multicast": {"enabled": False}, "gossip": {"enabled": False}}
    config = {"mode": "router", "listen": {"endpoints": [endpoint]}, "scouting": scouting}
    with zenoh.open(zenoh.Config.from_json5(json.dumps(config))) as router:
        first = router.liveliness().declare_token("mt/ann/alive")
        async with serving([], [endpoint]) as (station, session), connected(station, session) as socket:
            names: list[str] = []
            async with asyncio.timeout(20):
                while names != ["ann"]:
                    names = (await socket.receive_json()).get("names", names)
                second = await asyncio.to_thread(router.liveliness().declare_token, "mt/bob/alive")
                while names != ["ann", "bob"]:
                    names = (await socket.receive_json()).get("names", names)
        second.undeclare()
        first.undeclare()


async def test_browsers_are_bounded_and_one_that_goes_leaves_its_place(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(server, "MOST_BROWSERS", 2)
    async with serving() as (station, session):
        async with connected(station, session), connected(station, session):
            with pytest.raises(aiohttp.WSServerHandshakeError, match="503"):
                async with connected(station, session):
                    pass
        async with asyncio.timeout(5):
            while station._browsers:
                await asyncio.sleep(0.01)
        async with connected(station, session) as socket:
            assert (await socket.receive_json())["kind"] == "hello"


async def test_rubbish_of_a_browser_costs_a_few_lines_and_how_many_more_there_were_is_reported(
    caplog: pytest.LogCaptureFixture,
):
    count = 10 * BURST
    async with serving() as (station, session), connected(station, session) as socket:
        for _ in range(count):
            await socket.send_str('{"do":"\\u001b[2J\\nfaked line"}')
        answers = 0
        while answers < count:
            message = await socket.receive_json()
            answers += message["kind"] == "trouble"
        async with session.get("/", headers={"Host": "elsewhere.example"}):
            pass
    reported = [text for text in caplog.messages if text.endswith("further lines not logged")]
    assert len(reported) == 1
    left_out = int(reported[0].removeprefix("127.0.0.1: ").split()[0])
    assert left_out == count + 3 - BURST, "with those of who came, went and was refused"
    assert len(caplog.messages) <= BURST + 1
    assert all(text.isprintable() for text in caplog.messages)


async def test_lines_are_counted_for_each_address_and_anew_after_a_while(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
):
    made = remarks.Remarks(logging.getLogger("station"), window=0.05)
    for number in range(3 * MOST_PEERS):
        made.add(f"10.0.0.{number}", f"line of {number}")
    assert len(caplog.messages) == MOST_PEERS + BURST
    caplog.clear()
    await asyncio.sleep(0.1)
    assert caplog.messages == [f"other addresses: {2 * MOST_PEERS - BURST} further lines not logged"]
    made.add("10.0.0.95", "again\x1b]0;title\x07\nfaked")
    assert caplog.messages[-1] == r"again\x1b]0;title\x07\nfaked"
    made.add("10.0.0.95", "x" * 10_000)
    assert len(caplog.messages[-1]) < 600
    made.tell()


async def test_what_is_no_request_of_http_costs_no_line_each(caplog: pytest.LogCaptureFixture):
    async with serving() as (station, _):
        for rubbish in (
            b"\x00\xff\n\n",
            b"GET / HTTP/9.9\r\n\r\n",
            b"GET / HTTP/1.1\r\nA: " + 20_000 * b"a" + b"\r\n\r\n",
        ):
            for _ in range(2 * BURST):
                reader, writer = await asyncio.open_connection("127.0.0.1", station.place.port)
                writer.write(rubbish)
                with contextlib.suppress(ConnectionError):
                    await reader.read()
                writer.close()
    assert len(caplog.messages) <= BURST + 1


async def test_a_browser_that_sends_too_much_waits_and_others_do_not(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(server, "MESSAGES", 40.0)
    async with (
        serving() as (station, session),
        connected(station, session) as flooding,
        connected(station, session) as other,
    ):
        for number in range(100):
            await flooding.send_json({"do": "ping", "at": number})
        await other.send_json({"do": "ping", "at": 1000})
        answered = 0

        async def answers() -> None:
            nonlocal answered
            while True:
                answered += (await flooding.receive_json())["kind"] == "pong"

        async with asyncio.timeout(5):
            while (await other.receive_json()).get("at") != 1000:
                pass
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(0.3):
                await answers()
        assert 40 <= answered < 90, "the rest waits, and is lost no more than slowed down"


async def test_connections_of_one_address_have_an_end_and_those_that_were_there_stay(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    monkeypatch.setattr(server, "MOST_CONNECTIONS", 5)
    monkeypatch.setattr(server, "CHECK_PERIOD", 0.05)
    async with serving() as (station, session), connected(station, session) as socket:
        crowd = [await asyncio.open_connection("127.0.0.1", station.place.port) for _ in range(20)]
        async with asyncio.timeout(5):
            await asyncio.gather(*(reader.read() for reader, _ in crowd[5:]))
        await socket.send_json({"do": "ping", "at": 7})
        while (await socket.receive_json()).get("at") != 7:
            pass
        for _, writer in crowd:
            writer.close()
    assert "connections from 127.0.0.1" in caplog.text
