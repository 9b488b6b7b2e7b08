"""A truck in the rooms on the virtual clock, and somebody who asks it to go places."""

import math
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path
from typing import Any

from monstertruck_runtime.clock import VirtualClock, run_virtual
from monstertruck_runtime.mailbox import fifo
from monstertruck_schemas import topics
from monstertruck_schemas.plan import GoalPhase, GoalState
from monstertruck_schemas.reasons import Reason
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
QUICK = {
    "recorder": None,
    "blackbox": None,
    "planner": {"route": {"effort": 3000, "margin": 0.04}, "local_planner": None},
    "placement": {"planner": "loop", "local_planner": "loop"},
}


class Trip:
    """A truck in the rooms, and somebody who asks it to go places."""

    def __init__(self, rig: VirtualRig) -> None:
        self.rig = rig
        self.clock: VirtualClock = rig.clock
        self.operator = LocalOperator(rig.daemon, rig.clock)
        self.states = rig.bus.subscribe(topics.GOAL, fifo(4096))
        self.events = rig.bus.subscribe(topics.EVENT, fifo(4096))
        self._gate = rig.bus.subscribe(topics.GATE, fifo(4096))
        self._seq = 0

    def header(self) -> dict[str, Any]:
        gate, now = self._gate.latest, self.clock.now()
        assert gate is not None
        self._seq += 1
        known = {"nonce": gate.nonce, "gate_stamp": gate.stamp}
        who = {"seq": self._seq, "source": "tester", "role": "station", "lease": 1.0, "frame": "map"}
        return {"stamp": now, "received": now, **who, **known}

    async def goal(self, x: float, y: float, yaw: float, via: Sequence[tuple[float, ...]] = ()) -> dict[str, Any]:
        waypoints = [dict(zip(("x", "y", "yaw"), place, strict=False)) for place in via]
        goal = {"goal": {"x": x, "y": y, "yaw": yaw}, "waypoints": waypoints}
        return await self.rig.daemon.rpc.call("goal", {**self.header(), **goal})

    async def order(self, order: str) -> None:
        await self.rig.daemon.rpc.call("goal_control", {**self.header(), "order": order})

    async def arm(self) -> None:
        await self.operator.arm()

    async def end(self, limit: float = 200.0) -> GoalState:
        async with self.clock.deadline(limit):
            while True:
                state = await self.states.next()
                if state.phase is GoalPhase.IDLE and state.outcome is not Reason.OK:
                    return state

    def reasons(self) -> list[Reason]:
        drained = self.events.drain()
        return [
            event.reason for event in drained if event.source == "goals" and event.reason is not Reason.DEVICE_READY
        ]


def travel(story: Callable[[Trip], Awaitable[None]], base: str | None = None, **overlay: Any) -> VirtualRig:
    """Tell ``story`` by the truck of ``configs/goals.yaml`` with a small budget, or of the configuration ``base``."""
    config = load_config(CONFIGS / (base or "goals.yaml"), SimulatedTruckConfig)[0]
    if base is None:
        overlay = {"planner": {"local_planner": {"kind": "rsband"}}} | overlay
        config = with_overlay(config, QUICK)
    else:
        overlay = {name: QUICK[name] for name in ("recorder", "blackbox", "placement")} | overlay
    config = with_overlay(config, overlay)

    async def main(clock: VirtualClock) -> VirtualRig:
        rig = VirtualRig(config, clock)
        async with rig.running():
            trip = Trip(rig)
            await clock.sleep(3.0)
            await story(trip)
        return rig

    return run_virtual(main)


def own_path(folder: Path) -> Path:
    """A path of 5 m straight ahead of where the truck starts."""
    file = folder / "ahead.csv"
    file.write_text("x,y,yaw,direction\n" + "".join(f"{1.0 + i / 10},3.95,0,1\n" for i in range(51)))
    return file


def assert_at(rig: VirtualRig, x: float, y: float, yaw: float) -> None:
    truth = rig.truth.array()
    assert not truth[:, 5].any(), "collided"
    assert math.dist(truth[-1, 1:3], (x, y)) < 0.2
    assert abs(math.remainder(truth[-1, 3] - yaw, math.tau)) < 0.2
