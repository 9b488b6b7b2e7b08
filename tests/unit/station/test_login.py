"""The page beyond this machine: TLS, logins, roles."""

import asyncio
import base64
import contextlib
import json
import ssl
from functools import partial
from pathlib import Path
from unittest.mock import Mock

import aiohttp
import pytest

from monstertruck_runtime.clock import WallClock
from monstertruck_runtime.errors import InputError, NotFoundError, NotPermittedError
from monstertruck_schemas.roles import AccessRole
from monstertruckd.station import listener, users
from monstertruckd.station import server as server_module
from monstertruckd.station.address import RobotAddress
from monstertruckd.station.server import Place, Station
from monstertruckd.station.users import StationUsers, add_user
from tests.unit.station.certificate import self_signed
from tests.unit.station.test_server import free_port

MOST_ATTEMPTS = 16


def basic(name: str, password: str) -> str:
    return "Basic " + base64.b64encode(f"{name}:{password}".encode()).decode()


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(users, "WRONG_PASSWORD_PAUSE", 0.01)
    monkeypatch.setattr(users, "COST", users.COST | {"n": 2**8})
    made = tmp_path / "users.yaml"
    add_user(made, "ann", AccessRole.PILOT, "correct horse")
    add_user(made, "olga", AccessRole.OBSERVER, "battery staple")
    return made


def test_a_page_for_other_machines_needs_tls_and_users(file: Path):
    known = StationUsers(file)
    for tls, who in ((None, None), (None, known), (ssl.create_default_context(ssl.Purpose.CLIENT_AUTH), None)):
        with pytest.raises(NotPermittedError, match=r"0\.0\.0\.0"):
            Place("0.0.0.0", tls=tls, users=who)


async def test_who_logs_in_and_who_does_not(file: Path):
    known = StationUsers(file)

    async def who(name: str, password: str) -> AccessRole | None:
        user = await known.who(basic(name, password))
        return None if user is None else user.role

    assert await who("ann", "correct horse") is AccessRole.PILOT
    assert await who("ann", "correct horse") is AccessRole.PILOT
    assert await who("olga", "battery staple") is AccessRole.OBSERVER
    assert await who("ann", "battery staple") is None
    assert await who("bob", "") is None
    for header in (None, "", "Basic", "Basic ???", "Bearer x", "Basic " + "A" * 2000):
        assert await known.who(header) is None


async def test_whoever_guesses_holds_up_nobody_at_another_address(file: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(users, "WRONG_PASSWORD_PAUSE", 60.0)
    known = StationUsers(file)
    guesses = [asyncio.create_task(known.who(basic("ann", str(number)), "10.0.0.9")) for number in range(20)]
    await asyncio.sleep(0.05)
    async with asyncio.timeout(10):
        assert await known.who(basic("ann", "correct horse"), "10.0.0.1") is not None
    for guess in guesses:
        guess.cancel()
    await asyncio.gather(*guesses, return_exceptions=True)
    assert known._turns == {}


async def test_guesses_of_one_network_wait_in_one_queue_which_has_an_end(file: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(users, "WRONG_PASSWORD_PAUSE", 60.0)
    known = StationUsers(file)
    addresses = [f"2001:db8::{number:x}" for number in range(2 * MOST_ATTEMPTS)]
    guesses = [asyncio.create_task(known.who(basic("ann", address), address)) for address in addresses]
    await asyncio.sleep(0.05)
    assert list(known._turns) == ["2001:db8::/64"]
    assert [guess.done() for guess in guesses].count(True) == MOST_ATTEMPTS
    for guess in guesses:
        guess.cancel()
    await asyncio.gather(*guesses, return_exceptions=True)


async def test_the_file_of_users_is_read_again_when_it_changes(file: Path, caplog: pytest.LogCaptureFixture):
    known = StationUsers(file)
    ann, olga = [await known.who(basic(*each)) for each in (("ann", "correct horse"), ("olga", "battery staple"))]
    assert ann is not None
    assert olga is not None
    assert not await known.refresh()
    add_user(file, "bob", AccessRole.PILOT, "long enough")
    assert await known.refresh()
    assert await known.who(basic("bob", "long enough")) is not None
    assert known.stands(ann)
    add_user(file, "ann", AccessRole.OBSERVER, "correct horse")
    assert await known.refresh()
    assert not known.stands(ann), "another role"
    add_user(file, "olga", AccessRole.OBSERVER, "another staple")
    assert await known.refresh()
    assert not known.stands(olga), "another password"
    assert await known.who(basic("olga", "battery staple")) is None
    texts = (partial(file.write_text, text) for text in ("- ann\n", ""))
    for damage in (*texts, lambda: file.chmod(0o644), file.unlink):
        damage()
        assert not await known.refresh()
        assert caplog.messages[-1].startswith(f"the user list is unchanged: {file}")
    assert await known.who(basic("bob", "long enough")) is not None


async def test_a_file_of_users_that_could_not_be_read_is_read_again(file: Path, monkeypatch: pytest.MonkeyPatch):
    known = StationUsers(file)
    add_user(file, "bob", AccessRole.PILOT, "long enough")
    with monkeypatch.context() as broken:
        broken.setattr(users, "_rows", Mock(side_effect=OSError("too many open files")))
        assert not await known.refresh()
    assert await known.refresh()
    assert await known.who(basic("bob", "long enough")) is not None


def test_a_file_of_users_is_private_and_wrong_ones_are_refused(file: Path, tmp_path: Path):
    assert file.stat().st_mode & 0o777 == 0o600
    assert "correct horse" not in file.read_text()
    file.chmod(0o640)
    with pytest.raises(NotPermittedError, match="chmod 600"):
        StationUsers(file)
    with pytest.raises(NotFoundError, match="--add-user"):
        StationUsers(tmp_path / "none.yaml")
    wrong = tmp_path / "wrong.yaml"
    short = f"ann: {{role: pilot, password: '{'0' * 64}:{'é' * 64}'}}\n"
    for text, fault in (
        ("ann: {role: queen, password: x}\n", "ann: expected a role"),
        (short, "ann: expected a role"),
        ("- ann\n", "expected users by name"),
        ("7: {role: pilot, password: x}\n", "expected users by name"),
    ):
        wrong.write_text(text)
        wrong.chmod(0o600)
        with pytest.raises(InputError, match=fault):
            StationUsers(wrong)
    wrong.write_text("- ann\n")
    with pytest.raises(InputError, match="expected users by name"):
        add_user(wrong, "ann", AccessRole.PILOT, "long enough")
    for name, password, fault in (("a/b", "long enough", "letters"), ("ann", "short", "8 characters")):
        with pytest.raises(InputError, match=fault):
            add_user(file, name, AccessRole.PILOT, password)


def test_users_are_replaced_as_a_whole(file: Path, tmp_path: Path):
    before = file.read_text()
    (tmp_path / "old").hardlink_to(file)
    file.chmod(0o644)
    add_user(file, "bob", AccessRole.PILOT, "long enough")
    assert (tmp_path / "old").read_text() == before, "what a full disk would have left of them"
    assert file.stat().st_mode & 0o777 == 0o600
    assert "bob" in file.read_text()


async def test_a_revoked_user_whose_browser_reads_nothing_is_cut_off(file: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(server_module, "CHECK_PERIOD", 0.05)
    monkeypatch.setattr(server_module, "END", 0.2)
    place = Place(port=free_port(), users=StationUsers(file))
    station = Station([RobotAddress("truck", "tcp/127.0.0.1:1")], WallClock(), place)
    ready = asyncio.Event()
    running = asyncio.create_task(station.run(ready.set))
    await ready.wait()
    reader, writer = await asyncio.open_connection("127.0.0.1", place.port, limit=1024)
    try:
        request = (
            f"GET /socket HTTP/1.1\r\nHost: 127.0.0.1:{place.port}\r\nOrigin: {place.url[:-1]}\r\n"
            f"Authorization: {basic('ann', 'correct horse')}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
            "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
        )
        writer.write(request.encode())
        assert b"101" in await reader.readline()
        (browser,) = station._browsers
        for _ in range(100):
            browser.viewer.send(bytes(1 << 17))
        (transport,) = [transport for _, transport in station._sockets.values()]
        async with asyncio.timeout(10):
            while not transport.get_write_buffer_size():
                await asyncio.sleep(0.01)
            add_user(file, "ann", AccessRole.OBSERVER, "correct horse")
            while station._browsers:
                await asyncio.sleep(0.01)
    finally:
        writer.close()
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)


async def test_an_observer_sees_and_may_stop_and_nothing_else_over_tls(
    file: Path, tmp_path: Path, caplog, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(server_module, "CHECK_PERIOD", 0.05)
    server, client = self_signed(tmp_path)
    robot = RobotAddress("truck", "tcp/127.0.0.1:1")
    station = Station([robot], WallClock(), Place(port=free_port(), tls=server, users=StationUsers(file)))
    ready = asyncio.Event()
    running = asyncio.create_task(station.run(ready.set))
    try:
        await ready.wait()
        url = station.place.url
        assert url.startswith("https://")
        async with aiohttp.ClientSession(url, connector=aiohttp.TCPConnector(ssl=client)) as session:
            for login in ({}, {"Authorization": basic("olga", "wrong")}):
                for path in ("/", "/page/main.js", "/socket", "/robots/truck/map/1"):
                    async with session.get(path, headers={"Origin": url[:-1], **login}) as reply:
                        assert reply.status == 401
                        assert "Basic" in reply.headers["WWW-Authenticate"]
            assert "no valid login" in caplog.text
            login = {"Authorization": basic("olga", "battery staple")}
            ann = {"Authorization": basic("ann", "correct horse")}
            async with session.ws_connect("/socket", origin=url[:-1], headers=login) as socket:
                hello = await socket.receive_json()
                assert (hello["user"], hello["role"]) == ("olga", "observer")
                monkeypatch.setattr(server_module, "MOST_OF_USER", 1)
                async with session.get("/socket", headers={"Origin": url[:-1], **login}) as reply:
                    assert reply.status == 503, "one user does not take all places"
                async with session.ws_connect("/socket", origin=url[:-1], headers=ann) as other:
                    assert (await other.receive_json())["user"] == "ann"
                    rows = file.read_text()
                    file.write_text(rows[: rows.index("ann:")] + rows[rows.index("olga:") :])
                    while (message := await other.receive()).type is aiohttp.WSMsgType.TEXT:
                        pass
                    assert message.data == 1008
                    assert "browser of ann disconnected" in caplog.text
                async with session.get("/", headers=ann) as reply:
                    assert reply.status == 401
                await socket.send_json({"do": "watch", "robot": "truck"})
                wanted = {1: "not_permitted", 2: "not_permitted", 3: "not_found"}
                await socket.send_json({"do": "order", "id": 1, "order": "arm"})
                await socket.send_json({"do": "goal", "id": 2, "goal": [1, 0, 0]})
                await socket.send_json({"do": "order", "id": 3, "order": "estop"})
                answers = {}
                while answers != wanted:
                    message = json.loads((await socket.receive()).data)
                    if message["kind"] == "answer":
                        answers[message["id"]] = message["reason"]
            assert "user 'olga' is observer" in caplog.text
    finally:
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)


async def test_handshakes_that_never_end_are_few_and_short_and_who_comes_later_is_served(
    file: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(listener, "HANDSHAKE_LIMIT", 0.5)
    monkeypatch.setattr(listener, "MOST_OF_NETWORK", 4)
    server, client = self_signed(tmp_path)
    place = Place(port=free_port(), tls=server, users=StationUsers(file))
    station = Station([RobotAddress("truck", "tcp/127.0.0.1:1")], WallClock(), place)
    ready = asyncio.Event()
    running = asyncio.create_task(station.run(ready.set))
    try:
        await ready.wait()
        begun = asyncio.get_running_loop().time()
        crowd = [await asyncio.open_connection("127.0.0.1", place.port) for _ in range(12)]
        crowd[0][1].write(b"\x16\x03\x01\x02\x00\x01")  # the begin of a hello
        crowd[1][1].write(b"GET / HTTP/1.1\r\n\r\n")

        async def ended(number: int) -> float:
            with contextlib.suppress(ConnectionError):
                await crowd[number][0].read()
            return asyncio.get_running_loop().time() - begun

        async with asyncio.timeout(5):
            times = await asyncio.gather(*map(ended, range(12)))
        assert max(times[4:]) < 0.4, "those beyond are closed at once"
        assert 0.4 < times[0] < 2.0
        assert times[1] < 0.4, "no TLS at all"
        assert "4 connections from 127.0.0.1 are being set up" in caplog.text
        assert "connection of 127.0.0.1 failed" in caplog.text
        async with (
            aiohttp.ClientSession(place.url, connector=aiohttp.TCPConnector(ssl=client)) as session,
            session.get("/", headers={"Authorization": basic("ann", "correct horse")}) as reply,
        ):
            assert reply.status == 200
        crowd.append(await asyncio.open_connection("127.0.0.1", place.port))
    finally:
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
        for _, writer in crowd:
            writer.close()
    assert await crowd[-1][0].read() == b"", "one that is under way does not hold up the end"
