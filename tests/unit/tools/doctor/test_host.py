"""Clock, disk, heat, memory, link, and who may reach the daemon."""

from pathlib import Path

import pytest

from monstertruck_schemas.reasons import Reason
from monstertruckd.tools.doctor.computer import access, calendar, condition, link
from monstertruckd.tools.doctor.context import Level
from tests.unit.tools.doctor.kit import NOW, EmulatedHost, bad, see

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

    assert see(tmp_path / "c", calendar, by_chrony)["clock"].seen == "kept by chronyd"
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


@pytest.mark.parametrize("listen", ["tcp/0.0.0.0:7447", "tcp/192.168.1.5:7447", "udp/[::]:7447"])
def test_a_truck_open_to_everybody_fails(listen: str, tmp_path: Path):
    assert bad(see(tmp_path / "a", access)) == {}
    opened = {"listen": (listen,), "insecure": True}
    found = see(tmp_path / "b", access, lambda emulated: emulated.change(zenoh=opened))["access"]
    assert (found.level, found.reason) == (Level.FAIL, Reason.LINK_OPEN)
    assert listen in found.seen


def with_tls(emulated: EmulatedHost, mode: int = 0o600) -> None:
    tls = {"ca": Path("/pki/ca.pem"), "certificate": Path("/pki/truck.pem"), "key": Path("/pki/truck.key")}
    emulated.change(zenoh={"listen": ("tls/0.0.0.0:7447",), "tls": {**tls, "pilots": ("anna",)}})
    for file in tls.values():
        emulated.put(str(file.relative_to("/"))).chmod(0o644)
    (emulated.folder / "pki/truck.key").chmod(mode)
    emulated.runs(openssl=(0, ""))


def test_certificates_and_their_key(tmp_path: Path):
    # The service's user is another than the files' owner.
    found = bad(see(tmp_path / "a", access, with_tls))
    assert found["tls"].seen == "monstertruckd may not read /pki/truck.key"
    assert found["tls"].fix == "sudo chown monstertruckd /pki/truck.key"

    found = bad(see(tmp_path / "b", access, lambda emulated: with_tls(emulated, 0o640)))
    assert (found["tls"].level, found["tls"].fix) == (Level.WARN, "sudo chmod 600 /pki/truck.key")

    def gone(emulated: EmulatedHost) -> None:
        with_tls(emulated)
        (emulated.folder / "pki/truck.key").unlink()

    assert see(tmp_path / "c", access, gone)["tls"].seen == "/pki/truck.key: no such file"

    def old(emulated: EmulatedHost) -> None:
        with_tls(emulated)
        emulated.runs(openssl=(1, "Certificate will expire"))

    found = see(tmp_path / "d", access, old)
    assert found["access"].seen == "tls/0.0.0.0:7447, by certificate"
    assert found["certificate"].fix == "openssl x509 -noout -dates -in /pki/truck.pem"


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
