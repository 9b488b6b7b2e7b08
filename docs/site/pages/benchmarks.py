"""Every benchmark with its options, from the docstrings in ``benchmarks/``."""

import ast
import re
from pathlib import Path

from pages.markdown import Page, join, prose

FOLDER = Path(__file__).resolve().parents[3] / "benchmarks"
USAGE = re.compile(r"^ *python (-m benchmarks\.|benchmarks/)", re.MULTILINE)
"""A line of a docstring that runs its module; modules without one are parts of others."""


def page() -> Page:
    """Return the page: a section for each benchmark."""
    documents = {file: ast.get_docstring(ast.parse(file.read_text(encoding="utf-8"))) or "" for file in _files()}
    runs = {_name(file): document for file, document in documents.items() if USAGE.search(document)}
    text = join(
        "# Benchmark runs",
        "What each benchmark measures and how to run it. How to record its figures: [benchmarks](benchmarks.md).",
        *(f"## {name}\n\n{prose(document)}" for name, document in sorted(runs.items())),
    )
    return Page("benchmark-runs.md", "Benchmark runs", text)


def _files() -> list[Path]:
    return [*FOLDER.glob("*.py"), *FOLDER.glob("*/__main__.py")]


def _name(file: Path) -> str:
    return file.parent.name if file.name == "__main__.py" else file.stem
