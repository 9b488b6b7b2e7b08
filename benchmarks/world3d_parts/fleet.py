"""Two robots and walking people in one world of rigid bodies, a daemon for each robot: one leads, one follows."""

import hashlib
from time import process_time
from typing import Any

import numpy as np

from benchmarks.world3d_parts.terrain import CONFIGS
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.mailbox import fifo
from monstertruck_schemas import topics
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import BehaviourOrder
from monstertruck_sim.world.scene import MOVING
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig
from tests.fleet_kit import virtual_fleet

PEOPLE = (
    {"waypoints": ({"x": 0.6, "y": 2.4}, {"x": 0.6, "y": -2.4}), "speed": 0.5, "before": "stop"},
    {"waypoints": ({"x": -2.6, "y": 1.4}, {"x": 2.6, "y": 1.4}), "speed": 0.6, "before": "turn"},
)
MOVES: tuple[tuple[dict[str, float], float], ...] = (({"length": 1.5}, 14.0), ({"radius": 0.9, "angle": 1.7}, 17.0))
"""What the leader is asked for, and for how many seconds it may take."""


async def _start(rig: VirtualRig, clock: VirtualClock, behaviour: str, **settings: Any) -> None:
    operator = LocalOperator(rig.daemon, clock, source=f"operator_{behaviour}")
    await operator.arm()
    order = {"order": BehaviourOrder.START, "behaviour": behaviour, "settings": settings}
    await operator.call("behave", {**await operator.header(), **order})


def _drive(people: tuple[Any, ...]) -> tuple[list[np.ndarray], list[Any], Reason, float]:
    """Return the truth of both robots, contacts, the end of the follower, and processor time (s)."""

    async def main(clock: VirtualClock) -> tuple[list[np.ndarray], list[Any], Reason]:
        names = ("leader", "second")
        configs = [load_config(CONFIGS / "world3d" / f"{n}.yaml", SimulatedTruckConfig)[0] for n in names]
        overlay: dict[str, Any] = {"recorder": None, "sim": {"world": {"people": people}}}
        async with virtual_fleet([with_overlay(config, overlay) for config in configs], clock) as (rigs, scene):
            with rigs[1].bus.subscribe(topics.BEHAVIOUR, fifo(1 << 14)) as states:
                await clock.sleep(2.0)
                await _start(rigs[1], clock, "follow")
                for settings, seconds in MOVES:
                    await _start(rigs[0], clock, "move", **settings)
                    await clock.sleep(seconds)
                outcome = [*states.drain()][-1].outcome
            return [rig.truth.array() for rig in rigs], list(scene.contacts), outcome

    begin = process_time()
    truths, contacts, outcome = run_virtual(main, start=SECOND)
    return truths, contacts, outcome, process_time() - begin


def fleet() -> dict[str, float]:
    """Run alone, and twice with people, which must give the same."""
    _, alone, outcome, _ = _drive(())
    runs = [_drive(PEOPLE) for _ in range(2)]
    truths, contacts, _, seconds = runs[0]
    digests = {hashlib.sha256(b"".join(truth.tobytes() for truth in run[0])).hexdigest() for run in runs}
    robots = {"leader", "second"}
    by_robots = [c for c in (*alone, *contacts) if c.mover in robots and c.speed > MOVING]
    count = min(len(truth) for truth in truths)
    apart = np.hypot(*(truths[0][:count, 1:3] - truths[1][:count, 1:3]).T)
    return {
        "fleet_followed": float(outcome is Reason.DRIVING),
        "fleet_contacts_by_robots": len(by_robots),
        "fleet_contacts_by_people": len(contacts) - sum(c.mover in robots for c in contacts),
        "fleet_least_apart_m": float(apart.min()),
        "fleet_same": float(len(digests) == 1),
        "fleet_speed": float(truths[0][-1, 0] - truths[0][0, 0]) / seconds,
    }


if __name__ == "__main__":
    for _name, _value in fleet().items():
        print(f"{_name:36} {_value:.4g}")
