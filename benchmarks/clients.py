"""Memory of the daemon while many clients connect, query, drive and leave: it must stay flat.

    python benchmarks/clients.py [--minutes 60] [--clients 200] [--processes 2]

The daemon of an emulated truck runs in a separate process. Each client is a station's session with a unique name: it
follows the gate, queries the versions and sends a drive request once in ``BEAT`` s; after ``STAYS`` s it leaves and is
replaced. Resident memory is sampled every ten seconds. Its slope is that of a line through the samples after the first
ten minutes, or after half of a shorter run. The last line is JSON.
"""

import argparse
import asyncio
import json
import os
import sys
import time
from contextlib import AsyncExitStack, suppress
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks import ROOT
from benchmarks.estop_parts.processes import process, processor_seconds
from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import Clock, run_wall
from monstertruck_runtime.errors import TruckError
from monstertruck_runtime.mailbox import latest
from monstertruck_schemas import topics
from monstertruckd.tools.demo.runs import connect, free_endpoint, write_overlay

OUTPUT = ROOT / "runs" / "benchmarks" / "clients.json"
BEAT = 2.0
STAYS = (30.0, 120.0)
WARM = 10.0
"""Minutes at the start that do not count."""
EVERY = 10.0
"""Seconds from one sample to the next."""
SLOPE_GOAL = 0.3
"""MB a minute."""


async def visit(endpoint: str, name: str, seconds: float) -> None:
    """Run one client, from connection to departure."""
    end = time.monotonic() + seconds
    async with TruckClient("truck", endpoint, source=name) as client:
        with client.subscribe(topics.GATE, latest()):
            while time.monotonic() < end:
                with suppress(TruckError, TimeoutError):
                    await client.call("versions")
                    await client.drive(0.0, 0.0)
                await asyncio.sleep(BEAT)


async def visits(endpoint: str, place: str, seed: int) -> None:
    """Run clients one after the other at one of the places, until cancelled."""
    rng = np.random.default_rng(seed)
    await asyncio.sleep(float(rng.uniform(0, BEAT)))
    number = 0
    while True:
        number += 1
        with suppress(TruckError, TimeoutError):
            await visit(endpoint, f"{place}-{number}", float(rng.uniform(*STAYS)))


async def serve_clients(endpoint: str, first: int, count: int) -> None:
    """Run the clients of one process."""
    async with asyncio.TaskGroup() as group:
        for place in range(first, first + count):
            group.create_task(visits(endpoint, f"client{place}", place))


def resident(pid: int) -> float:
    """Resident memory of a process, MB (proc(5))."""
    pages = int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def slope(samples: list[tuple[float, float]], warm: float) -> float:
    """Return the slope (MB/min) of the samples (minute, MB) after ``warm`` minutes."""
    after = np.array([sample for sample in samples if sample[0] >= warm])
    return float(np.polyfit(after[:, 0], after[:, 1], 1)[0]) if len(after) > 2 else float("nan")


async def measure(clock: Clock, folder: Path, minutes: float, count: int, processes: int) -> list[tuple[float, float]]:
    """Return samples (minute, MB) of the daemon."""
    endpoint = free_endpoint()
    config = write_overlay(ROOT / "configs" / "demo.yaml", folder, endpoint)
    here = str(Path(__file__).resolve())
    samples: list[tuple[float, float]] = []
    async with AsyncExitStack() as stack:
        enter = stack.enter_async_context
        serving = ("-m", "monstertruckd", "simulate", "--config", str(config))
        await enter(process(None, folder / "simulate.txt", *serving))
        running = ("-m", "monstertruckd", "run", "--config", str(config))
        daemon = await enter(process(None, folder / "daemon.txt", *running))
        await enter(await connect(clock, "truck", endpoint))
        share = -(-count // processes)
        for first in range(0, count, share):
            some = str(min(share, count - first))
            await enter(process(None, folder / "clients.txt", here, "--visit", endpoint, str(first), some))
        began = time.monotonic()
        while (minute := (time.monotonic() - began) / 60) < minutes:
            samples.append((minute, resident(daemon.pid)))
            busy = processor_seconds(daemon.pid)
            print(f"minute {minute:.1f}: {samples[-1][1]:.1f} MB, {busy:.0f} s of processor", file=sys.stderr)
            await asyncio.sleep(EVERY)
    return samples


def main() -> int:
    """Measure; 0 = the goal is met."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--clients", type=int, default=200)
    parser.add_argument("--processes", type=int, default=2, help="that the clients are in")
    parser.add_argument("--visit", nargs=3, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.visit is not None:
        endpoint, first, count = options.visit
        run_wall(lambda _: serve_clients(endpoint, int(first), int(count)))
        return 0
    with TemporaryDirectory(prefix="clients-") as folder:
        samples = run_wall(
            lambda clock: measure(clock, Path(folder), options.minutes, options.clients, options.processes)
        )
    warm = min(WARM, options.minutes / 2)
    found = slope(samples, warm)
    figures = {
        "clients": options.clients,
        "minutes": options.minutes,
        "slope_mb_min": round(found, 3),
        "begin_mb": round(samples[0][1], 1),
        "end_mb": round(samples[-1][1], 1),
    }
    met = found <= SLOPE_GOAL and options.minutes >= 60 and options.clients >= 200
    goals = {"slope_mb_min": SLOPE_GOAL, "minutes": 60, "clients": 200}
    OUTPUT.parent.mkdir(parents=True, exist_ok=True)
    OUTPUT.write_text(json.dumps({"figures": figures, "samples": samples}), encoding="utf-8")
    print(json.dumps({"bench": "clients", "figures": figures, "goals": goals, "met": met}))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
