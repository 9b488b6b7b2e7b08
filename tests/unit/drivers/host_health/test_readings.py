"""What /proc and /sys say, and what they may leave out."""

import os
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from monstertruck_drivers.catalog import DEVICES
from monstertruck_drivers.computer import ROOT, Computer, disk_of
from monstertruck_drivers.host_health.emulator import HostEmulator
from monstertruck_drivers.host_health.readings import (
    Times,
    busy_share,
    parse_meminfo,
    parse_stat,
    read_host,
)
from monstertruck_runtime.clock import WallClock
from monstertruck_runtime.errors import DeviceError, InputError, ProtocolError, TruckError


def test_processor_times():
    text = "cpu  100 20 30 400 50 6 7 8 999 999\ncpu0 1 2 3 4\ncpu1 1 2 3 4\nintr 5 6\n"
    cores, times = parse_stat(text)
    assert cores == 2
    assert times == Times(busy=100 + 20 + 30 + 6 + 7 + 8, total=621)
    assert parse_stat("cpu 1 2 3 4") == (1, Times(6, 10))


def test_busy_share():
    assert busy_share(Times(100, 1000), Times(150, 1100)) == 0.5
    assert busy_share(Times(100, 1000), Times(100, 1000)) is None
    assert busy_share(Times(100, 1000), Times(90, 1100)) == 0.0, "idle time may go back a little"


def test_memory():
    assert parse_meminfo("MemTotal:  100 kB\nMemFree: 1 kB\nMemAvailable: 60 kB\nHugePages: x\n") == (102400, 61440)
    with pytest.raises(ProtocolError, match="no row 'MemAvailable'"):
        parse_meminfo("MemTotal: 100 kB")


@settings(max_examples=100)
@given(st.text(max_size=100))
@example(":²")
def test_any_text_is_read_or_refused(text: str):
    for parse in (parse_stat, parse_meminfo):
        try:
            parse(text)
        except TruckError:
            continue


def test_everything_of_a_board(tmp_path: Path):
    emulator = HostEmulator(tmp_path, WallClock())
    emulator.inject("cap", "0.5")
    emulator.inject("throttle")
    emulator.inject("firmware", "50001")
    reading = read_host(tmp_path, disk_of(tmp_path))
    assert (reading.cores, reading.load) == (4, 1.0)
    assert reading.temperature == 50.0, "the zone of -274 degrees is no zone"
    assert reading.frequency == pytest.approx(0.81e9)
    assert reading.frequency_share == 0.5
    assert (reading.throttle_events, reading.firmware_throttled) == (4, True)
    assert (reading.memory_total, reading.memory_available) == (4_096_000_000, 2_457_600_000)
    assert reading.daemon_memory == 12000 * os.sysconf("SC_PAGE_SIZE")
    assert reading.daemon_files == 7
    assert 0 < reading.disk.free <= reading.disk.total


@pytest.mark.parametrize(("word", "now"), [("0", False), ("50000", False), ("1", True), ("8", True), ("zz", False)])
def test_the_firmwares_word_of_the_past_does_not_count(tmp_path: Path, word: str, now: bool):
    HostEmulator(tmp_path, WallClock())
    (tmp_path / "sys/devices/platform/soc/soc:firmware/get_throttled").write_text(word)
    assert read_host(tmp_path, disk_of(tmp_path)).firmware_throttled is now


def test_what_sys_does_not_tell_is_none(tmp_path: Path):
    HostEmulator(tmp_path, WallClock()).inject("blind")
    reading = read_host(tmp_path, disk_of(tmp_path))
    assert (reading.temperature, reading.frequency, reading.frequency_share) == (None, None, None)
    assert (reading.throttle_events, reading.firmware_throttled) == (0, False)


@pytest.mark.parametrize("file", ["loadavg", "stat", "meminfo", "self/statm"])
def test_proc_must_be_as_documented(tmp_path: Path, file: str):
    HostEmulator(tmp_path, WallClock())
    (tmp_path / "proc" / file).write_text("")
    with pytest.raises(ProtocolError):
        read_host(tmp_path, disk_of(tmp_path))
    (tmp_path / "proc" / file).unlink()
    with pytest.raises(DeviceError, match="cannot be read"):
        read_host(tmp_path, disk_of(tmp_path))


def test_a_disk_path_that_does_not_exist_yet_counts_as_its_parent(tmp_path: Path):
    HostEmulator(tmp_path, WallClock())
    assert disk_of(tmp_path / "a/b/c").total == disk_of(tmp_path).total
    assert disk_of(Path("no-such-folder")).total > 0


async def test_the_probe_on_this_computer():
    found = await DEVICES["host_health"].identify(Computer.at(ROOT, WallClock()), WallClock())
    assert found["cores"] >= 1
    assert found["daemon_memory"] > 1_000_000
    assert found["daemon_files"] > 2


def test_unknown_faults_are_refused_with_a_list(tmp_path: Path):
    emulator = HostEmulator(tmp_path, WallClock())
    for fault in (("explode",), ("temperature", "warm")):
        with pytest.raises(InputError, match="known: temperature"):
            emulator.inject(*fault)
