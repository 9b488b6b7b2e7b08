"""What import-linter's contracts do not hold: circles of modules, and what a process has loaded by imports on use."""

import subprocess
import sys
import tomllib
from pathlib import Path

import grimp
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

ROOT = Path(__file__).resolve().parents[3]
SCRIPT = """
import sys
from pathlib import Path
from monstertruck_runtime.clock import WallClock
from monstertruckd.config.load import load_truck
from monstertruckd.daemon import Daemon
import monstertruckd.run
config, tree = load_truck(Path(sys.argv[1]))
Daemon(config.model_copy(update={"state_directory": Path(sys.argv[2])}), WallClock(), tree=tree)
print(*sorted(sys.modules))
"""


def test_neither_world_nor_heavy_libraries(tmp_path: Path):
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(ROOT / "configs" / "truck.yaml"), str(tmp_path)],
        capture_output=True,
        text=True,
        check=True,
        timeout=30,
    )
    loaded = set(done.stdout.split())
    assert not {
        name for name in loaded if name.startswith(("monstertruck_sim.world", "monstertruckd.tools.simulation"))
    }
    assert not loaded & {"scipy", "numba", "kiss_icp", "matplotlib", "PIL"}


def test_help_is_light():
    done = subprocess.run(
        [sys.executable, "-c", "import sys, monstertruckd.tools.cli.main; print(*sys.modules)"],
        capture_output=True,
        text=True,
        check=True,
        timeout=30,
    )
    assert not set(done.stdout.split()) & {"numpy", "zenoh", "scipy", "mcap", "serial", "pydantic"}


def test_no_modules_import_each_other_in_a_circle():
    """Imports on use and those for type checkers count, too."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]
    graph = grimp.build_graph(*contracts["root_packages"], cache_dir=None)
    modules = sorted(graph.modules)
    number = {module: index for index, module in enumerate(modules)}
    ends = [
        (number[module], number[other])
        for module in modules
        for other in graph.find_modules_directly_imported_by(module)
    ]
    edges = coo_array((np.ones(len(ends)), np.transpose(ends)), shape=(len(modules), len(modules)))
    _, circle = connected_components(edges, connection="strong")
    sizes = np.bincount(circle)
    assert len(modules) > 400
    assert [module for module in modules if sizes[circle[number[module]]] > 1] == []
