"""Clock, disk, heat, memory, link, and who may reach the daemon."""

from pathlib import Path

import pytest

from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Role
from monstertruck_schemas.roles import AccessRole
from monstertruckd.tools.doctor.computer import access, calendar, condition, link
from monstertruckd.tools.doctor.context import Level
from monstertruckd.tools.security.certificates import DAY, new_issuer
from monstertruckd.tools.security.folder import Folder
from tests.unit.tools.doctor.kit import NOW, EmulatedHost, bad, see, see_all

NTP = "sudo timedatectl set-ntp true"


def unsynchronized(emulated: EmulatedHost) -> None:
    (emulated.folder / "run/systemd/timesync/synchronized").unlink()


def test_the_clock(tmp_path: Path):
    assert bad(see(tmp_path / "a", calendar)) == {}
    found = see(tmp_path / "b", calendar, unsynchronized)["clock"]
    assert (found.level, found.reason, found.fix) == (Level.WARN, Reason.CLOCK_UNSET, NTP)

    def by_chrony(emulated: EmulatedHost) -> None:
        unsynchronized(emulated)
        emulated.process(99, "/usr/sbin/chronyd")

    assert see(tmp_path / "c", calendar, by_chrony)["clock"].seen == "set by chronyd"
    found = see(tmp_path / "d", calendar, lambda emulated: emulated.clock.step_real(-NOW))["clock"]
    assert (found.level, found.reason, found.fix) == (Level.FAIL, Reason.CLOCK_UNSET, NTP)

    def no_chip(emulated: EmulatedHost) -> None:
        (emulated.folder / "sys/class/rtc/rtc0/name").unlink()
        (emulated.folder / "sys/class/rtc/rtc0").rmdir()

    assert see(tmp_path / "e", calendar, no_chip)["clock chip"].seen.startswith("none: ")


def test_the_computer_in_need(tmp_path: Path):
    assert bad(see(tmp_path / "a", condition)) == {}

    def change(emulated: EmulatedHost) -> None:
        emulated.change(monitors={"host": {"kind": "host_health", "disk": 10**18, "disk_clear": 10**18 + 1}})
        emulated.host.inject("memory", "0.04")
        emulated.host.inject("temperature", "91")

    found = bad(see(tmp_path / "b", condition, change))
    assert {name: finding.reason for name, finding in found.items()} == {
        "disk": Reason.DISK_LOW,
        "memory": Reason.MEMORY_LOW,
        "heat": Reason.HOST_HOT,
    }
    assert found["disk"].level is Level.FAIL
    assert found["disk"].fix == f"du -xh {tmp_path}/b/var/lib/monstertruckd/logs | sort -h | tail"
    assert found["memory"].seen.startswith("4% of ")

    slow = see(tmp_path / "c", condition, lambda emulated: emulated.host.inject("cap", "0.5"))["heat"]
    assert slow.reason is Reason.HOST_THROTTLED
    broken = see(tmp_path / "d", condition, lambda emulated: emulated.host.inject("broken"))["host"]
    assert "/proc/stat" in broken.seen


def test_the_network_link(tmp_path: Path):
    assert see(tmp_path / "a", link)["link"].seen == "wlan0 (wifi): good, -55 dBm"
    weak = see(tmp_path / "b", link, lambda emulated: emulated.network.inject("signal", "-82"))["link"]
    assert (weak.level, weak.reason, weak.seen) == (Level.WARN, Reason.LINK_WEAK, "wlan0 (wifi): poor, -82 dBm")
    down = see(tmp_path / "c", link, lambda emulated: emulated.network.inject("wifi", "off"))["link"]
    assert (down.reason, down.fix) == (Reason.LINK_DOWN, "ip -brief link")


@pytest.mark.parametrize("endpoint", ["tcp/0.0.0.0:7447", "tcp/192.168.1.5:7447", "udp/[::]:7447"])
@pytest.mark.parametrize("way", ["listen", "connect"])
def test_a_truck_open_to_everybody_fails(endpoint: str, way: str, tmp_path: Path):
    assert bad(see(tmp_path / "a", access)) == {}
    opened = {way: (endpoint,), "insecure": True}
    found = see(tmp_path / "b", access, lambda emulated: emulated.change(zenoh=opened))["access"]
    assert (found.level, found.reason) == (Level.FAIL, Reason.LINK_OPEN)
    assert endpoint in found.seen


PLACE = Path("/pki")


def with_tls(emulated: EmulatedHost, *, robot_days: int = 90, anna_days: int = 90, mode: int = 0o600) -> None:
    """The robot's files as `security` makes them; Anna's issuer may live shorter than any that `security` makes."""
    security = Folder(emulated.folder / "security")
    made = int(NOW) - 100 * DAY + 60
    security.init("truck", ("truck.local",), PLACE, made, 100 + robot_days)
    security.add("ben", AccessRole.OBSERVER, Role.STATION, made)
    security.add("anna", AccessRole.PILOT, Role.STATION, made)
    issuer = new_issuer(security.authority(), "Issuer of anna", made, 100 + anna_days)
    with (security.robot / "pilots.pem").open("wb") as pilots:
        pilots.write(security.issuer("ben").pem + issuer.pem)
    for file in security.robot.iterdir():
        emulated.put(f"pki/{file.name}", file.read_text()).chmod(0o644)
    (emulated.folder / "pki/robot.key").chmod(mode)
    emulated.change(zenoh=security.zenoh().model_dump())


def test_certificates_and_their_key(tmp_path: Path):
    # The service's user is another than the files' owner.
    found = bad(see(tmp_path / "a", access, with_tls))
    assert found["tls"].seen == "monstertruckd may not read /pki/robot.key"
    assert found["tls"].fix == "sudo chown monstertruckd /pki/robot.key"

    found = bad(see(tmp_path / "b", access, lambda emulated: with_tls(emulated, mode=0o640)))
    assert (found["tls"].level, found["tls"].fix) == (Level.WARN, "sudo chmod 600 /pki/robot.key")


@pytest.mark.parametrize("name", ["stations.pem", "pilots.pem", "robot.pem", "robot.key"])
def test_every_file_must_be_there(name: str, tmp_path: Path):
    def gone(emulated: EmulatedHost) -> None:
        with_tls(emulated, mode=0o644)
        (emulated.folder / "pki" / name).unlink()

    (found,) = (one for one in see_all(tmp_path, access, gone) if one.check == "tls" and one.level is Level.FAIL)
    assert found.seen == f"/pki/{name}: no such file"


def test_requests_that_arrive_and_those_that_are_dropped_are_named(tmp_path: Path):
    found = see(tmp_path, access, with_tls)
    assert found["access"].seen == "tls/0.0.0.0:7447, tls/0.0.0.0:7448, by certificate"
    assert found["names"].level is Level.OK
    assert found["names"].seen.startswith("anna (pilot), ben (observer); Zenoh silently drops requests under names")
    assert "names" not in see(tmp_path / "open", access)


@pytest.mark.parametrize(
    ("days", "level", "words"),
    [(29, Level.WARN, "expires in 29 days"), (-2, Level.FAIL, "expired 2 days ago")],
)
def test_what_expires(days: int, level: Level, words: str, tmp_path: Path):
    """The robot's own certificate, and any in the files of who is let in."""
    for number, (which, name) in enumerate(
        (
            ({"robot_days": days}, "/pki/robot.pem: certificate of truck"),
            ({"anna_days": days}, "/pki/pilots.pem: certificate of Issuer of anna"),
        )
    ):
        found = see_all(tmp_path / str(number), access, lambda emulated, which=which: with_tls(emulated, **which))
        (bad_one,) = (one for one in found if one.check == "certificate" and one.level is not Level.OK)
        assert (bad_one.level, bad_one.seen) == (level, f"{name} {words}")
        assert bad_one.fix is not None
        assert bad_one.fix.endswith("security show")
        good = [one.seen for one in found if one.check == "certificate" and one.level is Level.OK]
        assert len(good) == 2


def test_a_file_that_holds_no_certificate(tmp_path: Path):
    def damaged(emulated: EmulatedHost) -> None:
        with_tls(emulated)
        emulated.put("pki/robot.pem", "no certificate")

    found = see(tmp_path, access, damaged)["certificate"]
    assert (found.level, found.seen) == (Level.FAIL, "/pki/robot.pem: expected certificates")


def test_files_that_this_user_may_not_read_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("os.access", lambda path, mode: False)
    found = see(tmp_path, access, with_tls)
    assert "certificate" not in found
    monkeypatch.undo()

    def closed(path: Path) -> None:
        raise PermissionError(13, "Permission denied")

    def behind_a_closed_folder(emulated: EmulatedHost) -> None:
        with_tls(emulated)
        usual = Path.stat
        monkeypatch.setattr(
            Path, "stat", lambda path, **named: closed(path) if "pki" in path.parts else usual(path, **named)
        )

    found = see(tmp_path / "closed", access, behind_a_closed_folder)["tls"]
    assert (found.level, found.seen) == (Level.WARN, "/pki/robot.key: not checked, because this user may not read it")


def test_a_port_that_somebody_else_has(tmp_path: Path):
    def taken(emulated: EmulatedHost) -> None:
        row = "   0: 0100007F:1D17 00000000:0000 0A 00000000:00000000 00:00000000 00000000     0        0 1"
        emulated.put("proc/net/tcp", f"  sl  local_address rem_address   st\n{row}\n")

    def by_the_daemon(emulated: EmulatedHost) -> None:
        taken(emulated)
        emulated.process(55, "/usr/bin/python3", "-P", "-m", "monstertruckd", "run", "--config", "x")

    found = see(tmp_path / "a", access, taken)["port"]
    assert (found.reason, found.fix) == (Reason.BUSY, "sudo ss -ltnp 'sport = :7447'")
    assert "port" not in see(tmp_path / "b", access, by_the_daemon)

    def pilots_port_taken(emulated: EmulatedHost) -> None:
        with_tls(emulated)
        row = "   0: 00000000:1D18 00000000:0000 0A 00000000:00000000 00:00000000 00000000     0        0 1"
        emulated.put("proc/net/tcp", f"  sl  local_address rem_address   st\n{row}\n")

    assert see(tmp_path / "c", access, pilots_port_taken)["port"].fix == "sudo ss -ltnp 'sport = :7448'"
