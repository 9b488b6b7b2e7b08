"""Tasks: requested activities that end, one of each kind at a time.

A goal, an exploration, a mission and a behaviour (including a move) are tasks. Every service that executes one kind is
a `Task`; its `TaskServer` handles the common part of all tasks:

1. The server checks every request: permission of the sender, age, and sequence number.
2. A task starts only if nothing else drives the robot, the service accepts the request (`accept`), and the robot is
   armed. The armed state is checked last, so that a client arms the robot only if nothing else prevents the start.
3. The task gets the next number, and the server calls `begin`. The service then reports through `state`, which the
   server publishes at every important change, and otherwise periodically.
4. Pause, resume and stop go to `control`; a program may restrict them to its own task.

Each service observes the gate's state and ends its task on an emergency stop. If the service stores its progress, a
task that a restart interrupted is `resumable`.
"""

import asyncio
from collections import defaultdict
from collections.abc import Awaitable, Callable, Collection
from operator import attrgetter
from typing import Final, Generic, Protocol, TypeVar

from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import RequestRefusedError
from monstertruck_runtime.ports import Publisher, RpcRegistry, Subscription
from monstertruck_runtime.requests import Sequences, does_not_drive, examine, register_numbered
from monstertruck_schemas.plan import (
    BehaviourState,
    ExplorationState,
    GoalState,
    MissionState,
    TaskState,
)
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import (
    BehaviourRequest,
    ExploreRequest,
    GoalControl,
    GoalRequest,
    MissionRequest,
    Verb,
)
from monstertruck_schemas.state import GateMode, GateState

R = TypeVar("R", GoalRequest | GoalControl, BehaviourRequest, ExploreRequest, MissionRequest)
S = TypeVar("S", GoalState, BehaviourState, ExplorationState, MissionState)
P = TypeVar("P")
R_contra = TypeVar("R_contra", contravariant=True)
S_co = TypeVar("S_co", covariant=True)

Rival = Subscription[GoalState] | Subscription[BehaviourState] | Subscription[ExplorationState]
NOBODY: Final[frozenset[str]] = frozenset()


class Task(Protocol[R_contra, P, S_co]):
    """One kind of task: the interface of its service to the task server."""

    noun: str
    """Name of a task in messages, such as "exploration"."""

    @property
    def running(self) -> bool:
        """Whether a task runs."""

    @property
    def resumable(self) -> bool:
        """Whether a restart of the daemon interrupted a task that can be resumed or abandoned."""

    def accept(self, request: R_contra) -> P:
        """Check a request to start a task; a refused request changes nothing.

        Raises:
            TruckError: the task is impossible, now or at any time.
        """

    def begin(self, accepted: P, request: R_contra, number: int) -> None:
        """Start the accepted task."""

    def control(self, request: R_contra) -> None:
        """Pause, resume or stop the running task, or abandon the one that can be resumed.

        Raises:
            RequestRefusedError: the state of the task does not allow this.
        """

    def state(self, now: int) -> S_co:
        """Return the report at ``now``, ns, with sequence number 0."""


class TaskServer(Generic[R, P, S]):
    """Starts, stops and reports the tasks of one kind.

    Args:
        task: service that executes the tasks.
        clock: time.
        gate: latest state of the gate.
        max_age: see ``GateConfig.max_request_age``.
        out: publisher of the reports.
        changes: fields of the report whose change is published at once.
        period: period of the reports of a running task without a change, ns.
        others: reports on tasks that exclude these.
        own: sources whose tasks do not exclude these.
        replaces: a new task replaces the running one instead of being refused.
        drives: modes of the gate that permit a start.
    """

    def __init__(
        self,
        task: Task[R, P, S],
        clock: Clock,
        gate: Subscription[GateState],
        max_age: float,
        out: Publisher[S],
        *,
        changes: tuple[str, ...],
        period: int,
        others: tuple[Rival, ...] = (),
        own: Collection[str] = NOBODY,
        replaces: bool = False,
        drives: Callable[[GateMode], bool] = attrgetter("active"),
    ) -> None:
        self._task: Task[R, P, S] = task
        self._out: Publisher[S] = out
        self._clock, self._gate, self._max_age = clock, gate, max_age
        self._changes, self._period, self._others, self._own = changes, period, others, own
        self._replaces, self._drives = replaces, drives
        self.noun = task.noun
        self._sequences: defaultdict[type, Sequences] = defaultdict(lambda: Sequences(max_age))
        self._program: tuple[str, str | None] | None = None
        self._changed = asyncio.Event()
        self.number = 0
        """Number of the latest task."""
        self.reported: S | None = None
        """Latest report."""

    def take(self, request: R) -> int:
        """Execute a request; return the number of the task that it starts or refers to.

        Raises:
            RequestRefusedError: the sender lacks permission, or the request is impossible now.
            TruckError: the service does not accept it.
        """
        gate, verb = self._gate.latest, request.verb
        limit = self._max_age if verb.moves else None
        examine(request, gate, self._sequences[type(request)], self._clock.now(), limit)
        if verb.moves:
            self._require_free(verb)
        if verb is Verb.START:
            self._start(request, gate)
        else:
            self._require_present(request)
            self._task.control(request)
        self.report()
        return self.number

    def other(self) -> str | None:
        """Describe the activity that another source has started; None without one."""
        states: list[TaskState | None] = [topic.latest for topic in self._others]
        running = (state for state in states if state is not None and state.running and state.source not in self._own)
        return next((state.activity for state in running), None)

    def report(self) -> None:
        """Publish the state if it has changed or a report is due."""
        now, before = self._clock.now(), self.reported
        state = self._task.state(now)
        same = before is not None and all(getattr(before, name) == getattr(state, name) for name in self._changes)
        if before is not None and same and (not state.running or now - before.stamp < self._period):
            return
        self.reported = state.model_copy(update={"seq": self._out.next_seq()})
        self._out.put(self.reported)
        changed, self._changed = self._changed, asyncio.Event()
        changed.set()

    async def next_report(self) -> None:
        """Wait until something is reported."""
        await self._changed.wait()

    def register(
        self, rpc: RpcRegistry, call: str, model: type[R], kept: Callable[[], Awaitable[object]] | None = None
    ) -> None:
        """Serve the remote ``call``; see ``register_numbered``."""
        register_numbered(rpc, call, model, self.take, kept)

    def _start(self, request: R, gate: GateState | None) -> None:
        accepted = self._task.accept(request)
        if gate is None or not self._drives(gate.mode):
            raise does_not_drive(gate)
        self.number, self._program = self.number + 1, request.program
        self._task.begin(accepted, request, self.number)

    def _require_free(self, verb: Verb) -> None:
        activity = self.other()
        if activity is None and verb is Verb.START and self._task.running and not self._replaces:
            activity = self._task.state(self._clock.now()).activity
        if activity is not None:
            raise RequestRefusedError(Reason.BUSY, f"{activity}, stop it first")

    def _require_present(self, request: R) -> None:
        """Require a task that the request can refer to, of the same program if the request demands this."""
        if not self._task.running and (request.own or not self._task.resumable):
            raise RequestRefusedError(Reason.NOT_FOUND, f"no {self._task.noun} is running")
        if request.own and request.program != self._program:
            raise RequestRefusedError(Reason.NOT_FOUND, self._task.state(self._clock.now()).activity)
