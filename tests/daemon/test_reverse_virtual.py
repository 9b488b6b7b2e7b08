"""Backing towards what the lidar sees no more, through the whole daemon."""

import math
from pathlib import Path
from typing import Any

import pytest

from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.mailbox import fifo
from monstertruck_schemas import topics
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import DriveRequest, Order, Role
from monstertruck_sim.world.obstacles import Disc
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig
from tests.calibration_kit import LocalTruck
from tests.daemon.test_saturation_virtual import NOMINAL

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(120)]

YARD = Path(__file__).resolve().parents[2] / "configs" / "yard.yaml"


def test_the_truck_does_not_back_into_a_post_that_it_has_passed():
    config = load_config(YARD, SimulatedTruckConfig)[0].model_copy(update={"recorder": None})
    config = with_overlay(config, {"sim": {"world": {"truck": NOMINAL}}})

    async def main(clock: VirtualClock) -> set[Reason]:
        rig = VirtualRig(config, clock)
        with rig.bus.subscribe(topics.GATE, fifo(4096)) as gate:
            async with rig.running():
                await clock.sleep(3.0)
                truck = LocalTruck(rig.daemon, clock)

                async def drive(speed: float, angle: float, seconds: float) -> None:
                    for _ in range(round(seconds / 0.1)):
                        await truck.drive(speed, angle, -angle)
                        await clock.sleep(0.1)

                start = rig.world.truth(clock.now())
                cos, sin = math.cos(start.yaw), math.sin(start.yaw)
                post = Disc(start.x + 0.6 * cos - 0.3 * sin, start.y + 0.6 * sin + 0.3 * cos, 0.05)
                rig.world.add(clock.now(), post)
                await truck.arm()
                await drive(0.2, 0.0, 6.0)
                passed = rig.world.truth(clock.now())
                assert math.dist((passed.x, passed.y), (start.x, start.y)) > 1.0
                await drive(0.0, 0.3, 1.0)
                gate.drain()
                await drive(-0.15, 0.3, 6.0)
                end = rig.world.truth(clock.now())
                assert not rig.truth.array()[:, 5].any(), "touched"
                assert math.dist((end.x, end.y), (passed.x, passed.y)) > 0.05, "backed up to it"
                return {reason for state in gate.drain() for reason in state.reasons}

    assert Reason.OBSTACLE_STOP in run_virtual(main, start=SECOND)


def pushed(overlay: dict[str, Any], reason: Reason) -> tuple[float, float]:
    """Back into a post with the second control held, for 10 s.

    Returns:
        Time from contact to the first gate state with the reason, s; distance from the place of contact at the end, m.
    """
    config = load_config(YARD, SimulatedTruckConfig)[0].model_copy(update={"recorder": None})
    config = with_overlay(config, overlay)

    async def main(clock: VirtualClock) -> tuple[float, float]:
        rig = VirtualRig(config, clock)
        with rig.bus.subscribe(topics.GATE, fifo(4096)) as gate:
            async with rig.running():
                await clock.sleep(3.0)
                hand = LocalOperator(rig.daemon, clock, "hand", Role.GAMEPAD)
                start = rig.world.truth(clock.now())
                cos, sin = math.cos(start.yaw), math.sin(start.yaw)
                rig.world.add(clock.now(), Disc(start.x - 0.4 * cos, start.y - 0.4 * sin, 0.05))
                await hand.order(Order.ARM)
                touched = noticed = None
                place = (start.x, start.y)
                for _ in range(200):
                    header = await hand.header(0.25)
                    motion = {"speed": -0.1, "front": 0.0, "rear": 0.0, "unseen": True}
                    rig.bus.inject(topics.REQ_DRIVE, DriveRequest(**header, **motion))
                    await clock.sleep(0.05)
                    true = rig.world.truth(clock.now())
                    if true.stuck and touched is None:
                        touched, place = clock.now(), (true.x, true.y)
                    if noticed is None and any(reason in state.reasons for state in gate.drain()):
                        noticed = clock.now()
                assert touched is not None
                assert noticed is not None
                end = rig.world.truth(clock.now())
                return (noticed - touched) / SECOND, math.dist((end.x, end.y), place)

    return run_virtual(main, start=SECOND)


def test_a_contact_in_a_confirmed_drive_is_noticed_within_three_tenths_of_a_second_and_backed_off():
    seconds, metres = pushed({}, Reason.CONTACT)
    assert 0.0 <= seconds <= 0.3
    assert metres == pytest.approx(0.03, abs=0.015)


def test_a_contact_that_neither_motor_nor_gyroscope_shows_is_noticed_by_the_scans():
    """As of a drive that measures no current: the wheels turn, and the scans show a robot that stands."""
    seconds, metres = pushed({"gate": {"contact": {"rise": 10.0, "rolling": 2.0}}}, Reason.CONTACT)
    assert 0.0 <= seconds <= 0.5
    assert metres == pytest.approx(0.03, abs=0.015)
