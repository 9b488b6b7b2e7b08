"""Measured numbers of the pages come from files that name command, commit and machine."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import older_figures
from benchmarks.older_figures import known, latest_commit, rows
from benchmarks.record import named, program, record, tables

ROOT = Path(__file__).resolve().parents[3]
DOCS = ROOT / "docs"
FILES = sorted((DOCS / "figures").glob("*.json"))
PAGES = sorted(page for page in DOCS.glob("*.md") if "\n[Figures](" in page.read_text(encoding="utf-8"))
HISTORY = {"errata.md"}
"""Pages that quote figures of others; decision records quote those of their date."""
JUDGED = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *(p for p in sorted(DOCS.glob("*.md")) if p.name not in HISTORY),
]
STATED = ROOT / "tests" / "data" / "stated_numbers.json"
"""Numbers with units that pages state: settings, limits, conditions and facts of devices, none of them a result."""


@pytest.fixture
def figures(site_module):
    return site_module("figures")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_link_alone_becomes_a_table(page: Path, figures):
    text = page.read_text(encoding="utf-8")
    assert figures.shown(text).count("\n\nMeasured by `") == text.count("\n[Figures](")


def test_a_link_shows_one_table_or_the_figures_with_their_source(figures):
    assert figures.shown('[Figures](figures/deaths.json "deaths")').startswith("| daemon | standstill s, p50 |")
    shown = figures.shown("a\n\n[Figures](figures/loop.json)\n\nb")
    assert shown.startswith("a\n\n| figure | measured | goal |\n")
    assert "\n\nMeasured by `python benchmarks/loop.py" in shown


@pytest.mark.parametrize("page", JUDGED, ids=lambda page: page.name)
def test_no_page_holds_a_result_itself(page: Path, figures):
    assert figures.unowned(page.read_text(encoding="utf-8")) == [], "a result comes from a file in docs/figures"


def test_other_numbers_of_the_pages_are_known_to_be_no_results(figures, tmp_path: Path):
    found = {page.name: sorted(figures.stated(page.read_text(encoding="utf-8"))) for page in JUDGED}
    now = tmp_path / STATED.name
    now.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    known = json.loads(STATED.read_text(encoding="utf-8"))
    new = {name: sorted(set(numbers) - set(known.get(name, []))) for name, numbers in found.items()}
    assert {name: numbers for name, numbers in new.items() if numbers} == {}, (
        "measured: record it in docs/figures and link it (docs/benchmarks.md); a setting, a limit or a fact: "
        f"cp {now} {STATED}"
    )


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_a_file_names_its_command_its_commit_and_the_code_it_measures(file: Path, figures):
    found = figures.read(file)
    assert program(found.command).is_file()
    assert found.machine
    assert found.commit
    assert found.measures
    assert [path for path in found.measures if not (ROOT / path).exists()] == []
    assert all(len(row) == len(rows[0]) for rows in found.tables.values() for row in rows)
    assert any(f"(figures/{file.stem}.json" in page.read_text(encoding="utf-8") for page in DOCS.glob("*.md"))


def test_a_measured_number_of_a_page_is_found(figures):
    table = "| run | goal | result |\n|---|---|---|\n| a | 4 s | 12 |\n"
    text = f"## Measured\n\nTakes 3.5 ms in 7 of 8 runs, with `--seconds 5 s`.\n\n{table}\n## Limits\n\nAt most 2 s.\n"
    assert figures.unowned(text) == ["3.5 ms", "7 of 8", "12"]
    assert figures.stated(text) == {"2 s"}
    assert figures.unowned("`python benchmarks/x.py`: 1.08 times as far.") == ["1.08"]


def test_figures_older_than_their_code_are_shown_with_the_number_of_changes(figures, monkeypatch: pytest.MonkeyPatch):
    found = figures.read(FILES[0])
    monkeypatch.setattr(figures, "commits_since", lambda commit, measures: 2)
    assert found.source.endswith(f"{found.machine}. 2 later commits changed the measured code.")
    monkeypatch.setattr(figures, "commits_since", lambda commit, measures: 0)
    assert found.source.endswith(f"{found.machine}.")


def test_a_commit_that_a_rebase_replaced_counts_as_the_latest_of_its_file():
    (name, commit, _, _), *_ = rows()
    assert known("no such commit", name) == latest_commit(ROOT / "docs" / "figures" / f"{name}.json")
    assert known(known(commit, name), name) == known(commit, name)


def test_a_shallow_clone_has_no_history(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(older_figures, "git", lambda *words: "true\n" if "rev-parse" in words else "\0abc\n\nREADME.md")
    older_figures._history.cache_clear()
    with pytest.raises(LookupError, match="shallow"):
        older_figures.commits_since("abc", ["README.md"])
    older_figures._history.cache_clear()


def test_the_program_of_a_command_is_its_file():
    assert program("python benchmarks/deaths.py --trials 3").name == "deaths.py"
    assert program("python -m benchmarks.thesis --only 5.1").parent.name == "thesis"
    assert program("python -m benchmarks.fleet").name == "fleet.py"


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


def test_a_table_recorded_again_keeps_its_name():
    deaths, modes = [["cause", "stands after"], ["kill", "3 s"]], [["mode", "rate"], ["a", "4"]]
    before = {"deaths": [deaths[0], ["kill", "9 s"]], "gone": [["other"]]}
    assert named({"1": modes, "2": deaths}, before) == {"1": modes, "deaths": deaths}
    assert named({"1": deaths, "2": deaths}, before) == {"deaths": deaths, "2": deaths}
