"""Answers of planner and local planner in a replay: recomputed, and delivered when the log shows the recorded ones.

The truck drove the recorded path, so the goal service receives the recorded one, and later outputs can be compared. The
computed path is kept and compared with it.
"""

import asyncio
from dataclasses import replace
from typing import Any, Self

import numpy as np

from monstertruck_kinematics.elementary import Array
from monstertruck_planners.goals.exchange import DeformAnswer, DeformTask, PlanTask, RouteAnswer
from monstertruck_planners.pose_path import PosePath
from monstertruck_planners.steps import CODEC
from monstertruck_runtime.actors.actor import Actor, ActorFactory, LoopActor, Placement
from monstertruck_runtime.actors.remote import RemoteWorkQueue
from monstertruck_runtime.clock import SECOND, WallClock
from monstertruck_schemas.plan import Path, Steering
from monstertruck_schemas.reasons import Reason
from monstertruckd.tools.replay_check.goals import DEFORMED, PLANNED, TOGETHER, GoalRecord
from monstertruckd.tools.replay_check.pace import PacedClock


class ComputedPaths:
    """Computed paths that differ from those driven."""

    def __init__(self) -> None:
        self._computed: dict[str, PosePath | None] = {}

    def settle(self, computed: PosePath | None, driven: Path) -> PosePath:
        """Return the path for the goal service: the one that was driven."""
        if computed is not None and _same(computed, driven):
            return computed
        self._computed[driven.name] = computed
        path = PosePath.of(driven)
        return replace(path, steering=path.steering or _steering(computed, path.poses))

    def as_computed(self, path: Path) -> Path:
        """Return ``path`` as it would be if no other path had been driven."""
        if path.name not in self._computed:
            return path
        computed = self._computed[path.name]
        if computed is None:
            return path.model_copy(update={"poses": np.empty(0), "directions": np.empty(0), "steering": ()})
        update = {"poses": computed.poses.ravel(), "directions": computed.directions, "steering": computed.steering}
        return path.model_copy(update=update)


class _Replayed:
    """Executes steps in the loop; a log gives the delivery times of their results."""

    def __init__(self, target: str, clock: PacedClock, record: GoalRecord, book: ComputedPaths, latency: float) -> None:
        self._inner = LoopActor(target, WallClock(), 0.0)  # not virtual: it answers at once
        self._clock, self._record, self._book = clock, record, book
        self._latency = round(latency * SECOND)

    async def start(self) -> None:
        """Prepare for the first step."""
        await self._inner.start()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *failure: object) -> None:
        await self._inner.__aexit__(*failure)


class ReplayedPlanner(_Replayed):
    """Recomputes routes and ways out."""

    async def step(self, task: PlanTask) -> RouteAnswer:
        """Answer just before the tick that shows the recorded answer; never if the log ends before."""
        end = self._record.decided()
        answer: RouteAnswer = await self._inner.step(task)
        if end is None:
            await asyncio.Event().wait()
        assert end is not None
        await self._clock.reach(end - (SECOND // 1000))  # a route is there this long before the tick that takes it, ns
        shown = self._record.path_between(end - TOGETHER, end, PLANNED)
        if shown is None:
            return answer
        path = self._book.settle(answer.path, shown)
        return answer if path is answer.path else replace(answer, reason=Reason.OK, path=path, length=path.length)


class ReplayedDeformer(_Replayed):
    """Recomputes deformed routes; most results are unrecorded, and due after the configured latency."""

    async def step(self, task: DeformTask) -> DeformAnswer:
        """Answer when a path shows the recorded answer, otherwise when due."""
        begin = self._clock.now()
        answer: DeformAnswer = await self._inner.step(task)
        shown = self._record.path_between(begin, begin + 2 * self._latency, DEFORMED)
        await self._clock.reach(begin + self._latency + 1 if shown is None else shown.stamp)
        if shown is None or "-held-up" in shown.name:
            return answer
        return replace(answer, finding="new", path=self._book.settle(answer.path, shown))


class ReplayedActors(ActorFactory):
    """Actors of the goal service."""

    def __init__(self, clock: PacedClock, record: GoalRecord, book: ComputedPaths) -> None:
        super().__init__(clock, RemoteWorkQueue(CODEC))
        self._paced, self._record, self._book = clock, record, book

    def actor(self, placement: Placement, name: str, target: str, *, latency: float, **limits: Any) -> Actor:
        """Return an actor that runs in the event loop, even if it ran elsewhere in the recorded run."""
        how = target, self._paced, self._record, self._book, latency
        match name:
            case "planning":
                return ReplayedPlanner(*how)
            case "deforming":
                return ReplayedDeformer(*how)
            case _:
                return super().actor(placement, name, target, latency=latency, **limits)


def _steering(computed: PosePath | None, poses: Array) -> tuple[Steering, ...]:
    """Return the steering modes, which paths in logs omit, from the nearest parts of the computed path."""
    if computed is None or not computed.steering:
        return ()
    apart = poses[:, None, :2] - computed.poses[None, :, :2]
    return tuple(computed.steering[index] for index in np.hypot(apart[..., 0], apart[..., 1]).argmin(axis=1))


def _same(computed: PosePath, driven: Path) -> bool:
    return np.array_equal(computed.poses.ravel(), driven.poses) and np.array_equal(
        computed.directions, driven.directions
    )
