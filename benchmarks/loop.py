"""How punctual the control tick is during everything else the daemon does, and what the daemon costs.

    python benchmarks/loop.py [--rounds N] [--seconds S] [--with slam|planning|exploring]

The whole truck drives lap after lap, armed again after every stop: the daemon with every device at full rate, recording
to disk, in one process; world and emulated devices behind ptys in another; a third subscribes to all it publishes.
Rounds alternate with an empty event loop that only ticks at the same rate, while world and emulators go on: that is the
floor. Lateness is that of the gate's 50 Hz tick; the figure is the median of the rounds. Processor time and memory are
those of the daemon's process alone, without its workers, from ``WARM_UP`` seconds after the truck drives. For as long
again the callbacks of its event loop are measured, in processor time of the thread, which has a cost of its own.
``--with`` adds mapping, or planner, deformer and goals in the rooms instead of the laps, or an exploration of the rooms
by mapper, explorer and planner; then only the lateness has a goal. The last line is JSON.
"""

import argparse
import asyncio
import itertools
import json
import signal
import sys
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks.same_python import go_on_in_the_systems_python
from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import SECOND, Clock, run_wall
from monstertruck_runtime.errors import RequestRefusedError
from monstertruck_runtime.mailbox import fifo, latest
from monstertruck_schemas import topics
from monstertruck_schemas.plan import GoalPhase
from monstertruck_schemas.req import ExploreOrder
from monstertruck_schemas.state import GateMode
from monstertruckd.tools.demo.runs import connect, free_endpoint, write_overlay
from monstertruckd.tools.simulation.operator import drive_lap
from monstertruckd.tools.simulation.program import program

HERE = Path(__file__).resolve().parent
FULL = HERE.parent / "configs" / "full.yaml"
WARM_UP = 5.0
TIMEOUT = 60.0
GOALS = {
    "late_p99_over_floor_ms": 1.5,
    "callbacks_over_2ms": 0,
    "longest_callback_ms": 10.0,
    "cpu_percent": 15.0,
    "rss_mb": 150.0,
}
ROOMS = HERE.parent / "configs" / "worlds" / "rooms.yaml"
ADDED: dict[str, dict[str, Any]] = {
    "slam": {"slam": {"mode": "mapping"}},
    "planning": {
        "path": None,
        "planner": {"map": str(ROOMS), "local_planner": {"kind": "rsband"}},
        "tracker": {"kind": "lqr"},
        "odometry": {"start": {"x": 1.0, "y": 3.95, "yaw": 0.0}},
        "sim": {"world": {"map": "rooms"}},
    },
    "exploring": {
        "path": None,
        "planner": {"map": None},
        "tracker": {"kind": "lqr"},
        "slam": {"mode": "mapping", "grid": {"passed": 5.6, "free_footprint": True}, "map_period": 2.0},
        "explorer": {"kind": "information"},
        "odometry": {"start": {"x": 1.0, "y": 3.95, "yaw": 0.0}},
        "sim": {"world": {"map": "rooms"}},
    },
}
"""Sections that ``--with`` adds."""
PLACES = ((3.5, 3.9, 0.0), (2.4, 1.5, -1.57), (1.2, 3.9, 3.14))
LEAST_DRIVEN = 0.5
"""Share of the time in which the truck has to drive."""
EXPLAINED: dict[str, str] = {}
"""Callbacks that may take more than 2 ms, with the reason."""

SUBSCRIBER = """
import sys, zenoh
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", f'["{sys.argv[1]}"]')
config.insert_json5("scouting/multicast/enabled", "false")
count = 0
with zenoh.open(config) as session:
    def take(sample):
        global count
        count += len(sample.payload) > 0
    session.declare_subscriber("mt/truck/**", take)
    print("subscribed", flush=True)
    sys.stdin.read()
print(count)
"""


@asynccontextmanager
async def process(*arguments: str) -> AsyncIterator[asyncio.subprocess.Process]:
    """Run a Python process for the duration of the context; SIGTERM ends it."""
    pipe = asyncio.subprocess.PIPE
    running = await asyncio.create_subprocess_exec(
        sys.executable, *arguments, stdin=pipe, stdout=pipe, stderr=asyncio.subprocess.DEVNULL
    )
    try:
        yield running
    finally:
        if running.returncode is None:
            running.terminate()
        await running.communicate()


async def drive(client: TruckClient, clock: Clock, drives: "Drives", *, laps: bool) -> None:
    """Keep the truck driving: lap after lap, or to goals; armed again after every stop."""
    while laps:
        lap = await drive_lap(client, clock)
        drives.stops += [reason.value for reason in lap.stops]
        await clock.sleep(0.2)  # the tracker has to see that the truck was disarmed, or it does not begin again
    with client.subscribe(topics.GATE, latest()) as gate, client.subscribe(topics.STOP, latest()) as stop:
        while True:
            if gate.latest is not None and not gate.latest.mode.active:
                if drives.states:
                    drives.stops.append("unknown" if stop.latest is None else stop.latest.reason.value)
                with suppress(RequestRefusedError):
                    await client.arm()
            await clock.sleep(0.25)


@dataclass
class Drives:
    """States of the gate during the drives."""

    states: list[tuple[int, bool]] = field(default_factory=list)
    """When, and whether the truck drove."""
    stops: list[str] = field(default_factory=list)
    """Why it had to be armed again."""

    async def watch(self, client: TruckClient) -> None:
        """Record every state from the first drive on."""
        with client.subscribe(topics.GATE, fifo(256)) as gate:
            while True:
                state = await gate.next()
                if self.states or state.mode is GateMode.DRIVING:
                    self.states.append((state.received, state.mode is GateMode.DRIVING))

    def share(self, begin: int, end: int) -> float:
        """Return the share of the time between two instants in which the truck drove.

        Raises:
            SystemExit: it hardly drove, so there is nothing to measure.
        """
        drove = [driving for at, driving in self.states if begin <= at < end]
        share = sum(drove) / max(len(drove), 1)
        if share < LEAST_DRIVEN:
            why = ", ".join(dict.fromkeys(self.stops)) or "nothing stopped it"
            raise SystemExit(f"the truck drove only {share:.0%} of the time ({why}): nothing to measure")
        return share


async def wander(client: TruckClient, clock: Clock) -> None:
    """Send the truck from place to place."""
    with client.subscribe(topics.GOAL, latest()) as goals:
        await goals.next()
        for place in itertools.cycle(PLACES):
            await client.goal(place)
            await clock.sleep(1.0)
            while goals.latest is None or goals.latest.phase is not GoalPhase.IDLE:
                await clock.sleep(0.25)


async def explore(client: TruckClient, clock: Clock) -> None:
    """Explore repeatedly; retry after a refusal."""
    with client.subscribe(topics.EXPLORE, latest()) as states:
        while True:
            if states.latest is None or not states.latest.running:
                with suppress(RequestRefusedError):
                    await client.explore(ExploreOrder.START)
            await clock.sleep(1.0)


SENT = {"planning": wander, "exploring": explore}
"""What sends the truck; without: lap after lap."""


async def daemon_round(clock: Clock, config: Path, endpoint: str, seconds: float, added: str | None) -> dict[str, Any]:
    """Return the figures of one run of the daemon."""
    report = config.with_name("report.json")
    async with process(str(HERE / "loop_watched.py"), "daemon", str(config), str(report)) as daemon:  # noqa: SIM117
        async with await connect(clock, "truck", endpoint) as client, process("-c", SUBSCRIBER, endpoint) as subscriber:
            assert subscriber.stdout is not None
            assert subscriber.stdin is not None
            await subscriber.stdout.readline()
            drives = Drives()
            tasks = [asyncio.create_task(drives.watch(client))]
            tasks.append(asyncio.create_task(drive(client, clock, drives, laps=added not in SENT)))
            if added in SENT:
                tasks.append(asyncio.create_task(SENT[added](client, clock)))
                with client.subscribe(topics.PATH, latest()) as paths:
                    await paths.next()
            async with clock.deadline(TIMEOUT):
                while not drives.states:
                    await clock.sleep(0.1)
            await clock.sleep(WARM_UP)
            begin, used = clock.now(), _used(daemon.pid)
            await clock.sleep(seconds)
            unwatched, used = clock.now(), _used(daemon.pid) - used
            daemon.send_signal(signal.SIGUSR1)
            await clock.sleep(seconds)
            end = clock.now()
            memory = _memory(daemon.pid)
            for task in tasks:
                if not task.cancel():
                    task.result()
            await asyncio.wait(tasks)  # a cancelled lap disarms
            subscriber.stdin.close()
            received = int(await subscriber.stdout.readline())
    found = json.loads(report.read_text())
    ticks = np.array([late for at, late in found["ticks"] if begin <= at < end])
    slow = [(used, name) for at, used, name in found["callbacks"] if begin <= at < end]
    collections = [(used, generation) for at, used, generation in found["collections"] if begin <= at < end]
    return {
        "late": ticks,
        "slow": slow,
        "collected": collections,
        "cpu_percent": 100 * used / (unwatched - begin) * SECOND,
        "received": received,
        "seconds": (end - begin) / SECOND,
        "driven": drives.share(begin, end),
        "stops": len(drives.stops),
        **memory,
    }


async def empty_round(config: Path, seconds: float) -> np.ndarray:
    """Return the lateness of an empty loop, ms."""
    report = config.with_name("empty.json")
    async with process(str(HERE / "loop_watched.py"), "empty", str(report), str(seconds)) as running:
        await running.wait()
    return np.array(json.loads(report.read_text())["ticks"])[:, 1]


def _used(pid: int) -> float:
    """Return the processor time (s) of another process, by the clock of clock_getcpuclockid(3)."""
    return time.clock_gettime((~pid << 3) | 2)


def _memory(pid: int) -> dict[str, float]:
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    values = {line.split(":")[0]: line.split()[1] for line in lines if line.startswith(("VmRSS", "VmHWM"))}
    return {"rss_mb": int(values["VmRSS"]) / 1024, "peak_rss_mb": int(values["VmHWM"]) / 1024}


async def compare(clock: Clock, rounds: int, seconds: float, added: str | None) -> dict[str, Any]:
    """Run all rounds."""
    floor: list[np.ndarray] = []
    runs: list[dict[str, Any]] = []
    with TemporaryDirectory() as folder:
        endpoint = free_endpoint()
        config = write_overlay(FULL, Path(folder), endpoint)
        if added is not None:
            sections = {"include": str(config), "version": 1, **ADDED[added]}
            config = config.with_name(f"{added}.yaml")
            config.write_text(json.dumps(sections))
        output = Path(folder) / "simulate.txt"
        async with program(output, "simulate", "--config", str(config)):
            async with clock.deadline(TIMEOUT):
                while b"ready" not in output.read_bytes():
                    await clock.sleep(0.1)
            for _ in range(rounds):
                floor.append(await empty_round(config, seconds))
                runs.append(await daemon_round(clock, config, endpoint, seconds, added))
    return figures(floor, runs)


def figures(floor: list[np.ndarray], runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the medians of the rounds, and the callbacks of all of them."""

    def median(values: list[float]) -> float:
        return float(np.median(values))

    p99 = np.array(
        [[np.percentile(empty, 99), np.percentile(run["late"], 99)] for empty, run in zip(floor, runs, strict=True)]
    )
    slow = sorted((entry for run in runs for entry in run["slow"]), reverse=True)
    over = [(used, name) for used, name in slow if used > 2.0]
    for used, name in slow[:12]:
        print(f"{used:8.2f} ms  {name}  {EXPLAINED.get(name, '')}")
    return {
        "floor_p50_ms": median([np.percentile(empty, 50) for empty in floor]),
        "floor_p99_ms": float(np.median(p99[:, 0])),
        "late_p50_ms": median([np.percentile(run["late"], 50) for run in runs]),
        "late_p99_ms": float(np.median(p99[:, 1])),
        "late_max_ms": median([run["late"].max() for run in runs]),
        "late_p99_over_floor_ms": float(np.median(p99[:, 1] - p99[:, 0])),
        "ticks": sum(len(run["late"]) for run in runs),
        "callbacks_over_2ms": len([name for _, name in over if name not in EXPLAINED]),
        "callbacks_over_2ms_explained": len([name for _, name in over if name in EXPLAINED]),
        "longest_collection_ms": max((used for run in runs for used, _ in run["collected"]), default=0.0),
        "collecting_percent": median([sum(used for used, _ in run["collected"]) / run["seconds"] / 10 for run in runs]),
        "full_collections": sum(generation == 2 for run in runs for _, generation in run["collected"]),
        "longest_callback_ms": slow[0][0] if slow else 0.0,
        "cpu_percent": median([run["cpu_percent"] for run in runs]),
        "rss_mb": median([run["rss_mb"] for run in runs]),
        "peak_rss_mb": median([run["peak_rss_mb"] for run in runs]),
        "driven_share": median([run["driven"] for run in runs]),
        "armed_again": sum(run["stops"] for run in runs),
        "messages_received": sum(run["received"] for run in runs),
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--with", dest="added", choices=ADDED, default=None)
    arguments = parser.parse_args()
    go_on_in_the_systems_python()
    found = run_wall(lambda clock: compare(clock, arguments.rounds, arguments.seconds, arguments.added))
    for name, value in found.items():
        print(f"{name:30} {value:10.3f}")
    goals = GOALS if arguments.added is None else {name: GOALS[name] for name in ("late_p99_over_floor_ms",)}
    met = all(found[name] <= goal for name, goal in goals.items())
    print(json.dumps({"bench": "loop", "figures": found, "goals": goals, "met": met}))


if __name__ == "__main__":
    main()
