"""Documents name files that are there."""

import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
THERE = [
    f"/{name}"
    for name in subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
]
PEERS = {"gym/f110_gym/envs/laser_models.py"}
"""Files of other projects."""
OWN_PACKAGES = {"writing-a-driver.md", "writing-a-planner.md", "writing-a-robot-body.md", "writing-a-gate-check.md"}
"""Pages whose code blocks make packages with files of their own."""


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_python_file_that_a_page_names_exists(page: Path):
    named = set(re.findall(r"`([\w/]+\.py)`", page.read_text(encoding="utf-8")))
    short = {name.removeprefix("runtime/").removeprefix("planners/").removeprefix("estimation/") for name in named}
    missing = {name for name in short if not any(path.endswith(f"/{name}") for path in THERE)}
    assert missing <= PEERS or page.name in OWN_PACKAGES
