"""What the daemon's process has loaded once it is built, which no linter can follow through lazy imports."""

import subprocess
import sys
from pathlib import Path

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
