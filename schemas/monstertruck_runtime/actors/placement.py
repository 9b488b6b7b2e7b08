"""Where a pure step runs: in the loop, in a worker process, or on another machine; one word changes it."""

import importlib
from types import TracebackType
from typing import Any, Literal, Protocol, Self

from monstertruck_runtime.actors.actor import WorkerActor
from monstertruck_runtime.actors.agenda import agenda_of
from monstertruck_runtime.actors.remote import RemoteDesk
from monstertruck_runtime.clock import SECOND, Clock, VirtualClock

Placement = Literal["loop", "worker", "remote"]


class Actor(Protocol):
    """Something that takes steps, one at a time, and keeps its state between them until one fails."""

    async def __aenter__(self) -> Self:
        """Begin."""
        ...

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End."""
        ...

    async def start(self) -> None:
        """Make ready for the first step."""
        ...

    async def step(self, inputs: Any) -> Any:
        """Take one step."""
        ...


class LoopActor:
    """The step in the caller's own loop, which stands still meanwhile.

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
        """Build what takes the steps."""
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
            await agenda_of(self._clock).wait(self._clock, submitted + round(self._latency * SECOND))
        return outputs

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._step = None


class Places:
    """Makes the actors of one daemon.

    Args:
        clock: time.
        desk: where other machines call for work.
    """

    def __init__(self, clock: Clock, desk: RemoteDesk) -> None:
        self._clock = clock
        self._desk = desk

    def actor(
        self, placement: Placement, name: str, target: str, *, latency: float, deadline: float, patience: float = 30.0
    ) -> Actor:
        """An actor; arguments as of ``WorkerActor``, those of no use to a placement are left out."""
        match placement:
            case "loop":
                return LoopActor(target, self._clock, latency)
            case "worker":
                return WorkerActor(name, target, self._clock, latency=latency, deadline=deadline, patience=patience)
            case "remote":
                return self._desk.actor(name, self._clock, deadline=deadline, patience=patience)
