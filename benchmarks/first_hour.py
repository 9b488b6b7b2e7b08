"""Waiting times of a new user: from the clone to the first lap, and for the first commands.

    python -m benchmarks.first_hour [--trials 40] [--only NAME ...]

    lap      git clone and `bootstrap demo --config lap` in it: packages from the cache, kernels not compiled, s
    help     `--help` to its end, s
    estop    from the start of `monstertruckd estop` to the quick stop on the drive controller's wire, s
    status   from the start of `status` on a terminal of 80x24 to the first picture with the robot's mode, s
    goto     from the start of `goto`, to a daemon that has just started, to the first route, s; kernels compiled
    tasks    on the page of `try`: add a zone, run a mission, plot the battery, start the compass's calibration,
             download the log, replay it; waiting, and the presses and keys of the keystroke-level model, s

``estop``, ``status`` and ``goto`` connect to a daemon and an emulated truck in separate processes; the goals are for
two idle cores. For ``estop`` and ``status``, daemon and truck have a core each; for ``goto`` the daemon and its workers
use both cores, like a user's. The last line is JSON.
"""

import argparse
import asyncio
import contextlib
import fcntl
import json
import os
import pty
import signal
import struct
import subprocess
import sys
import termios
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks import ROOT
from benchmarks.estop import Stops
from benchmarks.estop_parts.processes import order, process
from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import SECOND, Clock, run_wall
from monstertruck_runtime.mailbox import latest
from monstertruck_schemas import topics
from monstertruck_schemas.req import Order
from monstertruckd.tools.demo.runs import connect, free_endpoint, write_overlay
from tests.daemon.browser_kit import PATIENCE, chromium, opened
from tests.daemon.page_tasks import TASKS, timed, tried

COMMAND = (sys.executable, "-m", "monstertruckd")
GOALS = {"lap": 20.0, "help": 0.2, "estop": 0.17, "estop_p99": 0.2, "status": 1.0, "goto": 5.0}
GOALS |= dict.fromkeys(TASKS, 60.0)
GOAL_POSE = ("8.5", "6", "0")
WAIT = 60.0
"""Seconds after which a part has failed."""


def lap() -> dict[str, float]:
    """Drive the lap in a fresh clone."""
    with TemporaryDirectory(prefix="first-hour-") as folder:
        began = time.monotonic()
        subprocess.run(["git", "clone", "-q", str(ROOT), f"{folder}/clone"], check=True)
        demo = [sys.executable, "-m", "monstertruckd.bootstrap", "demo", "--config", "lap"]
        clean = {name: value for name, value in os.environ.items() if not name.startswith(("VIRTUAL_ENV", "PYTHON"))}
        subprocess.run(demo, cwd=f"{folder}/clone", check=True, stdout=subprocess.DEVNULL, env=clean)
        return {"lap": time.monotonic() - began}


def help_text(trials: int) -> dict[str, float]:
    """Time ``--help`` repeatedly."""

    def once() -> float:
        began = time.monotonic()
        subprocess.run([*COMMAND, "--help"], check=True, stdout=subprocess.DEVNULL)
        return time.monotonic() - began

    return {"help": median(once() for _ in range(trials))}


@asynccontextmanager
async def robot(
    clock: Clock, folder: Path, config: str, *, apart: bool = True
) -> AsyncIterator[tuple[TruckClient, str, Stops]]:
    """An emulated truck with its daemon, a client, the endpoint, and the quick stops on the drive's wire.

    Args:
        clock: source of time.
        folder: folder for configuration and outputs.
        config: file in ``configs``.
        apart: whether truck and daemon have a core each.
    """
    endpoint = free_endpoint()
    overlay = write_overlay(ROOT / "configs" / config, folder, endpoint)
    cores = sorted(os.sched_getaffinity(0)) if apart else [None]
    bench = str(ROOT / "benchmarks" / "estop.py")
    async with (
        process(cores[-1], folder / "simulate.txt", bench, "--serve", str(overlay)) as simulator,
        process(cores[0], folder / "daemon.txt", "-m", "monstertruckd", "run", "--config", str(overlay)),
        await connect(clock, "truck", endpoint) as client,
    ):
        assert simulator.stdout is not None
        stops = Stops(simulator.stdout)
        reading = asyncio.create_task(stops.run())
        try:
            yield client, endpoint, stops
        finally:
            reading.cancel()


async def estop(clock: Clock, folder: Path, trials: int) -> dict[str, float]:
    """Start the command while the truck drives."""
    found = []
    async with robot(clock, folder, "demo.yaml") as (client, endpoint, stops):
        for trial in range(trials):
            await order(client, Order.ARM)
            until = time.monotonic() + 0.6
            while time.monotonic() < until:
                await client.drive(0.1 if trial % 2 else -0.1, 0.0)
                await asyncio.sleep(0.03)
            began = time.monotonic_ns()
            pressed = await asyncio.create_subprocess_exec(*COMMAND, "estop", "-e", endpoint, stdout=subprocess.DEVNULL)
            async with asyncio.timeout(WAIT):
                at = await stops.first_after(began)
                if await pressed.wait():
                    raise RuntimeError("estop has failed")
            if at is None:
                raise RuntimeError("no quick stop on the wire")
            found.append((at - began) / SECOND)
            await order(client, Order.RESET)
    return {"estop": median(found), "estop_p99": float(np.percentile(found, 99))}


async def status(clock: Clock, folder: Path, trials: int) -> dict[str, float]:
    """Time the live screen."""
    async with robot(clock, folder, "demo.yaml") as (_, endpoint, _):
        found = [await asyncio.to_thread(first_picture, endpoint, b"disarmed") for _ in range(trials)]
    return {"status": median(found)}


def first_picture(endpoint: str, text: bytes) -> float:
    """Return the seconds until ``status`` shows ``text``."""
    began = time.monotonic()
    child, terminal = pty.fork()
    if child == 0:
        os.environ["TERM"] = "xterm-256color"
        os.execv(COMMAND[0], [*COMMAND, "status", "-e", endpoint])
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    shown = b""
    try:
        while text not in shown:
            shown += os.read(terminal, 1 << 16)
            if time.monotonic() - began > WAIT:
                raise TimeoutError(f"status did not show {text!r}: {shown[-2000:]!r}")
        return time.monotonic() - began
    finally:
        os.kill(child, signal.SIGINT)
        with suppress(OSError):
            while os.read(terminal, 1 << 16):
                pass
        os.waitpid(child, 0)
        os.close(terminal)


async def goto(clock: Clock, folder: Path) -> dict[str, float]:
    """Time a new daemon twice: the first one compiles missing kernels."""
    taken = 0.0
    for turn in ("first", "second"):
        (folder / turn).mkdir()
        async with (
            robot(clock, folder / turn, "goals.yaml", apart=False) as (client, endpoint, _),
            contextlib.AsyncExitStack() as stack,
        ):
            goals = stack.enter_context(client.subscribe(topics.GOAL, latest()))
            began = time.monotonic()
            going = await asyncio.create_subprocess_exec(
                *COMMAND, "goto", *GOAL_POSE, "-e", endpoint, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
            )
            async with asyncio.timeout(3 * WAIT):
                while (await goals.next()).routes == 0:
                    pass
            taken = time.monotonic() - began
            going.send_signal(signal.SIGINT)
            await going.wait()
    return {"goto": taken}


async def tasks(_: Clock, folder: Path) -> dict[str, float]:
    """Carry out the tasks of a new user on the page."""
    async with tried(folder) as url, chromium(folder) as browser:
        page = await opened(browser, url, viewport={"width": 1440, "height": 900})
        await page.wait_for_selector("#map[data-drawn=true]", timeout=4 * PATIENCE)
        return {name: await timed(page, task) for name, task in TASKS.items()}


def served(part: Callable[..., Any], *arguments: int) -> dict[str, float]:
    """Run a part that needs a robot."""

    async def main(clock: Clock) -> dict[str, float]:
        with TemporaryDirectory(prefix="first-hour-") as folder:
            result: dict[str, float] = await part(clock, Path(folder), *arguments)
            return result

    return run_wall(main)


def main() -> int:
    """Measure; 0: all goals are met."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=40)
    parts: dict[str, Callable[[int], dict[str, float]]] = {
        "help": help_text,
        "estop": lambda trials: served(estop, trials),
        "status": lambda trials: served(status, max(trials // 4, 3)),
        "goto": lambda _: served(goto),
        "tasks": lambda _: served(tasks),
        "lap": lambda _: lap(),
    }
    parser.add_argument("--only", nargs="*", choices=[*parts], default=[*parts])
    options = parser.parse_args()
    # Python keeps what it has compiled, unless it is set not to, as some containers do.
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    figures: dict[str, float] = {}
    print("| wait for | s | goal s |\n|---|---:|---:|")
    for name in options.only:
        for figure, seconds in parts[name](options.trials).items():
            figures[figure] = round(seconds, 3)
            print(f"| {figure} | {seconds:.3f} | {GOALS[figure]:g} |", flush=True)
    goals = {name: GOALS[name] for name in figures}
    met = all(seconds <= goals[name] for name, seconds in figures.items())
    print(json.dumps({"bench": "first_hour", "figures": figures, "goals": goals, "met": met}))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
