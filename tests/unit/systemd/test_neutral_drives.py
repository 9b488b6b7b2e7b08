"""The stop script at emulated controllers other than the EPOS, over ptys."""

import asyncio
import contextlib
import importlib.util
import subprocess
import sys
import time
from pathlib import Path

import pytest

from monstertruck_drivers.arduino_bridge.emulator import ArduinoBridgeEmulator
from monstertruck_drivers.cable import PtyPort
from monstertruck_drivers.epos.firmware import FreeMotor
from monstertruck_drivers.maestro.esc_config import MaestroEscConfig
from monstertruck_drivers.maestro.esc_emulator import MaestroEscEmulator
from monstertruck_drivers.pca9685.config import Pca9685EscConfig
from monstertruck_drivers.pca9685.emulator import Pca9685Emulator
from monstertruck_drivers.pca9685.protocol import pulse
from monstertruck_drivers.steppers.emulator import StepperEmulator
from monstertruck_drivers.vesc.config import VescConfig, VescMotorConfig
from monstertruck_drivers.vesc.emulator import VescEmulator
from monstertruck_runtime.clock import SECOND, WallClock

pytestmark = pytest.mark.wall

SCRIPT = Path(__file__).resolve().parents[3] / "systemd" / "neutral.py"
TWO = VescConfig(motors=(VescMotorConfig(), VescMotorConfig(can_id=7)))


@contextlib.asynccontextmanager
async def plugged_in(emulator, path):
    port = PtyPort(path)
    running = asyncio.create_task(emulator.run(port.device))
    await asyncio.sleep(0)
    port.plug()
    try:
        yield port
    finally:
        port.unplug()
        running.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await running


async def neutral(*arguments):
    command = [sys.executable, "-I", "-S", str(SCRIPT), *arguments]
    return await asyncio.to_thread(subprocess.run, command, capture_output=True, text=True, timeout=20, check=False)


async def test_all_motors_of_a_vesc_and_of_the_steppers_are_stopped(tmp_path):
    clock, rotors = WallClock(), [FreeMotor() for _ in range(3)]
    vesc, steppers = VescEmulator(clock, (rotors[0], rotors[1]), None, TWO), StepperEmulator(clock, [rotors[2]])
    for controller in vesc.controllers:
        controller.feed()
        controller.run(4000.0)
    rotors[2].command(clock.now(), 20.0, 1e4)
    async with plugged_in(vesc, tmp_path / "vesc"), plugged_in(steppers, tmp_path / "steppers"):
        done = await neutral(
            f"{tmp_path / 'vesc'}=vesc:{TWO.stop_words}@115200", f"{tmp_path / 'steppers'}=steppers:@115200"
        )
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("stopped") == 2
    assert [round(rotor.reading(clock.now()).rpm, 1) for rotor in rotors] == [0.0, 0.0, 0.0]


async def test_a_board_that_restarts_when_its_port_is_opened_is_waited_for(tmp_path):
    clock, rotors = WallClock(), (FreeMotor(), FreeMotor())
    board = ArduinoBridgeEmulator(clock, rotors)
    async with plugged_in(board, tmp_path / "board"):
        rotors[0].command(clock.now(), 20.0, 1e4)
        done = await neutral(f"{tmp_path / 'board'}=arduino_bridge:@57600")
    assert done.returncode == 0, done.stderr
    at_rest = clock.now() + SECOND  # the script ends on the answer; the motor is still braking then
    assert rotors[0].reading(at_rest).rpm == 0.0


async def test_a_speed_controller_on_a_maestro_gets_its_neutral_pulse(tmp_path):
    clock, config, rotor = WallClock(), MaestroEscConfig(), FreeMotor()
    unit = MaestroEscEmulator(clock, rotor, None, config)
    async with plugged_in(unit, tmp_path / "unit"):
        unit.inject("pulse", str(config.esc.channel), "1700")
        done = await neutral(f"{tmp_path / 'unit'}=maestro_esc:{config.stop_words}@115200")
        assert unit.pulse_us(config.esc.channel, clock.now()) == config.esc.neutral_us
    assert done.returncode == 0, done.stderr


async def test_a_motor_that_disobeys_and_a_silent_controller_are_reported(tmp_path):
    clock = WallClock()
    vesc, silent = VescEmulator(clock, settings=TWO), VescEmulator(clock)
    vesc.controllers[1].feed()
    vesc.controllers[1].run(4000.0)
    vesc.inject("runaway", "run", "900")
    silent.inject("silent", "on")
    async with plugged_in(vesc, tmp_path / "vesc"), plugged_in(silent, tmp_path / "silent"):
        done = await neutral(
            f"{tmp_path / 'vesc'}=vesc:{TWO.stop_words}@115200",
            f"{tmp_path / 'silent'}=vesc:{VescConfig().stop_words}@115200",
        )
    assert done.returncode == 1
    assert "a motor still turns at 1800 electrical rpm" in done.stderr
    assert "no answer" in done.stderr


@pytest.mark.parametrize("disobeys", [False, True])
def test_a_speed_controller_on_a_pca9685_gets_its_neutral_pulse(tmp_path, monkeypatch, capsys, disobeys):
    spec = importlib.util.spec_from_file_location("neutral", SCRIPT)
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    config, chip = Pca9685EscConfig(), Pca9685Emulator(WallClock())
    for data in (b"\x00\x20", pulse(config.esc.channel, 400)):
        chip.transfer(0x40, data, 0)
    if disobeys:
        chip.signals.inject(f"target_{config.esc.channel}", "ignored")
    bus = tmp_path / "i2c-1"
    bus.touch()
    monkeypatch.setattr(script.i2c, "transfer", lambda _, address, data, count=0: chip.transfer(address, data, count))
    monkeypatch.setattr(script, "TIMEOUT", 0.1)
    code = script.main([f"{bus}=pca9685_esc:{config.stop_words}@115200"])
    assert code == disobeys
    if disobeys:
        assert "the pulse is 400 counts" in capsys.readouterr().err
    else:
        time.sleep(0.001)
        neutral_us = chip.pulse_us(config.esc.channel, WallClock().now())
        assert neutral_us == pytest.approx(config.esc.neutral_us * 31 / 122, abs=5), "at the frequency of power-up"
