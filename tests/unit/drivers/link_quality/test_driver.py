"""The link monitor against emulated files, on the virtual clock."""

from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import pytest

from monstertruck_drivers.computer import ROOT, Computer
from monstertruck_drivers.link_quality.config import LinkQualityConfig
from monstertruck_drivers.link_quality.driver import LinkQualityDriver
from monstertruck_drivers.link_quality.emulator import ON_AIR, NetworkEmulator
from monstertruck_runtime.clock import SECOND, VirtualClock, WallClock, run_virtual
from monstertruck_schemas.event import Severity
from monstertruck_schemas.health import LinkHealth, LinkLevel, LinkMedium
from monstertruck_schemas.reasons import Reason
from tests.unit.drivers.kit import Events, Kept, background, emulated_computer


class Rig:
    def __init__(self, clock: VirtualClock, root: Path, **config: Any) -> None:
        self.clock = clock
        self.emulator = NetworkEmulator(root, clock)
        self.out: Kept[LinkHealth] = Kept()
        self.events = Events()
        self.ready = 0
        self.driver = LinkQualityDriver(
            LinkQualityConfig(**config), emulated_computer(root, clock), clock, self.out, self.events
        )

    def be_ready(self) -> None:
        self.ready += 1


def on_bench(tmp_path: Path, test: Callable[[Rig], Coroutine[Any, Any, None]], **config: Any) -> None:
    async def main(clock: VirtualClock) -> None:
        rig = Rig(clock, tmp_path, **config)
        async with background(rig.emulator.run()), background(rig.driver.run(rig.be_ready)):
            await test(rig)

    run_virtual(main)


def test_quality_and_traffic_are_published_once_a_second(tmp_path: Path):
    async def test(rig: Rig) -> None:
        await rig.clock.sleep(10)
        assert len(rig.out.kept) == pytest.approx(10, abs=1)
        last = rig.out.last
        assert (last.interface, last.medium, last.level) == ("wlan0", LinkMedium.WIFI, LinkLevel.GOOD)
        assert (last.signal, last.raw_signal, last.noise) == (-55.0, -55.0, None)
        assert last.receive_rate == pytest.approx(ON_AIR, rel=0.01)
        assert last.send_rate == pytest.approx(ON_AIR / 2, rel=0.01)
        assert last.errors == 3
        assert rig.ready > 0
        assert rig.events.kept == []

    on_bench(tmp_path, test)


def test_driving_away_and_back_is_reported_once_each_way(tmp_path: Path):
    async def test(rig: Rig) -> None:
        start = rig.clock.now()
        rig.emulator._signal = lambda now: -50 - 2.0 * (30 - abs((now - start) / SECOND - 30))
        await rig.clock.sleep(60)
        levels = list(dict.fromkeys(message.level for message in rig.out.kept))
        assert levels == [LinkLevel.GOOD, LinkLevel.FAIR, LinkLevel.POOR, LinkLevel.UNUSABLE]
        assert rig.events.reasons() == [Reason.LINK_WEAK, Reason.OK]
        assert rig.events.kept[0][1] is Severity.WARNING

    on_bench(tmp_path, test)


def test_lost_and_found(tmp_path: Path):
    async def test(rig: Rig) -> None:
        await rig.clock.sleep(3)
        rig.emulator.inject("wifi", "off")
        await rig.clock.sleep(3)
        assert rig.out.last.level is LinkLevel.DOWN
        assert (rig.out.last.signal, rig.out.last.raw_signal) == (None, None)
        rig.emulator.inject("remove")
        await rig.clock.sleep(3)
        assert (rig.out.last.level, rig.out.last.interface) == (LinkLevel.DOWN, None)
        rig.emulator.inject("plug")
        rig.emulator.inject("wifi", "on")
        await rig.clock.sleep(3)
        assert rig.out.last.level is LinkLevel.GOOD
        assert rig.events.reasons() == [Reason.LINK_DOWN, Reason.OK]

    on_bench(tmp_path, test, interface="wlan0")


def test_a_cable_takes_over(tmp_path: Path):
    async def test(rig: Rig) -> None:
        rig.emulator.inject("cable", "on")
        await rig.clock.sleep(3)
        assert rig.out.last.bit_rate is None
        rig.emulator.inject("wifi", "off")
        await rig.out.count(1)
        assert (rig.out.last.interface, rig.out.last.receive_rate) == ("eth0", None), "rates need two looks"
        await rig.clock.sleep(3)
        last = rig.out.last
        assert (last.level, last.bit_rate, last.signal) == (LinkLevel.EXCELLENT, 1e9, None)
        assert rig.events.kept == []

    on_bench(tmp_path, test)


def test_counters_that_begin_anew_give_no_rate(tmp_path: Path):
    async def test(rig: Rig) -> None:
        await rig.clock.sleep(5)
        rig.emulator.inject("reset")
        await rig.clock.sleep(1)
        rates = [message.receive_rate for message in rig.out.kept[2:]]
        assert None in rates
        assert all(rate is None or rate >= 0 for rate in rates)

    on_bench(tmp_path, test)


@pytest.mark.parametrize(
    ("style", "level", "signal"),
    [
        ("no_dot", LinkLevel.GOOD, -55.0),
        ("unsigned", LinkLevel.GOOD, -55.0),
        ("header", LinkLevel.UNKNOWN, None),
        ("missing", LinkLevel.UNKNOWN, None),
    ],
)
def test_every_form_of_the_kernels_table(tmp_path: Path, style: str, level: LinkLevel, signal: float | None):
    async def test(rig: Rig) -> None:
        rig.emulator.inject("style", style)
        await rig.clock.sleep(5)
        assert (rig.out.last.level, rig.out.last.raw_signal) == (level, signal)
        assert rig.events.kept == []

    on_bench(tmp_path, test)


async def test_this_computers_own_link_in_a_thread():
    out: Kept[LinkHealth] = Kept()
    clock = WallClock()
    driver = LinkQualityDriver(LinkQualityConfig(rate=10.0), Computer.at(ROOT, clock), clock, out, Events())
    async with background(driver.run(lambda: None)):
        await out.count(2)
