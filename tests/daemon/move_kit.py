"""A robot of configs/robots in the middle of the yard, moved by ``move``; the world says where it went."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import RequestRefusedError
from monstertruck_runtime.mailbox import fifo, latest
from monstertruck_schemas import topics
from monstertruck_schemas.plan import BehaviourState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import BehaviourOrder
from monstertruck_schemas.state import GateState, Odometry
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

FOLDER = Path(__file__).resolve().parents[2] / "configs" / "robots"
START = (-0.5, 0.3, 0.4)
"""x, y, yaw in the yard; m, m, rad."""


@dataclass
class Moved:
    """What became of one move."""

    refused: RequestRefusedError | None = None
    states: tuple[BehaviourState, ...] = ()
    gates: tuple[GateState, ...] = ()
    truth: np.ndarray = None  # type: ignore[assignment]
    """Rows of ``TruthLog.COLUMNS`` from before the move until it stands."""
    odometry: Odometry | None = None

    @property
    def end(self) -> BehaviourState:
        """The last report."""
        return self.states[-1]

    @property
    def moved(self) -> tuple[float, float, float]:
        """Forward, sideways (m) and turned (rad, counted), in the robot's frame at the start."""
        (x0, y0, yaw0), (x, y) = self.truth[0, 1:4], self.truth[-1, 1:3]
        c, s = math.cos(yaw0), math.sin(yaw0)
        turned = float(np.unwrap(self.truth[:, 3])[-1] - yaw0)
        return c * (x - x0) + s * (y - y0), c * (y - y0) - s * (x - x0), turned

    @property
    def drift(self) -> tuple[float, float]:
        """How far odometry is from the truth at the end: m, rad."""
        assert self.odometry is not None
        pose, (x, y, yaw) = self.odometry.pose, self.truth[-1, 1:4]
        return math.dist((pose.x, pose.y), (x, y)), abs(math.remainder(pose.yaw - yaw, math.tau))


def in_yard(name: str, **overlay: Any) -> SimulatedTruckConfig:
    """A robot of configs/robots without tracker, in the middle of the yard, whose ground counts as free unseen."""
    config, _ = load_config(FOLDER / f"{name}.yaml", SimulatedTruckConfig)
    config = config.model_copy(update={"recorder": None, "tracker": None, "path": None})
    x, y, yaw = START
    start = {"x": x, "y": y, "yaw": yaw}
    here = {
        "odometry": {"start": start},
        "sim": {"world": {"map": "yard", "start": start}},
        "gate": {"obstacle": {"unseen": "slow"}},
    }
    return with_overlay(with_overlay(config, here), overlay)


def drive_move(name: str, *, limit: float = 60.0, overlay: dict[str, Any] | None = None, **settings: Any) -> Moved:
    """Drive one move to its end."""
    config = in_yard(name, **(overlay or {}))

    async def main(clock: VirtualClock) -> Moved:
        rig = VirtualRig(config, clock)
        bus = rig.bus
        with (
            bus.subscribe(topics.BEHAVIOUR, fifo(4096)) as states,
            bus.subscribe(topics.GATE, fifo(4096)) as gates,
            bus.subscribe(topics.ODOMETRY, latest()) as odometry,
        ):
            async with rig.running():
                operator = LocalOperator(rig.daemon, clock)
                await clock.sleep(2.0)
                begin = len(rig.truth.array()) - 1
                await operator.arm()
                order = {"order": BehaviourOrder.START, "behaviour": "move", "settings": settings}
                refused, seen = None, []
                try:
                    await operator.call("behave", {**await operator.header(), **order})
                except RequestRefusedError as error:
                    refused = error
                else:
                    async with clock.deadline(limit):
                        async for state in states:
                            seen.append(state)
                            if state.number and not state.running:
                                break
                await clock.sleep(1.0)
                truth = rig.truth.array()[begin:]
            return Moved(refused, tuple(seen), tuple(gates.drain()), truth, odometry.latest)

    return run_virtual(main, start=SECOND)


def arrived(moved: Moved) -> bool:
    """Whether it came to its end without touching anything."""
    assert moved.refused is None, moved.refused
    return moved.end.outcome is Reason.BEHAVIOUR_DONE and not moved.truth[:, 5].any()
