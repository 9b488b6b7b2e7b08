"""Wall following in the whole daemon: gate, devices, noise and drop-outs, in the arena of ``wall_following.py``.

- ``laps``: every method from the middle of the arena until its lap is complete, both sides in turn. Errors are counted
  as in ``wall_following.py``; walls at a slant are steps of 1 cm here.
- ``tune``: ``monstertruckd tune wall`` to its end, and a picture of its runs.
- ``faults``: method 3 along the walls while the robot's devices break at random, about one in 10 s (``sim.drill``):
  contacts, and why the behaviour ended. It is armed and started again after every end.

The last line is JSON.

    python benchmarks/wall_daemon.py [--seeds 5] [--jobs 2] [--only laps tune faults] [--model cone] [--figure FILE.png]
"""

import argparse
import json
import sys
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks.wall_following import errors_along
from benchmarks.wall_parts.arena import study
from benchmarks.wall_parts.daemon import DaemonLap, FaultRun, broken, lap, tuned
from monstertruck_schemas.reasons import Reason
from monstertruckd.tools.tune.runs import draw

METHODS: Final = {"1, amended": "wall", "2": "switching", "3": "line"}
SIDES: Final = "left", "right"
FIRST: Final = 6.0
"""K_p with which the recipe begins."""
GOALS: Final = {"contacts": 0, "unfinished": 0, "tuned steady_mm": 6.0}


def laps(model: str, seeds: int, pool: ProcessPoolExecutor) -> Iterator[tuple[str, dict[str, Any]]]:
    """Return the figures of every method."""
    arena = study()
    for method, behaviour in METHODS.items():
        jobs = [(behaviour, SIDES[seed % 2], seed, model) for seed in range(seeds)]
        runs: list[DaemonLap] = list(pool.map(lap, *zip(*jobs, strict=True)))
        done = [run for run in runs if run.outcome is Reason.BEHAVIOUR_DONE]
        errors = [e[~np.isnan(e)] * 1000 for e in (errors_along(arena, run.track) for run in done)]
        counted = np.concatenate(errors) if errors else np.zeros(0)
        yield (
            f"{method}, {model}",
            {
                "runs": len(runs),
                "unfinished": len(runs) - len(done),
                "contacts": sum(run.contact for run in runs),
                "steady_mm": round(float(np.sqrt(np.mean(counted**2))), 2) if len(counted) else None,
                "worst_mm": round(float(np.abs(counted).max()), 1) if len(counted) else None,
                "seconds_max": round(max((run.seconds for run in done), default=0.0), 1),
                "ends": dict(Counter(f"{run.outcome.value}: {run.text}" for run in runs if run not in done)),
            },
        )


def tuning(model: str, seed: int, figure: Path | None) -> dict[str, Any]:
    """Return the result of the recipe."""
    best, runs = tuned(seed, FIRST, model, lambda run: print(f"    {run.text}", flush=True))
    if figure is not None:
        draw(runs, figure)
    found = next((run for run in runs if run.gains == best), None)
    return {
        "runs": len(runs),
        "k_p": None if best is None else round(best.k_p, 2),
        "k_d": None if best is None else round(best.k_d, 2),
        "steady_mm": None if found is None else round(1000 * found.verdict.steady, 1),
        "overshoot": None if found is None else round(found.verdict.overshoot, 2),
    }


def faults(seeds: int, seconds: float, pool: ProcessPoolExecutor) -> dict[str, Any]:
    """Return the figures of robots with device faults."""
    jobs = [(SIDES[seed % 2], seed, seconds) for seed in range(seeds)]
    runs: list[FaultRun] = list(pool.map(broken, *zip(*jobs, strict=True)))
    return {
        "runs": len(runs),
        "contacts": sum(run.contact for run in runs),
        "metres": round(sum(run.metres for run in runs), 1),
        "starts": sum(run.starts for run in runs),
        "ends": dict(sum((run.ends for run in runs), Counter[str]()).most_common()),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--only", choices=("laps", "tune", "faults"), nargs="+", default=("laps", "tune", "faults"))
    parser.add_argument("--model", choices=("beam", "cone"), nargs="+", default=("beam", "cone"))
    parser.add_argument("--seconds", type=float, default=300.0, help="of every run of `faults`")
    parser.add_argument("--figure", type=Path, help="PNG of the tuning's runs")
    args = parser.parse_args()
    figures: dict[str, dict[str, Any]] = {}
    with ProcessPoolExecutor(args.jobs, mp_context=get_context("spawn")) as pool:
        for model in args.model:
            for name, row in laps(model, args.seeds, pool) if "laps" in args.only else ():
                figures[name] = row
                print(name, row, flush=True)
            if "tune" in args.only:
                figures[f"tune, {model}"] = tuning(model, 1, args.figure)
                print(f"tune, {model}", figures[f"tune, {model}"], flush=True)
        if "faults" in args.only:
            figures["faults"] = faults(args.seeds, args.seconds, pool)
            print("faults", figures["faults"], flush=True)
    gains = [row for name, row in figures.items() if name.startswith("tune")]
    met = not any(row.get("contacts", 0) or row.get("unfinished", 0) for row in figures.values())
    met = met and all(row["steady_mm"] is not None and row["steady_mm"] <= GOALS["tuned steady_mm"] for row in gains)
    print(json.dumps({"bench": "wall_daemon", "seeds": args.seeds, "figures": figures, "goals": GOALS, "met": met}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
