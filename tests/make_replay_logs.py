"""``python -m tests.make_replay_logs``: short recorded runs that ``replay --check`` has to give again bit for bit.

Whole daemons on the virtual clock, of a fixed seed. To be made anew when the estimation, the tracker or the
configuration changes on purpose, so that the recorded outputs or the attached configuration are no longer theirs.
"""

import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from monstertruckd.config.yaml_tree import load_tree
from monstertruckd.demo.fast import run_fast_demo
from monstertruckd.logs import info

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "tests" / "data" / "replay"
RUNS = {"level": ("ramp.yaml", 0.2), "slam": ("slam.yaml", 0.8), "fusion": ("fusion.yaml", 0.6)}
"""Logs by name: configuration, and metres of the path: a rocking truck with a level lidar, and two that map."""


def short_config(source: Path, folder: Path, length: float) -> Path:
    """``source`` with all it includes, its path straight and short, without what fills a log: pictures, every beam."""
    config: dict[str, Any] = load_tree(source).data | {"version": 1}
    config.pop("include", None)
    config["path"] = {"file": "path.csv"}
    config["recorder"] = {"compression": "zstd"}
    config["map"] = None
    config["devices"]["camera"] = None
    config["devices"]["lidar"].setdefault("driver", {})["cluster"] = 3
    rows = [f"{x:.4f},-1.7000,0.00000,1" for x in np.arange(0.0, length + 1e-9, 0.05)]
    (folder / "path.csv").write_text("\n".join(["x,y,yaw,direction", *rows]) + "\n")
    target = folder / "truck.yaml"
    target.write_text(yaml.safe_dump(config, sort_keys=False), encoding="utf-8")
    return target


def record(name: str, target: Path) -> None:
    """Drive the run ``name`` and leave its log at ``target``."""
    source, length = RUNS[name]
    with tempfile.TemporaryDirectory(prefix="replay-") as scratch:
        config = short_config(ROOT / "configs" / source, Path(scratch), length)
        summary = run_fast_demo(config, Path(scratch) / "run", seed=1)
        (log,) = (file for file in summary.files if file.suffix == ".mcap")
        shutil.copy(log, target)


def main() -> None:
    """Write all logs."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    for name in RUNS:
        log = FOLDER / f"{name}.mcap"
        record(name, log)
        summary = info(log)
        print(log, f"{log.stat().st_size / 1e3:.0f} kB, {summary['duration']:.1f} s, {summary['messages']} messages")


if __name__ == "__main__":
    main()
