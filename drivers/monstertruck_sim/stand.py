"""Test stand in the simulated world: observes the robot from outside, with the noise of a camera above the table."""

import math
from collections.abc import Callable

from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.sensor import StandPose
from monstertruck_sim.config import StandConfig
from monstertruck_sim.world.noise import STAND, WhiteNoise
from monstertruck_sim.world.world import World


class SimulatedStand:
    """Observes the robot at a constant rate.

    Args:
        config: rate and noise.
        world: world with the robot.
        clock: time.
        put: called with every pose.
        seed: noise seed; None for no noise.
    """

    def __init__(
        self, config: StandConfig, world: World, clock: Clock, put: Callable[[StandPose], None], seed: int | None
    ) -> None:
        self._config, self._world, self._clock, self._put = config, world, clock, put
        self._noise = None if seed is None else WhiteNoise(seed, STAND, 3)
        self._count = 0

    async def run(self) -> None:
        """Observe until cancelled."""
        due = self._clock.now()
        while True:
            self._put(self.look())
            due += round(SECOND / self._config.rate)
            await self._clock.sleep_until(due)

    def look(self) -> StandPose:
        """Return the current pose."""
        now, config = self._clock.now(), self._config
        truth = self._world.truth(now)
        x, y, turn = (0.0, 0.0, 0.0) if self._noise is None else self._noise.at(self._count)
        self._count += 1
        yaw = math.remainder(truth.yaw + turn * config.heading_noise, math.tau)
        return StandPose(
            stamp=now,
            received=now,
            seq=self._count,
            frame="map",
            pose=Pose2D(x=truth.x + x * config.position_noise, y=truth.y + y * config.position_noise, yaw=yaw),
            observer="simulator",
            position_sigma=config.position_noise,
            heading_sigma=config.heading_noise,
        )
