"""A fleet behind one router: names are bound to certificates there; a robot is seen and asked by its own stations."""

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path

import pytest
import zenoh
from typer.testing import CliRunner

from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import SECOND, WallClock
from monstertruck_runtime.errors import InputError, NotFoundError
from monstertruck_runtime.mailbox import fifo
from monstertruck_runtime.stations import TLS_VARIABLE, ClientTls
from monstertruck_schemas.req import Role
from monstertruck_schemas.roles import AccessRole
from monstertruck_schemas.topics import GATE, POSE, REQ_DRIVE, Writer
from monstertruckd.bus.access import router_rules
from monstertruckd.station.discovery import Discovery
from monstertruckd.tools.cli.main import app
from monstertruckd.tools.security.folder import Folder
from monstertruckd.tools.security.router import make_router
from tests.bus_kit import Robot, free_endpoint, gate_state, odometry, running_robot

NOW = (WallClock().now() + WallClock().real_offset()) // SECOND
KNOWN = {"hare": ("ann", "bob"), "crab": ("cy",)}
"""Stations of each robot; bob is an observer."""


def fleet(tmp_path: Path) -> dict[str, Folder]:
    """Folders of two robots."""
    made = {robot: Folder(tmp_path / robot) for robot in KNOWN}
    for robot, folder in made.items():
        folder.init(robot, ("localhost", "127.0.0.1"), folder.robot, NOW)
        for name in KNOWN[robot]:
            folder.add(name, AccessRole.OBSERVER if name == "bob" else AccessRole.PILOT, Role.STATION, NOW)
    return made


@asynccontextmanager
async def behind_a_router(tmp_path: Path) -> AsyncIterator[tuple[dict[str, Folder], dict[str, Robot], str]]:
    """Both robots, each with a session and a certificate of its own, and where their router listens."""
    folders = fleet(tmp_path)
    endpoint = free_endpoint("tls")
    port = int(endpoint.rpartition(":")[2])
    place = tmp_path / "router" / "router"
    make_router(tmp_path / "router", list(folders.values()), ("127.0.0.1",), NOW, place, port)
    config = zenoh.Config.from_json5((place / "zenoh.json5").read_text())
    async with AsyncExitStack() as stack:
        router = await asyncio.to_thread(zenoh.open, config)
        stack.push_async_callback(asyncio.to_thread, router.close)
        robots = {}
        for robot, folder in folders.items():
            settings = folder.zenoh().model_dump() | {"listen_pilots": (), "listen": (), "local_socket": False}
            assert settings["connect"] == (endpoint,)
            robots[robot] = await stack.enter_async_context(running_robot("tcp/x", robot=robot, **settings))
            robots[robot].bus.publisher(GATE, Writer.GATE).put(gate_state(1))
        yield folders, robots, endpoint


def client(folder: Folder, endpoint: str, robot: str, name: str) -> TruckClient:
    files = folder.path / "stations" / name
    tls = ClientTls(ca=files / "ca.pem", certificate=files / "station.pem", key=files / "station.key")
    return TruckClient(robot, endpoint, tls=tls, source=name, timeout=1.0)


async def test_stations_see_and_ask_their_own_robots_and_robots_say_only_their_own_state(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    async with behind_a_router(tmp_path) as (folders, robots, endpoint), AsyncExitStack() as stack:
        requests = {robot: made.bus.subscribe(REQ_DRIVE, fifo(10)) for robot, made in robots.items()}
        ann, bob, ann_at_crab, cy = [
            await stack.enter_async_context(client(folders[home], endpoint, robot, name))
            for home, robot, name in (
                ("hare", "hare", "ann"),
                ("hare", "hare", "bob"),
                ("hare", "crab", "ann"),
                ("crab", "crab", "cy"),
            )
        ]
        async with asyncio.timeout(5):
            while not (await ann.alive() and await cy.alive()):
                await asyncio.sleep(0.02)
        assert await ann.get_retained(GATE) == await bob.get_retained(GATE) == await cy.get_retained(GATE)
        assert (await ann.call("topics"))["topics"]
        poses = ann.subscribe(POSE, fifo(10))
        others = ann_at_crab.subscribe(POSE, fifo(10))
        await asyncio.sleep(0.1)
        for made in robots.values():
            made.bus.publisher(POSE, Writer.ESTIMATION).put(odometry(1))
        async with asyncio.timeout(3):
            assert await poses.next() == odometry(1)

        assert not await ann_at_crab.alive(), "a robot that does not know her is not there for her"
        with pytest.raises(NotFoundError):
            await ann_at_crab.get_retained(GATE)
        ann_at_crab._open_session().put(REQ_DRIVE.key("crab", "ann"), b"forged")
        bob.source = "ann"
        await bob.drive(9.0, 0.0)
        await ann.drive(0.5, 0.0)
        async with asyncio.timeout(3):
            request = await requests["hare"].next()
        await asyncio.sleep(0.1)
        assert (request.source, request.speed) == ("ann", 0.5)
        assert requests["hare"].latest is request
        assert others.latest is None

        forged = zenoh.Config.from_json5(_robot_session(folders["crab"], endpoint))
        with await asyncio.to_thread(zenoh.open, forged) as session:
            await asyncio.to_thread(session.put, POSE.key("hare"), b"forged")
            await asyncio.to_thread(session.put, REQ_DRIVE.key("hare", "ann"), b"forged")
            await asyncio.sleep(0.2)
        assert poses.latest == odometry(1)
        assert [made.events.latest for made in robots.values()] == [None, None], (
            "what is not theirs to ask never arrives"
        )

        files = folders["hare"].path / "stations" / "ann"
        monkeypatch.setenv(TLS_VARIABLE, str(files))
        found: list[str] = []
        watching = asyncio.create_task(Discovery(endpoint, WallClock(), lambda a: found.append(a.name)).run())
        async with asyncio.timeout(5):
            while not found:
                await asyncio.sleep(0.02)
        await asyncio.sleep(0.2)
        watching.cancel()
        await asyncio.gather(watching, return_exceptions=True)
        assert found == ["hare"], "a station learns of the robots that know it"


def _robot_session(folder: Folder, endpoint: str) -> str:
    files = folder.robot
    tls = {
        "root_ca_certificate": str(files / "stations.pem"),
        "connect_certificate": str(files / "robot.pem"),
        "connect_private_key": str(files / "robot.key"),
        "enable_mtls": True,
    }
    return json.dumps(
        {
            "mode": "client",
            "connect": {"endpoints": [endpoint]},
            "scouting": {"multicast": {"enabled": False}},
            "transport": {"link": {"tls": tls}},
        }
    )


def test_a_router_binds_every_name_to_its_certificate():
    rules = router_rules(KNOWN)
    assert rules["default_permission"] == "deny"
    by_id = {rule["id"]: rule for rule in rules["rules"]}
    assert len(by_id) == len(rules["rules"])
    assert [subject["cert_common_names"] for subject in rules["subjects"]] == [
        [n] for n in ("hare", "crab", "ann", "bob", "cy")
    ]
    for policy in rules["policies"]:
        (who,) = policy["subjects"]
        for rule in (by_id[name] for name in policy["rules"]):
            for key in rule["key_exprs"]:
                if key.startswith("mt/*/"):
                    assert "put" not in rule["messages"]
                elif who in KNOWN:
                    assert key.split("/")[1] == who or key == f"mt/stand/sensor/pose_{who}"
                elif rule["flows"] == ["ingress"] and rule["messages"] in (["put"], ["query"]) and "/stand/" not in key:
                    assert any(part in (who, f"{who}:$*") for part in key.split("/"))


def test_a_router_is_made_by_a_command_and_every_name_is_there_once(tmp_path: Path):
    folders = fleet(tmp_path)
    words = [str(folder.path) for folder in folders.values()]
    made = CliRunner().invoke(app, ["security", "router", *words, "-a", "10.0.0.2", "-f", str(tmp_path / "router")])
    assert made.exit_code == 0, made.output
    assert "router of hare, crab" in made.output
    printed = json.loads(CliRunner().invoke(app, ["security", "rules", "-f", words[0]]).stdout)
    assert [s["id"] for s in printed[0]["access_control"]["subjects"]] == ["ann", "bob", "router"]
    for folder in folders.values():
        assert folder.zenoh().connect == ("tls/10.0.0.2:7447",)
        assert folder.zenoh().tls.routers == ("router",)
        for name in KNOWN[folder.register().robot]:
            trusted = (folder.path / "stations" / name / "ca.pem").read_text()
            assert (tmp_path / "router/authority.pem").read_text() in trusted
    folders["crab"].add("hare", AccessRole.PILOT, Role.STATION, NOW)
    with pytest.raises(InputError, match="hare: expected a different name"):
        make_router(tmp_path / "router", list(folders.values()), ("10.0.0.2",), NOW)


def test_no_station_has_the_name_of_the_router_whichever_came_first(tmp_path: Path):
    folder = fleet(tmp_path)["crab"]
    with pytest.raises(InputError, match="cy: is the name of the fleet's router"):
        folder.join("cy", "tls/10.0.0.2:7447", folder.authority().pem)
    assert not (folder.path / "router.pem").exists()
    folder.join("router", "tls/10.0.0.2:7447", folder.authority().pem)
    with pytest.raises(InputError, match="router: is the name of the fleet's router"):
        folder.add("router", AccessRole.PILOT, Role.STATION, NOW)
    assert folder.zenoh().tls.routers == ("router",), "the robot starts with what was written"
