"""The drive service and faults of the controller, other devices, other set-ups; the probe."""

import asyncio
from pathlib import Path

import pytest

from monstertruck_drivers.cable import DeviceEnd, PtyPort
from monstertruck_drivers.catalog import DEVICES
from monstertruck_drivers.epos import objects as od
from monstertruck_drivers.epos.config import EposConfig
from monstertruck_drivers.epos.protocol import Control, Opcode, State
from monstertruck_drivers.tty import SerialPort
from monstertruck_runtime.clock import VirtualClock, WallClock, run_virtual
from monstertruck_runtime.errors import (
    DeviceFaultError,
    DeviceMismatchError,
    DeviceTimeoutError,
    WrongDeviceError,
)
from monstertruck_schemas.cmd import DriveAction
from monstertruck_schemas.event import Severity
from monstertruck_schemas.health import ServiceState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import DriveMode
from tests.unit.drivers.epos.rig import Rig, bench, controls, on_bench
from tests.unit.drivers.kit import background

# Faults


def test_a_passing_fault_is_reported_reset_and_driving_goes_on_from_0():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.drive(6_000)
            rig.emulator.inject("fault", "over_voltage", "passing")
            await rig.until(lambda: rig.newest.mode is DriveMode.FAULT, 0.25)
            assert rig.newest.fault_code == 0x3210
            await rig.until(lambda: rig.newest.mode is not DriveMode.FAULT)
            await rig.drive(6_000)
        reason, severity, text, values = rig.events.kept[1]
        assert (reason, severity) == (Reason.DRIVE_FAULT, Severity.ERROR)
        assert "0x3210 (over-voltage)" in text
        assert values == {"code": 0x3210}
        assert "cleared" in rig.events.kept[2][2]
        reset = controls(rig).index(Control.FAULT_RESET)
        assert controls(rig)[reset - 1] == Control.DISABLE_VOLTAGE, "an edge"
        assert controls(rig).count(Control.FAULT_RESET) == 1
        cleared = rig.writes(od.CONTROLWORD)[reset][0]
        assert next(value for instant, value in rig.writes(od.TARGET_VELOCITY) if instant > cleared) == 0

    on_bench(test)


def test_after_a_fault_only_fresh_commands_count():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.drive(6_000)
            rig.gate.talking = False
            rig.gate.say(DriveAction.RUN, 6_000)
            rig.emulator.inject("fault", "over_current", "passing")
            await rig.settle(2.0)
            assert rig.newest.mode is DriveMode.DISABLED
            assert rig.shaft_rpm == 0

    on_bench(test, EposConfig(command_timeout=50.0, quick_stop_after=60.0))


def test_a_permanent_fault_ends_after_three_resets_and_waits_for_its_cause():
    async def test(rig: Rig) -> None:
        async with rig.supervised():
            await rig.drive(6_000)
            rig.emulator.inject("fault", "encoder")
            await rig.settle(8.0)
            assert controls(rig).count(Control.FAULT_RESET) == 3
            assert rig.health[-1].state is not ServiceState.READY
            assert any(row.reason is Reason.DEVICE_FAULT for row in rig.health)
            assert rig.events.reasons().count(Reason.DRIVE_FAULT) == 1, "reported once"
            assert rig.newest.mode is DriveMode.FAULT
            assert rig.newest.fault_code == od.POSITION_SENSOR
            rig.emulator.inject("clear")
            await rig.until(lambda: rig.newest.mode is DriveMode.ENABLED, 12.0)

    on_bench(test)


def test_a_permanent_fault_raises():
    async def test(rig: Rig) -> None:
        rig.emulator.inject("fault", "following")
        with pytest.raises(DeviceFaultError, match=r"0x8611 \(following error\) persists after 3 resets"):
            await rig.session()
        assert rig.ready_at == []

    on_bench(test)


def test_a_fault_that_comes_back_on_enabling_uses_up_the_resets():
    async def test(rig: Rig) -> None:
        async def failing() -> None:
            while True:
                await rig.until(lambda: rig.emulator.state is State.ENABLED, 60)
                rig.emulator.inject("fault", "over_current", "passing")

        async with background(failing()):
            session = asyncio.create_task(rig.session())
            rig.gate.say(DriveAction.RUN, 6_000)
            with pytest.raises(DeviceFaultError):
                await session
        assert controls(rig).count(Control.FAULT_RESET) == 3

    on_bench(test)


# Other devices, other set-ups


def test_another_device_on_the_port():
    async def main(clock: VirtualClock) -> None:
        async with bench(clock) as rig:
            rig.emulator.inject("silent", "on")

            async def compass(end: DeviceEnd) -> None:
                while True:
                    end.write(b"$C320.5P0.2R-18.3T19.0*3C\r\n")
                    await clock.sleep(0.1)

            async with background(compass(rig.port.device)):
                with pytest.raises(WrongDeviceError, match=r"not an EPOS, it sends"):
                    await rig.session()
                with pytest.raises(WrongDeviceError, match=r"not an EPOS, it sends"):
                    await DEVICES["epos"].identify(rig.port, clock)
            assert rig.ready_at == []

    run_virtual(main)


def test_a_device_that_never_answers():
    async def test(rig: Rig) -> None:
        rig.emulator.inject("silent", "on")
        with pytest.raises(DeviceTimeoutError):
            await rig.session()
        with pytest.raises(DeviceTimeoutError):
            await DEVICES["epos"].identify(rig.port, rig.clock)

    on_bench(test)


def test_a_slow_controller_is_not_taken_for_another_device():
    async def test(rig: Rig) -> None:
        rig.emulator.inject("delay", "600")
        with pytest.raises(DeviceTimeoutError):
            await rig.session()

    on_bench(test)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (EposConfig(encoder_pulses_per_turn=512), "is 500, expected 512"),
        (EposConfig(motor_type=1), "motor type"),
        (EposConfig(node=5), "wrong node id.*configured 5"),
    ],
)
def test_other_parameters_than_configured(config: EposConfig, message: str):
    async def test(rig: Rig) -> None:
        with pytest.raises(DeviceMismatchError, match=message):
            await rig.session()
        assert rig.ready_at == []
        assert Control.ENABLE not in controls(rig)

    on_bench(test, config)


@pytest.mark.parametrize("missing", [(od.CONTROLWORD, "not an EPOS 24/1"), (od.SOFTWARE_VERSION, "without 0x2003/1")])
def test_an_object_server_that_is_no_epos(missing: tuple[od.ObjectEntry, str], monkeypatch: pytest.MonkeyPatch):
    entry, message = missing
    monkeypatch.delitem(od.OBJECTS, (entry.index, entry.sub))

    async def test(rig: Rig) -> None:
        with pytest.raises(WrongDeviceError, match=message):
            await rig.session()

    on_bench(test)


def test_a_motor_already_running_in_an_unknown_session_is_stopped_before_anything_is_read():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.drive(6_000)
            rig.port.unplug()
        other = type(rig.driver)(EposConfig(), rig.port, rig.clock, rig.commands, rig.out, rig.events)
        rig.gate.say(DriveAction.DISABLE)
        await rig.settle(1.0)
        assert rig.shaft_rpm == -6_000
        rig.port.plug()
        async with background(other.run(rig.ready)):
            assert await rig.until(lambda: rig.shaft_rpm == 0) < 0.1
            await rig.settle(0.5)
            assert rig.emulator.state is State.SWITCH_ON_DISABLED

    on_bench(test)


# Probe, and a real tty


def test_probe_reports_and_changes_nothing():
    async def test(rig: Rig) -> None:
        rig.emulator.inject("fault", "over_voltage", "passing")
        await rig.settle(0.1)
        report = await DEVICES["epos"].identify(rig.port, rig.clock)
        assert report["identity"]["software"] == 0x2024
        assert report["identity"]["serial_number"] == "6301602400001234"
        assert report["state"] == "FAULT"
        assert report["faults"] == [{"code": 0x3210, "text": "0x3210 (over-voltage)"}]
        assert len(report["samples"]) == 5
        assert {frame.opcode for _, frame in rig.emulator.frames} == {
            Opcode.READ,
            Opcode.INITIATE_SEGMENTED_READ,
            Opcode.SEGMENTED_READ,
        }

    on_bench(test)


def test_probe_copes_without_a_serial_number(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delitem(od.OBJECTS, (od.SERIAL_NUMBER.index, 0))

    async def test(rig: Rig) -> None:
        assert (await DEVICES["epos"].identify(rig.port, rig.clock))["identity"]["serial_number"] is None

    on_bench(test)


@pytest.mark.wall
async def test_over_a_pty_on_the_wall_clock(tmp_path: Path):
    clock, path = WallClock(), tmp_path / "drive"
    async with bench(clock, port=PtyPort(path)) as rig:
        rig.driver._port = SerialPort(path, 38_400)
        async with rig.supervised():
            rig.gate.say(DriveAction.RUN, 18_000)
            await rig.until(lambda: rig.shaft_rpm == -18_000, 3.0)
            rig.port.unplug()
            await rig.settle(0.2)
            rig.port.plug()
            assert await rig.until(lambda: abs(rig.shaft_rpm) < 10) < 1.2
            await rig.drive(6_000)
        assert rig.emulator.state is State.SWITCH_ON_DISABLED
