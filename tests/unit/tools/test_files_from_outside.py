"""Mutated files of every kind that users hand in; ``benchmarks/durability.py`` tries many more."""

from pathlib import Path

import pytest

from benchmarks.durability_parts import files


@pytest.mark.parametrize("name", list(files.kinds()))
def test_a_sound_file_is_read(tmp_path: Path, name: str):
    kind = files.kinds()[name]
    kind.make(tmp_path)
    kind.read(tmp_path)


@pytest.mark.timeout(600)
@pytest.mark.parametrize("count", [len(files.kinds()), pytest.param(200, marks=pytest.mark.long)])
def test_mutated_files_are_read_or_refused(tmp_path: Path, count: int):
    figures = files.run_apart(count, 11, tmp_path / "work")
    assert {name: row["faults"] for name, row in figures.items()} == dict.fromkeys(files.kinds(), 0)
    assert sum(row["files"] for row in figures.values()) == count
