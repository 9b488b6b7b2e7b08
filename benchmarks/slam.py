"""SLAM on recorded logs, one configuration for all: accuracy against wheels and kiss-icp, URG-04LX maps, costs.

    python benchmarks/slam.py --data DIR [--only LOG|PART ...] [--logs LOG ...] [--quick]

DIR holds the files of the manifest in slam_parts/logs.py; their sha256 is checked first. Logs: intel1 (the first
1088 s), intel4 (those cut to 4 m), intel (joined), aces, csail; parts: thinned (whole logs, and every 2nd to 20th scan
of them), crowds (people who walk in drawn logs; with --quick one seed of each map), mounts (lidars that are
turned, mirrored or late in drawn logs; the same), exp2 (whole daemon), localise
(starts by seed in maps of a part of Intel; with --quick 20, not 100), map_edge (robots that leave such maps of Intel
and CSAIL), kidnap (cuts drawn by seed; with --quick 4 in the first 2500 scans of Intel), wrong_odometry (five faults;
with --quick of those scans), costs, world (odometry by every subset of sensors in the emulators' world; with --quick
two drives of each kind, not ten), endurance (memory over two hours); the last two need no data. --logs are those of
kidnap and wrong_odometry: intel1, csail, intel, or MAP-SEED (hospital-1, depot-1, robocup-1), a drive with exact truth
that is drawn through a map of the folder maps beside DIR; or those of thinned: aces, csail, exp2, intel. The
trajectories judged are those after the joint registration at a log's end; ``online`` figures are before it. Two
processes at most; times are processor time. Plots go to runs/slam. The last line is JSON.
"""

import argparse
import importlib
import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks import ROOT

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from benchmarks.slam_parts import accuracy, faults
from benchmarks.slam_parts.logs import verified

WITHOUT_DATA = {"world", "endurance"}
OUT = ROOT / "runs" / "slam"


def _part(name: str) -> Any:
    return importlib.import_module(f"slam_parts.{name}")


Result = tuple[dict[str, float], dict[str, float], bool]
"""Figures, goals, and whether they are met."""
RUNS: dict[str, Callable[[argparse.Namespace], Result]] = {
    "thinned": lambda asked: _part("thinned").run(asked.data, asked.logs or _part("thinned").LOGS),
    "crowds": lambda asked: _part("crowds").run(asked.data, quick=asked.quick),
    "mounts": lambda asked: _part("mounts").run(asked.data, quick=asked.quick),
    "exp2": lambda _: _part("exp2").run(OUT / "exp2.png"),
    "localise": lambda asked: _part("localisation").run(asked.data, quick=asked.quick),
    "map_edge": lambda asked: _part("map_edge").run(asked.data, quick=asked.quick),
    "kidnap": lambda asked: faults.kidnap(asked.data, quick=asked.quick, logs=asked.logs or faults.LOGS),
    "wrong_odometry": lambda asked: faults.wrong_odometry(
        asked.data, quick=asked.quick, logs=asked.logs or faults.LOGS
    ),
    "costs": lambda asked: _part("costs").run(asked.data / "urg04lx_exp2.dat.gz"),
    "world": lambda asked: _part("world").run(OUT, quick=asked.quick),
    "endurance": lambda _: _part("endurance").run(),
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="needed for recorded logs")
    parser.add_argument("--only", nargs="+", choices=(*accuracy.LOGS, *RUNS))
    parser.add_argument("--logs", nargs="+", help="of thinned, kidnap and wrong_odometry")
    parser.add_argument("--quick", action="store_true", help=f"only {' and '.join(accuracy.QUICK)}")
    arguments = parser.parse_args()
    OUT.mkdir(parents=True, exist_ok=True)
    chosen = arguments.only or (accuracy.QUICK if arguments.quick else (*accuracy.LOGS, *RUNS))
    if not WITHOUT_DATA.issuperset(chosen):
        if arguments.data is None:
            parser.error(f"--data DIR is needed for all parts but {', '.join(sorted(WITHOUT_DATA))}")
        verified(arguments.data)
    parts = []
    logs = tuple(name for name in accuracy.LOGS if name in chosen)
    if logs:
        parts.append(accuracy.run(arguments.data, OUT, logs))
    parts += [part(arguments) for name, part in RUNS.items() if name in chosen]
    figures = {key: value for part in parts for key, value in part[0].items()}
    goals = {key: value for part in parts for key, value in part[1].items()}
    met = all(part[2] for part in parts)
    result = {"bench": "slam", "figures": figures, "goals": goals, "met": met}
    (OUT / "slam.json").write_text(json.dumps(result, indent=1))
    print(json.dumps(result))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
