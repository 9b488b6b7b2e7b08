"""The whole daemon explores a world on the virtual clock, drives home and saves its map, with emulated devices.

Metres are truly driven; the known area is the part of the coverable area in the published map; the final position is
the truck's true one. Explorer, planner and tracker run in the loop, the mapper in its worker.
"""

import asyncio
import math
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np

from benchmarks import ROOT, scoring
from benchmarks.exploration_parts.arena import Arena
from benchmarks.exploration_parts.rover import SHARES
from monstertruck_estimation.slam.storage import load
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import Pose2
from monstertruck_planners.collision import DistanceField
from monstertruck_planners.explore.frontier import UNKNOWN_CELL, FrontierMap
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.mailbox import fifo, latest
from monstertruck_schemas import topics
from monstertruck_schemas.event import Event
from monstertruck_schemas.plan import ExplorationState
from monstertruck_schemas.req import ExploreOrder
from monstertruck_schemas.state import Grid
from monstertruck_sim.world.obstacles import Box
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

CONFIGS: Final = ROOT / "configs"
OFF: Final = 0.15
"""A wall of a saved map this far from every true one is none, m."""
HOME: Final = 0.1
"""Metres from the start within which the loop is closed."""
BUDGET, LIMIT = 1800.0, 3600.0
"""Seconds of exploring, and until the end."""

Happen = Callable[["ExploringTruck"], Awaitable[None]]


@dataclass
class RunRecord:
    """Record of one exploration."""

    state: ExplorationState
    late: bool
    """It had not ended in time."""
    events: list[Event]
    grids: list[tuple[Grid, bool]]
    """Published maps, True, and tiles."""
    true: Array
    """See ``TruthLog``."""
    start: Pose2
    pose_off: float
    """Metres between where it stands and where it believes to be."""
    off_share: float
    """Share of the saved map's walls that are none."""
    seconds: float
    truck: "ExploringTruck"


class ExploringTruck:
    """An exploring truck.

    Args:
        rig: the truck.
        arena: the world.
        start: start pose.
    """

    def __init__(self, rig: VirtualRig, arena: Arena, start: Pose2) -> None:
        self.rig, self.clock, self.arena, self.start = rig, rig.clock, arena, start
        self.operator = LocalOperator(rig.daemon, rig.clock)
        self.states = rig.bus.subscribe(topics.EXPLORE, latest())
        self.events = rig.bus.subscribe(topics.EVENT, fifo(100_000))
        self.poses = rig.bus.subscribe(topics.POSE, latest())
        self.maps, self.tiles = (rig.bus.subscribe(topic, fifo(100_000)) for topic in (topics.MAP, topics.MAP_TILES))
        self.added: list[Box] = []
        """What was put into the world."""
        self.at = 0.0
        """When something happened, s."""

    @property
    def here(self) -> Pose2:
        """True pose of the truck."""
        truth = self.rig.world.truth(self.clock.now())
        return truth.x, truth.y, truth.yaw

    async def explore(self, budget: float, limit: float, happen: Happen | None) -> dict[str, Any]:
        """Run from arming to the end of the exploration."""
        await self.operator.arm()
        order = {"order": ExploreOrder.START, "home": True, "budget": budget}
        await self.operator.call("explore", {**await self.operator.header(), **order})
        began, late = self.clock.now(), False
        happening = None if happen is None else asyncio.ensure_future(happen(self))
        try:
            async with self.clock.deadline(limit):
                while (state := self.states.latest) is None or not state.number or state.running:
                    await self.clock.sleep(0.5)
        except TimeoutError:
            late, state = True, self.states.latest
        if happening is not None:
            happening.cancel()
            await asyncio.wait([happening])
            if not happening.cancelled():
                happening.result()
        await self.clock.sleep(2.0)
        pose, here = self.poses.latest, self.here
        return {
            "state": state, "late": late, "events": self.events.drain(), "start": self.start, "truck": self,
            "grids": sorted(
                [(grid, True) for grid in self.maps.drain()] + [(tile, False) for tile in self.tiles.drain()],
                key=lambda pair: pair[0].received,
            ),
            "pose_off": math.inf if pose is None else math.dist((pose.pose.x, pose.pose.y), here[:2]),
            "seconds": (self.clock.now() - began) / SECOND,
        }  # fmt: skip


def recorded_run(
    world: str,
    seed: int,
    happen: Happen | None = None,
    *,
    reach: float = 5.6,
    budget: float = BUDGET,
    limit: float = LIMIT,
    **more: Any,
) -> RunRecord:
    """Run one exploration of a world of this repository; it starts as in the light harness.

    Args:
        world: name of the world.
        seed: seed of start and noise.
        happen: event during the run.
        reach: range of the lidar, m; known to mapper and explorer.
        budget: time limit of the exploration, s.
        limit: time limit of the run, s.
        more: further settings of `sim.world`.
    """
    file = CONFIGS / "worlds" / f"{world}.yaml"
    arena = Arena.load(world, file)
    start = arena.start(seed)
    pose = dict(zip(("x", "y", "yaw"), start, strict=True))
    with TemporaryDirectory() as folder:
        overlay: dict[str, Any] = {
            "recorder": None,
            "blackbox": None,
            "placement": {"planner": "loop", "explorer": "loop"},
            "odometry": {"start": pose},
            "slam": {"save": Path(folder) / "map", "grid": {"passed": reach}},
            "explorer": {"reach": reach},
            "sim": {"seed": seed, "world": {"map": str(file), "start": pose, "lidar": {"max_range": reach}, **more}},
        }
        config = with_overlay(load_config(CONFIGS / "explore.yaml", SimulatedTruckConfig)[0], overlay)
        result: dict[str, Any] = {}

        async def main(clock: VirtualClock) -> None:
            rig = VirtualRig(config, clock)
            async with rig.running():
                await clock.sleep(4.0)
                result.update(await ExploringTruck(rig, arena, start).explore(budget, limit, happen))
            result["true"] = rig.truth.array()

        run_virtual(main, start=SECOND)
        result["off_share"] = off_share(Path(folder) / "map", arena, result["truck"].added)
    return RunRecord(**result)


def explored(world: str, seed: int, reach: float) -> dict[str, Any]:
    """Run and judge one exploration."""
    run = recorded_run(world, seed, reach=reach)
    metres, covered = known(run)
    here = run.true[-1, 1:3]
    return {
        "world": world, "seed": seed, "reach": reach, "outcome": str(run.state.outcome), "text": run.state.text,
        "metres": {f"{share:.0%}": round(metres[share], 2) for share in SHARES if share in metres},
        "covered": round(covered, 5), "driven": round(driven(run.true)[-1], 1), "seconds": round(run.seconds),
        "collided": bool(run.true[:, 5].any()), "late": run.late, "home": round(math.dist(here, run.start[:2]), 3),
        "pose_off": round(run.pose_off, 3), "off_share": run.off_share, "goals": run.state.goals,
        "failures": run.state.failures,
    }  # fmt: skip


def driven(true: Array) -> Array:
    """Return the distance travelled at each sample, m."""
    return np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(true[:, 1:3], axis=0).T))))


def known(run: RunRecord) -> tuple[dict[float, float], float]:
    """Return the distance (m) at which each share of the reachable area was known, and the final share."""
    x, y = run.truck.arena.reachable(run.start)
    rest = np.column_stack((x, y))
    count, way, share = len(rest), driven(run.true), 0.0
    metres: dict[float, float] = {}
    grid: FrontierMap | None = None
    for message, whole in run.grids:
        if grid is None:
            grid = FrontierMap(message)
        else:
            grid.put(message, whole=whole)
        column, row = np.floor(rest / grid.resolution).astype(int).T - grid.corner[:, None]
        rows, columns = grid.cells.shape
        inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        value = np.full(len(rest), UNKNOWN_CELL)
        value[inside] = grid.cells[row[inside], column[inside]]
        rest = rest[value == UNKNOWN_CELL]
        share = 1.0 - len(rest) / count
        for wanted in SHARES:
            if share >= wanted:
                metres.setdefault(wanted, float(np.interp(message.received / SECOND, run.true[:, 0], way)))
    return metres, share


def off_share(folder: Path, arena: Arena, added: list[Box]) -> float:
    """Return the share of the saved map's walls that are more than ``OFF`` from the true walls and the added boxes."""
    saved = load(folder).grid
    blocked = arena.blocked.copy()
    origin = np.array(arena.origin)
    for box in added:
        half = np.array((box.length, box.width)) / 2
        low, high = (
            np.floor((np.array((box.x, box.y)) + sign * half - origin) / arena.resolution).astype(int)
            for sign in (-1, 1)
        )
        blocked[low[1] : high[1] + 1, low[0] : high[0] + 1] = True
    truth = DistanceField(blocked, arena.resolution, (*arena.origin, 0.0))
    off = scoring.wall_distances(saved.cells, saved.origin[:2], saved.resolution, truth)
    return round(float((off > OFF).mean()), 4) if len(off) else 1.0


def summary(rows: list[dict[str, Any]]) -> tuple[dict[str, float], dict[str, float]]:
    """Return the means of each world and range, and the violated goals."""
    figures: dict[str, float] = {"daemon_runs": float(len(rows))}
    for world, reach in sorted({(row["world"], row["reach"]) for row in rows}):
        of = [row for row in rows if (row["world"], row["reach"]) == (world, reach)]
        for share in (f"{share:.0%}" for share in SHARES):
            values = [row["metres"].get(share, math.inf) for row in of]
            figures[f"daemon_{world}_{reach:g}_{share}_m"] = round(min(float(np.mean(values)), 1e6), 1)
    figures["daemon_not_99"] = float(sum("99%" not in row["metres"] for row in rows))
    figures["daemon_collisions"] = float(sum(row["collided"] for row in rows))
    figures["daemon_late"] = float(sum(row["late"] for row in rows))
    figures["daemon_home_max_m"] = max((row["home"] for row in rows), default=0.0)
    figures["daemon_off_share_max"] = max((row["off_share"] for row in rows), default=0.0)
    none = dict.fromkeys(("daemon_not_99", "daemon_collisions", "daemon_late"), 0.0)
    return figures, {**none, "daemon_home_max_m": HOME}
