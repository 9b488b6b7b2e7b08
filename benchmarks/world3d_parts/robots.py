"""Every body with rigid wheels drives its bend, and the robot with five sonars follows a wall."""

from math import dist
from typing import Any

import numpy as np

from benchmarks import ROOT
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.mailbox import fifo
from monstertruck_schemas import topics
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import BehaviourOrder
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.operator import Lap, LocalOperator, drive_lap
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

ROBOTS = ROOT / "configs" / "robots"
BODIES = ("truck", "ackermann", "skid_steer", "differential", "omni", "mecanum")
END = (2.4, 4.15)
"""End of the bend, m."""
WALL, ASIDE, DISTANCE = 3.5, 0.05, 0.30
"""The yard's wall along x; of the left sonar from the robot's middle; at which the robot is to follow it, m."""


def config(name: str, **world: Any) -> SimulatedTruckConfig:
    """Return a robot of the folder in three dimensions."""
    base = load_config(ROBOTS / f"{name}.yaml", SimulatedTruckConfig)[0]
    return with_overlay(base, {"recorder": None, "sim": {"world": {"engine": "mujoco", **world}}})


def bend(name: str) -> tuple[Lap, np.ndarray]:
    """Return the lap of one robot, and its true poses."""

    async def main(clock: VirtualClock) -> tuple[Lap, np.ndarray]:
        rig = VirtualRig(config(name), clock)
        async with rig.running():
            lap = await drive_lap(LocalOperator(rig.daemon, clock), clock, limit=40)
            await clock.sleep(0.5)
        return lap, rig.truth.array()

    return run_virtual(main, start=SECOND)


def wall(seconds: float = 9.0) -> tuple[np.ndarray, bool]:
    """Return the poses of the robot with sonars, and whether it followed the wall to the end."""

    async def main(clock: VirtualClock) -> tuple[np.ndarray, bool]:
        start = {"x": -1.0, "y": WALL - 0.35, "yaw": 0.0}
        rig = VirtualRig(config("sonar", start=start, sonar={"model": "beam"}), clock)
        with rig.daemon.bus.subscribe(topics.BEHAVIOUR, fifo(4096)) as states:
            async with rig.running():
                operator = LocalOperator(rig.daemon, clock)
                await clock.sleep(2.0)
                await operator.arm()
                order = {"order": BehaviourOrder.START, "behaviour": "wall_left"}
                await operator.call("behave", {**await operator.header(), **order})
                await clock.sleep(seconds)
                truth = rig.truth.array()
            last = [*states.drain()][-1]
        return truth, last.running or last.outcome is Reason.SHUTDOWN

    return run_virtual(main, start=SECOND)


def robots() -> dict[str, float]:
    """Return how many robots complete the bend without contact, their errors, and the wall follower's distance."""
    figures: dict[str, float] = {}
    reached, worst = 0, 0.0
    for name in BODIES:
        lap, truth = bend(name)
        off = dist(truth[-1, 1:3], END)
        figures |= {f"robots_{name}_cross_track_cm": lap.cross_track_rms * 100, f"robots_{name}_end_cm": off * 100}
        reached += lap.outcome is Reason.GOAL_REACHED and not truth[:, 5].any()
        worst = max(worst, lap.cross_track_rms * 100)
        print(f"{name}: {lap.outcome.name}, cross-track {lap.cross_track_rms * 100:.2f} cm", flush=True)
    truth, followed = wall()
    apart = WALL - ASIDE - truth[-40:, 2]
    return figures | {
        "robots_reached": reached / len(BODIES),
        "robots_cross_track_cm": worst,
        "robots_wall_followed": float(followed and not truth[:, 5].any()),
        "robots_wall_m": float(truth[-1, 1] - truth[0, 1]),
        "robots_wall_error_cm": float(abs(apart.mean() - DISTANCE)) * 100,
    }


if __name__ == "__main__":
    for _name, _value in robots().items():
        print(f"{_name:36} {_value:.4g}")
