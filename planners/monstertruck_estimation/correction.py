"""Odom in map as published, which approaches corrections at a limited rate."""

import math

import numpy as np

from monstertruck_kinematics.se2 import Pose2, between, compose, inverse


class SmoothedCorrection:
    """Follows corrections at the robot's place, not at the origin of odom: a turn about a far origin would be a jump.

    Args:
        slew: greatest speed of the change, m/s and rad/s.
        jump: corrections of the robot's place beyond this, m, apply at once.
        settle: time constant of the approach within that, s; 0 for none. Scans are deskewed by these poses: a
            correction must not look like motion.
    """

    def __init__(self, slew: tuple[float, float], jump: float, settle: float = 0.0) -> None:
        self._slew = slew
        self._settle = settle
        self._jump = jump
        self._target = np.zeros(3)
        self._shown = np.zeros(3)

    @property
    def value(self) -> Pose2:
        """Odom in map, m and rad."""
        x, y, yaw = self._shown.tolist()
        return x, y, yaw

    def set_target(self, map_from_odom: Pose2, *, at_once: bool = False) -> None:
        """Take a new correction; ``at_once``: apply it without a transition."""
        self._target = np.array(map_from_odom)
        if at_once:
            self._shown = self._target.copy()

    def pose(self, odom: Pose2, dt: float) -> Pose2:
        """Base in map for base in odom, ``dt`` seconds after the last call."""
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
