"""Remote calls: named coroutine handlers that take and return JSON objects.

Handlers find the caller under ``source`` and its permitted priority under ``role``, whatever the payload claims.
"""

import json
import logging
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from monstertruck_runtime import wire
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import InputError, NoAnswerError, NotFoundError, RequestRefusedError, TruckError
from monstertruck_runtime.ports import Handler
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Role
from monstertruck_schemas.roles import AccessRole
from monstertruck_schemas.topics import TOPICS
from monstertruckd.bus.access import Sender

log = logging.getLogger(__name__)


class Rpc:
    """Registry of handlers.

    Args:
        clock: clock for the deadlines.
        deadline: maximum duration of a handler (s).
        record: receives name, source, payload, reason and answer of every recorded call from outside.
    """

    def __init__(
        self, clock: Clock, deadline: float = 5.0, record: Callable[[str, str, str, Reason, str], object] | None = None
    ) -> None:
        self._clock = clock
        self._record = record
        self._unrecorded: set[str] = set()
        self._deadline = deadline
        self._handlers: dict[str, Handler] = {}
        self._needed: dict[str, AccessRole] = {}

    def register(
        self, name: str, handler: Handler, role: AccessRole = AccessRole.PILOT, *, recorded: bool = True
    ) -> None:
        """Serve ``name`` with ``handler`` for callers that have ``role`` or a higher one.

        Calls that only read, or that are made many times per second, are not ``recorded``.

        Raises:
            RuntimeError: the name is taken.
        """
        if name in self._handlers:
            msg = f"rpc {name} is registered twice"
            raise RuntimeError(msg)
        self._handlers[name] = handler
        self._needed[name] = role
        if not recorded:
            self._unrecorded.add(name)

    def serves(self, name: str) -> bool:
        """Return whether a handler is registered."""
        return name in self._handlers

    async def call(self, name: str, payload: dict[str, Any]) -> dict[str, Any]:
        """Run one handler for any caller.

        Raises:
            NotFoundError: the name does not exist; the text lists the existing names.
            NoAnswerError: the handler missed its deadline and was cancelled.
            TruckError: the handler refused the call.
        """
        handler = self._handlers.get(name)
        if handler is None:
            msg = f"no rpc {name!r}; there are {', '.join(sorted(self._handlers)) or 'none'}"
            raise NotFoundError(msg)
        try:
            async with self._clock.deadline(self._deadline) as deadline:
                return await handler(payload)
        except TimeoutError:
            if not deadline.expired():
                raise
            msg = f"rpc {name} did not end within {self._deadline} s"
            raise NoAnswerError(msg) from None

    async def answer(self, sender: Sender, name: str, payload: bytes) -> tuple[bool, bytes]:
        """Serve one call from outside: JSON in, (success, JSON) out; never raises, and logs a handler's bug.

        A failure is ``{"reason": ..., "text": ...}``.

        Args:
            sender: caller, identified by the key.
            name: name of the call.
            payload: JSON object.
        """
        reason, answered = await self._answer(sender, name, payload)
        if self._record is not None and name not in self._unrecorded:
            self._record(name, sender.source, payload.decode(errors="replace"), reason, answered.decode())
        return reason is Reason.OK, answered

    async def _answer(self, sender: Sender, name: str, payload: bytes) -> tuple[Reason, bytes]:
        """Return ``OK`` and the answer, or the reason for the failure and the error reply."""
        needed = self._needed.get(name, AccessRole.OBSERVER)
        if not sender.may(needed):
            return Reason.NOT_PERMITTED, failure(Reason.NOT_PERMITTED, f"{name}: {sender.refusal(needed)}")
        try:
            answer = await self.call(name, _of_sender(sender, _parse(payload)))
            return Reason.OK, json.dumps(answer, allow_nan=False).encode()
        except TruckError as error:
            reason = error.refusal if isinstance(error, RequestRefusedError) else error.reason
            return reason, failure(reason, str(error))
        except Exception:
            log.exception("rpc %s: bug", name)
            return Reason.INTERNAL, failure(Reason.INTERNAL, Reason.INTERNAL.text)


def topic_rows(robot: str) -> list[dict[str, Any]]:
    """Return the topic table as JSON, for tools that do not use this package."""
    return [
        {
            "name": topic.name,
            "key": topic.key(robot),
            "group": topic.group,
            "model": topic.model.__name__,
            "schema": topic.schema_name,
            "encoding": wire.encoding(topic),
            "writer": topic.writer.value,
            "rate": topic.rate,
            "stale_after": topic.stale_after,
            "logged": topic.logged,
            "retained": topic.retained,
            "doc": topic.doc,
        }
        for topic in TOPICS
    ]


def _of_sender(sender: Sender, payload: dict[str, Any]) -> dict[str, Any]:
    """Return the payload with the sender's source and role; an invalid role is left to the handler."""
    said = {**payload, "source": sender.source}
    with suppress(KeyError, ValueError):
        said["role"] = sender.grant.capped(Role(payload["role"])).value
    return said


def _parse(payload: bytes) -> dict[str, Any]:
    if not payload:
        return {}
    try:
        value = json.loads(payload)
    except (ValueError, RecursionError) as error:
        msg = f"payload is not JSON: {error}"
        raise InputError(msg) from None
    if not isinstance(value, dict):
        msg = f"payload must be a JSON object, not {type(value).__name__}"
        raise InputError(msg)
    return value


def failure(reason: Reason, text: str) -> bytes:
    """Error reply as JSON."""
    return json.dumps({"reason": reason.value, "text": text}).encode()
