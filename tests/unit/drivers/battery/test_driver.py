"""The IIO driver against the emulated converter, on the virtual clock."""

import asyncio
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import pytest

from monstertruck_drivers.battery.config import IioConfig
from monstertruck_drivers.battery.driver import IioBatteryDriver
from monstertruck_drivers.battery.emulator import IioEmulator
from monstertruck_drivers.battery.iio import CONVERTERS
from monstertruck_drivers.computer import Computer
from monstertruck_runtime.clock import VirtualClock, WallClock, run_virtual
from monstertruck_runtime.errors import DeviceLostError, InputError, ProtocolError
from monstertruck_runtime.mailbox import Mailbox, latest
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import Battery, BatteryLevel, DriveFeedback, DriveMode
from tests.unit.drivers.kit import Events, Kept, background, emulated_computer

pytestmark = pytest.mark.virtual


class Rig:
    def __init__(self, clock: VirtualClock, root: Path, **config: Any) -> None:
        self.clock = clock
        self.volts = 23.5
        self.emulator = IioEmulator(root, clock, lambda _: self.volts / 10)
        self.out: Kept[Battery] = Kept()
        self.events = Events()
        self.drive: Mailbox[DriveFeedback] = Mailbox(latest())
        self.ready = 0
        self.driver = IioBatteryDriver(
            IioConfig(**config), emulated_computer(root, clock), clock, self.out, self.events, self.drive
        )

    def current(self, amperes: float | None) -> None:
        now = self.clock.now()
        feedback = DriveFeedback(
            stamp=now, received=now, seq=0, position=0.0, velocity=0.0, current=amperes, mode=DriveMode.ENABLED
        )
        self.drive.put(feedback)

    async def session(self) -> None:
        def ready() -> None:
            self.ready += 1

        await self.driver.run(ready)


def on_bench(tmp_path: Path, test: Callable[[Rig], Coroutine[Any, Any, None]], **config: Any) -> None:
    async def main(clock: VirtualClock) -> None:
        rig = Rig(clock, tmp_path, **config)
        async with background(rig.emulator.run()):
            await test(rig)

    run_virtual(main)


def test_volts_level_and_charge_are_published_ten_times_a_second(tmp_path: Path):
    async def test(rig: Rig) -> None:
        async with background(rig.session()):
            await rig.clock.sleep(10)
        assert rig.ready == 1
        assert len(rig.out.kept) == pytest.approx(100, abs=2)
        last = rig.out.last
        assert last.voltage == pytest.approx(23.5, abs=0.02)
        assert last.cell_voltage == pytest.approx(23.5 / 6, abs=0.01)
        assert last.charge == pytest.approx(0.66, abs=0.05)
        assert (last.level, last.cells, last.capacity_ah) == (BatteryLevel.NORMAL, 6, 3.7)
        assert rig.events.kept == []

    on_bench(tmp_path, test, capacity_ah=3.7)


def test_low_critical_and_overcharged_are_reported_once_each(tmp_path: Path):
    async def test(rig: Rig) -> None:
        async with background(rig.session()):
            for volts, seconds in ((23.5, 2), (25.6, 4), (23.5, 2), (21.8, 4), (20.5, 4), (23.0, 5)):
                rig.volts = volts
                await rig.clock.sleep(seconds)
        assert rig.events.reasons() == [
            Reason.BATTERY_OVERCHARGED, Reason.OK, Reason.BATTERY_LOW, Reason.BATTERY_CRITICAL, Reason.OK,
        ]  # fmt: skip

    on_bench(tmp_path, test, low_after=2.0, critical_after=2.0, clear_after=3.0)


def test_a_fresh_motor_current_explains_the_sag_and_a_stale_one_does_not(tmp_path: Path):
    async def test(rig: Rig) -> None:
        rig.volts = 21.8
        async with background(rig.session()):
            for _ in range(40):
                rig.current(6.0)
                await rig.clock.sleep(0.1)
            assert rig.out.last.level is BatteryLevel.NORMAL
            assert rig.out.last.voltage == pytest.approx(21.8, abs=0.02)
            assert rig.out.last.rest_voltage == pytest.approx(21.8 + 0.36, abs=0.02)
            rig.current(None)  # feedback without a current keeps the last one for a while
            await rig.clock.sleep(4)
            assert rig.out.last.level is BatteryLevel.LOW

    on_bench(tmp_path, test, low_after=2.0)


@pytest.mark.parametrize("fault", ["zero", "full"])
def test_an_end_of_the_scale_is_the_sensors_fault_not_an_empty_battery(tmp_path: Path, fault: str):
    async def test(rig: Rig) -> None:
        async with background(rig.session()):
            await rig.clock.sleep(1)
            rig.emulator.inject(fault, "on")
            await rig.clock.sleep(1)
            assert rig.out.last.level is BatteryLevel.SENSOR_FAULT
            assert (rig.out.last.voltage, rig.out.last.charge) == (None, None)
            rig.emulator.inject(fault, "off")
            await rig.clock.sleep(1)
            assert rig.out.last.level is BatteryLevel.NORMAL
        assert rig.events.reasons() == [Reason.DEVICE_FAULT, Reason.OK]

    on_bench(tmp_path, test, divider=8.0)


def test_a_bouncing_connector_is_no_news(tmp_path: Path):
    async def test(rig: Rig) -> None:
        async with background(rig.session()):
            for _ in range(20):
                rig.emulator.inject("bounce")
                await rig.clock.sleep(1)
        assert rig.events.kept == []
        assert min(m.raw_voltage for m in rig.out.kept) < 1.0

    on_bench(tmp_path, test)


def test_a_vanished_converter_ends_the_session_and_a_new_one_works(tmp_path: Path):
    async def test(rig: Rig) -> None:
        task = asyncio.create_task(rig.session())
        await rig.clock.sleep(1)
        rig.emulator.inject("unplug")
        for attempt in (task, rig.session()):
            with pytest.raises(DeviceLostError):
                await attempt
        rig.emulator.inject("plug")
        async with background(rig.session()):
            await rig.out.count(5)

    on_bench(tmp_path, test)


def test_single_failures_are_forgiven_three_in_a_row_are_not(tmp_path: Path):
    async def test(rig: Rig) -> None:
        async with background(rig.session()) as task:
            for _ in range(5):
                await rig.clock.sleep(0.5)
                rig.emulator.inject("garbage", "on")
                await rig.clock.sleep(0.15)
                rig.emulator.inject("garbage", "off")
            assert not task.done()
            rig.emulator.inject("garbage", "on")
            await rig.clock.sleep(0.5)

    with pytest.raises(ProtocolError):
        on_bench(tmp_path, test)


def test_unknown_faults_are_refused_with_a_list(tmp_path: Path):
    async def test(rig: Rig) -> None:
        with pytest.raises(InputError, match="known: zero"):
            rig.emulator.inject("explode")
        with pytest.raises(InputError, match="known: zero"):
            rig.emulator.inject("volts", "x")
        rig.emulator.inject("noise", "0")
        rig.emulator.inject("volts", "2.0")
        rig.emulator.convert()
        rig.emulator.inject("freeze", "on")
        rig.emulator.inject("bounce", "0.0")
        rig.emulator.convert()
        assert (tmp_path / CONVERTERS / "iio:device0/in_voltage0_raw").read_text() == "2000\n"

    on_bench(tmp_path, test)


async def test_files_are_read_in_a_thread_by_default(tmp_path: Path):
    """On the wall clock, in a thread."""
    clock = WallClock()
    IioEmulator(tmp_path, clock, lambda _: 2.4)
    out: Kept[Battery] = Kept()
    driver = IioBatteryDriver(IioConfig(rate=50.0), Computer.at(tmp_path, clock), clock, out, Events())
    async with background(driver.run(lambda: None)):
        await out.count(6)
    assert out.last.voltage == pytest.approx(24.0, abs=0.1)
