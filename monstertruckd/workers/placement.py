"""Where a pure step runs: in the loop, or in a worker process. One word of the configuration changes it."""

import importlib
from types import TracebackType
from typing import Any, Literal, Protocol, Self

from monstertruck_runtime.clock import SECOND, Clock, VirtualClock
from monstertruckd.workers.actor import WorkerActor
from monstertruckd.workers.agenda import agenda_of


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


def make_actor(
    placement: Literal["loop", "worker"], name: str, target: str, clock: Clock, *, latency: float, deadline: float,
    patience: float = 30.0,
) -> Actor:  # fmt: skip
    """The actor of a placement; arguments as of ``WorkerActor``."""
    if placement == "loop":
        return LoopActor(target, clock, latency)
    return WorkerActor(name, target, clock, latency=latency, deadline=deadline, patience=patience)
