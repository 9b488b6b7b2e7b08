"""Robots that can be bought today (docs/robots-of-today.md), each whole and at its top speed, on the virtual clock.

    python benchmarks/robots.py [--robots turtle ...] [--parts lap goals explore faults] [--goals 8] [--faults 500]

``lap``: a lap of the circuit while it maps: distance from the path by the world's truth, and the map's walls against
the world's. ``goals``: places drawn along the circuit, each 2.5 to 4 m further, among two people who walk, on a map
that grows. ``explore``: from nothing to a whole map, and home. ``faults``: a drill of families of faults
(benchmarks/drill.py), driven at random. The ``donkeycar``, without a lidar, has faults alone.

Results are kept in ``runs/benchmarks/robots.json``, part by part, so that the parts can run one by one. Only what was
run is in the figures; a goal of a part that was not run is not met.
"""

import argparse
import contextlib
import json
import logging
import math
import sys
from collections.abc import Awaitable, Callable
from typing import Any, Final

import numpy as np

from benchmarks import ROOT
from benchmarks.scoring import distance, map_error, rms
from benchmarks.virtual_runs import goal_end
from monstertruck_planners.collision import DistanceField
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import RequestRefusedError
from monstertruck_runtime.mailbox import fifo, latest
from monstertruck_runtime.map_files import FREE, OCCUPIED
from monstertruck_schemas import topics
from monstertruck_schemas.plan import ExplorationState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import ExploreOrder
from monstertruck_schemas.state import Grid
from monstertruck_sim.world.built_in import BUILT_IN, CIRCUIT, lap
from monstertruck_sim.world.scene import MOVING
from monstertruckd.config.load import load_config
from monstertruckd.tools.drill.campaign import Campaign
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.operator import LocalOperator, drive_lap
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

KEPT: Final = ROOT / "runs" / "benchmarks" / "robots.json"
MAPPING: Final = ("turtle", "truck_today", "f1tenth")
"""Robots with a lidar."""
ROBOTS: Final = (*MAPPING, "donkeycar")
PARTS: Final = ("lap", "goals", "explore", "faults")
CROSS_TRACK: Final = 0.02
"""Goal of the RMS distance from the path, as a share of what the robot drives in a second."""
MAP_ERROR: Final = 0.05
"""Goal of the mean distance of the map's walls from the world's, m."""
KNOWN: Final = 0.99
"""Goal of the share of the circuit's ground that exploring makes known."""
HOME: Final = 0.25
"""Goal of the distance between start and end of an exploration, m."""
FAULTS: Final = 500
PEOPLE: Final = (
    {"waypoints": [{"x": 5.0, "y": -1.5}, {"x": 5.0, "y": 1.5}], "speed": 0.6, "before": "stop"},
    {"waypoints": [{"x": -2.0, "y": 3.2}, {"x": 1.5, "y": 3.2}], "speed": 0.5, "before": "turn"},
)
PLAIN: Final[dict[str, Any]] = {
    "recorder": None,
    "blackbox": None,
    "placement": {"planner": "loop", "local_planner": "loop", "explorer": "loop"},
}

Story = Callable[[VirtualRig, LocalOperator], Awaitable[dict[str, Any]]]


def parts_of(robot: str) -> tuple[str, ...]:
    """Parts that a robot's sensors allow."""
    return PARTS if robot in MAPPING else ("faults",)


def configured(name: str, **overlay: Any) -> SimulatedTruckConfig:
    """A robot of configs/robots, without what the benchmark does not need."""
    config = load_config(ROOT / "configs" / "robots" / f"{name}.yaml", SimulatedTruckConfig)[0]
    plain = PLAIN if config.slam is None else PLAIN | {"slam": {"save": None}}
    return with_overlay(with_overlay(config, plain), overlay)


def driven(config: SimulatedTruckConfig, story: Story) -> dict[str, Any]:
    """Run a story on a robot; return its result, the truth and the latest map."""

    async def main(clock: VirtualClock) -> dict[str, Any]:
        rig = VirtualRig(config, clock)
        with rig.bus.subscribe(topics.MAP, latest()) as grid:
            async with rig.running():
                await clock.sleep(2.0)
                result = await story(rig, LocalOperator(rig.daemon, clock))
            return result | {"truth": rig.truth.array(), "grid": grid.latest, "contacts": own_contacts(rig)}

    return run_virtual(main, start=SECOND)


def own_contacts(rig: VirtualRig) -> int:
    """Return how often the robot moved into a person or a wall."""
    stuck = rig.truth.array()[:, 5] > 0
    walls_met = int((stuck[1:] & ~stuck[:-1]).sum())
    met = (one.speed if one.mover == rig.config.robot else one.other_speed for one in rig.world.scene.contacts)
    return walls_met + sum(speed > MOVING for speed in met)


def walls(grid: Grid | None) -> dict[str, float]:
    """Return the map's error against the circuit."""
    if grid is None:
        return {"wall_mean_m": math.inf, "wall_p95_m": math.inf}
    world = BUILT_IN["circuit"]().map
    truth = DistanceField(world.cells == OCCUPIED, world.resolution, (*world.origin[:2], 0.0))
    cells = grid.cells.reshape(grid.height, grid.width)
    return map_error(cells, (grid.origin.x, grid.origin.y), grid.resolution, truth)


# The parts; each returns what is kept of it


def lap_of(name: str) -> dict[str, Any]:
    """Drive a lap of the circuit while mapping."""
    path = {"file": ROOT / "configs" / "paths" / "circuit.csv", "closed": True}
    config = configured(name, path=path, slam={"map_period": 2.0})

    async def story(rig: VirtualRig, operator: LocalOperator) -> dict[str, Any]:
        drive = await drive_lap(operator, rig.clock, limit=120.0)
        await rig.clock.sleep(3.0)
        return {"outcome": drive.outcome.value, "seconds": round(drive.seconds, 2), "stops": len(drive.stops)}

    run = driven(config, story)
    truth, grid = run.pop("truth"), run.pop("grid")
    moving = truth[np.abs(truth[:, 4]) > config.gate.standstill]
    away = distance(moving[:, 1:3], lap(CIRCUIT)[:, :2])
    figures = {"cross_track_m": rms(away), "cross_track_max_m": float(away.max())}
    figures |= {"fastest_m_s": float(truth[:, 4].max()), "allowed_m": CROSS_TRACK * config.gate.speed} | walls(grid)
    return run | {key: round(value, 4) for key, value in figures.items()}


def goals_of(name: str, count: int, seed: int = 1) -> dict[str, Any]:
    """Drive to places along the circuit, each within sight of the last one, among people."""
    config = configured(name, sim={"world": {"people": list(PEOPLE)}})
    rng = np.random.default_rng([seed, count])
    line = lap(CIRCUIT)
    drawn = np.cumsum(rng.integers(50, 80, count)) % len(line)  # points of 0.05 m: 2.5 to 4 m from place to place
    places = [(*(line[k, :2] + rng.uniform(-0.3, 0.3, 2)), line[k, 2]) for k in drawn]

    async def story(rig: VirtualRig, operator: LocalOperator) -> dict[str, Any]:
        outcomes: list[str] = []
        off: list[float] = []
        refusals: list[str] = []
        for x, y, yaw in places:
            outcome = await to_goal(rig, operator, float(x), float(y), float(yaw), refusals)
            truth = rig.world.truth(rig.clock.now())
            outcomes.append(outcome)
            off.append(math.dist((truth.x, truth.y), (x, y)))
        return {"outcomes": outcomes, "off_m": [round(value, 3) for value in off], "refusals": refusals}

    run = driven(config, story)
    truth, grid = run.pop("truth"), run.pop("grid")
    reached = sum(one == Reason.GOAL_REACHED.value for one in run["outcomes"])
    figures = {"fastest_m_s": float(truth[:, 4].max()), "seconds": float(truth[-1, 0] - truth[0, 0])} | walls(grid)
    return run | {"goals": count, "reached": reached} | {key: round(value, 4) for key, value in figures.items()}


async def to_goal(rig: VirtualRig, operator: LocalOperator, x: float, y: float, yaw: float, refusals: list[str]) -> str:
    """Drive to a place, retried after refusals, armed again after stops that disarm; return the outcome."""
    clock = rig.clock
    with rig.bus.subscribe(topics.GOAL, fifo(4096)) as states, rig.bus.subscribe(topics.GATE, latest()) as gate:
        request = {"frame": "map", "goal": {"x": x, "y": y, "yaw": yaw}, "waypoints": []}
        try:
            async with clock.deadline(240.0):
                while True:
                    try:
                        await operator.arm()
                        number = int((await operator.call("goal", {**await operator.header(), **request}))["number"])
                        return await goal_end(number, operator, states, gate)
                    except RequestRefusedError as refused:
                        if refusals[-1:] != [refused.refusal.value]:
                            refusals.append(refused.refusal.value)
                        await clock.sleep(1.0)
        except TimeoutError:
            return "late"


def exploration_of(name: str) -> dict[str, Any]:
    """Explore without a map, and drive home."""
    config = configured(name, slam={"map_period": 2.0})

    async def story(rig: VirtualRig, operator: LocalOperator) -> dict[str, Any]:
        clock = rig.clock
        with rig.bus.subscribe(topics.EXPLORE, latest()) as states:
            await operator.arm()
            order = {"order": ExploreOrder.START, "home": True, "budget": 600.0}
            await operator.call("explore", {**await operator.header(), **order})
            state: ExplorationState | None = None
            with contextlib.suppress(TimeoutError):
                async with clock.deadline(900.0):
                    while (state := states.latest) is None or not state.number or state.running:
                        await clock.sleep(0.5)
            await clock.sleep(3.0)
        return {"outcome": "late" if state is None or state.running else str(state.outcome.value)}

    run = driven(config, story)
    truth, grid = run.pop("truth"), run.pop("grid")
    figures = {
        "known_share": known_share(grid),
        "home_m": math.dist(truth[-1, 1:3], truth[0, 1:3]),
        "driven_m": float(np.hypot(*np.diff(truth[:, 1:3], axis=0).T).sum()),
        "seconds": float(truth[-1, 0] - truth[0, 0]),
        "fastest_m_s": float(truth[:, 4].max()),
    } | walls(grid)
    return run | {key: round(value, 4) for key, value in figures.items()}


def known_share(grid: Grid | None) -> float:
    """Return the known share of the circuit's ground near its lap."""
    if grid is None:
        return 0.0
    world = BUILT_IN["circuit"]().map
    rows, columns = np.nonzero(world.cells == FREE)
    middles = (np.column_stack((columns, rows)) + 0.5) * world.resolution + world.origin[:2]
    place = np.floor((middles - (grid.origin.x, grid.origin.y)) / grid.resolution).astype(int)
    inside = (place >= 0).all(axis=1) & (place < (grid.width, grid.height)).all(axis=1)
    cells = grid.cells.reshape(grid.height, grid.width)
    known = cells[place[inside, 1], place[inside, 0]] >= 0
    return float(known.sum() / len(middles))


def faults_of(name: str, count: int) -> dict[str, Any]:
    """Run a drill of fault families."""
    report = Campaign(1, count, configured(name)).run(jobs=1)
    figures = report.figures()
    return {key: figures[key] for key in ("trials", "unsafe", "contacts", "stuck", "recovery_p99_s")}


# Goals


def figures_of(kept: dict[str, Any], robots: tuple[str, ...]) -> dict[str, Any]:
    """Return the figures as a flat mapping."""
    return {
        f"{robot}_{part}_{key}": value
        for robot in robots
        for part in parts_of(robot)
        for key, value in kept.get(robot, {}).get(part, {}).items()
        if not isinstance(value, list)
    }


def shortcomings(robot: str, part: str, run: dict[str, Any] | None) -> list[str]:
    """Return why a part does not meet its goal."""
    if run is None:
        return ["not run"]
    wanted: list[tuple[str, bool]] = [(f"{run['contacts']} contacts", run["contacts"] == 0)]
    match part:
        case "lap":
            allowed = run["allowed_m"]
            wanted += [
                (run["outcome"], run["outcome"] == Reason.GOAL_REACHED.value),
                (f"{run['cross_track_m']} m from the path, allowed {allowed}", run["cross_track_m"] <= allowed),
                (f"walls {run['wall_mean_m']} m off", run["wall_mean_m"] <= MAP_ERROR),
            ]
        case "goals":
            wanted += [(f"{run['reached']} of {run['goals']} goals", run["reached"] == run["goals"])]
        case "explore":
            wanted += [
                (run["outcome"], run["outcome"] == Reason.EXPLORED.value),
                (f"knows {run['known_share']}", run["known_share"] >= KNOWN),
                (f"{run['home_m']} m from its start", run["home_m"] <= HOME),
                (f"walls {run['wall_mean_m']} m off", run["wall_mean_m"] <= MAP_ERROR),
            ]
        case "faults":
            wanted += [
                (f"{run['trials']} faults of {FAULTS}", run["trials"] >= FAULTS),
                (f"{run['unsafe']} unsafe", run["unsafe"] == 0),
                (f"{run['stuck']} stuck", run["stuck"] == 0),
            ]
    return [text for text, met in wanted if not met]


def main() -> int:
    """Run the selected parts; 0: all goals are met."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", nargs="+", choices=ROBOTS, default=ROBOTS)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--goals", type=int, default=8)
    parser.add_argument("--faults", type=int, default=FAULTS)
    arguments = parser.parse_args()
    logging.disable(logging.CRITICAL)
    kept: dict[str, Any] = json.loads(KEPT.read_text(encoding="utf-8")) if KEPT.exists() else {}
    parts: dict[str, Callable[[str], dict[str, Any]]] = {
        "lap": lap_of,
        "goals": lambda robot: goals_of(robot, arguments.goals),
        "explore": exploration_of,
        "faults": lambda robot: faults_of(robot, arguments.faults),
    }
    for robot in arguments.robots:
        for part in (one for one in parts_of(robot) if one in arguments.parts):
            run = parts[part](robot)
            kept.setdefault(robot, {})[part] = run
            print(robot, part, json.dumps(run), flush=True)
            KEPT.parent.mkdir(parents=True, exist_ok=True)
            KEPT.write_text(json.dumps(kept, indent=1), encoding="utf-8")
    missed = [
        f"{robot} {part}: {text}"
        for robot in ROBOTS
        for part in parts_of(robot)
        for text in shortcomings(robot, part, kept.get(robot, {}).get(part))
    ]
    for text in missed:
        print(text)
    goals = {"cross_track_share": CROSS_TRACK, "map_error_m": MAP_ERROR, "known_share": KNOWN, "faults": FAULTS}
    goals |= {"unsafe": 0, "contacts": 0}
    met = not missed
    print(json.dumps({"bench": "robots", "figures": figures_of(kept, ROBOTS), "goals": goals, "met": met}))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
