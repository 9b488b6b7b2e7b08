"""Tables of other programs: CSV with commas, semicolons or tabs, or columns separated by spaces."""

import csv
import re
from pathlib import Path
from typing import Final

from monstertruck_runtime.outside import reading, text_of

DELIMITERS: Final = "\t;, "
"""Delimiters; the first one that occurs in a row separates its cells. White space beside another one does not."""
COMMENT: Final = "#"
_DECLARED: Final = re.compile(r"sep=(.)")
"""First line of a table by Excel, which names the delimiter."""
_DECIMAL_COMMA: Final = re.compile(r"^([+-]?\d*),(\d+(?:[eE][+-]?\d+)?)$")


def read_table(file: Path, expected: str, most: int) -> list[tuple[int, list[str]]]:
    """Read a table of at most ``most`` bytes: line number and cells of each row, without surrounding white space.

    A byte order mark, empty lines and lines that start with ``#`` are skipped. The first row, or Excel's ``sep=;``
    before it, decides the delimiter: tab, else semicolon, else comma, else spaces. Unless that is a comma, a decimal
    comma becomes a point. A delimiter at the end of a line starts no cell.

    Raises:
        InputError: it cannot be read, is too large, is not UTF-8, or not a table; the message names the line if
            possible.
    """
    return rows_of(text_of(file, expected, most), file, expected)


def rows_of(text: str, file: Path, expected: str) -> list[tuple[int, list[str]]]:
    """Return the rows of a table's text; see ``read_table``.

    Raises:
        InputError: it is not a table; the message names the line.
    """
    rows = [(number, line) for number, line in enumerate(text.splitlines(), start=1) if _counts(line)]
    declared = _DECLARED.fullmatch(rows[0][1].strip(" ")) if rows else None
    if declared:
        del rows[0]
    delimiter = declared[1] if declared else delimiter_of(rows[0][1]) if rows else ","
    found = []
    for number, line in rows:
        with reading(f"{file}:{number}", expected):
            found.append((number, cells_of(line, delimiter)))
    return found


def delimiter_of(line: str) -> str:
    """Return the first of ``DELIMITERS`` that occurs in a row; a comma if none does."""
    bare = re.sub(r"\s*([;,])\s*", r"\1", line.strip())
    return next((delimiter for delimiter in DELIMITERS if delimiter in bare), ",")


def cells_of(line: str, delimiter: str) -> list[str]:
    """Split a row into cells; see ``read_table``.

    Raises:
        csv.Error: it is no row of a table.
    """
    if delimiter == " ":
        cells = line.split()
    else:
        cells = [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter))]
        if len(cells) > 1 and not cells[-1]:
            cells.pop()
    return cells if delimiter == "," else [_DECIMAL_COMMA.sub(r"\1.\2", cell) for cell in cells]


def _counts(line: str) -> bool:
    return bool(line.strip(" \t;,")) and not line.lstrip().startswith(COMMENT)
