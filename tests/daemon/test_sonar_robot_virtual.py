"""The robot with sonars and an IMU, through real drivers and emulators, on the virtual clock."""

import hashlib
import math
from pathlib import Path

import numpy as np
import pytest

from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.mailbox import fifo, latest
from monstertruck_schemas import topics
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import DriveRequest, RequestedTwist
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(120)]

FILE = Path(__file__).resolve().parents[2] / "configs" / "robots" / "sonar.yaml"
STEP = 0.05


class Drive:
    """Reasons, commanded twists, true poses and sonar messages of one drive."""

    def __init__(self):
        self.reasons = set()
        self.twists = []
        self.truth = np.empty((0, 0))
        self.sonars = []
        self.imu = self.odometry = None
        self.events = set()
        self.frames = set()


def drive(start, seconds, twist, *, at=(), model="cone", **overlay):
    """Drive for so many seconds by ``twist`` (or a function of time); ``at``: (second, action on the rig) in turn."""
    config = with_overlay(load_config(FILE, SimulatedTruckConfig)[0], overlay)
    x, y, yaw = start
    world = config.sim.world
    sonar = world.sonar.model_copy(update={"model": model})
    pose = {"start": {"x": x, "y": y, "yaw": yaw}}
    world = type(world).model_validate(world.model_dump() | pose | {"sonar": sonar.model_dump()}, strict=False)
    config = config.model_copy(update={"recorder": None, "sim": config.sim.model_copy(update={"world": world})})

    async def main(clock: VirtualClock) -> Drive:
        rig, seen, due = VirtualRig(config, clock), Drive(), list(at)
        bus = rig.daemon.bus
        with (
            bus.subscribe(topics.GATE, fifo(4096)) as states,
            bus.subscribe(topics.SONAR, fifo(4096)) as sonars,
            bus.subscribe(topics.IMU, latest()) as imu,
            bus.subscribe(topics.TRANSFORMS, latest()) as transforms,
            bus.subscribe(topics.ODOMETRY, latest()) as odometry,
            bus.subscribe(topics.EVENT, fifo(4096)) as events,
        ):
            async with rig.running():
                operator = LocalOperator(rig.daemon, clock)
                await clock.sleep(3.0)
                await operator.arm()
                for i in range(round(seconds / STEP)):
                    while due and due[0][0] <= i * STEP:
                        due.pop(0)[1](rig)
                    vx, wz = twist(i * STEP) if callable(twist) else twist
                    header = await operator.header(lease=0.25)
                    request = DriveRequest(**header, speed=0.0, front=0.0, twist=RequestedTwist(vx=vx, vy=0.0, wz=wz))
                    bus.inject(topics.REQ_DRIVE, request)
                    await clock.sleep(STEP)
                seen.truth = rig.truth.array()
                for state in states.drain():
                    seen.reasons |= set(state.reasons)
                    seen.twists.append(state.twist)
                seen.sonars = sonars.drain()
                seen.imu, seen.odometry = imu.latest, odometry.latest
                seen.events = {event.reason for event in events.drain()}
                seen.frames = {t.child for t in transforms.latest.transforms}
            return seen

    return run_virtual(main, start=SECOND)


def digest(seen):
    return hashlib.sha256(seen.truth.tobytes() + repr(seen.sonars).encode()).hexdigest()


QUIET = {Reason.DISARMED, Reason.DRIVE_STALE}
"""Before it is armed."""


@pytest.mark.parametrize("model", [pytest.param("beam", marks=pytest.mark.long), "cone"])
def test_a_wall_beside_it_does_not_slow_it(model):
    seen = drive((-0.6, 3.15, 0.0), 6.0, (0.3, 0.0), model=model)
    assert seen.reasons == QUIET
    assert seen.truth[-1, 4] == pytest.approx(0.3, abs=0.01)
    assert seen.sonars[-1].echo("l").range == pytest.approx(0.3, abs=0.03)
    assert seen.imu.linear_acceleration.z == pytest.approx(9.81, abs=0.3)
    assert {"imu", "sonar_l", "sonar_fl", "sonar_f", "sonar_fr", "sonar_r"} <= seen.frames


def test_it_turns_on_the_spot_before_a_wall():
    seen = drive((0.0, 3.5 - 0.29 - 0.12, math.pi / 2), 6.0, (0.0, -0.5))
    assert seen.reasons == QUIET
    assert np.unwrap(seen.truth[:, 3])[-1] < math.pi / 2 - 2.5


@pytest.mark.parametrize("slant", [pytest.param(0.0, marks=pytest.mark.long), 0.3])
def test_it_stops_before_a_wall(slant):
    seen = drive((0.0, 2.2, math.pi / 2 + slant), 8.0, (0.3, 0.0))
    assert seen.reasons == QUIET | {Reason.OBSTACLE_SLOW, Reason.OBSTACLE_STOP}
    assert abs(seen.truth[-1, 4]) < 0.005
    assert not seen.truth[:, 5].any()
    assert 0.02 < 3.5 - seen.truth[-1, 2] - 0.16 < 0.2


@pytest.mark.parametrize(
    ("fault", "reason", "moves"),
    [
        (("dead", "f", "on"), Reason.SONAR_BLIND, False),
        (("dead", "l", "on"), Reason.SONAR_SLOW, True),
        pytest.param(("stuck", "f", "on"), Reason.SONAR_BLIND, False, marks=pytest.mark.long),
        (("silent", "on"), Reason.SONAR_STALE, False),
    ],
)
def test_a_sonar_that_fails_slows_or_stops_it(fault, reason, moves):
    seen = drive((0.0, 1.0, math.pi / 2), 4.0, (0.2, 0.0), at=[(1.0, failing(fault))])
    assert reason in seen.reasons
    assert seen.truth[-1, 4] == pytest.approx(0.1 if moves else 0.0, abs=0.01)
    assert not seen.truth[:, 5].any()


def failing(fault):
    return lambda rig: rig.robot.emulators["sonar"].inject(*fault)


def test_an_unplugged_bridge_stops_it_and_it_goes_on_when_it_is_back():
    at = [(1.5, lambda rig: rig.ports["sonar"].unplug()), (3.0, lambda rig: rig.ports["sonar"].plug())]
    seen = drive((-2.0, 0.0, 0.0), 7.0, (0.2, 0.0), at=at)
    assert Reason.SONAR_STALE in seen.reasons
    slow = np.abs(seen.truth[:, 4]) < 0.01
    assert slow[80:].any()
    assert seen.truth[-1, 4] == pytest.approx(0.2, abs=0.01)


def test_two_runs_are_the_same():
    assert len({digest(drive((-2.0, 0.0, 0.3), 2.0, (0.2, 0.2))) for _ in range(2)}) == 1


def turned(seen):
    """Error of the heading by odometry, rad."""
    true = seen.truth[-1, 3] - seen.truth[0, 3]
    return abs(math.remainder(seen.odometry.pose.yaw - true, math.tau))


def test_the_odometry_turns_with_the_imu():
    seen = drive((0.0, 0.0, 0.0), 8.0, (0.1, 0.5))
    assert "imu" in seen.odometry.sources
    assert Reason.IMU_DISAGREES not in seen.events
    assert turned(seen) < 0.05


def test_the_fusion_turns_with_the_imu_and_leaves_out_one_with_the_wrong_sign():
    def turn_round(rig):
        rig.robot.emulators["imu"].inject("inverted", "on")

    fused = {"odometry": {"kind": "fusion"}}
    seen = drive((0.0, 0.0, 0.0), 4.0, (0.1, 0.5), **fused)
    assert {"drive", "imu", "tilt"} == set(seen.odometry.sources)
    assert turned(seen) < 0.03
    seen = drive((0.0, 0.0, 0.0), 5.0, (0.1, 0.5), at=[(1.0, turn_round)], **fused)
    assert {"drive", "tilt"} == set(seen.odometry.sources)
    assert Reason.IMU_DISAGREES in seen.events
    assert turned(seen) < 0.1, "what it reported before it was noticed is taken back"


@pytest.mark.parametrize(
    "fault",
    [pytest.param("inverted", marks=pytest.mark.long), "unplugged", pytest.param("silent", marks=pytest.mark.long)],
)
def test_an_imu_that_fails_leaves_the_heading_to_the_wheels(fault):
    def act(rig):
        if fault == "unplugged":
            rig.ports["imu"].unplug()
        else:
            rig.robot.emulators["imu"].inject(fault, "on")

    seen = drive((0.0, 0.0, 0.0), 8.0, (0.1, 0.5), at=[(2.0, act)])
    assert "imu" not in seen.odometry.sources
    assert (Reason.IMU_DISAGREES in seen.events) is (fault == "inverted")
    assert turned(seen) < (0.8 if fault == "inverted" else 0.1)
