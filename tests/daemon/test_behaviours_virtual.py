"""Behaviours in the whole daemon: a robot with two wheels follows a wall of the hall by sonars of its world."""

import asyncio
from pathlib import Path

import numpy as np
import pytest

from monstertruck_planners.behave.wall.config import WallPdConfig
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import RequestRefusedError
from monstertruck_runtime.mailbox import fifo
from monstertruck_schemas import topics
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import BehaviourOrder
from monstertruck_schemas.topics import Writer
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig
from tests.unit.planners.behave.wall_kit import sonars

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(300)]

FILE = Path(__file__).resolve().parents[2] / "configs" / "robots" / "differential.yaml"
PLACES = {"l": (0.1, 0.05, 90), "fl": (0.15, 0.05, 45), "f": (0.2, 0.0, 0), "fr": (0.15, -0.05, -45)}
"""Ahead of the axle, where the published gains are damped."""


async def hear(rig: VirtualRig, out, clock: VirtualClock) -> None:
    """Beams from where the robot really is, at 10 Hz."""
    while True:
        truth, now = rig.world.truth(clock.now()), clock.now()
        c, s = np.cos(truth.yaw), np.sin(truth.yaw)
        ranges = {}
        for name, (px, py, angle) in PLACES.items():
            place = np.array([truth.x + c * px - s * py]), np.array([truth.y + s * px + c * py])
            reach = float(
                rig.world.scene.cast(*place, np.array([truth.yaw + np.radians(angle)]), 3.0, without=rig.world.name)[0]
            )
            ranges[name] = reach if 0.0 < reach < np.inf else None
        out.put(sonars(ranges, now=now))
        await clock.sleep(0.1)


def follow(seconds: float, *, deaf_after: float | None = None):
    config, _ = load_config(FILE, SimulatedTruckConfig)
    behaviours = {"wall": WallPdConfig(distance=0.65, offset=0.05, seen=0.8)}
    config = config.model_copy(update={"recorder": None, "tracker": None, "path": None, "behaviours": behaviours})

    async def main(clock: VirtualClock):
        rig = VirtualRig(config, clock)
        bus = rig.daemon.bus
        out = bus.publisher(topics.SONAR, Writer.DRIVER)
        with bus.subscribe(topics.BEHAVIOUR, fifo(4096)) as states:
            async with rig.running():
                operator = LocalOperator(rig.daemon, clock)
                await clock.sleep(2.0)

                async def order(order: BehaviourOrder) -> dict:
                    return await operator.call(
                        "behave", {**await operator.header(), "order": order, "behaviour": "wall"}
                    )

                await operator.arm()
                with pytest.raises(RequestRefusedError) as caught:
                    await order(BehaviourOrder.START)
                assert caught.value.refusal is Reason.INPUT_STALE
                hearing = asyncio.create_task(hear(rig, out, clock))
                await clock.sleep(0.3)
                assert (await operator.call("behaviours"))["wall"]["kind"] == "wall_pd"
                assert await order(BehaviourOrder.START) == {"number": 1}
                await clock.sleep(deaf_after or seconds)
                if deaf_after is not None:
                    hearing.cancel()
                    await clock.sleep(seconds - deaf_after)
                else:
                    await order(BehaviourOrder.STOP)
                    await clock.sleep(2.0)
                hearing.cancel()
                truth = rig.truth.array()
            return list(states.drain()), truth

    return run_virtual(main, start=SECOND)


def test_it_follows_a_wall_through_gate_and_drives_until_it_is_stopped():
    states, truth = follow(8.5)
    assert states[-1].outcome is Reason.CANCELLED
    assert states[-1].travelled > 1.0
    assert not truth[:, 5].any()
    assert np.abs(np.diff(truth[-20:, 1:3], axis=0)).max() < 1e-3
    distances = [state.values["distance"] for state in states if state.phase == "follow"]
    assert distances
    assert np.median(distances[-10:]) == pytest.approx(0.65, abs=0.05)


def test_without_sonars_it_stops_with_its_reason():
    states, truth = follow(8.0, deaf_after=4.0)
    assert states[-1].outcome is Reason.INPUT_STALE
    assert not truth[:, 5].any()
    assert np.abs(np.diff(truth[-20:, 1:3], axis=0)).max() < 1e-3


def test_the_robot_with_five_sonars_follows_a_wall_of_the_yard_by_its_own_devices():
    config, _ = load_config(FILE.with_name("sonar.yaml"), SimulatedTruckConfig)
    world = {"start": {"x": -1.0, "y": 3.15, "yaw": 0.0}, "sonar": {"model": "beam"}}
    config = with_overlay(config, {"recorder": None, "sim": {"world": world}})

    async def main(clock: VirtualClock):
        rig = VirtualRig(config, clock)
        with rig.daemon.bus.subscribe(topics.BEHAVIOUR, fifo(4096)) as states:
            async with rig.running():
                operator = LocalOperator(rig.daemon, clock)
                await clock.sleep(2.0)
                await operator.arm()
                order = {**await operator.header(), "order": BehaviourOrder.START, "behaviour": "wall_left"}
                await operator.call("behave", order)
                await clock.sleep(9.0)
                truth = rig.truth.array()
            return list(states.drain()), truth

    states, truth = run_virtual(main, start=SECOND)
    assert states[-1].running or states[-1].outcome is Reason.SHUTDOWN
    assert not truth[:, 5].any()
    assert truth[-1, 1] - truth[0, 1] > 1.2
    assert 3.5 - 0.05 - truth[-40:, 2].mean() == pytest.approx(0.30, abs=0.03)  # of the sonar from the wall


def along_the_yard(start, seconds, *, fault=None, at=14.0):
    """Method 3 in the yard."""
    config, _ = load_config(FILE.with_name("sonar.yaml"), SimulatedTruckConfig)
    x, y, yaw = start
    config = with_overlay(config, {"recorder": None, "sim": {"world": {"start": {"x": x, "y": y, "yaw": yaw}}}})
    return followed(config, "line_left", seconds, fault=fault, at=at)


def followed(config, behaviour, seconds, *, fault=None, at=14.0):
    """A behaviour by the robot's own devices; after so many seconds a fault acts on the rig."""

    async def main(clock: VirtualClock):
        rig = VirtualRig(config, clock)
        with rig.daemon.bus.subscribe(topics.BEHAVIOUR, fifo(4096)) as states:
            async with rig.running():
                operator = LocalOperator(rig.daemon, clock)
                await clock.sleep(2.0)
                await operator.arm()
                order = {**await operator.header(), "order": BehaviourOrder.START, "behaviour": behaviour}
                await operator.call("behave", order)
                await clock.sleep(min(at, seconds))
                if fault is not None:
                    fault(rig)
                await clock.sleep(max(seconds - at, 0.0))
                truth = rig.truth.array()
            return list(states.drain()), truth

    return run_virtual(main, start=SECOND)


@pytest.mark.long
def test_method_3_finds_a_wall_of_the_yard_passes_a_niche_and_turns_in_a_corner_by_its_own_devices():
    states, truth = along_the_yard((1.6, 0.7, 0.4), 38.0)
    assert states[-1].running or states[-1].outcome is Reason.SHUTDOWN
    assert not truth[:, 5].any()
    phases = [state.phase for state in states]
    order = [phase for i, phase in enumerate(phases) if phase and phase != phases[i - 1]]
    assert order == ["settle", "search", "brake", "turn", "follow", "brake", "turn", "follow"]
    sides = truth[:, 1] + 0.05 * np.cos(truth[:, 3]) - 0.05 * np.sin(truth[:, 3])  # x of the left sonar, heading south
    south = (truth[:, 2] < 0.0) & (truth[:, 2] > -2.6) & (np.abs(truth[:, 3] + np.pi / 2) < 0.1)
    assert south.sum() > 100
    assert np.abs(3.5 - sides[south] - 0.30).max() < 0.015


@pytest.mark.parametrize(
    ("fault", "outcome"),
    [
        (lambda rig: rig.ports["imu"].unplug(), Reason.INPUT_STALE),
        pytest.param(
            lambda rig: rig.robot.emulators["sonar"].inject("dead", "l", "on"),
            Reason.INPUT_STALE,
            marks=pytest.mark.long,
        ),
        pytest.param(
            lambda rig: rig.robot.emulators["sonar"].inject("stuck", "fl", "on"),
            Reason.INPUT_CONTRADICTORY,
            marks=pytest.mark.long,
        ),
    ],
    ids=["imu unplugged", "sonar dead", "sonar stuck"],
)
def test_a_fault_along_a_wall_stops_method_3_with_its_reason(fault, outcome):
    states, truth = along_the_yard((2.6, 1.0, 0.3), 20.0, fault=fault)
    assert any(state.phase == "follow" for state in states)
    assert not states[-1].running
    assert states[-1].outcome is outcome
    assert not truth[:, 5].any()
    assert np.abs(np.diff(truth[-20:, 1:3], axis=0)).max() < 1e-3


@pytest.mark.long
def test_the_truck_follows_walls_by_sonars_computed_from_its_lidar():
    wall = {
        "kind": "wall_pd", "distance": 0.45, "offset": 0.05, "speed": 0.15, "k_p": 3.0, "k_d": 6.0, "trigger": 0.85,
        "seen": 0.8, "free": 1.1, "gap": 0.6, "aligned": 0.0, "safety": 0.4,
    }  # fmt: skip
    bare = dict.fromkeys(("recorder", "path", "tracker", "slam", "map", "planner"))
    config, _ = load_config(FILE.parents[1] / "demo.yaml", SimulatedTruckConfig)
    config = with_overlay(
        config, {**bare, "lidar_sonars": {}, "behaviours": {"wall": wall}, "sim": {"world": {"map": "yard"}}}
    )
    states, truth = followed(config, "wall", 58.0)
    assert not truth[:, 5].any()
    phases = [state.phase for state in states]
    assert phases.count("turn_away") > 2
    behind = [state.values["distance"] for state in states if state.phase == "follow" and state.elapsed > 53.0]
    assert behind
    assert np.abs(np.array(behind) - 0.45).max() < 0.06
