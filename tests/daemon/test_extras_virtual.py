"""What the README's first command installs suffices for what it runs."""

import subprocess
import sys
from importlib.metadata import packages_distributions, requires
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from monstertruck_estimation.consistency.config import SCAN_LIBRARIES
from monstertruckd.bootstrap import EXTRAS

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(120)]

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


def test_the_demo_needs_no_more_than_its_own_extra(tmp_path: Path):
    own = installed_by(*EXTRAS["demo"])
    assert {*SCAN_LIBRARIES} <= own, "the demo compares the wheels with the scans"
    others = sorted(
        module
        for module, distributions in packages_distributions().items()
        if not own & {canonicalize_name(name) for name in distributions}
    )
    assert {"kiss_icp", "matplotlib", "mujoco"} <= {*others}
    command = [sys.executable, "-c", DEMO, "demo", "--fast", ",".join(others)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
