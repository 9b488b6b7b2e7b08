"""Run a benchmark and write its figures, tables, commit and machine to ``docs/figures/NAME.json``.

    python benchmarks/record.py NAME --measures PATH [PATH ...] -- benchmarks/deaths.py --trials 20

A benchmark that runs as a module is given as ``-m benchmarks.thesis``. NAME is that of the file. The benchmark's last
line gives figures and goals; Markdown tables in its output become the tables ``1``, ``2`` ..., or keep the names that
tables with the same headings had in the file. Pages that link them show them on the site.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
from pathlib import Path
from typing import Any, Final

from benchmarks import ROOT

FOLDER: Final = ROOT / "docs" / "figures"


def tables(output: str) -> dict[str, list[list[str]]]:
    """Return the Markdown tables of ``output``, numbered from 1, without their rulers."""
    found: dict[str, list[list[str]]] = {}
    inside = False
    for line in output.splitlines():
        if not line.startswith("|"):
            inside = False
            continue
        rows = found.setdefault(str(len(found) + (not inside)), [])
        inside = True
        if line.strip("|-: ") or not rows:
            rows.append([cell.strip() for cell in line.strip().strip("|").split("|")])
    return found


def program(command: str) -> Path:
    """Return the file of the benchmark that ``command`` runs."""
    _, first, *rest = command.split()
    if first != "-m":
        return ROOT / first
    place = ROOT.joinpath(*rest[0].split("."))
    return place / "__main__.py" if place.is_dir() else place.with_suffix(".py")


def named(found: dict[str, list[list[str]]], before: dict[str, list[list[str]]]) -> dict[str, list[list[str]]]:
    """Return the tables ``found`` by the names of those ``before`` that have the same headings, each used once."""
    left = dict(before)
    names = {}
    for number, rows in found.items():
        name = next((name for name, old in left.items() if old[:1] == rows[:1]), number)
        left.pop(name, None)
        names[name] = rows
    return names


def record(output: str, command: str, measures: list[str], commit: str, machine: str) -> dict[str, Any]:
    """Return the content of a figures file.

    Raises:
        ValueError: the last line of ``output`` is not a benchmark's result.
    """
    try:
        result = json.loads(output.strip().splitlines()[-1])
        last = {key: result[key] for key in ("bench", "figures", "goals", "met")}
    except (ValueError, IndexError, KeyError, TypeError) as error:
        raise ValueError(f"the last line of the output is not a benchmark's result: {error!r}") from error
    return {"command": command, "commit": commit, "machine": machine, "measures": measures, **last} | {
        "tables": tables(output)
    }


def machine() -> str:
    """Return processor count, architecture and load, as a phrase."""
    return f"{os.cpu_count()} cores ({platform.machine()}, load {os.getloadavg()[0]:.1f} at the start)"


def main() -> int:
    """Run, record, and return the benchmark's exit code."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("name", help="name of the file in docs/figures")
    parser.add_argument("--measures", nargs="+", required=True, help="paths whose change makes the figures old")
    parser.add_argument("command", nargs="+", help="after --: the benchmark's file and arguments")
    arguments = parser.parse_args()
    before, commit = machine(), _git("rev-parse", "--short", "HEAD")
    if _git("status", "--porcelain", "--untracked-files=no"):
        parser.error("commit the changes first: the figures would belong to no commit")
    done = subprocess.run(
        [sys.executable, *arguments.command], cwd=ROOT, stdout=subprocess.PIPE, text=True, check=False
    )
    sys.stdout.write(done.stdout)
    content = record(done.stdout, " ".join(["python", *arguments.command]), arguments.measures, commit, before)
    file = FOLDER / f"{arguments.name}.json"
    if file.exists():
        earlier = json.loads(file.read_text(encoding="utf-8"))["tables"]
        content["tables"] = named(content["tables"], earlier)
    file.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    return done.returncode


def _git(*words: str) -> str:
    return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()


if __name__ == "__main__":
    sys.exit(main())
