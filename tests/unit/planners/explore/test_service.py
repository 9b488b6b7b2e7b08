"""The exploring service and its worker."""

import asyncio
from types import SimpleNamespace
from typing import Self

import numpy as np
import pytest

from monstertruck_planners.collision import Footprint
from monstertruck_planners.explore.config import InformationConfig
from monstertruck_planners.explore.exchange import ExploreAnswer, ExploreSetup, ExploreTask, Viewpoint
from monstertruck_planners.explore.service import ExplorerInputs, ExplorerService
from monstertruck_runtime.clock import VirtualClock, run_virtual
from monstertruck_runtime.errors import InputError, RequestRefusedError
from monstertruck_runtime.mailbox import Mailbox, fifo
from monstertruck_runtime.requests import inner_request
from monstertruck_schemas.base import Message, Pose2D, Twist2D
from monstertruck_schemas.event import Event, Severity
from monstertruck_schemas.health import ServiceHealth, ServiceState
from monstertruck_schemas.plan import GoalPhase, GoalState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import ExploreOrder, ExploreRequest, GoalControl
from monstertruck_schemas.state import GateMode, GateState, Odometry

DECIDING = 0.3
"""Seconds."""


class Worker:
    """Answers the nth question with a place at x = n."""

    asked = 0

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        pass

    def __init__(self, clock: VirtualClock) -> None:
        self._clock = clock

    async def step(self, _: ExploreTask) -> ExploreAnswer:
        self.asked += 1
        target = Viewpoint((float(self.asked), 0.0, 0.0), (self.asked + 1.0, 0.0))
        await self._clock.sleep(DECIDING)
        return ExploreAnswer(target, frontiers=1, known=1.0)


class Live:
    """A topic whose newest message is always of now."""

    def __init__(self, message: Message, clock: VirtualClock) -> None:
        self._message, self._clock = message, clock

    @property
    def latest(self) -> Message:
        return self._message.model_copy(update={"stamp": self._clock.now(), "received": self._clock.now()})


def test_a_step_in_the_loop_that_refuses_its_input_is_an_answer_and_an_event():
    class Refusing:
        async def step(self, task: object) -> object:
            raise InputError("map: not readable")

    reported: list[tuple[object, ...]] = []
    service = ExplorerService.__new__(ExplorerService)
    service._actor, service._fresh = Refusing(), False
    service._events = lambda *event: reported.append(event)
    target = Viewpoint((1.0, 0.0, 0.0), (2.0, 0.0))
    answer = asyncio.run(service._ask(ExploreTask((0.0, 0.0, 0.0), current=target)))
    assert (answer.target, answer.kept, service._fresh) == (target, True, True)
    assert (answer.failure, answer.text) == (Reason.BAD_INPUT, "map: not readable")
    assert [event[0] for event in reported] == [Reason.BAD_INPUT]


def test_an_operators_goal_after_one_of_its_own_was_refused_is_noticed():
    service = ExplorerService.__new__(ExplorerService)
    service._refused, service._goal, service._others = (Reason.LEASE_EXPIRED, "late"), 3, 1
    newest = GoalState(stamp=0, received=0, seq=0, frame="map", number=4, source="bob", phase=GoalPhase.DRIVING)
    service._in = SimpleNamespace(goal=SimpleNamespace(latest=newest))
    assert service._goal_end() == (None, "", "bob")
    service._in.goal.latest = newest.model_copy(update={"number": 1})
    assert service._goal_end() == (Reason.LEASE_EXPIRED, "late", "")


def test_a_map_that_could_not_be_saved_is_not_waited_for():
    service = ExplorerService.__new__(ExplorerService)
    service._saves, service._cannot_save = 5, False
    service._in = SimpleNamespace(events=Mailbox(fifo(8)))

    def say(reason: Reason, at: int) -> None:
        event = {"stamp": at, "received": at, "seq": 0, "source": "slam", "severity": Severity.WARNING}
        service._in.events.put(Event(**event, reason=reason, text="no space left"))

    say(Reason.MAP_NOT_SAVED, 4)
    assert service._saved() == (None, ""), "that was an earlier request"
    say(Reason.MAP_NOT_SAVED, 6)
    assert service._saved() == ("", "no space left")
    say(Reason.MAP_SAVED, 7)
    assert service._saved() == ("no space left", "")


def test_it_hears_of_failed_services_without_which_it_cannot_drive():
    service = ExplorerService.__new__(ExplorerService)
    rows = [
        ServiceHealth(name=name, state=state, since=0, detail=f"{name} fell")
        for name, state in (
            ("goals", ServiceState.READY),
            ("camera", ServiceState.FAILED),
            ("tracker", ServiceState.BACKOFF),
        )
    ]
    gate = SimpleNamespace(reasons=())
    service._in = SimpleNamespace(
        health=SimpleNamespace(latest=SimpleNamespace(services=rows)), gate=SimpleNamespace(latest=gate)
    )
    assert service._failed() == "", "the gate lets it drive without a camera"
    gate.reasons = (Reason.SERVICE_FAILED,)
    assert service._failed() == "camera: camera fell"
    gate.reasons, rows[0] = (), rows[0].model_copy(update={"state": ServiceState.FAILED})
    assert service._failed() == "goals: goals fell", "whether the gate lets it drive or not"


def test_a_goal_that_has_ended_since_the_newest_report_is_not_cancelled_once_more():
    def control(_: object) -> None:
        raise RequestRefusedError(Reason.NOT_FOUND, "cancel: no goal is being pursued")

    service = ExplorerService.__new__(ExplorerService)
    goal = GoalState(stamp=0, received=0, seq=0, frame="map", number=3, source="explorer", phase=GoalPhase.DRIVING)
    service._in = SimpleNamespace(goal=SimpleNamespace(latest=goal), gate=SimpleNamespace(latest=None))
    service._seq, service._goal, service._clock = 0, 3, SimpleNamespace(now=lambda: 0)
    service._goals = SimpleNamespace(tasks=SimpleNamespace(take=control))
    service._cancel()
    assert service._goal is None


def test_what_an_exploration_needs_is_checked_before_it_begins():
    service, pose = ExplorerService.__new__(ExplorerService), (1.0, 2.0, 0.0)
    service._pose, service._clock = lambda _: pose, SimpleNamespace(now=lambda: 0)
    service._in = SimpleNamespace(points=None)

    def start(**more: int) -> ExploreRequest:
        return ExploreRequest(**inner_request(1, None, 0, "ann"), order=ExploreOrder.START, **more)

    assert service.accept(start()) == pose
    with pytest.raises(RequestRefusedError) as refused:
        service.accept(start(find=3))
    assert refused.value.refusal is Reason.NOT_SUPPORTED
    pose = None
    with pytest.raises(RequestRefusedError) as refused:
        service.accept(start())
    assert refused.value.refusal is Reason.NO_MAP


def test_the_answer_to_a_question_of_the_exploration_before_is_none():
    sent: list[float] = []

    async def main(clock: VirtualClock) -> None:
        worker, newest, head = Worker(clock), SimpleNamespace, {"stamp": 0, "received": 0, "seq": 0}
        still, sure = Twist2D(vx=0.0, vy=0.0, wz=0.0), np.zeros(9)
        here = Pose2D(x=0.0, y=0.0, yaw=0.0)
        gate = GateState(**head, frame="base", mode=GateMode.ARMED, nonce="n", speed_limit=1.0)
        pose = Odometry(
            **head, frame="map", pose=here, twist=still, pose_covariance=sure, twist_covariance=sure, age=0.0
        )
        none = newest(latest=None)
        service = ExplorerService(
            ExploreSetup(InformationConfig(), Footprint(), 0.5), clock, worker,
            newest(tasks=newest(take=lambda asked: isinstance(asked, GoalControl) or sent.append(asked.goal.x)
                                or len(sent)), hold=lambda *_, **__: None),
            None, max_age=1.0,
            inputs=ExplorerInputs(
                gate=Live(gate, clock), pose=Live(pose, clock), goal=none, grid=none, tiles=Mailbox(fifo(8)),
                slam=none, battery=none, events=Mailbox(fifo(8)), health=none,
            ),
            state=newest(next_seq=lambda: 0, put=lambda _: None),
            events=lambda *_, **__: None,
        )  # fmt: skip

        def order(what: ExploreOrder, seq: int) -> None:
            header = inner_request(seq, service._in.gate.latest, clock.now(), "ann")
            service.tasks.take(ExploreRequest(**header, order=what))

        running = asyncio.create_task(service.run(lambda: None))
        await clock.sleep(0.1)
        order(ExploreOrder.START, 1)
        while not worker.asked:
            await clock.sleep(0.05)
        order(ExploreOrder.STOP, 2)
        await clock.sleep(1.0)
        assert sent == []
        order(ExploreOrder.START, 3)
        while not sent:
            await clock.sleep(0.05)
        running.cancel()
        await asyncio.wait([running])

    run_virtual(main)
    assert sent == [2.0]
