"""List the files of ``docs/figures`` that are older than the code that they measure.

    python benchmarks/older_figures.py

The last line is JSON. The site says the same below every table.
"""

import json
import subprocess
import sys
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parents[1]


@cache
def _history() -> tuple[tuple[str, tuple[str, ...]], ...]:
    """Return hash and changed paths of every commit, newest first."""
    log = subprocess.run(
        ["git", "log", "--format=%x00%H", "--name-only", "--no-renames"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    commits = (part.split("\n") for part in log.stdout.split("\0")[1:])
    return tuple((lines[0], tuple(filter(None, lines[1:]))) for lines in commits)


def commits_since(commit: str, measures: Sequence[str]) -> int:
    """Return the number of commits since ``commit`` that change one of the paths in ``measures``.

    Raises:
        LookupError: the history does not hold ``commit``.
        subprocess.CalledProcessError: there is no history.
    """
    count = 0
    for found, paths in _history():
        if found.startswith(commit):
            return count
        count += any(path == each or path.startswith(f"{each}/") for path in paths for each in measures)
    raise LookupError(f"no commit {commit}")


def main() -> int:
    """Print a line for each file whose measured paths have changed since its commit."""
    changes = {}
    for file in sorted((ROOT / "docs" / "figures").glob("*.json")):
        found = json.loads(file.read_text(encoding="utf-8"))
        changes[file.stem] = commits_since(found["commit"], found["measures"])
        if changes[file.stem]:
            print(f"{file.stem}: {changes[file.stem]} commits since {found['commit']}; run {found['command']}")
    older = sum(count > 0 for count in changes.values())
    print(json.dumps({"bench": "older_figures", "figures": {"older": older}, "goals": {"older": 0}, "met": not older}))
    return 0 if not older else 1


if __name__ == "__main__":
    sys.exit(main())
