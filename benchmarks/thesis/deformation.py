"""5.4 Deformation: what the map does not contain stands on the route; ours, teb and the published planner.

The closed loop of the navigation benchmark (kinematic truck, emulated lidar); every method drives every scenario.
"""

from collections.abc import Iterable

import numpy as np
import scoring
from navigation_parts import Options, Part
from navigation_parts.deformation import CARS, drive
from navigation_parts.deformation_world import SCENARIOS

from monstertruck_planners.local.config import PublishedConfig, RsbandConfig, TebConfig

METHODS = {
    "ours": RsbandConfig(strategy="start_to_next"),
    "teb": TebConfig(),
    "published": PublishedConfig(strategy="start_to_next"),
}


def run(options: Options) -> Part:
    part = Part()
    rows = []
    for config in METHODS.values():  # compiles
        drive(SCENARIOS[0], "4ws", config, limit=1.0 if options.quick else 6.0)
    for scenario in SCENARIOS[:1] if options.quick else SCENARIOS:
        for car in CARS[1:] if options.quick else CARS:
            for name, config in METHODS.items():
                row = drive(scenario, car, config, limit=8.0 if options.quick else 60.0)
                rows.append(row | {"method": name, "car": car, "scenario": scenario.name})
                print(f"  {scenario.name:16} {car} {name:10} {row['reached']} {row['clearance_m']:.3f} m", flush=True)
    for name in METHODS:
        for car in CARS:
            own = [row for row in rows if (row["method"], row["car"]) == (name, car)]
            if own:
                add(part, f"{name}.{car}", own)
    if not options.quick:
        part.goals |= {f"ours.{car}.contacts": 0 for car in CARS}
        part.goals |= {f"ours.{car}.curvature_violations": 0 for car in CARS}
    draw(options, rows)
    return part


def add(part: Part, prefix: str, rows: Iterable[dict]) -> None:
    rows = list(rows)
    cycles = scoring.percentiles(np.concatenate([row["cycles_ms"] for row in rows]))
    part.add(f"{prefix}.reached_share", sum(row["reached"] for row in rows) / len(rows))
    part.add(f"{prefix}.contacts", sum(row["contacts"] for row in rows))
    part.add(f"{prefix}.clearance_min_m", min(row["clearance_m"] for row in rows))
    part.add(f"{prefix}.curvature_violations", sum(row["violations"] for row in rows))
    part.add(f"{prefix}.failed_cycles", sum(row["waiting"] for row in rows))
    part.add(f"{prefix}.cycle_p99_ms", cycles["p99_ms"])


def draw(options: Options, rows: list[dict]) -> None:
    from matplotlib.figure import Figure  # noqa: PLC0415

    names = list(dict.fromkeys(row["scenario"] for row in rows))
    figure = Figure(figsize=(11, 2.6 * len(names)), layout="constrained")
    for line, name in zip(figure.subplots(len(names), 2, squeeze=False), names, strict=True):
        for axes, car in zip(line, CARS, strict=True):
            for row in rows:
                if (row["scenario"], row["car"]) == (name, car):
                    axes.plot(*np.array(row["trace"])[:, :2].T, label=row["method"])
            axes.set_title(f"{name}, {car}", fontsize=9)
            axes.set_aspect("equal", "datalim")
    axes.legend(fontsize=7)
    figure.savefig(options.out / "deformation.png", dpi=70)
