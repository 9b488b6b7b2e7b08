"""The whole daemon on rigid bodies: it drives its path, stops before what is put there, and every run is the same."""

import math
from pathlib import Path

import numpy as np
import pytest

from monstertruck_runtime.clock import VirtualClock, run_virtual
from monstertruck_schemas.req import Order
from monstertruck_sim.world.obstacles import Disc
from monstertruckd.config.load import load_config
from monstertruckd.tools.drill.truck import DrillTruck
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(240)]

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
RIGID = {"recorder": None, "map": None, "sim": {"world": {"engine": "mujoco"}}}


def driving(test, overlay: dict | None = None, file: str = "demo.yaml"):
    """Run ``test(truck)`` on a truck that has begun to drive; returns what it returns."""
    found = []

    async def main(clock: VirtualClock) -> None:
        config = with_overlay(load_config(CONFIGS / file, SimulatedTruckConfig)[0], RIGID)
        async with DrillTruck.running(with_overlay(config, overlay or {}), clock) as truck:
            assert await truck.until(truck.drives, 15.0, Order.ARM)
            found.append(await test(truck))

    run_virtual(main)
    return found[0]


def test_it_drives_the_lap_of_the_loop():
    """Straight on and into the first bend: the tracker and the odometry know nothing of tyres and springs."""

    async def test(truck: DrillTruck) -> None:
        await truck.clock.sleep(18.0)
        truth = truck.rig.truth.array()
        x, y = truth[:, 1], truth[:, 2]
        corner = np.hypot(np.maximum(x - 1.3, 0.0), np.maximum(-0.7 - y, 0.0))
        assert x.max() > 2.0
        assert abs(corner - 1.0).max() < 0.05
        state = truck.rig.world.truth(truck.clock.now())
        assert not state.stuck
        assert abs(state.pitch) < math.radians(1.0)

    driving(test)


def test_it_stops_before_a_thing_that_is_put_in_its_way():
    async def test(truck: DrillTruck) -> None:
        world, clock = truck.rig.world, truck.clock
        await clock.sleep(2.0)
        world.add(clock.now(), Disc(world.truth(clock.now()).x + 1.0, -1.7, 0.1))
        await clock.sleep(16.0)
        state = world.truth(clock.now())
        assert not state.stuck
        assert state.v == pytest.approx(0.0, abs=0.01)

    driving(test)


def test_two_runs_of_a_seed_are_the_same_and_another_seed_makes_another():
    def driven(seed: int) -> bytes:
        async def test(truck: DrillTruck) -> bytes:
            await truck.clock.sleep(3.0)
            return truck.rig.truth.array().tobytes()

        return driving(test, {"sim": {"seed": seed}})

    first = driven(1)
    assert driven(1) == first
    assert driven(2) != first


def test_the_stabilised_truck_runs_as_well():
    """All devices of the full configuration on the rigid body."""

    async def test(truck: DrillTruck) -> None:
        await truck.clock.sleep(5.0)
        assert truck.rig.world.truth(truck.clock.now()).x > 0.3

    driving(test, file="full3d.yaml")
