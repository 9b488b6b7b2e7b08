"""Random faults on the whole daemon, on the virtual clock, and an observer that is not to be fooled."""

import asyncio
import contextlib
import json
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from monstertruck_drivers.cable import MemoryPort
from monstertruck_drivers.epos import objects as od
from monstertruck_drivers.epos.protocol import write_request
from monstertruck_drivers.steppers.protocol import Line
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.mailbox import fifo
from monstertruck_schemas import topics
from monstertruck_schemas.health import HealthTable
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Order
from monstertruck_schemas.state import GateMode
from monstertruck_sim.faults import CatalogFault, FaultCatalog, FaultKind, apply
from monstertruck_sim.world.obstacles import Disc
from monstertruck_sim.world.world import World
from monstertruckd.config.load import load_config
from monstertruckd.tools.drill.observer import Observer, Violation
from monstertruckd.tools.drill.random_drill import (
    TRACKER_IN_WORKER,
    Drill,
    DrillReport,
    FaultOutcome,
    run_leg,
    unguarded,
    wired,
)
from monstertruckd.tools.drill.truck import DrillTruck
from monstertruckd.tools.simulation.config import DEADMAN_LINE, SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

DEADMAN = {"map": None, **DEADMAN_LINE}
"""Wires the deadman line, and draws no map."""
pytestmark = [pytest.mark.virtual, pytest.mark.timeout(120)]

CONFIGS = Path(__file__).resolve().parents[2] / "configs"


@cache
def full() -> SimulatedTruckConfig:
    return load_config(CONFIGS / "full.yaml", SimulatedTruckConfig)[0]


@cache
def demo() -> SimulatedTruckConfig:
    return load_config(CONFIGS / "demo.yaml", SimulatedTruckConfig)[0]


@cache
def body(name: str) -> SimulatedTruckConfig:
    return load_config(CONFIGS / "robots" / f"{name}.yaml", SimulatedTruckConfig)[0]


def catalog_of(config: SimulatedTruckConfig) -> FaultCatalog:
    monitors, records = config.monitors.present(), config.recorder is not None
    return FaultCatalog(config.devices, monitors, records=records, restarts=True, workers=("tracking",))


@pytest.mark.parametrize("count", [4, pytest.param(16, marks=pytest.mark.long)])
def test_random_faults_end_safely_and_leave_nothing_behind(count: int):
    report = Drill(4, count, full(), leg=count).run()
    assert len(report.outcomes) == count
    assert [(o.fault, o.violations) for o in report.outcomes if o.violations] == []
    assert [(o.fault, o.stuck) for o in report.outcomes if o.stuck] == []
    assert all(o.standstill_s is not None and o.standstill_s <= 0.6 for o in report.outcomes if o.must_stop)
    assert report.score > 95


def test_a_drill_of_both_hubs_has_them_back_in_two_seconds():
    drill = Drill(1, 2, full(), leg=2, faults=[FaultKind.RAIL_ELECTRONICS])
    outcomes = drill.run().outcomes
    assert [outcome.kind for outcome in outcomes] == [FaultKind.RAIL_ELECTRONICS] * 2
    for outcome in outcomes:
        assert outcome.score == 100, outcome
        assert 0.0 < (outcome.recovered_s or math.inf) <= 2.0


def test_a_fault_that_the_robot_cannot_have_is_refused():
    with pytest.raises(InputError, match="fault held wheel: expected one that"):
        Drill(1, 1, demo(), faults=[FaultKind.HELD_WHEEL])


@pytest.mark.long
def test_the_tracker_of_every_second_truck_runs_in_a_worker_that_may_be_killed():
    kinds = {number: {o.kind for o in run_leg(leg)} for number, leg in enumerate(worker_drill().legs())}
    assert FaultKind.WORKER not in kinds[0]
    assert FaultKind.WORKER in kinds[1]


def worker_drill() -> Drill:
    """Two legs; the seed is one that draws a killed worker for the second."""
    return Drill(3, 8, with_overlay(demo(), {"recorder": None}), leg=4)


def test_a_truck_whose_trackers_worker_is_killed_says_so_and_drives_on_with_a_new_one():
    async def main(clock: VirtualClock) -> None:
        overlay = {**DEADMAN, **TRACKER_IN_WORKER, "recorder": None}
        async with DrillTruck.running(with_overlay(demo(), overlay), clock) as truck:
            assert await truck.until(truck.drives, 15.0, Order.ARM)
            (before,) = truck.rig.daemon.worker_pids().values()
            truck.rig.kill("tracking")
            truck.rig.kill("no such worker")
            truck.reports()
            await clock.sleep(1.0)
            services = [r for report in truck.reports() if isinstance(report, HealthTable) for r in report.services]
            assert Reason.WORKER_DIED in {row.reason for row in services if row.name == "tracker"}
            assert await truck.until(truck.drives, 3.0)
            (after,) = truck.rig.daemon.worker_pids().values()
            assert after != before

    run_virtual(main)


# Interrupted


def resumable() -> Drill:
    return Drill(7, 2, with_overlay(demo(), {"recorder": None}), leg=1)


@pytest.mark.long
def test_an_interrupted_drill_goes_on_where_it_ended_and_gives_the_same_report(tmp_path: Path):
    class InterruptedDrillError(Exception): ...

    def interrupt(_: list[FaultOutcome]) -> None:
        raise InterruptedDrillError

    file = tmp_path / "legs.jsonl"
    with pytest.raises(InterruptedDrillError):
        resumable().run(resume=file, report=interrupt)
    with file.open("ab") as half:
        half.write(file.read_bytes()[:50])
    parts: list[list[FaultOutcome]] = []
    began: list[int] = []
    again = resumable()
    legs = again.legs
    again.legs = lambda: began.append(len(file.read_bytes().splitlines())) or legs()  # type: ignore[method-assign]
    report = again.run(resume=file, report=parts.append)
    assert began == [2]
    assert report == resumable().run()
    assert [len(part) for part in parts] == [1, 1]
    lines = file.read_bytes().splitlines()
    assert [json.loads(line)["leg"] for line in lines] == [0, 1]
    assert resumable().run(resume=file) == report
    assert file.read_bytes().splitlines() == lines, "nothing was run again"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("rubbish\n", ":1: expected a leg of a drill"),
        ("[" * 100_000 + "\n", ":1: expected a leg of a drill: it is nested too deeply"),
        ('{"seed": 7, "program": "x", "leg": 1e999, "count": 1, "outcomes": []}\n', ":1: expected a leg of a drill"),
        ('{"seed": 7, "program": "x", "leg": 0, "count": 1, "outcomes": []}\n', "of another program"),
    ],
)
def test_a_file_of_something_else_is_refused(tmp_path: Path, text: str, expected: str):
    file = tmp_path / "legs.jsonl"
    file.write_text(text)
    with pytest.raises(InputError, match=expected):
        resumable().run(resume=file)
    assert file.read_text() == text
    with pytest.raises(InputError, match="Is a directory"):
        resumable().run(resume=tmp_path)


def test_a_file_that_cannot_be_made_is_refused_before_the_first_leg(tmp_path: Path):
    drill = resumable()
    drill._parts = lambda *_: pytest.fail("it began")  # type: ignore[method-assign]
    with pytest.raises(InputError, match="No such file"):
        drill.run(resume=tmp_path / "nowhere" / "legs.jsonl")


def test_every_kind_is_on_the_catalog_of_the_whole_truck_and_what_needs_hubs_is_not_without():
    others = {FaultKind.BAD_ANSWERS, FaultKind.HELD_WHEEL, FaultKind.WRONG_SIGN}  # of wheels, sonars, IMU
    others |= {FaultKind.DEAD_SONAR, FaultKind.STUCK_SONAR, FaultKind.CROSS_TALK}
    others |= {FaultKind.STUCK_ENCODER, FaultKind.MIRRORED_ENCODER}
    assert set(catalog_of(full()).kinds) == set(FaultKind) - others
    missing = set(FaultKind) - others - set(catalog_of(demo()).kinds)
    hubs = {FaultKind.HUB_LOSS, FaultKind.RAIL_ELECTRONICS, FaultKind.COMPUTER_POWER}
    assert missing == {*hubs, FaultKind.RAIL_12V, FaultKind.ECHO, FaultKind.NETWORK, FaultKind.MEMORY}


def test_a_robot_that_nothing_drives_is_refused_with_the_key():
    with pytest.raises(InputError, match="path: truck has none: expected one that its tracker follows"):
        Drill(1, 1, with_overlay(demo(), {"path": None}))
    with pytest.raises(InputError, match="cannot drive: its body needs the devices drive and steering"):
        Drill(1, 1, with_overlay(demo(), {"devices": {"drive": None}, "tracker": None, "path": None}))


def test_the_deadman_line_takes_a_free_output_and_without_it_nothing_cuts_a_motor_controller_off():
    for name, channel in (("truck", 2), ("independent", 4)):
        config = wired(body(name))
        assert config.devices.steering is not None
        assert (config.devices.steering.driver.deadman_channel, unguarded(config)) == (channel, ())
    assert unguarded(wired(body("skid_stand"))) == (), "steppers have a watchdog"
    config = wired(body("differential"))
    assert Drill(1, 1, config).unguarded == unguarded(config) == ("drive", "drive_2")
    catalog, rng = FaultCatalog(config.devices, records=False, unguarded=unguarded(config)), np.random.default_rng(1)
    names = {catalog.draw(rng).name for _ in range(600)}
    assert {"unplug: lidar", "stall: compass", "late answers: drive_2", "blocked shaft: drive_2"} <= names
    assert {
        name for name in names if name.startswith(("unplug: dr", "stall: dr")) or "wrong device: dr" in name
    } == set()
    assert FaultKind.RAIL_SERVOS not in catalog.kinds


@pytest.mark.long
@pytest.mark.parametrize(
    "name", ["differential", "skid_steer", "mecanum", "omni", "independent", "skid_stand", "sonar"]
)
def test_random_faults_of_other_bodies_end_safely(name: str):
    report = Drill(7, 4, with_overlay(body(name), {"recorder": None}), leg=4).run()
    assert [(o.fault, o.violations, o.stuck) for o in report.outcomes if o.violations or o.stuck] == []
    assert len(report.outcomes) == 4


def test_draws_are_the_seeds():
    catalog = catalog_of(full())
    names = [[catalog.draw(rng).name for _ in range(50)] for rng in map(np.random.default_rng, (1, 1, 2))]
    assert names[0] == names[1] != names[2]
    assert len(set(names[0])) > 20


# The observer, with nobody driving but the test


TAPPED = ("drive", "steering", "lidar", "compass")


@dataclass(frozen=True)
class Bare:
    world: World
    ports: dict[str, MemoryPort]
    clock: VirtualClock
    tasks: list[asyncio.Task[None]] = field(default_factory=list)


def watched(
    scene: Callable[[Bare], None],
    *,
    stops: bool = False,
    disarms: bool = False,
    disarmed: bool = False,
    estopped: bool = False,
    seconds: float = 3.0,
    deadman: bool = True,
    robot: str | None = None,
) -> set[str]:
    """Rules broken by a scene."""

    async def main(clock: VirtualClock) -> set[str]:
        config = with_overlay(demo(), DEADMAN) if deadman else demo()
        if robot is not None:
            config = body(robot)
        world = World(config.sim.world, seed=1)
        ports = {role: MemoryPort(role) for role in (*TAPPED, *config.devices.present())}
        bare = Bare(world, ports, clock)
        observer = Observer(config, world, ports, clock)
        watching = asyncio.create_task(observer.run())
        try:
            world.truth(clock.now())
            observer.begin(stops=stops, disarms=disarms)
            if disarmed:
                observer.disarm()
            if estopped:
                observer.estop()
            scene(bare)
            await clock.sleep(seconds)
        finally:
            watching.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await watching
        return {violation.rule for violation in observer.violations()}

    return run_virtual(main)


def motor(rpm: float) -> Callable[[Bare], None]:
    return lambda bare: bare.world.motors[0].command(bare.clock.now(), -rpm, 1e5)


def said(bare: Bare, role: str) -> None:
    """A device's bytes reach the host."""
    bare.ports[role].device.on_bytes(False, b"?")


def pulses(channel: int, us: int) -> bytes:
    return bytes((0x84, channel, 4 * us & 0x7F, 4 * us >> 7))


def test_a_quiet_drive_breaks_no_rule():
    assert watched(motor(10_000)) == set()


def test_motion_of_a_disarmed_truck_is_seen():
    assert watched(motor(10_000), disarmed=True) == {"disarmed"}


def test_motion_after_an_emergency_stop_is_seen_until_it_is_reset():
    assert watched(motor(10_000), estopped=True) == {"emergency stop"}

    async def main(clock: VirtualClock) -> bool:
        observer = Observer(demo(), World(demo().sim.world, seed=1), {r: MemoryPort(r) for r in TAPPED}, clock)
        observer.estop()
        observer.reset()
        watching = asyncio.create_task(observer.run())
        motor(10_000)(Bare(observer._world, {}, clock))
        await clock.sleep(2.0)
        watching.cancel()
        return not observer.violations()

    assert run_virtual(main)


def test_motion_after_a_fault_that_must_stop_is_seen():
    assert watched(motor(10_000), stops=True) == {"stop"}


@pytest.mark.parametrize("order", ["disarmed", "estopped"])
@pytest.mark.parametrize(("later", "rules"), [(0.05, set()), (0.15, {"stopping bytes"})])
def test_bytes_that_ask_a_stopping_truck_for_a_speed_are_seen(order: str, later: float, rules: set[str]):
    def scene(bare: Bare) -> None:
        motor(10_000)(bare)
        targets(bare, (later, 0.01), (later + 0.1, 0.0))

    assert watched(scene, seconds=0.5, **{order: True}) == rules


def test_setting_off_again_after_a_fault_that_must_disarm_is_seen():
    assert watched(motor(10_000), disarms=True) == {"unarmed"}


@pytest.mark.parametrize("rpm", [0, 5_000])
def test_a_motor_driven_on_though_its_shaft_is_held_is_seen(rpm: int):
    def scene(bare: Bare) -> None:
        bare.world.block_shaft(bare.clock.now(), on=True)
        bare.ports["drive"].device.take(write_request(od.TARGET_VELOCITY, rpm, 1).body)

    assert watched(scene) == ({"held shaft"} if rpm else set())
    assert watched(scene, seconds=0.9) == set()


def test_a_truck_that_is_too_fast_is_seen():
    assert watched(motor(20_000)) == {"speed"}


def test_a_truck_that_backs_too_fast_is_seen():
    assert watched(motor(-13_500), seconds=2.0) == {"speed"}
    assert watched(motor(-12_000), seconds=2.0) == set()


@pytest.mark.parametrize("role", TAPPED)
@pytest.mark.parametrize(("silent", "seen"), [(0.7, False), (1.2, True)])
def test_driving_on_though_a_device_is_silent_is_seen(role: str, silent: float, seen: bool):
    def scene(bare: Bare) -> None:
        motor(10_000)(bare)
        said(bare, role)

    assert watched(scene, seconds=silent) == ({"silence"} if seen else set())
    assert watched(lambda bare: said(bare, role), seconds=silent) == set(), "it stands"


@pytest.mark.parametrize(
    ("rpm", "unknown", "rules"),
    [(10_000, 2.5, set[str]()), (10_000, 2.8, {"battery"}), (8_000, 2.8, set()), (0, 2.8, set())],
)
def test_driving_fast_though_the_battery_is_no_longer_measured_is_seen(rpm: int, unknown: float, rules: set[str]):
    def scene(bare: Bare) -> None:
        motor(rpm)(bare)
        bare.ports["steering"].device.take(bytes((0xA1, 0x90, 1, 0x90, 5)))  # errors, a servo, the battery
        asyncio.get_running_loop().call_later(0.001, said, bare, "steering")

    assert watched(scene, seconds=unknown) - {"silence"} == rules, "of the wire itself"


def test_a_battery_that_is_asked_for_and_not_answered_counts_as_not_measured():
    def scene(bare: Bare) -> None:
        motor(10_000)(bare)
        device, loop = bare.ports["steering"].device, asyncio.get_running_loop()
        device.take(bytes((0x90, 5)))
        loop.call_later(0.001, said, bare, "steering")
        for at in range(1, 30):
            loop.call_later(at / 10, device.take, bytes((0x90, 5)))

    assert watched(scene) - {"silence"} == {"battery"}


def test_without_the_deadman_line_nothing_stops_a_drive_that_is_silent():
    def scene(bare: Bare) -> None:
        motor(10_000)(bare)
        said(bare, "drive")

    assert watched(scene, seconds=1.2, deadman=False) == set()


def test_driving_towards_something_faster_than_it_brakes_is_seen():
    def before(metres: float, rpm: float) -> Callable[[Bare], None]:
        def scene(bare: Bare) -> None:
            truth = bare.world.truth(bare.clock.now())
            ahead = demo().sim.world.truck.length / 2 + metres + 0.1
            x, y = truth.x + ahead * math.cos(truth.yaw), truth.y + ahead * math.sin(truth.yaw)
            bare.world.add(bare.clock.now(), Disc(x, y, 0.1))
            motor(rpm)(bare)

        return scene

    assert "braking" in watched(before(0.25, 17_000), seconds=1.3)
    assert watched(before(0.25, 4_000), seconds=1.3) == set()


def test_driving_into_something_is_seen():
    def scene(bare: Bare) -> None:
        now = bare.clock.now()
        truth = bare.world.truth(now)
        bare.world.add(now, Disc(truth.x + 0.5 * math.cos(truth.yaw), truth.y + 0.5 * math.sin(truth.yaw), 0.1))
        motor(10_000)(bare)

    assert watched(scene) == {"contact", "obstacle"}


@pytest.mark.parametrize(
    ("pulse", "rules"),
    [
        (1240, set[str]()),
        (1088, set()),
        (1087, {"pulse bytes"}),
        (1841, {"pulse bytes"}),
        (900, {"pulse bytes", "angle bytes"}),
    ],
)
def test_pulses_beyond_the_limits_are_seen(pulse: int, rules: set[str]):
    assert watched(lambda bare: bare.ports["steering"].device.take(pulses(1, pulse))) == rules


def test_a_truck_that_does_not_turn_as_its_pulses_ask_is_seen():
    def scene(bare: Bare) -> None:
        bare.ports["steering"].device.take(pulses(1, 1140) + pulses(0, 1740))
        motor(14_000)(bare)

    assert watched(scene, seconds=4.0) == {"steering"}


RPM = 81_997
"""Of the motor at 1 m/s; the controller's positive sense drives backwards."""


@pytest.mark.parametrize(
    ("speed", "rules"), [(0.21, set[str]()), (0.215, {"speed bytes"}), (-0.15, set[str]()), (-0.16, {"speed bytes"})]
)
def test_target_speeds_beyond_the_limit_are_seen(speed: float, rules: set[str]):
    def scene(bare: Bare) -> None:
        targets(bare, *((0.02 * tick, 0.01 * tick * speed / abs(speed)) for tick in range(15)), (0.4, speed))

    assert watched(scene) == rules


@pytest.mark.parametrize(
    ("rpm", "asked", "rules"), [(10_000, -0.02, {"reversal bytes"}), (10_000, 0.02, set()), (3_000, -0.02, set())]
)
def test_bytes_that_turn_a_motor_round_before_it_stands_are_seen(rpm: float, asked: float, rules: set[str]):
    def scene(bare: Bare) -> None:
        motor(rpm)(bare)
        targets(bare, (0.5, asked))

    assert watched(scene) == rules


@pytest.mark.parametrize(("then", "rules"), [(0.145, set[str]()), (0.16, {"ramp bytes"}), (0.0, set[str]())])
def test_bytes_that_ask_for_a_speed_sooner_than_the_ramp_are_seen(then: float, rules: set[str]):
    assert watched(lambda bare: targets(bare, (0.0, 0.0), (0.1, 0.05), (0.15, 0.08), (0.2, then))) == rules
    assert watched(lambda bare: targets(bare, (0.0, 0.0), (0.1, 0.05), (0.2, 0.0), (0.3, then))) == set()


def targets(bare: Bare, *speeds: tuple[float, float]) -> None:
    """Ask for speeds, each (s from now, m/s)."""

    async def ask() -> None:
        began = bare.clock.now()
        for at, speed in speeds:
            await bare.clock.sleep_until(began + round(at * SECOND))
            frame = write_request(od.TARGET_VELOCITY, round(-RPM * speed), 1)
            bare.ports["drive"].device.take(frame.body)

    bare.tasks.append(asyncio.get_running_loop().create_task(ask()))


# Bodies with several motors


def asked(bare: Bare, role: str, speed: float) -> None:
    """Bytes ask a motor for a speed, m/s."""
    bare.ports[role].device.take(write_request(od.TARGET_VELOCITY, round(-RPM * speed), 1).body)


def turned(bare: Bare, shaft: int, speed: float) -> None:
    """A motor does turn."""
    bare.world.motors[shaft].command(bare.clock.now(), -RPM * speed, 1e5)


@pytest.mark.parametrize(("right", "rules"), [(0.12, set[str]()), (0.0, {"steering"})])
def test_a_body_whose_motors_do_not_turn_it_as_their_bytes_ask_is_seen(right: float, rules: set[str]):
    def scene(bare: Bare) -> None:
        for shaft, (role, speed) in enumerate({"drive": 0.12, "drive_2": right}.items()):
            asked(bare, role, 0.12)
            turned(bare, shaft, speed)

    assert watched(scene, robot="differential", seconds=1.5) == rules


@pytest.mark.parametrize(
    ("left", "right", "rules"), [(0.15, -0.15, set[str]()), (0.1, 0.2, set()), (0.1, 0.215, {"speed bytes"})]
)
def test_bytes_to_the_second_motor_are_judged_as_well(left: float, right: float, rules: set[str]):
    def scene(bare: Bare) -> None:
        for shaft, (role, speed) in enumerate({"drive": left, "drive_2": right}.items()):
            asked(bare, role, speed)
            turned(bare, shaft, speed)

    assert watched(scene, robot="differential", seconds=1.0) == rules


def test_a_held_second_shaft_that_is_driven_on_and_motion_back_before_standstill_are_seen():
    def held(bare: Bare) -> None:
        bare.world.block_shaft(bare.clock.now(), 1, on=True)
        asked(bare, "drive_2", 0.1)

    assert watched(held, robot="differential", seconds=1.5) == {"held shaft"}

    def turning(bare: Bare) -> None:
        bare.world.block_shaft(bare.clock.now(), 1, on=True)
        for shaft, role in enumerate(("drive", "drive_2")):
            asked(bare, role, 0.2)
            turned(bare, shaft, 0.2)

    assert watched(turning, robot="differential", seconds=0.95) == set(), "a held shaft turns it, not its bytes"

    def back(bare: Bare) -> None:
        for shaft, role in enumerate(("drive", "drive_2")):
            turned(bare, shaft, 0.12)
            asyncio.get_running_loop().call_later(0.5, asked, bare, role, -0.05)

    assert "reversal bytes" in watched(back, robot="differential", seconds=0.6)


@pytest.mark.parametrize(("rate", "rules"), [(150, set[str]()), (190, {"speed bytes"})])
def test_the_lines_to_steppers_are_read(rate: int, rules: set[str]):
    def scene(bare: Bare) -> None:
        bare.ports["wheels"].device.take(bytes(Line("R", 1, (str(1000 * rate),) * 4)))

    assert watched(scene, robot="skid_stand", seconds=0.3) == rules
    assert watched(scene, robot="skid_stand", seconds=0.3, disarmed=True) == rules, "it was asked before the order"

    def late(bare: Bare) -> None:
        turn = bare.world.motors[0].command
        turn(bare.clock.now(), 100.0, 1e5)
        asyncio.get_running_loop().call_later(0.2, scene, bare)

    assert "stopping bytes" in watched(late, robot="skid_stand", seconds=0.4, disarmed=True)


def test_a_truck_before_something_is_distinguished_from_one_in_the_open():
    async def main(clock: VirtualClock) -> tuple[bool, bool]:
        world = World(demo().sim.world, seed=1)
        ports = {role: MemoryPort(role) for role in ("drive", "steering")}
        observer = Observer(demo(), world, ports, clock)
        truth = world.truth(clock.now())
        free = observer.before_something()
        world.add(clock.now(), Disc(truth.x + 0.6 * math.cos(truth.yaw), truth.y + 0.6 * math.sin(truth.yaw), 0.1))
        return free, observer.before_something()

    assert run_virtual(main) == (False, True)


# Scores and configuration


def test_the_score_counts_motion_first():
    safe = FaultOutcome("a", FaultKind.STALL, True, recovered_s=0.5)
    late = FaultOutcome("b", FaultKind.STALL, True, recovered_s=6.0)
    stuck = FaultOutcome("c", FaultKind.STALL, True, stuck=("lidar",))
    unsafe = FaultOutcome("d", FaultKind.STALL, True, recovered_s=0.5, violations=(Violation(0.7, "stop", ""),))
    assert [o.score for o in (safe, late, stuck, unsafe)] == [100, 80, 50, 0]
    report = DrillReport(1, (safe, late, stuck, unsafe))
    assert (report.unsafe, report.stuck, report.score) == (1, 1, 57.5)
    assert report.recovery(50) == 0.5
    assert report.as_json()["outcomes"][3]["reaction"] == "UNSAFE"


def test_a_configuration_can_let_faults_happen_by_themselves():
    config = with_overlay(demo(), {"recorder": None, "map": None, "sim": {"drill": {"seed": 3, "period": 2.0}}})

    async def main(clock: VirtualClock) -> set[Reason]:
        rig = VirtualRig(config, clock)
        events = rig.bus.subscribe(topics.EVENT, fifo(4096))
        async with rig.running():
            await clock.sleep_until(20 * SECOND)
        return {event.reason for event in events.drain()}

    reported = run_virtual(main)
    assert reported & {Reason.DEVICE_LOST, Reason.DEVICE_TIMEOUT, Reason.DEVICE_WRONG, Reason.DEVICE_FAULT}, reported


# The computer's supply


def test_a_computer_that_loses_its_supply_stops_the_truck_and_starts_disarmed_on_the_same_world():
    async def main(clock: VirtualClock) -> tuple[float, bool, GateMode, bool]:
        config = with_overlay(full(), DEADMAN)
        fault = fault_of(FaultKind.COMPUTER_POWER, config)
        async with DrillTruck.running(config, clock) as truck:
            assert await truck.until(truck.drives, 15.0, Order.ARM)
            first, place = truck.rig.daemon, truck.rig.world.truth(clock.now())
            truck.observer.begin(stops=True)
            await apply(fault.start, truck.rig.context)
            await clock.sleep(1.0)
            assert truck.rig.daemon_ended
            still, violations = truck.observer.standstill_after(), truck.observer.violations()
            truck.observer.end_fault()
            await apply(fault.end, truck.rig.context)
            truck.listen()
            assert await truck.until(lambda: not truck.blockers(), 15.0)
            assert truck.gate is not None
            mode, found = truck.gate.mode, truck.rig.world.truth(clock.now())
            moved = math.dist((place.x, place.y), (found.x, found.y))
            again = await truck.until(truck.drives, 15.0, Order.ARM)
            assert truck.rig.daemon is not first
            assert violations == truck.observer.violations() == ()
            return still, moved < 0.2, mode, again

    still, near, mode, again = run_virtual(main)
    assert still <= 0.6
    assert (near, mode, again) == (True, GateMode.DISARMED, True)


def fault_of(kind: FaultKind, config: SimulatedTruckConfig) -> CatalogFault:
    """A fault of the kind, as the catalog draws it."""
    catalog, rng = catalog_of(config), np.random.default_rng(1)
    return next(fault for fault in iter(lambda: catalog.draw(rng), None) if fault.kind is kind)
