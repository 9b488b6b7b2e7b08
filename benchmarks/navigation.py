"""Navigation against its peers: motions, routes, deformation, tracking, complete runs.

    python benchmarks/navigation.py [--data DIR] [--only PART ...] [--runs N] [--quick]

DIR contains ``maps/NAME.yaml`` and ``planning/queries.json``. Times are processor time of the calling thread. Plots are
written to runs/navigation. The last line is JSON.
"""

import argparse
import importlib
import json
import sys
from pathlib import Path

from benchmarks import ROOT
from benchmarks.navigation_parts import Options, Part

FOLDER = Path(__file__).parent / "navigation_parts"
PARTS = sorted(path.stem for path in FOLDER.glob("*.py") if "\ndef run(" in path.read_text())
OUT = ROOT / "runs" / "navigation"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=None)
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--runs", type=int, default=2000, help="of the part harness")
    parser.add_argument("--quick", action="store_true", help="fewer runs, for a look")
    arguments = parser.parse_args()
    OUT.mkdir(parents=True, exist_ok=True)
    options = Options(arguments.data, OUT, arguments.quick, arguments.runs)
    whole = Part()
    for name in arguments.only:
        part = importlib.import_module(f"navigation_parts.{name}").run(options)
        for key, value in part.figures.items():
            whole.figures[f"{name}.{key}"] = value
        for key, value in part.goals.items():
            whole.goals[f"{name}.{key}"] = value
    result = {"bench": "navigation", "figures": whole.figures, "goals": whole.goals, "met": whole.met}
    (OUT / "navigation.json").write_text(json.dumps(result, indent=1))
    print(json.dumps(result))
    return 0 if whole.met else 1


if __name__ == "__main__":
    sys.exit(main())
