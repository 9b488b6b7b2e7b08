"""The whole daemon of the robot with sonars in the study's arena, with gate, devices and noise: laps, faults, gains."""

import contextlib
import math
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, NamedTuple

import numpy as np

from benchmarks import ROOT
from benchmarks.virtual_runs import behaviour_run
from benchmarks.wall_parts.arena import Arena, study
from benchmarks.wall_parts.simulation import mirrored
from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import TruckError
from monstertruck_runtime.mailbox import fifo
from monstertruck_runtime.map_files import FREE, OCCUPIED, WorldMap, save_map
from monstertruck_schemas.plan import BehaviourState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import BehaviourOrder
from monstertruck_schemas.topics import BEHAVIOUR
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig
from monstertruckd.tools.tune.recipe import WallGains
from monstertruckd.tools.tune.runs import Tuning, TuningRun, tune

FILE: Final = ROOT / "configs" / "robots" / "sonar.yaml"
CELL: Final = 0.01
"""Cell size of the map, m: walls at a slant are steps of this size."""
LAP: Final = 20.0, 1.0
"""Least length of a lap, and how near its end is to its beginning, m: that of the benchmark."""
LIMIT: Final = 500.0
"""Simulated seconds of a lap."""
SETTLED: Final = 2.0
"""Seconds from the daemon's start to the first order."""


class DaemonLap(NamedTuple):
    """One lap in the whole daemon."""

    outcome: Reason
    text: str
    contact: bool
    seconds: float
    track: Array
    """(n, 5) as ``WallRun.track``."""


def map_of(walls: Array, folder: Path) -> Path:
    """Write a map file of walls, 4 cm thick on the outside."""
    reach = float(np.abs(walls).max()) + 0.5
    size = math.ceil(2 * reach / CELL)
    cells = np.full((size, size), FREE, dtype=np.int8)
    for x0, y0, x1, y1 in walls:
        length = math.hypot(x1 - x0, y1 - y0)
        along, aside = np.array([x1 - x0, y1 - y0]) / length, np.array([-(y1 - y0), x1 - x0]) / length
        ways = np.arange(0.0, length, CELL / 3)
        for off in np.arange(CELL / 2, 0.04, CELL / 3):  # the cells' faces are on the line on average
            places = np.array([x0, y0]) + ways[:, None] * along + off * aside
            columns, rows = np.floor((places + reach) / CELL).astype(int).T
            cells[rows, columns] = OCCUPIED
    file = folder / "arena.yaml"
    save_map(WorldMap(cells, CELL, (-reach, -reach)), file)
    return file


def robot(folder: Path, walls: Array, start: tuple[float, float, float], seed: int, **overlay: Any) -> Any:
    """The robot in an arena."""
    x, y, yaw = start
    config, _ = load_config(FILE, SimulatedTruckConfig)
    place = {"x": x, "y": y, "yaw": yaw}
    world = {"map": str(map_of(walls, folder)), "start": place, "sonar": {"dropout": 0.05}}
    here = {"recorder": None, "odometry": {"start": place}, "sim": {"seed": seed, "world": world}}
    return with_overlay(with_overlay(config, here), overlay)


def lap(behaviour: str, side: str, seed: int, model: str) -> DaemonLap:
    """Drive one lap of the study's arena from its centre.

    Args:
        behaviour: behaviour of sonar.yaml, without the side: ``line``, ``wall``, ``published``, ``switching``.
        side: side of the wall.
        seed: seed of heading and noise.
        model: model of the sonars.
    """
    arena, rng = study(), np.random.default_rng(seed)
    walls = arena.walls if side == "left" else mirrored(arena.walls)[:, [2, 3, 0, 1]]
    x, y = rng.uniform(-0.5, 0.5, 2).tolist()
    start = (x, y, float(rng.uniform(-math.pi, math.pi)))
    name = f"{behaviour}_{side}"
    own = {"lap_length": LAP[0], "lap_radius": LAP[1], **({"beam": model == "beam"} if behaviour == "line" else {})}
    with TemporaryDirectory() as folder:
        overlay = {"behaviours": {name: own}, "sim": {"world": {"sonar": {"model": model}}}}
        config = robot(Path(folder), walls, start, seed, **overlay)
        states, truth = run_virtual(
            lambda clock: behaviour_run(config, name, clock, settle=SETTLED, limit=LIMIT), start=SECOND
        )
    end = states[-1]
    return DaemonLap(end.outcome, end.text, bool(truth[:, 5].any()), end.elapsed, _track(truth, states, side))


def _track(truth: Array, states: list[BehaviourState], side: str) -> Array:
    """Return the truth in the format of ``WallRun.track``."""
    mirror = 1.0 if side == "left" else -1.0
    stamps = np.array([state.stamp / SECOND for state in states])
    found = np.array([state.phase not in ("", "settle", "search", "approach") for state in states])
    place = np.clip(np.searchsorted(stamps, truth[:, 0], side="right") - 1, 0, len(stamps) - 1)
    t, x, y, yaw = truth[:, :4].T
    return np.column_stack([x, mirror * y, mirror * yaw, t, found[place]])


def beside(arena: Arena, way: float = 2.0) -> tuple[float, float, float]:
    """Return the pose of a robot along the first wall, ``way`` m from its start, at the set distance."""
    a, b = arena.corners[:2]
    along = (b - a) / np.linalg.norm(b - a)
    x, y = a + way * along + 0.35 * np.array([along[1], -along[0]])
    return float(x), float(y), math.atan2(along[1], along[0])


def tuned(
    seed: int, first: float, model: str, report: Callable[[TuningRun], None] = lambda _: None
) -> tuple[WallGains | None, list[TuningRun]]:
    """Run ``monstertruckd tune wall`` to its end on the virtual clock.

    Raises:
        TruckError: it ended early.
    """
    arena, runs = study(), list[TuningRun]()

    def keep(run: TuningRun) -> None:
        runs.append(run)
        report(run)

    async def main(clock: VirtualClock) -> WallGains | None:
        rig = VirtualRig(config, clock)
        async with rig.running():
            operator = LocalOperator(rig.daemon, clock)
            await clock.sleep(SETTLED)
            found = await tune(operator, "wall_left", 0.3, Tuning(first=first), lambda: clock.sleep(1.5), keep)
            assert not rig.truth.array()[:, 5].any(), "the robot touched the wall"
            return found

    with TemporaryDirectory() as folder:
        config = robot(Path(folder), arena.walls, beside(arena), seed, sim={"world": {"sonar": {"model": model}}})
        return run_virtual(main, start=SECOND), runs


class FaultRun(NamedTuple):
    """One robot that follows walls during successive device faults."""

    contact: bool
    metres: float
    starts: int
    ends: Counter[str]
    """Why the behaviour ended or was refused."""


def broken(side: str, seed: int, seconds: float) -> FaultRun:
    """Cause random faults of the robot's catalog, one about every 10 s; restart the behaviour whenever it ends."""
    arena, ends = study(), Counter[str]()
    walls = arena.walls if side == "left" else mirrored(arena.walls)[:, [2, 3, 0, 1]]
    x, y, yaw = beside(arena)
    start = (x, y, yaw) if side == "left" else (x, -y, -yaw)
    starts = 0

    async def main(clock: VirtualClock) -> Array:
        nonlocal starts
        rig = VirtualRig(config, clock)
        with rig.bus.subscribe(BEHAVIOUR, fifo(4096)) as states:
            async with rig.running():
                operator, until = LocalOperator(rig.daemon, clock), clock.now() + round(seconds * SECOND)
                await clock.sleep(SETTLED)
                with contextlib.suppress(TimeoutError):
                    async with clock.deadline(seconds):
                        while clock.now() < until:
                            try:
                                await operator.arm()
                                number = int((await operator.behave(BehaviourOrder.START, f"line_{side}"))["number"])
                            except TruckError as error:
                                ends[str(getattr(error, "refusal", error.reason).value)] += 1
                                await clock.sleep(1.0)
                                continue
                            starts += 1
                            async for state in states:
                                if state.number == number and not state.running:
                                    ends[state.outcome.value] += 1
                                    break
                return rig.truth.array()

    with TemporaryDirectory() as folder:
        config = robot(Path(folder), walls, start, seed, sim={"drill": {"seed": seed, "period": 10.0}})
        truth = run_virtual(main, start=SECOND)
    way = float(np.hypot(*np.diff(truth[:, 1:3], axis=0).T).sum())
    return FaultRun(bool(truth[:, 5].any()), way, starts, ends)
