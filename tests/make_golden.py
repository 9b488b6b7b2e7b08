"""``python tests/make_golden.py``: the golden log and configuration of this version, read by tests of all later ones.

Run once per release, at the commit that is tagged; an existing folder is never overwritten.
"""

import json
import shutil
import tempfile
from pathlib import Path

import numpy as np

from monstertruck_runtime.yaml_files import read_yaml, yaml_text
from monstertruckd import __version__
from monstertruckd.config.load import FILE_VERSION, load_tree
from monstertruckd.tools.demo.runs import run_fast_demo
from monstertruckd.tools.logs.report.collect import collect
from monstertruckd.tools.logs.summary import info

ROOT = Path(__file__).resolve().parents[1]
GOLDEN = ROOT / "tests" / "data" / "golden"
LENGTH = 0.15
"""Metres of the recorded drive: the log has to stay small."""


def write_config(source: Path, target: Path, **changes: object) -> None:
    """``source`` with all it includes as one file without includes, its path straight and short."""
    config = load_tree(source).data | {"version": FILE_VERSION} | changes
    config.pop("include", None)
    config["path"] = {"file": "path.csv"}
    target.write_text(yaml_text(config), encoding="utf-8")
    rows = [f"{x:.4f},-1.7000,0.00000,1" for x in np.arange(0.0, LENGTH + 1e-9, 0.05)]
    (target.parent / "path.csv").write_text("\n".join(["x,y,yaw,direction", *rows]) + "\n")


def _coarser_lidar(config: Path) -> None:
    """Every third beam: scans are most of a log."""
    values = read_yaml(config)
    values["devices"]["lidar"]["driver"]["cluster"] = 3
    config.write_text(yaml_text(values))


def main() -> None:
    """Write the folder of this version."""
    folder = GOLDEN / __version__
    folder.mkdir(parents=True)
    write_config(ROOT / "configs" / "full.yaml", folder / "truck.yaml")
    with tempfile.TemporaryDirectory(prefix="golden-") as scratch:
        short = Path(scratch) / "demo.yaml"
        write_config(ROOT / "configs" / "demo.yaml", short, recorder={"compression": "zstd"})
        _coarser_lidar(short)
        summary = run_fast_demo(short, Path(scratch) / "run", seed=1)
        (log,) = (file for file in summary.files if file.suffix == ".mcap")
        shutil.copy(log, folder / "run.mcap")
    log = folder / "run.mcap"
    counts = {name: row["messages"] for name, row in info(log)["topics"].items()}
    run = collect(log)
    expected = {"topics": counts, "duration": run.duration, "distance": run.distance, "outcome": summary.lap.outcome}
    (folder / "expected.json").write_text(json.dumps(expected, indent=1) + "\n")
    print(folder, f"{log.stat().st_size / 1e3:.0f} kB", counts)


if __name__ == "__main__":
    main()
