"""Every robot of configs/robots drives its bend through real drivers and emulators, on the virtual clock."""

import asyncio
import math
from pathlib import Path

import numpy as np
import pytest

from monstertruck_runtime.bodies import BODIES
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import ConfigError
from monstertruck_runtime.mailbox import fifo, latest
from monstertruck_runtime.ports import Subscription
from monstertruck_schemas import topics
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.state import Odometry
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, load_robot
from monstertruckd.tools.simulation.operator import Lap, LocalOperator, drive_lap
from monstertruckd.tools.simulation.virtual_rig import VirtualRig
from tests.long_kit import mostly_long

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(120)]

FOLDER = Path(__file__).resolve().parents[2] / "configs" / "robots"
ELSEWHERE = {"hall", "skid_stand", "sonar", "turtle", "truck_today", "f1tenth"}
"""Driven by tests of their own; hall is what the others share."""
ROBOTS = sorted(file.stem for file in FOLDER.glob("*.yaml") if file.stem not in ELSEWHERE)
KEEP_HEADING = {"synchro", "mecanum", "truck", "truck_rear_sonars"}
"""These crab."""
END = (2.4, 4.15)


def drive(name: str) -> tuple[Lap, np.ndarray, Odometry, VirtualRig]:
    config, _ = load_config(FOLDER / f"{name}.yaml", SimulatedTruckConfig)
    config = config.model_copy(update={"recorder": None})

    async def main(clock: VirtualClock) -> tuple[Lap, np.ndarray, Odometry, VirtualRig]:
        rig = VirtualRig(config, clock)
        with rig.bus.subscribe(topics.ODOMETRY, latest()) as odometry:
            async with rig.running():
                lap = await drive_lap(LocalOperator(rig.daemon, clock), clock, limit=40)
                await clock.sleep(0.5)
            assert odometry.latest is not None
            return lap, rig.truth.array(), odometry.latest, rig

    return run_virtual(main, start=SECOND)


def test_there_is_a_robot_of_every_kind():
    kinds = {load_robot(FOLDER / f"{name}.yaml")[0].body.kind for name in ROBOTS}
    assert kinds == set(BODIES)


@pytest.mark.parametrize("name", mostly_long(ROBOTS, {"differential", "independent", "synchro"}))
def test_a_robot_drives_its_bend(name: str):
    lap, truth, odometry, rig = drive(name)
    assert lap.outcome is Reason.GOAL_REACHED
    assert not truth[:, 5].any()
    x, y, yaw = truth[-1, 1:4]
    assert math.dist((x, y), END) < 0.06
    assert lap.cross_track_rms < 0.03
    assert math.dist((odometry.pose.x, odometry.pose.y), (x, y)) < 0.03
    assert odometry.pose.yaw == pytest.approx(yaw, abs=0.05)
    heading = np.abs(truth[:, 3]).max()
    assert heading < 0.05 if name in KEEP_HEADING else heading > 0.15
    shafts = len(rig.world.motors)
    assert [motor.reading(0).turns != 0 for motor in rig.world.motors] == [True] * shafts


def test_a_tricycle_names_a_stuck_encoder_and_drives_on_without_it_and_without_both():
    config, _ = load_config(FOLDER / "tricycle.yaml", SimulatedTruckConfig)
    config = config.model_copy(update={"recorder": None})

    async def main(clock: VirtualClock) -> None:
        rig = VirtualRig(config, clock)
        sources: list[tuple[str, ...]] = []

        async def happen(odometry: Subscription[Odometry]) -> None:
            for seconds, act in (
                (4.0, lambda: None),
                (0.1, lambda: rig.robot.emulators["encoders"].inject("stuck", "left", "on")),
                (4.0, rig.ports["encoders"].unplug),
                (1.0, lambda: None),
            ):
                await clock.sleep(seconds)
                assert odometry.latest is not None
                sources.append(odometry.latest.sources[:2])
                act()

        with (
            rig.bus.subscribe(topics.EVENT, fifo(4096)) as events,
            rig.bus.subscribe(topics.ODOMETRY, latest()) as odometry,
        ):
            async with rig.running(), asyncio.TaskGroup() as group:
                group.create_task(happen(odometry))
                lap = await drive_lap(LocalOperator(rig.daemon, clock), clock, limit=40)
                reported = {event.reason: event.text for event in events.drain()}
            assert lap.outcome is Reason.GOAL_REACHED
            assert lap.stops == ()
            assert "left is stuck; odometry uses right and steering" in reported[Reason.ENCODERS_DISAGREE]
            assert Reason.DEVICE_LOST in reported
            assert sources == [("encoders", "drive")] * 3 + [("drive", "steering")]
            assert odometry.latest is not None
            assert math.dist((odometry.latest.pose.x, odometry.latest.pose.y), rig.truth.array()[-1, 1:3]) < 0.03

    run_virtual(main, start=SECOND)


# Configurations that do not fit the body


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "include: {0}/differential.yaml\nversion: 1\ndevices: {{drive_2: null}}\n",
            "body differential is driven by drive (left), drive_2 (right); got drive",
        ),
        (
            "include: {0}/ackermann.yaml\nversion: 1\n"
            "devices: {{drive_2: {{port: {{path: /dev/x}}, driver: {{kind: epos}}}}}}\n",
            "body ackermann is driven by drive (drive); got drive, drive_2",
        ),
        (
            "include: {0}/differential.yaml\nversion: 1\ntracker: {{steering: counter}}\n",
            "tracker.steering counter: impossible for body differential: rear is -0.1: expected 0",
        ),
        (
            "include: {0}/differential.yaml\nversion: 1\ntracker: {{steering: crab}}\n",
            "this body has no second steered axle and cannot move sideways",
        ),
        (
            "include: {0}/synchro.yaml\nversion: 1\ntracker: {{steering: front}}\n",
            "impossible for body synchro: front is 0.1, rear is 0: expected equal angles",
        ),
        (
            "include: {0}/ackermann.yaml\nversion: 1\ndevices: {{steering: null}}\n",
            "a tracker needs the devices drive and steering",
        ),
        (
            "include: {0}/differential.yaml\nversion: 1\nsim: {{world: {{truck: {{body: {{kind: omni}}}}}}}}\n",
            "sim.world.truck.body is omni, body is differential",
        ),
        (
            "include: {0}/skid_steer.yaml\nversion: 1\nbody: {{icr_left: -0.3}}\n",
            "icr_left is -0.3: expected more than icr_right",
        ),
        (
            "include: {0}/tricycle.yaml\nversion: 1\nbody: {{kind: bicycle}}\n",
            "devices.encoders: expected of body tricycle, body is bicycle",
        ),
        (
            "include: {0}/tricycle.yaml\nversion: 1\ndevices: {{encoders: null}}\n",
            "odometry.kind encoders needs the device encoders",
        ),
        ("include: {0}/ackermann.yaml\nversion: 1\nbody: {{kind: hovercraft}}\n", "body: "),
        (
            "include: {0}/independent.yaml\nversion: 1\nbody: {{steering: axles}}\n",
            "body independent has 2 servos: expected front_right and rear_right of devices.steering null",
        ),
        (
            "include: {0}/independent.yaml\nversion: 1\n"
            "devices: {{steering: {{driver: {{front: {{min_us: 1200}}}}}}}}\n",
            "devices.steering: pulses reach 60 degrees to one side: expected 100",
        ),
    ],
)
def test_what_does_not_fit_the_body_is_refused(text: str, said: str, tmp_path: Path):
    bad = tmp_path / "bad.yaml"
    bad.write_text(text.format(FOLDER))
    with pytest.raises(ConfigError) as caught:
        load_robot(bad)
    assert said in str(caught.value)


def test_a_lap_that_a_stop_interrupts_is_driven_to_its_end():
    config, _ = load_config(FOLDER / "truck.yaml", SimulatedTruckConfig)
    config = config.model_copy(update={"recorder": None})

    async def main(clock: VirtualClock) -> Lap:
        rig = VirtualRig(config, clock)

        async def unplug() -> None:
            await clock.sleep(8.0)
            rig.ports["drive"].unplug()
            await clock.sleep(1.0)
            rig.ports["drive"].plug()

        async with rig.running(), asyncio.TaskGroup() as group:
            group.create_task(unplug())
            return await drive_lap(LocalOperator(rig.daemon, clock), clock, limit=60)

    lap = run_virtual(main, start=SECOND)
    assert lap.outcome is Reason.GOAL_REACHED
    assert lap.stops == (Reason.DRIVE_STALE,)
    assert lap.armed_again == 1
