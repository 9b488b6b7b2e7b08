"""List the figures and pictures of the documentation that are older than the code that they measure or show.

    python benchmarks/older_figures.py

``docs/pictures/sources.json`` names the subject of each picture. The last line is JSON. The site shows the number of
later commits below every table.
"""

import json
import subprocess
import sys
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path

from benchmarks import ROOT


def git(*words: str) -> str:
    """Return the output of a command of git in this repository."""
    return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=True).stdout


@cache
def _history() -> tuple[tuple[str, tuple[str, ...]], ...]:
    """Return hash and changed paths of every commit, newest first.

    Raises:
        LookupError: a shallow clone, whose oldest commit seems to change every file.
    """
    if git("rev-parse", "--is-shallow-repository") != "false\n":
        raise LookupError("a shallow clone has no history")
    log = git("log", "--format=%x00%H", "--name-only", "--no-renames")
    commits = (part.split("\n") for part in log.split("\0")[1:])
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


def latest_commit(file: Path) -> str:
    """Return the latest commit that changed ``file``.

    Raises:
        LookupError: no commit did.
    """
    name = file.relative_to(ROOT).as_posix()
    for commit, paths in _history():
        if name in paths:
            return commit
    raise LookupError(f"no commit of {name}")


def known(commit: str, name: str) -> str:
    """Return ``commit``, or the latest one of the figures ``name`` if a rebase has replaced it."""
    there = any(found.startswith(commit) for found, _ in _history())
    return commit if there else latest_commit(ROOT / "docs" / "figures" / f"{name}.json")


def rows() -> Iterator[tuple[str, str, Sequence[str], str]]:
    """Yield name, commit, paths and command of every file of figures and every picture."""
    for file in sorted((ROOT / "docs" / "figures").glob("*.json")):
        found = json.loads(file.read_text(encoding="utf-8"))
        yield file.stem, found["commit"], found["measures"], found["command"]
    pictures = ROOT / "docs" / "pictures"
    for pattern, source in json.loads((pictures / "sources.json").read_text(encoding="utf-8")).items():
        for picture in sorted(pictures.glob(pattern)):
            yield picture.name, latest_commit(picture), source["shows"], source["command"]


def main() -> int:
    """Print a line for each row whose paths have changed since its commit."""
    older = {"figures": 0, "pictures": 0}
    for name, commit, paths, command in rows():
        if changes := commits_since(known(commit, name), paths):
            older["pictures" if "." in name else "figures"] += 1
            print(f"{name}: {changes} commits since {commit[:8]}; run {command}")
    met = not any(older.values())
    print(json.dumps({"bench": "older_figures", "figures": older, "goals": dict.fromkeys(older, 0), "met": met}))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
