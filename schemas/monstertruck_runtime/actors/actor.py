"""Runs a pure step in the event loop, in a worker process, or on another machine, as configured.

Actors keep their state from step to step. A worker is a separate process with a deadline; it is killed and restarted on
failure.
"""

import asyncio
import heapq
import importlib
import itertools
import weakref
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, Literal, Protocol, Self, TypeVar

from monstertruck_runtime.actors.process import WorkerProcess
from monstertruck_runtime.actors.remote import RemoteWorkQueue
from monstertruck_runtime.clock import SECOND, Clock, VirtualClock
from monstertruck_runtime.errors import WorkerTimeoutError
from monstertruck_runtime.slowness import SlowComputer, slow_computer
from monstertruck_runtime.threads import in_thread

T = TypeVar("T")

Placement = Literal["loop", "worker", "remote"]


class Actor(Protocol):
    """Executes steps one at a time, and keeps its state between them until a step fails."""

    async def __aenter__(self) -> Self:
        """Start the actor."""

    async def __aexit__(self, *_: object) -> None:
        """End the actor."""

    async def start(self) -> None:
        """Prepare for the first step."""

    async def step(self, inputs: Any) -> Any:
        """Execute one step."""


class ResultDelivery(Protocol):
    """Decides when a worker's result is delivered on a virtual clock."""

    async def wait(self, clock: VirtualClock, due: int) -> None:
        """Return when a result due at ``due`` (ns) may be delivered."""


class VirtualDelivery:
    """Delivers results when they are due; results due together in the order of submission."""

    def __init__(self) -> None:
        self._sequence = itertools.count()
        self._waiting: list[tuple[int, int, asyncio.Future[None]]] = []

    async def wait(self, clock: VirtualClock, due: int) -> None:
        """Wait until ``due`` (ns)."""
        delivered: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        heapq.heappush(self._waiting, (due, next(self._sequence), delivered))
        self._set_timer(clock, due)
        await delivered

    def _set_timer(self, clock: VirtualClock, due: int) -> None:
        left = max(0, due - clock.now()) / SECOND
        asyncio.get_running_loop().call_later(left, self._deliver, clock, due)

    def _deliver(self, clock: VirtualClock, due: int) -> None:
        now = clock.now()
        if now < due:  # timers use float seconds
            self._set_timer(clock, due)
            return
        while self._waiting and self._waiting[0][0] <= now:
            delivered = heapq.heappop(self._waiting)[2]
            if not delivered.done():
                delivered.set_result(None)


_deliveries: "weakref.WeakKeyDictionary[VirtualClock, ResultDelivery]" = weakref.WeakKeyDictionary()


def delivery_of(clock: VirtualClock) -> ResultDelivery:
    """Return the delivery shared by all workers of a clock."""
    return _deliveries.setdefault(clock, VirtualDelivery())


def use_delivery(clock: VirtualClock, delivery: ResultDelivery) -> None:
    """Let ``delivery`` decide when the results of all workers of ``clock`` are delivered."""
    _deliveries[clock] = delivery


def _factor(computer: SlowComputer | None) -> float:
    return 1.0 if computer is None else computer.factor


class LoopActor:
    """Runs the step in the caller's event loop, which is blocked meanwhile.

    On the virtual clock the result is delivered at the same time as a worker's.

    Args:
        target: ``module:factory``, as for ``WorkerActor``.
        clock: source of time.
        latency: declared duration of a step, s; virtual clock only.
    """

    def __init__(self, target: str, clock: Clock, latency: float) -> None:
        self._target = target
        self._clock = clock
        self._latency = latency
        self._step: Any = None

    async def start(self) -> None:
        """Build the object that executes the steps."""
        if self._step is None:
            module, _, factory = self._target.partition(":")
            self._step = getattr(importlib.import_module(module), factory)()

    async def step(self, inputs: Any) -> Any:
        """Execute one step; after an exception the next step starts with a fresh state."""
        await self.start()
        submitted = self._clock.now()
        try:
            outputs = self._step.step(inputs)
        except BaseException:
            self._step = None
            raise
        if isinstance(self._clock, VirtualClock):
            latency = self._latency * _factor(slow_computer(self._clock))
            await delivery_of(self._clock).wait(self._clock, submitted + round(latency * SECOND))
        return outputs

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        self._step = None


class WorkerActor:
    """One worker process and its steps; an async context manager that ends the process.

    Steps are executed one at a time, in the order of their calls. A worker that fails, hangs or dies, or whose step is
    cancelled, is killed; the next step starts a new worker with a fresh state.

    On the wall clock a result is delivered as soon as it is available. On the virtual clock it is delivered exactly
    ``latency`` after submission: the loop waits in real time at that instant until the process is done. Results due
    together are delivered in the order of submission, so runs are reproducible. On a ``SlowComputer`` the latency and
    the measured processor time of the step are multiplied by its factor, and the longer of the two is used.

    Args:
        name: for error texts, and ``ActorFactory.worker_pids``.
        target: ``module:factory``; the factory's object has ``step(inputs) -> outputs``, both picklable.
        clock: source of time.
        latency: declared duration of a step on the reference computer, s.
        deadline: time limit of a step, s.
        start_timeout: maximum real time of a start, s.
        answer_timeout: maximum real time without an answer or a further part of it, s; on the virtual clock measured
            from the time when the result is due. Default: ``start_timeout``.
    """

    def __init__(
        self,
        name: str,
        target: str,
        clock: Clock,
        *,
        latency: float,
        deadline: float,
        start_timeout: float = 30.0,
        answer_timeout: float | None = None,
    ) -> None:
        self.name = name
        self._target = target
        self._clock = clock
        self._latency = latency
        self._deadline = deadline
        self._start_timeout = start_timeout
        self._answer_timeout = start_timeout if answer_timeout is None else answer_timeout
        self._virtual = isinstance(clock, VirtualClock)
        self._process: WorkerProcess | None = None
        self._thread: ThreadPoolExecutor | None = None
        """Threads that wait for the process, perhaps for a minute, without blocking other work."""
        self._built = False
        """Whether the process has reported that it is ready for steps."""
        self._lock = asyncio.Lock()

    @property
    def pid(self) -> int | None:
        """Process id of the running worker; None before its start and after its end."""
        return None if self._process is None else self._process.pid

    async def start(self) -> None:
        """Start the process if it is not running. A step does so itself; this avoids the wait.

        On the virtual clock it returns at once: the first step waits for the process and raises its error.

        Raises:
            WorkerError: the factory failed (wall clock).
            WorkerTimeoutError: the start exceeded ``start_timeout`` (wall clock).
        """
        async with self._lock:
            if not self._virtual:
                await self._started()
            elif self._process is None:
                self._spawn()

    async def step(self, inputs: Any) -> Any:
        """Execute one step.

        Raises:
            WorkerTimeoutError: the deadline passed; the worker was killed.
            WorkerError: the worker raised or died.
        """
        async with self._lock:
            process = await self._started()
            try:
                return await (self._step_virtually if self._virtual else self._step_really)(process, inputs)
            except BaseException:
                await self._discard()
                raise

    async def close(self) -> None:
        """End the process. Repeated calls have no effect; a step in progress fails with ``WorkerError``."""
        await self._discard()

    async def _started(self) -> WorkerProcess:
        process = self._process
        if process is not None and self._built:
            return process
        try:
            if process is None:
                process = await self._blocking(self._spawn)
            await self._build(process)
        except BaseException:
            await self._discard()
            raise
        return process

    async def _build(self, process: WorkerProcess) -> None:
        try:
            if self._virtual:
                process.receive(self._start_timeout)
            else:
                async with self._clock.deadline(self._start_timeout):
                    await self._wait(process.receive)
        except TimeoutError:
            await self._blocking(process.kill_hung_server)
            raise WorkerTimeoutError(f"worker {self.name} did not start within {self._start_timeout} s") from None
        self._built = True

    async def _step_really(self, process: WorkerProcess, inputs: Any) -> Any:
        try:
            async with self._clock.deadline(self._deadline):
                return await self._wait(partial(process.exchange, inputs))
        except TimeoutError:
            raise self._late() from None

    async def _step_virtually(self, process: WorkerProcess, inputs: Any) -> Any:
        submitted, computer = self._clock.now(), slow_computer(self._clock)
        latency = self._latency * _factor(computer)
        try:
            process.send(inputs)
            if latency <= self._deadline:
                assert isinstance(self._clock, VirtualClock)
                await delivery_of(self._clock).wait(self._clock, submitted + round(latency * SECOND))
                outputs = process.receive(self._answer_timeout)
                if computer is None:
                    return outputs
                computer.note(f"worker {self.name}", process.used)
                used = process.used * computer.factor
                if used <= self._deadline:
                    if used > latency:
                        await delivery_of(self._clock).wait(self._clock, submitted + round(used * SECOND))
                    return outputs
        except TimeoutError:
            pass
        await self._clock.sleep_until(submitted + round(self._deadline * SECOND))
        raise self._late()

    def _late(self) -> WorkerTimeoutError:
        return WorkerTimeoutError(f"worker {self.name} missed its deadline of {self._deadline} s and was killed")

    def _spawn(self) -> WorkerProcess:
        self._process, self._built = WorkerProcess(self.name, self._target, self._answer_timeout), False
        self._thread = ThreadPoolExecutor(1, f"worker {self.name}")
        return self._process

    async def _discard(self) -> None:
        process, self._process = self._process, None
        if self._thread is not None:
            self._thread.shutdown(wait=False)  # it ends with the process
        if process is not None:
            await self._blocking(process.kill)

    async def _wait(self, function: Callable[[], T]) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._thread, function)

    async def _blocking(self, function: Callable[[], T]) -> T:
        """Wait for a call in a thread.

        On the virtual clock no virtual time passes, on the wall clock the loop continues.
        """
        return function() if self._virtual else await in_thread(function)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()


class ActorFactory:
    """Creates the actors of one daemon.

    Args:
        clock: source of time.
        remote: remote actors, for steps placed on other machines.
    """

    def __init__(self, clock: Clock, remote: RemoteWorkQueue) -> None:
        self._clock = clock
        self._remote = remote
        self._workers: list[WorkerActor] = []

    def worker_pids(self) -> dict[str, int]:
        """Process ids of the running workers, by name."""
        return {worker.name: worker.pid for worker in self._workers if worker.pid is not None}

    def actor(
        self,
        placement: Placement,
        name: str,
        target: str,
        *,
        latency: float,
        deadline: float,
        start_timeout: float = 30.0,
    ) -> Actor:
        """Create an actor; arguments as for ``WorkerActor``; a placement ignores arguments that it does not use."""
        match placement:
            case "loop":
                return LoopActor(target, self._clock, latency)
            case "worker":
                worker = WorkerActor(
                    name, target, self._clock, latency=latency, deadline=deadline, start_timeout=start_timeout
                )
                self._workers.append(worker)
                return worker
            case "remote":
                return self._remote.actor(name, self._clock, deadline=deadline, start_timeout=start_timeout)
