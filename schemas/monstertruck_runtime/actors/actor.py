"""Execution of a pure step: in the loop, in a worker process, or on another machine; one word changes it.

Actors keep their state from step to step. A worker is a separate process, with deadline, kill and restart.
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
    """Something that takes steps, one at a time, and keeps its state between them until one fails."""

    async def __aenter__(self) -> Self:
        """Begin."""

    async def __aexit__(self, *_: object) -> None:
        """End."""

    async def start(self) -> None:
        """Make ready for the first step."""

    async def step(self, inputs: Any) -> Any:
        """Take one step."""


class ResultDelivery(Protocol):
    """Delivery time of a worker's result on a virtual clock."""

    async def wait(self, clock: VirtualClock, due: int) -> None:
        """Return when a result that is due at ``due``, ns, may be delivered."""


class VirtualDelivery:
    """Delivers results at their instants; results due together in the order of submission."""

    def __init__(self) -> None:
        self._sequence = itertools.count()
        self._waiting: list[tuple[int, int, asyncio.Future[None]]] = []

    async def wait(self, clock: VirtualClock, due: int) -> None:
        """Wait until ``due``, ns."""
        delivered: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        heapq.heappush(self._waiting, (due, next(self._sequence), delivered))
        self._set_timer(clock, due)
        await delivered

    def _set_timer(self, clock: VirtualClock, due: int) -> None:
        left = max(0, due - clock.now()) / SECOND
        asyncio.get_running_loop().call_later(left, self._deliver, clock, due)

    def _deliver(self, clock: VirtualClock, due: int) -> None:
        now = clock.now()
        if now < due:  # timers count in float seconds
            self._set_timer(clock, due)
            return
        while self._waiting and self._waiting[0][0] <= now:
            delivered = heapq.heappop(self._waiting)[2]
            if not delivered.done():
                delivered.set_result(None)


_deliveries: "weakref.WeakKeyDictionary[VirtualClock, ResultDelivery]" = weakref.WeakKeyDictionary()


def delivery_of(clock: VirtualClock) -> ResultDelivery:
    """The one delivery that all workers of a clock share."""
    return _deliveries.setdefault(clock, VirtualDelivery())


def use_delivery(clock: VirtualClock, delivery: ResultDelivery) -> None:
    """Let ``delivery`` decide when the results of all workers of ``clock`` count."""
    _deliveries[clock] = delivery


def _factor(computer: SlowComputer | None) -> float:
    return 1.0 if computer is None else computer.factor


class LoopActor:
    """The step in the caller's own loop, which is blocked meanwhile.

    On the virtual clock the result is delivered when a worker's would be.

    Args:
        target: ``module:factory``, as for ``WorkerActor``.
        clock: time.
        latency: declared seconds of a step; virtual clock only.
    """

    def __init__(self, target: str, clock: Clock, latency: float) -> None:
        self._target = target
        self._clock = clock
        self._latency = latency
        self._step: Any = None

    async def start(self) -> None:
        """Build the object that takes the steps."""
        if self._step is None:
            module, _, factory = self._target.partition(":")
            self._step = getattr(importlib.import_module(module), factory)()

    async def step(self, inputs: Any) -> Any:
        """Take one step; if it raises, the next one finds a fresh state."""
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
    """One worker process and the steps it is asked to take; an async context manager that ends it.

    Steps are taken one at a time, in the order of their calls. A worker that fails, hangs, dies or whose step is
    cancelled is killed; the next step starts a fresh one, without the state of the old.

    On the wall clock a result is delivered as soon as it is there. On the virtual clock it is delivered exactly
    ``latency`` after submission: the loop stops the real time at that instant until the process is done, and results
    due together come in the order of submission, so that runs are reproducible. On a ``SlowComputer`` both the latency
    and the processor time that the step has really used are longer by its factor, and the longer one counts.

    Args:
        name: for error texts, and ``ActorFactory.worker_pids``.
        target: ``module:factory``; the factory's object has ``step(inputs) -> outputs``, both picklable.
        clock: time.
        latency: declared seconds of a step on the reference computer.
        deadline: time limit of a step, s.
        start_timeout: real seconds a start may take.
        answer_timeout: maximum real seconds without an answer, or more of it; on the virtual clock from the result's
            instant on. Default: ``start_timeout``.
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
        """Waits for the process: for a minute, maybe, which must not take a place from other blocking work."""
        self._built = False
        """The process has reported that it can take steps."""
        self._lock = asyncio.Lock()

    @property
    def pid(self) -> int | None:
        """Process number of the running worker; None before its start and after its end."""
        return None if self._process is None else self._process.pid

    async def start(self) -> None:
        """Start the process if it does not run; a step does so itself, this only saves it the wait.

        On the virtual clock it returns at once: the first step waits for the process and raises what went wrong.

        Raises:
            WorkerError: the factory failed (wall clock).
            WorkerTimeoutError: it took longer than ``start_timeout`` (wall clock).
        """
        async with self._lock:
            if not self._virtual:
                await self._started()
            elif self._process is None:
                self._spawn()

    async def step(self, inputs: Any) -> Any:
        """Take one step.

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
        """End the process. Closing twice is harmless; a step under way fails with ``WorkerError``."""
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
        """Wait; on the virtual clock no virtual time passes meanwhile, on the wall clock the loop continues."""
        return function() if self._virtual else await in_thread(function)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()


class ActorFactory:
    """Makes the actors of one daemon.

    Args:
        clock: time.
        remote: where other machines call for work.
    """

    def __init__(self, clock: Clock, remote: RemoteWorkQueue) -> None:
        self._clock = clock
        self._remote = remote
        self._workers: list[WorkerActor] = []

    def worker_pids(self) -> dict[str, int]:
        """Process numbers of the workers that run, by name."""
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
        """An actor; arguments as for ``WorkerActor``; a placement ignores arguments that it does not use."""
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
