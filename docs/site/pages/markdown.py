"""Pieces of Markdown, and docstrings as Markdown."""

import inspect
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

SECTION = re.compile(r"^(Args|Returns|Yields|Raises):\n", re.MULTILINE)


@dataclass(frozen=True, slots=True)
class Page:
    """One page of the site."""

    uri: str
    """Its place, ending in .md."""
    title: str
    text: str


def cell(text: str) -> str:
    """Text as it may stand in a table; in code a pipe divides no cells."""
    return re.sub(r"`[^`]*`|\|", lambda found: found[0] if len(found[0]) > 1 else "\\|", " ".join(text.split()))


def table(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table without the columns that are empty throughout; nothing if there are no rows."""
    filled = [[cell(text) for text in row] for row in rows]
    kept = [n for n in range(len(headings)) if any(row[n] for row in filled)]
    if not kept:
        return ""
    lines = [[headings[n] for n in kept], ["---"] * len(kept), *([row[n] for n in kept] for row in filled)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def prose(docstring: str | None) -> str:
    """What a docstring says before its sections, with single backticks."""
    text = SECTION.split(inspect.cleandoc(docstring or ""))[0]
    return text.replace("``", "`").strip()


def section(docstring: str | None, name: str) -> str:
    """One section of a docstring (``Raises`` ...); empty if there is none."""
    parts = SECTION.split(inspect.cleandoc(docstring or ""))
    found = dict(zip(parts[1::2], parts[2::2], strict=True)).get(name, "")
    return inspect.cleandoc(found).replace("``", "`").strip()


def raised(docstring: str | None) -> list[tuple[str, str]]:
    """Rows of a ``Raises`` section: exception and when."""
    entries = re.split(r"^(\w+): ", section(docstring, "Raises"), flags=re.MULTILINE)
    return list(zip(entries[1::2], entries[2::2], strict=True))


def join(*parts: str) -> str:
    """Paragraphs, tables and headings with empty lines between them."""
    return "\n\n".join(part for part in parts if part) + "\n"
