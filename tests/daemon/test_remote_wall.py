"""Steps in another process, over a real Zenoh session, give what they give in the loop and in a worker."""

import asyncio
import sys
from typing import Any

import numpy as np
import pytest

from monstertruck_planners.goals.exchange import DeformAnswer, RouteAnswer
from monstertruck_planners.steps import CODEC, DEFORMING, EXPLORING, PLANNING, STEPS, TRACKING
from monstertruck_runtime.actors.actor import ActorFactory, Placement
from monstertruck_runtime.actors.remote import RPC, RemoteWorkQueue
from monstertruck_runtime.clock import Clock, run_wall
from tests.bus_kit import running_robot
from tests.unit.runtime.actors.step_kit import deform_tasks, explore_task, numbers, plan_task, track_inputs

pytestmark = [pytest.mark.wall, pytest.mark.timeout(180)]

INPUTS = {PLANNING: [plan_task()], DEFORMING: deform_tasks(), TRACKING: track_inputs(), EXPLORING: [explore_task()]}


async def outputs(actors: ActorFactory, placement: Placement, name: str) -> list[Any]:
    target, inputs = STEPS[name], INPUTS[name]
    async with actors.actor(placement, name, target, latency=0.0, deadline=60.0, start_timeout=120.0) as actor:
        await actor.start()
        return [await actor.step(one) for one in inputs]


def test_all_steps_give_the_same_in_the_loop_in_a_worker_and_in_a_plan_server():
    async def main(clock: Clock) -> tuple[int, dict[str, list[list[Any]]]]:
        queue = RemoteWorkQueue(CODEC)
        actors = ActorFactory(clock, queue)
        remote = {}
        async with running_robot(deadline=5.0) as robot:
            robot.rpc.register(RPC, queue.serve)
            server = await asyncio.create_subprocess_exec(
                sys.executable, "-m", "monstertruckd", "plan-server", "--endpoint", robot.endpoint
            )
            try:
                for name in STEPS:
                    remote[name] = await outputs(actors, "remote", name)
            finally:
                server.terminate()
                ended = await server.wait()
        here: tuple[Placement, ...] = ("worker", "loop")
        return ended, {name: [remote[name], *[await outputs(actors, place, name) for place in here]] for name in STEPS}

    ended, found = run_wall(main)
    assert ended == 0
    for name, (remote, worker, loop) in found.items():
        for elsewhere in (remote, worker):
            a, b = (numbers(CODEC.to_json(outputs)) for outputs in (elsewhere, loop))
            assert len(a) == len(b) > 3, name
            assert np.abs(np.subtract(a, b)).max() < 1e-9, name
    plan, last = found["planning"][0][0], found["deforming"][0][0]
    assert isinstance(plan, RouteAnswer)
    assert isinstance(last, DeformAnswer)
    assert plan.path is not None
    assert last.finding == "new"
    driven = found["tracking"][0][-1]
    assert driven.drive
    assert driven.command.speed > 0.0
