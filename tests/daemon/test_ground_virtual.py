"""The ground in the whole daemon: felt on the way out, gone round on the way back."""

import numpy as np
import pytest

from monstertruck_schemas import topics
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.state import GROUND_UNKNOWN, ROUGHNESS_STEP, Ground
from tests.daemon.goal_kit import Trip, assert_at, travel

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(300)]

X, Y, LENGTH, WIDTH = 3.1, 3.95, 1.0, 0.5
PATCH = {"x": X, "y": Y, "length": LENGTH, "width": WIDTH, "height": 0.03}


def over_patch(truth: np.ndarray) -> np.ndarray:
    return (abs(truth[:, 1] - X) < LENGTH / 2) & (abs(truth[:, 2] - Y) < WIDTH / 2)


def roughness_at(ground: Ground, x: float, y: float) -> float:
    column, row = (int((v - low) / ground.resolution) for v, low in ((x, ground.origin.x), (y, ground.origin.y)))
    value = ground.roughness[row * ground.width + column]
    assert value != GROUND_UNKNOWN
    return float(value * ROUGHNESS_STEP)


@pytest.mark.long
def test_a_rough_patch_is_driven_over_once():
    turns = []

    async def story(trip: Trip) -> None:
        await trip.goal(5.0, 3.95, 0.0)
        await trip.arm()
        assert (await trip.end()).outcome is Reason.GOAL_REACHED
        turns.append(len(trip.rig.truth.array()))
        ground = trip.rig.bus.newest(topics.GROUND)
        assert ground is not None
        assert roughness_at(ground, X + 0.2, Y) > 0.008
        assert roughness_at(ground, 4.6, Y) < 0.004
        await trip.goal(1.0, 3.95, 0.0)
        assert (await trip.end()).outcome is Reason.GOAL_REACHED

    rig = travel(
        story,
        planner={"route": {"effort": 20000, "margin": 0.04, "reverse_cost": 1.0}, "local_planner": None},
        sim={"world": {"rough": [PATCH]}},
    )
    assert_at(rig, 1.0, 3.95, 0.0)
    truth = rig.truth.array()
    there, back = truth[: turns[0]], truth[turns[0] :]
    assert over_patch(there).any()
    assert not over_patch(back).any()
