"""Faults by standard input: an unknown word is answered by all that are known, the cable's too."""

import asyncio
import os
import pty
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from monstertruck_drivers.cable import MemoryPort
from monstertruck_drivers.catalog import DEVICES
from monstertruck_drivers.emulation import EmulatorSetup
from monstertruck_drivers.signals import SignalKind, Signals
from monstertruck_runtime.clock import VirtualClock, VirtualLoop
from monstertruck_runtime.errors import InputError
from monstertruck_sim.console import CommandedGroup, Emulated, FaultConsole, set_signal_fault
from monstertruck_sim.world.config import WorldConfig
from monstertruck_sim.world.world import World


@pytest.mark.parametrize("device", ["lidar", "drive", "steering", "compass"])
@pytest.mark.parametrize("words", [["help"], ["nonsense"], []])
def test_the_answer_names_faults_of_the_device_and_of_its_cable(device: str, words: list[str]):
    loop = VirtualLoop()
    try:
        clock, port = VirtualClock(loop), MemoryPort(device)
        kind = DEVICES.named(device)
        setup = EmulatorSetup(kind.role.name, None, clock, World(WorldConfig(), 0), 0, port)
        emulated = Emulated(kind.emulated(setup), port)
        with pytest.raises(InputError) as refused:
            emulated.command(list(words))
        assert "known:" in str(refused.value)
        assert "Cable faults: plug, unplug, power-cycle, line stalled|deaf on|off" in str(refused.value)
        with pytest.raises(InputError, match=r"^Cable faults: plug"):
            emulated.command(["line"])
    finally:
        loop.close()


class Recorded:
    """Keeps the commands it gets."""

    def __init__(self) -> None:
        self.commands: list[list[str]] = []

    def command(self, words: list[str]) -> None:
        """Keep it."""
        self.commands.append(words)


async def test_a_terminal_keeps_its_mode_so_that_long_lines_of_others_are_not_lost_on_it():
    user, program = pty.openpty()
    target, said = Recorded(), []
    with os.fdopen(program, "r") as terminal:
        running = asyncio.create_task(FaultConsole(target, terminal, said.append).run())
        for line in (b"lidar unp", b"lug\nlidar", b" plug\n\n"):
            os.write(user, line)
            await asyncio.sleep(0.01)
        assert os.get_blocking(terminal.fileno())
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
        assert os.get_blocking(terminal.fileno())
    os.close(user)
    assert target.commands == [["lidar", "unplug"], ["lidar", "plug"]]
    assert said == ["ok", "ok"]


async def test_the_end_of_the_input_ends_the_last_line_and_nothing_else():
    reading, writing = os.pipe()
    target = Recorded()
    with os.fdopen(reading, "r") as source:
        running = asyncio.create_task(FaultConsole(target, source, lambda _: None).run())
        os.write(writing, b"lidar unplug\ndrive stall")
        os.close(writing)
        await asyncio.sleep(0.05)
        assert not running.done()
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
    assert target.commands == [["lidar", "unplug"], ["drive", "stall"]]


@pytest.mark.parametrize(
    ("line", "answer"),
    [
        ("help", "start the line with a device: lidar, drive; `lidar help` lists its commands"),
        ("lidar help", "known: spin"),
        ("lidar nonsense", "error: known: spin"),
        ("nonsense", "error: start the line with a device: lidar, drive; `lidar help` lists its commands"),
    ],
)
def test_help_is_no_error(line: str, answer: str):
    class Refusing:
        def command(self, _: list[str]) -> None:
            raise InputError("known: spin")

    said: list[str] = []
    target = CommandedGroup("device", {"lidar": Refusing(), "drive": Refusing()})
    FaultConsole(target, sys.stdin, said.append).execute(line)
    assert said == [answer]


def test_signals_are_falsified_by_name():
    signals = Signals(lambda: 0, {"heading": SignalKind.NUMBER}, np.random.default_rng(1))
    emulator = SimpleNamespace(signals=signals)
    set_signal_fault(emulator, ["heading", "offset", "5"])
    assert signals.report("heading", 10) == 15
    set_signal_fault(emulator, ["heading", "off"])
    assert signals.report("heading", 10) == 10
    with pytest.raises(InputError, match="names: heading"):
        set_signal_fault(emulator, ["help"])
    with pytest.raises(InputError, match="names no signals"):
        set_signal_fault(object(), ["heading", "off"])


BACKGROUND = """
import asyncio, fcntl, os, sys, termios
from monstertruck_sim.console import FaultConsole

fcntl.ioctl(0, termios.TIOCSCTTY, 0)
if not (child := os.fork()):
    os.setpgid(0, 0)
    asyncio.run(asyncio.wait_for(FaultConsole(None, sys.stdin, print).run(), 0.3))
_, status = os.waitpid(child, os.WUNTRACED)
print("stopped" if os.WIFSTOPPED(status) else "ran on")
"""


def test_in_the_background_of_a_terminal_the_devices_run_on():
    user, program = pty.openpty()
    os.write(user, b"a line for the shell\n")
    command = [sys.executable, "-c", BACKGROUND]
    try:
        ended = subprocess.run(
            command, stdin=program, start_new_session=True, capture_output=True, text=True, check=False
        )
    finally:
        os.close(program)
        os.close(user)
    assert ended.stdout == "ran on\n", ended.stdout + ended.stderr
