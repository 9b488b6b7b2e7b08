"""Steps taken on another machine: it calls the robot for work and brings the outputs back.

So the robot listens as always, and whoever may call it may compute for it (``monstertruckd plan-server``). What travels
is JSON of listed classes, see ``codec``; nothing that comes in is executed.
"""

import asyncio
import json
from types import TracebackType
from typing import Any, Final, Self

from monstertruck_runtime.actors.codec import StepCodec
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import InputError, NotFoundError, WorkerError, WorkerTimeoutError

RPC: Final = "remote_step"
POLL: Final = 2.0
"""Seconds a caller waits for work."""
PART: Final = 8192
"""Characters of outputs in one call."""
MOST: Final = 1_000_000
"""Characters of outputs at all."""


class RemoteActor:
    """One kind of steps, taken by whoever calls for them; the newest caller is the one that counts.

    Args:
        name: of the steps, for the caller.
        codec: of their inputs and outputs.
        clock: time.
        deadline: seconds for a step.
        patience: seconds to wait for a caller.
    """

    def __init__(self, name: str, codec: StepCodec, clock: Clock, *, deadline: float, patience: float) -> None:
        self._name, self._codec, self._clock = name, codec, clock
        self._deadline, self._patience = deadline, patience
        self._server: str | None = None
        self._changed = False
        self._number = 0
        self._task: Any = None
        self._result: asyncio.Future[Any] | None = None
        self._parts: list[str] = []
        self._news = asyncio.Event()
        self._turn = asyncio.Lock()

    async def start(self) -> None:
        """Wait for the first call.

        Raises:
            WorkerTimeoutError: none came in time.
        """
        try:
            async with self._clock.deadline(self._patience):
                while self._server is None:
                    await self._wait()
        except TimeoutError:
            raise WorkerTimeoutError(f"{self._name}: no plan-server called for {self._patience:g} s") from None
        self._changed = False

    async def step(self, inputs: Any) -> Any:
        """Take one step there.

        Raises:
            WorkerTimeoutError: no outputs in time.
            WorkerError: the step failed, or another server took over, which knows nothing yet.
        """
        async with self._turn:
            if self._changed:
                self._changed = False
                raise WorkerError(f"{self._name}: another plan-server took over")
            self._number += 1
            self._task = self._codec.to_json(inputs)
            result = self._result = asyncio.get_running_loop().create_future()
            self._tell()
            try:
                async with self._clock.deadline(self._deadline):
                    return await result
            except TimeoutError:
                raise WorkerTimeoutError(f"{self._name}: no outputs within {self._deadline:g} s") from None
            finally:
                self._task = self._result = None

    async def serve(self, payload: dict[str, Any]) -> dict[str, Any]:
        """One call: takes outputs, answers with the next inputs once there are some.

        Raises:
            InputError: the call makes no sense.
        """
        server = payload.get("server")
        if not isinstance(server, str) or not 0 < len(server) <= 64:
            raise InputError("server: expected a name")
        if server != self._server:
            self._take_over(server)
        if "part" in payload and not self._take(payload):
            return {}
        handed = int(payload.get("after", 0))
        try:
            async with self._clock.deadline(POLL):
                while self._task is None or self._number <= handed:
                    await self._wait()
                    if server != self._server:
                        return {}
        except TimeoutError:
            return {}
        return {"number": self._number, "inputs": self._task}

    def _take_over(self, server: str) -> None:
        self._changed = self._server is not None
        self._server, self._parts = server, []
        if self._changed and self._result is not None and not self._result.done():
            self._changed = False
            self._result.set_exception(WorkerError(f"{self._name}: another plan-server took over"))
        self._tell()

    def _take(self, payload: dict[str, Any]) -> bool:
        """Whether these outputs are complete."""
        self._parts.append(str(payload["part"]))
        if sum(map(len, self._parts)) > MOST:
            self._parts = []
            raise InputError(f"outputs: more than {MOST} characters")
        if not payload.get("last"):
            return False
        text, self._parts = "".join(self._parts), []
        result = self._result
        if result is None or result.done() or payload.get("number") != self._number:
            return True
        if payload.get("failed"):
            result.set_exception(WorkerError(f"{self._name}: {text}"))
            return True
        try:
            result.set_result(self._codec.from_json(json.loads(text)))
        except (ValueError, InputError) as error:
            result.set_exception(WorkerError(f"{self._name}: {error}"))
        return True

    def _tell(self) -> None:
        news, self._news = self._news, asyncio.Event()
        news.set()

    async def _wait(self) -> None:
        await self._news.wait()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._task = None


class RemoteDesk:
    """The remote actors of a daemon by name.

    Args:
        codec: of all steps' inputs and outputs.
    """

    def __init__(self, codec: StepCodec) -> None:
        self._codec = codec
        self._actors: dict[str, RemoteActor] = {}

    def actor(self, name: str, clock: Clock, *, deadline: float, patience: float) -> RemoteActor:
        """A new one."""
        self._actors[name] = RemoteActor(name, self._codec, clock, deadline=deadline, patience=patience)
        return self._actors[name]

    async def serve(self, payload: dict[str, Any]) -> dict[str, Any]:
        """One call of a server.

        Raises:
            NotFoundError: no such steps are placed elsewhere.
            InputError: the call makes no sense.
        """
        actor = self._actors.get(str(payload.get("actor")))
        if actor is None:
            raise NotFoundError(f"{payload.get('actor')!r} is not placed on another machine")
        return await actor.serve(payload)
