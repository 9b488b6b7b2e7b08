"""Drills of families: the judge flags runs that are known to be unsafe, and trials end as they should."""

import asyncio
import contextlib
import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from monstertruck_drivers.cable import MemoryPort
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import InputError
from monstertruck_schemas import topics
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Order
from monstertruck_schemas.state import GateMode
from monstertruck_sim.families import families
from monstertruck_sim.faults import Fault, apply, command, place_obstacle
from monstertruck_sim.world.obstacles import Disc
from monstertruck_sim.world.world import World
from monstertruckd.bus.local import Bus
from monstertruckd.config.load import load_config
from monstertruckd.tools.drill.campaign import (
    LEG,
    Campaign,
    Trial,
    TrialOutcome,
    drives_again,
    recovers,
    run_trials,
)
from monstertruckd.tools.drill.judge import WorldJudge
from monstertruckd.tools.drill.observer import Observer
from monstertruckd.tools.drill.random_drill import wired
from monstertruckd.tools.drill.truck import DrillTruck, Wanderer
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(120)]

CONFIGS = Path(__file__).resolve().parents[2] / "configs"


@cache
def demo() -> SimulatedTruckConfig:
    config = load_config(CONFIGS / "demo.yaml", SimulatedTruckConfig)[0]
    return config.model_copy(update={"recorder": None, "blackbox": None})


# The judge: worlds without a daemon, moved by the test


class Scene:
    """A world, its judge, and time that the test lets pass."""

    def __init__(self, clock: VirtualClock) -> None:
        self.clock = clock
        self.world = World(demo().sim.world, seed=1)
        self.judge = WorldJudge(self.world, clock)

    def motor(self, rpm: float | None, ramp: float = 1e5) -> None:
        """Forwards positive; None switches off."""
        self.world.motors[0].command(self.clock.now(), None if rpm is None else -rpm, ramp)

    def post(self, gap: float, *, behind: bool = False) -> None:
        truth = self.world.truth(self.clock.now())
        away = (demo().sim.world.truck.length / 2 + gap + 0.1) * (-1 if behind else 1)
        x, y = truth.x + away * math.cos(truth.yaw), truth.y + away * math.sin(truth.yaw)
        self.world.add(self.clock.now(), Disc(x, y, 0.1))


async def cruise(scene: Scene) -> None:
    scene.judge.arm()
    scene.motor(10_000)
    await scene.clock.sleep(1.0)


async def drives_on(scene: Scene) -> None:
    """An order to stop that nothing obeys."""
    await cruise(scene)
    scene.judge.forbid()
    await scene.clock.sleep(1.5)


async def creeps(scene: Scene) -> None:
    """So slowly that only time tells."""
    scene.judge.forbid()
    scene.motor(900)
    await scene.clock.sleep(1.5)


async def rolls_fast(scene: Scene) -> None:
    """It stands within a second, but too far away."""
    scene.judge.arm()
    scene.motor(60_000, 1e6)
    await scene.clock.sleep(1.0)
    scene.judge.forbid()
    await scene.clock.sleep(0.4)
    scene.motor(0, 1e6)
    await scene.clock.sleep(0.5)


async def sets_off_again(scene: Scene) -> None:
    """It stood, as it should, and sets off again though still forbidden."""
    await cruise(scene)
    scene.judge.forbid()
    scene.motor(0)
    await scene.clock.sleep(2.0)
    scene.motor(5_000)
    await scene.clock.sleep(1.0)


async def hits_ahead(scene: Scene) -> None:
    scene.judge.arm()
    scene.post(0.2)
    scene.motor(10_000)
    await scene.clock.sleep(2.5)


async def hits_behind(scene: Scene) -> None:
    scene.judge.arm()
    scene.post(0.2, behind=True)
    scene.motor(-10_000)
    await scene.clock.sleep(2.5)


async def hits_behind_on_confirmed_ground(scene: Scene) -> None:
    scene.judge.arm()
    scene.post(0.05, behind=True)
    scene.motor(-2_000)
    for _ in range(30):
        scene.judge.confirm()
        await scene.clock.sleep(0.1)
    assert scene.judge.confirmed_contacts == 1


async def hits_behind_long_after_a_confirmation(scene: Scene) -> None:
    scene.judge.confirm()
    await scene.clock.sleep(0.6)
    await hits_behind(scene)
    assert scene.judge.confirmed_contacts == 0


async def leaves_a_target(scene: Scene) -> None:
    """Held by hand it stands; the motor still wants to turn."""
    scene.judge.forbid()
    scene.world.block_shaft(scene.clock.now(), 0, on=True)
    scene.motor(5_000)
    await scene.clock.sleep(1.0)
    scene.judge.check_left()


async def stops(scene: Scene) -> None:
    await cruise(scene)
    scene.judge.forbid()
    scene.motor(0)
    await scene.clock.sleep(3.0)
    scene.judge.check_left()


async def coasts(scene: Scene) -> None:
    await cruise(scene)
    scene.judge.forbid()
    scene.motor(None)
    await scene.clock.sleep(3.0)
    scene.judge.check_left()


async def drives_while_permitted(scene: Scene) -> None:
    scene.judge.forbid()
    scene.judge.arm()
    scene.motor(-5_000)
    await scene.clock.sleep(2.0)


async def stands_beside_something(scene: Scene) -> None:
    scene.post(0.01)
    scene.judge.forbid()
    await scene.clock.sleep(2.0)


def judged(run: Callable[[Scene], object]) -> WorldJudge:
    async def main(clock: VirtualClock) -> WorldJudge:
        scene = Scene(clock)
        watching = asyncio.create_task(scene.judge.run())
        await run(scene)  # type: ignore[misc]
        watching.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await watching
        return scene.judge

    return run_virtual(main)


@pytest.mark.parametrize(
    ("run", "rules"),
    [
        (drives_on, {"motion"}),
        (creeps, {"motion"}),
        (rolls_fast, {"motion"}),
        (sets_off_again, {"motion"}),
        (hits_ahead, {"contact"}),
        (hits_behind, {"contact"}),
        (hits_behind_long_after_a_confirmation, {"contact"}),
        (hits_behind_on_confirmed_ground, set()),
        (leaves_a_target, {"left behind"}),
        (stops, set()),
        (coasts, set()),
        (drives_while_permitted, set()),
        (stands_beside_something, set()),
    ],
)
def test_the_judge_flags_what_is_unsafe_and_nothing_else(run: Callable[[Scene], object], rules: set[str]) -> None:
    assert {violation.rule for violation in judged(run).violations} == rules


def test_the_judge_measures_travel_and_standstill_from_the_order() -> None:
    judge = judged(stops)
    assert judge.standstill is not None
    assert 0 < judge.standstill < 0.5
    assert 0 < judge.travelled < 0.1


# The operator


def test_a_wanderer_drives_in_both_directions_and_steers_in_every_way() -> None:
    async def main(clock: VirtualClock) -> None:
        config = with_overlay(wired(demo()), {"tracker": None, "path": None})
        async with DrillTruck.running(config, clock, wander=np.random.default_rng(2), judged=True) as truck:
            station = truck.station
            assert isinstance(station, Wanderer)
            seen = set()
            for _ in range(200):
                station.choose()
                rear = 0 if station.rear == 0 else math.copysign(1, station.rear * station.front)
                seen.add((station.speed > 0, rear))
                assert -config.gate.reverse_speed <= station.speed <= config.gate.speed
                assert max(abs(station.front), abs(station.rear)) <= config.gate.angle
            assert seen == {(forward, rear) for forward in (True, False) for rear in (0, 1, -1)}
            assert await truck.until(truck.drives, 15.0, Order.ARM)
            station.choose(backwards=True)
            assert await truck.until(lambda: truck.speed < -0.03, 5.0, Order.ARM)

    run_virtual(main)


@pytest.mark.parametrize("name", sorted(path.stem for path in (CONFIGS / "robots").glob("*.yaml")))
def test_a_wanderer_asks_a_body_for_nothing_impossible_and_for_all_that_it_can_do(name: str) -> None:
    config = load_config(CONFIGS / "robots" / f"{name}.yaml", SimulatedTruckConfig)[0]
    chassis = config.chassis()

    async def main(clock: VirtualClock) -> set[tuple[bool, ...]]:
        station = Wanderer(Bus(clock), clock, config, np.random.default_rng(1), lambda: None)
        twists = set()
        for _ in range(300):
            station.choose()
            if station.twist is None:
                assert chassis.refusal(station.front, station.rear) is None
                continue
            assert (station.speed, station.front, station.rear) == (0.0, 0.0, 0.0)
            twist = station.twist.vx, station.twist.vy, station.twist.wz
            chassis.possible(twist)
            twists.add(tuple(map(bool, twist)))
        return twists

    sideways = {(False, True, False)} if name in {"mecanum", "omni", "independent"} else set()
    on_the_spot = {"differential", "skid_steer", "skid_stand", "sonar", "turtle"}
    turns = {(False, False, True)} if sideways or name in on_the_spot else set()
    assert run_virtual(main) == turns | sideways


@pytest.mark.parametrize("place", [(1.34, 0.0, 0.0), (-1.34, -1.34, math.pi / 4), (0.0, 1.34, 1.0)])
def test_the_operator_of_a_robot_without_range_sensors_looks_where_it_drives(place: tuple[float, float, float]) -> None:
    config = load_config(CONFIGS / "robots" / "skid_stand.yaml", SimulatedTruckConfig)[0]

    async def main(clock: VirtualClock) -> None:
        async with DrillTruck.running(
            wired(config.model_copy(update={"recorder": None})), clock, wander=np.random.default_rng(3), judged=True
        ) as truck:
            judge, moved = truck.judge, 0
            assert judge is not None
            truck.rig.world.carry(clock.now(), place)
            assert await truck.until(lambda: abs(truck.speed) > 0.03, 15.0, Order.ARM)
            for _ in range(600):
                await clock.sleep(0.05)
                moved += abs(truck.speed) > 0.01
            assert judge.violations == ()
            assert moved > 150, "it goes on driving"

    run_virtual(main)


@pytest.mark.parametrize(("name", "sees_ahead", "sees_behind"), [("sonar", True, False), ("skid_stand", False, False)])
def test_the_operator_looks_where_the_robot_has_no_range_sensor(name: str, sees_ahead: bool, sees_behind: bool) -> None:
    config = load_config(CONFIGS / "robots" / f"{name}.yaml", SimulatedTruckConfig)[0]

    async def main(clock: VirtualClock) -> None:
        wander = np.random.default_rng(1)
        async with DrillTruck.running(wired(config), clock, wander=wander, judged=True) as truck:
            world, now, station = truck.rig.world, clock.now(), truck.station
            assert isinstance(station, Wanderer)
            truth, away = world.truth(now), config.sim.world.truck.length / 2 + 0.2
            for side in (1, -1):
                x, y = truth.x + side * away * math.cos(truth.yaw), truth.y + side * away * math.sin(truth.yaw)
                world.add(now, Disc(x, y, 0.1))
            assert station._clear((0.2, 0.0, 0.0)) is sees_ahead
            assert station._clear((-0.2, 0.0, 0.0)) is sees_behind

    run_virtual(main)


def test_a_wanderer_that_is_refused_unseen_ground_holds_the_second_control_after_a_while() -> None:
    async def main(clock: VirtualClock) -> None:
        config = with_overlay(wired(demo()), {"tracker": None, "path": None})
        async with DrillTruck.running(config, clock, wander=np.random.default_rng(2), judged=True) as truck:
            station, judge = truck.station, truck.judge
            assert isinstance(station, Wanderer)
            assert judge is not None
            station.choose(backwards=True)  # it has just been armed: nothing behind it has been seen
            assert await truck.until(lambda: truck.speed < -0.03, 5.0, Order.ARM)
            assert truck.gate is not None
            assert Reason.UNSEEN_DRIVE in truck.gate.reasons
            station.run_up(6.0)
            begin = judge.place
            assert await truck.until(lambda: math.dist(judge.place, begin) > 0.7, 6.0, Order.ARM)
            station.choose(backwards=True)
            assert await truck.until(lambda: truck.speed < -0.06, 2.0, Order.ARM), "over ground that it has seen"
            assert not station.unseen

    run_virtual(main)


def test_an_operator_takes_over_where_something_is_in_the_way_of_a_tracker() -> None:
    async def main(clock: VirtualClock) -> None:
        wander = np.random.default_rng(2)
        async with DrillTruck.running(wired(demo()), clock, wander=wander, judged=True, by_hand=False) as truck:
            assert await truck.until(truck.drives, 15.0, Order.ARM)
            await truck.order(Order.DISARM)
            await clock.sleep(1.0)
            await apply(place_obstacle(0.1), truck.rig.context)
            assert await drives_again(truck)
            assert truck.by_hand

    run_virtual(main)


@pytest.mark.long
def test_an_operator_gives_the_planner_one_goal_after_another() -> None:
    config = load_config(CONFIGS / "goals.yaml", SimulatedTruckConfig)[0].model_copy(update={"recorder": None})

    async def main(clock: VirtualClock) -> None:
        wander = np.random.default_rng(2)
        async with DrillTruck.running(wired(config), clock, wander=wander, judged=True, by_hand=False) as truck:
            assert await truck.until(truck.drives, 30.0, Order.ARM)
            first = truck.rig.bus.newest(topics.GOAL)
            assert first is not None
            await truck.operator.call("goal_control", {**await truck.operator.header(), "order": "cancel"})
            await clock.sleep(1.5)
            second = truck.rig.bus.newest(topics.GOAL)
            assert second is not None
            assert second.number > first.number
            assert second.goal != first.goal

    run_virtual(main)


@pytest.mark.long
def test_a_robot_with_a_planner_is_driven_by_hand_in_most_legs_and_to_goals_in_every_fourth() -> None:
    config = load_config(CONFIGS / "goals.yaml", SimulatedTruckConfig)[0].model_copy(update={"recorder": None})
    legs = Campaign(3, 4 * LEG, config).legs()
    followed = [run_trials(replace(leg, count=1))[0].followed for leg in legs[2:]]
    assert followed == [False, True]


@pytest.mark.long
def test_a_pack_that_seemed_critical_keeps_a_robot_waiting_and_is_not_stuck(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("monstertruckd.tools.drill.campaign.RECOVERY_LIMIT", 5.0)
    config = load_config(CONFIGS / "full.yaml", SimulatedTruckConfig)[0].model_copy(update={"recorder": None})

    async def main(clock: VirtualClock) -> None:
        async with DrillTruck.running(wired(config), clock, wander=np.random.default_rng(2), judged=True) as truck:
            assert await truck.until(truck.drives, 15.0, Order.ARM)
            channel = config.devices.steering.driver.battery.channel  # type: ignore[union-attr]
            signals = truck.rig.context.signals("steering")
            signals.inject(f"position_{channel}", "scaled", "0.75")
            assert await truck.until(lambda: Reason.BATTERY_CRITICAL in truck.blockers(), 20.0)
            signals.inject(f"position_{channel}", "off")
            begin = clock.now()
            assert await recovers(truck)
            assert (clock.now() - begin) / SECOND > 6.0

    run_virtual(main)


def test_a_robot_whose_stabiliser_turned_by_itself_recovers_once_an_operator_has_reset_it() -> None:
    config = load_config(CONFIGS / "full.yaml", SimulatedTruckConfig)[0].model_copy(update={"recorder": None})
    config = with_overlay(wired(config), {"tracker": None, "path": None})

    async def main(clock: VirtualClock) -> None:
        async with DrillTruck.running(config, clock, wander=np.random.default_rng(2), judged=True) as truck:
            assert await truck.until(truck.drives, 15.0, Order.ARM)
            signals = truck.rig.context.signals("stabiliser")
            signals.inject("goal_position_2", "scaled", "2.5")
            assert await truck.until(lambda: Reason.UNCOMMANDED_MOTION in truck.blockers(), 3.0)
            signals.inject("goal_position_2", "off")
            assert await recovers(truck)
            assert await drives_again(truck)

    run_virtual(main)


# A stalled computer


def test_devices_keep_their_own_time_while_the_computer_is_stalled() -> None:
    async def main(clock: VirtualClock) -> None:
        async with DrillTruck.running(wired(demo()), clock, judged=True) as truck:
            assert await truck.until(truck.drives, 15.0, Order.ARM)
            firmware = truck.rig.robot.emulators["drive"].firmware  # type: ignore[attr-defined]
            began = clock.now()
            clock.stall(1.0)
            stopping = asyncio.create_task(truck.order(Order.DISARM))
            await clock.sleep(0.4)
            assert firmware.quick_stop_input, "the deadman line"
            await clock.sleep(0.4)
            assert abs(truck.speed) < 0.01
            assert truck.gate is not None
            assert truck.gate.stamp <= began
            assert truck.gate.mode is GateMode.DRIVING
            assert not stopping.done()
            await clock.sleep(1.0)
            assert stopping.done()
            assert truck.gate.mode is GateMode.DISARMED

    run_virtual(main)


# Trials


def campaign(count: int = LEG, first: int = 0) -> Campaign:
    return Campaign(5, count, demo(), first=first)


def test_parts_of_a_drill_add_up_and_are_not_run_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def quick(leg) -> list[TrialOutcome]:  # type: ignore[no-untyped-def]
        ran.append(leg.number)
        numbers = range(leg.number * LEG, leg.number * LEG + leg.count)
        return [TrialOutcome(number, ("a",), ("a",), False, False, recovered_s=0.5) for number in numbers]

    monkeypatch.setattr("monstertruckd.tools.drill.campaign.run_trials", quick)
    ran: list[int] = []
    one, other, whole = (tmp_path / name for name in ("one", "other", "whole"))
    campaign(2 * LEG).run(resume=one)
    campaign(3 * LEG + 5, first=2 * LEG).run(resume=other)
    assert ran == [0, 1, 2, 3]
    whole.write_bytes(one.read_bytes() + other.read_bytes())
    report = campaign(3 * LEG + 5).run(resume=whole)
    assert ran == [0, 1, 2, 3]
    assert [o.number for o in report.outcomes] == list(range(3 * LEG + 5))
    assert report.figures()["trials"] == 3 * LEG + 5


def test_a_beginning_inside_a_leg_is_refused() -> None:
    with pytest.raises(InputError, match=f"expected a multiple of {LEG}"):
        campaign(first=LEG - 1)


@pytest.mark.long
def test_trials_have_pairs_both_directions_and_families_of_every_device() -> None:
    outcomes = run_trials(Campaign(3, 6, demo()).legs()[0])
    assert [outcome.number for outcome in outcomes] == list(range(6))
    assert {len(outcome.faults) for outcome in outcomes} == {1, 2}
    assert not any(outcome.stuck for outcome in outcomes), outcomes
    again = run_trials(Campaign(3, 6, demo()).legs()[0])
    assert again == outcomes


def test_reasons_of_the_start_and_of_earlier_faults_still_explain_a_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    fault = Fault("stall", command("lidar", "line stalled on"), command("lidar", "line stalled off"), 1.0)
    trial = Trial((fault,), ("stall",), backwards=False, between=0.0)
    monkeypatch.setattr("monstertruckd.tools.drill.campaign._Draw.__call__", lambda _: trial)
    outcomes = run_trials(campaign(2).legs()[0])
    assert [outcome.reason for outcome in outcomes] == [Reason.SCAN_STALE] * 2


@pytest.mark.long
@pytest.mark.parametrize("name", ["skid_steer", "sonar", "differential", "skid_stand", "mecanum", "ackermann"])
def test_any_robot_can_be_drilled(name: str) -> None:
    config = load_config(CONFIGS / "robots" / f"{name}.yaml", SimulatedTruckConfig)[0]
    outcomes = run_trials(Campaign(3, 2, config.model_copy(update={"recorder": None})).legs()[0])
    assert [outcome.stuck for outcome in outcomes] == [(), ()]


def test_the_families_of_a_running_truck_are_those_of_signals_in_use() -> None:
    async def main(clock: VirtualClock) -> None:
        async with DrillTruck.running(wired(demo()), clock, judged=True) as truck:
            assert await truck.until(truck.drives, 15.0, Order.ARM)
            found = {family.name for family in families(truck.rig.robot, used=True)}
            assert {"drive target_velocity ignored", "lidar range frozen", "steering target_0 late"} <= found
            assert "drive velocity_demand frozen" not in found, "the driver never reads it"

    run_virtual(main)


# A motor controller of a kind of one's own


def own_drive() -> SimulatedTruckConfig:
    """The demo's truck with a motor controller whose protocol nobody here knows."""
    config = demo()
    assert config.devices.drive is not None
    driver = config.devices.drive.driver.model_copy(update={"kind": "own"})
    drive = config.devices.drive.model_copy(update={"driver": driver})
    return config.model_copy(update={"devices": config.devices.model_copy(update={"drive": drive})})


def test_a_motor_controller_of_any_kind_is_judged_by_what_its_motors_do() -> None:
    config = own_drive()

    async def main(clock: VirtualClock) -> None:
        world = World(config.sim.world, seed=1)
        ports = {role: MemoryPort(role) for role in config.devices.present()}
        observer = Observer(config, world, ports, clock)
        watching = asyncio.create_task(observer.run())
        world.motors[0].command(clock.now(), -10_000, 5e4)
        await clock.sleep(1.0)
        observer.begin(stops=True)
        assert observer.stop_bytes_after() is None
        await clock.sleep(0.2)
        world.motors[0].command(clock.now(), 0.0, 5e4)
        await clock.sleep(0.5)
        after = observer.stop_bytes_after()
        assert after is not None
        assert 0.2 < after < 0.5
        assert observer.violations() == ()
        observer.disarm()
        world.motors[0].command(clock.now(), -10_000, 5e4)
        await clock.sleep(1.0)
        assert "disarmed" in {violation.rule for violation in observer.violations()}
        watching.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await watching

    run_virtual(main)
