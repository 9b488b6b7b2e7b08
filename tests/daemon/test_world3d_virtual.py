"""The whole daemon on rigid bodies: it drives its path, stops before what is put there, and every run is the same."""

import math
from pathlib import Path

import numpy as np
import pytest

from monstertruck_runtime.clock import VirtualClock, run_virtual
from monstertruck_runtime.errors import RequestRefusedError
from monstertruck_runtime.mailbox import fifo
from monstertruck_schemas import topics
from monstertruck_schemas.event import Event
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Order
from monstertruck_schemas.state import GateMode
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


@pytest.mark.long
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
            await truck.clock.sleep(1.0)
            return truck.rig.truth.array().tobytes()

        return driving(test, {"sim": {"seed": seed}})

    first = driven(1)
    assert driven(1) == first
    assert driven(2) != first


def test_the_stabilised_truck_runs_as_well():
    """All devices of the full configuration on the rigid body."""

    async def test(truck: DrillTruck) -> None:
        await truck.clock.sleep(3.0)
        assert truck.rig.world.truth(truck.clock.now()).x > 0.3

    driving(test, file="full3d.yaml")


def ditch(**more: float) -> dict:
    return {"sim": {"world": {"ground": [{"kind": "ditch", "yaw": 1.5708, "length": 3.0, **more}]}}}


def test_a_truck_that_falls_into_a_ditch_is_stopped_by_its_tilt_and_disarmed():
    async def test(truck: DrillTruck) -> None:
        assert await truck.until(lambda: truck.gate is not None and truck.gate.mode is GateMode.DISARMED, 8.0)
        events = [report.reason for report in truck.reports() if isinstance(report, Event)]
        assert Reason.TILT_STOP in events
        assert truck.rig.world.plant.height < -0.05
        driven = truck.rig.bus.subscribe(topics.CMD_DRIVE, fifo(64))
        await truck.clock.sleep(0.5)
        assert all(command.speed == 0.0 for command in driven.drain()), "whatever its wheels stand on"
        with pytest.raises(RequestRefusedError, match="tilt"):
            await truck.operator.arm()

    driving(test, ditch(x=0.9, y=-1.7, width=0.8, depth=0.4))


@pytest.mark.long
def test_a_truck_that_pushes_against_a_kerb_below_its_lidar_says_that_it_does_not_get_on():
    """Its wheels go on turning: what the scans see tells that it stands."""

    async def test(truck: DrillTruck) -> None:
        assert await truck.until(lambda: truck.gate is not None and truck.gate.mode is GateMode.DISARMED, 60.0)
        events = [report.reason for report in truck.reports() if isinstance(report, Event)]
        assert Reason.STUCK in events
        assert truck.rig.world.truth(truck.clock.now()).x < 0.2

    kerb = {"kind": "step", "x": 0.5, "y": -1.7, "length": 0.3, "width": 2.0, "height": 0.06}
    driving(test, {"sim": {"world": {"ground": [kerb]}}}, "fusion.yaml")
