"""Requests by twist drive the whole daemon, through real drivers and emulators, on the virtual clock."""

import math
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.mailbox import fifo, latest
from monstertruck_schemas import topics
from monstertruck_schemas.event import Event
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import DriveForm, DriveRequest, RequestedTwist
from monstertruck_schemas.state import GateMode, GateState, Odometry
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig
from tests.long_kit import mostly_long

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(120)]

FOLDER = Path(__file__).resolve().parents[2] / "configs" / "robots"
RATE = 20.0


@dataclass
class Seen:
    """What a drive showed."""

    answers: list[Reason] = field(default_factory=list)
    states: list[GateState] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    truth: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))
    begin: int = 0
    """Row of ``truth`` when the first request was sent."""
    odometry: Odometry | None = None

    @property
    def moved(self) -> tuple[float, float, float]:
        """Forward, sideways (m) and turned (rad, counted) since the first request, in the robot's frame then."""
        way = self.truth[self.begin :]
        dx, dy = way[-1, 1:3] - way[0, 1:3]
        c, s = math.cos(way[0, 3]), math.sin(way[0, 3])
        return c * dx + s * dy, c * dy - s * dx, float(np.unwrap(way[:, 3])[-1] - way[0, 3])


def drive(name: str, *requests: tuple[float, tuple[float, float, float]], unseen: str = "stop") -> Seen:
    """Drive a robot of configs/robots by (seconds, twist) in turn; its tracker stays out of it."""
    config, _ = load_config(FOLDER / f"{name}.yaml", SimulatedTruckConfig)
    config = config.model_copy(update={"recorder": None, "tracker": None, "path": None})
    config = with_overlay(config, {"gate": {"obstacle": {"unseen": unseen}}})

    async def main(clock: VirtualClock) -> Seen:
        rig, seen = VirtualRig(config, clock), Seen()
        bus = rig.daemon.bus
        with (
            bus.subscribe(topics.ODOMETRY, latest()) as odometry,
            bus.subscribe(topics.GATE, fifo(4096)) as states,
            bus.subscribe(topics.EVENT, fifo(4096)) as events,
        ):
            async with rig.running():
                operator = LocalOperator(rig.daemon, clock)
                await clock.sleep(2.0)
                seen.begin = len(rig.truth.array()) - 1
                await operator.arm()
                for seconds, (vx, vy, wz) in requests:
                    for _ in range(round(seconds * RATE)):
                        twist = RequestedTwist(vx=vx, vy=vy, wz=wz)
                        header = await operator.header(lease=0.25)
                        request = DriveRequest(**header, speed=0.0, front=0.0, twist=twist)
                        seen.answers += bus.inject(topics.REQ_DRIVE, request)
                        await clock.sleep(1.0 / RATE)
                await clock.sleep(1.0)
                seen.truth = rig.truth.array()
            seen.odometry, seen.states, seen.events = odometry.latest, list(states.drain()), list(events.drain())
        return seen

    return run_virtual(main, start=SECOND)


def assert_odometry_agrees(seen: Seen) -> None:
    assert seen.odometry is not None
    pose, (x, y, yaw) = seen.odometry.pose, seen.truth[-1, 1:4]
    assert math.dist((pose.x, pose.y), (x, y)) < 0.03
    assert math.remainder(pose.yaw - yaw, math.tau) == pytest.approx(0.0, abs=0.05)


@pytest.mark.parametrize(
    ("name", "side"),
    mostly_long(
        product(("differential", "skid_steer", "omni", "mecanum", "independent"), (1, -1)),
        {("skid_steer", -1), ("independent", 1)},
    ),
)
def test_turning_on_the_spot(name: str, side: int):
    seen = drive(name, (4.0, (0.0, 0.0, 0.5 * side)))
    ahead, aside, turned = seen.moved
    assert math.hypot(ahead, aside) < (0.1 if name == "skid_steer" else 0.02)  # its sides' ICRs are behind its middle
    # Of 2.0: onto ground that no scan has seen it turns slower, and wheels that are steered turn first.
    assert 1.2 < turned * side < 2.1
    assert not seen.truth[:, 5].any()
    assert set(seen.answers) == {Reason.OK}
    assert_odometry_agrees(seen)


@pytest.mark.parametrize(
    ("name", "side"),
    mostly_long(product(("omni", "mecanum", "independent"), (1, -1)), {("omni", 1), ("independent", -1)}),
)
def test_moving_sideways(name: str, side: int):
    seen = drive(name, (5.0, (0.0, 0.1 * side, 0.0)), unseen="slow")
    ahead, aside, turned = seen.moved
    assert aside * side == pytest.approx(0.5, abs=0.2 if name == "independent" else 0.05)
    assert abs(ahead) < 0.03
    assert abs(turned) < 0.03
    assert set(seen.answers) == {Reason.OK}
    assert_odometry_agrees(seen)


def test_sideways_a_robot_stops_before_ground_that_no_scan_has_seen():
    seen = drive("mecanum", (3.0, (0.0, 0.1, 0.0)))
    assert Reason.UNSEEN_STOP in {reason for state in seen.states for reason in state.reasons}
    assert abs(seen.moved[1]) < 0.03


@pytest.mark.long
@pytest.mark.parametrize("name", ["mecanum", "independent"])
def test_one_motion_after_the_other(name: str):
    seen = drive(name, (4.0, (0.12, 0.0, 0.0)), (4.0, (0.0, 0.0, 0.4)), (4.0, (0.0, -0.1, 0.0)), (1.0, (0.0, 0.0, 0.0)))
    assert not seen.truth[:, 5].any()
    ahead, aside, turned = seen.moved
    assert turned == pytest.approx(1.6, abs=0.5)
    assert ahead > 0.6  # its right side looks ahead on the last leg
    assert abs(aside) < 0.2
    assert_odometry_agrees(seen)
    driving = [state for state in seen.states if state.mode is GateMode.DRIVING]
    assert {state.form for state in driving} == {DriveForm.TWIST}
    assert max(state.twist.wz for state in driving if state.twist is not None) == pytest.approx(0.4)


@pytest.mark.parametrize(
    ("name", "twist", "why"),
    [
        ("truck", (0.0, 0.0, 0.5), "this body cannot turn on the spot"),
        ("truck", (0.0, 0.1, 0.0), "this body cannot move sideways"),
        ("ackermann", (0.0, 0.0, 0.5), "this body cannot turn on the spot"),
        ("differential", (0.0, 0.1, 0.0), "this body cannot move sideways"),
        ("synchro", (0.1, 0.0, 0.3), "this body keeps its heading"),
    ],
)
def test_what_a_body_cannot_do_is_refused_by_name_and_nothing_moves(name, twist, why):
    seen = drive(name, (1.0, twist))
    assert set(seen.answers) == {Reason.IMPOSSIBLE_MOTION}
    assert max(map(abs, seen.moved)) < 1e-3
    refused = [event for event in seen.events if event.reason is Reason.IMPOSSIBLE_MOTION]
    assert refused
    assert all(why in event.text for event in refused)


def test_the_truck_drives_a_curve_by_twist_and_one_too_tight_is_clipped():
    seen = drive("truck", (3.0, (0.15, 0.0, 0.1)))
    assert seen.moved[2] == pytest.approx(0.3, abs=0.1)
    assert Reason.CLIPPED not in {reason for state in seen.states for reason in state.reasons}
    tight = drive("truck", (2.0, (0.1, 0.0, 0.5)))
    assert Reason.CLIPPED in {reason for state in tight.states for reason in state.reasons}
    assert 0.1 < tight.moved[2] < 0.6


def test_a_wall_stops_sideways_motion_before_contact():
    seen = drive("mecanum", (14.0, (0.0, -0.1, 0.0)), unseen="slow")
    assert Reason.OBSTACLE_STOP in {reason for state in seen.states for reason in state.reasons}
    assert not seen.truth[:, 5].any()
    assert seen.moved[1] < -0.1
