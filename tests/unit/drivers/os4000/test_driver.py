"""The driver against the emulator on the virtual clock: start states, damage, loss."""

import asyncio
import json
import math
from pathlib import Path

import numpy as np
import pytest

from monstertruck_drivers.cable import DeviceEnd, MemoryPort, PtyPort
from monstertruck_drivers.catalog import DEVICES
from monstertruck_drivers.os4000.config import Os4000Config
from monstertruck_drivers.os4000.driver import Os4000Driver
from monstertruck_drivers.os4000.emulator import Os4000Emulator
from monstertruck_drivers.os4000.protocol import frame
from monstertruck_drivers.tty import SerialPort
from monstertruck_runtime.clock import SECOND, VirtualClock, WallClock, run_virtual
from monstertruck_runtime.errors import (
    DeviceLostError,
    DeviceTimeoutError,
    PortBusyError,
    ProtocolError,
    WrongDeviceError,
)
from monstertruck_runtime.service import RestartPolicy, supervise
from monstertruck_schemas.event import Severity
from monstertruck_schemas.health import ServiceHealth
from monstertruck_schemas.reasons import Reason
from tests.unit.drivers.kit import Events, Kept, background
from tests.unit.drivers.os4000.rig import Rig, Table, bench


def on_bench(test, config: Os4000Config | None = None, **options):
    """Run ``test(rig)`` on the virtual clock."""

    async def main(clock: VirtualClock) -> None:
        async with bench(clock, config, **options) as rig:
            await test(rig)

    run_virtual(main)


def test_a_unit_that_streams_as_configured_is_only_listened_to():
    async def test(rig: Rig) -> None:
        start = rig.clock.now()
        async with rig.driving():
            await rig.out.count(20)
            assert rig.ready_at[0] - start < 0.8 * SECOND
        attitude = rig.out.kept[-1]
        assert attitude.heading == pytest.approx(math.radians(123.4))
        assert attitude.pitch == pytest.approx(-math.radians(5))
        assert attitude.roll == pytest.approx(math.radians(-7))
        assert attitude.tilt_valid
        assert not attitude.heading_disturbed
        assert [m.seq for m in rig.out.kept] == list(range(20))
        assert rig.sent == b""
        assert rig.events.kept == []

    on_bench(test)


def test_stamps_are_when_the_device_sampled():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.out.count(30)
        sampled = np.array(rig.table.times)
        for attitude in rig.out.kept:
            assert np.abs(sampled - attitude.stamp).min() < 10_000_000
            assert attitude.received > attitude.stamp

    on_bench(test)


@pytest.mark.parametrize(
    ("faults", "options"),
    [
        ([("pending",)], {}),
        ([("rate", "0")], {}),
        ([("rate", "-10")], {}),
        ([("rate", "5")], {}),
        ([("rate", "0"), ("pending",)], {}),
        ([("format", "2")], {}),
        ([("format", "4")], {}),
        ([("format", "8")], {}),
        ([], {"fields": 7}),
        ([], {"fields": 64, "rate": 3}),
        ([("rate", "7")], {"terminators": b"\r"}),
        ([("rate", "7")], {"terminators": b" "}),
        ([("bad_checksum", "3"), ("prompt",)], {}),
    ],
)
def test_every_start_state_ends_in_a_stream_as_configured(faults: list[tuple[str, ...]], options: dict):
    async def test(rig: Rig) -> None:
        for fault in faults:
            rig.emulator.inject(*fault)
        async with rig.driving():
            await rig.out.count(10)
            since = rig.clock.now()
            await rig.out.count(40)
            assert (rig.clock.now() - since) / SECOND == pytest.approx(2.0, abs=0.1)
        assert rig.emulator.settings.rate == 20
        assert rig.emulator.settings.fields == 335
        assert rig.emulator.settings.format == 1
        assert rig.out.kept[-1].acceleration is not None
        assert all(severity is Severity.INFO for _, severity, *_ in rig.events.kept)

    on_bench(test, **options)


def test_a_setting_is_written_once_and_only_what_differs():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.out.count(3)
        assert rig.sent == b"\x1bX335 "
        assert rig.events.reasons() == [Reason.DEVICE_MISMATCH]
        assert "heading+pitch+roll" in rig.events.kept[0][2]
        async with rig.driving():
            await rig.out.count(3)
        assert rig.sent == b"\x1bX335 "

    on_bench(test, fields=7)


def test_a_setting_that_does_not_stick_is_reported_and_lived_with():
    async def test(rig: Rig) -> None:
        rig.emulator.inject("drift", "-0.5")
        async with rig.driving():
            await rig.out.count(5)
        assert [severity for _, severity, *_ in rig.events.kept] == [Severity.INFO, Severity.WARNING]
        assert "even after setting it" in rig.events.kept[-1][2]

    on_bench(test)


def test_a_unit_without_tilt_cannot_serve():
    async def test(rig: Rig) -> None:
        rig.emulator.inject("empty_field", "P")
        with pytest.raises(ProtocolError, match="does not send pitch"):
            await rig.session()
        assert rig.ready_at == []

    on_bench(test)


# Damage and loss


def test_one_byte_at_a_time_and_delay():
    async def test(rig: Rig) -> None:
        rig.port.device.faults.chunk = 1
        rig.port.device.faults.delay = 0.02
        async with rig.driving():
            await rig.out.count(30)
        assert rig.events.kept == []

    on_bench(test)


def test_flipped_and_lost_bytes_never_become_attitudes():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.out.count(5)
            faults = rig.port.device.faults
            faults.seed(1)
            faults.flip_rate = faults.drop_rate = 0.002
            await rig.clock.sleep(30)
        assert len(rig.out.kept) > 300
        assert {round(math.degrees(m.heading), 1) for m in rig.out.kept} == {123.4}

    on_bench(test)


def test_garbage_and_prompts_in_the_stream_are_skipped():
    async def test(rig: Rig) -> None:
        rng = np.random.default_rng(2)
        async with rig.driving():
            await rig.out.count(5)
            for _ in range(20):
                rig.port.device.faults.garbage = rng.bytes(300)
                rig.emulator.inject("prompt")
                await rig.out.count(1)

    on_bench(test)


def test_a_sentence_out_of_range_is_reported_once_and_not_published():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.out.count(5)
            rig.table.turn(pitch_deg=120.0)
            await rig.clock.sleep(0.3)
            rig.table.turn(pitch_deg=1.0)
            await rig.out.count(5)
        assert all(abs(m.pitch) <= math.radians(90) for m in rig.out.kept)
        assert rig.events.reasons() == [Reason.DEVICE_PROTOCOL]
        assert "pitch 120.0" in rig.events.kept[0][2]

    on_bench(test)


def test_a_burst_is_spread_over_the_periods_it_came_from():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.out.count(5)
            await rig.clock.sleep(0.01)
            rig.port.device.baud = None
            rig.emulator.inject("silent", "on")
            await rig.clock.sleep(0.1)
            rig.out.kept.clear()
            rig.port.device.write(frame("C1.0P2.0R3.0") * 3)
            await rig.clock.sleep(0.01)
        stamps = [m.stamp for m in rig.out.kept]
        assert np.diff(stamps).tolist() == [SECOND // 20] * 2

    on_bench(test)


def test_silence_ends_the_session():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.out.count(5)
            rig.port.device.faults.stalled = True
            await rig.clock.sleep(0.7)

    with pytest.raises(DeviceTimeoutError, match=r"/dev/test: silent for 0\.5 s"):
        on_bench(test)


def test_bytes_without_sentences_end_the_session():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.out.count(5)
            rig.emulator.inject("bad_checksum", "1000")
            await rig.clock.sleep(0.7)

    with pytest.raises(ProtocolError, match="no usable sentence"):
        on_bench(test)


def test_unplugging_ends_the_session():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.out.count(5)
            rig.port.unplug()
            await rig.clock.sleep(0.01)

    with pytest.raises(DeviceLostError, match="unplugged"):
        on_bench(test)


def test_nothing_plugged_in_and_a_busy_port():
    async def test(rig: Rig) -> None:
        async with await rig.port.open():
            with pytest.raises(PortBusyError):
                await rig.session()
        rig.port.unplug()
        with pytest.raises(DeviceLostError, match="not plugged in"):
            await rig.session()

    on_bench(test)


def test_a_silent_port_is_explained_after_all_remedies():
    async def test(rig: Rig) -> None:
        rig.port.device.faults.stalled = True
        with pytest.raises(DeviceTimeoutError, match="expected an OS4000"):
            await rig.session()
        assert rig.sent == b"\x1b\r\r\x1bR20 "

    on_bench(test)


def test_another_baud_rate_shows_as_a_wrong_device_with_a_hint():
    async def test(rig: Rig) -> None:
        rig.emulator.inject("host_baud", "9600")
        with pytest.raises(WrongDeviceError, match="baud rate"):
            await rig.session()
        assert rig.sent == b"", "whoever talks without sense is not written to"

    on_bench(test)


async def _scanner(end: DeviceEnd, clock: VirtualClock) -> None:
    """Another device: a scanner left streaming."""
    while True:
        end.write(b"MD0044072501000\n99b\nQGC0C\n" + b"0CB0CB0CB0D" * 100 + b"\n\n")
        await clock.sleep(0.1)


async def _echo(end: DeviceEnd, clock: VirtualClock) -> None:
    """Another device: repeats what it hears."""
    while True:
        end.write(await end.read())


@pytest.mark.parametrize("device", [_scanner, _echo])
def test_a_wrong_device_is_refused(device):
    async def main(clock: VirtualClock) -> None:
        port = MemoryPort("/dev/test")
        port.plug()
        rig = Rig(clock, port, Os4000Config())
        async with background(device(port.device, clock)):
            with pytest.raises(WrongDeviceError, match="/dev/test"):
                await rig.session()
        assert rig.ready_at == []

    run_virtual(main)


def test_junk_of_a_modem_manager_changes_nothing():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.out.count(5)
            rig.port.device.take(b"AT\r\nAT+GCAP\r\n")
            await rig.out.count(20)
        assert rig.events.kept == []

    on_bench(test)


def test_back_within_two_seconds_of_being_plugged_in_again():
    async def test(rig: Rig) -> None:
        service = supervise(rig.driver, RestartPolicy(), rig.clock, lambda _: None, np.random.default_rng(0))
        async with background(service):
            await rig.out.count(5)
            rig.port.unplug()
            await rig.clock.sleep(10)
            rig.out.kept.clear()
            rig.port.plug()
            back = rig.clock.now()
            await rig.out.count(1)
            assert rig.clock.now() - back < 2 * SECOND

    on_bench(test)


# Probe and wall clock


def test_probe_tells_what_is_there():
    async def test(rig: Rig) -> None:
        found = json.loads(json.dumps(await DEVICES["os4000"].identify(rig.port, rig.clock)))
        assert found["rate"] == pytest.approx(20, abs=1)
        assert found["fields"] == ["heading", "pitch", "roll", "temperature", "field", "acceleration"]
        assert found["sample"]["heading_deg"] == 123.4
        assert any("Ver" in line for line in found["version"])
        assert rig.sent == b"\x1bV"

    on_bench(test)


async def test_over_a_pty_on_the_wall_clock(tmp_path: Path):
    clock = WallClock()
    pty = PtyPort(tmp_path / "compass")
    emulator = Os4000Emulator(clock, Table())
    out = Kept()
    driver = Os4000Driver(Os4000Config(), SerialPort(tmp_path / "compass", 19200), clock, out, Events())
    pty.plug()
    try:
        async with background(emulator.run(pty.device)), background(driver.run(lambda: None)), asyncio.timeout(5):
            await out.count(3)
        assert out.kept[-1].tilt_valid
    finally:
        pty.unplug()


async def minutes(rig: Rig, count: int) -> list[ServiceHealth]:
    """Session after session for so many minutes."""
    health: list[ServiceHealth] = []
    service = supervise(rig.driver, RestartPolicy(max_delay=1.0), rig.clock, health.append, np.random.default_rng(1))
    async with background(service):
        await rig.settle(60.0 * count)
    return health


@pytest.mark.long
def test_a_compass_without_a_heading_is_set_up_once_an_hour_at_most():
    """It was written to every 2.3 s: its memory wears, and each write pauses the stream."""

    async def test(rig: Rig) -> None:
        rig.emulator.inject("empty_field", "C")
        await minutes(rig, 59)
        assert rig.sent.count(b"\x1bX") == 1
        assert rig.sent.count(b"\x1bR") == 0
        await minutes(rig, 10)
        assert rig.sent.count(b"\x1bX") == 2

    on_bench(test)


def test_a_pause_of_the_host_is_no_wrong_rate():
    async def test(rig: Rig) -> None:
        rig.port.device.faults.delay = 0.6
        async with rig.driving():
            await rig.settle(0.7)
            rig.port.device.faults.delay = 0.0  # what was sent since arrives in one burst
            await rig.out.total(20)
        assert rig.sent == b""

    on_bench(test)


def test_a_half_typed_command_is_left_not_ended():
    """CR would store what a host that died had typed: a rate of 2."""

    async def test(rig: Rig) -> None:
        rig.emulator.inject("pending", "2")
        async with rig.driving():
            await rig.out.total(20)
        assert rig.emulator.settings.rate == 20
        assert rig.sent == b"\x1b\r"

    on_bench(test)
