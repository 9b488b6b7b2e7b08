"""The driver through damage and loss; other devices; the probe and the wall clock."""

import asyncio
from pathlib import Path

import numpy as np
import pytest

from monstertruck_drivers.cable import DeviceEnd, MemoryPort, PtyPort
from monstertruck_drivers.catalog import DEVICES
from monstertruck_drivers.maestro.config import MaestroConfig
from monstertruck_drivers.maestro.driver import MaestroDriver
from monstertruck_drivers.maestro.emulator import MaestroEmulator
from monstertruck_drivers.tty import SerialPort
from monstertruck_runtime.clock import SECOND, VirtualClock, WallClock, run_virtual
from monstertruck_runtime.errors import (
    DeviceLostError,
    DeviceTimeoutError,
    PortBusyError,
    ProtocolError,
    WrongDeviceError,
)
from monstertruck_runtime.mailbox import Mailbox, latest
from monstertruck_runtime.service import RestartPolicy, supervise
from monstertruck_schemas.health import ServiceHealth
from monstertruck_schemas.reasons import Reason
from tests.unit.drivers.kit import Events, Kept, background
from tests.unit.drivers.maestro.rig import Gate, Rig, on_bench

# Damage and loss


def test_one_byte_at_a_time_and_delay():
    async def test(rig: Rig) -> None:
        rig.port.device.faults.chunk = 1
        rig.port.device.faults.delay = 0.01
        async with rig.driving():
            await rig.out.count(20)
            assert rig.out.kept[-1].trusted
        assert rig.events.kept == []

    on_bench(test)


def test_damaged_answers_never_become_wild_angles_for_long():
    async def test(rig: Rig) -> None:
        faults = rig.port.device.faults
        faults.seed(1)
        rig.gate.front = 0.2
        async with rig.driving():
            await rig.out.count(10)
            faults.drop_rate = 0.01
            await rig.settle(20)
            faults.drop_rate = 0.0
            await rig.settle(0.2)
            assert rig.out.kept[-1].front == pytest.approx(0.2, abs=0.001)
            assert rig.out.kept[-1].trusted
        assert len(rig.out.kept) > 300

    on_bench(test)


def test_garbage_before_an_answer_costs_one_poll():
    async def test(rig: Rig) -> None:
        rng = np.random.default_rng(3)
        async with rig.driving():
            for _ in range(20):
                await rig.out.count(1)
                rig.port.device.faults.garbage = rng.bytes(9)
            await rig.settle(0.3)
            assert rig.out.kept[-1].trusted

    on_bench(test)


def test_garbage_at_the_start_is_survived():
    async def test(rig: Rig) -> None:
        rig.port.device.faults.garbage = b"\xff\xfe~~"
        async with rig.driving():
            await rig.out.count(2)

    on_bench(test)


def test_a_stall_ends_the_session():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.out.count(5)
            rig.port.device.faults.stalled = True
            await rig.settle(0.6)

    with pytest.raises(DeviceTimeoutError, match="/dev/test: no answer"):
        on_bench(test)


def test_a_short_stall_does_not():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.out.count(5)
            rig.port.device.faults.stalled = True
            await rig.settle(0.15)
            rig.port.device.faults.stalled = False
            await rig.settle(0.2)
            assert rig.out.kept[-1].trusted

    on_bench(test)


def test_answers_out_of_form_end_the_session():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.out.count(5)
            rig.port.device.faults.flip_rate = 1.0
            await rig.settle(2)

    with pytest.raises(ProtocolError, match="malformed answers"):
        on_bench(test)


def test_unplugging_is_noticed_even_while_silent():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.out.count(5)
            rig.gate.talking = False
            await rig.settle(1)
            rig.port.unplug()
            await rig.settle(0.1)

    with pytest.raises(DeviceLostError):
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


def test_uart_mode_is_explained():
    async def test(rig: Rig) -> None:
        with pytest.raises(DeviceTimeoutError, match="USB Dual Port"):
            await rig.session()
        assert rig.ready_at == []

    on_bench(test, mode="uart")


async def _chatter(end: DeviceEnd, clock: VirtualClock) -> None:
    """Another device: a compass that streams."""
    while True:
        end.write(b"$C320.5P0.2R-18.3T19.0*3C\r\n")
        await clock.sleep(0.05)


async def _echo(end: DeviceEnd, clock: VirtualClock) -> None:
    """Another device: repeats what it hears."""
    while True:
        end.write(await end.read())


async def _words(end: DeviceEnd, clock: VirtualClock) -> None:
    """Another device: answers every request with a full line."""
    while True:
        await end.read()
        end.write(b"\0\0\0\0\0\0\0\0\n")


@pytest.mark.parametrize("device", [_chatter, _echo, _words])
def test_a_wrong_device_is_refused(device):
    async def main(clock: VirtualClock) -> None:
        port = MemoryPort("/dev/test")
        port.plug()
        rig = Rig(clock, port, MaestroConfig())
        async with background(device(port.device, clock)):
            with pytest.raises(WrongDeviceError, match="/dev/test: not a Maestro"):
                await rig.session()
        assert rig.ready_at == []

    run_virtual(main)


async def _supervised(rig: Rig, health: list[ServiceHealth]) -> None:
    await supervise(rig.driver, RestartPolicy(), rig.clock, health.append, np.random.default_rng(0))


@pytest.mark.parametrize("fault", ["unplug", "brown_out"])
def test_back_within_two_seconds_of_being_plugged_in_again(fault: str):
    async def test(rig: Rig) -> None:
        rig.gate.front = 0.25
        async with background(_supervised(rig, [])):
            await rig.settle(2)
            if fault == "unplug":
                rig.port.unplug()
                await rig.settle(10)
                rig.port.plug()
            else:
                rig.emulator.inject("brown_out", "0.3")
                await rig.settle(0.3)
            back = rig.clock.now()
            rig.out.kept.clear()
            await rig.out.count(2)
            assert rig.clock.now() - back < 2 * SECOND
            assert rig.out.kept[-1].front == pytest.approx(0.25, abs=0.001)
            assert rig.out.kept[-1].trusted
            assert rig.emulator._ramps[1].speed == 100, "the speed limit is set anew"

    on_bench(test)


# Probe and wall clock


def test_probe_reads_and_moves_nothing():
    async def test(rig: Rig) -> None:
        rig.emulator.inject("noise", "0")
        rig.gate.talking = False
        found = await DEVICES["maestro"].identify(rig.port, rig.clock)
        assert found["errors"] == ["serial_signal"]
        assert found["channels"][5] == {"channel": 5, "if_servo_us": 122.75, "if_input_v": 2.4}
        assert b"\x84" not in bytes(rig.emulator.received)

    on_bench(test)


async def test_over_a_pty_on_the_wall_clock(tmp_path: Path):
    clock = WallClock()
    pty = PtyPort(tmp_path / "servos")
    emulator = MaestroEmulator(clock)
    commands, out, battery = Mailbox(latest()), Kept(), Kept()
    gate = Gate(clock, commands)
    gate.front = 0.1
    driver = MaestroDriver(MaestroConfig(), SerialPort(tmp_path / "servos"), clock, commands, out, battery, Events())
    pty.plug()
    try:
        async with (
            background(emulator.run(pty.device)),
            background(gate.run()),
            background(driver.run(lambda: None)),
            asyncio.timeout(5),
        ):
            await out.count(5)
        assert out.kept[-1].trusted
        assert out.kept[-1].front == pytest.approx(0.1, abs=0.001)
    finally:
        pty.unplug()


@pytest.mark.parametrize("late", [0.101, 0.13, 0.16])
def test_a_late_answer_is_never_taken_for_the_next_one(late: float):
    """Four words late, three asked for next: the battery would be read as the error word."""

    async def test(rig: Rig) -> None:
        async with rig.driving():
            rig.gate.front = 0.2
            await rig.settle(1.0)
            for step in range(20):
                rig.emulator.inject("late", str(late))
                await rig.settle(0.5 + 0.013 * step)
        judge(rig)

    def judge(rig: Rig) -> None:
        assert {feedback.error_word for feedback in rig.out.kept} == {0}
        assert Reason.DEVICE_FAULT not in rig.events.reasons()
        assert all(feedback.front == pytest.approx(0.2, abs=0.01) for feedback in rig.out.kept[20:])
        assert all(20 < battery.raw_voltage < 26 for battery in rig.battery.kept)
        assert len(rig.ready_at) == 1

    on_bench(test)


@pytest.mark.parametrize("pulse", ["1000", "1950"])
def test_pulses_beyond_the_limits_are_no_angles(pulse: str):
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.settle(1.0)
            rig.gate.talking = False
            await rig.settle(0.1)
            rig.emulator.inject("pulse", "1", pulse)
            await rig.settle(1.0)
        reach = MaestroConfig().front.reach
        assert all(reach[0] - 0.01 <= feedback.front <= reach[1] + 0.01 for feedback in rig.out.kept)
        assert not all(feedback.trusted for feedback in rig.out.kept)
        assert "pulses outside" in " ".join(text for _, _, text, _ in rig.events.kept)

    on_bench(test, MaestroConfig(deadman_feed="always"))
