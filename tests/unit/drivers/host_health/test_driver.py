"""The host monitor against emulated files, on the virtual clock."""

import os
from collections.abc import Callable, Coroutine
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from monstertruck_drivers.computer import ROOT, Computer
from monstertruck_drivers.host_health.config import HostHealthConfig
from monstertruck_drivers.host_health.driver import HostHealthDriver
from monstertruck_drivers.host_health.emulator import HostEmulator
from monstertruck_runtime.clock import VirtualClock, WallClock, run_virtual
from monstertruck_runtime.errors import ProtocolError
from monstertruck_schemas.event import Severity
from monstertruck_schemas.health import HostHealth
from monstertruck_schemas.reasons import Reason
from tests.unit.drivers.kit import Events, Kept, background, emulated_computer


class Rig:
    def __init__(self, clock: VirtualClock, root: Path, **config: Any) -> None:
        self.clock = clock
        self.emulator = HostEmulator(root, clock)
        self.out: Kept[HostHealth] = Kept()
        self.events = Events()
        self.driver = HostHealthDriver(
            HostHealthConfig(disk_path=root, **{"disk": 0, "disk_clear": 1} | config),
            emulated_computer(root, clock), clock, self.out, self.events,
        )  # fmt: skip

    async def follow(self, *steps: tuple[str, str, float]) -> None:
        """Faults and the seconds after each."""
        for fault, value, seconds in steps:
            self.emulator.inject(fault, value)
            await self.clock.sleep(seconds)


def on_bench(tmp_path: Path, test: Callable[[Rig], Coroutine[Any, Any, None]], **config: Any) -> None:
    async def main(clock: VirtualClock) -> None:
        rig = Rig(clock, tmp_path, **config)
        async with background(rig.emulator.run()), background(rig.driver.run(lambda: None)):
            await test(rig)

    run_virtual(main)


def test_health_is_published_once_a_second(tmp_path: Path):
    async def test(rig: Rig) -> None:
        await rig.clock.sleep(10)
        assert len(rig.out.kept) == pytest.approx(10, abs=1)
        assert rig.out.kept[0].cpu is None, "a share needs two looks"
        last = rig.out.last
        assert (last.cpu, last.cores, last.temperature, last.throttled) == (0.25, 4, 50.0, False)
        assert (last.memory_total, last.daemon_files) == (4_096_000_000, 7)
        assert rig.events.kept == []

    on_bench(tmp_path, test)


@pytest.mark.parametrize(
    ("fault", "good", "bad", "between", "reason", "severity"),
    [
        ("temperature", "50", "85", "77", Reason.HOST_HOT, Severity.WARNING),
        ("busy", "0.2", "0.99", "0.9", Reason.HOST_BUSY, Severity.WARNING),
        ("memory", "0.5", "0.05", "0.12", Reason.MEMORY_LOW, Severity.ERROR),
        ("cap", "1.0", "0.5", "0.6", Reason.HOST_THROTTLED, Severity.WARNING),
        ("firmware", "50000", "50004", "50002", Reason.HOST_THROTTLED, Severity.WARNING),
    ],
)
def test_limits(tmp_path: Path, fault: str, good: str, bad: str, between: str, reason: Reason, severity: Severity):
    async def test(rig: Rig) -> None:
        await rig.follow((fault, bad, 2.0), (fault, good, 5.0))
        assert rig.events.kept == [], "a short while is no news"
        await rig.follow((fault, bad, 15.0), (fault, between, 15.0))
        assert rig.events.reasons() == [reason]
        assert rig.events.kept[0][1] is severity
        await rig.follow((fault, good, 3.0))
        assert rig.events.reasons() == [reason, Reason.OK]
        assert rig.events.kept[1][2] == f"over: {reason.text}"

    on_bench(tmp_path, test)


def test_throttle_events_of_the_past_do_not_count(tmp_path: Path):
    async def test(rig: Rig) -> None:
        for _ in range(3):
            rig.emulator.inject("throttle")
        await rig.clock.sleep(3)
        assert not rig.out.last.throttled
        for _ in range(8):
            rig.emulator.inject("throttle")
            await rig.clock.sleep(1)
        assert rig.out.last.throttled
        assert rig.events.reasons() == [Reason.HOST_THROTTLED]
        await rig.clock.sleep(3)
        assert not rig.out.last.throttled

    on_bench(tmp_path, test)


def test_a_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    free = 10_000_000_000
    monkeypatch.setattr(os, "statvfs", lambda _: SimpleNamespace(f_frsize=1, f_blocks=20_000_000_000, f_bavail=free))

    async def test(rig: Rig) -> None:
        nonlocal free
        await rig.clock.sleep(3)
        free = 900_000_000
        await rig.clock.sleep(5)
        assert rig.out.last.disk_free == free
        free = 1_400_000_000
        await rig.clock.sleep(5)
        assert rig.events.reasons() == [Reason.DISK_LOW]
        free = 1_600_000_000
        await rig.clock.sleep(2)
        assert rig.events.reasons() == [Reason.DISK_LOW, Reason.OK]

    on_bench(tmp_path, test, disk=1_000_000_000, disk_clear=1_500_000_000)


def test_a_computer_that_tells_little_is_no_fault(tmp_path: Path):
    async def test(rig: Rig) -> None:
        rig.emulator.inject("blind")
        await rig.clock.sleep(5)
        assert (rig.out.last.temperature, rig.out.last.throttled) == (None, False)
        assert rig.events.kept == []

    on_bench(tmp_path, test)


def test_a_broken_proc_ends_the_session(tmp_path: Path):
    async def main(clock: VirtualClock) -> None:
        rig = Rig(clock, tmp_path)
        rig.emulator.inject("broken")
        await rig.driver.run(lambda: None)

    with pytest.raises(ProtocolError, match="processor times"):
        run_virtual(main)


def test_limits_must_leave_room():
    with pytest.raises(ValueError, match=r"hot_clear 75\.0 < hot 70\.0"):
        HostHealthConfig(hot=70.0)


async def test_this_computer_in_a_thread(tmp_path: Path):
    out: Kept[HostHealth] = Kept()
    clock, config = WallClock(), HostHealthConfig(rate=10.0, disk_path=tmp_path)
    driver = HostHealthDriver(config, Computer.at(ROOT, clock), clock, out, Events())
    async with background(driver.run(lambda: None)):
        await out.count(3)
    assert out.last.cpu is not None
    assert out.last.daemon_memory > 1_000_000
