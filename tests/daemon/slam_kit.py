"""A truck that maps or localises on the virtual clock: what it said, and what was true."""

from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import distance_transform_edt

from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.mailbox import fifo
from monstertruck_runtime.map_files import OCCUPIED
from monstertruck_schemas import topics
from monstertruck_schemas.event import Event
from monstertruck_schemas.health import SlamHealth
from monstertruck_schemas.state import Grid, Odometry
from monstertruck_schemas.topics import Topic
from monstertruck_sim.world.built_in import BUILT_IN
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

CONFIGS = Path(__file__).resolve().parents[2] / "configs"


@dataclass(frozen=True)
class Drive:
    """One drive."""

    said: dict[str, list[Any]]
    """Messages by their topic's name."""
    truth: np.ndarray
    """Shape (n, 6): ``TruthLog.COLUMNS``."""

    @property
    def poses(self) -> list[Odometry]:
        """In map."""
        return self.said[topics.POSE.name]

    @property
    def health(self) -> list[SlamHealth]:
        """Of the mapping, or localisation."""
        return self.said[topics.SLAM.name]

    @property
    def events(self) -> list[Event]:
        """All."""
        return self.said[topics.EVENT.name]

    def off(self, after: float = 0.0) -> np.ndarray:
        """Distances, m, of the poses after that many seconds from the true ones, shape (n,)."""
        poses = [pose for pose in self.poses if pose.stamp / SECOND > after]
        stamps = np.array([pose.stamp for pose in poses]) / SECOND
        x, y = (np.interp(stamps, self.truth[:, 0], self.truth[:, k]) for k in (1, 2))
        return np.hypot([pose.pose.x for pose in poses] - x, [pose.pose.y for pose in poses] - y)


Scenario = Callable[[VirtualRig], Awaitable[None]]


def lap(seconds: float) -> Scenario:
    """The truck is armed and follows its path for some seconds."""

    async def story(rig: VirtualRig) -> None:
        await LocalOperator(rig.daemon, rig.clock).arm()
        await rig.clock.sleep(seconds)

    return story


def driven(base: str, story: Scenario, *more: Topic[Any], **overlay: Any) -> Drive:
    """Let ``story`` happen to the truck of a configuration with an overlay; ``more`` topics are listened to."""
    config = load_config(CONFIGS / base, SimulatedTruckConfig)[0]
    config = with_overlay(config, {"recorder": None, "map": None, **overlay})

    async def main(clock: VirtualClock) -> Drive:
        rig = VirtualRig(config, clock)
        listened = (topics.POSE, topics.SLAM, topics.EVENT, *more)
        boxes = {topic.name: rig.bus.subscribe(topic, fifo(20_000)) for topic in listened}
        async with rig.running():
            await clock.sleep(1.5)
            await story(rig)
        return Drive({name: box.drain() for name, box in boxes.items()}, rig.truth.array())

    return run_virtual(main, start=SECOND)


def share_beside_walls(grid: Grid, world: str) -> float:
    """Share of the occupied cells of a grid that are more than 0.12 m from what is occupied in a built-in world."""
    rows, columns = np.nonzero(grid.cells.reshape(grid.height, grid.width) >= 65)
    assert len(rows) > 300
    x, y = (grid.origin.x + (columns + 0.5) * grid.resolution, grid.origin.y + (rows + 0.5) * grid.resolution)
    true = BUILT_IN[world]().map
    far = distance_transform_edt(true.cells != OCCUPIED) * true.resolution
    at = ((y - true.origin[1]) / true.resolution).astype(int), ((x - true.origin[0]) / true.resolution).astype(int)
    inside = (at[0] >= 0) & (at[0] < far.shape[0]) & (at[1] >= 0) & (at[1] < far.shape[1])
    wrong = far[np.clip(at[0], 0, far.shape[0] - 1), np.clip(at[1], 0, far.shape[1] - 1)] > 0.12
    return float((~inside | wrong).mean())
