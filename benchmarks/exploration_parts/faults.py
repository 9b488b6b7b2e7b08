"""Faults while the whole daemon explores the built-in rooms, on the virtual clock, drawn by seed.

- ``kidnap``: the truck is carried to another place, and armed again;
- ``door``: the nearest door is closed, for ``SHUT`` seconds with every other seed, otherwise permanently;
- ``person``: a person walks about from the start, and stops or turns in front of the truck;
- ``lidar``: the lidar is unplugged for ``UNPLUGGED`` seconds, then the truck is armed again;
- ``battery``: replaced by a nearly empty one when the truck is ``FAR`` from its start, or after ``LATEST`` seconds.

A run ends safely if it ends in time, touches nothing, and the truck stands. The map is doubled if more than ``DOUBLED``
of its walls are more than 0.15 m from true ones (the door leaf counts as true). A run is explained if its end has a
reason and a text, the map was saved by then, and a reason of the fault was reported.
"""

import math
from typing import Any, Final

import numpy as np

from benchmarks.exploration_parts.arena import Arena
from benchmarks.exploration_parts.daemon import CONFIGS, ExploringTruck, RunRecord, recorded_run
from monstertruck_planners.collision import Footprint
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError, TruckError
from monstertruck_schemas import topics
from monstertruck_schemas.reasons import Reason
from monstertruck_sim.world.obstacles import Box

FAULTS: Final = ("kidnap", "door", "person", "lidar", "battery")
DOORS: Final = ((2.45, 3.1, 0.9, 0.1), (7.65, 3.1, 0.9, 0.1), (3.85, 4.8, 0.9, 0.1), (6.85, 4.8, 0.9, 0.1))
"""Doors of the rooms: middle, length, width, m."""
WALK: Final = (
    (1.2, 3.95), (2.45, 3.95), (2.45, 2.2), (2.45, 3.95), (6.85, 3.95), (6.85, 5.8), (6.85, 3.95), (8.8, 3.95)
)  # fmt: skip
"""Waypoints of the person, round and round, through the hall and into two rooms, m."""
APART: Final = 1.5
"""Metres from the truck at which the person begins, at least."""
BUDGET, LIMIT = 240.0, 600.0
"""Seconds of exploring, and until the end."""
WHEN: Final = (15.0, 60.0)
"""Seconds after the start between which the fault comes."""
SHUT, UNPLUGGED, FAR, LATEST = 60.0, 5.0, 4.0, 200.0
"""s, s, m, s."""
CARRIED: Final = (1.5, 6.0)
"""Least and greatest way of a robot that is carried off, m."""
DOUBLED: Final = 0.05
HOME: Final = 0.2
"""Metres from the start within which it is back."""
SAYS: Final = {
    "kidnap": {Reason.POSE_LOST, Reason.ODOMETRY_DROPPED, Reason.POSE_FOUND},
    "lidar": {Reason.SCAN_STALE, Reason.DEVICE_LOST},
    "battery": {Reason.BATTERY_LOW, Reason.CHARGE_SPENT},
}
"""Reasons of which one is to be reported."""


def explored(seed: int, fault: str) -> dict[str, Any]:
    """Run and judge one exploration."""
    rng = np.random.default_rng([31, seed, FAULTS.index(fault)])
    people = [walker(seed, rng)] if fault == "person" else []

    async def happen(truck: ExploringTruck) -> None:
        await truck.clock.sleep(float(rng.uniform(*WHEN)))
        match fault:
            case "kidnap":
                carry_off(truck, rng)
                await arm_again(truck, 4.0)
            case "door":
                await shut_door(truck, opens=seed % 2 == 1)
            case "lidar":
                noted(truck)
                truck.rig.ports["lidar"].unplug()
                await truck.clock.sleep(UNPLUGGED)
                truck.rig.ports["lidar"].plug()
                await arm_again(truck, 6.0)
            case "battery":
                began = truck.clock.now()
                while math.dist(truck.here[:2], truck.start[:2]) < FAR and truck.clock.now() < began + LATEST * SECOND:
                    await truck.clock.sleep(0.5)
                noted(truck)
                truck.rig.world.set_charge(truck.clock.now(), float(rng.uniform(0.05, 0.12)))

    return judged(recorded_run("rooms", seed, happen, budget=BUDGET, limit=LIMIT, people=people), fault, seed)


def walker(seed: int, rng: np.random.Generator) -> dict[str, Any]:
    """Return the settings of a person who starts away from the truck."""
    start = Arena.load("rooms", CONFIGS / "worlds" / "rooms.yaml").start(seed)
    first = next(int(k) for k in rng.permutation(len(WALK)) if math.dist(WALK[k], start[:2]) > APART)
    places = [{"x": x, "y": y} for x, y in (*WALK[first:], *WALK[:first])]
    return {"waypoints": places, "speed": 0.5, "before": ("stop", "turn")[seed % 2]}


def noted(truck: ExploringTruck) -> None:
    """Mark the time of the fault."""
    truck.at = truck.clock.now() / SECOND


def carry_off(truck: ExploringTruck, rng: np.random.Generator) -> None:
    """Carry the truck to another place."""
    arena = truck.arena
    low, size = np.array(arena.origin), np.array(arena.blocked.shape[::-1]) * arena.resolution
    while True:
        x, y = (low + size * rng.random(2)).tolist()
        pose = x, y, float(rng.uniform(-math.pi, math.pi))
        far = CARRIED[0] < math.dist(pose[:2], truck.here[:2]) < CARRIED[1]
        if far and arena.truth.free(Footprint(), np.array([pose]), 0.15)[0]:
            break
    noted(truck)
    truck.rig.world.carry(truck.clock.now(), pose)


async def shut_door(truck: ExploringTruck, *, opens: bool) -> None:
    """Close the nearest door that the truck is not in."""
    while True:
        here = truck.here[:2]
        doors = sorted(DOORS, key=lambda door: math.dist(here, door[:2]))
        leaf = Box(*next(door for door in doors if math.dist(here, door[:2]) > 0.7))
        try:
            truck.rig.world.add(truck.clock.now(), leaf)
        except InputError:
            await truck.clock.sleep(1.0)
            continue
        break
    noted(truck)
    truck.added.append(leaf)
    if opens:
        await truck.clock.sleep(SHUT)
        truck.rig.world.remove(truck.clock.now(), leaf)


async def arm_again(truck: ExploringTruck, after: float) -> None:
    """Arm as an operator who has removed the cause; retry if refused."""
    for _ in range(10):
        await truck.clock.sleep(after)
        gate = truck.rig.bus.newest(topics.GATE)
        if gate is not None and gate.mode.active:
            return
        try:
            await truck.operator.arm()
        except TruckError:
            continue


def judged(run: RunRecord, fault: str, seed: int) -> dict[str, Any]:
    """Return the saved values of a run."""
    state, at = run.state, run.truck.at
    reasons = {event.reason for event in run.events if event.stamp / SECOND >= at}
    wanted, saved = SAYS.get(fault, set()), "map in" in state.text
    return {
        "fault": fault, "seed": seed, "outcome": str(state.outcome), "text": state.text, "late": run.late,
        "touched": bool(run.true[:, 5].any()), "stands": bool(abs(run.true[-1, 4]) < 0.01),
        "doubled": run.off_share > DOUBLED, "off_share": run.off_share, "pose_off": round(run.pose_off, 3),
        "home": round(math.dist(run.true[-1, 1:3], run.start[:2]), 3), "seconds": round(run.seconds),
        "travelled": round(state.travelled, 1), "saved": saved,
        "said": bool(state.text) and saved and (not wanted or bool(wanted & reasons)),
        "reasons": sorted(map(str, reasons)),
    }  # fmt: skip


def summary(rows: list[dict[str, Any]]) -> tuple[dict[str, float], dict[str, float]]:
    """Return, for each fault, the runs with an unsafe end, a doubled map or no explanation; the goals are zero."""
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
