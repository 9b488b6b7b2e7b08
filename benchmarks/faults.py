"""Every scripted fault on the whole daemon, on the virtual clock: times to detection and standstill, and distance.

    python benchmarks/faults.py

Each fault is caused at several instants, so that it meets ticks and exchanges at different phases. The table shows the
run with the longest distance; the figures are the worst of all runs.
"""

import argparse
import json
import logging
import os
import sys
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import cache
from itertools import product

from rich import box
from rich.console import Console
from rich.table import Table

from benchmarks import ROOT
from benchmarks.fault_parts.scenario import COLUMNS, GOALS, Expect, Reaction, Scenario, cells, measure, shortcomings
from benchmarks.fault_parts.scenarios import SCENARIOS
from monstertruck_runtime.clock import run_virtual
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig

OUTPUT = ROOT / "runs" / "benchmarks" / "faults.json"
PHASES = (3.0, 3.0417, 3.0834)
"""Seconds driven before the fault."""


@dataclass(frozen=True)
class Run:
    """One scenario at one phase."""

    number: int
    reaction: Reaction
    shortcomings: list[str]

    @property
    def scenario(self) -> Scenario:
        """Executed scenario."""
        return SCENARIOS[self.number]


@cache
def demo() -> SimulatedTruckConfig:
    """Return the truck of the demo."""
    return load_config(ROOT / "configs" / "demo.yaml", SimulatedTruckConfig)[0]


def run(job: tuple[int, float]) -> Run:
    """Run one scenario."""
    number, driven = job
    logging.disable(logging.CRITICAL)
    reaction = run_virtual(lambda clock: measure(SCENARIOS[number], demo(), clock, driven))
    return Run(number, reaction, shortcomings(SCENARIOS[number], reaction))


def figures(runs: Iterable[Run]) -> dict[str, float]:
    """Return the worst value of every kind, by the names of ``GOALS``; seconds."""
    worst = dict.fromkeys(GOALS, 0.0)

    def take(name: str, seconds: float | None) -> None:
        worst[name] = round(max(worst[name], seconds or 0.0), 4)

    for one in runs:
        expect, got = one.scenario.expect, one.reaction
        if expect in (Expect.STOP, Expect.EXIT) and got.stop_bytes_after_s is not None:
            noticed = got.detected_after_s or 0.0
            take("stop_after_detection_s", got.stop_bytes_after_s - noticed)
            take("stop_after_sample_s", got.stop_bytes_after_sample_s)
            take("standstill_after_stop_s", (got.standstill_after_s or 99.0) - max(got.stop_bytes_after_s, noticed))
        if expect is Expect.STOP_AGAIN:
            take("standstill_after_return_s", (got.standstill_after_s or 99.0) - got.ended_after_s)
        if expect is Expect.STOP_BY_LINE:
            take("standstill_by_line_s", got.standstill_after_s)
        if one.scenario.name.endswith("unplugged"):
            take("back_after_replug_s", got.recovered_after_s)
    return worst


def furthest(runs: Iterable[Run]) -> list[Run]:
    """Return the run with the longest distance of every scenario."""
    worst: dict[int, Run] = {}
    for one in runs:
        if one.number not in worst or one.reaction.metres > worst[one.number].reaction.metres:
            worst[one.number] = one
    return [worst[number] for number in sorted(worst)]


def main() -> int:
    """Run all scenarios; 0: all goals are met."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--markdown", action="store_true", help="print the table for the documentation")
    markdown = parser.parse_args().markdown
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        runs = list(pool.map(run, product(range(len(SCENARIOS)), PHASES)))
    table = Table(*COLUMNS, box=box.MARKDOWN if markdown else box.SIMPLE)
    for one in furthest(runs):
        table.add_row(*cells(one.scenario, one.reaction))
    Console(width=180).print(table)
    for one in runs:
        for text in one.shortcomings:
            print(f"{one.scenario.name}: {text}")
    found = figures(runs)
    met = not any(one.shortcomings for one in runs) and all(found[name] <= goal for name, goal in GOALS.items())
    result = {"bench": "faults", "figures": found, "goals": GOALS, "met": met}
    OUTPUT.parent.mkdir(parents=True, exist_ok=True)
    OUTPUT.write_text(json.dumps({**result, "runs": [asdict(one) for one in runs]}, indent=1), encoding="utf-8")
    print(json.dumps(result))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
