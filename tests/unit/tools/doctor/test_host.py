"""Clock, disk, heat, memory, link, and who may reach the daemon."""

from pathlib import Path

import pytest

from monstertruck_schemas.reasons import Reason
from monstertruckd.tools.doctor.access import access
from monstertruckd.tools.doctor.finding import Level
from monstertruckd.tools.doctor.host import calendar, condition, link
from tests.unit.tools.doctor.kit import NOW, Ward, bad, see

NTP = "sudo timedatectl set-ntp true"


def unsynchronized(ward: Ward) -> None:
    (ward.folder / "run/systemd/timesync/synchronized").unlink()


def test_the_clock(tmp_path: Path):
    assert bad(see(tmp_path / "a", calendar)) == {}
    found = see(tmp_path / "b", calendar, unsynchronized)["clock"]
    assert (found.level, found.reason, found.mend) == (Level.WARN, Reason.CLOCK_UNSET, NTP)

    def by_chrony(ward: Ward) -> None:
        unsynchronized(ward)
        ward.process(99, "/usr/sbin/chronyd")

    assert see(tmp_path / "c", calendar, by_chrony)["clock"].seen == "kept by chronyd"
    found = see(tmp_path / "d", calendar, lambda ward: ward.clock.step_real(-NOW))["clock"]
    assert (found.level, found.reason, found.mend) == (Level.FAIL, Reason.CLOCK_UNSET, NTP)

    def no_chip(ward: Ward) -> None:
        (ward.folder / "sys/class/rtc/rtc0/name").unlink()
        (ward.folder / "sys/class/rtc/rtc0").rmdir()

    assert see(tmp_path / "e", calendar, no_chip)["clock chip"].seen.startswith("none: ")


def test_the_computer_in_need(tmp_path: Path):
    assert bad(see(tmp_path / "a", condition)) == {}

    def spoil(ward: Ward) -> None:
        ward.change(monitors={"host": {"kind": "host_health", "disk": 10**18, "disk_clear": 10**18 + 1}})
        ward.host.inject("memory", "0.04")
        ward.host.inject("temperature", "91")

    found = bad(see(tmp_path / "b", condition, spoil))
    assert {name: finding.reason for name, finding in found.items()} == {
        "disk": Reason.DISK_LOW,
        "memory": Reason.MEMORY_LOW,
        "heat": Reason.HOST_HOT,
    }
    assert found["disk"].level is Level.FAIL
    assert found["disk"].mend == f"du -xh {tmp_path}/b/var/lib/monstertruckd/logs | sort -h | tail"
    assert found["memory"].seen.startswith("4% of ")

    slow = see(tmp_path / "c", condition, lambda ward: ward.host.inject("cap", "0.5"))["heat"]
    assert slow.reason is Reason.HOST_THROTTLED
    broken = see(tmp_path / "d", condition, lambda ward: ward.host.inject("broken"))["host"]
    assert "/proc/stat" in broken.seen


def test_the_network_link(tmp_path: Path):
    assert see(tmp_path / "a", link)["link"].seen == "wlan0 (wifi): good, -55 dBm"
    weak = see(tmp_path / "b", link, lambda ward: ward.network.inject("signal", "-82"))["link"]
    assert (weak.level, weak.reason, weak.seen) == (Level.WARN, Reason.LINK_WEAK, "wlan0 (wifi): poor, -82 dBm")
    down = see(tmp_path / "c", link, lambda ward: ward.network.inject("wifi", "off"))["link"]
    assert (down.reason, down.mend) == (Reason.LINK_DOWN, "ip -brief link")


@pytest.mark.parametrize("listen", ["tcp/0.0.0.0:7447", "tcp/192.168.1.5:7447", "udp/[::]:7447"])
def test_a_truck_open_to_everybody_fails(listen: str, tmp_path: Path):
    assert bad(see(tmp_path / "a", access)) == {}
    found = see(tmp_path / "b", access, lambda ward: ward.change(zenoh={"listen": (listen,)}))["access"]
    assert (found.level, found.reason) == (Level.FAIL, Reason.LINK_OPEN)
    assert listen in found.seen


def with_tls(ward: Ward, mode: int = 0o600) -> None:
    tls = {"ca": Path("/pki/ca.pem"), "certificate": Path("/pki/truck.pem"), "key": Path("/pki/truck.key")}
    ward.change(zenoh={"listen": ("tls/0.0.0.0:7447",), "tls": {**tls, "pilots": ("anna",)}})
    for file in tls.values():
        ward.put(str(file.relative_to("/"))).chmod(0o644)
    (ward.folder / "pki/truck.key").chmod(mode)
    ward.runs(openssl=(0, ""))


def test_certificates_and_their_key(tmp_path: Path):
    # The service's user is another than the files' owner.
    found = bad(see(tmp_path / "a", access, with_tls))
    assert found["tls"].seen == "monstertruckd may not read /pki/truck.key"
    assert found["tls"].mend == "sudo chown monstertruckd /pki/truck.key"

    found = bad(see(tmp_path / "b", access, lambda ward: with_tls(ward, 0o640)))
    assert (found["tls"].level, found["tls"].mend) == (Level.WARN, "sudo chmod 600 /pki/truck.key")

    def gone(ward: Ward) -> None:
        with_tls(ward)
        (ward.folder / "pki/truck.key").unlink()

    assert see(tmp_path / "c", access, gone)["tls"].seen == "/pki/truck.key: no such file"

    def old(ward: Ward) -> None:
        with_tls(ward)
        ward.runs(openssl=(1, "Certificate will expire"))

    found = see(tmp_path / "d", access, old)
    assert found["access"].seen == "tls/0.0.0.0:7447, by certificate"
    assert found["certificate"].mend == "openssl x509 -noout -dates -in /pki/truck.pem"


def test_a_port_that_somebody_else_has(tmp_path: Path):
    def taken(ward: Ward) -> None:
        row = "   0: 0100007F:1D17 00000000:0000 0A 00000000:00000000 00:00000000 00000000     0        0 1"
        ward.put("proc/net/tcp", f"  sl  local_address rem_address   st\n{row}\n")

    def by_the_daemon(ward: Ward) -> None:
        taken(ward)
        ward.process(55, "/usr/bin/python3", "-P", "-m", "monstertruckd", "run", "--config", "x")

    found = see(tmp_path / "a", access, taken)["port"]
    assert (found.reason, found.mend) == (Reason.BUSY, "sudo ss -ltnp 'sport = :7447'")
    assert "port" not in see(tmp_path / "b", access, by_the_daemon)
