"""Measured numbers of the pages come from files that name command, commit and machine."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.record import record, tables

ROOT = Path(__file__).resolve().parents[3]
DOCS = ROOT / "docs"
FILES = sorted((DOCS / "figures").glob("*.json"))
PAGES = sorted(page for page in DOCS.glob("*.md") if "\n[Figures](" in page.read_text(encoding="utf-8"))


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(str(DOCS / "site"))
    from pages import figures

    yield figures
    for name in [name for name in sys.modules if name == "pages" or name.startswith("pages.")]:
        del sys.modules[name]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_link_alone_becomes_a_table(page: Path, figures):
    text = page.read_text(encoding="utf-8")
    assert figures.shown(text).count("\n\nMeasured by `") == text.count("\n[Figures](")


def test_a_link_shows_one_table_or_the_figures_with_their_source(figures):
    assert figures.shown('[Figures](figures/deaths.json "deaths")').startswith("| daemon | standstill s, p50 |")
    shown = figures.shown("a\n\n[Figures](figures/loop.json)\n\nb")
    assert shown.startswith("a\n\n| figure | measured | goal |\n")
    assert "\n\nMeasured by `python benchmarks/loop.py" in shown


def test_owned_pages_hold_no_other_measured_number(figures):
    for name in figures.OWNED:
        assert figures.unowned((DOCS / name).read_text(encoding="utf-8")) == [], name


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_a_file_names_its_command_its_commit_and_the_code_it_measures(file: Path, figures):
    found = figures.read(file)
    assert (ROOT / found.command.split()[1]).is_file()
    assert found.machine
    assert found.commit
    assert found.measures
    assert [path for path in found.measures if not (ROOT / path).exists()] == []
    assert all(len(row) == len(rows[0]) for rows in found.tables.values() for row in rows)
    assert any(f"(figures/{file.stem}.json" in page.read_text(encoding="utf-8") for page in DOCS.glob("*.md"))


def test_a_measured_number_of_a_page_is_found(figures):
    text = "Takes 3.5 ms, with `--seconds 5 s`.\n\n| run | goal | result |\n|---|---|---|\n| a | 4 s | 12 % |\n"
    assert figures.unowned(text) == ["3.5 ms", "12 %"]


def test_a_file_that_lacks_a_key_is_refused_by_name(figures, tmp_path: Path):
    (tmp_path / "bad.json").write_text("{}")
    with pytest.raises(ValueError, match=r"bad\.json: KeyError\('command'\)"):
        figures.read(tmp_path / "bad.json")


def test_a_benchmarks_output_becomes_a_file():
    output = "loud\n| a | b |\n|---|---:|\n| 1 | 2 |\n\n| c |\n|---|\n| 3 |\n" + json.dumps(
        {"bench": "x", "figures": {"s": 1.5}, "goals": {"s": 2.0}, "met": True}
    )
    assert tables(output) == {"1": [["a", "b"], ["1", "2"]], "2": [["c"], ["3"]]}
    found = record(output, "python benchmarks/x.py", ["schemas"], "abc", "a computer")
    assert found["figures"] == {"s": 1.5}
    assert found["tables"]["2"] == [["c"], ["3"]]
    with pytest.raises(ValueError, match="not a benchmark's result"):
        record("no JSON", "python benchmarks/x.py", ["schemas"], "abc", "a computer")


def test_an_incomplete_command_line_of_record_is_refused():
    done = subprocess.run(
        [sys.executable, ROOT / "benchmarks" / "record.py", "x"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert "--measures" in done.stderr
