"""A whole computer in a folder, in good health until a test spoils something."""

import asyncio
import os
from collections.abc import Callable, Coroutine, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from monstertruck_drivers.cable import MemoryPort
from monstertruck_drivers.host_health.emulator import HostEmulator
from monstertruck_drivers.link_quality.emulator import NetworkEmulator
from monstertruck_drivers.usb.tree import DEVICES
from monstertruck_runtime.clock import VirtualClock, run_virtual
from monstertruck_sim.computer import EmulatedComputer
from monstertruckd.config.load import load_truck
from monstertruckd.config.truck import TruckConfig
from monstertruckd.tools.doctor.context import Account, Finding, HostContext, Level
from monstertruckd.tools.install.apply import install
from monstertruckd.tools.install.plan import plan
from tests.unit.tools.install.kit import PROGRAM, TRUCK

NODES = ("ttyUSB0", "ttyACM0", "ttyUSB1", "ttyUSB2", "ttyACM1", "video0")
NOW = 1.8e9
"""Seconds since 1970."""


@dataclass
class EmulatedHost:
    """The folder, what emulates it, and whom the doctor sees."""

    folder: Path
    clock: VirtualClock
    computer: EmulatedComputer
    host: HostEmulator
    network: NetworkEmulator
    context: HostContext

    def put(self, path: str, text: str = "") -> Path:
        file = self.folder / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
        return file

    def change(self, **values: Any) -> None:
        """Another configuration, named as in the YAML."""
        assert self.context.config is not None
        config = type(self.context.config).model_validate(self.context.config.model_dump() | values)
        self.context = replace(self.context, config=config)

    def runs(self, **answers: tuple[int, str]) -> None:
        """Programs that are there, and what they answer."""

        async def run(arguments: Sequence[str]) -> tuple[int, str]:
            if arguments[0] not in answers:
                raise FileNotFoundError(arguments[0])
            return answers[arguments[0]]

        computer = replace(self.context.computer, machine=replace(self.context.computer.machine, run=run))
        self.context = replace(self.context, computer=computer)

    def process(self, pid: int, *words: str) -> None:
        self.put(f"proc/{pid}/cmdline", "\0".join(words) + "\0")
        self.put(f"proc/{pid}/comm", Path(words[0]).name + "\n")

    @property
    def latencies(self) -> list[Path]:
        return sorted((self.folder / "sys" / DEVICES).glob("*/ttyUSB*/latency_timer"))


@cache
def truck() -> TruckConfig:
    return load_truck(TRUCK)[0]


def emulated(folder: Path, clock: VirtualClock) -> EmulatedHost:
    """Everything installed, plugged in, permitted, synchronized."""
    config = truck()
    cables = {role: MemoryPort(role) for role in config.devices.present()}
    computer = EmulatedComputer(folder, config.devices, cables, clock)
    for node in NODES:
        (folder / "dev" / node).touch()
        (folder / "dev" / node).chmod(0o660)
    groups = {"dialout": os.getgid(), "video": os.getgid()}
    account = Account("monstertruckd", 64_999, groups)
    context = HostContext(folder, computer.computer(), PROGRAM, TRUCK, config, None, account)
    made = EmulatedHost(folder, clock, computer, HostEmulator(folder, clock), NetworkEmulator(folder, clock), context)
    install(plan(TRUCK, "monstertruckd", PROGRAM, folder), folder)
    made.put("run/systemd/timesync/synchronized")
    made.put("sys/class/rtc/rtc0/name", "rtc")
    logs = folder / "var/lib/monstertruckd/logs"
    logs.mkdir(parents=True)
    logs.chmod(0o770)
    for file in made.latencies:
        file.write_text("1")
    return made


def see(
    folder: Path,
    check: Callable[[HostContext], Any],
    change: Callable[[EmulatedHost], Coroutine[Any, Any, None] | None] = lambda _: None,
) -> dict[str, Finding]:
    """Findings of one check by their name, the last of each, after ``change`` had its way with the emulated."""
    return {finding.check: finding for finding in see_all(folder, check, change)}


def see_all(
    folder: Path,
    check: Callable[[HostContext], Any],
    change: Callable[[EmulatedHost], Coroutine[Any, Any, None] | None] = lambda _: None,
) -> list[Finding]:
    """All findings of one check, likewise."""

    async def main(clock: VirtualClock) -> list[Finding]:
        clock.step_real(NOW)
        made = emulated(folder, clock)
        changing = change(made)
        if asyncio.iscoroutine(changing):
            await changing
        found = check(made.context)
        return [one async for one in found] if hasattr(found, "__aiter__") else list(found)

    return run_virtual(main)


def bad(findings: dict[str, Finding]) -> dict[str, Finding]:
    return {name: finding for name, finding in findings.items() if finding.level is not Level.OK}
