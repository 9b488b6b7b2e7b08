"""Habits of the devices and what the whole daemon makes of them, beyond whether the truck stops."""

import asyncio
import math
from pathlib import Path

import pytest

from monstertruck_drivers.epos.emulator import EposEmulator
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.mailbox import fifo, latest
from monstertruck_schemas import topics
from monstertruck_schemas.health import ServiceState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Order
from monstertruck_schemas.state import GateMode
from monstertruckd.config.load import load_config
from monstertruckd.tools.drill.truck import DrillTruck
from monstertruckd.tools.simulation.config import DEADMAN_LINE, SimulatedTruckConfig, with_overlay

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(120)]

DEMO = Path(__file__).resolve().parents[2] / "configs" / "demo.yaml"


def driving(test, overlay: dict | None = None):
    """Run ``test(truck)`` on a truck that has driven for a second."""

    async def main(clock: VirtualClock) -> None:
        plain = with_overlay(load_config(DEMO, SimulatedTruckConfig)[0], {"recorder": None, "map": None})
        async with DrillTruck.running(with_overlay(plain, overlay or {}), clock) as truck:
            assert await truck.until(truck.drives, 15.0, Order.ARM)
            await clock.sleep(1.0)
            await test(truck)

    run_virtual(main)


def test_a_slow_link_is_named_in_the_health_of_its_service():
    async def test(truck: DrillTruck) -> None:
        health = truck.rig.bus.subscribe(topics.HEALTH, latest())
        truck.rig.context.command("drive", "delay 40")
        await truck.clock.sleep(4.0)
        (row,) = (service for service in health.latest.services if service.name == "drive")
        assert (row.state, row.reason) == (ServiceState.READY, Reason.SLOW_LINK)
        assert "ms" in row.detail
        truck.rig.context.command("drive", "delay 0")
        await truck.clock.sleep(4.0)
        (row,) = (service for service in health.latest.services if service.name == "drive")
        assert (row.state, row.reason) == (ServiceState.READY, Reason.OK)

    driving(test)


def test_after_a_supply_dip_of_the_drive_the_odometry_goes_on_and_the_truck_waits_to_be_armed():
    async def test(truck: DrillTruck) -> None:
        rig, clock = truck.rig, truck.clock
        odometry = rig.bus.subscribe(topics.ODOMETRY, fifo(10_000))
        truck.rig.context.command("drive", "restart 1")
        await clock.sleep(3.0)
        poses = [(message.pose.x, message.pose.y) for message in odometry.drain()]
        truth = rig.world.truth(clock.now())
        coasted = 0.06  # while nobody counted
        assert max(map(math.dist, poses, poses[1:])) < coasted
        assert math.dist(poses[-1], (truth.x, truth.y)) < coasted
        assert truck.gate is not None
        assert truck.gate.mode is GateMode.DISARMED
        assert abs(truth.v) < 0.01
        assert await truck.until(truck.drives, 15.0, Order.ARM)

    driving(test)


def test_an_emergency_stop_goes_by_the_deadman_line_as_well():
    """The drive hears nothing any more; nobody has noticed yet."""

    async def test(truck: DrillTruck) -> None:
        rig, clock = truck.rig, truck.clock
        drive = rig.robot.emulators["drive"]
        assert isinstance(drive, EposEmulator)
        truck.rig.context.command("drive", "line deaf on")
        ordering = asyncio.create_task(truck.order(Order.ESTOP))
        began = clock.now()
        while not drive.firmware.quick_stop_input:
            assert clock.now() - began < 0.06 * SECOND, "before the silence of the drive is noticed"
            await clock.sleep(0.005)
        await clock.sleep(0.4)
        assert abs(rig.world.truth(clock.now()).v) < 0.01
        await ordering

    driving(test, DEADMAN_LINE)
