"""The whole daemon on the virtual clock: random goals in the rooms, each driven twice, with equal decisions.

Devices are emulated byte for byte; planner, deformer and tracker run in the loop. Every other run puts a post onto the
route while the truck drives, at the first place ahead where ``ROOM`` remains free beside it. Errors are those of the
true pose, including odometry's, as there is no slam. Further goals are driven once without a post: a deformed route is
unjustified there.
"""

import asyncio
import hashlib
import json
import math
from typing import Any

import numpy as np

from benchmarks import ROOT
from benchmarks.navigation_parts import Options, Part
from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.collision import OCCUPIED, DistanceField, Footprint
from monstertruck_planners.route.api import RouteMap, Vehicle
from monstertruck_planners.route.config import HybridConfig
from monstertruck_planners.route.hybrid import HybridPlanner
from monstertruck_runtime.clock import VirtualClock, run_virtual
from monstertruck_runtime.errors import RequestRefusedError
from monstertruck_runtime.mailbox import fifo
from monstertruck_runtime.map_files import load_map
from monstertruck_schemas import topics
from monstertruck_schemas.plan import GoalPhase, GoalState
from monstertruck_schemas.reasons import Reason
from monstertruck_sim.world.obstacles import Disc
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

CONFIGS = ROOT / "configs"
RUNS, FURTHER = 40, 40
LIMIT = 700.0
POST = 0.1
"""Radius, m."""
GAP = 0.9
"""From the truck's middle to the post, m."""
IN_THE_LOOP: dict[str, Any] = {
    "recorder": None,
    "blackbox": None,
    "placement": {"planner": "loop", "local_planner": "loop", "tracker": "loop"},
}

ROOM = 0.06
"""Kept free on both sides of the truck on some way round the post, m."""
STEP = 0.1
"""Between two places tried for the post, m."""

Goal = tuple[float, float, float]


def run(options: Options) -> Part:
    world = load_map(CONFIGS / "worlds" / "rooms.yaml")
    truth = DistanceField((world.cells >= OCCUPIED) | (world.cells < 0), world.resolution, (*world.origin, 0.0))
    rows = []
    twice, once = (2, 2) if options.quick else (RUNS, FURTHER)
    for number in range(twice + once):
        rng = np.random.default_rng([2, number])
        goal = random_goal(truth, np.array(world.origin), np.array(world.size), rng)
        surprise = number < twice and number % 2 == 1
        row = drive(goal, number, surprise=surprise)
        row["equal"] = number >= twice or row["digest"] == drive(goal, number, surprise=surprise)["digest"]
        rows.append(row)
        print(f"{number:3} {np.round(goal, 2)} {reported(row)}", flush=True)
    part = Part()
    possible = [row for row in rows if row["outcome"] != Reason.GOAL_UNREACHABLE.value or row["routes"]]
    reached = [row for row in possible if row["reached"]]
    part.add("runs", len(rows))
    part.add("not_reached_share", 1.0 - len(reached) / max(len(possible), 1), 0.02)
    part.add("collisions", sum(row["collided"] for row in rows), 0)
    part.add("unequal_decisions", sum(not row["equal"] for row in rows), 0)
    for name, unit in (("away", "m"), ("turned", "rad")):
        values = np.array([row[name] for row in reached] or [math.inf])
        part.add(f"{name}_p50_{unit}", float(np.median(values)))
        part.add(f"{name}_p95_{unit}", float(np.percentile(values, 95)))
        part.add(f"{name}_max_{unit}", float(values.max()), 0.2)
    part.add("deformed_runs", sum(row["deformed"] for row in rows))
    part.add("runs_with_nothing_there", sum(not row["surprise"] for row in rows))
    part.add("deformed_with_nothing_there", sum(row["deformed"] and not row["surprise"] for row in rows), 0)
    part.add("recoveries", sum(row["recoveries"] for row in rows))
    (options.out / "daemon.json").write_text(json.dumps(rows, indent=1))
    return part


def random_goal(truth: DistanceField, low: np.ndarray, size: np.ndarray, rng: np.random.Generator) -> Goal:
    while True:
        pose = np.append(rng.uniform(low, low + size), rng.uniform(-math.pi, math.pi))
        if truth.free(Footprint(), pose[None], 0.08)[0]:
            return float(pose[0]), float(pose[1]), float(pose[2])


def drive(goal: Goal, seed: int, *, surprise: bool, base: str = "goals.yaml", seconds: float = 600.0) -> dict[str, Any]:
    """Run once with the configuration ``base``, for at most this time of driving."""
    config = with_overlay(load_config(CONFIGS / base, SimulatedTruckConfig)[0], IN_THE_LOOP)
    if isinstance(config.planner.route, HybridConfig):
        config = with_overlay(config, {"planner": {"route": {"effort": 8000}}})
    config = with_overlay(config, {"sim": {"seed": seed}, "planner": {"timeout": seconds}})
    row: dict[str, Any] = {"goal": goal, "surprise": surprise}
    digest = hashlib.sha256()

    async def main(clock: VirtualClock) -> None:
        rig = VirtualRig(config, clock)
        events = rig.bus.subscribe(topics.EVENT, fifo(100_000))
        async with rig.running():
            await clock.sleep(3.0)
            state = await pursue(rig, clock, goal, surprise=surprise)
        reported = events.drain()
        for event in reported:
            digest.update(f"{event.stamp} {event.source} {event.reason} {event.text}\n".encode())
        true = rig.truth.array()
        x, y, yaw = true[-1, 1:4]
        row.update(
            outcome=state.outcome.value, text=state.text, routes=state.routes, recoveries=state.recoveries,
            elapsed=round(state.elapsed, 2), collided=bool(true[:, 5].any()), away=math.dist((x, y), goal[:2]),
            turned=abs(math.remainder(yaw - goal[2], math.tau)), digest=digest.hexdigest(),
            deformed=any(event.reason is Reason.ROUTE_DEFORMED for event in reported),
        )  # fmt: skip
        row["reached"] = state.outcome is Reason.GOAL_REACHED and row["away"] <= 0.2 and row["turned"] <= 0.2

    run_virtual(main)
    return row


async def pursue(rig: VirtualRig, clock: VirtualClock, goal: Goal, *, surprise: bool) -> GoalState:
    """Send the goal, arm, optionally put a post onto the route, and wait for the end."""
    operator, states = LocalOperator(rig.daemon, clock), rig.bus.subscribe(topics.GOAL, fifo(100_000))
    gate = rig.bus.newest(topics.GATE)
    assert gate is not None
    header = {
        "stamp": clock.now(), "received": clock.now(), "seq": 1, "source": "benchmark", "role": "station", "lease": 1.0,
        "frame": "map", "nonce": gate.nonce, "gate_stamp": gate.stamp,
    }  # fmt: skip
    x, y, yaw = goal
    try:
        await rig.daemon.rpc.call("goal", {**header, "goal": {"x": x, "y": y, "yaw": yaw}})
    except RequestRefusedError:
        return await last(states)
    await operator.arm()
    if surprise:
        stepping = asyncio.create_task(step_in(rig, clock, goal))
    try:
        async with clock.deadline(LIMIT):
            return await last(states)
    finally:
        if surprise:
            stepping.cancel()


async def last(states: Any) -> GoalState:
    async for state in states:
        if state.phase is GoalPhase.IDLE and state.outcome is not Reason.OK:
            return state
    raise AssertionError("the bus was closed")


async def step_in(rig: VirtualRig, clock: VirtualClock, goal: Goal) -> None:
    """Put a post onto the route ahead of the truck after some seconds of driving; never at the goal."""
    await clock.sleep(6.0)
    path = rig.bus.newest(topics.PATH)
    truth = rig.world.truth(clock.now())
    if path is None:
        return
    poses = path.poses.reshape(-1, 3)[:, :2]
    near = int(np.argmin(np.hypot(*(poses - (truth.x, truth.y)).T)))
    travelled = np.cumsum(np.hypot(*np.diff(poses[near:], axis=0).T))
    world, here = load_map(CONFIGS / "worlds" / "rooms.yaml"), (truth.x, truth.y, truth.yaw)
    for place in poses[near + np.searchsorted(travelled, np.arange(GAP, travelled[-1] - GAP, STEP))]:
        if min(math.dist(place, here[:2]), math.dist(place, goal[:2])) > GAP and way_remains(world, place, here, goal):
            rig.world.add(clock.now(), Disc(float(place[0]), float(place[1]), POST))
            return


def way_remains(world: Any, post: np.ndarray, here: Goal, goal: Goal) -> bool:
    """Whether the true map leaves a passage beside a post."""
    rows, columns = np.indices(world.cells.shape)
    x, y = ((v + 0.5) * world.resolution + low for v, low in zip((columns, rows), world.origin, strict=True))
    cells = np.where(np.hypot(x - post[0], y - post[1]) < POST + world.resolution / 2, 100, world.cells)
    ground = RouteMap.from_cells(cells.astype(np.int8), world.resolution, (*world.origin, 0.0))
    vehicle = Vehicle.truck("4ws", geometry=FourWheelSteering(), footprint=Footprint())
    planner = HybridPlanner(vehicle, HybridConfig(margin=ROOM, narrow_margin=ROOM, effort=4000))
    start, end = (vehicle.reference_pose(pose) for pose in (here, goal))
    return planner.plan(ground, start, end).path is not None


def reported(row: dict[str, Any]) -> str:
    what = "reached" if row["reached"] else f"{row['outcome']} ({row['text']})"
    more = ", collided" * row["collided"] + ", decisions differ" * (not row["equal"])
    return f"{what}, {row['away']:.3f} m {row['turned']:.3f} rad, {row['elapsed']:.0f} s{more}"
