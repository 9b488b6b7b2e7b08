"""Turning round in a corridor, by the whole daemon: many cusps, no contact, and the goal is met."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from monstertruck_runtime.mailbox import fifo
from monstertruck_runtime.map_files import WorldMap, save_map
from monstertruck_schemas import topics
from monstertruck_schemas.reasons import Reason
from tests.daemon.goal_kit import Trip, travel

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(300)]

CELL = 0.025
X = 2.5
NARROW = {"obstacle": {"ahead": 0.01, "side_clearance": 0.01}}
"""Let the truck near to walls."""
SLOW = {"obstacle": NARROW["obstacle"] | {"memory_time": 60.0}}
"""Under MPC the truck turns so slowly that the gate would by default (30 s) forget the ground behind it meanwhile."""


def corridor(width: float, folder: Path) -> Path:
    """Map file of a corridor 5 m long, its walls four cells thick, its middle at ``width / 2 + 0.1`` m."""
    cells = np.full((round(width / CELL) + 8, round(5.0 / CELL) + 8), 100, np.int8)
    cells[4:-4, 4:-4] = 0
    file = folder / "corridor.yaml"
    save_map(WorldMap(cells, CELL, (0.0, 0.0)), file)
    return file


@pytest.mark.parametrize(
    ("width", "kind", "seed", "gate"),
    [
        pytest.param(0.8, "lqr", 1, NARROW, marks=pytest.mark.long),
        pytest.param(0.8, "mpc", 2, SLOW, marks=pytest.mark.long),
        pytest.param(0.9, "lqr", 3, {}, marks=pytest.mark.long),
    ],
)
def test_turning_round_in_a_corridor_touches_nothing(
    width: float, kind: str, seed: int, gate: dict[str, Any], tmp_path: Path
):
    """In 0.8 m there is less room than the gate keeps by default: it has to allow the truck nearer to the walls.

    The truck first drives ahead, as it has not yet seen the ground that its tail would swing onto where it stands.
    Routes there pass them at 15 mm: the gate may still stop the truck, which then goes on by a route from where it is.
    """
    file, y = corridor(width, tmp_path), width / 2 + 0.1
    cusps = []

    async def story(trip: Trip) -> None:
        paths = trip.rig.bus.subscribe(topics.PATH, fifo(64))
        await trip.goal(X, y, math.pi)
        await trip.arm()
        state = await trip.end(400.0)
        assert state.outcome is Reason.GOAL_REACHED
        assert state.recoveries == 0 or gate
        cusps.extend(np.count_nonzero(np.diff(path.directions)) for path in paths.drain())

    place = {"x": X, "y": y, "yaw": 0.0}
    rig = travel(
        story,
        planner={"map": file, "local_planner": None, "route": {"effort": 20_000}},
        odometry={"start": place},
        sim={"seed": seed, "world": {"map": str(file), "start": place}},
        tracker={"kind": kind},
        gate=gate,
    )
    truth = rig.truth.array()
    assert not truth[:, 5].any(), "collided"
    assert math.dist(truth[-1, 1:3], (X, y)) < 0.03
    assert abs(math.remainder(truth[-1, 3] - math.pi, math.tau)) < 0.1
    assert max(cusps) >= 2
