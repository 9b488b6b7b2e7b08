"""An authority's folder, and a robot that runs with what it wrote: who is let in, and what each may do."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import SECOND, WallClock
from monstertruck_runtime.errors import InputError, NotFoundError, NotPermittedError, RequestRefusedError
from monstertruck_runtime.stations import ClientTls
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Role
from monstertruck_schemas.roles import AccessRole
from monstertruck_schemas.topics import GATE, Writer
from monstertruckd.config.load import load_tree
from monstertruckd.tools.cli.main import app
from monstertruckd.tools.security.certificates import DAY, issue, new_authority, read_certificate, seconds_left
from monstertruckd.tools.security.check import _Attempt, check
from monstertruckd.tools.security.folder import Folder
from tests.bus_kit import free_endpoint, gate_state, running_robot

NOW = (WallClock().now() + WallClock().real_offset()) // SECOND


@pytest.fixture
def folder(tmp_path: Path) -> Folder:
    made = Folder(tmp_path / "authority")
    assert made.init("truck", ("localhost", "127.0.0.1"), made.robot, NOW)
    assert made.add("ann", AccessRole.PILOT, Role.KEYBOARD, NOW)
    assert made.add("bob", AccessRole.OBSERVER, Role.STATION, NOW)
    return made


def running(folder: Folder, endpoint: str, **more: object):
    """A robot with the folder's configuration at other endpoints."""
    settings = folder.zenoh().model_dump() | {"listen_pilots": (), "access_control": False, **more}
    return running_robot(endpoint, **{name: value for name, value in settings.items() if name != "listen"})


async def refuse(_: object) -> dict[str, object]:
    raise RequestRefusedError(Reason.BAD_NONCE)


async def test_all_cases_against_a_running_robot(folder: Folder):
    endpoint = free_endpoint("tls")
    async with running(folder, endpoint) as robot:
        gate = robot.bus.publisher(GATE, Writer.GATE)
        gate.put(gate_state(1))
        robot.rpc.register("arm", refuse)
        robot.rpc.register("versions", _nothing, AccessRole.OBSERVER)
        cases = await check(folder, endpoint, WallClock())
    assert [(case.who, case.found) for case in cases if not case.met] == []
    assert [case.who for case in cases] == [
        "ann, a pilot",
        "bob, an observer",
        "ann under another name",
        "a stranger of this authority",
        "ann of another authority",
        "no certificate",
        "without TLS",
        "a certificate that expires",
    ]
    assert cases[3].found.startswith("no link")  # it holds no place


async def test_the_check_finds_an_observer_who_may_give_orders(folder: Folder, tmp_path: Path):
    endpoint = free_endpoint("tls")
    async with running(folder, endpoint) as robot:
        robot.bus.publisher(GATE, Writer.GATE).put(gate_state(1))
        robot.rpc.register("arm", refuse, AccessRole.OBSERVER)
        robot.rpc.register("versions", _nothing, AccessRole.OBSERVER)
        found = []
        async for case in _Attempt(folder, endpoint, WallClock(), tmp_path).cases():
            found.append((case.who, case.met, case.found))
            if len(found) == 2:
                break
    assert found == [
        ("ann, a pilot", True, "state, calls and orders"),
        ("bob, an observer", False, "an order: bad_nonce"),
    ]


async def test_observers_have_no_place_at_the_pilots_endpoint(folder: Folder):
    endpoint, pilots = free_endpoint("tls"), free_endpoint("tls")
    async with running(folder, endpoint, listen_pilots=(pilots,), max_sessions=1) as robot:
        robot.bus.publisher(GATE, Writer.GATE).put(gate_state(1))
        async with client(folder, "bob", endpoint):  # takes the only place of all stations
            async with client(folder, "ann", pilots) as ann:
                assert await ann.get_retained(GATE) == gate_state(1)
            with pytest.raises(NotPermittedError, match="is refused: tlsv1 alert unknown ca"):
                async with client(folder, "bob", pilots):
                    pass


async def test_a_renewed_certificate_needs_no_new_robot_and_a_revoked_one_opens_no_link(folder: Folder):
    endpoint = free_endpoint("tls")
    async with running(folder, endpoint) as robot:
        robot.bus.publisher(GATE, Writer.GATE).put(gate_state(1))
        before = (folder.path / "stations/ann/station.pem").read_bytes()
        assert not folder.add("ann", AccessRole.PILOT, Role.KEYBOARD, NOW)
        assert (folder.path / "stations/ann/station.pem").read_bytes() != before
        async with client(folder, "ann", endpoint) as ann:
            assert await ann.get_retained(GATE) == gate_state(1)
    tls = ClientTls(**{name: folder.path / "kept" / file for name, file in FILES.items()})
    (folder.path / "stations/bob").rename(folder.path / "kept")
    folder.revoke("bob")
    endpoint = free_endpoint("tls")
    async with running(folder, endpoint):
        with pytest.raises(NotPermittedError, match="is refused: "):
            async with TruckClient(endpoint=endpoint, tls=tls, timeout=0.5):
                pass


FILES = {"ca": "ca.pem", "certificate": "station.pem", "key": "station.key"}


def client(folder: Folder, name: str, endpoint: str) -> TruckClient:
    files = {key: folder.path / "stations" / name / file for key, file in FILES.items()}
    return TruckClient(endpoint=endpoint, tls=ClientTls(**files), timeout=1.0)


async def _nothing(_: object) -> dict[str, object]:
    return {}


def test_keys_are_their_owners_alone_and_the_configuration_is_one(folder: Folder):
    keys = [*folder.path.rglob("*.key")]
    assert len(keys) == 6
    assert {key.stat().st_mode & 0o777 for key in keys} == {0o600}
    tree = load_tree(folder.robot / "zenoh.yaml")
    assert tree.data["zenoh"]["tls"]["pilots"] == ["ann"]
    assert tree.data["zenoh"]["tls"]["ranks"] == {"ann": "keyboard"}
    assert folder.zenoh().listen == ("tls/0.0.0.0:7447",)
    assert (folder.robot / "stations.pem").read_text().count("BEGIN CERTIFICATE") == 2
    assert (folder.robot / "pilots.pem").read_text().count("BEGIN CERTIFICATE") == 1
    assert not list(folder.robot.glob("authority*"))


def test_certificates_expire_and_the_robots_is_renewed(folder: Folder):
    left = {row.name: row.days for row in folder.certificates(NOW)}
    assert left == {"authority": 3650, "truck": 825, "ann": 365, "bob": 365}
    later = NOW + 400 * DAY
    assert {row.name for row in folder.certificates(later) if row.days < 0} == {"ann", "bob"}
    assert not folder.init("truck", ("localhost",), folder.robot, later)
    left = {row.name: row.days for row in folder.certificates(later)}
    assert left["truck"] == 825
    assert folder.register().of_role(AccessRole.PILOT) == ("ann",)


@pytest.mark.parametrize("name", ["a/b", "", "a:b", "@ann", "../x"])
def test_names_that_no_key_may_hold_are_refused(folder: Folder, name: str):
    with pytest.raises(InputError):
        folder.add(name, AccessRole.PILOT, Role.STATION, NOW)
    with pytest.raises(InputError):
        folder.add("cy", AccessRole.PILOT, Role.ESTOP, NOW)
    assert set(folder.register().stations) == {"ann", "bob"}


def test_without_an_authority_or_a_pilot_nothing_is_certified(tmp_path: Path):
    folder = Folder(tmp_path)
    with pytest.raises(NotFoundError, match="security init"):
        folder.add("ann", AccessRole.PILOT, Role.STATION, NOW)
    folder.init("truck", ("localhost",), tmp_path, NOW)
    with pytest.raises(InputError, match="pilots or engineers"):
        folder.zenoh()
    with pytest.raises(NotFoundError, match="no station 'ann'"):
        folder.revoke("ann")


def test_a_certificate_tells_how_long_it_is_good(tmp_path: Path):
    made = issue(new_authority("A", NOW, 1), "ann", NOW, 60)
    made.save(tmp_path / "a.pem", tmp_path / "a.key")
    assert seconds_left(read_certificate(tmp_path / "a.pem"), NOW) == 60
    with pytest.raises(InputError, match="expected a certificate"):
        read_certificate(tmp_path / "a.key")


def test_the_commands_from_nothing_to_rules(tmp_path: Path):
    run, folder = CliRunner(), ["--folder", str(tmp_path / "a")]
    assert run.invoke(app, ["security", "init", "--address", "10.0.0.7", *folder]).exit_code == 0
    added = run.invoke(app, ["security", "add", "ann", "--role", "engineer", "--rank", "gamepad", *folder])
    assert added.exit_code == 0
    assert "restart it while the robot stands" in added.output
    again = run.invoke(app, ["security", "add", "ann", "--role", "engineer", "--rank", "gamepad", *folder])
    assert "The robot needs no new files" in again.output
    shown = run.invoke(app, ["security", "show", "--json", *folder])
    assert [row["name"] for row in json.loads(shown.stdout)] == ["authority", "truck", "ann"]
    printed = json.loads(run.invoke(app, ["security", "rules", *folder]).stdout)
    assert printed[0]["access_control"]["subjects"][0]["cert_common_names"] == ["ann"]
    revoked = run.invoke(app, ["security", "revoke", "ann", *folder])
    assert revoked.exit_code == 0
    assert "restart it while the robot stands" in revoked.output
