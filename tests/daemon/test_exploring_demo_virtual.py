"""The demo with what the README's first command installs: a tag is found, and a report of the log ends it."""

import json
import subprocess
import sys
from importlib.metadata import packages_distributions, requires
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from monstertruck_estimation.consistency.config import SCAN_LIBRARIES
from monstertruckd.bootstrap import EXTRAS

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(480)]

SMALL = """
include: {room}
version: 2
odometry:
  start: {{ x: -0.6, y: 0.0, yaw: 0.0 }}
sim:
  world:
    map: table
    tags: [{{ tag: 0, x: 1.495, y: 0.6, z: 0.25, yaw: 3.1416 }}]
"""
ROOT = Path(__file__).resolve().parents[2]
DEMO = """
import sys
from importlib.abc import MetaPathFinder

class NotInstalled(MetaPathFinder):
    names = set(sys.argv.pop().split(","))

    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in self.names:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, NotInstalled())
import importlib.util
found = importlib.util.find_spec
importlib.util.find_spec = lambda name, package=None: None if name in NotInstalled.names else found(name, package)
from monstertruckd.tools.cli.main import app
app()
"""


def installed_by(*extras: str) -> set[str]:
    """Names of the distributions that ``monstertruckd`` with these extras needs."""
    names: set[str] = set()
    todo = [("monstertruckd", frozenset(extras))]
    seen = set()
    while todo:
        name, wanted = todo.pop()
        if (name, wanted) in seen:
            continue
        seen.add((name, wanted))
        names.add(name)
        for line in requires(name) or ():
            needed = Requirement(line)
            marks = [{"extra": extra} for extra in ("", *wanted)]
            if needed.marker is None or any(map(needed.marker.evaluate, marks)):
                todo.append((canonicalize_name(needed.name), frozenset(needed.extras)))
    return names


def test_it_maps_finds_a_tag_and_ends_at_home_with_map_and_report(tmp_path: Path):
    own = installed_by(*EXTRAS["demo"])
    assert {*SCAN_LIBRARIES} <= own, "the demo compares the wheels with the scans"
    others = sorted(
        module
        for module, distributions in packages_distributions().items()
        if not own & {canonicalize_name(name) for name in distributions}
    )
    assert {"aiohttp", "matplotlib", "mujoco"} <= {*others}
    file, run = tmp_path / "small.yaml", tmp_path / "run"
    file.write_text(SMALL.format(room=ROOT / "configs/room.yaml"))
    words = ("demo", "--json", "--config", str(file), "--output", str(run))
    command = [sys.executable, "-c", DEMO, *words, ",".join(others)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=460, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    figures = json.loads(done.stdout)
    assert figures["outcome"] == "points_found"
    assert figures["found"] == 1
    assert not figures["collided"]
    assert figures["home_error_m"] < 0.2
    assert figures["known"] > 3.0
    files = [Path(name) for name in figures["files"]]
    assert {file.suffix for file in files} == {".png", ".html", ".mcap"}
    assert all(file.is_file() and file.is_relative_to(run) for file in files)
    assert "1 of 1 tags" in done.stderr or "known" in done.stderr, "progress is shown"
