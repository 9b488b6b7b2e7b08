"""Keepout and speed zones in random worlds: entries of the true footprint, true speeds, and how goals are judged.

    python benchmarks/zones.py [--seeds 20] [--first 0]

Each seed draws a hall of 8 m with boxes, keepout and speed zones (polygons, and masks of cells) and goals, half of them
anywhere. The whole daemon drives on the virtual clock with odometry alone. The judge knows the world's truth and works
with polygons only: it clips the rectangle of the robot against each zone, and floods the free ground to see which goals
can be reached. In the last part of each trial a keepout zone appears where the robot drives.

``entries`` counts trials in which the true footprint reached into a keepout zone, ``too_fast`` those in which the true
speed on a speed zone exceeded its limit by more than 5 mm/s, ``wrong_refusals`` goals refused outside of zones or
accepted inside, ``missed`` goals that the judge calls easy and the robot did not reach, ``surprises_driven_on`` zones
that appear under the driving robot, after which it travelled further than it needs to brake. The last line is JSON.
"""

import argparse
import json
import math
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from scipy.ndimage import binary_dilation, label

from benchmarks import ROOT
from monstertruck_runtime.clock import VirtualClock, run_virtual
from monstertruck_runtime.errors import RequestRefusedError
from monstertruck_runtime.mailbox import fifo
from monstertruck_runtime.map_files import WorldMap, save_map
from monstertruck_schemas import topics
from monstertruck_schemas.plan import GoalPhase
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import DriveRequest
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

CONFIGS = ROOT / "configs"
SIDE, CELL = 8.0, 0.05
"""Sides of the hall and of its cells, m."""
LENGTH, WIDTH = 0.47, 0.34
"""Size of the robot, m."""
START = (1.0, 1.0, 0.0)
GOALS = 3
LIMIT = 0.1
"""Speed limit of the speed zones, m/s."""
EASY = 0.45
"""Half the width of ways that the judge calls easy, m: the circle around the robot with 15 cm to spare."""
TOLERANCE = 0.005
"""m/s."""
BRAKING = 0.1
"""Greatest distance from the surprise to standstill, m."""
QUIET: dict[str, Any] = {
    "recorder": None,
    "blackbox": None,
    "placement": {"planner": "loop", "local_planner": "loop", "tracker": "loop"},
    "planner": {"route": {"effort": 8000}, "timeout": 240.0},
}
Polygon = list[tuple[float, float]]


def corners_of(pose: tuple[float, ...], length: float = LENGTH, width: float = WIDTH) -> Polygon:
    """Rectangle of the robot at a pose."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    ends = ((length / 2, width / 2), (-length / 2, width / 2), (-length / 2, -width / 2), (length / 2, -width / 2))
    return [(pose[0] + c * x - s * y, pose[1] + s * x + c * y) for x, y in ends]


def overlap(zone: Polygon, body: Polygon) -> float:
    """Return the area that a convex body shares with a polygon, m^2: the polygon clipped at every side of the body."""
    part = zone
    for (ax, ay), (bx, by) in zip(body, body[1:] + body[:1], strict=True):
        side = [(bx - ax) * (y - ay) - (by - ay) * (x - ax) for x, y in part]
        clipped: Polygon = []
        for i, (point, value) in enumerate(zip(part, side, strict=True)):
            before, other = part[i - 1], side[i - 1]
            if (value >= 0) != (other >= 0):
                share = other / (other - value)
                clipped.append(tuple(a + share * (b - a) for a, b in zip(before, point, strict=True)))  # type: ignore[arg-type]
            if value >= 0:
                clipped.append(point)
        part = clipped
        if not part:
            return 0.0
    return abs(sum(a[0] * b[1] - b[0] * a[1] for a, b in zip(part, part[1:] + part[:1], strict=True))) / 2


def touches(zones: list[Polygon], body: Polygon, least: float = 1e-6) -> bool:
    return any(overlap(zone, body) > least for zone in zones)


def blob(rng: np.random.Generator, middle: np.ndarray, size: float) -> Polygon:
    """Return a star-shaped polygon around a place."""
    count = int(rng.integers(3, 8))
    turns = (np.arange(count) + rng.uniform(-0.2, 0.2, count)) * math.tau / count
    return [
        (float(middle[0] + r * math.cos(a)), float(middle[1] + r * math.sin(a)))
        for a, r in zip(turns, size * rng.uniform(0.5, 1.0, count), strict=True)
    ]


def clear_of_start(polygon: Polygon) -> bool:
    return not touches([polygon], corners_of(START, 1.6, 1.6), 0.0)


class World:
    """A hall, its zones and goals, all from one seed."""

    def __init__(self, seed: int, folder: Path) -> None:
        rng = self.rng = np.random.default_rng([52, seed])
        count = round(SIDE / CELL)
        cells = np.zeros((count, count), np.int8)
        cells[[0, -1]] = cells[:, [0, -1]] = 100
        for _ in range(int(rng.integers(2, 6))):
            x, y = rng.uniform(2.0, 7.0, 2)
            w, h = rng.uniform(0.2, 0.8, 2)
            cells[round(y / CELL) : round((y + h) / CELL), round(x / CELL) : round((x + w) / CELL)] = 100
        self.cells, self.map = cells, folder / "hall.yaml"
        save_map(WorldMap(cells, CELL), self.map)
        self.keepout = [p for p in (blob(rng, rng.uniform(1, 7, 2), 0.9) for _ in range(4)) if clear_of_start(p)]
        self.speed = [p for p in (blob(rng, rng.uniform(1, 7, 2), 1.2) for _ in range(3)) if clear_of_start(p)]
        mask = np.full((count, count), 0, np.int8)
        self.masked: list[Polygon] = []
        for x, y in rng.uniform(2.0, 7.5, (2, 2)):
            row, column = round(y / CELL), round(x / CELL)
            mask[row : row + 8, column : column + 8] = 100
            rows, columns = min(row + 8, count), min(column + 8, count)
            low, high = (column * CELL, row * CELL), (columns * CELL, rows * CELL)
            self.masked.append([low, (high[0], low[1]), high, (low[0], high[1])])
        save_map(WorldMap(mask, CELL), folder / "mask.yaml")
        areas: dict[str, Any] = {f"keep{i}": {"kind": "keepout", "corners": p} for i, p in enumerate(self.keepout)}
        areas |= {f"slow{i}": {"kind": "speed", "limit": LIMIT, "corners": p} for i, p in enumerate(self.speed)}
        self.zones = {"areas": areas, "keepout_mask": {"map": folder / "mask.yaml"}}
        self.closed = self.keepout + self.masked
        self.goals = [self._goal() for _ in range(GOALS)]

    def _goal(self) -> tuple[float, float, float]:
        while True:
            pose = (*self.rng.uniform(0.6, SIDE - 0.6, 2).tolist(), float(self.rng.uniform(-math.pi, math.pi)))
            if self.rng.random() < 0.5 or self.easy(pose):
                return pose

    def easy(self, pose: tuple[float, ...]) -> bool:
        """Whether a circle around the robot reaches the pose from the start, with room to turn."""
        blocked = self.cells >= 50
        y, x = (np.mgrid[0 : len(blocked), 0 : len(blocked)] + 0.5) * CELL
        for zone in self.closed:
            inside = np.zeros(blocked.shape, np.bool_)
            for (ax, ay), (bx, by) in zip(zone, zone[1:] + zone[:1], strict=True):
                if ay != by:
                    inside ^= ((ay > y) != (by > y)) & (x < ax + (y - ay) / (by - ay) * (bx - ax))
            blocked = blocked | inside
        reach = math.ceil(EASY / CELL)
        dy, dx = np.mgrid[-reach : reach + 1, -reach : reach + 1]
        regions, _ = label(~binary_dilation(blocked, dx**2 + dy**2 <= reach**2))
        here, there = (regions[int(p[1] / CELL), int(p[0] / CELL)] for p in (START, pose))
        return bool(here and here == there)


async def drive(world: World, rig: VirtualRig, clock: VirtualClock) -> dict[str, int]:
    """Drive to all goals; then let the pose jump into a zone."""
    row = {"goals": 0, "reached": 0, "refused": 0, "wrong_refusals": 0, "missed": 0}
    operator, states = LocalOperator(rig.daemon, clock), rig.bus.subscribe(topics.GOAL, fifo(100_000))
    for number, goal in enumerate(world.goals, 1):
        gate = rig.bus.newest(topics.GATE)
        assert gate is not None
        header = {
            "stamp": clock.now(), "received": clock.now(), "seq": number, "source": "bench", "role": "station",
            "lease": 1.0, "frame": "map", "nonce": gate.nonce, "gate_stamp": gate.stamp,
        }  # fmt: skip
        row["goals"] += 1
        easy = world.easy(goal)
        try:
            await rig.daemon.rpc.call("goal", {**header, "goal": dict(zip(("x", "y", "yaw"), goal, strict=True))})
        except RequestRefusedError as refused:
            row["refused"] += 1
            named = refused.refusal is Reason.KEEPOUT
            row["wrong_refusals"] += named and not touches(world.closed, corners_of(goal, LENGTH + 0.3, WIDTH + 0.3))
            row["missed"] += easy
            continue
        row["wrong_refusals"] += touches(world.closed, corners_of(goal))
        if not gate.mode.active:
            await operator.arm()
        while (state := await states.next()).number < number or state.phase is not GoalPhase.IDLE:
            pass
        row["reached"] += state.outcome is Reason.GOAL_REACHED
        row["missed"] += easy and state.outcome is not Reason.GOAL_REACHED
    return row


async def surprise(rig: VirtualRig, clock: VirtualClock) -> int:
    """Drive by hand, and add a zone under the robot; return whether it drove on."""
    operator = LocalOperator(rig.daemon, clock)
    gate = rig.bus.newest(topics.GATE)
    if gate is None or not gate.mode.active:
        await operator.arm()
    before = after = rig.truth.array()[-1, 1:3]
    for step in range(60):
        if step == 30:
            before = rig.truth.array()[-1, 1:3]
            x, y = before.tolist()
            square = [[x - 1, y - 1], [x + 1, y - 1], [x + 1, y + 1], [x - 1, y + 1]]
            area = {"kind": "keepout", "corners": square}
            request = {**await operator.header(), "order": "add", "name": "surprise", "area": area}
            await rig.daemon.rpc.call("zones", request)
        drive = {**await operator.header(0.3), "speed": -0.1, "front": 0.0, "rear": 0.0, "unseen": True}
        rig.bus.inject(topics.REQ_DRIVE, DriveRequest.model_validate_json(json.dumps(drive)))
        await clock.sleep(0.05)
        after = rig.truth.array()[-1, 1:3]
    return int(math.dist(before, after) > BRAKING)


def trial(seed: int) -> dict[str, Any]:
    """Run one world."""
    row: dict[str, Any] = {"seed": seed}
    with TemporaryDirectory() as name:
        world = World(seed, Path(name))
        x, y, yaw = START
        config = with_overlay(load_config(CONFIGS / "goals.yaml", SimulatedTruckConfig)[0], QUIET)
        config = with_overlay(
            config,
            {
                "planner": {"map": world.map},
                "odometry": {"start": {"x": x, "y": y, "yaw": yaw}},
                "zones": world.zones,
                "sim": {"seed": seed, "world": {"map": str(world.map), "start": {"x": x, "y": y, "yaw": yaw}}},
            },
        )

        async def main(clock: VirtualClock) -> None:
            rig = VirtualRig(config, clock)
            async with rig.running():
                await clock.sleep(3.0)
                row.update(await drive(world, rig, clock))
                truth = rig.truth.array()
                row["surprises_driven_on"] = await surprise(rig, clock)
            judge(world, truth, row)

        run_virtual(main)
    return row


def judge(world: World, truth: np.ndarray, row: dict[str, Any]) -> None:
    """Count entries and speed violations by the world's truth; columns t, x, y, yaw, ..., collided."""
    step = max(round(0.1 / float(np.median(np.diff(truth[:, 0])))), 1)
    shown = truth[::step]
    bodies = [corners_of(tuple(pose)) for pose in shown[:, 1:4].tolist()]
    speeds = np.hypot(*np.diff(shown[:, 1:3], axis=0).T) / np.diff(shown[:, 0])
    row["entries"] = int(any(touches(world.closed, body) for body in bodies))
    fast = [
        speed
        for before, after, speed in zip(bodies, bodies[1:], speeds.tolist(), strict=False)
        if touches(world.speed, before) and touches(world.speed, after)
    ]
    row["on_speed_zones"] = len(fast)
    row["fastest"] = max(fast, default=0.0)
    row["too_fast"] = int(row["fastest"] > LIMIT + TOLERANCE)
    row["collided"] = int(truth[:, 5].any())


def main() -> None:
    """Run all trials and print the sums."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    options = parser.parse_args()
    rows = []
    for seed in range(options.first, options.first + options.seeds):
        rows.append(trial(seed))
        print(rows[-1], flush=True)
    sums = {name: sum(row[name] for row in rows) for name in rows[0] if name not in ("seed", "fastest")}
    sums |= {"seeds": len(rows), "fastest": max(row["fastest"] for row in rows)}
    goals = dict.fromkeys(("entries", "too_fast", "wrong_refusals", "missed", "surprises_driven_on", "collided"), 0)
    met = all(sums[name] <= most for name, most in goals.items())
    print(json.dumps({"bench": "zones", "figures": sums, "goals": goals, "met": met}))


if __name__ == "__main__":
    main()
