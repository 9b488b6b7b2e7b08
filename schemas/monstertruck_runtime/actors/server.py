"""The other machine's side of remote steps."""

import asyncio
import importlib
import json
import logging
from collections.abc import Mapping
from functools import partial
from typing import Any, Final, Protocol

from monstertruck_runtime.actors.codec import StepCodec
from monstertruck_runtime.actors.remote import PART, POLL, RPC
from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import NotFoundError, TruckError
from monstertruck_runtime.threads import in_thread

log = logging.getLogger(__name__)

RETRY: Final = 1.0
"""Seconds between two tries to reach a robot."""


class Caller(Protocol):
    """What is needed of a ``TruckClient``."""

    async def call(self, rpc: str, payload: dict[str, Any] | None = None) -> dict[str, Any]:
        """Call the robot."""
        ...


async def serve(clock: Clock, robot: str, endpoint: str, steps: Mapping[str, str], codec: StepCodec) -> None:
    """Serve a robot until cancelled, over all its restarts.

    Args:
        clock: time.
        robot: its name.
        endpoint: where it listens.
        steps: what can be computed here: ``module:factory`` by name.
        codec: of inputs and outputs.
    """
    while True:
        try:
            async with (
                TruckClient(robot, endpoint, clock=clock, timeout=2 * POLL) as client,
                asyncio.TaskGroup() as tasks,
            ):
                for name, target in steps.items():
                    tasks.create_task(work(client, clock, name, target, codec, f"{client.source[:40]}.{clock.now():x}"))
        except* TruckError as group:
            log.warning("%s; tries again", group.exceptions[0])
        await clock.sleep(RETRY)


async def work(caller: Caller, clock: Clock, name: str, target: str, codec: StepCodec, server: str) -> None:
    """Call for one kind of steps, take them, bring the outputs; until cancelled.

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
            await clock.sleep(RETRY)
            continue
        if "inputs" not in reply:
            continue
        done = int(reply["number"])
        failed = False
        try:
            text = await in_thread(partial(_answer, step, codec, reply["inputs"]))
        except Exception as error:  # noqa: BLE001 - told to the robot, which decides
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
