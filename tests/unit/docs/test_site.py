"""The documentation site is built without a warning and asks nobody for anything."""

import html.parser
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.record import program
from monstertruck_drivers.catalog import DEVICES
from monstertruck_schemas.topics import TOPICS
from monstertruckd.config.wizards import WIZARDS
from monstertruckd.tools.cli.main import app
from monstertruckd.tools.drill.unrevealed import UNREVEALED
from tests.unit.docs.command_lines import commands_of

ROOT = Path(__file__).resolve().parents[3]
pytestmark = [pytest.mark.long, pytest.mark.timeout(180)]

BUILD = ROOT / "docs" / "site" / "build.py"


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    build = subprocess.run(
        [sys.executable, BUILD, folder],
        cwd=ROOT,
        env={name: value for name, value in os.environ.items() if name != "NO_MKDOCS_2_WARNING"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert build.returncode == 0, build.stderr
    assert "WARNING" not in build.stderr
    assert "zensical" not in build.stderr.lower(), "the theme's makers advertise something else"
    return folder


def test_every_page_says_first_what_it_is_for(site: Path):
    pages = [page for page in site.rglob("*.html") if page.name != "404.html" and "files" not in page.parts]
    for page in pages:
        (after,) = re.findall(r"<h1[^>]*>.*?</h1>(.*)", page.read_text(), re.DOTALL)
        first = re.search(r"<p>(?!<img)(.*?)</p>|<h2", after, re.DOTALL)
        assert first is not None and len(re.sub("<[^>]+>", "", first[1] or "")) > 12, page  # noqa: PT018


class Loaded(html.parser.HTMLParser):
    """What a browser fetches for a page."""

    def __init__(self) -> None:
        super().__init__()
        self.places: set[str] = set()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        names = dict(attrs)
        if tag == "link" and names.get("rel") not in {"prev", "next", "canonical"}:
            self.places.add(names.get("href") or "")
        elif tag in {"script", "img", "iframe", "source"}:
            self.places.add(names.get("src") or "")


def test_no_page_fetches_anything_from_elsewhere_or_that_is_not_there(site: Path):
    pages = [page for page in site.rglob("*.html") if page.name != "404.html"]
    assert len(pages) > 80
    for page in pages:
        loaded = Loaded()
        loaded.feed(page.read_text())
        for place in loaded.places - {""}:
            assert "//" not in place, (page, place)
            assert (page.parent / place.partition("?")[0]).resolve().is_file(), (page, place)


def test_every_device_command_and_topic_has_its_place(site: Path):
    for kind in DEVICES.values():
        text = (site / "devices" / f"{kind.name}.html").read_text()
        for heading in ("Settings", "Probe", "Emulator", "Faults"):
            assert f'id="{heading.lower()}"' in text, (kind.name, heading)
        assert ('id="behaviours"' in text) == (kind.name not in {"link_quality", "host_health"}), kind.name
    for name in commands_of(app):
        assert (site / "commands" / f"{'-'.join(name)}.html").is_file(), name
    for topic in TOPICS:
        text = (site / "topics" / f"{topic.group}.html").read_text()
        assert topic.key("&lt;robot&gt;") in text


def test_every_benchmark_with_figures_is_described(site: Path):
    text = (site / "benchmark-runs.html").read_text()
    commands = [json.loads(file.read_text())["command"] for file in (ROOT / "docs" / "figures").glob("*.json")]
    programs = {program(command) for command in commands}
    names = [file.parent.name if file.name == "__main__.py" else file.stem for file in sorted(programs)]
    assert [name for name in names if f'id="{name}"' not in text] == []


def test_wizards_and_faults_that_nothing_reveals_have_their_places(site: Path):
    text = (site / "wizards.html").read_text()
    assert [key for wizard in WIZARDS.values() for key in wizard.keys if f"<code>{key}</code>" not in text] == []
    text = (site / "unrevealed.html").read_text()
    assert [row for row in UNREVEALED if f"<code>{row.families[0]}</code>" not in text] == []


def test_what_was_never_tried_is_gathered_and_code_is_shown(site: Path):
    text = (site / "never-tried.html").read_text()
    assert "no byte has gone to a real" in text
    assert "Nothing on this page has been tested on the truck" in text
    assert 'class="k">def</span>' in (site / "writing-a-driver.html").read_text()
