"""What the goal service keeps of a deformation: what is sent, when it counts as blocked, what is reported."""

import asyncio
from collections.abc import Callable, Coroutine
from typing import Any, Self

import numpy as np
import pytest

from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.collision import Footprint
from monstertruck_planners.goals.config import PlannerConfig
from monstertruck_planners.goals.deformation import RouteDeformation, event_of
from monstertruck_planners.goals.exchange import DeformAnswer, DeformTask, Finding, RouteAnswer, Setup
from monstertruck_planners.local.config import RsbandConfig
from monstertruck_planners.pose_path import PosePath
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import WorkerError
from monstertruck_runtime.mailbox import Mailbox, latest
from monstertruck_schemas.base import Pose2D, Twist2D
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import LaserScan
from monstertruck_schemas.state import Odometry

POSES = np.column_stack((np.linspace(0.0, 2.0, 21), np.zeros(21), np.zeros(21)))
ROUTE = RouteAnswer(Reason.OK, "", PosePath(POSES, np.ones(21), ("counter",) * 21), 2.0, 2.0)
FREE, BLOCKED = DeformAnswer(1, "free", complete=True), DeformAnswer(1, "blocked", Reason.PATH_BLOCKED)


class Elsewhere:
    """An actor that answers as it is given, or fails."""

    def __init__(self) -> None:
        self.tasks: list[DeformTask] = []
        self.answer = FREE
        self.fails = False

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        pass

    async def start(self) -> None:
        pass

    async def step(self, task: DeformTask) -> DeformAnswer:
        self.tasks.append(task)
        if self.fails:
            raise WorkerError("gone")
        return self.answer


class Stage:
    """A deformation with its ends in hand."""

    def __init__(self, clock: VirtualClock) -> None:
        self.clock, self.actor = clock, Elsewhere()
        self.scans: Mailbox[LaserScan] = Mailbox(latest())
        self.poses: Mailbox[Odometry] = Mailbox(latest())
        self.odometry: Mailbox[Odometry] = Mailbox(latest())
        self.reported: list[tuple[Finding, Finding]] = []
        self.events: list[Reason] = []
        self.deformation = RouteDeformation(
            Setup(PlannerConfig(local_planner=RsbandConfig()), FourWheelSteering(), Footprint()),
            clock, self.actor, scan=self.scans, pose=self.poses, grid=None,
            events=lambda reason, *_, **__: self.events.append(reason), odometry=self.odometry,
        )  # fmt: skip

    async def scan(self, count: int = 1, tilt: float | None = None) -> None:
        """Scans at 10 Hz, with poses."""
        for _ in range(count):
            head = {"stamp": self.clock.now(), "received": self.clock.now(), "seq": 0}
            self.poses.put(
                Odometry(
                    **head, frame="map", pose=Pose2D(x=0.0, y=0.0, yaw=0.0), twist=Twist2D(vx=0.0, vy=0.0, wz=0.0),
                    pose_covariance=np.zeros(9), twist_covariance=np.zeros(9), age=0.0,
                )
            )  # fmt: skip
            self.scans.put(
                LaserScan(
                    **head, frame="lidar", start_angle=0.0, end_angle=1.0, time_increment=0.0, scan_time=0.1,
                    range_min=0.1, range_max=4.0, ranges=np.ones(2), codes=np.zeros(2, np.uint8), tilt=tilt,
                )
            )  # fmt: skip
            await self.clock.sleep(0.1)


def play(story: Callable[[Stage], Coroutine[Any, Any, None]]) -> Stage:
    async def main(clock: VirtualClock) -> Stage:
        stage = Stage(clock)
        task = asyncio.create_task(
            stage.deformation.run(lambda was, answer: stage.reported.append((was, answer.finding)))
        )
        await clock.sleep(0.01)
        await story(stage)
        task.cancel()
        await asyncio.wait([task])
        return stage

    return run_virtual(main)


def test_setup_and_route_are_sent_once_and_again_after_a_failure():
    async def story(stage: Stage) -> None:
        await stage.scan()
        stage.deformation.begin(ROUTE)
        await stage.scan(2)
        stage.actor.fails = True
        await stage.scan()
        stage.actor.fails = False
        await stage.scan()
        sent = [(task.setup is not None, task.route is not None) for task in stage.actor.tasks]
        assert sent == [(True, False), (False, True), (False, False), (False, False), (True, True)]
        assert len(stage.events) == 1

    assert play(story).reported == [("idle", "free"), ("free", "free"), ("free", "free")]


def test_the_pose_in_the_odometry_frame_is_the_one_at_the_stamp_of_the_pose_in_the_map():
    async def story(stage: Stage) -> None:
        await stage.scan()
        assert stage.actor.tasks[-1].odometry is None, "before the first odometry"
        at = stage.poses.latest
        assert at is not None
        moved = {"pose": Pose2D(x=1.0, y=2.0, yaw=0.5), "twist": Twist2D(vx=0.0, vy=0.0, wz=-0.1)}
        stage.odometry.put(at.model_copy(update={"stamp": stage.clock.now() - SECOND // 50, **moved}))
        await stage.scan()
        assert stage.actor.tasks[-1].odometry == pytest.approx((1.0, 2.0, 0.498), abs=1e-6)

    play(story)


def test_tilted_scans_say_nothing():
    async def story(stage: Stage) -> None:
        await stage.scan(2, tilt=0.05)
        await stage.scan(3, tilt=0.3)
        await stage.scan()
        assert len(stage.actor.tasks) == 3

    play(story)


def test_the_route_counts_as_blocked_after_a_while_without_a_way_round():
    async def story(stage: Stage) -> None:
        stage.deformation.begin(ROUTE)
        assert not stage.deformation.active
        stage.actor.answer = BLOCKED
        await stage.scan(15)
        assert (stage.deformation.held_up, stage.deformation.blocked(stage.clock.now())) == (True, False)
        await stage.scan(10)
        assert stage.deformation.blocked(stage.clock.now())
        stage.deformation.begin(ROUTE)
        assert not stage.deformation.blocked(stage.clock.now())
        stage.actor.answer = DeformAnswer(1, "kept", complete=True)
        await stage.scan(10)
        assert not stage.deformation.active, "that was another route's"

    play(story)


def test_a_detour_without_end_is_blocked_too():
    async def story(stage: Stage) -> None:
        stage.deformation.begin(ROUTE)
        stage.actor.answer = DeformAnswer(1, "kept", place=5)
        await stage.scan(400)
        stage.actor.answer = DeformAnswer(1, "kept", place=7)
        await stage.scan(400)
        assert not stage.deformation.blocked(stage.clock.now())
        assert (stage.deformation.deformed, stage.deformation.complete) == (True, False)
        await stage.scan(60)
        assert stage.deformation.blocked(stage.clock.now())
        assert stage.deformation.left == pytest.approx(1.3)
        rest = stage.deformation.rest
        assert (rest.poses[0, 0], len(rest.steering)) == (pytest.approx(0.7), 14)

    play(story)


@pytest.mark.parametrize(
    ("was", "answer", "reason"),
    [
        ("free", DeformAnswer(1, "new"), Reason.ROUTE_DEFORMED),
        ("new", DeformAnswer(1, "new"), None),
        ("kept", BLOCKED, Reason.PATH_BLOCKED),
        ("blocked", BLOCKED, None),
        ("kept", FREE, Reason.ROUTE_FREE),
        ("idle", FREE, None),
        ("free", DeformAnswer(1, "yields"), Reason.YIELDS),
        ("yields", DeformAnswer(1, "yields"), None),
        ("yields", FREE, Reason.ROUTE_FREE),
    ],
)
def test_changes_are_reported_once(was: Finding, answer: DeformAnswer, reason: Reason | None):
    reported = event_of(was, answer)
    assert (None if reported is None else reported[0]) is reason
