"""Published pose of odom in map: it approaches corrections at a limited rate."""

import math

import numpy as np

from monstertruck_kinematics.se2 import Pose2, between, compose, inverse


class SmoothedCorrection:
    """Apply corrections gradually at the robot's place; at the origin of odom, a turn would make a distant robot jump.

    Args:
        slew: maximum rate of the change (m/s, rad/s).
        jump: minimum correction of the robot's place that applies at once (m).
        settle: time constant of the approach for smaller corrections (s); 0 for none. Scans are deskewed with these
            poses, so a correction must not look like motion.
    """

    def __init__(self, slew: tuple[float, float], jump: float, settle: float = 0.0) -> None:
        self._slew = slew
        self._settle = settle
        self._jump = jump
        self._target = np.zeros(3)
        self._shown = np.zeros(3)

    @property
    def value(self) -> Pose2:
        """Pose of odom in map (m, rad)."""
        x, y, yaw = self._shown.tolist()
        return x, y, yaw

    def set_target(self, map_from_odom: Pose2, *, at_once: bool = False) -> None:
        """Set a new correction; ``at_once`` applies it without a transition."""
        self._target = np.array(map_from_odom)
        if at_once:
            self._shown = self._target.copy()

    def pose(self, odom: Pose2, dt: float) -> Pose2:
        """Return the pose of base in map for a pose in odom, ``dt`` seconds after the last call."""
        base = np.array(odom)
        now, then = compose(self._shown, base), compose(self._target, base)
        off = between(now, then)
        way, turn = math.hypot(off[0], off[1]), abs(float(off[2]))
        share = min(self._slew[0] * dt / max(way, 1e-12), self._slew[1] * dt / max(turn, 1e-12))
        if self._settle > 0:
            share = min(share, -math.expm1(-dt / self._settle))
        if way > self._jump or share >= 1.0:
            now, self._shown = then, self._target.copy()
        else:
            now = compose(now, off * share)
            self._shown = compose(now, inverse(base))
        x, y, yaw = now.tolist()
        return x, y, yaw
