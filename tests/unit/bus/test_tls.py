"""Mutual TLS end to end: a pilot drives, an observer looks, strangers get nothing."""

import asyncio
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from monstertruck_runtime import robots
from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.endpoints import local_endpoints
from monstertruck_runtime.errors import NoAnswerError, NotFoundError, NotPermittedError, RequestRefusedError
from monstertruck_runtime.mailbox import fifo
from monstertruck_runtime.stations import TLS_VARIABLE, ClientTls, station_tls
from monstertruck_schemas.roles import AccessRole
from monstertruck_schemas.topics import GATE, REQ_CONTROL, REQ_DRIVE, Writer
from monstertruckd.bus.port_holder import holder_of
from monstertruckd.bus.zenoh_config import TlsConfig
from monstertruckd.early_estop import send_estop
from tests.bus_kit import free_endpoint, gate_state, running_robot

pytestmark = pytest.mark.skipif(shutil.which("openssl") is None, reason="makes certificates with openssl")


def certificates(folder: Path) -> None:
    """One authority; a server certificate for the truck, client certificates for the others."""

    def openssl(*arguments: str) -> None:
        subprocess.run(["openssl", *arguments], cwd=folder, check=True, capture_output=True)

    key = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes"]
    openssl("req", "-x509", *key, "-keyout", "ca.key", "-out", "ca.pem", "-days", "1", "-subj", "/CN=Test CA")
    for name, usage, names in (
        ("truck", "serverAuth,clientAuth", "DNS:localhost,IP:127.0.0.1"),
        ("ann", "clientAuth", "DNS:ann"),
        ("bob", "clientAuth", "DNS:bob"),
        ("eve", "clientAuth", "DNS:eve"),
    ):
        openssl("req", *key, "-keyout", f"{name}.key", "-out", f"{name}.csr", "-subj", f"/CN={name}")
        (folder / f"{name}.ext").write_text(
            "basicConstraints=critical,CA:FALSE\nkeyUsage=critical,digitalSignature\n"
            f"extendedKeyUsage={usage}\nsubjectAltName={names}\n"
        )
        openssl("x509", "-req", "-in", f"{name}.csr", "-CA", "ca.pem", "-CAkey", "ca.key", "-CAcreateserial",
                "-days", "1", "-extfile", f"{name}.ext", "-out", f"{name}.pem")  # fmt: skip


async def test_who_may_do_what(tmp_path: Path):
    await asyncio.to_thread(certificates, tmp_path)
    server = TlsConfig(
        ca=tmp_path / "ca.pem",
        certificate=tmp_path / "truck.pem",
        key=tmp_path / "truck.key",
        pilots=("ann",),
        observers=("bob",),
    )
    endpoint = free_endpoint("tls")

    def client(name: str) -> TruckClient:
        files = ClientTls(ca=server.ca, certificate=tmp_path / f"{name}.pem", key=tmp_path / f"{name}.key")
        return TruckClient(endpoint=endpoint, tls=files, timeout=1.0, source=name)

    async with running_robot(endpoint, tls=server) as robot:
        robot.bus.publisher(GATE, Writer.GATE).put(gate_state(1))
        callers: list[str] = []

        async def take(payload: dict[str, Any]) -> dict[str, Any]:
            callers.append(payload["source"])
            return gate_state(2).model_dump(mode="json")

        robot.rpc.register("arm", take)
        robot.rpc.register("estop", take, AccessRole.OBSERVER)
        requests = robot.bus.subscribe(REQ_DRIVE, fifo(10))
        async with client("ann") as ann, client("bob") as bob, client("eve") as eve:
            assert await ann.get_retained(GATE) == gate_state(1)
            assert (await ann.call("topics"))["topics"]
            assert await bob.get_retained(GATE) == gate_state(1)
            assert [await each.alive() for each in (ann, bob, eve)] == [True, True, False]
            assert (await bob.call("topics"))["topics"]
            with pytest.raises(RequestRefusedError, match="arm: bob has the role observer, but this needs pilot"):
                await bob.arm()
            await bob.estop()
            with pytest.raises(
                NotFoundError, match=r"or it does not know the certificate of 'eve' \(its `zenoh.tls`\)$"
            ):
                await eve.get_retained(GATE)
            await bob.drive(9.0, 0.0)
            ann.source = "bob"  # under another's name nothing arrives
            await ann.drive(9.0, 0.0)
            with pytest.raises(NoAnswerError, match=r"does not answer: .* does not accept requests of 'bob'"):
                await ann.call("topics")
            ann.source = "ann"
            await ann.drive(0.5, 0.0)
            async with asyncio.timeout(3):
                request = await requests.next()
            await asyncio.sleep(0.05)
        with pytest.raises(NotFoundError):
            async with TruckClient(endpoint=endpoint.replace("tls/", "tcp/"), timeout=0.3):
                pass
    assert request.source == "ann"
    assert callers == ["bob"]
    assert requests.latest is request


async def test_a_refused_certificate_is_not_said_to_be_a_robot_that_is_not_there(tmp_path: Path):
    ours, theirs = tmp_path / "ours", tmp_path / "theirs"
    for folder in (ours, theirs):
        folder.mkdir()
        await asyncio.to_thread(certificates, folder)
    server = TlsConfig(ca=ours / "ca.pem", certificate=ours / "truck.pem", key=ours / "truck.key", pilots=("ann",))
    endpoint = free_endpoint("tls")
    async with running_robot(endpoint, tls=server):
        for authority, station, why in (
            (ours, theirs, "unknown ca|decrypt error|bad certificate"),
            (theirs, ours, "self-signed certificate|unable to get local issuer|certificate signature failure"),
        ):
            files = ClientTls(ca=authority / "ca.pem", certificate=station / "ann.pem", key=station / "ann.key")
            with pytest.raises(NotPermittedError, match=rf"its certificate or this station's is refused: .*({why})"):
                async with TruckClient(endpoint=endpoint, tls=files, timeout=0.5, source="ann"):
                    pass
    files = ClientTls(ca=ours / "ca.pem", certificate=ours / "ann.pem", key=ours / "ann.key")
    with pytest.raises(NotFoundError, match="no robot answers at"):
        async with TruckClient(endpoint=endpoint, tls=files, timeout=0.3, source="ann"):
            pass


async def test_a_command_finds_the_stations_certificate_by_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    await asyncio.to_thread(certificates, tmp_path)
    for name, file in (("ann.pem", "station.pem"), ("ann.key", "station.key")):
        (tmp_path / name).rename(tmp_path / file)
    server = TlsConfig(
        ca=tmp_path / "ca.pem", certificate=tmp_path / "truck.pem", key=tmp_path / "truck.key", pilots=("ann",)
    )
    endpoint = free_endpoint("tls")
    monkeypatch.setenv(TLS_VARIABLE, str(tmp_path))
    async with running_robot(endpoint, tls=server) as robot, TruckClient(endpoint=endpoint, timeout=1.0) as client:
        robot.bus.publisher(GATE, Writer.GATE).put(gate_state(1))
        assert await client.get_retained(GATE) == gate_state(1)
        assert client.source.startswith("ann:")
        with pytest.raises(NotPermittedError, match="the certificate is for 'ann'"):
            async with TruckClient(endpoint=endpoint, source="bob"):
                pass
        orders = robot.bus.subscribe(REQ_CONTROL, fifo(10))
        session = await asyncio.to_thread(send_estop, "truck", endpoint, 1.0)
        async with asyncio.timeout(3):
            assert (await orders.next()).source.startswith("ann:")
        await asyncio.to_thread(session.close)


def test_a_certificate_that_is_missing_or_open_to_others_is_refused(tmp_path: Path):
    config = tmp_path / "monstertruckd" / "tls"
    config.mkdir(parents=True)
    where = {"XDG_CONFIG_HOME": str(tmp_path)}
    for name in ("ca.pem", "station.pem", "station.key"):
        with pytest.raises(NotFoundError, match=f"{name}: not there"):
            station_tls(where)
        (config / name).touch(mode=0o644)
    with pytest.raises(NotPermittedError, match="chmod 600"):
        station_tls(where)
    (config / "station.key").chmod(0o600)
    assert station_tls(where).key == config / "station.key"


async def test_it_is_found_and_named_by_those_who_have_no_certificate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Another user, who may read neither its certificates nor the folder of its Unix socket."""
    await asyncio.to_thread(certificates, tmp_path)
    server = TlsConfig(
        ca=tmp_path / "ca.pem", certificate=tmp_path / "truck.pem", key=tmp_path / "truck.key", pilots=("ann",)
    )
    monkeypatch.setattr(robots, "local_endpoints", local_endpoints)
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path / "theirs"))
    certified = free_endpoint("tls")
    async with running_robot(certified, robot="guarded", tls=server), running_robot(robot="second") as plain:
        monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path / "ours"))
        monkeypatch.setenv(TLS_VARIABLE, str(tmp_path / "none"))
        there = await asyncio.to_thread(robots.robots_here)
        assert {("guarded", certified), ("second", plain.endpoint)} <= {*there}
        assert "robot 'guarded'" in await asyncio.to_thread(holder_of, [certified])
    assert "guarded" not in dict(await asyncio.to_thread(robots.robots_here))
