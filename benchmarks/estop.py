"""Time from an emergency stop to the quick-stop bytes on the drive controller's wire, under floods of other messages.

    python benchmarks/estop.py [--trials 300] [--quick] [--flood NAME ...]
    python benchmarks/estop.py --cost [--flood NAME ...]
    python benchmarks/estop.py --page [--trials 500] [--quick]

The daemon of the emulated truck runs in a separate process, pinned to one core; world, emulators, operator and flooder
share the other. The truck drives to and fro at 0.1 m/s. Each trial sends one emergency stop by topic and measures the
time to the first quick stop on the wire; without one within ``MISSED`` s the stop is missed. Floods are as fast as the
flooder can send, at most ``RATE`` a second; the achieved rate and the load of the cores by other programs are reported:

    none     nothing else
    nonce    orders to arm with another run's nonce
    orders   orders with the right nonce and growing sequence numbers, of a role without the permission
    stops    orders to stop, which every role may send: the truck stands, armed, when the emergency stop arrives
    rubbish  bytes that are no order
    calls    remote calls, each with an answer
    forged   states of the gate and scans published under the robot's keys, by a robot with
             ``zenoh.access_control``: without it they reach the operator's program, which then sees a disarmed truck

``--cost`` prints the daemon's processor time for each message of a flood instead: that of a daemon with a standing
truck, minus its time without a flood. It does not depend on other load.

``--quick`` makes 40 trials of none, nonce and rubbish. ``--page`` measures from the page in a browser instead
(``estop_parts/page.py``): clicks, commands to the wires, and a frozen browser. The last line is JSON.
"""

import argparse
import asyncio
import contextlib
import json
import os
import sys
import time
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks import ROOT
from benchmarks.estop_parts.processes import (
    ORDER_TIMEOUT,
    TO_AND_FRO,
    OtherLoad,
    on_stderr,
    order,
    process,
    processor_seconds,
    set_scheduler,
)
from monstertruck_drivers.cable import PtyPort
from monstertruck_drivers.epos import objects as od
from monstertruck_drivers.epos.protocol import Control, FrameError, Opcode, decode_body, join
from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import SECOND, Clock, run_wall
from monstertruck_runtime.errors import TruckError
from monstertruck_runtime.mailbox import latest
from monstertruck_runtime.yaml_files import yaml_text
from monstertruck_schemas import topics
from monstertruck_schemas.req import Order
from monstertruck_schemas.state import GateMode, GateState
from monstertruckd.config.load import FILE_VERSION
from monstertruckd.tools.demo.runs import connect, free_endpoint, write_overlay
from monstertruckd.tools.simulation import simulate
from monstertruckd.tools.simulation.config import load_simulated

FLOODS = ("none", "nonce", "orders", "stops", "rubbish", "calls", "forged")
QUICK = ("none", "nonce", "rubbish")
RATE = 10_000
MISSED = 1.0
DRIVEN = 0.3
"""Seconds of driving before each emergency stop, and a random share of a tick more."""
GOAL_MS = 35.0
STOPPED = 0.5
"""Seconds of a flood of stops before each emergency stop."""
COST_US = {"nonce": 20.0, "orders": 20.0, "stops": 30.0, "rubbish": 20.0, "calls": 300.0, "forged": 20.0}
"""Goals of the daemon's processor time for each message of a flood, us: 10 000 a second are a fifth of a core then."""
COST_SECONDS = 5.0
"""Seconds over which the processor time of a flood is counted."""
MOST_FAILED = 3
"""Trials of one flood in which a computer too busy for its sensors keeps the truck standing; it ends with the last."""
QUIET = 0.03
"""Cores that others may be busy with on a computer that counts as quiet."""


# World and emulators


class TappedPort(PtyPort):
    """Prints the time (ns) when a quick stop reached the drive controller."""

    def __init__(self, link: Path) -> None:
        super().__init__(link)
        if link.name == "drive":
            self.device.on_bytes = self._pass

    @staticmethod
    def _pass(to_device: bool, data: bytes) -> None:
        at = time.monotonic_ns()
        if not to_device:
            return
        with suppress(FrameError):
            words = decode_body(Opcode.WRITE, data).words
            written = len(words) == 4 and words[0] == od.CONTROLWORD.index
            if written and join(words[2], words[3]) == Control.QUICK_STOP:
                print(f"stop {at}", flush=True)


def serve(config: Path) -> None:
    """Run ``monstertruckd simulate`` with a tap on the drive's wire."""
    simulate.PtyPort = TappedPort  # type: ignore[attr-defined, misc]
    run_wall(lambda clock: simulate.serve(clock, (load_simulated(config),), on_stderr))


# Flooder


def flood(kind: str, endpoint: str, nonce: str, yields: bool) -> None:
    """Flood from the first line of standard input to the next one, and so on until it ends.

    Prints a line when it is connected; at the end the number of sent messages and the seconds they took.

    Args:
        kind: name of the flood.
        endpoint: endpoint of the robot.
        nonce: nonce of its run.
        yields: whether to yield to emulated devices and operator on its core: real devices have their own processors.
    """
    import select  # noqa: PLC0415 - of this process only

    import zenoh  # noqa: PLC0415

    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config) as session:
        send = _sender(session, kind, nonce)
        count, total, seconds = 0, 0, 0.0
        print("connected", flush=True)
        flooding, began = False, 0.0
        while True:
            if not flooding or select.select([sys.stdin], [], [], 0)[0]:
                if flooding:
                    total, seconds = total + count, seconds + time.monotonic() - began
                if not sys.stdin.readline():
                    break
                flooding, count, began = not flooding, 0, time.monotonic()
                if yields and flooding:
                    set_scheduler(os.getpid(), os.SCHED_IDLE)
                continue
            send(count)
            count += 1
            wait = began + count / RATE - time.monotonic()
            if wait > 0.001:
                time.sleep(wait)
        print(json.dumps({"count": total, "seconds": seconds}), flush=True)


def _sender(session: Any, kind: str, nonce: str) -> Callable[[int], None]:
    """Return a function that sends the message of a flood with the given number."""
    rng = np.random.default_rng(1)
    order = {"source": "flood", "role": "station", "lease": 1.0, "nonce": "another", "order": "arm"}
    if kind == "orders":
        order |= {"nonce": nonce, "role": "tracker"}
    if kind == "stops":
        order |= {"order": "stop"}
    requests = topics.REQ_CONTROL.key("truck", "flood")
    call = topics.rpc_key("truck", "versions", "flood")

    def send(number: int) -> None:
        now = time.monotonic_ns()
        match kind:
            case "rubbish":
                session.put(requests, rng.bytes(200))
            case "calls":
                session.get(call, lambda _: None, timeout=0.5)
            case "forged":
                state = GateState(
                    stamp=now, received=now, seq=number, mode=GateMode.DISARMED, nonce=nonce, speed_limit=0.0
                )
                session.put(topics.GATE.key("truck"), state.model_dump_json())
                session.put(topics.SCAN.key("truck"), rng.bytes(2000))
            case _:
                header = {"stamp": now, "received": now, "seq": now, "gate_stamp": now}
                session.put(requests, json.dumps(order | header))

    return send


class Flooder:
    """A flood in a separate process.

    Args:
        running: that process.
    """

    def __init__(self, running: asyncio.subprocess.Process) -> None:
        self._running = running

    async def switch(self) -> None:
        """Start or pause."""
        assert self._running.stdin is not None
        self._hurry()
        self._running.stdin.write(b"\n")
        await self._running.stdin.drain()

    def _hurry(self) -> None:
        """Raise its priority until it has read the command: a yielding process gets no time on a busy computer."""
        set_scheduler(self._running.pid, os.SCHED_OTHER)

    async def end(self) -> float:
        """End the flood; return its messages per second of flooding."""
        self._hurry()
        printed, _ = await self._running.communicate(b"")
        sent = json.loads(printed.splitlines()[-1])
        return float(sent["count"] / (sent["seconds"] or 1.0))


@contextlib.asynccontextmanager
async def flooder(
    kind: str, client: TruckClient, endpoint: str, folder: Path, core: int | None
) -> AsyncIterator[Flooder]:
    """Start a connected flooder that does not flood yet; without a separate core it does not yield."""
    state = await client.get_retained(topics.GATE)
    assert state is not None
    words = (
        str(Path(__file__).resolve()),
        "--flooder",
        kind,
        endpoint,
        state.nonce,
        "yields" if core is not None else "",
    )
    async with process(core, folder / "flood.txt", *words) as running:
        assert running.stdout is not None
        await running.stdout.readline()
        yield Flooder(running)


# Operator


class Stops:
    """Times of quick stops on the wire, as printed by the simulator."""

    def __init__(self, stream: asyncio.StreamReader) -> None:
        self._stream = stream
        self._instants: asyncio.Queue[int] = asyncio.Queue()

    async def run(self) -> None:
        """Read until the simulator ends."""
        while line := await self._stream.readline():
            if line.startswith(b"stop "):
                self._instants.put_nowait(int(line[5:]))

    async def first_after(self, instant: int) -> int | None:
        """Return the first one after ``instant``, ns; None if it is missed."""
        with suppress(TimeoutError):
            async with asyncio.timeout(MISSED):
                while (at := await self._instants.get()) < instant:
                    pass
                return at
        return None


async def press(
    client: TruckClient, stops: Stops, forward: bool, more: float, stopping: Flooder | None = None
) -> float | None:
    """Drive, then send one emergency stop; return the seconds to its quick stop, None if missed.

    The truck is disarmed at the end. A truck that was disarmed because a busy computer delayed its sensors is armed
    again. In a flood of stops the truck stands when the emergency stop arrives.

    Raises:
        TruckError, TimeoutError: the computer is too busy for the truck to drive.
    """
    with client.subscribe(topics.ODOMETRY, latest()) as odometry, client.subscribe(topics.GATE, latest()) as gate:
        async with asyncio.timeout(ORDER_TIMEOUT):
            driven: int | None = None
            while driven is None or time.monotonic_ns() < driven + (DRIVEN + more) * SECOND:
                if gate.latest is None or gate.latest.mode is GateMode.DISARMED:
                    await order(client, Order.ARM)
                    driven = None
                await client.drive(0.1 if forward else -0.1, 0.0)
                moves = odometry.latest is not None and abs(odometry.latest.twist.vx) > 0.02
                if driven is None and moves:
                    driven = time.monotonic_ns()
                await asyncio.sleep(0.03)
    if stopping is not None:
        await stopping.switch()
        await asyncio.sleep(STOPPED)
    await asyncio.sleep(more)
    pressed = time.monotonic_ns()
    outcome = client.order(Order.ESTOP)
    at = await stops.first_after(pressed)
    with suppress(Exception):
        await outcome
    if stopping is not None:
        await stopping.switch()
    await order(client, Order.RESET)
    return None if at is None else (at - pressed) / SECOND


async def trials(clock: Clock, folder: Path, kind: str, count: int) -> dict[str, Any]:
    """Run all trials of one flood."""
    endpoint = free_endpoint()
    base, access = folder / "to_and_fro.yaml", {"zenoh": {"access_control": True}} if kind == "forged" else {}
    demo = {"include": str(ROOT / "configs" / "demo.yaml"), "version": FILE_VERSION}
    base.write_text(yaml_text(demo | TO_AND_FRO | access))
    config = write_overlay(base, folder, endpoint)
    cores = sorted(os.sched_getaffinity(0))
    own, other = cores[0], cores[-1]
    here = str(Path(__file__).resolve())
    rng = np.random.default_rng(1)
    async with (
        process(other, folder / "simulate.txt", here, "--serve", str(config)) as simulator,
        process(own, folder / "daemon.txt", "-m", "monstertruckd", "run", "--config", str(config)),
        await connect(clock, "truck", endpoint) as client,
    ):
        assert simulator.stdout is not None
        stops = Stops(simulator.stdout)
        reading = asyncio.create_task(stops.run())
        with suppress(TruckError, TimeoutError):
            await press(client, stops, True, 0.0)  # everything is warm then
        async with contextlib.AsyncExitStack() as flooded:
            running, stopping, rate = None, None, 0.0
            if kind != "none":
                running = await flooded.enter_async_context(flooder(kind, client, endpoint, folder, other))
                if kind == "stops":
                    stopping = running
                else:
                    await running.switch()
                    await asyncio.sleep(1.0)
            delays = rng.uniform(0, 0.02, count).tolist()
            found: list[float | None] = []
            failed = 0
            for n, more in enumerate(delays):
                try:
                    found.append(await press(client, stops, n % 2 == 1, more, stopping))
                except (TruckError, TimeoutError):
                    failed += 1
                    if failed == MOST_FAILED:
                        break
            if running is not None:
                rate = await running.end()
        reading.cancel()
    known = np.array([1e3 * seconds for seconds in found if seconds is not None])
    p50, p99, most = np.percentile(known, (50, 99, 100)).tolist() if len(known) else (0.0, 0.0, 0.0)
    return {
        "trials": len(found),
        "not_driven": failed,
        "missed": len(found) - len(known),
        "p50_ms": round(p50, 1),
        "p99_ms": round(p99, 1),
        "max_ms": round(most, 1),
        "rate": round(rate),
    }


async def costs(clock: Clock, folder: Path, kinds: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return the daemon's processor time for each message of the floods (us), and the messages per second."""
    endpoint = free_endpoint()
    config = write_overlay(ROOT / "configs" / "demo.yaml", folder, endpoint)
    here = str(Path(__file__).resolve())
    async with (
        process(None, folder / "simulate.txt", here, "--serve", str(config)),
        process(None, folder / "daemon.txt", "-m", "monstertruckd", "run", "--config", str(config)) as daemon,
        await connect(clock, "truck", endpoint) as client,
    ):
        await asyncio.sleep(COST_SECONDS)  # everything is warm then

        async def share() -> float:
            before, began = processor_seconds(daemon.pid), time.monotonic()
            await asyncio.sleep(COST_SECONDS)
            return (processor_seconds(daemon.pid) - before) / (time.monotonic() - began)

        alone = await share()
        figures: dict[str, dict[str, Any]] = {"none": {"daemon_percent": round(100 * alone, 1)}}
        for kind in kinds:
            async with flooder(kind, client, endpoint, folder, None) as running:
                await running.switch()
                await asyncio.sleep(1.0)
                flooded = await share()
                await running.switch()
                rate = await running.end()
            figures[kind] = {
                "rate": round(rate),
                "cost_us": round(1e6 * (flooded - alone) / rate, 1),
                "daemon_percent": round(100 * flooded, 1),
            }
    return figures


def print_costs(kinds: Sequence[str]) -> int:
    """Print the cost of each message of a flood; 0: the goal is met."""
    with TemporaryDirectory(prefix="estop-") as folder:
        figures = run_wall(lambda clock: costs(clock, Path(folder), kinds))
    print("| flood | rate, 1/s | processor time of the daemon for each, us |")
    print("|---|---:|---:|")
    for kind in kinds:
        print(f"| {kind} | {figures[kind]['rate']} | {figures[kind]['cost_us']} |")
    met = all(figures[kind]["cost_us"] <= COST_US[kind] for kind in kinds)
    print(json.dumps({"bench": "estop_cost", "figures": figures, "goals": {"cost_us": COST_US}, "met": met}))
    return 0 if met else 1


def from_the_page(count: int) -> int:
    """Press the button on the page; 0: all goals are met."""
    from benchmarks.estop_parts import page  # noqa: PLC0415 - needs a browser

    with TemporaryDirectory(prefix="estop-") as folder:
        figures = run_wall(lambda clock: page.measure(clock, Path(folder), count))
    print("| from the page | trials | not counted | p50 ms | p99 ms | greatest ms |")
    print("|---|---:|---:|---:|---:|---:|")
    for name, done in figures.items():
        print(f"| {name} | " + " | ".join(str(value) for value in done.values()) + " |")
    goals_met = page.met(figures)
    print(json.dumps({"bench": "estop_page", "figures": figures, "goals": page.GOALS, "met": goals_met}))
    return 0 if goals_met else 1


def main() -> int:
    """Run all trials; 0: all goals are met."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, help="300; 500 from the page")
    parser.add_argument("--page", action="store_true", help="from a hand on the page, in a browser")
    parser.add_argument("--cost", action="store_true", help="processor time of the daemon for each message of a flood")
    parser.add_argument("--quick", action="store_true", help="40 trials, fewer floods")
    parser.add_argument("--flood", nargs="*", choices=FLOODS, help="only these")
    parser.add_argument("--serve", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--flooder", nargs=4, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve is not None:
        serve(options.serve)
        return 0
    if options.flooder is not None:
        kind, endpoint, nonce, yields = options.flooder
        flood(kind, endpoint, nonce, bool(yields))
        return 0
    if options.cost:
        return print_costs([kind for kind in options.flood or FLOODS if kind in COST_US])
    count = 40 if options.quick else options.trials or (500 if options.page else 300)
    if options.page:
        return from_the_page(count)
    figures: dict[str, dict[str, Any]] = {}
    print("| flood | rate, 1/s | trials | not driven | missed | p50 ms | p99 ms | greatest ms | others, cores |")
    print("|---|---:|---:|---:|---:|---:|---:|---:|---:|")
    for kind in options.flood or (QUICK if options.quick else FLOODS):
        others = OtherLoad()
        with TemporaryDirectory(prefix="estop-") as folder:
            done = run_wall(lambda clock, kind=kind, folder=folder: trials(clock, Path(folder), kind, count))
        done["others_cores"] = round(others.cores(), 2)
        figures[kind] = done
        columns = ("rate", "trials", "not_driven", "missed", "p50_ms", "p99_ms", "max_ms", "others_cores")
        print(f"| {kind} | {' | '.join(str(done[name]) for name in columns)} |", flush=True)
    if any(done["others_cores"] > QUIET for done in figures.values()):
        print(f"others were busy with more than {QUIET} cores: these are no figures of a quiet computer")
    met = all(done["p99_ms"] <= GOAL_MS and done["missed"] == done["not_driven"] == 0 for done in figures.values())
    met = met and all(done["rate"] > 0 for kind, done in figures.items() if kind != "none")
    goals = {"p99_ms": GOAL_MS, "missed": 0, "trials": 300, "others_cores": QUIET}
    print(json.dumps({"bench": "estop", "figures": figures, "goals": goals, "met": met}))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
