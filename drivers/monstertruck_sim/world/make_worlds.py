"""Writes the built-in worlds as map_server files, and the lap of ``loop``: ``python -m ...make_worlds configs``."""

import sys
from pathlib import Path

from monstertruck_runtime.map_files import save_map
from monstertruck_sim.world.built_in import BUILT_IN, lap
from monstertruck_sim.world.terrain import profile_path, save_profile


def make_worlds(out: Path) -> list[Path]:
    """Write ``out``/worlds/NAME.yaml, .png, .profile.yaml and ``out``/paths/loop.csv; returns what was written."""
    worlds, paths = out / "worlds", out / "paths"
    worlds.mkdir(parents=True, exist_ok=True)
    paths.mkdir(parents=True, exist_ok=True)
    written = []
    for name, draw in BUILT_IN.items():
        built, path = draw(), worlds / f"{name}.yaml"
        save_map(built.map, path)
        written += [path, path.with_suffix(".png")]
        if built.profile is not None:
            save_profile(built.profile, profile_path(path))
            written.append(profile_path(path))
    rows = [f"{x:.4f},{y:.4f},{yaw:.5f},1" for x, y, yaw in lap()]
    (paths / "loop.csv").write_text("\n".join(["x,y,yaw,direction", *rows, ""]), encoding="utf-8")
    return [*written, paths / "loop.csv"]


if __name__ == "__main__":
    for path in make_worlds(Path(sys.argv[1] if len(sys.argv) > 1 else "configs")):
        sys.stdout.write(f"{path}\n")
