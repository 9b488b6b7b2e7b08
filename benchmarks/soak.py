"""An hour of driving and replugging on the virtual clock: memory and file descriptors stay flat.

    python benchmarks/soak.py [--minutes 60] [--seed 1]

The whole daemon and its emulated devices share one process; the first ten minutes warm it up.
"""

import argparse
import asyncio
import gc
import json
import logging
import os
import sys
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter

import numpy as np

from benchmarks import ROOT
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import TruckError
from monstertruck_sim.faults import hubs_of
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

WARM = 1 / 6
"""Share of the run that does not count."""
GROWTH = 2.0
"""MB by which memory may grow after that, not counted what is meant to be kept: the simulator's own record of the
truth (3.5 MB an hour), and what the black box holds, by its own account: more in lively minutes than in quiet ones."""

LOGS = {"rotate_seconds": 120, "quota_bytes": 50_000_000}
"""The index of a log is kept until the next file begins, some 0.3 MB a minute; so here they begin soon."""

Sample = tuple[float, float, int]


def now_used(minute: float, known: int) -> Sample:
    """Return the minute, resident memory in MB minus ``known`` bytes, and open file descriptors."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return minute, (pages * os.sysconf("SC_PAGE_SIZE") - known) / 1e6, sum(1 for _ in Path("/proc/self/fd").iterdir())


async def soak(clock: VirtualClock, config: SimulatedTruckConfig, minutes: int, seed: int) -> tuple[list[Sample], int]:
    """Return samples, one a minute, and the number of replugged devices."""
    rng = np.random.default_rng(seed)
    rig = VirtualRig(config, clock)
    samples: list[Sample] = []
    replugs = 0
    assert rig.daemon.black_box is not None
    ring = rig.daemon.black_box.ring
    async with rig.running():
        operator = LocalOperator(rig.daemon, clock)
        began = clock.now()
        arming = asyncio.create_task(_arm_for_ever(operator, clock))
        try:
            for minute in range(minutes):
                while clock.now() - began < (minute + 1) * 60 * SECOND:
                    await _replug(rig, rng)
                    replugs += 1
                    await clock.sleep(float(rng.uniform(2.0, 6.0)))
                samples.append(now_used(minute + 1, rig.truth.array().nbytes + ring.size))
                print(f"minute {minute + 1}: {samples[-1][1]:.1f} MB, {samples[-1][2]} descriptors", file=sys.stderr)
        finally:
            arming.cancel()
            await asyncio.wait([arming])
    return samples, replugs


async def _arm_for_ever(operator: LocalOperator, clock: VirtualClock) -> None:
    while True:
        with suppress(TruckError):
            await operator.arm()
        await clock.sleep(1.0)


async def _replug(rig: VirtualRig, rng: np.random.Generator) -> None:
    hubs = hubs_of(rig.config.devices)
    pause = float(rng.uniform(0.05, 1.5))
    if hubs and rng.random() < 0.2:
        hub = hubs[rng.integers(len(hubs))]
        rig.computer.usb.lose_hub(hub)
        await rig.clock.sleep(pause)
        await rig.computer.usb.return_hub(hub, rig.clock)
        return
    roles = tuple(rig.computer.ports)
    port = rig.computer.ports[roles[rng.integers(len(roles))]]
    port.unplug()
    await rig.clock.sleep(pause)
    port.plug()


def main() -> int:
    """Soak; 0: flat."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    logging.disable(logging.CRITICAL)
    config = load_config(ROOT / "configs" / "full.yaml", SimulatedTruckConfig)[0]
    began = perf_counter()
    with TemporaryDirectory() as folder:
        truck = with_overlay(config, {"map": None, "recorder": {"directory": folder, **LOGS}})
        samples, replugs = run_virtual(lambda clock: soak(clock, truck, arguments.minutes, arguments.seed))
    warm = [sample for sample in samples if sample[0] > WARM * arguments.minutes]
    third = max(1, len(warm) // 3)
    growth = float(np.median([s[1] for s in warm[-third:]]) - np.median([s[1] for s in warm[:third]]))
    descriptors = sorted({sample[2] for sample in warm})
    met = growth <= GROWTH and descriptors[-1] - descriptors[0] <= 1  # a log rotates
    result = {
        "bench": "soak",
        "figures": {
            "minutes": arguments.minutes,
            "replugs": replugs,
            "rss_mb": round(samples[-1][1], 1),
            "rss_growth_mb": round(growth, 2),
            "descriptors": descriptors,
            "real_s": round(perf_counter() - began, 1),
        },
        "goals": {"rss_growth_mb": GROWTH, "descriptors_apart": 1},
        "met": met,
    }
    print(json.dumps(result))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
