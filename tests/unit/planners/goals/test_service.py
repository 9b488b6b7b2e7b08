"""The goal service before it runs, what it answers, and what it does about planners that fail."""

import asyncio
from collections import deque
from types import SimpleNamespace

import numpy as np
import pytest

from monstertruck_kinematics.se2 import placed
from monstertruck_planners.goals import deformation
from monstertruck_planners.goals.config import PlannerConfig
from monstertruck_planners.goals.deform_step import DeformStep, Window
from monstertruck_planners.goals.deformation import RouteDeformation
from monstertruck_planners.goals.exchange import DeformTask, RouteAnswer, pose_of, twist_of
from monstertruck_planners.goals.service import GoalService
from monstertruck_runtime.clock import SECOND, run_virtual
from monstertruck_runtime.errors import InputError, RequestRefusedError, WorkerError
from monstertruck_runtime.mailbox import Mailbox, latest
from monstertruck_runtime.requests import inner_request
from monstertruck_schemas.base import Pose2D, Twist2D
from monstertruck_schemas.plan import GoalPhase, GoalState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import GoalRequest
from monstertruck_schemas.state import Odometry
from tests.unit.planners.kit import scanned_on_the_move

GOAL = GoalRequest(**inner_request(1, None, 0, "ann"), goal=Pose2D(x=1.0, y=0.0, yaw=0.0))


@pytest.mark.parametrize(
    ("actor", "reason", "text"),
    [(None, Reason.PLANNER_STARTING, "the planner is starting"), (object(), Reason.NO_MAP, "no pose yet")],
)
def test_a_goal_that_comes_too_early_is_refused_by_what_is_missing(actor: object, reason: Reason, text: str):
    service = GoalService.__new__(GoalService)
    service._actor, service._trouble = actor, None
    service._in = SimpleNamespace(pose=SimpleNamespace(latest=None), slam=None)
    with pytest.raises(RequestRefusedError, match=text) as refused:
        service.accept(GOAL)
    assert refused.value.refusal is reason


def test_a_planner_that_cannot_start_is_not_said_to_be_starting():
    error = "worker goals raised ImportError: libLLVM.so: cannot open"

    class Broken:
        async def __aenter__(self):
            return self

        async def __aexit__(self, *_):
            pass

        async def start(self):
            raise WorkerError(f"{error}\nTraceback (most recent call last):")

    service = GoalService.__new__(GoalService)
    service._place, service._actor, service._trouble = Broken(), None, None
    with pytest.raises(WorkerError):
        asyncio.run(service.run(lambda: pytest.fail("it is not ready")))
    with pytest.raises(RequestRefusedError, match=rf"^the planner does not start: {error}$") as refused:
        service.accept(GOAL)
    assert refused.value.refusal is Reason.WORKER_DIED


def test_who_holds_the_truck_between_goals_does_not_stop_a_behaviour():
    still = []
    service = GoalService.__new__(GoalService)
    service._goal, service._held = None, {"missions"}
    service._keep_scan, behaviour = lambda _: None, None
    service.tasks = SimpleNamespace(report=lambda: None, other=lambda: behaviour)
    service._paths = SimpleNamespace(stand_still=lambda: still.append(1))
    service._tick(0)
    behaviour = "the behaviour wall of ann is running"
    service._tick(1)
    assert still == [1]


def test_who_waits_for_the_way_to_a_goal_is_not_informed_of_another_goals_way():
    async def main() -> None:
        service = GoalService.__new__(GoalService)
        changed = asyncio.Event()
        state = GoalState(stamp=0, received=0, seq=0, frame="map", number=1, phase=GoalPhase.PLANNING)
        service.tasks = SimpleNamespace(reported=state, next_report=changed.wait)
        waiting = asyncio.create_task(service.settled(1))
        await asyncio.sleep(0)
        service.tasks.reported = state.model_copy(update={"number": 2})
        changed.set()
        with pytest.raises(RequestRefusedError, match="another goal") as refused:
            await waiting
        assert refused.value.refusal is Reason.CANCELLED

    asyncio.run(main())


def test_the_ground_seen_moves_with_a_pose_that_jumps_and_is_not_placed_by_a_later_one():
    service = GoalService.__new__(GoalService)
    service._setup, service._config = SimpleNamespace(seen_for=30.0), PlannerConfig()
    service._seen, service._trail, service._before = deque(), deque(), None
    service._scan = lambda *_: np.empty((0, 2))
    pose, seen, scan = (SimpleNamespace(latest=None) for _ in range(3))
    service._in = SimpleNamespace(pose=pose, seen=seen, scan=scan)
    scan.latest = SimpleNamespace(field=(-2.0, 2.0), range_max=4.0)

    def at(tick: int, x: float) -> None:
        now = 10 * SECOND + tick * SECOND // 10
        pose.latest = Odometry(
            stamp=now, received=now, seq=tick, pose=Pose2D(x=x, y=0.0, yaw=0.0), frame="map",
            twist=Twist2D(vx=0.0, vy=0.0, wz=0.0), pose_covariance=np.zeros(9), twist_covariance=np.zeros(9), age=0.0,
        )  # fmt: skip
        service._keep_scan(now)

    for tick in range(5):
        at(tick, 0.02 * tick)
    seen.latest = SimpleNamespace(stamp=10 * SECOND)
    assert service._ground_seen().pose == (0.0, 0.0, 0.0)
    at(5, 3.08)  # the map's frame has moved under the robot
    assert service._ground_seen().pose == pytest.approx((3.0, 0.0, 0.0))
    for tick in range(6, 46):
        at(tick, 3.08 + 0.02 * (tick - 5))
    assert service._ground_seen() is None, "the pose at its stamp is no longer kept"


def test_a_planner_in_the_loop_that_refuses_its_input_is_an_answer_and_an_event():
    class Refusing:
        async def step(self, task: object) -> object:
            raise InputError("map: not readable")

    reported: list[tuple[object, ...]] = []
    service = GoalService.__new__(GoalService)
    service._actor, service._fresh = Refusing(), False
    service._out = SimpleNamespace(events=lambda *event: reported.append(event))
    answer = asyncio.run(service._ask(None))
    assert (answer.reason, answer.path, service._fresh) == (Reason.BAD_INPUT, None, True)
    assert [event[0] for event in reported] == [Reason.BAD_INPUT]


def test_without_the_worker_that_deforms_routes_goals_go_on_and_it_is_tried_again():
    reported: list[Reason] = []

    class Failing:
        starts = 0

        async def __aenter__(self):
            return self

        async def __aexit__(self, *_):
            pass

        async def start(self):
            self.starts += 1
            if self.starts < 3:
                raise WorkerError("worker local did not start")

    async def main(clock):
        actor = Failing()
        setup = SimpleNamespace(config=SimpleNamespace(local=None))
        service = RouteDeformation(
            setup,
            clock,
            actor,
            scan=Mailbox(latest()),
            pose=None,
            grid=None,
            events=lambda *e, **_: reported.append(e[0]),
        )
        task = asyncio.create_task(service.run(lambda *_: None))
        await clock.sleep(3 * deformation.DEFORM_RETRY)
        assert (actor.starts, task.done()) == (3, False)
        task.cancel()

    run_virtual(main)
    assert reported == [WorkerError.reason] * 2


def test_returns_of_a_scan_lie_where_they_are_though_the_truck_turned_since():
    scan, odometry, lidar = scanned_on_the_move(wall=2.5)
    service = GoalService.__new__(GoalService)
    service._in, service._scanned = SimpleNamespace(scan=SimpleNamespace(latest=scan)), None
    service._config, service._setup = PlannerConfig(), SimpleNamespace(lidar=lidar)
    points = service._scan(odometry, odometry.stamp)
    there = placed(np.column_stack((points, np.zeros(len(points)))), pose_of(odometry))
    assert np.abs(there[:, 0] - 2.5).max() < 0.002


def test_the_window_of_the_local_planner_has_them_there_too():
    scan, odometry, lidar = scanned_on_the_move(wall=1.0)
    step = DeformStep()
    step._window = Window()
    task = DeformTask(scan, pose_of(odometry), stamp=odometry.stamp, twist=twist_of(odometry))
    step._observe(SimpleNamespace(lidar=lidar), task)
    assert set(np.floor(step._window.obstacles[:, 0] / 0.04).tolist()) <= {24.0, 25.0}, "cells on either side of 1 m"


def test_a_new_route_waits_until_a_braking_truck_is_at_rest():
    """A truck that sets off from another pose than planned misses the cusps, and covers ground nobody has checked."""
    route = RouteAnswer(Reason.OK)

    async def main() -> None:
        service = GoalService.__new__(GoalService)
        service._goal, service._deformation, service._setup = None, None, None
        service._zone_layer = lambda: None
        service._odometry = lambda _: None
        service._in = SimpleNamespace(gate=SimpleNamespace(latest=None), slam=None)
        service._paths = SimpleNamespace(followed=None, rest=(0.1, 0.0, 0.0))
        service._planning = asyncio.create_task(asyncio.sleep(0, route))
        await service._planning
        assert service._observe(0).answer is None
        service._paths.rest = None
        assert service._observe(0).answer is route
        assert service._observe(0).answer is None, "passed once"

    asyncio.run(main())
