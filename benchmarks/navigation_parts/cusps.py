"""Turns in corridors of 0.80 to 1.0 m, by the whole daemon on the virtual clock: cusps, contacts, final error.

The map's cells are 2.5 cm; planner and manager have their defaults. Where the corridor leaves less room than the gate
keeps by default, its margin is reduced. Errors are those of the true pose, including odometry's, as there is no slam.
"""

import json
import math
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.navigation_parts import Options, Part
from benchmarks.navigation_parts.daemon import CONFIGS, pursue
from monstertruck_runtime.clock import VirtualClock, run_virtual
from monstertruck_runtime.mailbox import fifo
from monstertruck_runtime.map_files import WorldMap, save_map
from monstertruck_schemas import topics
from monstertruck_schemas.reasons import Reason
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

CELL, LENGTH, WALL = 0.025, 5.0, 4
"""Sizes of the map: m, m, and cells."""
WIDTHS = (0.8, 0.85, 0.9, 1.0)
TRACKERS = ("lqr", "mpc")
SEEDS = (1, 2, 3)
NARROW = 0.9
"""Below this width the gate's distances are ``NEAR``, m."""
NEAR = {"obstacle": {"ahead": 0.01, "side_clearance": 0.01}}
CUSPS = 8


def run(options: Options) -> Part:
    widths, seeds = ((0.8, 1.0), SEEDS[:1]) if options.quick else (WIDTHS, SEEDS)
    rows = []
    for width in widths:
        for tracker in TRACKERS:
            for seed in seeds:
                rows.append(row := turn_round(width, tracker, seed))
                what = f"{row['outcome']}, {row['away']:.3f} m {row['turned']:.3f} rad off"
                more = f"{row['cusps']} cusps, {row['routes']} routes, {row['elapsed']:.0f} s"
                print(f"{width:g} m {tracker} {seed}: {what}, {more}{', contact' * row['contact']}", flush=True)
    part = Part()
    part.add("runs", len(rows))
    part.add("not_reached", sum(row["outcome"] != Reason.GOAL_REACHED.value for row in rows), 0)
    part.add("contacts", sum(row["contact"] for row in rows), 0)
    part.add("cusps", max(row["cusps"] for row in rows), CUSPS)
    part.add("away_max_m", max(row["away"] for row in rows), 0.03)
    part.add("turned_max_rad", max(row["turned"] for row in rows), 0.1)
    part.add("routes_max", max(row["routes"] for row in rows))
    part.add("recoveries", sum(row["recoveries"] for row in rows))
    (options.out / "cusps.json").write_text(json.dumps(rows, indent=1))
    return part


def turn_round(width: float, tracker: str, seed: int) -> dict[str, Any]:
    """One run."""
    x, y = LENGTH / 2, width / 2 + WALL * CELL
    row: dict[str, Any] = {"width": width, "tracker": tracker, "seed": seed}
    start = {"x": x, "y": y, "yaw": 0.0}
    with tempfile.TemporaryDirectory() as folder:
        file = corridor(width, Path(folder))
        overlay = {
            "recorder": None,
            "blackbox": None,
            "planner": {"map": file, "local_planner": None},
            "odometry": {"start": start},
            "sim": {"seed": seed, "world": {"map": str(file), "start": start}},
            "tracker": {"kind": tracker},
            "gate": NEAR if width < NARROW else {},
            "placement": {"planner": "loop", "local_planner": "loop", "tracker": "loop"},
        }
        config = with_overlay(load_config(CONFIGS / "goals.yaml", SimulatedTruckConfig)[0], overlay)

        async def main(clock: VirtualClock) -> None:
            rig = VirtualRig(config, clock)
            paths = rig.bus.subscribe(topics.PATH, fifo(64))
            async with rig.running():
                await clock.sleep(3.0)
                state = await pursue(rig, clock, (x, y, math.pi), surprise=False)
            true = rig.truth.array()
            row.update(
                outcome=state.outcome.value, routes=state.routes, recoveries=state.recoveries, elapsed=state.elapsed,
                contact=bool(true[:, 5].any()), away=math.dist(true[-1, 1:3], (x, y)),
                turned=abs(math.remainder(true[-1, 3] - math.pi, math.tau)),
                cusps=max((int(np.count_nonzero(np.diff(path.directions))) for path in paths.drain()), default=0),
            )  # fmt: skip

        run_virtual(main)
    return row


def corridor(width: float, folder: Path) -> Path:
    """Map file of a corridor whose free cells begin at (``WALL * CELL``, ``WALL * CELL``)."""
    cells = np.full((round(width / CELL) + 2 * WALL, round(LENGTH / CELL) + 2 * WALL), 100, np.int8)
    cells[WALL:-WALL, WALL:-WALL] = 0
    file = folder / "corridor.yaml"
    save_map(WorldMap(cells, CELL, (0.0, 0.0)), file)
    return file
