"""The author's own set-up as a baseline: goals in the rooms, whole daemon, ``as-published.yaml`` and ``goals.yaml``.

A* over the grid, rsband (start_to_next) and the fuzzy tracker with their published faults drive to the goals drawn by
the part ``daemon``, without obstacles on the routes. A run ends after ``SECONDS`` of driving at the latest, because the
published tracker may drive to and fro at its goal for ever. Errors are those of the true pose at the end of the run,
whether the goal was reached or not.
"""

import numpy as np

from benchmarks.navigation_parts import Options, Part
from benchmarks.navigation_parts.daemon import CONFIGS, drive, random_goal, reported
from monstertruck_planners.collision import OCCUPIED, DistanceField
from monstertruck_runtime.map_files import load_map

RUNS, QUICK_RUNS = 10, 2
SECONDS = 120.0
BASES = {"published": "as-published.yaml", "ours": "goals.yaml"}


def run(options: Options) -> Part:
    world = load_map(CONFIGS / "worlds" / "rooms.yaml")
    truth = DistanceField((world.cells >= OCCUPIED) | (world.cells < 0), world.resolution, (*world.origin, 0.0))
    rows: dict[str, list] = {name: [] for name in BASES}
    for number in range(QUICK_RUNS if options.quick else RUNS):
        goal = random_goal(truth, np.array(world.origin), np.array(world.size), np.random.default_rng([2, number]))
        for name, base in BASES.items():
            rows[name].append(row := drive(goal, number, surprise=False, base=base, seconds=SECONDS) | {"equal": True})
            print(f"{number:3} {name:10} {np.round(goal, 2)} {reported(row)}", flush=True)
    part = Part()
    for name, found in rows.items():
        part.add(f"{name}.reached_share", sum(row["reached"] for row in found) / len(found))
        part.add(f"{name}.away_median_m", float(np.median([row["away"] for row in found])))
        part.add(f"{name}.elapsed_median_s", float(np.median([row["elapsed"] for row in found])))
        part.add(f"{name}.collisions", sum(row["collided"] for row in found), 0 if name == "ours" else None)
    less = part.figures["published.reached_share"] - part.figures["ours.reached_share"]
    part.add("reached_share_below_published", less, 0.0)
    return part
