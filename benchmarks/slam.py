"""SLAM on recorded logs, one configuration for all: accuracy against wheels and kiss-icp, URG-04LX maps, costs.

    python benchmarks/slam.py --data DIR [--only LOG|PART ...] [--logs LOG ...] [--quick]

DIR holds the files of the manifest in slam_parts/logs.py; their sha256 is checked first. Logs: intel1 (the first
1088 s), intel4 (those cut to 4 m), intel (joined), aces, csail; parts: exp2 (whole daemon), localise (starts by seed
in maps of a part of Intel; with --quick 20, not 100), map_edge (robots that leave such maps of Intel and CSAIL), kidnap
(cuts drawn by seed; with --quick 4 in the first 2500 scans of Intel), wrong_odometry (five faults; with --quick of
those scans), costs, world (odometry by every subset of sensors in the emulators' world; with --quick two drives of
each kind, not ten), endurance (memory over two hours); the last two need no data. --logs are those of kidnap and
wrong_odometry: intel1, csail, intel, or MAP-SEED (hospital-1, depot-1, robocup-1), a drive with exact truth that is
drawn through a map of the folder maps beside DIR. The trajectories judged are those after the joint registration at a
log's end; ``online`` figures are before it. Two processes at most; times are processor time. Plots go to runs/slam.
The last line is JSON.
"""

import argparse
import importlib
import json
import os
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from slam_parts import accuracy, faults
from slam_parts.logs import verified

PARTS = ("exp2", "localise", "map_edge", "kidnap", "wrong_odometry", "costs", "world", "endurance")
WITHOUT_DATA = {"world", "endurance"}
OUT = Path(__file__).resolve().parents[1] / "runs" / "slam"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="needed for recorded logs")
    parser.add_argument("--only", nargs="+", choices=(*accuracy.LOGS, *PARTS))
    parser.add_argument("--logs", nargs="+", default=faults.LOGS, help="of kidnap and wrong_odometry")
    parser.add_argument("--quick", action="store_true", help=f"only {' and '.join(accuracy.QUICK)}")
    arguments = parser.parse_args()
    OUT.mkdir(parents=True, exist_ok=True)
    chosen = arguments.only or (accuracy.QUICK if arguments.quick else (*accuracy.LOGS, *PARTS))
    if not WITHOUT_DATA.issuperset(chosen):
        if arguments.data is None:
            parser.error(f"--data DIR is needed for all parts but {', '.join(sorted(WITHOUT_DATA))}")
        verified(arguments.data)
    parts = []
    logs = tuple(name for name in accuracy.LOGS if name in chosen)
    if logs:
        parts.append(accuracy.run(arguments.data, OUT, logs))
    if "exp2" in chosen:
        parts.append(importlib.import_module("slam_parts.exp2").run(OUT / "exp2.png"))
    if "localise" in chosen:
        parts.append(importlib.import_module("slam_parts.localisation").run(arguments.data, quick=arguments.quick))
    if "map_edge" in chosen:
        parts.append(importlib.import_module("slam_parts.map_edge").run(arguments.data, quick=arguments.quick))
    if "kidnap" in chosen:
        parts.append(faults.kidnap(arguments.data, quick=arguments.quick, logs=arguments.logs))
    if "wrong_odometry" in chosen:
        parts.append(faults.wrong_odometry(arguments.data, quick=arguments.quick, logs=arguments.logs))
    if "costs" in chosen:
        parts.append(importlib.import_module("slam_parts.costs").run(arguments.data / "urg04lx_exp2.dat.gz"))
    if "world" in chosen:
        parts.append(importlib.import_module("slam_parts.world").run(OUT, quick=arguments.quick))
    if "endurance" in chosen:
        parts.append(importlib.import_module("slam_parts.endurance").run())
    figures = {key: value for part in parts for key, value in part[0].items()}
    goals = {key: value for part in parts for key, value in part[1].items()}
    met = all(part[2] for part in parts)
    result = {"bench": "slam", "figures": figures, "goals": goals, "met": met}
    (OUT / "slam.json").write_text(json.dumps(result, indent=1))
    print(json.dumps(result))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
