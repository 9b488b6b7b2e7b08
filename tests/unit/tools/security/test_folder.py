"""An authority's folder: odd names, wrong clocks, commands that are broken off or run at once."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
from cryptography.x509 import DNSName, SubjectAlternativeName
from typer.testing import CliRunner

from monstertruck_runtime.errors import InputError
from monstertruck_schemas.req import Role
from monstertruck_schemas.roles import AccessRole
from monstertruckd.tools.cli.main import app
from monstertruckd.tools.security import certificates
from monstertruckd.tools.security import folder as module
from monstertruckd.tools.security.certificates import DAY, read_certificate, read_certificates
from monstertruckd.tools.security.folder import AUTHORITY_DAYS, Folder
from monstertruckd.tools.security.router import make_router

NOW = 1_900_000_000


@pytest.fixture(autouse=True)
def no_waiting_for_the_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.fsync", lambda _: None)


@pytest.fixture
def folder(tmp_path: Path) -> Folder:
    made = Folder(tmp_path / "authority")
    made.init("truck", ("localhost",), made.robot, NOW)
    return made


def add(folder: Folder, name: str, role: AccessRole = AccessRole.PILOT, now: int = NOW, days: int = 365) -> bool:
    return folder.add(name, role, Role.STATION, now, days)


def let_in(folder: Folder) -> int:
    file = folder.robot / "stations.pem"
    return len(read_certificates(file)) if file.read_bytes() else 0


@pytest.mark.parametrize("name", [".", "..", ".ann", "a b", "a$", "a*", "ann\n", "Jürgen", "x" * 33])
def test_a_name_that_is_no_folder_of_its_own_is_refused_and_changes_nothing(folder: Folder, name: str):
    before = sorted(folder.path.rglob("*"))
    with pytest.raises(InputError, match="letters, digits"):
        add(folder, name)
    assert sorted(folder.path.rglob("*")) == before


@pytest.mark.parametrize(
    ("robot", "address", "days", "complaint"),
    [
        ("a/b*", "localhost", 1, "robot"),
        ("truck", "münchen", 1, "an IP address or a host name"),
        ("truck", "a b", 1, "an IP address or a host name"),
        ("truck", "", 1, "an IP address or a host name"),
        ("truck", "[::1]", 1, "an IP address or a host name"),
        ("truck", "::1", 99_999_999, "expected at most 3650"),
    ],
)
def test_a_robot_that_nobody_could_reach_is_refused_before_anything_is_made(
    tmp_path: Path, robot: str, address: str, days: int, complaint: str
):
    with pytest.raises(InputError, match=complaint):
        Folder(tmp_path / "new").init(robot, (address,), tmp_path, NOW, days)
    assert not (tmp_path / "new").exists()


def test_nothing_is_certified_for_longer_than_its_authority_or_by_a_wrong_clock(folder: Folder):
    with pytest.raises(InputError, match="expires in 100"):
        add(folder, "ann", now=NOW + (AUTHORITY_DAYS - 100) * DAY)
    with pytest.raises(InputError, match=r"the authority becomes valid in 10\.0 days: this computer's clock is wrong"):
        add(folder, "ann", now=NOW - 300 - 10 * DAY)
    late = NOW + 3000 * DAY
    add(folder, "ann", now=late)
    issuer, authority = folder.issuer("ann").certificate, folder.authority().certificate
    assert issuer.not_valid_after_utc <= authority.not_valid_after_utc


def test_a_key_that_others_could_read_is_its_owners_alone_once_renewed(folder: Folder):
    key = folder.robot / "robot.key"
    key.chmod(0o644)
    folder.init("truck", ("localhost",), folder.robot, NOW)
    assert key.stat().st_mode & 0o777 == 0o600


def test_what_is_renewed_stays_what_it_was_unless_something_else_is_asked_for(folder: Folder):
    folder.init("car", ("10.0.0.7", "car.local"), Path("/srv"), NOW)
    folder.add("bob", AccessRole.OBSERVER, Role.GAMEPAD, NOW)
    before = folder.register()
    assert not folder.init(None, None, None, NOW)
    assert not folder.add("bob", None, None, NOW)
    assert folder.register() == before
    names = read_certificate(folder.robot / "robot.pem").extensions.get_extension_for_class(SubjectAlternativeName)
    assert names.value.get_values_for_type(DNSName) == ["car.local"]
    assert folder.add("bob", None, Role.KEYBOARD, NOW)
    assert folder.register().stations["bob"].role is AccessRole.OBSERVER
    folder.init(None, ("10.0.0.8",), None, NOW)
    assert folder.register().robot == "car"


class OffError(Exception):
    """The computer went off."""


@contextmanager
def broken_off_before(name: str) -> Iterator[None]:
    """The next file of this name, or its like, is not written."""
    write = module.replace_file

    def replace(path: Path, *more: object) -> None:
        if path.match(name):
            raise OffError
        write(path, *more)

    with pytest.MonkeyPatch.context() as patch, pytest.raises(OffError):  # noqa: PT012 - a context of its own
        patch.setattr(module, "replace_file", replace)
        patch.setattr(certificates, "replace_file", replace)
        yield


@pytest.mark.parametrize(
    "file", ["authority.key", "authority.pem", "robot.pem", "stations.pem", "zenoh.yaml", "register.yaml"]
)
def test_a_broken_off_init_is_gone_on_with(tmp_path: Path, file: str):
    folder = Folder(tmp_path / "new")
    with broken_off_before(file):
        folder.init("truck", ("localhost",), tmp_path, NOW)
    authority = folder.path / "authority.pem"
    before = authority.read_bytes() if authority.exists() else None
    folder.init("truck", ("localhost",), tmp_path, NOW)
    assert before in (None, authority.read_bytes())
    assert add(folder, "ann")


@pytest.mark.parametrize(
    "file", ["issuers/*.key", "issuers/*.pem", "station.pem", "stations.pem", "zenoh.yaml", "register.yaml"]
)
def test_a_broken_off_add_is_gone_on_with_and_says_that_the_robot_needs_it(folder: Folder, file: str):
    add(folder, "bob")
    with broken_off_before(file):
        add(folder, "ann")
    changed = add(folder, "ann")
    assert changed or file == "register.yaml"  # the robot's files were complete
    assert let_in(folder) == 2
    assert folder.register().of_role(AccessRole.PILOT) == ("bob", "ann")


@pytest.mark.parametrize("file", ["stations.pem", "pilots.pem", "register.yaml"])
def test_a_broken_off_revocation_can_be_asked_for_again(folder: Folder, file: str):
    add(folder, "ann")
    add(folder, "bob")
    with broken_off_before(file):
        folder.revoke("ann")
    folder.revoke("ann")
    assert let_in(folder) == 1
    assert [path.name for path in (folder.path / "stations").iterdir()] == ["bob"]
    assert not list(folder.path.glob("issuers/ann*"))


def test_the_authority_of_stations_is_not_made_anew_when_its_register_is_lost(folder: Folder):
    add(folder, "ann")
    key = (folder.path / "authority.key").read_bytes()
    (folder.path / "register.yaml").unlink()
    with pytest.raises(InputError, match=r"register\.yaml is missing among certificates of ann"):
        folder.init("truck", ("localhost",), folder.robot, NOW)
    assert (folder.path / "authority.key").read_bytes() == key


def test_two_commands_at_once_lose_nothing(folder: Folder, monkeypatch: pytest.MonkeyPatch):
    read, both = Folder.register, threading.Barrier(2)

    def slow(self: Folder):
        found = read(self)
        with suppress(threading.BrokenBarrierError):
            both.wait(0.1)  # both have read, unless one has to wait
        return found

    monkeypatch.setattr(Folder, "register", slow)
    names = ("ann", "bob")
    adding = [threading.Thread(target=add, args=(folder, name)) for name in names]
    for thread in adding:
        thread.start()
    for thread in adding:
        thread.join()
    assert set(read(folder).stations) == set(names)
    assert let_in(folder) == 2


def test_files_that_were_moved_to_their_station_hide_nothing(folder: Folder, tmp_path: Path):
    add(folder, "ann")
    (folder.path / "stations/ann").rename(tmp_path / "gone")
    assert [(row.name, row.days) for row in folder.certificates(NOW)][1:] == [("truck", 825), ("ann", None)]
    make_router(tmp_path / "router", [folder], ["::1"], NOW)
    assert (folder.path / "stations/ann/ca.pem").read_text().count("BEGIN CERTIFICATE") == 2
    assert folder.register().router is not None
    assert folder.zenoh().connect == ("tls/[::1]:7447",)
    with pytest.raises(InputError, match="--address 'a b'"):
        make_router(tmp_path / "router", [folder], ["a b"], NOW)


def test_who_revokes_the_last_pilot_hears_what_follows(folder: Folder):
    add(folder, "ann")
    add(folder, "bob", AccessRole.OBSERVER)
    make_router(folder.path / "router", [folder], ["10.0.0.1"], NOW)
    revoked = CliRunner().invoke(app, ["security", "revoke", "ann", "--folder", str(folder.path)])
    assert revoked.exit_code == 0
    assert "does not start with these files, because no station could drive" in revoked.output
    assert "security router" in revoked.output
