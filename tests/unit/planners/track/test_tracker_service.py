import asyncio
import math

import numpy as np
import pytest

from monstertruck_kinematics.elementary import KinematicsError
from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.collision import Footprint
from monstertruck_planners.track.config import PurePursuitConfig
from monstertruck_planners.track.pure_pursuit import PurePursuit
from monstertruck_planners.track.segments import SegmentedPath
from monstertruck_planners.track.service import (
    STUCK_AFTER,
    UNSEEN_AFTER,
    Newest,
    TrackerService,
    TrackingStep,
    TrackingWorker,
    TrackOutput,
    TrackSetup,
)
from monstertruck_runtime.clock import SECOND, run_virtual
from monstertruck_schemas.base import Pose2D, Twist2D
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Role
from monstertruck_schemas.sensor import Attitude, LaserScan
from monstertruck_schemas.state import GateMode, GateState, Odometry
from tests.unit.estimation.kit import felt_tilt
from tests.unit.planners.behave.wall_kit import odometry
from tests.unit.planners.kit import STEERING, circle, path, straight


class Inbox:
    latest = None
    drops = 0


class Outbox(list):
    def next_seq(self):
        return len(self)

    put = list.append


class Bench:
    """A tracker, a gate that lets it drive, and a truck that obeys at once."""

    def __init__(self, clock, route, *, with_scan=False, actor=None, **config):
        self.clock = clock
        self.pose_in, self.path_in, self.gate_in, self.scan_in = Inbox(), Inbox(), Inbox(), Inbox()
        self.path_in.latest = route
        self.asked, self.reported, self.events = Outbox(), Outbox(), []
        self.pose, self.speed = (0.0, 0.0, 0.0), 0.0
        self.silent = False
        self.heard = 0
        self.service = TrackerService(
            TrackSetup(PurePursuitConfig(**config), FourWheelSteering(), Footprint(), (0.14, 0.0, 0.0)),
            clock,
            inputs=self._inputs(with_scan),
            actor=actor,
            drive=self.asked,
            tracker=self.reported,
            events=lambda reason, severity, source, text="", **values: self.events.append((reason, text)),
        )
        self.gate(GateMode.DISARMED)

    def _inputs(self, with_scan):
        inputs = {"pose": self.pose_in, "path": self.path_in, "gate": self.gate_in}
        return inputs | ({"scan": self.scan_in} if with_scan else {})

    def newest(self):
        return Newest(self.pose_in.latest, self.path_in.latest, self.gate_in.latest)

    def gate(self, mode):
        now = self.clock.now()
        self.gate_in.latest = GateState(stamp=now, received=now, seq=0, mode=mode, nonce="n1", speed_limit=0.2)

    def _sense(self):
        now = self.clock.now()
        x, y, yaw = self.pose
        self.pose_in.latest = Odometry(
            stamp=now,
            received=now,
            seq=0,
            frame="odom",
            pose=Pose2D(x=x, y=y, yaw=yaw),
            twist=Twist2D(vx=self.speed, vy=0.0, wz=0.0),
            pose_covariance=np.zeros(9),
            twist_covariance=np.zeros(9),
            age=0.0,
        )

    async def world(self):
        while True:
            if not self.silent:
                self._sense()
            await self.clock.sleep(0.02)
            fresh = len(self.asked) > self.heard
            gate = self.gate_in.latest
            driving = gate is not None and gate.mode in (GateMode.ARMED, GateMode.DRIVING)
            if self.asked and driving and (fresh or self.clock.now() - self.asked[-1].stamp < SECOND // 4):
                self.heard = len(self.asked)
                request = self.asked[-1]
                self.speed = request.speed
                self.pose = STEERING.integrate(
                    self.pose, *STEERING.body_twist(request.speed, request.front, request.rear), 0.02
                )
            else:
                self.speed = 0.0


def on_bench(scenario, route, **more):
    async def main(clock):
        bench = Bench(clock, route, **more)
        tasks = [asyncio.create_task(bench.world()), asyncio.create_task(bench.service.run(lambda: None))]
        await clock.sleep(0.2)
        try:
            await scenario(bench)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
        return bench

    return run_virtual(main)


async def until_ended(bench, seconds=60.0):
    for _ in range(round(seconds / 0.1)):
        if bench.reported[-1].outcome is not Reason.DRIVING:
            return
        await bench.clock.sleep(0.1)


@pytest.mark.parametrize(("step", "turns"), [(0.05, 0), (0.003, 2)])
def test_a_long_path_is_taken_in_within_several_turns_of_the_loop(step, turns):
    async def scenario(bench):
        bench.path_in.latest = path(circle(1.0, step=step), closed=True)
        tracking = TrackingStep(TrackSetup(PurePursuitConfig(), FourWheelSteering(), Footprint(), (0.14, 0.0, 0.0)))
        *before, output = tracking.parts(bench.clock.now(), bench.newest())
        assert before == [None] * turns
        assert output.command is not None

    on_bench(scenario, path(circle(1.0)))


def test_a_truck_that_gains_speed_on_level_ground_does_not_take_that_for_a_slope():
    async def scenario(bench):
        tracking = TrackingStep(TrackSetup(PurePursuitConfig(), FourWheelSteering(), Footprint(), (0.14, 0.0, 0.0)))
        bench.gate(GateMode.DRIVING)
        asked = []
        for i in range(10):
            pose = odometry(vx=0.06 * i, now=bench.clock.now())  # 1.2 m/s^2
            felt = felt_tilt(1.2, 0.0, 0.0, 0.0)
            attitude = Attitude(stamp=pose.stamp, received=pose.stamp, seq=i, heading=0.0, roll=0.0, pitch=felt.pitch)
            output = list(tracking.parts(pose.stamp, bench.newest()._replace(pose=pose, attitude=attitude)))[-1]
            asked.append(output.command.speed)
            await bench.clock.sleep(0.05)
        assert asked[0] < 0.15, "the compass alone shows 7 degrees"
        assert asked[-1] == PurePursuitConfig().speed

    on_bench(scenario, path(straight(5.0)))


class Elsewhere:
    """An actor with the worker's end of the tracker; notes what was sent."""

    def __init__(self):
        self.worker, self.sent = TrackingWorker(), []

    async def __aenter__(self):
        return self

    async def __aexit__(self, *_):
        pass

    async def start(self):
        pass

    async def step(self, inputs):
        self.sent.append(inputs)
        return self.worker.step(inputs)


def test_a_worker_gives_what_the_loop_gives_and_is_sent_what_is_new():
    async def scenario(bench):
        bench.gate(GateMode.DRIVING)
        await until_ended(bench)

    actor, route = Elsewhere(), path(straight(0.5))
    here, there = (on_bench(scenario, route, actor=where) for where in (None, actor))
    assert here.asked == there.asked
    assert here.reported == there.reported
    assert here.events == there.events
    assert [inputs.setup is not None for inputs in actor.sent] == [True] + [False] * (len(actor.sent) - 1)
    assert sum("path" in inputs.news for inputs in actor.sent) == 1


def test_a_lap_from_arming_to_the_goal():
    async def scenario(bench):
        assert bench.asked == []
        bench.gate(GateMode.ARMED)
        await until_ended(bench)
        await bench.clock.sleep(1.0)

    bench = on_bench(scenario, path(circle(1.0), closed=True))
    request = bench.asked[5]
    assert (request.source, request.role, request.nonce, request.lease) == ("tracker", Role.TRACKER, "n1", 0.25)
    assert [w.seq for w in bench.asked] == list(range(len(bench.asked)))
    assert np.diff([w.stamp for w in bench.asked]) == pytest.approx(SECOND // 20, abs=1000)
    last = bench.reported[-1]
    assert last.outcome is Reason.GOAL_REACHED
    assert last.along == pytest.approx(last.length, abs=0.03)
    assert last.path == "test"
    assert max(abs(t.cross_track) for t in bench.reported) < 0.06
    assert math.hypot(*bench.pose[:2]) < 0.06
    assert [reason for reason, _ in bench.events] == [Reason.GOAL_REACHED]
    assert bench.asked[-1].speed == 0.0
    assert bench.reported[-1].stamp - bench.asked[-1].stamp > SECOND // 2  # silent once at rest


def test_it_asks_for_nothing_while_disarmed_and_goes_on_after_a_stop():
    async def scenario(bench):
        assert bench.reported[-1].along == 0.0
        bench.gate(GateMode.DRIVING)
        await bench.clock.sleep(3.0)
        driven = bench.reported[-1].along
        assert driven > 0.3
        bench.gate(GateMode.ESTOPPED)
        await bench.clock.sleep(1.0)
        asked = len(bench.asked)
        await bench.clock.sleep(1.0)
        assert len(bench.asked) == asked
        bench.gate(GateMode.ARMED)
        await bench.clock.sleep(1.0)
        assert len(bench.asked) > asked
        assert bench.reported[-1].along > driven

    on_bench(scenario, path(straight(4.0)))


def test_arming_after_the_end_starts_the_lap_over():
    async def scenario(bench):
        bench.gate(GateMode.ARMED)
        await until_ended(bench)
        bench.gate(GateMode.DISARMED)
        await bench.clock.sleep(0.5)
        bench.gate(GateMode.ARMED)
        await bench.clock.sleep(2.0)
        assert bench.reported[-1].outcome is Reason.DRIVING
        assert 0.1 < bench.reported[-1].along < 1.0

    on_bench(scenario, path(circle(0.6), closed=True))


@pytest.mark.parametrize("route", [path(straight(1.0)), path(circle(0.6), closed=True)], ids=["open", "closed"])
def test_while_disarmed_a_path_is_prepared_anew_only_for_a_truck_that_moved(monkeypatch, route):
    prepared = []

    def line(*arguments):
        prepared.append(arguments)
        return SegmentedPath(*arguments)

    async def scenario(bench):
        bench.gate(GateMode.ARMED)
        await until_ended(bench)
        bench.gate(GateMode.DISARMED)
        await bench.clock.sleep(0.2)
        before = len(prepared)
        await bench.clock.sleep(2.0)
        assert len(prepared) == before
        bench.pose = (bench.pose[0] - 0.2, *bench.pose[1:])
        await bench.clock.sleep(2.0)
        assert len(prepared) == before + 1

    monkeypatch.setattr("monstertruck_planners.track.service.SegmentedPath", line)
    bench = on_bench(scenario, route)
    assert [reason for reason, _ in bench.events] == [Reason.GOAL_REACHED]


def test_a_truck_put_elsewhere_before_arming_starts_there():
    async def scenario(bench):
        bench.pose = (1.0, 1.0, math.pi / 2)
        await bench.clock.sleep(0.2)
        bench.gate(GateMode.ARMED)
        await bench.clock.sleep(0.5)
        assert abs(bench.reported[-1].cross_track) < 0.05
        assert bench.reported[-1].along < 0.2

    on_bench(scenario, path(circle(1.0), closed=True))


def test_a_stale_pose_silences_it():
    async def scenario(bench):
        bench.gate(GateMode.DRIVING)
        await bench.clock.sleep(1.0)
        bench.silent = True
        await bench.clock.sleep(0.3)
        asked = len(bench.asked)
        await bench.clock.sleep(1.0)
        assert len(bench.asked) == asked

    on_bench(scenario, path(straight(4.0)))


def test_a_lost_path_is_reported_and_the_truck_left_standing():
    async def scenario(bench):
        bench.gate(GateMode.DRIVING)
        await bench.clock.sleep(2.0)
        bench.pose = (bench.pose[0], 2.0, 0.0)
        await bench.clock.sleep(1.0)
        assert bench.reported[-1].outcome is Reason.PATH_LOST
        assert bench.reported[-1].stamp - bench.asked[-1].stamp > SECOND // 2

    bench = on_bench(scenario, path(straight(4.0)))
    ((reason, text),) = bench.events
    assert reason is Reason.PATH_LOST
    assert "m from the robot, which is at" in text
    assert "2.00 m in odom; the nearest point of the path is" in text


def test_a_new_path_replaces_the_old_one():
    async def scenario(bench):
        bench.gate(GateMode.DRIVING)
        await bench.clock.sleep(2.0)
        bench.path_in.latest = path(straight(1.0) + bench.pose[:2])
        await bench.clock.sleep(0.2)
        assert bench.reported[-1].length == pytest.approx(1.0)
        assert bench.reported[-1].along < 0.2

    on_bench(scenario, path(straight(4.0)))


def test_impossible_paths_are_reported_once_and_ignored():
    async def scenario(bench):
        bench.gate(GateMode.DRIVING)
        await bench.clock.sleep(1.0)
        assert bench.asked == []
        bench.path_in.latest = path([[0.0, 0.0]])
        await bench.clock.sleep(1.0)
        bench.gate(GateMode.DISARMED)
        await bench.clock.sleep(0.2)
        bench.path_in.latest = path(straight(1.0))
        bench.gate(GateMode.DRIVING)
        await bench.clock.sleep(0.2)
        assert bench.asked

    bench = on_bench(scenario, path(straight(1.0), frame="map"))
    assert [reason for reason, _ in bench.events] == [Reason.BAD_INPUT, Reason.BAD_INPUT]
    assert "frame 'map': expected 'odom'" in bench.events[0][1]


def test_a_path_of_huge_poses_is_reported_and_ignored():
    async def scenario(bench):
        bench.gate(GateMode.DRIVING)
        await bench.clock.sleep(1.0)
        assert bench.asked == []
        bench.path_in.latest = path(straight(1.0))
        await bench.clock.sleep(0.2)
        assert bench.asked

    bench = on_bench(scenario, path([[0.0, 0.0], [1e308, 1e308], [-1e308, 0.0]]))
    assert [reason for reason, _ in bench.events] == [Reason.BAD_INPUT]


def test_a_path_that_the_kinematics_refuse_is_reported_once_and_ignored(monkeypatch):
    def refuse(*_):
        raise KinematicsError("no such motion")

    async def scenario(bench):
        bench.gate(GateMode.DRIVING)
        with monkeypatch.context() as patch:
            patch.setattr(PurePursuit, "control", refuse)
            await bench.clock.sleep(1.0)
        asked = len(bench.asked)
        await bench.clock.sleep(1.0)
        assert len(bench.asked) == asked
        bench.path_in.latest = path(straight(1.0))
        await bench.clock.sleep(0.2)
        assert len(bench.asked) > asked

    bench = on_bench(scenario, path(straight(2.0)))
    assert [reason for reason, _ in bench.events] == [Reason.BAD_INPUT]
    assert "path 'test' cannot be driven from" in bench.events[0][1]


def test_the_gates_stamp_is_echoed():
    async def scenario(bench):
        bench.gate(GateMode.DRIVING)
        await bench.clock.sleep(0.5)
        assert bench.asked[-1].gate_stamp == bench.gate_in.latest.stamp

    on_bench(scenario, path(straight(2.0)))


def test_nothing_happens_without_gate_or_path():
    async def scenario(bench):
        gate, bench.gate_in.latest = bench.gate_in.latest, None
        reported = len(bench.reported)
        await bench.clock.sleep(0.3)
        assert len(bench.reported) == reported
        bench.gate_in.latest = gate
        await bench.clock.sleep(0.1)
        assert len(bench.reported) > reported

    on_bench(scenario, path(straight(1.0)))


def scan(now, x, y):
    """One return at (x, y) in base."""
    bearing, distance = math.atan2(y, x - 0.14), math.hypot(x - 0.14, y)
    return LaserScan(
        stamp=now,
        received=now,
        seq=0,
        frame="lidar",
        start_angle=bearing,
        end_angle=bearing,
        time_increment=0.0,
        scan_time=0.1,
        range_min=0.06,
        range_max=4.0,
        ranges=[distance],
        codes=[255],
    )


def test_a_narrow_place_ahead_slows_it_down_while_the_scan_is_fresh():
    async def scenario(bench):
        bench.gate(GateMode.DRIVING)
        await bench.clock.sleep(0.5)
        assert bench.asked[-1].speed == pytest.approx(0.18)
        bench.scan_in.latest = scan(bench.clock.now(), 0.6, 0.24)
        await bench.clock.sleep(0.1)
        assert bench.asked[-1].speed == pytest.approx(0.18 * 0.06 / 0.12, rel=0.05)
        await bench.clock.sleep(0.5)
        assert bench.asked[-1].speed == pytest.approx(0.18)

    on_bench(scenario, path(straight(4.0)), with_scan=True)


def driven(
    way: float, asked: float, seconds: float, *, again: bool = False, at: float = 0.0, reasons: tuple[Reason, ...] = ()
) -> tuple[list[TrackOutput], TrackingStep]:
    """Outputs of a truck that comes ``way`` m/s along a straight where the gate lets it drive ``asked`` m/s."""
    setup = TrackSetup(PurePursuitConfig(), FourWheelSteering(), Footprint(), (0.14, 0.0, 0.0))
    step, route, outputs = TrackingStep(setup), path(straight(9.0 if not at else 0.3)), []

    def stand(now: int, mode: GateMode, x: float) -> None:
        head = {"stamp": now, "received": now, "seq": 0}
        covariance = {"pose_covariance": np.zeros(9), "twist_covariance": np.zeros(9), "age": 0.0}
        twist = Twist2D(vx=0.0, vy=0.0, wz=0.0)
        pose = Odometry(**head, frame="odom", pose=Pose2D(x=x, y=0.0, yaw=0.0), twist=twist, **covariance)
        gate = GateState(
            **head, mode=mode, nonce="n1", speed_limit=0.2, holder="tracker", twist=Twist2D(vx=asked, vy=0.0, wz=0.0),
            reasons=reasons,
        )  # fmt: skip
        outputs.append(step.step(now, Newest(pose, route, gate)))

    stand(0, GateMode.DISARMED, at)
    for tick in range(1, round(50 * seconds)):
        stand(tick * SECOND // 50, GateMode.DRIVING, at + way * tick / 50)
    if again:
        stand(10**11, GateMode.DISARMED, way * seconds)
        stand(10**11 + SECOND // 50, GateMode.DRIVING, way * seconds)
    return outputs, step


def test_a_path_that_leads_onto_unseen_ground_ends_within_seconds_and_says_where():
    outputs, _ = driven(0.0, 0.0, 3.0, again=True, reasons=(Reason.UNSEEN_STOP,))
    outcomes = [output.command.outcome for output in outputs]
    first = outcomes.index(Reason.UNSEEN_STOP)
    assert first / 50 == pytest.approx(UNSEEN_AFTER / SECOND, abs=0.05)
    assert set(outcomes[first:-1]) == {Reason.UNSEEN_STOP}
    assert all(output.command.speed == 0.0 and not output.drive for output in outputs[first:-1])
    (event,) = [event for output in outputs for event in output.events if event.reason is Reason.UNSEEN_STOP]
    assert "leads onto ground that no sensor has seen, from 0.00, 0.00" in event.text
    assert outcomes[-1] is Reason.DRIVING, "armed again it tries again"


def test_a_path_is_driven_if_only_its_tolerance_is_left_before_unseen_ground():
    outputs, _ = driven(
        0.0, 0.0, 2.0, at=0.3 - PurePursuitConfig().goal_tolerance + 0.005, reasons=(Reason.UNSEEN_STOP,)
    )
    assert outputs[-1].command.outcome is Reason.GOAL_REACHED


def test_a_truck_that_pushes_against_something_unseen_stops_and_says_so_once_and_begins_anew_when_armed():
    outputs, _ = driven(0.0, 0.2, 8.0, again=True)
    outcomes = [output.command.outcome for output in outputs]
    first = outcomes.index(Reason.STUCK)
    assert first / 50 == pytest.approx(STUCK_AFTER / 0.2, abs=0.1)
    assert set(outcomes[first:-1]) == {Reason.STUCK}
    assert all(output.command.speed == 0.0 and not output.drive for output in outputs[first:-1])
    events = [event.reason for output in outputs for event in output.events]
    assert events.count(Reason.STUCK) == 1
    assert outcomes[-1] is Reason.DRIVING
    assert outputs[-1].drive


@pytest.mark.parametrize(("way", "asked"), [(0.05, 0.2), (0.0, 0.0), (0.18, 0.18)])
def test_a_truck_that_slips_waits_or_drives_is_not_stuck(way: float, asked: float):
    outputs, _ = driven(way, asked, 20.0)
    assert {output.command.outcome for output in outputs} == {Reason.DRIVING}
