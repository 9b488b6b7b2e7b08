"""Pictures of the documentation name what they show; those of the station's page are as new as the page."""

import json
import re
import shlex
from pathlib import Path

from benchmarks.older_figures import commits_since
from benchmarks.record import program
from docs.pictures.station_hash import HASH, page_hash

ROOT = Path(__file__).resolve().parents[3]
FOLDER = ROOT / "docs" / "pictures"
SOURCES = json.loads((FOLDER / "sources.json").read_text(encoding="utf-8"))
PICTURES = {picture for kind in ("png", "gif") for picture in FOLDER.rglob(f"*.{kind}")}


def test_the_pictures_of_the_page_are_as_new_as_the_page():
    """A picture of an older page promises what is no longer there."""
    assert HASH.read_text(encoding="utf-8").strip() == page_hash(), (
        "monstertruckd/station/page has changed since its pictures were taken: run `python -m docs.pictures.station` "
        "(needs chromium, takes a minute), look at docs/pictures/station-*.png, and commit them with station.sha256"
    )


def test_every_picture_names_its_command_and_what_it_shows():
    named = [picture for pattern in SOURCES for picture in FOLDER.glob(pattern)]
    assert len(named) == len(set(named))
    assert {picture.name for picture in PICTURES - set(named)} == set()
    for pattern, source in SOURCES.items():
        assert [path for path in source["shows"] if not (ROOT / path).exists()] == [], pattern
        if shlex.split(source["command"])[0] == "python":
            command = source["command"]
            place = command.replace("-m docs.pictures.", "docs/pictures/") + ".py" * command.startswith(
                "python -m docs"
            )
            assert program(place).is_file(), pattern


def test_every_picture_is_shown_on_a_page():
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")]
    shown = {name for page in pages for name in re.findall(r"pictures/([\w./-]+)", page.read_text(encoding="utf-8"))}
    assert {picture.relative_to(FOLDER).as_posix() for picture in PICTURES} <= shown


def test_commits_since_count_changes_of_the_named_paths(monkeypatch):
    history = (("c3", ("a/x.py",)), ("c2", ("ab.py", "b.py")), ("c1", ("a/x.py",)))
    monkeypatch.setattr("benchmarks.older_figures._history", lambda: history)
    assert [commits_since(commit, ["a", "b.py"]) for commit in ("c3", "c2", "c1")] == [0, 1, 2]
