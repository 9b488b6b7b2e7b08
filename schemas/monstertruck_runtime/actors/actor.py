"""Stateful workers: a process each, driven step by step, with deadline, kill and restart."""

import asyncio
from collections.abc import Callable
from types import TracebackType
from typing import Any, Self, TypeVar

from monstertruck_runtime.actors.agenda import agenda_of
from monstertruck_runtime.actors.process import WorkerProcess
from monstertruck_runtime.clock import SECOND, Clock, VirtualClock
from monstertruck_runtime.errors import WorkerTimeoutError
from monstertruck_runtime.threads import in_thread

T = TypeVar("T")


class WorkerActor:
    """One worker process and the steps it is asked to take; an async context manager that ends it.

    Steps are taken one at a time, in the order of their calls. A worker that fails, hangs, dies or whose step is
    cancelled is killed; the next step starts a fresh one, without the state of the old.

    On the wall clock a result is delivered as soon as it is there. On the virtual clock it is delivered exactly
    ``latency * cpu_factor`` after submission: the loop stops the real time at that instant until the process is
    done, and results due together come in the order of submission, so that runs are reproducible.

    Args:
        name: for error texts.
        target: ``module:factory``; what the factory returns has ``step(inputs) -> outputs``, both picklable.
        clock: time.
        latency: declared seconds of a step on the reference computer.
        deadline: seconds after which a step is given up.
        cpu_factor: how much slower than the reference the studied computer is; virtual clock only.
        patience: real seconds a start may take and, on the virtual clock, a result may be late.
    """

    def __init__(
        self,
        name: str,
        target: str,
        clock: Clock,
        *,
        latency: float,
        deadline: float,
        cpu_factor: float = 1.0,
        patience: float = 30.0,
    ) -> None:
        self._name = name
        self._target = target
        self._clock = clock
        self._latency = latency * cpu_factor
        self._deadline = deadline
        self._patience = patience
        self._virtual = isinstance(clock, VirtualClock)
        self._process: WorkerProcess | None = None
        self._built = False
        """The process has told that it can take steps."""
        self._turn = asyncio.Lock()

    @property
    def pid(self) -> int | None:
        """Process number of the running worker; None before its start and after its end."""
        return None if self._process is None else self._process.pid

    async def start(self) -> None:
        """Start the process if it does not run; a step does so itself, this only saves it the wait.

        On the virtual clock nobody waits: the process starts beside the run, and the first step raises what went wrong.

        Raises:
            WorkerError: the factory failed (wall clock).
            WorkerTimeoutError: it took longer than ``patience`` (wall clock).
        """
        async with self._turn:
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
        async with self._turn:
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
                process.receive(self._patience)
            else:
                async with self._clock.deadline(self._patience):
                    await asyncio.to_thread(process.receive)
        except TimeoutError:
            msg = f"worker {self._name} did not start within {self._patience} s"
            raise WorkerTimeoutError(msg) from None
        self._built = True

    async def _step_really(self, process: WorkerProcess, inputs: Any) -> Any:
        try:
            async with self._clock.deadline(self._deadline):
                return await asyncio.to_thread(process.exchange, inputs)
        except TimeoutError:
            raise self._late() from None

    async def _step_virtually(self, process: WorkerProcess, inputs: Any) -> Any:
        submitted = self._clock.now()
        try:
            process.send(inputs, self._patience)
            if self._latency <= self._deadline:
                assert isinstance(self._clock, VirtualClock)
                await agenda_of(self._clock).wait(self._clock, submitted + round(self._latency * SECOND))
                return process.receive(self._patience)
        except TimeoutError:
            pass
        await self._clock.sleep_until(submitted + round(self._deadline * SECOND))
        raise self._late()

    def _late(self) -> WorkerTimeoutError:
        return WorkerTimeoutError(f"worker {self._name} missed its deadline of {self._deadline} s and was killed")

    def _spawn(self) -> WorkerProcess:
        self._process, self._built = WorkerProcess(self._name, self._target), False
        return self._process

    async def _discard(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            await self._blocking(process.kill)

    async def _blocking(self, function: Callable[[], T]) -> T:
        """On the virtual clock no virtual time passes meanwhile, on the wall clock the loop goes on."""
        return function() if self._virtual else await in_thread(function)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()
