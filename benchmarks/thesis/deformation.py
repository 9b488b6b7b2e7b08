"""5.4 Deformation: unmapped obstacles on the route; ours, teb and the published planner.

The closed loop of the navigation benchmark (kinematic truck, emulated lidar); every method drives every scenario.
"""

from collections.abc import Iterable

import numpy as np

from benchmarks import scoring
from benchmarks.navigation_parts import Options, Part
from benchmarks.navigation_parts.deformation import CARS, LIMIT, drive
from benchmarks.navigation_parts.deformation_world import SCENARIOS, SIZE
from monstertruck_planners.local.config import PublishedConfig, RsbandConfig, TebConfig
from monstertruckd.tools.figures import new_figure, write_figure

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
    from matplotlib.patches import Rectangle  # noqa: PLC0415

    scenarios = [scenario for scenario in SCENARIOS if any(row["scenario"] == scenario.name for row in rows)]
    figure = new_figure(11, 3.6 * len(scenarios))
    for line, scenario in zip(figure.subplots(len(scenarios), 2, squeeze=False), scenarios, strict=True):
        for axes, car in zip(line, CARS, strict=True):
            for boxes, colour in ((scenario.known, "0.6"), (scenario.hidden(LIMIT), "tab:red")):
                for x0, y0, x1, y1 in boxes:
                    axes.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, color=colour, lw=0))
            if scenario.person is not None:
                walk = np.array([scenario.person(t) for t in np.arange(0.0, LIMIT, 0.5)])
                axes.plot(*walk.T, color="tab:red", ls=":", label="person")
            for row in rows:
                if (row["scenario"], row["car"]) == (scenario.name, car):
                    end = f"{row['clearance_m']:.2f} m" if row["reached"] else "not arrived"
                    axes.plot(*np.array(row["trace"])[:, :2].T, label=f"{row['method']}, {end}")
            for x, y, yaw in (scenario.start, scenario.goal):
                axes.annotate(
                    "", (x + 0.3 * np.cos(yaw), y + 0.3 * np.sin(yaw)), (x, y), arrowprops={"arrowstyle": "->"}
                )
            axes.set_title(f"{scenario.name}, {car}", fontsize=9)
            axes.set(xlim=(0.0, SIZE[0]), ylim=(0.0, SIZE[1]), aspect="equal")
            axes.legend(fontsize=7, title="least clearance", title_fontsize=7, loc="upper left")
    figure.suptitle("grey: in the map; red: not in the map", fontsize=9)
    write_figure(figure, options.out / "deformation.png")
