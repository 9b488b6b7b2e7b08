"""Two daemons in one world on one virtual clock: they see each other, bump into each other, and people walk."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.mailbox import fifo
from monstertruck_schemas import topics
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import BehaviourOrder
from monstertruck_sim.world.scene import Contact
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig
from tests.fleet_kit import virtual_fleet

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(120)]

FOLDER = Path(__file__).resolve().parents[2] / "configs" / "fleet"
BLIND = {"devices": {"lidar": None}, "gate": {"speed": 0.2, "scan": {"critical": False}}}


def fleet(**overlays: dict[str, Any]) -> list[SimulatedTruckConfig]:
    """``leader`` and ``second``, each with an overlay."""
    loaded = [load_config(FOLDER / f"{name}.yaml", SimulatedTruckConfig)[0] for name in ("leader", "second")]
    return [with_overlay(config, {"recorder": None, **overlays.get(config.robot, {})}) for config in loaded]


async def start(rig: VirtualRig, clock: VirtualClock, behaviour: str = "move", **settings: Any) -> None:
    operator = LocalOperator(rig.daemon, clock, source=f"operator_{behaviour}")
    await operator.arm()
    order = {"order": BehaviourOrder.START, "behaviour": behaviour, "settings": settings}
    await operator.call("behave", {**await operator.header(), **order})


def drive(*configs: SimulatedTruckConfig, seconds: float = 12.0) -> tuple[list[VirtualRig], list[Contact], Reason]:
    """The second robot drives 2 m ahead, to where the first one stands."""

    async def main(clock: VirtualClock) -> tuple[list[VirtualRig], list[Contact], Reason]:
        async with virtual_fleet(configs, clock) as (rigs, scene):
            with rigs[1].bus.subscribe(topics.BEHAVIOUR, fifo(4096)) as states:
                await clock.sleep(2.0)
                await start(rigs[1], clock, length=2.0)
                await clock.sleep(seconds)
                return rigs, scene.contacts, [*states.drain()][-1].outcome

    return run_virtual(main, start=SECOND)


def test_a_robot_stops_before_another_that_its_lidar_sees():
    rigs, contacts, outcome = drive(*fleet())
    assert outcome is Reason.OBSTACLE_STOP
    assert contacts == []
    gap = rigs[0].truth.array()[-1, 1] - rigs[1].truth.array()[-1, 1] - 0.47
    assert 0.02 < gap < 0.3


@pytest.mark.long
def test_in_three_dimensions_each_has_its_daemon_and_stops_before_the_other():
    world = {"engine": "mujoco", "ground": [{"kind": "hills", "height": 0.01, "wavelength": 1.5}]}
    near = {"x": -1.9, "y": 0.0, "yaw": 0.0}
    leader, second = (
        {"sim": {"world": world}},
        {"sim": {"world": {**world, "start": near}}, "odometry": {"start": near}},
    )
    rigs, contacts, _ = drive(*fleet(leader=leader, second=second), seconds=3.0)
    assert contacts == []
    x, speed = rigs[1].truth.array()[-1, [1, 4]]
    assert x - near["x"] > 0.1
    assert abs(speed) < 0.02, "before it stands the first one, 1.7 m before its goal"


def test_a_robot_without_eyes_stops_before_another_that_it_hears():
    rigs, contacts, outcome = drive(*fleet(second=BLIND), seconds=9.0)
    assert outcome is Reason.OBSTACLE_STOP
    assert contacts == []
    gap = rigs[0].truth.array()[-1, 1] - rigs[1].truth.array()[-1, 1] - 0.47
    assert 0.02 < gap < 0.3


@pytest.mark.long
def test_a_robot_without_eyes_and_ears_runs_into_it_and_the_world_says_so():
    leader, second = fleet(second=BLIND)
    rigs, contacts, outcome = drive(leader, second.model_copy(update={"peers": {}}))
    assert outcome is not Reason.BEHAVIOUR_DONE
    assert [(contact.mover, contact.other) for contact in contacts] == [("second", "leader")]
    assert contacts[0].speed == pytest.approx(0.15, abs=0.03)
    assert rigs[1].truth.array()[:, 5].any()


def test_a_robot_stops_for_somebody_who_walks_across():
    crossing = {
        "sim": {"world": {"people": ({"waypoints": ({"x": -1.5, "y": 1.5}, {"x": -1.5, "y": -1.5}), "speed": 0.5},)}}
    }
    away = {"odometry": {"start": {"x": 2.5, "y": 2.0, "yaw": 0.0}}}
    away["sim"] = {"world": {**crossing["sim"]["world"], "start": away["odometry"]["start"]}}
    _, contacts, _ = drive(*fleet(leader=away, second=crossing), seconds=14.0)
    assert [contact for contact in contacts if contact.mover == "second"] == []


def test_two_runs_of_a_fleet_are_the_same():
    def ends() -> list[float]:
        rigs, *_ = drive(*fleet(), seconds=2.0)
        return [float(value) for rig in rigs for value in rig.truth.array()[-1]]

    assert ends() == ends()


def test_the_stand_sees_each_robot_where_it_is():
    async def main(clock: VirtualClock) -> list[tuple[float, float]]:
        seen: list[float] = []
        async with virtual_fleet(fleet(), clock) as (rigs, _):
            for rig in rigs:
                rig.bus.tap(lambda _t, message, _d, _a: seen.append(message.pose.x), [topics.STAND_POSE])
            await clock.sleep(2.0)
        return seen

    seen = run_virtual(main, start=SECOND)
    assert {round(x, 1) for x in seen} == {-1.0, -2.2}


def test_robots_that_overlap_are_refused():
    overlapping = {"x": -1.1, "y": 0.0, "yaw": 0.0}

    async def main(clock: VirtualClock) -> None:
        async with virtual_fleet(fleet(second={"sim": {"world": {"start": overlapping}}}), clock):
            pass

    with pytest.raises(InputError, match="start: the robots leader and second overlap"):
        run_virtual(main, start=SECOND)


def follow(*, silent_after: float | None = None) -> tuple[list[VirtualRig], list[Contact], list[Any]]:
    """The truck drives ahead and round a bend, the second robot follows it."""

    async def main(clock: VirtualClock) -> tuple[list[VirtualRig], list[Contact], list[Any]]:
        async with virtual_fleet(fleet(), clock) as (rigs, scene):
            with rigs[1].bus.subscribe(topics.BEHAVIOUR, fifo(4096)) as states:
                await clock.sleep(2.0)
                await start(rigs[1], clock, "follow")
                await start(rigs[0], clock, length=1.5)
                if silent_after is not None:
                    await clock.sleep(silent_after)
                    await rigs[0].end_daemon()
                    await clock.sleep(3.0)
                else:
                    await clock.sleep(14.0)
                    await start(rigs[0], clock, radius=0.9, angle=1.7)
                    await clock.sleep(17.0)
                return rigs, scene.contacts, [*states.drain()]

    return run_virtual(main, start=SECOND)


@pytest.mark.long
def test_a_robot_follows_another_round_a_bend_at_its_distance():
    rigs, contacts, states = follow()
    assert contacts == []
    assert states[-1].outcome is Reason.DRIVING
    leader, second = (rig.truth.array() for rig in rigs)
    count = min(len(leader), len(second))
    apart = np.hypot(*(leader[:count, 1:3] - second[:count, 1:3]).T)
    assert apart.min() > 0.7
    assert apart[-1] == pytest.approx(1.0, abs=0.12)
    off = [np.hypot(*(leader[:, 1:3] - place).T).min() for place in second[:, 1:3] if place[0] > -1.0]
    assert max(off) < 0.12  # on the leader's way, not across the bend
    assert second[-1, 3] > 0.3


def test_a_leader_that_falls_silent_stops_its_follower_with_the_reason():
    rigs, contacts, states = follow(silent_after=5.0)
    assert contacts == []
    assert states[-1].outcome is Reason.INPUT_STALE
    assert states[-1].text.startswith("leader has been silent for 0.")
    assert abs(rigs[1].truth.array()[-1, 4]) < 1e-3
