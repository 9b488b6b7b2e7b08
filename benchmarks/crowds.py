"""Goals among people in the whole daemon: contacts by the robot's own motion, and goals reached.

    python benchmarks/crowds.py [--goals 10] [--seed 1] [--jobs 2] [--worlds rooms hall ...]

In each world six people walk between random places at 0.5 to 1.2 m/s: two stop before others, two turn aside, two turn
aside at a smaller distance. The robot drives to goals drawn from the free ground, on the virtual clock. It is armed
again after stops that disarm it.

A contact counts if the robot moved faster than 1 cm/s; people who walk into a standing robot are counted apart. The
last line is JSON.
"""

import argparse
import json
import math
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any

import numpy as np
from scipy.ndimage import label

from benchmarks import ROOT
from benchmarks.virtual_runs import goal_end
from monstertruck_kinematics.elementary import Array
from monstertruck_planners.collision import DistanceField
from monstertruck_runtime.clock import VirtualClock, run_virtual
from monstertruck_runtime.errors import RequestRefusedError
from monstertruck_runtime.mailbox import fifo, latest
from monstertruck_runtime.map_files import FREE
from monstertruck_schemas import topics
from monstertruck_schemas.reasons import Reason
from monstertruck_sim.world.built_in import BUILT_IN
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

CONFIGS = ROOT / "configs"
WORLDS = ("rooms", "hall", "workshop", "yard")
PEOPLE = 6
ROOM = 0.45
"""Least distance of a goal from walls, m."""
LIMIT = 300.0
"""Simulated seconds of a goal."""
MOVING = 0.01
"""Speed above which a contact is by the robot's own motion, m/s."""
GOALS = {"contacts": 0, "reached": 0.95}


def people(seed: int) -> list[dict[str, Any]]:
    rng = np.random.default_rng([54, seed])
    kinds = ({"before": "stop"}, {"before": "turn"}, {"before": "turn", "distance": 0.4})
    # A person's pace varies by a fifth from leg to leg: 0.5 to 1.2 m/s in all.
    return [{"speed": float(rng.uniform(0.625, 1.0)), **kinds[i % 3]} for i in range(PEOPLE)]


def places(world: str, count: int, seed: int) -> list[tuple[float, float, float]]:
    """Return goals on ground that a person can reach from the start."""
    built = BUILT_IN[world]()
    cells, rng = built.map.cells, np.random.default_rng([55, seed])
    field = DistanceField(cells != FREE, built.map.resolution, (*built.map.origin, 0.0))
    rows, columns = np.indices(cells.shape)
    middles: Array = np.stack((columns, rows), axis=-1).astype(np.float64)
    middles = (middles + 0.5) * built.map.resolution + built.map.origin
    away = field.lookup(middles)
    regions, _ = label(away > 0.3)  # half the width of the robot's narrowest way, m
    x, y, _ = built.start
    start = (np.array((y, x)) - built.map.origin[::-1]) / built.map.resolution
    mine = np.argwhere((away > ROOM) & (regions == regions[tuple(start.astype(int))]))
    chosen = mine[rng.choice(len(mine), count, replace=False)]
    return [(*middles[row, column].tolist(), float(rng.uniform(-math.pi, math.pi))) for row, column in chosen.tolist()]


def trial(world: str, count: int, seed: int) -> dict[str, Any]:
    """Drive to all goals of one world."""
    x, y, yaw = BUILT_IN[world]().start
    start = {"x": x, "y": y, "yaw": yaw}
    config = with_overlay(
        load_config(CONFIGS / "goals.yaml", SimulatedTruckConfig)[0],
        {
            "recorder": None, "blackbox": None,
            "placement": {"planner": "loop", "local_planner": "loop", "tracker": "loop"},
            "planner": {"map": CONFIGS / "worlds" / f"{world}.yaml", "route": {"effort": 8000}},
            "odometry": {"start": start},
            "sim": {"seed": seed, "world": {"map": world, "start": start, "people": people(seed)}},
        },
    )  # fmt: skip
    outcomes: list[str] = []

    async def main(clock: VirtualClock) -> dict[str, Any]:
        rig = VirtualRig(config, clock)
        async with rig.running():
            await clock.sleep(3.0)
            began, operator = clock.now(), LocalOperator(rig.daemon, clock)
            for goal in places(world, count, seed):
                outcomes.append(await to_goal(rig, operator, goal))
                print(world, seed, outcomes[-1], round((clock.now() - began) * 1e-9), flush=True)
            truth = rig.truth.array()
        own = [str(c) for c in rig.world.scene.contacts if (c.speed if c.mover == "truck" else c.other_speed) > MOVING]
        return {
            "world": world, "seed": seed, "goals": count, "outcomes": outcomes,
            "reached": outcomes.count(Reason.GOAL_REACHED.value), "contacts": len(own),
            "into_standing": len(rig.world.scene.contacts) - len(own), "contact_texts": own,
            "stuck": bool(truth[:, 5].any()), "seconds": round((clock.now() - began) * 1e-9),
            "metres": round(float(np.hypot(*np.diff(truth[:, 1:3], axis=0).T).sum()), 1),
        }  # fmt: skip

    return run_virtual(main)


async def to_goal(rig: VirtualRig, operator: LocalOperator, goal: tuple[float, float, float]) -> str:
    """Drive to a goal, armed again after stops that disarm; return the outcome.

    A goal occupied by a person is refused; it is sent again every 5 s.
    """
    clock = rig.clock
    with rig.bus.subscribe(topics.GOAL, fifo(4096)) as states, rig.bus.subscribe(topics.GATE, latest()) as gate:
        if gate.latest is None or not gate.latest.mode.active:
            await operator.arm()
        pose = dict(zip(("x", "y", "yaw"), goal, strict=True))
        try:
            async with clock.deadline(LIMIT):
                number = None
                while number is None:
                    request = {**await operator.header(), "frame": "map", "goal": pose, "waypoints": []}
                    try:
                        number = int((await operator.call("goal", request))["number"])
                    except RequestRefusedError as refused:
                        if refused.refusal is not Reason.GOAL_BLOCKED:
                            return str(refused.refusal.value)
                        await clock.sleep(5.0)
                return await goal_end(number, operator, states, gate)
        except TimeoutError:
            return "late"


def main() -> None:
    """Drive in all worlds and print the sums."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--goals", type=int, default=10, help="in each world")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--worlds", nargs="+", choices=WORLDS, default=WORLDS)
    options = parser.parse_args()
    jobs = [(world, options.goals, options.seed) for world in options.worlds]
    rows: list[dict[str, Any]] = []
    with ProcessPoolExecutor(options.jobs, mp_context=get_context("spawn")) as pool:
        for row in pool.map(trial, *zip(*jobs, strict=True)):
            rows.append(row)
            print(row, flush=True)
    figures = {name: sum(row[name] for row in rows) for name in ("goals", "reached", "contacts", "into_standing")}
    met = figures["reached"] >= GOALS["reached"] * figures["goals"] and not figures["contacts"]
    met = met and set(options.worlds) == set(WORLDS)
    print(json.dumps({"bench": "crowds", "figures": figures, "goals": GOALS, "met": met}))


if __name__ == "__main__":
    main()
