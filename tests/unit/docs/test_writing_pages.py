"""The pages on packages of one's own are followed to the letter: their files, then their commands, then mypy."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.plugin_kit import ROOT, files_of, written

PAGES = ("driver", "planner", "gate-check", "robot-body")
ROWS = {"driver": "mb7360", "planner": "linear", "gate-check": "bumper", "robot-body": "tracked"}
"""What `monstertruckd plugins` lists for each page's package."""
PLACES = [str(ROOT), *(str(ROOT / name) for name in ("drivers", "planners", "schemas"))]

pytestmark = pytest.mark.timeout(600)


def project(page: str, folder: Path) -> Path:
    written(files_of(page.replace("-", "_")), folder)
    (folder / "configs").symlink_to(ROOT / "configs")
    return folder


def commands(page: str) -> list[str]:
    """Lines of the page's fence of commands."""
    text = (ROOT / "docs" / f"writing-a-{page}.md").read_text(encoding="utf-8")
    found = re.search(r"^```\n(python -m hatchling .*?)^```$", text, re.DOTALL | re.MULTILINE)
    assert found is not None
    return found[1].splitlines()


@pytest.mark.parametrize("page", PAGES)
def test_the_package_is_built_and_found_by_the_commands_of_the_page(page: str, tmp_path: Path):
    lines = commands(page)
    first = lines[: lines.index("monstertruckd plugins") + 1]
    assert ROWS[page] in followed(first, project(page, tmp_path))


@pytest.mark.long  # demos drive their laps
@pytest.mark.parametrize("page", PAGES)
def test_all_commands_of_the_page_run(page: str, tmp_path: Path):
    lines = commands(page)
    if page == "driver":
        *lines, emulate, probe = lines
        link = emulate.split()[-1]
        # The page has the emulator run in another terminal until Ctrl-C.
        lines += [f"{emulate} & trap 'kill '$! EXIT", f"until [ -e {link} ]; do sleep 0.1; done", probe]
    assert "Traceback" not in followed(lines, project(page, tmp_path))


def followed(lines: list[str], folder: Path) -> str:
    """Run lines in a shell whose ``monstertruckd`` is this tree's, and return their output."""
    program = folder / "bin" / "monstertruckd"
    program.parent.mkdir()
    program.write_text(f'#!/bin/sh\nPYTHONPATH="$PYTHONPATH:{":".join(PLACES)}" exec python -m monstertruckd "$@"\n')
    program.chmod(0o755)
    ended = subprocess.run(
        ["bash", "-ec", "\n".join(lines)],
        cwd=folder,
        env=os.environ | {"PATH": f"{program.parent}:{Path(sys.executable).parent}:{os.environ['PATH']}"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return ended.stdout


@pytest.mark.long  # mypy reads the whole project without its cache
def test_the_samples_have_the_right_types(tmp_path: Path):
    folders = [project(page, tmp_path / page) for page in PAGES]
    packages = [str(next(folder.glob("truck_*"))) for folder in folders]
    ended = subprocess.run(
        [sys.executable, "-m", "mypy", "--cache-dir", str(tmp_path / "mypy"), *packages],
        cwd=ROOT,
        env=os.environ | {"MYPYPATH": ":".join(map(str, folders))},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 0, ended.stdout
