"""Turns of phrase that slow a reader down, per 1000 words of docstrings, comments, messages and pages.

    python benchmarks/prose.py [--list] [PATH ...]

Counts patterns of sentences without an actor or with a clause in place of a noun. A hit is a place to read again, not
an error. ``--list`` prints every hit. Decisions, tests and generated files are not counted. The last line is JSON.
"""

import argparse
import ast
import json
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from typing import Final, NamedTuple

from benchmarks import ROOT

PATHS: Final = ("monstertruckd", "drivers", "planners", "schemas", "docs", "README.md")
GOAL: Final = 2.0
"""Maximum rate over all files, per 1000 words."""
FILE_GOAL: Final = 6.0
"""Maximum rate of a file with at least ``FILE_WORDS`` words."""
FILE_WORDS: Final = 300
PATTERNS: Final = {
    "clause with what in place of a noun": (
        r"\b[Ww]hat (?!if\b|else\b|about\b|to\b|you\b|we\b)"
        r"(is|are|was|were|has|had|it|they|the|a|an|one|no|comes|stands|hangs|\w+s|\w+ed)\b"
    ),
    "preposition with which": r"\b(of|by|in|with|for|from|after|at|on|to|behind|before) which\b",
    "docstring without a head": r'(?m)^"""(Of|That of|Those of|By|From|With|In|At|As|Where|While|Along|Around|To|On) ',
    "newest, present": r"\b[Nn]ewest\b|\b(the|its|a|their|[Tt]he) present (?!in\b)\w+",
    "texts that say": r"\b(says|said)\b",
    "least, greatest": r'(?m)(^|"""|: |; )(Least|Most|Fewest|Greatest|Farthest) (?!of\b|likely|common)\w+',
    "possessive without a noun": r"(?m)\b\w+'s(?=[.,;:)]|$)",
    "equals sign for a condition": (
        r"\b(None|null|0|empty|nothing) = (there|it|they|he|nobody|nothing|nowhere|none|never|not|as|what|one)\b"
    ),
    "of its own": r"\bof (its|their|his|our|one's|the \w+'s|\w+'s) own\b",
    "go on, take on, set off": (
        r"\b(go|goes|went|going|gone) on\b(?! to\b)|\b(take|takes|taken|took) on\b|\bsets? off\b"
    ),
    "is no N": r"(?<![Tt]here )\b(is|are|was|were|be) no (?!longer|more|such|need|reason|other|different|guarantee)\w+",
    "counts for is valid": (
        r"\b(does not|do not|no longer|only|still|that|which|it|they|scans?|results?) counts?\b(?! (of|as \w+ or))"
    ),
    "another one": r"\b(one after the other|the other one|another one|no other one|that one)\b",
    "actor without a name": (
        r"\b([Ss]omebody|[Nn]obody|[Ww]hoever|[Aa]nybody|anew|alike|likewise|begun|beside|farther)\b"
    ),
    "is named, says so": r"\b(is|are|was|were) (tol[d]|named)\b|\bsays so\b",
    "way for path": (
        r"\bways\b(?! (to|of|in|out|that)\b)|\bthe way (driven|by|ends|was)\b|\bno way (leads|\{|\d)"
        r"|(?<!right )\bof ways?\b"
    ),
    "that of, those of": r"\b(that|those) of\b",
}
SKIPPED: Final = re.compile(r"decisions/|_pb2\.py$|^tests/")
COMPILED: Final = {label: re.compile(pattern) for label, pattern in PATTERNS.items()}
COMMENT: Final = re.compile(r"(?:^|\s\s)#\s+(.+)$", re.MULTILINE)


class FileCount(NamedTuple):
    """Hits and words of a file."""

    hits: int
    words: int

    @property
    def rate(self) -> float:
        """Hits per 1000 words."""
        return 1000 * self.hits / max(self.words, 1)


def units(name: str, text: str) -> Iterator[str]:
    """Yield the prose of a file, piece by piece.

    Docstrings begin with their quotes. Strings and comments of fewer than three words are not prose.

    Args:
        name: of the file; its extension decides.
        text: its content.
    """
    if name.endswith(".py"):
        yield from _of_python(text)
    elif name.endswith(".md"):
        yield from _of_page(text)


def _of_python(text: str) -> Iterator[str]:
    tree = ast.parse(text)
    docstrings = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            words = node.value.split()
            if len(words) >= 3:
                yield ('"""' if id(node) in docstrings else "") + " ".join(words)
    for comment in COMMENT.findall(text):
        if len(comment.split()) >= 3:
            yield comment


def _of_page(text: str) -> Iterator[str]:
    code = False
    for line in text.splitlines():
        if line.startswith("```"):
            code = not code
        elif not code and not line.startswith("    "):
            yield line


def hits(prose: str) -> Iterator[tuple[str, re.Match[str]]]:
    """Yield pattern and match of every hit in pieces of prose, one a line."""
    for label, pattern in COMPILED.items():
        for found in pattern.finditer(prose):
            yield label, found


def files(paths: tuple[str, ...]) -> list[str]:
    """Return the tracked files to count."""
    names = subprocess.run(
        ["git", "ls-files", "--", *paths], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.splitlines()
    return [name for name in names if name.endswith((".py", ".md")) and not SKIPPED.search(name)]


def counted(paths: tuple[str, ...] = PATHS, *, listed: bool = False) -> tuple[Counter[str], dict[str, FileCount]]:
    """Count the hits of all files, by pattern and by file; print them if ``listed``."""
    total: Counter[str] = Counter()
    by_file = {}
    for name in files(paths):
        prose = "\n".join(units(name, (ROOT / name).read_text(encoding="utf-8")))
        found = list(hits(prose))
        total.update(label for label, _ in found)
        by_file[name] = FileCount(len(found), len(prose.split()))
        if listed:
            for label, match in found:
                around = prose[max(match.start() - 60, 0) : match.end() + 60].replace("\n", " / ")
                print(f"{name}: {label}: {around}")
    return total, by_file


def figures_of(by_file: dict[str, FileCount]) -> dict[str, float]:
    """Return the rate over all files, and the number of files above their goal."""
    whole = FileCount(sum(file.hits for file in by_file.values()), sum(file.words for file in by_file.values()))
    above = sum(file.words >= FILE_WORDS and file.rate > FILE_GOAL for file in by_file.values())
    return {"per_1000_words": round(whole.rate, 2), "files_above": above}


def main() -> int:
    """Count and print; return 0 if the goals are met."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--list", action="store_true", help="print every hit")
    parser.add_argument("paths", nargs="*", default=PATHS)
    arguments = parser.parse_args()
    total, by_file = counted(tuple(arguments.paths), listed=arguments.list)
    for label, number in total.most_common():
        print(f"{number:5d}  {label}")
    for name, file in sorted(by_file.items(), key=lambda item: -item[1].rate):
        if file.words >= FILE_WORDS and file.rate > FILE_GOAL:
            print(f"{file.rate:5.1f}  {file.hits:3d} in {file.words:5d} words  {name}")
    figures = figures_of(by_file)
    goals = {"per_1000_words": GOAL, "files_above": 0}
    met = all(figures[name] <= goal for name, goal in goals.items())
    print(json.dumps({"bench": "prose", "figures": figures, "goals": goals, "met": met}))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
