"""Steps of planner, local planner, tracker and explorer in the loop, in a worker, and in ``plan-server`` over Zenoh.

Measures the time from an input to its output, and the difference of the outputs from those of the loop.
"""

import asyncio
import sys
import time
from typing import Any

import numpy as np

from benchmarks.navigation_parts import Options, Part
from monstertruck_planners.steps import CODEC, DEFORMING, EXPLORING, PLANNING, STEPS, TRACKING
from monstertruck_runtime.actors.actor import ActorFactory, Placement
from monstertruck_runtime.actors.remote import RPC, RemoteWorkQueue
from monstertruck_runtime.clock import Clock, run_wall
from tests.bus_kit import running_robot
from tests.unit.runtime.actors.step_kit import deform_tasks, explore_task, numbers, plan_task, track_inputs

PLACEMENTS: tuple[Placement, ...] = ("loop", "worker", "remote")
TRACK_PERIOD = 20.0
"""Time in which a tracker's step has to be answered (ms)."""


def run(options: Options) -> Part:
    rounds = 3 if options.quick else 20
    inputs: dict[str, list[Any]] = {
        PLANNING: [plan_task()] * rounds,
        DEFORMING: deform_tasks() * rounds,
        TRACKING: track_inputs() * rounds,
        EXPLORING: [explore_task()] * rounds,
    }

    async def measured(actors: ActorFactory, placement: Placement, name: str) -> tuple[list[float], list[Any]]:
        times, outputs = [], []
        async with actors.actor(placement, name, STEPS[name], latency=0.0, deadline=60.0, start_timeout=600.0) as actor:
            await actor.start()
            await actor.step(inputs[name][0])  # kernels are compiled
            for one in inputs[name]:
                began = time.perf_counter()
                outputs.append(await actor.step(one))
                times.append(1e3 * (time.perf_counter() - began))
        return times, outputs

    async def main(clock: Clock) -> dict[tuple[str, str], tuple[list[float], list[Any]]]:
        queue = RemoteWorkQueue(CODEC)
        actors = ActorFactory(clock, queue)
        async with running_robot(deadline=5.0) as robot:
            robot.rpc.register(RPC, queue.serve)
            server = await asyncio.create_subprocess_exec(
                sys.executable, "-m", "monstertruckd", "plan-server", "--endpoint", robot.endpoint
            )
            try:
                return {(place, name): await measured(actors, place, name) for name in STEPS for place in PLACEMENTS}
            finally:
                server.terminate()
                await server.wait()

    found, part = run_wall(main), Part()
    for (place, name), (times, outputs) in found.items():
        part.add(f"{place}.{name}_ms", float(np.median(times)))
        part.add(f"{place}.{name}_p95_ms", float(np.percentile(times, 95)), TRACK_PERIOD if name == TRACKING else None)
        here, there = (numbers(CODEC.to_json(each)) for each in (found["loop", name][1], outputs))
        difference = float(np.abs(np.subtract(here, there)).max()) if len(here) == len(there) else np.inf
        part.add(f"{place}.{name}_difference", difference, 1e-9)
    return part
