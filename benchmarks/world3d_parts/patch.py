"""A patch of rubble between two places: must be found, and avoided by routes.

The whole chain: stones tilt the body, the compass measures it, ``state/ground`` stores it, the route planner avoids it,
the truck drives. Ground beside the wheels is unknown and costs nothing, so each trip over the patch finds one strip.
"""

from math import pi
from typing import NamedTuple

import numpy as np

from benchmarks.world3d_parts.terrain import CONFIGS, run
from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.mailbox import latest
from monstertruck_schemas import topics
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.plan import GoalPhase
from monstertruck_schemas.req import GoalRequest, Order
from monstertruck_schemas.state import GROUND_UNKNOWN, ROUGHNESS_STEP, Ground
from monstertruckd.config.load import load_config
from monstertruckd.tools.drill.truck import DrillTruck
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay

ENDS = (0.5, 6.0)
"""Places along x between which the truck drives to and fro, m."""
PATCH = (2.4, 4.0)
"""Where the stones begin and end along x, m."""
WIDTHS = {"narrow": 0.5, "spanning": 6.0}
"""Widths of the patch, m: one with room on both sides, half as wide again as the truck, and one from wall to wall."""
TRIPS = 4
LIMIT = 240.0
"""Seconds a trip may take."""
STONE = 0.125
"""Half the side of the largest stone, m: so far beyond the patch it may lie."""
HALF = 0.17
"""Half of the truck's width, m."""
ROUGH = 0.004
"""A cell at least this rough is found to be, m."""


class Trip(NamedTuple):
    """One trip between the ends."""

    reached: bool
    way: Array
    """Places of its middle every 0.1 s; shape (n, 2), m."""

    @property
    def length(self) -> float:
        """Distance travelled, m."""
        return float(np.hypot(*np.diff(self.way, axis=0).T).sum())

    def on(self, width: float) -> float:
        """Return the distance with a wheel over a patch of this width, m."""
        x, y = self.way[1:].T
        over = (x > PATCH[0]) & (x < PATCH[1]) & (abs(y) < width / 2 + HALF)
        return float(np.hypot(*np.diff(self.way, axis=0).T)[over].sum())


def config(width: float) -> SimulatedTruckConfig:
    """Return a truck with goals on the map of a hall with stones."""
    base = load_config(CONFIGS / "world3d" / "rubble.yaml", SimulatedTruckConfig)[0]
    stones = {
        "kind": "rubble",
        "x": sum(PATCH) / 2,
        "y": 0.0,
        "length": PATCH[1] - PATCH[0],
        "width": width,
        "count": min(200, round(40 * width)),
        "height": 0.015,
    }
    return with_overlay(
        base,
        {
            "recorder": None,
            "path": None,
            "planner": {"map": CONFIGS / "worlds" / "hall.yaml", "local_planner": {"kind": "rsband"}},
            "tracker": {"kind": "lqr"},
            "sim": {"world": {"ground": [stones]}},
        },
    )


def trips(width: float, count: int) -> tuple[list[Trip], Ground | None]:
    """Return trips to and fro over a patch, and the known ground after the last."""

    async def drive(truck: DrillTruck) -> tuple[list[Trip], Ground | None]:
        ground = truck.rig.bus.subscribe(topics.GROUND, latest())
        ways = []
        for number in range(1, count + 1):
            there = number % 2
            ways.append(await _trip(truck, number, Pose2D(x=ENDS[there], y=0.0, yaw=0.0 if there else pi)))
            trip = ways[-1]
            print(f"patch, trip {number}: {trip.length:.2f} m, {trip.on(width):.2f} m on stones", flush=True)
        return ways, ground.latest

    return run(config(width), drive)  # type: ignore[no-any-return]


async def _trip(truck: DrillTruck, number: int, goal: Pose2D) -> Trip:
    clock, world = truck.clock, truck.rig.world
    states = truck.rig.bus.subscribe(topics.GOAL, latest())
    await truck.until(lambda: truck.gate is not None and not truck.blockers(), 20.0)
    request = GoalRequest.model_validate({**await truck.operator.header(), "frame": "map", "goal": goal.model_dump()})
    await truck.operator.call("goal", request.model_dump(mode="json"))
    way: list[tuple[float, float]] = []
    begin = clock.now()
    while clock.now() - begin < LIMIT * SECOND:
        await clock.sleep(0.1)
        truth = world.truth(clock.now())
        way.append((truth.x, truth.y))
        if truck.gate is not None and not truck.gate.mode.active:
            await truck.order(Order.ARM)
        state = states.latest
        if state is not None and state.number >= number and state.phase is GoalPhase.IDLE:
            break
    x, y = way[-1]
    return Trip(abs(x - goal.x) < 0.15 and abs(y - goal.y) < 0.15, np.array(way))


def found(ground: Ground, width: float, ways: list[Trip]) -> tuple[float, float]:
    """Return the rough shares of the cells under the truck's centre: on the patch, and away from it."""
    cells = np.asarray(ground.roughness).reshape(ground.height, ground.width)
    way = np.vstack([trip.way for trip in ways])
    columns, rows = np.floor((way - (ground.origin.x, ground.origin.y)) / ground.resolution).astype(int).T
    inside = (columns >= 0) & (columns < ground.width) & (rows >= 0) & (rows < ground.height)
    values, (x, y) = cells[rows[inside], columns[inside]], way[inside].T
    known = values != GROUND_UNKNOWN
    on = known & (x > PATCH[0]) & (x < PATCH[1]) & (abs(y) < width / 2)
    reach = 0.235 + STONE  # half the truck's length: it feels a stone before its middle is there
    off = known & ((x < PATCH[0] - reach) | (x > PATCH[1] + reach) | (abs(y) > width / 2 + HALF + STONE))
    rough = values * ROUGHNESS_STEP >= ROUGH
    return (float(rough[on].mean()) if on.any() else 0.0), (float(rough[off].mean()) if off.any() else 0.0)


def patch() -> dict[str, float]:
    """Drive over a narrow patch and over one from wall to wall."""
    figures: dict[str, float] = {}
    for name, width in WIDTHS.items():
        ways, ground = trips(width, TRIPS)
        on, off = (0.0, 1.0) if ground is None else found(ground, width, ways)
        figures |= {
            f"patch_{name}_reached": sum(trip.reached for trip in ways) / len(ways),
            f"patch_{name}_first_m_on_stones": ways[0].on(width),
            f"patch_{name}_last_m_on_stones": ways[-1].on(width),
            f"patch_{name}_trips_over_it": sum(trip.on(width) > 0.0 for trip in ways),
            f"patch_{name}_rough_on": on,
            f"patch_{name}_rough_off": off,
            f"patch_{name}_detour": ways[-1].length / (ENDS[1] - ENDS[0]),
        }
    return figures


if __name__ == "__main__":
    for _name, _value in patch().items():
        print(f"{_name:36} {_value:.4g}")
