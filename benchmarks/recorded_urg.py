"""A real URG-04LX recording through emulator, pty, driver, daemon and Zenoh, in real time, to another process.

    python benchmarks/recorded_urg.py

The emulated scanner sends the 641 recorded scans as SCIP 2.0 at their recorded times (63 s); a separate process
subscribes to ``sensor/scan`` with raw zenoh. Every scan must arrive, in order, with exact values and a stamp within
5 ms of the time at which its first beam was measured.
"""

import argparse
import asyncio
import json
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from benchmarks import ROOT
from monstertruck_drivers.hokuyo_urg.recording import STEPS, RecordedRanges
from monstertruck_runtime.clock import WallClock, run_wall
from monstertruck_schemas.sensor import VALID_BEAM
from monstertruckd.tools.demo.runs import connect, free_endpoint, write_overlay

CONFIG = ROOT / "configs" / "recorded-urg.yaml"
STEP_NS = 1e8 / 1024
GOALS = {"lost": 0, "wrong_values": 0, "out_of_order": 0, "worst_stamp_ms": 5.0}

SUBSCRIBER = """
import sys, numpy, zenoh
from monstertruck_runtime import wire
from monstertruck_schemas.topics import SCAN
endpoint, count, target = sys.argv[1], int(sys.argv[2]), sys.argv[3]
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", f'["{endpoint}"]')
config.insert_json5("scouting/multicast/enabled", "false")
with zenoh.open(config) as session:
    samples = session.declare_subscriber(SCAN.key("truck"))
    print("subscribed", flush=True)
    scans = [wire.decode(SCAN, samples.recv().payload.to_bytes()) for _ in range(count)]
numpy.savez(target, stamps=[s.stamp for s in scans], seqs=[s.seq for s in scans],
            ranges=[s.ranges for s in scans], codes=[s.codes for s in scans])
"""


@dataclass(frozen=True)
class Result:
    """Messages received by the other process."""

    sent: int
    received: int
    lost: int
    wrong_values: int
    out_of_order: int
    worst_stamp_ms: float
    median_stamp_ms: float


async def play(clock: WallClock, folder: Path, config: Path, recording: RecordedRanges) -> Result:
    """Run daemon, subscriber and emulator; compare the received scans with ``recording``."""
    endpoint = free_endpoint()
    overlay = write_overlay(config, folder, endpoint)
    pipe = asyncio.subprocess.PIPE
    target = folder / "scans.npz"
    running: list[asyncio.subprocess.Process] = []

    async def start(*arguments: str) -> asyncio.subprocess.Process:
        process = await asyncio.create_subprocess_exec(sys.executable, *arguments, stdin=pipe, stdout=pipe)
        running.append(process)
        return process

    try:
        await start("-m", "monstertruckd", "run", "--config", str(overlay))
        await connect(clock, "truck", endpoint)
        subscriber = await start("-c", SUBSCRIBER, endpoint, str(len(recording)), str(target))
        await _said(subscriber, "subscribed")
        simulator = await start("-m", "monstertruckd", "simulate", "--config", str(overlay))
        began = int((await _said(simulator, "recording sent")).split()[-1])
        async with asyncio.timeout(10):
            await subscriber.wait()
    finally:
        for process in running:
            if process.returncode is None:
                process.terminate()
            await process.communicate()
    with np.load(target) as got:
        return compare(recording, began, got["stamps"], got["seqs"], got["ranges"], got["codes"])


async def _said(process: asyncio.subprocess.Process, words: str) -> str:
    assert process.stdout is not None
    while line := (await process.stdout.readline()).decode():
        if words in line:
            return line.strip()
    raise RuntimeError(f"process ended before it said {words!r}")


def compare(
    recording: RecordedRanges, began: int, stamps: np.ndarray, seqs: np.ndarray, ranges: np.ndarray, codes: np.ndarray
) -> Result:
    """Compare exactly; readings below 20 mm are error codes and must arrive as such."""
    raw = recording.ranges[: len(ranges)]
    valid = raw >= 20
    good = np.where(valid, ranges == raw / 1000.0, np.isinf(ranges)) & (codes == np.where(valid, VALID_BEAM, raw))
    true = began + recording.times[: len(stamps)] + STEPS.start * STEP_NS
    error = np.abs(stamps - true) / 1e6
    return Result(
        sent=len(recording),
        received=len(ranges),
        lost=len(recording) - len(ranges),
        wrong_values=int((~good).sum()),
        out_of_order=int((np.diff(seqs) != 1).sum() + (np.diff(stamps) <= 0).sum()),
        worst_stamp_ms=float(error.max()),
        median_stamp_ms=float(np.median(error)),
    )


def main() -> None:
    """Run the whole recording and print the result."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=ROOT / "tests" / "data" / "urg04lx_exp2.dat.gz")
    recording = RecordedRanges.load(parser.parse_args().data)
    with tempfile.TemporaryDirectory() as folder:
        result = run_wall(lambda clock: play(clock, Path(folder), CONFIG, recording))
    figures = asdict(result)
    for name, value in figures.items():
        print(f"{name:18} {value}")
    met = all(figures[name] <= goal for name, goal in GOALS.items())
    print(json.dumps({"bench": "recorded_urg", "figures": figures, "goals": GOALS, "met": met}))


if __name__ == "__main__":
    main()
