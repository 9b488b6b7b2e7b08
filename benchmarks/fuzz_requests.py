"""A fuzzer on every key by which something may be asked of a running robot, from a process of its own.

    python -m benchmarks.fuzz_requests [--count 100000] [--seed 1] [--rate 2000]
    python -m benchmarks.fuzz_requests --gate [--count 100000] [--seed 1]

Emulated truck and daemon as ``monstertruckd simulate`` and ``run`` are. The fuzzer knows the keys of all requests and
the names of all calls, and takes another name every time; it does not know the robot's nonce. It sends noise, and
requests that would be right but for the nonce, with bytes flipped, cut, doubled, fields of wrong types, huge and
nested. The truck must not move and never be armed: stopped it may be, for an emergency stop is taken from everybody.
Afterwards no service may have failed, and the truck has to obey its operator.

``--gate`` asks the gates of all kinds of bodies instead, without a daemon, for as many ticks: numbers, times and orders
at which arithmetic or the state machine may break (``fuzz_parts/gate.py``). The last line is JSON.
"""

import argparse
import asyncio
import json
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import zenoh

from benchmarks import ROOT
from benchmarks.estop_parts.processes import order, process
from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import Clock, run_wall
from monstertruck_runtime.errors import TruckError
from monstertruck_runtime.mailbox import latest
from monstertruck_runtime.stations import session_config, tls_for
from monstertruck_schemas import topics
from monstertruck_schemas.health import ServiceState
from monstertruck_schemas.req import Order
from monstertruck_schemas.state import GateMode
from monstertruck_schemas.topics import TOPICS, Writer
from monstertruckd.tools.demo.runs import connect, free_endpoint, write_overlay

MOVED = 0.005
"""Metres by which odometry may differ."""
BODIES: list[dict[str, Any]] = [
    {"order": "arm"},
    {"order": "stop"},
    {"speed": 0.2, "front": 0.1, "rear": 0.0},
    {"goal": {"x": 1.0, "y": 1.0, "yaw": 0.0}},
    {"order": "start", "behaviour": "move"},
    {"values": {"gate.speed": 9.0}, "save": True},
    {"name": "run-000001-000.mcap", "offset": 0},
    {"name": "../../etc/passwd", "offset": 0},
    {"mission": {"steps": [{"goto": [1, 1, 0]}]}},
]


def payload(rng: np.random.Generator) -> bytes:
    """Return one message: noise, or a nearly valid request."""
    if rng.random() < 0.2:
        return rng.bytes(int(rng.integers(0, 300)))
    now = time.monotonic_ns()
    head = {"stamp": now, "received": now, "gate_stamp": now, "seq": int(rng.integers(0, 2**62)), "role": "station"}
    body: dict[str, Any] = {**head, "lease": 0.5, "nonce": "guessed", **BODIES[rng.integers(len(BODIES))]}
    if rng.random() < 0.4:
        name = list(body)[rng.integers(len(body))]
        body[name] = [None, -1, 1e308, "x" * 2000, [], {}, [[[[[]]]]] * 50, True, "NaN", 2**70][rng.integers(10)]
    data = bytearray(json.dumps(body).encode())
    for _ in range(int(rng.integers(0, 4))):
        place = int(rng.integers(len(data)))
        match int(rng.integers(4)):
            case 0:
                data[place] ^= 1 << int(rng.integers(8))
            case 1:
                del data[place:]
            case 2:
                data += data[place:]
            case _:
                data[place:place] = rng.bytes(3)
        if not data:
            break
    return bytes(data)


def fuzz(endpoint: str, names: list[str], count: int, seed: int, rate: float) -> None:
    """Send messages; print their number. A ``tls/`` endpoint is used with this user's certificate and name."""
    rng = np.random.default_rng(seed)
    tls = tls_for(endpoint)
    owner = "fuzz{}" if tls is None else tls.owner()
    inward = [topic.key for topic in TOPICS if topic.writer is Writer.OUTSIDE] + [topics.estop_key]
    with zenoh.open(zenoh.Config.from_json5(json.dumps(session_config(endpoint, 5.0, tls)))) as session:
        began = time.monotonic()
        for number in range(count):
            source = f"{owner.format(rng.integers(1000))}:{rng.integers(10)}"
            data = payload(rng)
            if number % 2:
                session.put(inward[number // 2 % len(inward)]("truck", source), data)
            else:
                name = names[number // 2 % len(names)]
                session.get(topics.rpc_key("truck", name, source), lambda _: None, payload=data, timeout=1.0)
            time.sleep(max(0.0, began + number / rate - time.monotonic()))
        time.sleep(1.5)
    print(json.dumps({"sent": count, "seconds": round(time.monotonic() - began, 1)}), flush=True)


async def call_names(client: TruckClient) -> list[str]:
    """Return all calls served by the robot: it lists them in the answer to an unknown call."""
    try:
        await client.call("no-such-call")
    except TruckError as error:
        return [name.strip() for name in str(error).partition("there are ")[2].split(",")]
    raise AssertionError("it answered")


async def attack(clock: Clock, folder: Path, count: int, seed: int, rate: float) -> dict[str, Any]:
    """Run once."""
    endpoint = free_endpoint()
    config = write_overlay(ROOT / "configs" / "demo.yaml", folder, endpoint)
    async with (
        process(0, folder / "simulate.txt", "-m", "monstertruckd", "simulate", "--config", str(config)),
        process(1, folder / "daemon.txt", "-m", "monstertruckd", "run", "--config", str(config)) as daemon,
        await connect(clock, "truck", endpoint) as client,
    ):
        names = await call_names(client)
        await order(client, Order.ARM)
        await order(client, Order.DISARM)
        odometry = client.subscribe(topics.ODOMETRY, latest())
        gate = client.subscribe(topics.GATE, latest())
        health = client.subscribe(topics.HEALTH, latest())
        before = await odometry.next()
        words = (
            "-m",
            "benchmarks.fuzz_requests",
            "--fuzzer",
            endpoint,
            ",".join(names),
            str(count),
            str(seed),
            str(rate),
        )
        modes: set[str] = set()
        async with process(0, folder / "fuzz.txt", *words) as fuzzer:
            assert fuzzer.stdout is not None
            reading = asyncio.create_task(fuzzer.stdout.read())
            while not reading.done():
                if gate.latest is not None:
                    modes.add(gate.latest.mode.value)
                await asyncio.sleep(0.05)
            sent = json.loads(reading.result().splitlines()[-1])
        after = await odometry.next()
        failed = [s.name for s in health.latest.services if s.state is ServiceState.FAILED] if health.latest else ["?"]
        if gate.latest is not None and gate.latest.mode is GateMode.ESTOPPED:
            await order(client, Order.RESET)
        await order(client, Order.ARM)
        obeyed = await client.get_retained(topics.GATE)
        await order(client, Order.DISARM)
        return {
            **sent,
            "calls": len(names),
            "moved_m": round(float(np.hypot(after.pose.x - before.pose.x, after.pose.y - before.pose.y)), 4),
            "modes": sorted(modes),
            "failed_services": failed,
            "daemon_lives": daemon.returncode is None,
            "obeys_afterwards": obeyed is not None and obeyed.mode is GateMode.ARMED,
        }


def of_gates(ticks: int, seed: int) -> int:
    """Fuzz the gates of all bodies; 0: all goals are met."""
    from benchmarks.fuzz_parts import gate  # noqa: PLC0415 - needs the tests
    from tests.unit.gate.rig import BODIES  # noqa: PLC0415

    done, found = gate.fuzz(seed, ticks)
    for finding in found:
        print(f"{finding.kind}: {finding.error}")
        for what, values in finding.actions:
            print(f"    {what} {' '.join(f'{name}={value}' for name, value in values.items())}")
    figures = {"ticks": done, "bodies": len(BODIES), "findings": len(found)}
    goals = {"ticks": 100_000, "findings": 0}
    met = done >= goals["ticks"] and not found
    print(json.dumps({"bench": "fuzz_gate", "figures": figures, "goals": goals, "met": met}))
    return 0 if met else 1


def main() -> int:
    """Fuzz; 0: all goals are met."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gate", action="store_true", help="the gates of all bodies, without a daemon")
    parser.add_argument("--count", type=int, default=100_000, help="messages, or ticks of gates")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--rate", type=float, default=2000.0, help="messages a second")
    parser.add_argument("--fuzzer", nargs=5, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.fuzzer:
        endpoint, names, count, seed, rate = options.fuzzer
        fuzz(endpoint, names.split(","), int(count), int(seed), float(rate))
        return 0
    if options.gate:
        return of_gates(options.count, options.seed)
    with TemporaryDirectory(prefix="fuzz-") as folder:
        figures = run_wall(lambda clock: attack(clock, Path(folder), options.count, options.seed, options.rate))
    for name, value in figures.items():
        print(f"{name:20} {value}")
    goals: dict[str, Any] = {
        "moved_m": MOVED,
        "modes": ["disarmed", "estopped"],
        "failed_services": [],
        "sent": 100_000,
    }
    met = (
        figures["moved_m"] <= MOVED
        and set(figures["modes"]) <= {"disarmed", "estopped"}
        and not figures["failed_services"]
    )
    met = met and figures["sent"] >= goals["sent"] and figures["daemon_lives"] and figures["obeys_afterwards"]
    print(json.dumps({"bench": "fuzz_requests", "figures": figures, "goals": goals, "met": met}))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
