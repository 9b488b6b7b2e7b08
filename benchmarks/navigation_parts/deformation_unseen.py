"""Local planners in scenarios not used in development: other dimensions, boxes, doors and people, drawn at random.

Same truck, lidar, follower and tolerance as in the part deformation, without the published planner.
"""

import json
import math

import numpy as np

from benchmarks.navigation_parts import Options, Part
from benchmarks.navigation_parts.deformation import CARS, drive, summary
from benchmarks.navigation_parts.deformation_world import unseen
from monstertruck_planners.local.config import LocalPlannerConfig, RsbandConfig, TebConfig

SEEDS = 8
METHODS: dict[str, LocalPlannerConfig] = {"rsband": RsbandConfig(), "teb": TebConfig()}


def run(options: Options) -> Part:
    part = Part()
    rows = []
    for seed in range(1 if options.quick else SEEDS):
        for scenario in unseen(seed):
            for car in CARS:
                for name, config in METHODS.items():
                    row = drive(scenario, car, config)
                    row |= {"scenario": scenario.name, "seed": seed, "car": car, "method": name}
                    rows.append(row)
                    print(f"{seed} {scenario.name:20} {car} {name:7} {summary(row)}", flush=True)
    cycles = np.concatenate([row.pop("cycles_ms") for row in rows])
    part.add("rows", len(rows))
    part.add("cycle_p99_ms", float(np.percentile(cycles, 99)), 50.0)
    part.add("cycle_max_ms", float(cycles.max()))
    part.add("curvature_violations", sum(row["violations"] for row in rows), 0)
    part.add("contacts", sum(row["contacts"] for row in rows))
    for name in METHODS:
        own = [row for row in rows if row["method"] == name]
        part.add(f"{name}_reached_share", sum(row["reached"] for row in own) / len(own))
        part.add(f"{name}_contacts", sum(row["contacts"] for row in own))
        part.add(f"{name}_least_clearance_m", min(row["clearance_m"] for row in own))
        part.add(f"{name}_time_s", float(np.mean([row["time_s"] for row in own if row["reached"]] or [math.inf])))
    (options.out / "deformation_unseen.json").write_text(json.dumps(rows, indent=1))
    return part
