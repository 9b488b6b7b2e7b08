"""What a skid-steer robot does besides what its model says: unequal wheels, a turn at each reversal, a slow slide.

The skid-steer paper saw all three: its robot bent within a pass though its motors were commanded alike, turned a little
whenever it reversed, and its circles wandered. Body parameters (turning centres, effective radii) are the body's own.
"""

from math import copysign, cos, sin

from monstertruck_kinematics.se2 import Twist2
from monstertruck_sim.world.config import SkidModelConfig
from monstertruck_sim.world.noise import SKID, generator


class SkidEffects:
    """Hidden truth of one robot; every draw is a function of seed and number of the reversal.

    Args:
        config: its parameters.
        seed: None = every reversal turns by the mean.
    """

    def __init__(self, config: SkidModelConfig, seed: int | None) -> None:
        self._config = config
        self._seed = seed
        self._direction = 0.0
        self._reversals = 0
        self._rate = 0.0
        self._left = 0.0
        """Seconds for which it still turns."""

    def wheel_speeds(self, speeds: list[float]) -> list[float]:
        """What of each wheel's speed reaches the ground, m/s."""
        gains = self._config.wheel_gains
        return [speed * gain for speed, gain in zip(speeds, gains, strict=True)] if gains else speeds

    def twist(self, twist: Twist2, yaw: float, dt: float) -> Twist2:
        """Velocity of the body, from what its wheels make of it; m/s, rad/s."""
        vx, vy, wz = twist
        turning_time = 0.2  # seconds that the turn at a reversal takes
        if abs(vx) > 1e-3:  # slower robots stand, m/s
            direction = copysign(1.0, vx)
            if direction == -self._direction:
                self._rate, self._left = self._turn() / turning_time, turning_time
                self._reversals += 1
            self._direction = direction
            x, y = self._config.drift_x, self._config.drift_y
            vx, vy = vx + x * cos(yaw) + y * sin(yaw), vy - x * sin(yaw) + y * cos(yaw)
        if self._left > 0.0:
            wz += self._rate * min(dt, self._left) / dt
            self._left -= dt
        return vx, vy, wz

    def _turn(self) -> float:
        config = self._config
        if self._seed is None:
            return config.reversal_turn
        drawn = float(generator(self._seed, SKID, self._reversals).standard_normal())
        return config.reversal_turn + config.reversal_spread * drawn
