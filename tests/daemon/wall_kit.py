"""A whole robot over ptys for tests: emulators in one process, the daemon in another, a client here."""

import asyncio
import contextlib
import signal
import subprocess
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import WallClock
from monstertruck_runtime.errors import NotFoundError, RequestRefusedError, TruckError
from monstertruck_runtime.mailbox import Mailbox, latest
from monstertruck_runtime.yaml_files import read_yaml, yaml_text
from monstertruck_schemas import topics
from monstertruck_schemas.state import GateMode, GateState
from monstertruckd.tools.demo.runs import free_endpoint, write_overlay
from tests.daemon import forked

ROOT = Path(__file__).resolve().parents[2]
DEMO = ROOT / "configs" / "demo.yaml"


def merged(base: dict[str, Any], top: dict[str, Any]) -> dict[str, Any]:
    both = {
        k: merged(base[k], v) if isinstance(v, dict) and isinstance(base.get(k), dict) else v for k, v in top.items()
    }
    return base | both


@dataclass
class Robot:
    """Processes and files of one emulated robot."""

    folder: Path
    endpoint: str
    config: Path
    clock: WallClock = field(default_factory=WallClock)
    simulator: "asyncio.subprocess.Process | forked.Forked | None" = None
    daemon: asyncio.subprocess.Process | None = None

    async def start_simulator(self) -> None:
        words = ("simulate", "--config", str(self.config), "--truth", str(self.folder / "t.npz"))
        self.simulator = await forked.started(*words, folder=ROOT, errors=self.folder / "simulate.txt")
        async with asyncio.timeout(40):
            while "ready" not in await self.said():
                pass

    async def said(self) -> str:
        assert self.simulator is not None
        assert self.simulator.stdout is not None
        line = (await self.simulator.stdout.readline()).decode()
        assert line, "the simulator ended"
        return line

    async def fault(self, words: str) -> None:
        assert self.simulator is not None
        assert self.simulator.stdin is not None
        self.simulator.stdin.write(words.encode() + b"\n")
        await self.simulator.stdin.drain()
        assert (await self.said()).strip() == "ok"

    async def start_daemon(self) -> None:
        self.daemon = await self.spawn("run", "--config", str(self.config))

    async def spawn(self, *arguments: str) -> asyncio.subprocess.Process:
        pipe = asyncio.subprocess.PIPE
        with (self.folder / f"{arguments[0]}.txt").open("ab") as errors:
            return await asyncio.create_subprocess_exec(
                sys.executable, "-m", "monstertruckd", *arguments, cwd=ROOT, stdin=pipe, stdout=pipe, stderr=errors
            )

    @asynccontextmanager
    async def client(self) -> AsyncIterator[TruckClient]:
        async with asyncio.timeout(40):
            while True:
                with contextlib.suppress(NotFoundError):
                    async with TruckClient(endpoint=self.endpoint, clock=self.clock, timeout=0.5) as probe:
                        if await probe.alive():
                            break
                await asyncio.sleep(0.1)
        async with TruckClient(endpoint=self.endpoint, clock=self.clock) as client:
            yield client

    async def drive(self, client: TruckClient, speed: float = 0.15) -> None:
        """Arm, and wait until the tracker drives at ``speed``."""
        with client.subscribe(topics.GATE, latest()) as gate, client.subscribe(topics.ODOMETRY, latest()) as odometry:
            async with asyncio.timeout(30):
                while gate.latest is None or odometry.latest is None or odometry.latest.twist.vx < speed:
                    if gate.latest is None or gate.latest.mode is GateMode.DISARMED:
                        with contextlib.suppress(RequestRefusedError):
                            await client.arm()
                    await asyncio.sleep(0.05)

    async def truth(self) -> np.ndarray:
        """End the simulator; what happened: rows of time, x, y, yaw, speed, stuck."""
        await end(self.simulator)
        with np.load(self.folder / "t.npz") as archive:
            return archive["truth"]

    def logs(self) -> list[Path]:
        return sorted((self.folder / "logs").glob("*.mcap"))


async def planner_ready(client: TruckClient) -> None:
    """Wait until goals are taken on: the first time a computer's planner compiles."""
    with client.subscribe(topics.HEALTH, latest()) as health:
        async with asyncio.timeout(200):
            while health.latest is None or {s.name: s.state.value for s in health.latest.services}["goals"] != "ready":
                await asyncio.sleep(0.2)


@asynccontextmanager
async def kept_armed(client: TruckClient) -> AsyncIterator[None]:
    """Arm again a truck that a busy computer's late samples disarmed while it had somewhere to go."""

    async def arm(gate: Mailbox[GateState]) -> None:
        while True:
            if gate.latest is not None and gate.latest.mode is GateMode.DISARMED and gate.latest.waiting:
                with contextlib.suppress(TruckError):
                    await client.arm()
            await asyncio.sleep(0.5)

    with client.subscribe(topics.GATE, latest()) as gate:
        arming = asyncio.create_task(arm(gate))
        try:
            yield
        finally:
            arming.cancel()
            await asyncio.gather(arming, return_exceptions=True)


async def end(process: "asyncio.subprocess.Process | forked.Forked | None", number: int = signal.SIGTERM) -> int | None:
    """Signal a process and wait for it; its exit code."""
    if process is None:
        return None
    if process.returncode is None:
        with contextlib.suppress(ProcessLookupError):
            process.send_signal(number)
    if process.stdin is not None:
        process.stdin.close()
    async with asyncio.timeout(20):
        await process.communicate()
    return process.returncode


@asynccontextmanager
async def robot(folder: Path, overlay: dict[str, Any] | None = None, base: Path = DEMO) -> AsyncIterator[Robot]:
    """Configuration files and, at the end, no process left."""
    endpoint = free_endpoint()
    file = write_overlay(base, folder, endpoint)
    if overlay is not None:
        file.write_text(yaml_text(merged(read_yaml(file), overlay)))
    made = Robot(folder, endpoint, file)
    try:
        yield made
    finally:
        for process in (made.daemon, made.simulator):
            if process is not None and process.returncode is None:
                with contextlib.suppress(ProcessLookupError):
                    process.kill()
                await end(process)


async def command(*arguments: str, timeout: float = 60) -> subprocess.CompletedProcess[str]:
    """Run one command to its end."""
    return await asyncio.to_thread(forked.run, *arguments, folder=ROOT, timeout=timeout)
