"""1000 seeded faults on the whole truck, on the virtual clock: no unsafe motion, no stuck robot, quick recovery.

    python benchmarks/drill.py [--seed 1] [--count 1000] [--fault KIND ...] [--jobs N]
                               [--resume FILE]
    python benchmarks/drill.py --families [--count 10000] [--from N] [--robot NAME] [...]

An observer judges what is unsafe from the bytes on the wires of drive and steering and from the world's truth alone.

``--fault`` draws faults of these kinds only, with their names in the report: "electronics rail lost" affects both hubs.

``--families`` also draws from the families of the devices' own signals: each value falsified, each command ignored,
singles and pairs, in both directions, judged by the world's truth alone. ``--from`` begins at that trial, so that
several computers can share the work: their joined ``--resume`` files equal one of the whole. ``--robot`` is a file of
configs or configs/robots, without its suffix: ``goals`` drives to goals of its planner.
"""

import argparse
import json
import sys
from collections import defaultdict
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from benchmarks import ROOT
from monstertruck_sim.faults import FaultKind
from monstertruckd.config.load import load_config
from monstertruckd.tools.drill.campaign import Campaign, CampaignReport
from monstertruckd.tools.drill.legs import default_jobs
from monstertruckd.tools.drill.random_drill import Drill, DrillReport, FaultOutcome
from monstertruckd.tools.drill.summary import by_family, troubles, without_reason
from monstertruckd.tools.simulation.config import SimulatedTruckConfig

OUTPUT = ROOT / "runs" / "benchmarks"
FAMILY_TRIALS = 10_000
RECOVERY_GOAL = 2.0
"""Seconds within which 99 % of what was lost is back."""


def table(report: DrillReport) -> None:
    """Print one row for every kind of fault; seconds and metres are maxima."""
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


def family_table(report: CampaignReport) -> None:
    """Print one row for every family, with the seconds to the reason."""
    print("| family | trials | with a reason | reason | s, p50 | greatest | unsafe | stuck |")
    print("|---|---:|---:|---|---:|---:|---:|---:|")
    summaries = by_family(report.outcomes)
    for row in summaries:
        middle, most = ("-" if s is None else f"{s:.2f}" for s in (row.reason_p50_s, row.reason_max_s))
        cells = row.family, row.trials, row.noticed, row.reason or "-", middle, most, row.unsafe, row.stuck
        print(f"| {' | '.join(map(str, cells))} |")
    for line in (*without_reason(summaries), *troubles(report.outcomes)):
        print(line)


def drill_families(arguments: argparse.Namespace) -> int:
    """Drill families; 0: all goals are met."""
    name = arguments.robot or "full"
    folder = ROOT / "configs" if (ROOT / "configs" / f"{name}.yaml").exists() else ROOT / "configs" / "robots"
    config = load_config(folder / f"{name}.yaml", SimulatedTruckConfig)[0]
    count = arguments.count or FAMILY_TRIALS
    began = perf_counter()
    report = Campaign(arguments.seed, count, config, first=arguments.first).run(
        jobs=arguments.jobs, resume=arguments.resume
    )
    family_table(report)
    figures = {"robot": name} | report.figures() | {"real_s": round(perf_counter() - began, 1)}
    most = {"unsafe": 0, "contacts": 0, "stuck": 0, "recovery_p99_s": RECOVERY_GOAL}
    least = {"trials": FAMILY_TRIALS, "pairs": 4000, "reverse": 2000} if arguments.robot is None else {"trials": 1000}
    met = all((figures[key] or 0) <= goal for key, goal in most.items())
    met = met and all(figures[key] >= goal for key, goal in least.items())
    write(f"drill_families_{name}", report.as_json())
    print(json.dumps({"bench": "drill_families", "figures": figures, "goals": most | least, "met": met}))
    return 0 if met else 1


def write(name: str, data: dict[str, Any]) -> None:
    """Save all outcomes."""
    OUTPUT.mkdir(parents=True, exist_ok=True)
    (OUTPUT / f"{name}.json").write_text(json.dumps(data, indent=1), encoding="utf-8")


def main() -> int:
    """Drill; 0: no unsafe motion, no stuck robot, recovery within the goal."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, help="1000; 10000 of families")
    parser.add_argument("--fault", nargs="+", default=(), type=FaultKind, metavar="KIND", help="only these kinds")
    parser.add_argument("--families", action="store_true", help="falsify signals of devices and commands to them")
    parser.add_argument("--from", type=int, default=0, dest="first", metavar="N", help="of families: first trial")
    parser.add_argument("--robot", metavar="NAME", help="of families: of configs or configs/robots instead of full")
    parser.add_argument("--jobs", type=int, default=default_jobs())
    parser.add_argument(
        "--resume", type=Path, metavar="FILE", help="go on with the outcomes in this file, and add to it"
    )
    arguments = parser.parse_args()
    if arguments.families:
        return drill_families(arguments)
    truck = load_config(ROOT / "configs" / "full.yaml", SimulatedTruckConfig)[0]
    began = perf_counter()
    report = Drill(arguments.seed, arguments.count or 1000, truck, faults=arguments.fault).run(
        jobs=arguments.jobs, resume=arguments.resume
    )
    table(report)
    figures = report.figures() | {"real_s": round(perf_counter() - began, 1)}
    goals = {"unsafe": 0, "stuck": 0, "recovery_p99_s": RECOVERY_GOAL}
    met = all((figures[name] or 0) <= goal for name, goal in goals.items())
    write("drill", report.as_json())
    print(json.dumps({"bench": "drill", "figures": figures, "goals": goals, "met": met}))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
