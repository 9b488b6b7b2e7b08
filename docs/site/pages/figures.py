"""Measured figures: one file a benchmark in ``docs/figures``, included in the pages by name.

On the site a paragraph ``[Figures](figures/FILE.json)`` becomes the figures and goals of a file, and
``[Figures](figures/FILE.json "TABLE")`` one of its tables. Tests fail if a page holds a measured number itself.
"""

import json
import re
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.older_figures import commits_since
from pages.markdown import Page, join, table

DOCS = Path(__file__).resolve().parents[2]
FOLDER = DOCS / "figures"
LINK = re.compile(r'^\[Figures\]\(figures/(?P<file>\w+)\.json(?: "(?P<table>\w+)")?\)$', re.MULTILINE)
NOT_PROSE = re.compile(r"^```.*?^```|`[^`\n]*`|^    [^\n]*$|\]\([^)]*\)|<!--.*?-->", re.MULTILINE | re.DOTALL)
UNITS = r"(?:[num]?s|%|[kM]?B|[cm]?m|x|Hz|rad|degrees|seconds|minutes|metres)"
NUMBER = re.compile(rf"(?<![\w.-])\d[\d ]*(?:\.\d+)? ?{UNITS}(?![\w-])")
RESULT = re.compile(rf"{NUMBER.pattern}|(?<![\w.-])\d+\.\d+(?![\w.-])|\b\d+ of \d+\b")
"""A number with a unit, a decimal fraction or a count of a whole."""
CELL = re.compile(r"(?<![\w.-])\d[\d.]*(?!\w)")
"""A number of a table."""
MEASURED = re.compile(r"#+ (Measured\b|Benchmarks$|Safety case$|.*, measured$)", re.MULTILINE)
"""Heading of a section that shows results only."""
BENCHMARK = re.compile(r"\bbenchmarks[/.]\w")
"""What a paragraph names that shows results."""
EXEMPT_COLUMNS = re.compile(r"goals?|condition|judged by")
"""Headings of columns with requirements rather than measurements."""


@dataclass(frozen=True, slots=True)
class Figures:
    """Result of one benchmark.

    Attributes:
        command: shell command that measures it.
        commit: commit that was measured.
        machine: computer and its load.
        measures: files and folders on which the result depends.
        figures: values by name; a nested object is a group.
        goals: limits by the same names.
        tables: rows of cells by name; the first row is the heading.
    """

    command: str
    commit: str
    machine: str
    measures: tuple[str, ...]
    figures: dict[str, Any]
    goals: dict[str, Any]
    tables: dict[str, list[list[str]]]

    @property
    def source(self) -> str:
        """Sentences that name command, commit and machine, and the commits since that changed the measured code."""
        try:
            later = commits_since(self.commit, self.measures)
        except (OSError, LookupError, subprocess.CalledProcessError):
            later = 0  # no clone, or a shallow one
        older = f" {later} later commit{'s' * (later > 1)} changed the measured code." if later else ""
        return f"Measured by `{self.command}` at {self.commit}, {self.machine}.{older}"


def read(file: Path) -> Figures:
    """Read one file.

    Raises:
        ValueError: a key is missing, or the file is not JSON; the message names the file.
    """
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
        return Figures(
            *(found[key] for key in ("command", "commit", "machine")),
            tuple(found["measures"]),
            *(found[key] for key in ("figures", "goals", "tables")),
        )
    except (KeyError, ValueError) as error:
        raise ValueError(f"{file.name}: {error!r}") from error


def shown(markdown: str) -> str:
    """Return ``markdown`` with tables in place of every paragraph that links to figures.

    Raises:
        OSError: no such file.
        KeyError: no such table in it.
    """

    def block(found: re.Match[str]) -> str:
        figures = read(FOLDER / f"{found['file']}.json")
        rows = figures.tables[found["table"]] if found["table"] else _values(figures)
        return f"{table(rows[0], rows[1:])}\n\n{figures.source}"

    return LINK.sub(block, markdown)


def pages() -> Iterator[Page]:
    """Yield one page of the site for each file, with all its tables."""
    for file in sorted(FOLDER.glob("*.json")):
        figures = read(file)
        values = _values(figures)
        rows = [values] if values[1:] else []
        blocks = [table(head, body) for head, *body in (*rows, *figures.tables.values())]
        text = join(f"# Figures: {file.stem}", figures.source, *blocks)
        yield Page(f"figures/{file.stem}.md", file.stem, text)


def unowned(markdown: str) -> list[str]:
    """Return the results that paragraphs on measurements hold outside code and columns of requirements."""
    lines = (line for results, block in _blocks(markdown) if results for line in _prose(block))
    return [found[0] for line in lines for found in (CELL if line.startswith("|") else RESULT).finditer(line)]


def stated(markdown: str) -> set[str]:
    """Return the numbers with units of all other paragraphs: settings, limits and facts."""
    blocks = (block for results, block in _blocks(markdown) if not results)
    return {found[0] for block in blocks for line in _prose(block) for found in NUMBER.finditer(line)}


def _blocks(markdown: str) -> Iterator[tuple[bool, str]]:
    """Yield each paragraph, and whether it shows results."""
    measured = 0  # level of the heading that a section of results has; 0 outside one
    for block in NOT_PROSE.sub(lambda found: found[0].replace("\n\n", "\n"), markdown).split("\n\n"):
        level = len(block) - len(block.lstrip("#"))
        if level and (not measured or level <= measured):
            measured = level if MEASURED.match(block) else 0
        yield measured > 0 or BENCHMARK.search(block) is not None, block


def _values(figures: Figures) -> list[list[str]]:
    values, goals = dict(_flat(figures.figures)), dict(_flat(figures.goals))
    return [
        ["figure", "measured", *(["goal"] if goals else [])],
        *([name, _text(value), *([_text(goals.get(name, ""))] if goals else [])] for name, value in values.items()),
    ]


def _flat(values: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{name}: ")
        else:
            yield f"{prefix}{name}", value


def _text(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _prose(markdown: str) -> Iterator[str]:
    """Yield the lines outside code and columns of requirements."""
    exempt: set[int] | None = None
    for line in NOT_PROSE.sub("", markdown).splitlines():
        if not line.startswith("|"):
            exempt = None
            yield line
            continue
        cells = line.strip("|").split("|")
        if exempt is None:
            exempt = {n for n, cell in enumerate(cells) if EXEMPT_COLUMNS.fullmatch(cell.strip())}
        yield "|" + "|".join(cell for n, cell in enumerate(cells) if n not in exempt)
