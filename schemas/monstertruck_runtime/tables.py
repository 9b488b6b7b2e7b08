"""Tables of other programs: CSV with commas, semicolons or tabs."""

import csv
from pathlib import Path
from typing import Final

from monstertruck_runtime.outside import reading, text_of

DELIMITERS: Final = ",;\t"
COMMENT: Final = "#"


def read_table(file: Path, expected: str, most: int) -> list[tuple[int, list[str]]]:
    """Read a table of at most ``most`` bytes: line number and cells of each row, without surrounding white space.

    A byte order mark, empty lines and lines that start with ``#`` are skipped. The delimiter is the most frequent of
    comma, semicolon and tab in the first row.

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
    delimiter = max(DELIMITERS, key=rows[0][1].count) if rows else DELIMITERS[0]
    found = []
    for number, line in rows:
        with reading(f"{file}:{number}", expected):
            found.append((number, [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter))]))
    return found


def _counts(line: str) -> bool:
    return bool(line.strip(" \t;,")) and not line.lstrip().startswith(COMMENT)
