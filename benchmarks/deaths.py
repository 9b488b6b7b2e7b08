"""Daemon killed, frozen or terminated while the truck drives: seconds and metres to standstill.

    python -m benchmarks.deaths [--trials 20]

Emulated devices run in one process, the daemon in another, on the wall clock. Every trial begins at the start of the
lap, at 0.18 m/s, at a different moment of the lap. The true speed is the simulator's. Takes half an hour.
"""

import argparse
import asyncio
import json
import signal
import subprocess
import sys
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks import ROOT
from monstertruck_runtime.clock import SECOND
from monstertruckd.tools.drill.observer import STANDING_SPEED
from monstertruckd.tools.simulation.config import DEADMAN_LINE
from tests.daemon.wall_kit import Robot, end, robot

FROZEN = 1.5
"""Seconds for which a daemon is stopped where nothing else stops the truck."""
WATCHED = 3.0
"""Seconds from the last signal to the end of a trial."""


async def kill(truck: Robot) -> float:
    """SIGKILL the daemon; return the instant, s."""
    return await send(truck, signal.SIGKILL)


async def kill_and_stop(truck: Robot) -> float:
    """SIGKILL the daemon, and run the stop script as soon as the process is gone."""
    began = await send(truck, signal.SIGKILL)
    await end(truck.daemon, signal.SIGKILL)
    script = [sys.executable, "-I", str(ROOT / "systemd" / "neutral.py"), str(truck.folder / "dev" / "drive")]
    await asyncio.to_thread(subprocess.run, script, capture_output=True, check=True, timeout=20)
    return began


async def freeze(truck: Robot) -> float:
    """SIGSTOP the daemon."""
    return await send(truck, signal.SIGSTOP)


async def freeze_and_continue(truck: Robot) -> float:
    """SIGSTOP the daemon for a while, then SIGCONT; return the instant of the latter."""
    await send(truck, signal.SIGSTOP)
    await asyncio.sleep(FROZEN)
    return await send(truck, signal.SIGCONT)


async def terminate(truck: Robot) -> float:
    """SIGTERM the daemon."""
    return await send(truck, signal.SIGTERM)


async def send(truck: Robot, number: int) -> float:
    """Signal the daemon; return the instant, s."""
    assert truck.daemon is not None
    began = truck.clock.now() / SECOND
    truck.daemon.send_signal(number)
    return began


@dataclass(frozen=True)
class Way:
    """A way in which the daemon abandons the truck."""

    act: Callable[[Robot], Awaitable[float]]
    overlay: dict[str, Any]
    goal: float
    """Greatest seconds to standstill."""


WAYS = {
    "killed, deadman line": Way(kill, dict(DEADMAN_LINE), 0.75),
    "killed, no line, stop script": Way(kill_and_stop, {}, 2.0),
    "frozen, deadman line": Way(freeze, dict(DEADMAN_LINE), 0.75),
    "frozen 1.5 s, no line, then continued": Way(freeze_and_continue, {}, 1.0),
    "asked to end": Way(terminate, {}, 0.6),
}


async def trial(way: Way, cruise: float) -> tuple[float, float]:
    """Return the seconds (infinite: never) and metres to standstill."""
    with TemporaryDirectory(prefix="monstertruck-") as folder:
        async with robot(Path(folder), way.overlay) as truck:
            await truck.start_simulator()
            await truck.start_daemon()
            async with truck.client() as client:
                await truck.drive(client)
                await asyncio.sleep(cruise)
            began = await way.act(truck)
            await asyncio.sleep(WATCHED)
            truth = await truck.truth()
    later = truth[truth[:, 0] >= began]
    moving = np.flatnonzero(np.abs(later[:, 4]) > STANDING_SPEED)
    last = int(moving[-1]) + 1 if len(moving) else 0
    seconds = float(later[last, 0] - began) if last < len(later) else float("inf")
    return seconds, float(np.hypot(*np.diff(later[: last + 1, 1:3], axis=0).T).sum())


def main() -> int:
    """Try all ways; 0: all goals are met."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=20)
    trials = parser.parse_args().trials
    rng, figures, goals = np.random.default_rng(1), {}, {}
    print("| daemon | trials | standstill s, p50 | greatest | metres, p50 | greatest |")
    print("|---|---:|---:|---:|---:|---:|")
    for name, way in WAYS.items():
        found = np.array([asyncio.run(trial(way, float(rng.uniform(0.2, 2.0)))) for _ in range(trials)])
        (middle, metres), (most, farthest) = np.median(found, axis=0), found.max(axis=0)
        print(f"| {name} | {trials} | {middle:.2f} | {most:.2f} | {metres:.3f} | {farthest:.3f} |", flush=True)
        figures |= {f"{name}: s": round(float(most), 3), f"{name}: m": round(float(farthest), 3)}
        goals[f"{name}: s"] = way.goal
    met = all(figures[name] <= goal for name, goal in goals.items())
    print(json.dumps({"bench": "deaths", "figures": figures | {"trials": trials}, "goals": goals, "met": met}))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
