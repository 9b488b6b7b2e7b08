"""List the files of ``docs/figures`` that are older than the code that they measure.

    python benchmarks/older_figures.py

The last line is JSON.
"""

import json
import subprocess
import sys
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parents[1]


def main() -> int:
    """Print a line for each file whose measured paths have changed since its commit."""
    changes = {}
    for file in sorted((ROOT / "docs" / "figures").glob("*.json")):
        found = json.loads(file.read_text(encoding="utf-8"))
        log = subprocess.run(
            ["git", "log", "--oneline", f"{found['commit']}..HEAD", "--", *found["measures"]],
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=True,
        )
        changes[file.stem] = len(log.stdout.splitlines())
        if changes[file.stem]:
            print(f"{file.stem}: {changes[file.stem]} commits since {found['commit']}; run {found['command']}")
    older = sum(count > 0 for count in changes.values())
    print(json.dumps({"bench": "older_figures", "figures": {"older": older}, "goals": {"older": 0}, "met": not older}))
    return 0 if not older else 1


if __name__ == "__main__":
    sys.exit(main())
