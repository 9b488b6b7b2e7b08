"""What is the same for all tasks: who may start, pause and stop one, and when it is reported."""

import asyncio
from types import SimpleNamespace

import pytest

from monstertruck_planners.tasks import TaskServer
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError, RequestRefusedError
from monstertruck_runtime.requests import inner_request
from monstertruck_schemas.plan import ExplorationPhase, ExplorationState, GoalPhase, GoalState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import ExploreOrder, ExploreRequest
from monstertruck_schemas.state import GateMode, GateState

PERIOD = SECOND // 2


class Digging:
    """A service that digs, records what it is asked for, and can be resumed after a restart if it says so."""

    noun = "excavation"
    running = resumable = False

    def __init__(self) -> None:
        self.now = SECOND
        self.asked: list[tuple[object, ...]] = []
        self.newest = ExplorationState(stamp=0, received=0, seq=0, frame="map")
        self.refusal: Exception | None = None
        self.gate = self.topic(
            GateState(stamp=0, received=0, seq=0, mode=GateMode.ARMED, nonce="n", speed_limit=0.2), live=True
        )
        self.goal, self.out = self.topic(None), []
        self.server(changes=("number", "phase"), period=PERIOD, others=(self.goal,), own={"digger"})

    def topic(self, message: object, *, live: bool = False) -> SimpleNamespace:
        bench = self

        class Topic(SimpleNamespace):
            @property
            def latest(self) -> object:
                return message.model_copy(update={"stamp": bench.now} | self.more) if live else self.message

        return Topic(message=message, more={})

    def server(self, **how: object) -> None:
        out = SimpleNamespace(next_seq=lambda: len(self.out), put=self.out.append)
        self.tasks = TaskServer(self, SimpleNamespace(now=lambda: self.now), self.gate, 1.0, out, **how)
        self.seq = 0

    def accept(self, request: ExploreRequest) -> str:
        if self.refusal is not None:
            raise self.refusal
        return "spade"

    def begin(self, accepted: str, request: ExploreRequest, number: int) -> None:
        self.asked.append((accepted, request.source, number))
        self.newest = self.newest.model_copy(
            update={"number": number, "source": request.source, "phase": ExplorationPhase.DRIVING}
        )
        self.running = True

    def control(self, request: ExploreRequest) -> None:
        self.asked.append((request.order, request.source))
        self.newest = self.newest.model_copy(update={"phase": ExplorationPhase.IDLE})
        self.running = False

    def state(self, now: int) -> ExplorationState:
        return self.newest.model_copy(update={"stamp": now})

    def ask(self, order: str, source: str = "ann", instance: str = "one", *, own: bool = False, **more: object) -> int:
        self.seq += 1
        header = inner_request(self.seq, self.gate.latest, self.now, source) | {"instance": instance} | more
        return self.tasks.take(ExploreRequest(**header, order=ExploreOrder(order), own=own))

    def refused(self, *args: object, **more: object) -> tuple[Reason, str]:
        asked = list(self.asked)
        with pytest.raises(RequestRefusedError) as error:
            self.ask(*args, **more)
        assert self.asked == asked, "nothing has changed"
        return error.value.refusal, str(error.value)


def test_a_task_gets_a_number_and_is_stopped_by_anybody_unless_it_is_to_be_the_programs_own():
    digging = Digging()
    assert digging.ask("start") == 1
    assert digging.refused("start", "bob") == (Reason.BUSY, "the exploration of ann is running, stop it first")
    for other in (("bob", "one"), ("ann", "another")):
        assert digging.refused("stop", *other, own=True) == (Reason.NOT_FOUND, "the exploration of ann is running")
    assert digging.ask("stop", own=True) == 1
    assert digging.refused("stop") == (Reason.NOT_FOUND, "no excavation is running")
    digging.ask("start")
    assert digging.ask("stop", "bob") == 2
    assert digging.asked == [
        ("spade", "ann", 1), (ExploreOrder.STOP, "ann"), ("spade", "ann", 2), (ExploreOrder.STOP, "bob")
    ]  # fmt: skip


def test_that_the_robot_is_disarmed_is_only_said_if_nothing_else_is_in_the_way():
    digging = Digging()
    digging.gate.more = {"mode": GateMode.DISARMED, "reasons": (Reason.DISARMED,)}
    digging.refusal = RequestRefusedError(Reason.NO_MAP, "no map")
    assert digging.refused("start") == (Reason.NO_MAP, "no map")
    digging.refusal = InputError("depth: missing")
    with pytest.raises(InputError):
        digging.ask("start")
    digging.refusal = None
    assert digging.refused("start")[0] is Reason.DISARMED
    digging.server(changes=(), period=PERIOD, drives=lambda _: True)
    assert digging.ask("start") == 1, "tasks of this kind wait until it is armed"


def test_another_sources_task_excludes_it_but_not_its_stop():
    digging = Digging()
    goal = GoalState(stamp=0, received=0, seq=0, frame="map", number=3, source="bob", phase=GoalPhase.DRIVING)
    digging.goal.message = goal
    assert digging.refused("start") == (Reason.BUSY, "goal 3 of bob is pursued, stop it first")
    digging.goal.message = goal.model_copy(update={"source": "digger"})
    digging.ask("start")
    digging.goal.message = goal
    digging.ask("stop")


def test_a_new_task_replaces_the_running_one_where_its_kind_says_so():
    digging = Digging()
    digging.server(changes=(), period=PERIOD, replaces=True)
    assert [digging.ask("start"), digging.ask("start", "bob")] == [1, 2]


def test_what_a_restart_interrupted_is_given_up_but_not_by_who_stops_only_its_own():
    digging = Digging()
    digging.resumable = True
    assert digging.refused("stop", own=True)[0] is Reason.NOT_FOUND
    digging.ask("stop")
    assert digging.asked == [(ExploreOrder.STOP, "ann")]


def test_a_request_of_another_run_or_that_is_too_old_moves_nothing_and_an_old_stop_stops():
    digging = Digging()
    assert digging.refused("start", nonce="other")[0] is Reason.BAD_NONCE
    assert digging.refused("start", gate_stamp=digging.now - 2 * SECOND)[0] is Reason.LEASE_EXPIRED
    digging.ask("start")
    digging.ask("stop", gate_stamp=None)


def test_it_is_reported_at_once_when_it_changes_and_now_and_then_while_it_runs():
    digging = Digging()

    def seen(seconds: float) -> int:
        del digging.out[:]
        for _ in range(round(10 * seconds)):
            digging.now += SECOND // 10
            digging.tasks.report()
        return len(digging.out)

    assert seen(2.0) == 1, "that there is none"
    digging.ask("start")
    assert digging.out[-1].number == 1
    assert seen(2.0) == 4
    digging.ask("stop")
    assert seen(2.0) == 0, "the end was reported with the stop"


def test_who_waits_for_the_next_report_gets_it():
    async def main() -> None:
        digging = Digging()
        waiting = asyncio.create_task(digging.tasks.next_report())
        await asyncio.sleep(0)
        assert not waiting.done()
        digging.ask("start")
        await asyncio.wait_for(waiting, 1.0)

    asyncio.run(main())
