"""Kills, power cuts and damaged files: acknowledged data survives, saves are never mixed, errors are never tracebacks.

    python -m benchmarks.durability [--kills 1000] [--cuts 200] [--logs 2000] [--files 20000] [--from 0] [PART ...]

Parts: ``kills`` ends the writers of all subjects (``durability_parts/deaths.py``) by SIGKILL at any moment; ``cuts``
replays the traces of their writes to a disk that loses unsynced data, and cuts its power at any point; ``logs`` damages
recordings and repairs them (``damage.py``); ``files`` mutates files of every kind that users supply (``files.py``).
"""

import argparse
import json
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.durability_parts import damage, deaths, files
from benchmarks.durability_parts.subject import Subject

GOALS = {"kills": 1000, "cuts": 200, "logs": 2000, "files": 20_000, "faults": 0}
PARTS = ("kills", "cuts", "logs", "files")


def main() -> int:
    """Run the parts; 0 = all goals are met."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)}; default: all")
    options.add_argument("--kills", type=int, default=GOALS["kills"])
    options.add_argument("--cuts", type=int, default=GOALS["cuts"])
    options.add_argument("--logs", type=int, default=GOALS["logs"])
    options.add_argument("--files", type=int, default=GOALS["files"])
    options.add_argument("--from", dest="first", type=int, default=0, help="number of the first of --files")
    options.add_argument("--seed", type=int, default=1)
    options.add_argument("--subject", action="append", help="kill and cut writers of these subjects only")
    given = options.parse_args()
    parts = given.parts or PARTS
    subjects = [it for it in deaths.SUBJECTS if not given.subject or it.name in given.subject]
    figures: dict[str, Any] = {}
    with tempfile.TemporaryDirectory(prefix="durability") as name:
        if "kills" in parts:
            figures["kills"] = deaths.kills(subjects, given.kills, given.seed, Path(name))
        if "cuts" in parts:
            figures["cuts"] = _cuts(subjects, given.cuts, given.seed, Path(name) / "cuts")
        if "logs" in parts:
            figures["logs"] = {"damaged": damage.run(given.logs, given.seed, Path(name) / "logs")}
        if "files" in parts:
            figures["files"] = files.run_apart(given.files, given.seed, Path(name) / "files", given.first)
    print(json.dumps({"bench": "durability", "figures": figures, "goals": GOALS, "met": _met(figures)}))
    return 0 if _met(figures) else 1


def _cuts(subjects: list[Subject], count: int, seed: int, work: Path) -> dict[str, Any]:
    if shutil.which("cc") is None:
        return {"skipped": "no C compiler (Debian: gcc)"}
    return deaths.cuts(subjects, count, seed, work)


def _met(figures: dict[str, Any]) -> bool:
    """Whether all parts ran as often as the goals require, without a fault."""
    for part in PARTS:
        rows = figures.get(part, {}).values()
        if not all(isinstance(row, dict) for row in rows):
            return False
        if sum(row[part] for row in rows) < GOALS[part] or any(row["faults"] for row in rows):
            return False
    return True


if __name__ == "__main__":
    sys.exit(main())
