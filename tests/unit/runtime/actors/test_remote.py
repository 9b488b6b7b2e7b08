"""Steps on another machine give what they give here, and say so when they cannot."""

import asyncio
import dataclasses
import json
from enum import Enum
from typing import Any, get_args, get_type_hints

import numpy as np
import pytest

from monstertruck_planners.goals.exchange import RouteAnswer
from monstertruck_planners.goals.plan_step import PlanningStep
from monstertruck_planners.steps import CODEC, STEPS
from monstertruck_planners.track.service import TrackingWorker, TrackInput
from monstertruck_runtime.actors import remote as plan_server
from monstertruck_runtime.actors.remote import RemoteWorkQueue
from monstertruck_runtime.clock import Clock, run_wall
from monstertruck_runtime.errors import InputError, NotFoundError, WorkerError, WorkerTimeoutError
from monstertruck_schemas.base import Schema
from monstertruck_schemas.reasons import Reason
from tests.unit.runtime.actors.step_kit import numbers, plan_task, track_inputs


class Wire:
    """A robot that is called: everything goes through JSON."""

    def __init__(self, queue: RemoteWorkQueue) -> None:
        self._queue = queue

    async def call(self, rpc: str, payload: dict[str, Any] | None = None) -> dict[str, Any]:
        assert rpc == "remote_step"
        return json.loads(json.dumps(await self._queue.serve(json.loads(json.dumps(payload)))))


def test_planner_and_tracker_give_the_same_on_another_machine():
    async def main(clock: Clock) -> tuple[RouteAnswer, list[Any]]:
        queue = RemoteWorkQueue(CODEC)
        planning = queue.actor("planning", clock, deadline=60.0, start_timeout=60.0)
        tracking = queue.actor("tracking", clock, deadline=60.0, start_timeout=60.0)
        servers = [
            asyncio.create_task(plan_server.work(Wire(queue), clock, name, STEPS[name], CODEC, "s1"))
            for name in ("planning", "tracking")
        ]
        try:
            async with planning, tracking:
                await planning.start()
                await tracking.start()
                return await planning.step(plan_task()), [await tracking.step(inputs) for inputs in track_inputs()]
        finally:
            for server in servers:
                server.cancel()

    plan, tracked = run_wall(main)
    here = TrackingWorker()
    for ours, theirs in (
        (PlanningStep().step(plan_task()), plan),
        *zip(map(here.step, track_inputs()), tracked, strict=True),
    ):
        a, b = numbers(CODEC.to_json(ours)), numbers(CODEC.to_json(theirs))
        assert len(a) == len(b) > 3
        assert np.abs(np.subtract(a, b)).max() < 1e-9
    assert plan.path is not None
    assert tracked[-1].command.speed > 0.0


def test_failures_reach_the_robot_as_worker_errors():
    async def main(clock: Clock) -> None:
        queue = RemoteWorkQueue(CODEC)
        actor = queue.actor("tracking", clock, deadline=0.2, start_timeout=0.05)
        with pytest.raises(WorkerTimeoutError, match="no plan-server"):
            await actor.start()
        server = asyncio.create_task(plan_server.work(Wire(queue), clock, "tracking", STEPS["tracking"], CODEC, "s1"))
        await asyncio.sleep(0.05)
        await actor.start()
        with pytest.raises(WorkerError, match="expected a setup"):
            await actor.step(TrackInput(0, {}))
        server.cancel()
        with pytest.raises(WorkerTimeoutError, match="no outputs"):
            await actor.step(TrackInput(0, {}))
        await queue.serve({"actor": "tracking", "server": "s2", "part": "", "last": True, "after": 99, "number": 0})
        with pytest.raises(WorkerError, match="took over"):
            await actor.step(TrackInput(0, {}))

    run_wall(main)


def test_calls_that_make_no_sense_are_refused():
    async def main(clock: Clock) -> None:
        queue = RemoteWorkQueue(CODEC)
        queue.actor("planning", clock, deadline=1.0, start_timeout=1.0)
        with pytest.raises(NotFoundError, match="not placed"):
            await queue.serve({"actor": "tracking", "server": "s"})
        with pytest.raises(InputError, match="server"):
            await queue.serve({"actor": "planning"})

    run_wall(main)


@pytest.mark.parametrize(
    "value",
    [
        {"class": "Popen", "fields": {}},
        {"class": "monstertruck_planners.collision.Footprint", "fields": {"length": -1.0}},
        {"array": "object", "shape": [1], "data": ""},
        {"array": "float64", "shape": [3], "data": "AAAA"},
        {"enum": "monstertruck_schemas.reasons.Reason", "value": "whatever"},
        {"unknown": 1},
    ],
)
def test_only_known_things_are_built(value):
    with pytest.raises(InputError):
        CODEC.from_json(value)


def test_what_travels_comes_back_as_it_was():
    assert CODEC.from_json(CODEC.to_json((1, 2.5, None, "a", [True], {"k": Reason.OK}))) == (
        1,
        2.5,
        None,
        "a",
        [True],
        {"k": Reason.OK},
    )
    with pytest.raises(InputError, match="object"):
        CODEC.to_json(object())


def parts(annotation: Any) -> list[Any]:
    """Every type named in an annotation."""
    return [annotation, *(part for inner in get_args(annotation) for part in parts(inner))]


def test_whatever_the_travelling_classes_hold_travels_too():
    known = {*CODEC._classes.values()}
    held = {
        part
        for cls in CODEC._classes.values()
        if not issubclass(cls, Enum)
        for annotation in get_type_hints(cls).values()
        for part in parts(annotation)
        if isinstance(part, type) and (issubclass(part, Schema | Enum) or dataclasses.is_dataclass(part))
    }
    assert not held - known
