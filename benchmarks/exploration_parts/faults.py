"""Faults while the whole daemon explores the built-in rooms, on the virtual clock, drawn by seed.

- ``kidnap``: it is carried off to another place, and armed again;
- ``door``: the nearest door is shut, of every other seed for ``SHUT`` seconds, else for good;
- ``person``: somebody walks about from the beginning, and stops or turns before the truck;
- ``lidar``: its plug is out for ``UNPLUGGED`` seconds, then the truck is armed again;
- ``battery``: it is changed for one nearly empty when the truck is ``FAR`` from its start.

A run ends safely if it ends in time, touches nothing, and the truck stands. The map is doubled if more than ``DOUBLED``
of its walls are more than ``OFF`` from true ones (a door leaf and posts count as such). It says what it did if its end
has a reason and a text, the map was saved by then, and a reason of the fault was reported.
"""

import asyncio
import math
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
from scipy.ndimage import distance_transform_edt

from exploration_parts.arena import Arena
from monstertruck_estimation.slam.storage import load
from monstertruck_planners.collision import OCCUPIED, Footprint
from monstertruck_planners.goals.exchange import Pose
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import InputError, TruckError
from monstertruck_runtime.mailbox import fifo, latest
from monstertruck_schemas import topics
from monstertruck_schemas.plan import ExplorationState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import ExploreOrder
from monstertruck_sim.world.obstacles import Box
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

CONFIGS: Final = Path(__file__).resolve().parents[2] / "configs"
FAULTS: Final = ("kidnap", "door", "person", "lidar", "battery")
DOORS: Final = ((2.45, 3.1, 0.9, 0.1), (7.65, 3.1, 0.9, 0.1), (3.85, 4.8, 0.9, 0.1), (6.85, 4.8, 0.9, 0.1))
"""Of the rooms: middle, length, width, m."""
BUDGET, LIMIT = 240.0, 600.0
"""Seconds of exploring, and until the end."""
WHEN: Final = (15.0, 60.0)
"""Seconds after the start between which the fault comes."""
SHUT, UNPLUGGED, FAR = 60.0, 5.0, 4.0
CARRIED: Final = (1.5, 6.0)
"""Least and greatest way of a robot that is carried off, m."""
OFF, DOUBLED = 0.15, 0.05
HOME: Final = 0.2
"""Metres from the start within which it is back."""
SAYS: Final = {
    "kidnap": {Reason.POSE_LOST, Reason.ODOMETRY_DROPPED, Reason.POSE_FOUND},
    "lidar": {Reason.SCAN_STALE, Reason.DEVICE_LOST},
    "battery": {Reason.BATTERY_LOW, Reason.CHARGE_SPENT},
}
"""Reasons of which one is to be reported."""


def explored(seed: int, fault: str) -> dict[str, Any]:
    """One run."""
    rng = np.random.default_rng([31, seed, FAULTS.index(fault)])
    arena = Arena.load("rooms", CONFIGS / "worlds" / "rooms.yaml")
    start = arena.start(seed)
    pose = dict(zip(("x", "y", "yaw"), start, strict=True))
    with TemporaryDirectory() as folder:
        overlay: dict[str, Any] = {
            "recorder": None,
            "blackbox": None,
            "placement": {"planner": "loop", "explorer": "loop"},
            "planner": {"local_planner": None, "route": {"effort": 3000}},
            "odometry": {"start": pose},
            "slam": {"save": Path(folder) / "map"},
            "sim": {"seed": seed, "world": {"start": pose}},
        }
        if fault == "person":
            overlay["sim"]["world"]["people"] = [{"speed": 0.5, "before": ("stop", "turn")[seed % 2]}]
        config = with_overlay(load_config(CONFIGS / "explore.yaml", SimulatedTruckConfig)[0], overlay)
        told: dict[str, Any] = {}

        async def main(clock: VirtualClock) -> None:
            rig = VirtualRig(config, clock)
            async with rig.running():
                await clock.sleep(4.0)
                told.update(await Story(rig, arena, fault, seed, rng, start).tell())
            told["true"] = rig.truth.array()

        run_virtual(main, start=SECOND)
        row = {"fault": fault, "seed": seed, **judged(told, fault, start)}
        row["off_share"] = off_share(Path(folder) / "map", arena, told["added"])
    row["doubled"] = bool(row["off_share"] > DOUBLED)
    return row


class Story:
    """A truck that explores, and what happens to it.

    Args:
        rig: the truck.
        arena: the world.
        fault: what happens.
        seed: every other one's door opens again.
        rng: of what is drawn.
        start: of the truck.
    """

    def __init__(
        self, rig: VirtualRig, arena: Arena, fault: str, seed: int, rng: np.random.Generator, start: Pose
    ) -> None:
        self.rig, self.clock, self.arena, self.fault = rig, rig.clock, arena, fault
        self.opens, self.rng, self.start = seed % 2 == 1, rng, start
        self.operator = LocalOperator(rig.daemon, rig.clock)
        self.states = rig.bus.subscribe(topics.EXPLORE, latest())
        self.events = rig.bus.subscribe(topics.EVENT, fifo(100_000))
        self.poses = rig.bus.subscribe(topics.POSE, latest())
        self.added: list[Box] = []
        self.at = 0.0

    async def tell(self) -> dict[str, Any]:
        """From arming to the end of the exploration."""
        await self.operator.arm()
        order = {"order": ExploreOrder.START, "home": True, "budget": BUDGET}
        await self.operator.call("explore", {**await self.operator.header(), **order})
        began = self.clock.now()
        happening = asyncio.create_task(self.happen())
        state, late = None, False
        try:
            async with self.clock.deadline(LIMIT):
                state = await self.end()
        except TimeoutError:
            late, state = True, self.states.latest
        happening.cancel()
        await asyncio.wait([happening])
        if not happening.cancelled() and (error := happening.exception()) is not None:
            raise error
        await self.clock.sleep(2.0)
        pose, true = self.poses.latest, self.rig.world.truth(self.clock.now())
        off = math.inf if pose is None else math.dist((pose.pose.x, pose.pose.y), (true.x, true.y))
        return {
            "state": state, "late": late, "events": self.events.drain(), "added": self.added, "at": self.at,
            "seconds": (self.clock.now() - began) / SECOND, "pose_off": off, "speed": abs(true.v),
        }  # fmt: skip

    async def end(self) -> ExplorationState:
        """What the exploration came to."""
        while True:
            state = self.states.latest
            if state is not None and state.number and not state.running:
                return state
            await self.clock.sleep(0.5)

    async def happen(self) -> None:
        """The fault, and what its people do about it."""
        await self.clock.sleep(float(self.rng.uniform(*WHEN)))
        match self.fault:
            case "kidnap":
                self.carry_off()
                await self.arm_again(4.0)
            case "door":
                await self.shut_door()
            case "lidar":
                self.noted()
                self.rig.ports["lidar"].unplug()
                await self.clock.sleep(UNPLUGGED)
                self.rig.ports["lidar"].plug()
                await self.arm_again(6.0)
            case "battery":
                while math.dist(self.here[:2], self.start[:2]) < FAR:
                    await self.clock.sleep(0.5)
                self.noted()
                self.rig.world.set_charge(self.clock.now(), float(self.rng.uniform(0.05, 0.12)))

    @property
    def here(self) -> Pose:
        """Where the truck really is."""
        truth = self.rig.world.truth(self.clock.now())
        return truth.x, truth.y, truth.yaw

    def noted(self) -> None:
        """The fault comes now."""
        self.at = self.clock.now() / SECOND

    def carry_off(self) -> None:
        """Somewhere else."""
        low, size = np.array(self.arena.origin), np.array(self.arena.blocked.shape[::-1]) * self.arena.resolution
        while True:
            pose = (*(low + size * self.rng.random(2)), self.rng.uniform(-math.pi, math.pi))
            far = CARRIED[0] < math.dist(pose[:2], self.here[:2]) < CARRIED[1]
            if far and self.arena.truth.free(Footprint(), np.array([pose]), 0.15)[0]:
                break
        self.noted()
        self.rig.world.carry(self.clock.now(), tuple(map(float, pose)))  # type: ignore[arg-type]

    async def shut_door(self) -> None:
        """The nearest one that the truck is not in."""
        while True:
            x, y, _ = self.here
            doors = sorted(DOORS, key=lambda door: math.dist((x, y), door[:2]))
            door = next(door for door in doors if math.dist((x, y), door[:2]) > 0.7)
            leaf = Box(*door)
            try:
                self.rig.world.add(self.clock.now(), leaf)
            except InputError:
                await self.clock.sleep(1.0)
                continue
            break
        self.noted()
        self.added.append(leaf)
        if self.opens:
            await self.clock.sleep(SHUT)
            self.rig.world.remove(self.clock.now(), leaf)

    async def arm_again(self, after: float) -> None:
        """As somebody does who put it right; again where it is refused."""
        for _ in range(10):
            await self.clock.sleep(after)
            gate = self.rig.bus.newest(topics.GATE)
            if gate is not None and gate.mode.active:
                return
            try:
                await self.operator.arm()
            except TruckError:
                continue


def judged(told: dict[str, Any], fault: str, start: Pose) -> dict[str, Any]:
    """What the run has to be judged by, but for its map."""
    state, true = told["state"], told["true"]
    reasons = {event.reason for event in told["events"] if event.stamp / SECOND >= told["at"] - 0.5}
    wanted = SAYS.get(fault, set())
    saved = "map in" in state.text
    return {
        "outcome": str(state.outcome), "text": state.text, "late": told["late"],
        "touched": bool(true[:, 5].any()), "stands": told["speed"] < 0.01, "pose_off": round(told["pose_off"], 3),
        "home": round(math.dist(true[-1, 1:3], start[:2]), 3), "seconds": round(told["seconds"]),
        "travelled": round(state.travelled, 1), "saved": saved,
        "said": bool(state.text) and saved and (not wanted or bool(wanted & reasons)),
        "reasons": sorted({str(e.reason) for e in told["events"] if e.stamp / SECOND >= told["at"]}),
    }  # fmt: skip


def off_share(folder: Path, arena: Arena, added: list[Box]) -> float:
    """Share of the saved map's walls that are more than ``OFF`` from true ones and from what was put there."""
    saved = load(folder).grid
    rows, columns = np.nonzero(saved.cells >= OCCUPIED)
    places = (np.column_stack((columns, rows)) + 0.5) * saved.resolution + np.array(saved.origin[:2])
    blocked = arena.blocked.copy()
    origin = np.array(arena.origin)
    for box in added:
        half = np.array((box.length, box.width)) / 2
        low, high = (
            np.floor((np.array((box.x, box.y)) + sign * half - origin) / arena.resolution).astype(int)
            for sign in (-1, 1)
        )
        blocked[low[1] : high[1] + 1, low[0] : high[0] + 1] = True
    away = distance_transform_edt(~blocked) * arena.resolution
    at = np.floor((places - origin) / arena.resolution).astype(int)[:, ::-1]
    at = np.clip(at, 0, np.array(blocked.shape) - 1)
    return round(float((away[at[:, 0], at[:, 1]] > OFF).mean()), 4) if len(at) else 1.0


def summary(rows: list[dict[str, Any]]) -> tuple[dict[str, float], dict[str, float]]:
    """Runs of each fault that did not end safely, with a doubled map, without a word; all should be none."""
    figures: dict[str, float] = {}
    goals: dict[str, float] = {}
    for fault in FAULTS:
        of = [row for row in rows if row["fault"] == fault]
        if not of:
            continue
        bad = {
            "late": [row["late"] for row in of],
            "touched": [row["touched"] for row in of],
            "not_standing": [not row["stands"] for row in of],
            "doubled": [row["doubled"] for row in of],
            "silent": [not row["said"] for row in of],
        }
        counts = {f"{fault}_{name}": float(sum(values)) for name, values in bad.items()}
        goals |= dict.fromkeys(counts, 0.0)
        back = float(sum(row["home"] <= HOME for row in of))
        figures |= {f"{fault}_runs": float(len(of)), **counts, f"{fault}_back_at_the_start": back}
    return figures, goals
