"""Steps on another machine, which requests work from the robot and returns the outputs.

The robot listens as usual, and any permitted client may compute for it (``monstertruckd plan-server``). Messages are
JSON of known classes, see ``StepCodec``; received content is never executed.
"""

import asyncio
import base64
import dataclasses
import importlib
import json
import logging
from collections.abc import Callable, Mapping
from contextlib import AbstractAsyncContextManager
from enum import Enum
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Final, Self, get_type_hints

import numpy as np

from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import InputError, NotFoundError, TruckError, WorkerError, WorkerTimeoutError
from monstertruck_runtime.plugins import classes_in
from monstertruck_runtime.requests import Operator
from monstertruck_runtime.threads import in_thread
from monstertruck_schemas.base import Schema

log = logging.getLogger(__name__)

RPC: Final = "remote_step"
POLL: Final = 2.0
"""Seconds that a caller waits for work."""
PART: Final = 8192
"""Maximum number of characters of outputs in one call."""
REMOTE_RETRY: Final = 1.0
"""Seconds between two attempts to reach a robot."""
_DTYPES: Final = ("float64", "int8", "uint8", "int64")


class StepCodec:
    """Converts trees of known classes, arrays, tuples, lists, dicts with text keys, paths and scalars to JSON and back.

    Args:
        roots: dataclasses and ``Schema`` models that may be sent. These and all dataclasses, models and enums in their
            fields, including the settings of plug-ins, are known.
    """

    def __init__(self, *roots: type[Any]) -> None:
        self._roots = roots

    @cached_property
    def _classes(self) -> dict[str, type[Any]]:
        found: dict[str, type[Any]] = {}
        waiting = list(self._roots)
        while waiting:
            cls = waiting.pop()
            if found.setdefault(_name(cls), cls) is cls and not issubclass(cls, Enum):
                held = {inner for field in _annotations(cls) for inner in classes_in(field) if _travels(inner)}
                waiting += held - set(found.values())
        return found

    def to_json(self, value: Any) -> Any:
        """Convert a value to JSON-compatible data.

        Raises:
            InputError: the class is unknown.
        """
        match value:
            case Enum() if self._knows(value):
                return {"enum": _name(type(value)), "value": value.value}
            case None | bool() | int() | float() | str():
                return value
            case np.ndarray() if str(value.dtype) in _DTYPES:
                data = base64.b64encode(np.ascontiguousarray(value).tobytes()).decode()
                return {"array": str(value.dtype), "shape": list(value.shape), "data": data}
            case Path():
                return {"path": str(value)}
            case tuple():
                return {"tuple": [self.to_json(inner) for inner in value]}
            case list():
                return [self.to_json(inner) for inner in value]
            case dict():
                return {"dict": [[key, self.to_json(inner)] for key, inner in value.items()]}
        if not self._knows(value):
            raise InputError(f"step: a {type(value).__name__} cannot be sent to another machine")
        names = type(value).model_fields if isinstance(value, Schema) else [f.name for f in dataclasses.fields(value)]
        return {
            "class": _name(type(value)),
            "fields": {field: self.to_json(getattr(value, field)) for field in names},
        }

    def from_json(self, value: Any) -> Any:
        """Convert JSON-compatible data back.

        Raises:
            InputError: the data is not a result of ``to_json``.
        """
        try:
            return self._back(value)
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"step: cannot be decoded: {type(error).__name__}: {error}") from error

    def _knows(self, value: Any) -> bool:
        return self._classes.get(_name(type(value))) is type(value)

    def _back(self, value: Any) -> Any:
        match value:
            case {"enum": name, "value": inner}:
                return self._named(name, Enum)(inner)
            case {"array": dtype, "shape": shape, "data": data} if dtype in _DTYPES:
                return np.frombuffer(base64.b64decode(data, validate=True), dtype).reshape(shape)
            case {"path": text}:
                return Path(text)
            case {"tuple": inner}:
                return tuple(map(self._back, inner))
            case {"dict": rows}:
                return {key: self._back(inner) for key, inner in rows}
            case {"class": name, "fields": fields}:
                return self._named(name, object)(**{field: self._back(inner) for field, inner in fields.items()})
            case list():
                return [self._back(inner) for inner in value]
            case None | bool() | int() | float() | str():
                return value
        raise ValueError(f"unknown object {str(value)[:64]}")

    def _named(self, name: str, base: type[Any]) -> type[Any]:
        found = self._classes[name]
        if not issubclass(found, base):
            raise TypeError(f"{name} is not a {base.__name__}")
        return found


def _name(cls: type[Any]) -> str:
    """Return the wire name of a class, with its module: two plug-ins may use the same class name."""
    return f"{cls.__module__}.{cls.__qualname__}"


def _travels(cls: type[Any]) -> bool:
    return dataclasses.is_dataclass(cls) or issubclass(cls, Schema | Enum)


def _annotations(cls: type[Any]) -> list[Any]:
    """Return the annotations of the fields of a dataclass or model."""
    if issubclass(cls, Schema):
        return [part for field in cls.model_fields.values() for part in (field.annotation, *field.metadata)]
    hints = get_type_hints(cls, include_extras=True)
    return [hints[field.name] for field in dataclasses.fields(cls)]


class RemoteActor:
    """One kind of steps, executed by a plan server that requests work; a new caller replaces the previous one.

    Args:
        name: name of the steps, used by the caller.
        codec: codec of their inputs and outputs.
        clock: source of time.
        deadline: maximum duration of a step, s.
        start_timeout: maximum wait for a caller, s.
    """

    def __init__(self, name: str, codec: StepCodec, clock: Clock, *, deadline: float, start_timeout: float) -> None:
        self._name, self._codec, self._clock = name, codec, clock
        self._deadline, self._start_timeout = deadline, start_timeout
        self._server: str | None = None
        self._changed = False
        self._number = 0
        self._task: Any = None
        self._result: asyncio.Future[Any] | None = None
        self._parts: list[str] = []
        self._update = asyncio.Event()
        self._lock = asyncio.Lock()

    async def start(self) -> None:
        """Wait for the first call.

        Raises:
            WorkerTimeoutError: no caller in time.
        """
        try:
            async with self._clock.deadline(self._start_timeout):
                while self._server is None:
                    await self._wait()
        except TimeoutError:
            raise WorkerTimeoutError(
                f"{self._name}: no plan-server connected within {self._start_timeout:g} s"
            ) from None
        self._changed = False

    async def step(self, inputs: Any) -> Any:
        """Execute one step on the plan server.

        Raises:
            WorkerTimeoutError: no outputs in time.
            WorkerError: the step failed, or another server without the current state took over.
        """
        async with self._lock:
            if self._changed:
                self._changed = False
                raise WorkerError(f"{self._name}: another plan-server took over")
            self._number += 1
            self._task = self._codec.to_json(inputs)
            result = self._result = asyncio.get_running_loop().create_future()
            self._notify()
            try:
                async with self._clock.deadline(self._deadline):
                    return await result
            except TimeoutError:
                raise WorkerTimeoutError(f"{self._name}: no outputs within {self._deadline:g} s") from None
            finally:
                self._task = self._result = None

    async def serve(self, payload: dict[str, Any]) -> dict[str, Any]:
        """Serve one call: accept outputs, and answer with the next inputs when available.

        Raises:
            InputError: the call is invalid.
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
        self._notify()

    def _take(self, payload: dict[str, Any]) -> bool:
        """Accept a part of the outputs; return whether they are complete."""
        self._parts.append(str(payload["part"]))
        most = 1_000_000  # maximum total number of characters of outputs
        if sum(map(len, self._parts)) > most:
            self._parts = []
            raise InputError(f"outputs: more than {most} characters")
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

    def _notify(self) -> None:
        update, self._update = self._update, asyncio.Event()
        update.set()

    async def _wait(self) -> None:
        await self._update.wait()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        self._task = None


class RemoteWorkQueue:
    """The remote actors of a daemon by name.

    Args:
        codec: codec of all steps' inputs and outputs.
    """

    def __init__(self, codec: StepCodec) -> None:
        self._codec = codec
        self._actors: dict[str, RemoteActor] = {}

    def actor(self, name: str, clock: Clock, *, deadline: float, start_timeout: float) -> RemoteActor:
        """Create a remote actor."""
        self._actors[name] = RemoteActor(name, self._codec, clock, deadline=deadline, start_timeout=start_timeout)
        return self._actors[name]

    async def serve(self, payload: dict[str, Any]) -> dict[str, Any]:
        """Serve one call of a plan server.

        Raises:
            NotFoundError: no such steps are placed on another machine.
            InputError: the call is invalid.
        """
        actor = self._actors.get(str(payload.get("actor")))
        if actor is None:
            raise NotFoundError(f"{payload.get('actor')!r} is not placed on another machine")
        return await actor.serve(payload)


async def serve(
    clock: Clock,
    connect: Callable[[], AbstractAsyncContextManager[Operator]],
    steps: Mapping[str, str],
    codec: StepCodec,
) -> None:
    """Serve a robot until cancelled, across its restarts.

    Args:
        clock: source of time.
        connect: opens a client of the robot; its calls may take twice ``POLL``.
        steps: available steps, ``module:factory`` by name.
        codec: codec of inputs and outputs.
    """
    while True:
        try:
            async with (
                connect() as client,
                asyncio.TaskGroup() as tasks,
            ):
                for name, target in steps.items():
                    tasks.create_task(work(client, clock, name, target, codec, f"{client.source[:40]}.{clock.now():x}"))
        except* TruckError as group:
            log.warning("%s; retrying", group.exceptions[0])
        await clock.sleep(REMOTE_RETRY)


async def work(caller: Operator, clock: Clock, name: str, target: str, codec: StepCodec, server: str) -> None:
    """Request one kind of steps, execute them and return the outputs, until cancelled.

    Raises:
        TruckError: the robot is gone.
    """
    who = {"actor": name, "server": server}
    step = await in_thread(partial(_build, target))
    reply: dict[str, Any] = {}
    done = 0
    while True:
        try:
            reply = await caller.call(RPC, {**who, "after": done}) if "inputs" not in reply else reply
        except NotFoundError as error:
            if "not placed" not in str(error) and "no rpc" not in str(error):
                raise
            await clock.sleep(REMOTE_RETRY)
            continue
        if "inputs" not in reply:
            continue
        done = int(reply["number"])
        failed = False
        try:
            text = await in_thread(partial(_answer, step, codec, reply["inputs"]))
        except Exception as error:  # noqa: BLE001 - sent to the robot, which decides
            failed, text = True, f"{type(error).__name__}: {error}"
            step = await in_thread(partial(_build, target))
        parts = [text[i : i + PART] for i in range(0, len(text), PART)] or [""]
        for i, part in enumerate(parts, start=1):
            outputs = {"number": done, "part": part, "last": i == len(parts), "failed": failed}
            reply = await caller.call(RPC, {**who, "after": done, **outputs})


def _build(target: str) -> Any:
    module, _, factory = target.partition(":")
    return getattr(importlib.import_module(module), factory)()


def _answer(step: Any, codec: StepCodec, inputs: Any) -> str:
    return json.dumps(codec.to_json(step.step(codec.from_json(inputs))))
