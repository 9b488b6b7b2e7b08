"""The doctor against faults drawn by seed from a catalogue: which are found, with what mends, and what is said falsely.

    python benchmarks/doctor.py [--seeds 100]

First every fault of ``tests/unit/tools/doctor/catalogue.py`` alone, then ``--seeds`` computers with up to six of them
at once, then a healthy one. The computers are folders with emulated USB trees, networks and logs.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from tests.unit.tools.doctor.catalogue import FAULTS, Fault, drawn, examined, log, mistakes, weaving

OUTPUT = Path(__file__).resolve().parents[1] / "runs" / "benchmarks" / "doctor.json"
GOALS = {"catalogue": 40, "not_found": 0, "without_mend": 0, "false": 0}


def wrong_with(faults: Sequence[Fault], *, drove: bool = False) -> list[str]:
    """Mistakes on one computer."""
    with TemporaryDirectory(prefix="monstertruck-") as folder:
        before = log(*weaving()) if drove else lambda _: None
        return mistakes(examined(Path(folder), faults, before), faults)


def main() -> int:
    """Examine; 0 = all goals are met."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=100)
    arguments = parser.parse_args()
    wrong, met_faults = [], 0
    cases = [[fault] for fault in FAULTS]
    cases += [drawn(np.random.default_rng([seed, 26]), 6) for seed in range(arguments.seeds)]
    for faults in cases:
        met_faults += len(faults)
        found = wrong_with(faults)
        for text in found:
            print(f"{', '.join(fault.name for fault in faults)}: {text}", flush=True)
        wrong += found
    healthy = wrong_with([]) + wrong_with([], drove=True)
    for text in healthy:
        print(f"healthy: {text}", flush=True)
    wrong += healthy
    figures = {
        "catalogue": len(FAULTS),
        "computers": len(cases) + 2,
        "faults": met_faults,
        "not_found": sum(text.endswith(": not found") for text in wrong),
        "without_mend": sum(": no mend in " in text for text in wrong),
        "false": sum(text.startswith("false: ") for text in wrong),
    }
    met = figures["catalogue"] >= GOALS["catalogue"] and not wrong
    OUTPUT.parent.mkdir(parents=True, exist_ok=True)
    OUTPUT.write_text(json.dumps(figures, indent=1), encoding="utf-8")
    print(json.dumps({"bench": "doctor", "figures": figures, "goals": GOALS, "met": met}))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
