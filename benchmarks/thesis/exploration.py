"""5.6 Exploration: metres, time and map of the built-in rooms, ours and the author's scores, two wheels and four.

The light harness of the exploration benchmark: real grid, exploring step and route planner; time is that at 0.2 m/s.
"""

import numpy as np

from benchmarks import scoring
from benchmarks.exploration_parts.arena import Arena
from benchmarks.exploration_parts.rover import SPEED, Rover
from benchmarks.navigation_parts import Options, Part
from benchmarks.navigation_parts.harness import WORLDS
from monstertruck_planners.explore.catalog import EXPLORERS
from monstertruck_planners.explore.config import ExplorerConfig
from monstertruck_planners.explore.explore_step import warm_up
from monstertruckd.tools.figures import new_figure, write_figure

KINDS = ("information", "author")
REACH = 4.0
"""Range of the thesis's lidar, m."""
SEEDS = 2


def run(options: Options) -> Part:
    part = Part()
    warm_up()
    arena = Arena.load("rooms", WORLDS / "rooms.yaml")
    tracks = {}
    for kind in KINDS[:1] if options.quick else KINDS:
        for car in ("4ws",) if options.quick else ("2ws", "4ws"):
            rows = [one(arena, kind, car, seed) for seed in range(1 if options.quick else SEEDS)]
            for key in rows[0][0]:
                part.add(f"{kind}.{car}.{key}", float(np.mean([row[key] for row, _ in rows])))
            tracks[f"{kind} {car}"] = rows[0][1]
            print(f"  {kind} {car}: {rows[0][0]}", flush=True)
    part.goals |= {name: 0 for name in part.figures if name.startswith(KINDS[0]) and name.endswith("collisions")}
    if not options.quick:
        for car in ("2ws", "4ws"):
            ours, theirs = (part.figures[f"{kind}.{car}.metres_95"] for kind in KINDS)
            part.add(f"{car}.ours_over_author_95", ours / theirs, 1.0)
        part.add(
            "ours.4ws_over_2ws_95",
            part.figures[f"{KINDS[0]}.4ws.metres_95"] / part.figures[f"{KINDS[0]}.2ws.metres_95"],
        )
    draw(options, arena, tracks)
    return part


def one(arena: Arena, kind: str, car: str, seed: int) -> tuple[dict[str, float], np.ndarray]:
    config = EXPLORERS[kind].settings_class().model_validate({"reach": REACH})
    assert isinstance(config, ExplorerConfig)
    rover = Rover(arena, config, seed, steering=car)
    done = rover.explore()
    patch = rover.grid.patch()
    error = scoring.map_error(patch.cells, patch.origin, patch.resolution, arena.truth)
    metres = {f"metres_{round(100 * share)}": done.metres.get(share, done.driven) for share in (0.9, 0.95, 0.99)}
    return metres | {
        "driven_m": done.driven, "time_s": done.driven / SPEED, "covered_share": done.covered, "goals": done.goals,
        "failures": done.failures, "collisions": done.collisions, "home_m": min(done.home, 1e6),
        "wall_mean_m": error["wall_mean_m"], "false_free_share": error["false_free_share"],
    }, np.array(done.track)  # fmt: skip


def draw(options: Options, arena: Arena, tracks: dict[str, np.ndarray]) -> None:
    figure = new_figure(12, 5)
    ways, shares = figure.subplots(1, 2)
    rows, columns = arena.blocked.shape
    x, y = arena.origin
    box = (x, x + columns * arena.resolution, y, y + rows * arena.resolution)
    ways.imshow(arena.blocked, origin="lower", extent=box, cmap="Greys", alpha=0.7)
    for name, track in tracks.items():
        ways.plot(track[:, 0], track[:, 1], lw=1)
        shares.plot(track[:, 2], track[:, 3], label=name)
    shares.set_xlabel("metres")
    shares.set_ylabel("share of the reachable area known")
    shares.legend()
    write_figure(figure, options.out / "exploration.png")
