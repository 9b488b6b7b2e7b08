"""Behaviours as a service: who may start one, when it ends, and what it asks the gate for."""

import asyncio
from dataclasses import dataclass

import pytest

from monstertruck_kinematics.chassis import Dimensions
from monstertruck_kinematics.truck import DriveTrain
from monstertruck_planners.behave.api import BehaviourBody, RequestedMotion
from monstertruck_planners.behave.service import SOURCE, BehaviourService
from monstertruck_planners.behave.wall.config import WallPdConfig
from monstertruck_runtime.bodies import build_chassis
from monstertruck_runtime.clock import VirtualClock, run_virtual
from monstertruck_runtime.errors import InputError, NotFoundError, RequestRefusedError
from monstertruck_runtime.mailbox import fifo, latest
from monstertruck_schemas import topics
from monstertruck_schemas.base import Twist2D
from monstertruck_schemas.body import TruckBody
from monstertruck_schemas.plan import GoalPhase, GoalState, TrackerState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import BehaviourOrder, BehaviourRequest, Role
from monstertruck_schemas.state import GateMode, GateState
from monstertruck_schemas.topics import Writer
from monstertruckd.bus.local import Bus
from tests.unit.planners.behave.wall_kit import odometry, sonars

ALONG = {"l": 0.3, "fl": 0.42, "f": 2.5, "fr": 2.9, "r": 2.9}


@dataclass
class Bench:
    """The service, and a robot beside a wall whose messages come at 20 Hz."""

    clock: VirtualClock
    mode: GateMode = GateMode.ARMED
    reasons: tuple[Reason, ...] = ()
    hears: bool = True
    """Sonars send."""
    obeys: bool = True
    blocked: bool = False
    seq: int = 0

    def __post_init__(self):
        self.bus = bus = Bus(self.clock)
        self.gate, self.sonar = bus.publisher(topics.GATE, Writer.GATE), bus.publisher(topics.SONAR, Writer.DRIVER)
        self.odometry = bus.publisher(topics.ODOMETRY, Writer.ESTIMATION)
        self.goal = bus.publisher(topics.GOAL, Writer.PLANNER)
        self.tracker = bus.publisher(topics.TRACKER, Writer.PLANNER)
        self.requests = bus.subscribe(topics.PLAN_DRIVE, fifo(4096))
        self.states = bus.subscribe(topics.BEHAVIOUR, fifo(4096))
        self.newest = bus.subscribe(topics.BEHAVIOUR, latest())
        self.events = bus.subscribe(topics.EVENT, fifo(4096))
        drive = bus.publisher(topics.PLAN_DRIVE, Writer.PLANNER)
        configs = {"wall": WallPdConfig(), "other": WallPdConfig(side="right")}
        body = BehaviourBody(build_chassis(TruckBody(), Dimensions(DriveTrain())), 0.4)
        self.service = BehaviourService(configs, self.clock, bus, drive, 0.5, body)
        self.asked = RequestedMotion()

    async def robot(self):
        while True:
            now = self.clock.now()
            for request in self.requests.drain():
                self.asked = RequestedMotion(request.twist.vx, request.twist.wz)
            mode = self.mode
            if mode is GateMode.ARMED and self.obeys and any(self.asked):
                mode = GateMode.DRIVING
            twist = Twist2D(
                vx=0.0 if self.blocked else self.asked.vx, vy=0.0, wz=0.0 if self.blocked else self.asked.wz
            )
            driving = mode is GateMode.DRIVING
            self.gate.put(
                GateState(
                    stamp=now,
                    received=now,
                    seq=0,
                    mode=mode,
                    nonce="n",
                    speed_limit=0.2,
                    reasons=self.reasons,
                    holder=SOURCE if driving else None,
                    twist=twist if driving else None,
                )
            )
            vx = twist.vx if driving else 0.0
            self.odometry.put(odometry(vx=vx, now=now))
            if self.hears:
                self.sonar.put(sonars(ALONG, now=now))
            await self.clock.sleep(0.05)

    def order(self, order, behaviour="", **more):
        self.seq += 1
        now = self.clock.now()
        header = {"stamp": now, "received": now, "seq": self.seq, "source": "ann", "role": Role.STATION, "lease": 1.0}
        header |= {"nonce": "n", "gate_stamp": now}
        return self.service.tasks.take(BehaviourRequest(**{**header, **more}, order=order, behaviour=behaviour))

    def start(self, name="wall", **more):
        return self.order(BehaviourOrder.START, name, **more)

    def stop(self, name="", **more):
        return self.order(BehaviourOrder.STOP, name, **more)

    @property
    def state(self):
        return self.newest.latest

    def say_goal(self, phase):
        now = self.clock.now()
        self.goal.put(GoalState(stamp=now, received=now, seq=0, number=3, source="bob", phase=phase))

    def say_tracker(self, outcome):
        now = self.clock.now()
        self.tracker.put(
            TrackerState(
                stamp=now,
                received=now,
                seq=0,
                path="bend",
                cross_track=0.0,
                heading_error=0.0,
                along=0.0,
                length=1.0,
                outcome=outcome,
            )
        )


def on_bench(scenario, **more):
    async def main(clock):
        bench = Bench(clock, **more)
        running = [asyncio.create_task(bench.service.run(lambda: None)), asyncio.create_task(bench.robot())]
        await clock.sleep(1.0)
        try:
            await scenario(bench)
            assert not any(task.done() for task in running)
        finally:
            for task in running:
                task.cancel()
            await asyncio.wait(running)

    run_virtual(main)


def refused(bench, *args, **more):
    with pytest.raises(RequestRefusedError) as caught:
        bench.start(*args, **more)
    return caught.value


def test_it_asks_for_motion_as_a_planner_and_reports_until_it_is_stopped():
    async def scenario(bench):
        assert bench.state.number == 0
        assert bench.start() == 1
        await bench.clock.sleep(2.0)
        assert bench.asked.vx == pytest.approx(0.2)
        assert bench.state.running
        assert (bench.state.behaviour, bench.state.kind, bench.state.source) == ("wall", "wall_pd", "ann")
        assert bench.state.values["distance"] == pytest.approx(0.3, abs=0.01)
        assert bench.stop("wall") == 1
        assert not bench.state.running
        assert bench.state.outcome is Reason.CANCELLED
        await bench.clock.sleep(0.2)
        assert bench.asked == RequestedMotion()
        await bench.clock.sleep(1.5)
        bench.asked = RequestedMotion(9.0)
        await bench.clock.sleep(1.0)
        assert bench.asked == RequestedMotion(9.0)  # nothing is asked for any more
        assert [e.reason for e in bench.events.drain()] == [Reason.BEHAVIOUR_STARTED, Reason.CANCELLED]

    on_bench(scenario)


def test_one_behaviour_at_a_time_and_only_those_configured():
    async def scenario(bench):
        with pytest.raises(NotFoundError, match="wall, other"):
            bench.start("nothing")
        bench.start()
        again = refused(bench, "other")
        assert again.refusal is Reason.BUSY
        assert "wall" in str(again)
        with pytest.raises(RequestRefusedError):
            bench.stop("other")
        bench.stop()
        with pytest.raises(RequestRefusedError) as caught:
            bench.stop()
        assert caught.value.refusal is Reason.NOT_FOUND
        assert bench.start("other") == 2

    on_bench(scenario)


@pytest.mark.parametrize("other", [{"source": "bob"}, {"instance": "another"}])
def test_who_stops_only_its_own_stops_nobody_elses(other):
    async def scenario(bench):
        bench.start(instance="one")
        with pytest.raises(RequestRefusedError, match="the behaviour wall of ann is running") as caught:
            bench.stop("wall", own=True, **{"instance": "one", **other})
        assert caught.value.refusal is Reason.NOT_FOUND
        assert bench.state.running
        bench.stop("wall", own=True, instance="one")
        assert not bench.state.running

    on_bench(scenario)


def test_the_rules_of_requests_hold():
    async def scenario(bench):
        assert refused(bench, nonce="old").refusal is Reason.BAD_NONCE
        assert refused(bench, role=Role.TRACKER).refusal is Reason.BAD_ROLE
        late = refused(bench, gate_stamp=0)
        assert late.refusal is Reason.LEASE_EXPIRED
        assert str(late).startswith("the request came more than 0.5 s after its sender had heard the gate")
        assert refused(bench, seq=1).refusal is Reason.BAD_SEQUENCE

    on_bench(scenario)


def test_a_goal_or_a_path_that_is_followed_excludes_it():
    async def scenario(bench):
        bench.say_goal(GoalPhase.DRIVING)
        goal = refused(bench)
        assert goal.refusal is Reason.BUSY
        assert "goal 3 of bob" in str(goal)
        bench.say_goal(GoalPhase.IDLE)
        bench.say_tracker(Reason.DRIVING)
        assert str(refused(bench)) == "the tracker follows the path 'bend'"
        bench.mode = GateMode.DISARMED
        await bench.clock.sleep(0.2)
        bench.say_tracker(Reason.DRIVING)
        waits = refused(bench)
        assert (waits.refusal, str(waits)) == (
            Reason.BUSY,
            "the tracker follows the path 'bend' as soon as the robot is armed",
        )
        bench.mode = GateMode.ARMED
        await bench.clock.sleep(0.2)
        bench.say_tracker(Reason.GOAL_REACHED)
        bench.start()
        bench.say_tracker(Reason.DRIVING)
        await bench.clock.sleep(0.3)
        assert bench.state.outcome is Reason.BUSY

    on_bench(scenario)


@pytest.mark.parametrize("mode", [GateMode.DISARMED, GateMode.ESTOPPED])
def test_it_needs_an_armed_robot_and_ends_when_it_is_disarmed(mode):
    async def scenario(bench):
        bench.mode, bench.reasons = mode, (Reason(mode.value),)
        await bench.clock.sleep(0.2)
        assert refused(bench).refusal is Reason(mode.value)
        bench.mode, bench.reasons = GateMode.ARMED, ()
        await bench.clock.sleep(0.2)
        bench.start()
        await bench.clock.sleep(0.5)
        bench.mode, bench.reasons = mode, (Reason(mode.value),)
        await bench.clock.sleep(0.3)
        assert bench.state.outcome is Reason(mode.value)

    on_bench(scenario)


@pytest.mark.parametrize("settings", [{"kind": "move"}, {"rate": 50.0}, {"spede": 0.1}])
def test_a_run_takes_its_settings_but_no_kind_nor_rate_of_its_own(settings):
    async def scenario(bench):
        with pytest.raises(
            InputError, match=rf"settings\.{next(iter(settings))}: not a setting of wall_pd for one run"
        ):
            bench.start(settings=settings)
        with pytest.raises(InputError, match=r"not a setting of wall_pd for one run"):
            bench.service.check("wall", settings)
        bench.mode = GateMode.DISARMED
        await bench.clock.sleep(0.2)
        bench.service.check("wall", {"distance": 0.4})
        assert bench.state.number == 0
        bench.mode = GateMode.ARMED
        await bench.clock.sleep(0.2)
        bench.start(settings={"distance": 0.4})

    on_bench(scenario)


def test_without_fresh_sonars_it_does_not_start_and_stops():
    async def scenario(bench):
        bench.hears = False
        for mode in (GateMode.DISARMED, GateMode.ARMED):  # to arm it would not help
            bench.mode = mode
            await bench.clock.sleep(0.5)
            stale = refused(bench)
            assert stale.refusal is Reason.INPUT_STALE
            assert "sensor/sonar" in str(stale)
        bench.hears = True
        await bench.clock.sleep(0.2)
        bench.start()
        await bench.clock.sleep(1.0)
        bench.hears = False
        await bench.clock.sleep(0.6)
        assert bench.state.outcome is Reason.INPUT_STALE
        assert bench.asked == RequestedMotion()

    on_bench(scenario)


def test_what_does_not_run_cannot_be_stopped():
    async def scenario(bench):
        with pytest.raises(RequestRefusedError, match="no behaviour is running"):
            bench.stop("wall")
        bench.start()
        with pytest.raises(RequestRefusedError, match="the behaviour other is not running"):
            bench.stop("other")

    on_bench(scenario)


def test_an_order_to_stop_ends_it_so_that_it_does_not_go_on_when_the_robot_is_armed_at_once():
    async def scenario(bench):
        bench.start()
        for reasons, running in (((Reason.SCAN_STALE,), True), ((Reason.STOPPED,), False)):
            await bench.clock.sleep(0.5)
            bench.mode, bench.reasons = GateMode.STOPPING, reasons
            await bench.clock.sleep(0.2)
            assert bench.state.running is running
            bench.mode, bench.reasons = GateMode.ARMED, ()
        await bench.clock.sleep(0.5)
        assert (bench.state.outcome, any(bench.asked)) == (Reason.CANCELLED, False)

    on_bench(scenario)


@pytest.mark.parametrize("way", ["obeys", "blocked"])
def test_a_gate_that_does_not_let_it_drive_ends_it_with_the_gates_reason(way):
    async def scenario(bench):
        bench.reasons = (Reason.OBSTACLE_STOP,)
        setattr(bench, way, way == "blocked")
        bench.start()
        await bench.clock.sleep(4.0)
        assert bench.state.outcome in (Reason.OBSTACLE_STOP, Reason.STUCK)
        assert not bench.state.running

    on_bench(scenario)
