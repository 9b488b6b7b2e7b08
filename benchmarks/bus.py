"""Cost of typed messages compared with plain bytes: a scan of 682 beams to another process and back.

    python benchmarks/bus.py [--rounds N]

Pairs of processes run side by side and take turns, so that other load affects all of them equally. Every round restarts
them, because the placement of a process by the system matters as much as its work. The pairs are:

- ``typed``: the product, message object in, message object awaited in asyncio;
- ``raw``: the same bytes, untyped, over Zenoh and asyncio; ``direct``: received in the thread that reads the network,
  as in the product;
- ``quick_typed``, ``quick_raw``: the same with Zenoh's threads configured for low latency, see ``docs/zenoh.md``;
- ``rospy``: ``sensor_msgs/LaserScan`` with ``tcp_nodelay``, where Debian's ROS 1 is installed (``apt install
  python3-rospy python3-sensor-msgs python3-rosmaster``).

The goals are the ratios of ``typed`` to ``raw``, and of ``quick_typed`` to ``rospy``. A round trip is two messages. The
processor time is that of both processes at 100 round trips a second. The codec is measured separately: in processor
time of many consecutive calls, and, for comparison, once after each pause. The last line is JSON.

rospy uses the system's Python; if it has our version, all ends of the product use it too (``--own-python``: ours), so
that programs are compared, not builds of Python.
"""

import argparse
import itertools
import json
import os
import select
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.bus_peers import scan
from benchmarks.same_python import SYSTEM_PYTHON, can_import, go_on_in_the_systems_python
from monstertruck_runtime import wire
from monstertruck_schemas.topics import SCAN

HERE = Path(__file__).resolve().parent
GOALS = {
    "typed_p50_over_raw": 1.4,
    "typed_cpu_over_raw": 1.5,
    "codec_us": 25.0,
    "quick_typed_p50_over_rospy": 1.3,
    "quick_typed_cpu_over_rospy": 1.3,
}
QUICK = {"ZENOH_RUNTIME": "(app: (handover: rx))"}
PORT = 17447
_ends = itertools.cycle(range(256))
TURNS, BURST, PACED, RATE = 8, 60, 150, 100.0


class Pair:
    """Two running ends, driven through the standard input of one."""

    def __init__(self, ping: subprocess.Popen[bytes], echo: subprocess.Popen[bytes]) -> None:
        self._ping = ping
        self._clocks = [_process_clock(process.pid) for process in (ping, echo)]
        self._ready = False

    def round_trips(self, count: int, rate: float) -> tuple[np.ndarray, float]:
        """Return the times in us, and the processor seconds of both processes per 1000 messages."""
        if not self._ready:
            assert self._answer() == b"ready\n"
            self._ready = True
        before = self._used()
        assert self._ping.stdin is not None
        self._ping.stdin.write(b"%d %f\n" % (count, rate))
        self._ping.stdin.flush()
        times = json.loads(self._answer())
        return np.array(times) / 1e3, (self._used() - before) / (2 * count) * 1000

    def _used(self) -> float:
        return sum(map(time.clock_gettime, self._clocks))

    def _answer(self) -> bytes:
        assert self._ping.stdout is not None
        if not select.select([self._ping.stdout], [], [], 60)[0]:
            raise RuntimeError(f"{self._ping.args!r} does not answer")
        return self._ping.stdout.readline()


def _process_clock(pid: int) -> int:
    """Return the id of another process's processor-time clock, computed as by clock_getcpuclockid(3)."""
    return (~pid << 3) | 2


@contextmanager
def _processes(ping: list[str], echo: list[str], **options: Any) -> Iterator[Pair]:
    pipe = subprocess.PIPE
    echoing = subprocess.Popen(echo, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, **options)
    pinging = subprocess.Popen(ping, stdin=pipe, stdout=pipe, **options)
    try:
        yield Pair(pinging, echoing)
    finally:
        for process in (pinging, echoing):
            process.kill()
            process.wait()


@contextmanager
def zenoh_pair(kind: str) -> Iterator[Pair]:
    """Start the ends of ``bus_peers``, each with an unused address and port."""
    one, other = (f"tcp/127.1.{end}.1:{PORT + end}" for end in (next(_ends), next(_ends)))
    program = [sys.executable, str(HERE / "bus_peers.py"), kind.removeprefix("quick_")]
    arranged = QUICK if kind.startswith("quick_") else {}
    with _processes([*program, "ping", one, other], [*program, "echo", other, one], env=os.environ | arranged) as pair:
        yield pair


@contextmanager
def rospy_pair() -> Iterator[Pair]:
    """Start the ends of ``bus_rospy`` with a separate master."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    environment = {**os.environ, "ROS_MASTER_URI": f"http://127.0.0.1:{port}", "ROS_IP": "127.0.0.1"}
    environment.pop("PYTHONPATH", None)
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    master = subprocess.Popen(["rosmaster", "--core", "-p", str(port)], env=environment, **quiet)
    program = [str(SYSTEM_PYTHON), str(HERE / "bus_rospy.py")]
    try:
        time.sleep(3.0)
        with _processes([*program, "ping"], [*program, "echo"], env=environment) as pair:
            yield pair
    finally:
        master.kill()
        master.wait()


def has_rospy() -> bool:
    """Whether the system's Python finds Debian's ROS 1."""
    return shutil.which("rosmaster") is not None and can_import("rospy", "sensor_msgs.msg")


def codec(repeats: int = 300, burst: int = 100) -> tuple[float, float]:
    """Return the processor time (us) of encoding and of decoding one scan: medians of short, alternating bursts."""
    message = scan(1234, time.monotonic_ns())
    data = wire.encode(SCAN, message)
    jobs: tuple[Callable[[], object], ...] = lambda: wire.encode(SCAN, message), lambda: wire.decode(SCAN, data)
    costs = np.empty((repeats, len(jobs)))
    for row in costs:
        for i, job in enumerate(jobs):
            begin = time.thread_time_ns()
            for _ in range(burst):
                job()
            row[i] = (time.thread_time_ns() - begin) / 1e3 / burst
    encode, decode = np.median(costs, axis=0)
    return float(encode), float(decode)


def from_cold_caches(repeats: int = 200) -> dict[str, float]:
    """Return the medians (us) of creating, encoding and decoding one scan after a millisecond of sleep each."""
    message = scan(1234, time.monotonic_ns())
    data = wire.encode(SCAN, message)
    jobs: dict[str, Callable[[], object]] = {
        "cold_nothing_us": lambda: None,
        "cold_make_us": lambda: scan(1234, message.stamp),
        "cold_encode_us": lambda: wire.encode(SCAN, message),
        "cold_decode_us": lambda: wire.decode(SCAN, data),
    }
    costs = np.empty((repeats, len(jobs)))
    for row in costs:
        for i, job in enumerate(jobs.values()):
            time.sleep(0.001)
            begin = time.perf_counter_ns()
            job()
            row[i] = (time.perf_counter_ns() - begin) / 1e3
    return dict(zip(jobs, np.median(costs, axis=0).tolist(), strict=True))


def compare(rounds: int) -> dict[str, float]:
    """Return medians over the rounds; each ratio is within one round."""
    kinds = ("typed", "raw", "direct", "quick_typed", "quick_raw", *(("rospy",) if has_rospy() else ()))
    p50, p99, cpu = ({kind: np.empty(rounds) for kind in kinds} for _ in range(3))
    for number in range(rounds):
        with ExitStack() as stack:
            pairs = {kind: stack.enter_context(rospy_pair() if kind == "rospy" else zenoh_pair(kind)) for kind in kinds}
            times: dict[str, list[np.ndarray]] = {kind: [] for kind in kinds}
            for turn in range(1 + TURNS):
                for kind, pair in pairs.items():
                    burst, _ = pair.round_trips(BURST, 0)
                    if turn:
                        times[kind].append(burst)
            for kind, pair in pairs.items():
                p50[kind][number], p99[kind][number] = np.percentile(times[kind], (50, 99))
                cpu[kind][number] = pair.round_trips(PACED, RATE)[1]
    figures = {}
    for kind in kinds:
        figures |= {f"{kind}_p50_us": _median(p50[kind]), f"{kind}_p99_us": _median(p99[kind])}
        figures[f"{kind}_cpu_s_per_1000"] = _median(cpu[kind])
    compared = [("typed", "raw"), ("typed", "direct"), ("quick_typed", "quick_raw")]
    if "rospy" in kinds:
        compared += [("typed", "rospy"), ("quick_typed", "rospy")]
    for one, other in compared:
        figures |= {
            f"{one}_p50_over_{other}": _median(p50[one] / p50[other]),
            f"{one}_cpu_over_{other}": _median(cpu[one] / cpu[other]),
        }
    return figures


def _median(values: np.ndarray) -> float:
    return float(np.median(values))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--own-python", action="store_true")
    arguments = parser.parse_args()
    if has_rospy() and not arguments.own_python:
        go_on_in_the_systems_python()
    figures = compare(arguments.rounds)
    figures["encode_us"], figures["decode_us"] = codec()
    figures["codec_us"] = figures["encode_us"] + figures["decode_us"]
    figures |= from_cold_caches()
    for name, value in figures.items():
        print(f"{name:28} {value:9.3f}")
    goals = {name: goal for name, goal in GOALS.items() if name in figures}
    missing = sorted(GOALS.keys() - goals.keys())
    if missing:
        print(f"not measured, because Debian's ROS 1 is not installed: {', '.join(missing)}")
    met = all(figures[name] <= goal for name, goal in goals.items())
    result = {"bench": "bus", "figures": figures, "goals": goals, "not_measured": missing, "met": met}
    print(json.dumps(result))


if __name__ == "__main__":
    main()
