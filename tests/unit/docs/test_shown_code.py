"""The code that pages show is the code that runs."""

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
def test_it_is_in_the_page_and_equal(page: Path, source):
    text = page.read_text()
    assert source.refreshed(text) == text, "python docs/site/pages/source.py writes it anew"
    assert text.count("<!-- source: ") == text.count(" -->\n```python\n")


def test_older_code_is_replaced_and_missing_code_added(source):
    mark = "<!-- source: monstertruck_runtime.clock:is_date -->"
    fresh = source.refreshed(f"before\n\n{mark}\n\nafter\n")
    assert fresh.startswith(f"before\n\n{mark}\n```python\ndef is_date(real: int) -> bool:\n")
    assert fresh.endswith("```\n\nafter\n")
    assert source.refreshed(fresh.replace("def is_date", "def was_date")) == fresh


def test_three_pages_show_code():
    assert {page.name for page in PAGES} >= {"writing-a-driver.md", "writing-a-planner.md", "writing-a-robot-body.md"}
