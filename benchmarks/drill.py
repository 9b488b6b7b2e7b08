"""1000 seeded faults on the whole truck, on the virtual clock: no unsafe motion, nothing stuck, back soon.

    python benchmarks/drill.py [--seed 1] [--count 1000] [--jobs N | --cluster ADDRESS] [--resume FILE]

What is unsafe is judged by an observer that sees only bytes on the wires of drive and steering, and the world's truth.
"""

import argparse
import json
import sys
from collections import defaultdict
from pathlib import Path
from time import perf_counter

import numpy as np

from monstertruckd.config.load import load_config
from monstertruckd.tools.drill.random_drill import Drill, DrillReport, FaultOutcome, default_jobs
from monstertruckd.tools.simulation.config import SimulatedTruckConfig

ROOT = Path(__file__).resolve().parents[1]
OUTPUT = ROOT / "runs" / "benchmarks" / "drill.json"
RECOVERY_GOAL = 2.0
"""Seconds within which 99 % of what was lost is back."""


def table(report: DrillReport) -> None:
    """One row for every kind of fault; seconds and metres are the greatest."""
    kinds: dict[str, list[FaultOutcome]] = defaultdict(list)
    for outcome in report.outcomes:
        kinds[outcome.kind.value].append(outcome)
    print("| fault | times | stopped | standstill s, p50 | greatest | metres, greatest | back s, greatest | unsafe |")
    print("|---|---:|---:|---:|---:|---:|---:|---:|")
    for kind, outcomes in sorted(kinds.items()):
        stills = [o.standstill_s for o in outcomes if o.standstill_s is not None]
        middle, most = (f"{np.median(stills):.2f}", f"{max(stills):.2f}") if stills else ("-", "-")
        backs = max((o.recovered_s for o in outcomes if o.recovered_s is not None), default=0.0)
        unsafe = sum(bool(o.violations) for o in outcomes)
        metres = max(o.metres for o in outcomes)
        print(
            f"| {kind} | {len(outcomes)} | {len(stills)} | {middle} | {most} | {metres:.3f} | {backs:.2f} | {unsafe} |"
        )
    for outcome in report.outcomes:
        for violation in outcome.violations:
            print(f"{outcome.fault}: after {violation.seconds:.2f} s {violation.rule}: {violation.text}")
        if outcome.stuck:
            print(f"{outcome.fault}: not back: {', '.join(outcome.stuck)}")


def main() -> int:
    """Drill; 0 = nothing unsafe, nothing stuck, back within the goal."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--jobs", type=int, default=default_jobs())
    parser.add_argument("--cluster", metavar="ADDRESS", help="dask scheduler whose workers run it")
    parser.add_argument(
        "--resume", type=Path, metavar="FILE", help="go on with the outcomes in this file, and add to it"
    )
    arguments = parser.parse_args()
    truck = load_config(ROOT / "configs" / "full.yaml", SimulatedTruckConfig)[0]
    began = perf_counter()
    report = Drill(arguments.seed, arguments.count, truck).run(
        jobs=arguments.jobs, cluster=arguments.cluster, resume=arguments.resume
    )
    table(report)
    figures = report.figures() | {"real_s": round(perf_counter() - began, 1)}
    goals = {"unsafe": 0, "stuck": 0, "recovery_p99_s": RECOVERY_GOAL}
    met = all((figures[name] or 0) <= goal for name, goal in goals.items())
    OUTPUT.parent.mkdir(parents=True, exist_ok=True)
    OUTPUT.write_text(json.dumps(report.as_json(), indent=1), encoding="utf-8")
    print(json.dumps({"bench": "drill", "figures": figures, "goals": goals, "met": met}))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
