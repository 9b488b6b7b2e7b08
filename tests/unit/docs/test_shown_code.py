"""The code that pages show is the code that runs: the site takes it from the files that they link."""

import re
from pathlib import Path

import pytest

SITE = Path(__file__).resolve().parents[3] / "docs" / "site"
KINDS = {".py", ".toml", ".yaml"}
PAGES = sorted(SITE.parent.glob("writing-*.md"))


@pytest.fixture
def source(site_module):
    return site_module("source")


@pytest.mark.parametrize("page", PAGES, ids=[page.name for page in PAGES])
def test_every_paragraph_that_links_code_shows_it(page: Path, source):
    text = page.read_text()
    links = [line for line in text.splitlines() if re.fullmatch(r"\[.*\]\(\S+\.(py|toml|yaml)\)", line)]
    assert len(links) > 4
    assert source.shown(text).count(' title="') == len(links)


def test_every_file_of_an_example_is_on_its_page():
    shown = {place for page in PAGES for place in re.findall(r"\(examples/(\S+)\)", page.read_text())}
    examples = SITE.parent / "examples"
    there = {file.relative_to(examples).as_posix() for file in examples.glob("*/**/*") if file.suffix in KINDS}
    assert there == shown


def test_a_link_to_a_module_shows_the_name_of_the_link(source):
    link = "[is_date](../schemas/monstertruck_runtime/clock.py)"
    shown = source.shown(f"before\n\n{link}\n\nafter\n")
    assert shown.startswith('before\n\n```python title="is_date"\ndef is_date(real: int) -> bool:\n')
    assert shown.endswith("\n```\n\nafter\n")


def test_a_decorated_class_is_shown_with_its_decorator(source):
    assert "\n@dataclass(slots=True)\nclass Command:\n" in source.shown(
        "[Command](../planners/monstertruck_planners/track/path_tracker.py)"
    )


def test_a_link_within_a_sentence_stays_a_link(source):
    text = "See [is_date](../schemas/monstertruck_runtime/clock.py)."
    assert source.shown(text) == text


def test_a_name_that_is_not_in_the_module_is_refused(source):
    with pytest.raises(LookupError, match="no was_date"):
        source.shown("[was_date](../schemas/monstertruck_runtime/clock.py)")
