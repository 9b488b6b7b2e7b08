"""Cost of the black box: memory of a full minute, processor time per message, and delay of the loop while it writes.

The traffic is that of the whole emulated truck (virtual clock, camera 640x480 at 15 Hz), replayed until the ring is
full. Memory includes the ring's pages and the growth of the heap. The delay by writing is measured in two ways: by the
processor time between two pauses of the writer, which bounds the loop's wait for the interpreter independently of the
load, and beside an event loop that wakes every millisecond, in rounds with and without writing. The last line is JSON.

    python benchmarks/black_box.py [ROUNDS]
"""

import asyncio
import json
import sys
import threading
import tracemalloc
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter, thread_time
from typing import Any

import numpy as np

from benchmarks import ROOT
from monstertruck_runtime import wire
from monstertruck_runtime.clock import SECOND, VirtualClock, WallClock, run_virtual
from monstertruck_schemas.topics import BY_NAME, TOPICS
from monstertruckd.config.load import load_config
from monstertruckd.recorder.black_box import BlackBox
from monstertruckd.recorder.config import BlackBoxConfig
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

FULL = ROOT / "configs" / "full.yaml"
SAMPLE = 4.0
GOALS = {"memory_mb": 25.2, "record_us": 15.0, "burst_p99_ms": 2.0, "loop_wait_p99_ms": 2.0}

Traffic = list[tuple[int, str, bytes]]


def traffic() -> Traffic:
    """Record some seconds of the whole truck: (ns since the start, topic, payload)."""
    config = with_overlay(load_config(FULL, SimulatedTruckConfig)[0], {"recorder": None, "map": None})
    kept: Traffic = []

    async def main(clock: VirtualClock) -> None:
        rig = VirtualRig(config, clock)
        async with rig.running():
            await clock.sleep(6.0)
            begin = clock.now()
            rig.bus.tap(lambda topic, _, data, at: kept.append((at - begin, topic.name, data)), TOPICS)
            await clock.sleep(SAMPLE)

    run_virtual(main)
    return kept


class Played:
    """Clock whose time is the instant of the message being replayed."""

    now_ns = 0

    def now(self) -> int:
        """Instant of the message."""
        return self.now_ns

    def real_offset(self) -> int:
        """None."""
        return 0


class Pauses(threading.Event):
    """Pauses of the writer, and the processor time between them."""

    def __init__(self) -> None:
        super().__init__()
        self.bursts: list[float] = []
        self._since: float | None = None

    def wait(self, timeout: float | None = None) -> bool:
        """Note a pause."""
        if self._since is not None:
            self.bursts.append(thread_time() - self._since)
        done = super().wait(timeout)
        self._since = thread_time()
        return done


TURNS = round(BlackBoxConfig().before / SAMPLE) + 3


def fill(box: BlackBox, clock: Played, messages: Traffic, first: int) -> tuple[int, float]:
    """Replay messages until the ring is full; return their number and the thread's processor time (s)."""
    count, spent = 0, 0.0
    for turn in range(first, first + TURNS):
        batch = [(at, BY_NAME[name], bytes(bytearray(data))) for at, name, data in messages]
        begin = thread_time()
        for at, topic, data in batch:
            clock.now_ns = at + round(turn * SAMPLE * SECOND)
            box.record(topic, clock.now_ns, data)
        spent += thread_time() - begin
        count += len(batch)
    return count, spent


async def waits(during: "asyncio.Future[Any] | None", seconds: float) -> float:
    """Return the 99th percentile of the lateness of a millisecond timer, ms."""
    late = []
    end = perf_counter() + seconds
    while not during.done() if during is not None else perf_counter() < end:
        due = perf_counter() + 0.001
        await asyncio.sleep(0.001)
        late.append(perf_counter() - due)
    return float(np.percentile(late, 99)) * 1e3


def main(rounds: int) -> None:
    messages = traffic()
    for topic in TOPICS:
        wire.schema(topic)  # as the daemon does before it starts
    rate = len(messages) / SAMPLE
    clock = Played()
    with TemporaryDirectory() as folder:

        async def measure() -> dict[str, float]:
            box = BlackBox(
                BlackBoxConfig(),
                Path(folder),
                WallClock(),
                lambda *_, **__: None,
                attachments={},
                metadata={},
            )
            box._clock = clock  # type: ignore[assignment]  # noqa: SLF001
            tracemalloc.start()
            before, _ = tracemalloc.get_traced_memory()
            count, _ = fill(box, clock, messages, 0)
            heap = tracemalloc.get_traced_memory()[0] - before
            tracemalloc.stop()
            _, spent = fill(box, clock, messages, TURNS)
            entries = box.ring.snapshot()
            quiet, busy, took, bursts = [], [], [], []
            for number in range(rounds):
                quiet.append(await waits(None, 1.5))
                begin = perf_counter()
                box._hurry = pauses = Pauses()  # noqa: SLF001
                name = f"blackbox-{number:06d}-scan_stale.mcap"
                writing = asyncio.ensure_future(asyncio.to_thread(box._write, name, entries, {}, 0))  # noqa: SLF001
                busy.append(await waits(writing, 0.0))
                await writing
                took.append(perf_counter() - begin)
                bursts += pauses.bursts
            sizes = [path.stat().st_size for path in Path(folder).iterdir()]
            return {
                "messages_per_s": rate,
                "kept_messages": float(len(entries)),
                "memory_mb": (heap + box.ring.size) / 1e6,
                "heap_mb": heap / 1e6,
                "record_us": spent / count * 1e6,
                "file_mb": max(sizes) / 1e6,
                "write_s": float(np.median(took)),
                "burst_p99_ms": float(np.percentile(bursts, 99)) * 1e3,
                "burst_max_ms": max(bursts) * 1e3,
                "quiet_p99_ms": float(np.median(quiet)),
                "busy_p99_ms": float(np.median(busy)),
                "loop_wait_p99_ms": float(np.median(busy) - np.median(quiet)),
            }

        figures = asyncio.run(measure())
    for name, value in figures.items():
        print(f"{name:20} {value:10.2f}")
    met = all(figures[name] <= goal for name, goal in GOALS.items())
    rounded = {name: round(value, 3) for name, value in figures.items()}
    print(json.dumps({"bench": "black_box", "figures": rounded, "goals": GOALS, "met": met}))


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 5)
