"""Several robots in one world, their daemons on one virtual clock."""

from collections.abc import AsyncIterator, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from functools import partial

from monstertruck_runtime.clock import VirtualClock
from monstertruck_schemas.topics import POSE
from monstertruck_sim.world.scene import Surroundings
from monstertruckd.tools.simulation.config import SimulatedTruckConfig
from monstertruckd.tools.simulation.fleet import as_fleet, shared_scene
from monstertruckd.tools.simulation.virtual_rig import VirtualRig


@asynccontextmanager
async def virtual_fleet(
    configs: Sequence[SimulatedTruckConfig], clock: VirtualClock
) -> AsyncIterator[tuple[list[VirtualRig], Surroundings]]:
    """Several robots in one world, their daemons on one virtual clock; the world of the first one.

    Raises:
        InputError: two robots claim the same thing, or overlap.
    """
    configs = as_fleet(configs)
    scene = shared_scene(configs)
    async with AsyncExitStack() as stack:
        rigs = [await stack.enter_async_context(VirtualRig(config, clock, scene=scene).running()) for config in configs]
        for rig in rigs:
            for other in rigs:
                if rig.daemon.peers is not None and other.config.robot in rig.config.peers:
                    other.bus.listen(POSE, partial(rig.daemon.peers.hear, other.config.robot))
        yield rigs, scene
