"""The code that pages show is the code that runs: the site takes it from the packages."""

import sys
from pathlib import Path

import pytest

SITE = Path(__file__).resolve().parents[3] / "docs" / "site"
PAGES = sorted(page for page in SITE.parent.glob("*.md") if "<!-- source: " in page.read_text())


@pytest.fixture
def source(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(str(SITE))
    from pages import source

    yield source
    for name in [name for name in sys.modules if name == "pages" or name.startswith("pages.")]:
        del sys.modules[name]


@pytest.mark.parametrize("page", PAGES, ids=[page.name for page in PAGES])
def test_every_mark_names_code(page: Path, source):
    shown = source.shown(page.read_text())
    assert shown.count("<!-- source: ") == shown.count(" -->\n```python\n")


def test_code_stands_below_its_mark(source):
    mark = "<!-- source: monstertruck_runtime.clock:is_date -->"
    shown = source.shown(f"before\n\n{mark}\n\nafter\n")
    assert shown.startswith(f"before\n\n{mark}\n```python\ndef is_date(real: int) -> bool:\n")
    assert shown.endswith("```\n\nafter\n")


def test_a_mark_without_code_is_refused(source):
    with pytest.raises(AttributeError):
        source.shown("<!-- source: monstertruck_runtime.clock:was_date -->")


def test_three_pages_show_code():
    assert {page.name for page in PAGES} >= {"writing-a-driver.md", "writing-a-planner.md", "writing-a-robot-body.md"}
