"""Exploration: metres until 90, 95 and 99 % of the reachable area are known, against peers, in a light harness.

The grid, the exploring step and the route planner are the daemon's; the robot is where its route says. All runs of a
world and seed start at the same pose. Peers: `nearest` and `author` (kinds of the catalog), and `offline`, a tour by
somebody who knows the world. Reachable: what the footprint can cover, flood-filled by its inscribed circle. The last
line is JSON.

    python benchmarks/exploration.py [--part NAME ...] [--maps FOLDER] [--seeds N] [--reach 5.6 4] [--worlds NAME ...]
        [--kinds NAME ...] [--faults NAME ...] [--resume]

Parts: `metres`, 5 seeds; `costs`: frontiers of a map of 1000 x 1000 cells with one changed tile, and a decision on it;
`daemon`: the whole daemon in the worlds of this repository, 2 seeds; `faults`: what goes wrong meanwhile, 20 seeds, see
`exploration_parts/faults.py`.

FOLDER has map_server files (stdr_simple_rooms, nav2_depot, stdr_hospital_section, movingai_berlin_0_256); without it
the worlds of this repository are explored. `--worlds` takes the names of other files, too, and those of worlds that are
generated: office3, maze1, hall2 (any number). Rows go to runs/exploration/PART.jsonl; with --resume those there count.
"""

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks import ROOT
from benchmarks.exploration_parts import daemon, faults
from benchmarks.exploration_parts.arena import Arena
from benchmarks.exploration_parts.generated import generated
from benchmarks.exploration_parts.offline import offline_tour
from benchmarks.exploration_parts.rover import SHARES, Rover, Run
from monstertruck_planners.collision import Footprint
from monstertruck_planners.explore.catalog import EXPLORERS
from monstertruck_planners.explore.config import ExplorerConfig, InformationConfig
from monstertruck_planners.explore.exchange import ExploreSetup, ExploreTask
from monstertruck_planners.explore.explore_step import ExploringStep, warm_up
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.state import Grid

WORLDS: Final = {
    "simple_rooms": "stdr_simple_rooms",
    "depot": "nav2_depot",
    "hospital": "stdr_hospital_section",
    "berlin": "movingai_berlin_0_256",
}
SHIPPED: Final = ("rooms", "corridor_maze", "loop", "yard")
OURS, PEERS = "information", ("nearest", "author")
SHORTER = "nearest", "offline"
"""The aim is to be no longer than the shorter one of these."""
OUT = ROOT / "runs" / "exploration"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--part", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--maps", type=Path)
    parser.add_argument("--seeds", type=int, help="instead of each part's own number")
    parser.add_argument("--reach", type=float, nargs="+", default=[5.6, 4.0])
    parser.add_argument("--worlds", nargs="+")
    parser.add_argument("--kinds", nargs="+", default=[OURS, *PEERS, "offline"])
    parser.add_argument("--faults", nargs="+", choices=faults.FAULTS, default=faults.FAULTS)
    parser.add_argument("--resume", action="store_true")
    arguments = parser.parse_args()
    OUT.mkdir(parents=True, exist_ok=True)
    figures: dict[str, float] = {}
    goals: dict[str, float] = {}
    for part in arguments.part:
        found, asked = PARTS[part](arguments)
        figures |= found
        goals |= asked
    met = all(figures[name] <= goal for name, goal in goals.items() if name in figures)
    print(json.dumps({"bench": "exploration", "figures": figures, "goals": goals, "met": met}))
    return 0 if met else 1


class Rows:
    """Result rows of a part, each written immediately.

    Args:
        part: name of the file.
        keep: whether to keep the rows of an earlier run.
    """

    def __init__(self, part: str, *, keep: bool) -> None:
        self._file = OUT / f"{part}.jsonl"
        self.all: list[dict[str, Any]] = []
        if keep and self._file.exists():
            self.all = [json.loads(line) for line in self._file.read_text().splitlines()]
        else:
            self._file.write_text("")

    def has(self, **key: Any) -> bool:
        """Whether a row with these values exists."""
        return any(key.items() <= row.items() for row in self.all)

    def add(self, row: dict[str, Any]) -> None:
        """Print and write a row."""
        self.all.append(row)
        print(json.dumps(row), flush=True)
        with self._file.open("a") as out:
            out.write(json.dumps(row) + "\n")


def metres(arguments: argparse.Namespace) -> tuple[dict[str, float], dict[str, float]]:
    """Run all explorations in the light harness."""
    worlds = arguments.worlds or list(WORLDS if arguments.maps is not None else SHIPPED)
    rows = Rows("metres", keep=arguments.resume)
    warm_up()
    for seed in range(arguments.seeds or 5):
        for reach in arguments.reach:
            for world in worlds:
                arena = generated(world) or Arena.load(world, file_of(world, arguments.maps))
                for kind in arguments.kinds:
                    if not rows.has(world=world, kind=kind, seed=seed, reach=reach):
                        rows.add(row_of(run_of(arena, kind, reach, seed)))
    return summary([row for row in rows.all if row["world"] in worlds])


def faulty(arguments: argparse.Namespace) -> tuple[dict[str, float], dict[str, float]]:
    """Explore with the whole daemon and faults."""
    rows = Rows("faults", keep=arguments.resume)
    for seed in range(arguments.seeds or 20):
        for fault in arguments.faults:
            if not rows.has(fault=fault, seed=seed):
                rows.add(faults.explored(seed, fault))
    return faults.summary(rows.all)


def whole(arguments: argparse.Namespace) -> tuple[dict[str, float], dict[str, float]]:
    """Explore with the whole daemon."""
    rows = Rows("daemon", keep=arguments.resume)
    for seed in range(arguments.seeds or 2):
        for reach in arguments.reach:
            for world in [world for world in arguments.worlds or SHIPPED if world in SHIPPED]:
                if not rows.has(world=world, seed=seed, reach=reach):
                    rows.add(daemon.explored(world, seed, reach))
    return daemon.summary(rows.all)


def file_of(world: str, maps: Path | None) -> Path:
    """Return the file of a world, by the world's name or a file name in the folder."""
    if maps is None or world in SHIPPED:
        return ROOT / "configs" / "worlds" / f"{world}.yaml"
    return maps / f"{WORLDS.get(world, world)}.yaml"


def run_of(arena: Arena, kind: str, reach: float, seed: int) -> Run:
    """Run one exploration."""
    if kind == "offline":
        return offline_tour(arena, reach, seed)
    config = EXPLORERS[kind].settings_class().model_validate({"reach": reach})
    assert isinstance(config, ExplorerConfig)
    return Rover(arena, config, seed).explore()


def row_of(run: Run) -> dict[str, Any]:
    """Return the saved values of a run."""
    return {
        "world": run.world, "kind": run.kind, "seed": run.seed, "reach": run.reach,
        "metres": {f"{share:.0%}": round(run.metres[share], 2) for share in SHARES if share in run.metres},
        "covered": round(run.covered, 5), "driven": round(run.driven, 1), "collisions": run.collisions,
        "goals": run.goals, "failures": run.failures, "home": round(run.home, 3),
        "decision_p99_ms": round(1e3 * float(np.percentile(run.decisions, 99)), 1) if run.decisions else 0.0,
        "update_p99_ms": round(1e3 * float(np.percentile(run.updates, 99)), 2) if run.updates else 0.0,
        "cpu_s": round(run.seconds, 1),
    }  # fmt: skip


def summary(rows: list[dict[str, Any]]) -> tuple[dict[str, float], dict[str, float]]:
    """Return the means of each world, range and kind, with their goals."""
    figures: dict[str, float] = {}
    goals: dict[str, float] = {}
    for world, reach in sorted({(row["world"], row["reach"]) for row in rows}):
        here = [row for row in rows if (row["world"], row["reach"]) == (world, reach)]
        means: dict[tuple[str, str], float] = {}
        for kind in sorted({row["kind"] for row in here}):
            of = [row for row in here if row["kind"] == kind]
            for share in (f"{share:.0%}" for share in SHARES):
                values = [row["metres"].get(share, np.inf) for row in of]
                means[kind, share] = float(np.mean(values))
                figures[f"{world}_{reach:g}_{kind}_{share}_m"] = round(min(means[kind, share], 1e6), 1)
        for (kind, share), mean in means.items():
            if kind in PEERS and (OURS, share) in means:
                name = f"{world}_{reach:g}_{share}_over_{kind}"
                figures[name], goals[name] = round(means[OURS, share] / mean, 4), 1.0
        for share in (f"{share:.0%}" for share in SHARES):
            if all((kind, share) in means for kind in (OURS, *SHORTER)):
                name = f"{world}_{reach:g}_{share}_over_shorter"
                shorter = min(means[kind, share] for kind in SHORTER)
                figures[name], goals[name] = round(means[OURS, share] / shorter, 4), 1.0
    ours = [row for row in rows if row["kind"] == OURS]
    figures["runs"] = len(ours)
    figures["not_99"] = sum("99%" not in row["metres"] for row in ours)
    figures["collisions"] = sum(row["collisions"] for row in ours)
    figures["home_max_m"] = max((row["home"] for row in ours), default=0.0)
    figures["run_update_p99_ms"] = max((row["update_p99_ms"] for row in ours), default=0.0)
    figures["run_decision_p99_ms"] = max((row["decision_p99_ms"] for row in ours), default=0.0)
    goals |= {"not_99": 0.0, "collisions": 0.0, "home_max_m": 0.1, "run_decision_p99_ms": 200.0}
    return figures, goals


def costs(_: argparse.Namespace) -> tuple[dict[str, float], dict[str, float]]:
    """Measure the processor time of a changed tile, and of a decision, in a half-known map of 1000 x 1000 cells."""
    rng = np.random.default_rng(5)
    cells = np.full((1000, 1000), -1, np.int8)
    for row in range(0, 1000, 125):
        for column in range(0, 1000, 125):
            if rng.random() < 0.75:
                cells[row : row + 125, column : column + 125] = 0
    cells[::125] = cells[:, ::125] = 100
    for row in range(0, 1000, 125):
        for column in range(0, 1000, 125):
            cells[row, column + 50 : column + 75] = cells[row + 50 : row + 75, column] = 0
    step, pose = ExploringStep(), (3.0, 3.0, 0.0)
    cells[20:100, 20:100] = 0
    whole = message(cells, 0, 0)
    step.step(ExploreTask(pose, whole, (), ExploreSetup(InformationConfig(), Footprint(), 0.47)))
    updates, decisions = [], []
    for k in range(600):
        row, column = (int(v) * 64 for v in rng.integers(0, 15, 2))
        tile = cells[row : row + 64, column : column + 64]
        spot = rng.integers(0, 54, 2)
        tile[spot[0] : spot[0] + 10, spot[1] : spot[1] + 10] = rng.choice([-1, 0, 100])
        begin = time.process_time()
        step.step(ExploreTask(pose, tiles=(message(tile, column, row),)))
        updates.append(time.process_time() - begin)
        if k % 20 == 0:
            begin = time.process_time()
            answer = step.step(ExploreTask(pose, choose=True, home=pose))
            decisions.append(time.process_time() - begin)
    figures = {
        "frontier_update_p99_ms": round(1e3 * float(np.percentile(updates, 99)), 3),
        "decision_1000_p50_ms": round(1e3 * float(np.median(decisions[1:])), 1),
        "decision_1000_max_ms": round(1e3 * max(decisions[1:]), 1),
        "decision_1000_frontiers": float(answer.frontiers),
    }
    return figures, {"frontier_update_p99_ms": 5.0, "decision_1000_max_ms": 200.0}


def message(cells: np.ndarray, column: int, row: int) -> Grid:
    """Return a part of the map."""
    rows, columns = cells.shape
    return Grid(
        stamp=0, received=0, seq=0, frame="map", resolution=0.05, width=columns, height=rows,
        origin=Pose2D(x=column * 0.05, y=row * 0.05, yaw=0.0), cells=np.ascontiguousarray(cells).reshape(-1),
    )  # fmt: skip


PARTS: Final = {"metres": metres, "costs": costs, "daemon": whole, "faults": faulty}


if __name__ == "__main__":
    sys.exit(main())
