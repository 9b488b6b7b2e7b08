"""Steps on another machine give what they give here, and say so when they cannot."""

import asyncio
import dataclasses
import json
from enum import Enum
from typing import Any, get_args, get_type_hints

import numpy as np
import pytest

from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.collision import Footprint
from monstertruck_planners.manage.config import PlannerConfig
from monstertruck_planners.manage.exchange import PlanAnswer, PlanTask, Setup
from monstertruck_planners.manage.planning import PlanningStep
from monstertruck_planners.route.config import HybridConfig
from monstertruck_planners.track.config import LqrConfig
from monstertruck_runtime.clock import Clock, run_wall
from monstertruck_runtime.errors import InputError, NotFoundError, WorkerError, WorkerTimeoutError
from monstertruck_schemas.base import Pose2D, Schema, Twist2D
from monstertruck_schemas.plan import Path
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.state import GateMode, GateState, Grid, Odometry
from monstertruckd.workers import codec, plan_server
from monstertruckd.workers.codec import from_json, to_json
from monstertruckd.workers.remote import RemoteDesk
from monstertruckd.workers.tracking import TrackingWorker, TrackInput, TrackSetup

BODY, TRUCK = Footprint(), FourWheelSteering()
HEAD = {"stamp": 5, "received": 5, "seq": 0}


class Wire:
    """A robot that is called: everything goes through JSON."""

    def __init__(self, desk: RemoteDesk) -> None:
        self._desk = desk

    async def call(self, rpc: str, payload: dict[str, Any] | None = None) -> dict[str, Any]:
        assert rpc == "remote_step"
        return json.loads(json.dumps(await self._desk.serve(json.loads(json.dumps(payload)))))


def plan_task() -> PlanTask:
    cells = np.zeros((60, 120), np.int8)
    cells[[0, -1]] = cells[:, [0, -1]] = 100
    grid = Grid(
        **HEAD, frame="map", resolution=0.05, width=120, height=60, origin=Pose2D(x=0.0, y=0.0, yaw=0.0),
        cells=cells.ravel(),
    )  # fmt: skip
    setup = Setup(PlannerConfig(route=HybridConfig(effort=1000, margin=0.04)), TRUCK, BODY, timed=False)
    points = np.array([[2.75, 1.5], [2.75, 1.45]])
    return PlanTask("route", (1.0, 1.5, 0.1), (4.5, 1.4, 0.3), points, setup=setup, grid=grid)


def track_inputs() -> list[TrackInput]:
    xs = np.linspace(0.0, 2.0, 41)
    path = Path(
        **HEAD, frame="odom", poses=np.column_stack((xs, 0.1 * xs**2, 0.2 * xs)).ravel(), directions=np.ones(41)
    )
    gate = GateState(**HEAD, mode=GateMode.DRIVING, nonce="n", speed_limit=0.2)
    setup = TrackSetup(LqrConfig(kind="lqr"), TRUCK, BODY, (0.0, 0.0, 0.0), scan=False, attitude=False)
    inputs = []
    for i in range(5):
        odometry = Odometry(
            **{**HEAD, "received": 50_000_000 * i}, frame="odom", pose=Pose2D(x=0.01 * i, y=0.02, yaw=0.0),
            twist=Twist2D(vx=0.1, vy=0.0, wz=0.0), pose_covariance=np.zeros(9), twist_covariance=np.zeros(9), age=0.0,
        )  # fmt: skip
        news = {"pose": odometry} | ({"path": path, "gate": gate} if i == 0 else {})
        inputs.append(TrackInput(50_000_000 * i, news, setup if i == 0 else None))
    return inputs


def numbers(value: Any) -> list[float]:
    """All numbers of a tree."""
    match value:
        case {"array": _}:
            return from_json(value).ravel().tolist()
        case dict():
            return [number for inner in value.values() for number in numbers(inner)]
        case list():
            return [number for inner in value for number in numbers(inner)]
        case bool() | str() | None:
            return []
    return [float(value)]


def test_planner_and_tracker_give_the_same_on_another_machine():
    async def main(clock: Clock) -> tuple[PlanAnswer, list[Any]]:
        desk = RemoteDesk()
        planning = desk.actor("planning", clock, deadline=60.0, patience=60.0)
        tracking = desk.actor("tracking", clock, deadline=60.0, patience=60.0)
        servers = [
            asyncio.create_task(plan_server.work(Wire(desk), clock, name, "s1")) for name in ("planning", "tracking")
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
        a, b = numbers(to_json(ours)), numbers(to_json(theirs))
        assert len(a) == len(b) > 3
        assert np.abs(np.subtract(a, b)).max() < 1e-9
    assert plan.ok
    assert tracked[-1].drive[0].speed > 0.0


def test_failures_reach_the_robot_as_worker_errors():
    async def main(clock: Clock) -> None:
        desk = RemoteDesk()
        actor = desk.actor("tracking", clock, deadline=0.2, patience=0.05)
        with pytest.raises(WorkerTimeoutError, match="no plan-server"):
            await actor.start()
        server = asyncio.create_task(plan_server.work(Wire(desk), clock, "tracking", "s1"))
        await asyncio.sleep(0.05)
        await actor.start()
        with pytest.raises(WorkerError, match="expected a setup"):
            await actor.step(TrackInput(0, {}))
        server.cancel()
        with pytest.raises(WorkerTimeoutError, match="no outputs"):
            await actor.step(TrackInput(0, {}))
        await desk.serve({"actor": "tracking", "server": "s2", "part": "", "last": True, "after": 99, "number": 0})
        with pytest.raises(WorkerError, match="took over"):
            await actor.step(TrackInput(0, {}))

    run_wall(main)


def test_calls_that_make_no_sense_are_refused():
    async def main(clock: Clock) -> None:
        desk = RemoteDesk()
        desk.actor("planning", clock, deadline=1.0, patience=1.0)
        with pytest.raises(NotFoundError, match="not placed"):
            await desk.serve({"actor": "tracking", "server": "s"})
        with pytest.raises(InputError, match="server"):
            await desk.serve({"actor": "planning"})

    run_wall(main)


@pytest.mark.parametrize(
    "value",
    [
        {"class": "Popen", "fields": {}},
        {"class": "Footprint", "fields": {"length": -1.0}},
        {"array": "object", "shape": [1], "data": ""},
        {"array": "float64", "shape": [3], "data": "AAAA"},
        {"enum": "Reason", "value": "whatever"},
        {"unknown": 1},
    ],
)
def test_only_known_things_are_built(value):
    with pytest.raises(InputError):
        from_json(value)


def test_what_travels_comes_back_as_it_was():
    assert from_json(to_json((1, 2.5, None, "a", [True], {"k": Reason.OK}))) == (
        1,
        2.5,
        None,
        "a",
        [True],
        {"k": Reason.OK},
    )
    with pytest.raises(InputError, match="object"):
        to_json(object())


def parts(annotation: Any) -> list[Any]:
    """Every type named in an annotation."""
    return [annotation, *(part for inner in get_args(annotation) for part in parts(inner))]


def test_whatever_the_travelling_classes_hold_travels_too():
    known = {*codec._CLASSES.values(), *codec._ENUMS.values()}
    held = {
        part
        for cls in codec._CLASSES.values()
        for annotation in get_type_hints(cls).values()
        for part in parts(annotation)
        if isinstance(part, type) and (issubclass(part, Schema | Enum) or dataclasses.is_dataclass(part))
    }
    assert {cls.__name__ for cls in held - known} == {"TrackerConfig"}, "the base of those that travel"
