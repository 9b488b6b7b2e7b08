"""Fence check: keeps the outline of the robot inside a polygon of the map."""

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from monstertruck_kinematics.se2 import placed
from monstertruck_planners.collision import UnitTwist, swept_poses
from monstertruck_planners.zones.shapes import inside
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.base import Message
from monstertruck_schemas.event import Measurement
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.state import Odometry
from monstertruck_schemas.topics import POSE, Topic
from monstertruckd.gate.approach import comfortable_speed, reach
from monstertruckd.gate.catalog import FenceConfig
from monstertruckd.gate.checks import Check, GateView, PaceLimit, Tick
from monstertruckd.gate.motion import Course
from monstertruckd.gate.obstacles import OUTLINE, at_poses


class FenceCheck(Check):
    """Stops the robot before more of its outline leaves the fence; a robot that is outside may return.

    Args:
        config: the fence.
        view: read access to the gate's state.
    """

    reasons = (Reason.OWN_CHECK,)
    reads = (POSE,)

    def __init__(self, config: FenceConfig, view: GateView) -> None:
        super().__init__(view)
        self._corners = np.array(config.corners)
        self._edges = view.footprint.edge_points(OUTLINE, OUTLINE)
        self._pose: Odometry | None = None
        self._free: float | None = None

    def observe(self, seen: Message | Tick, topic: Topic[Any] | None) -> None:
        """Process the latest pose in the map."""
        if isinstance(seen, Odometry) and topic is POSE:
            self._pose = seen

    def limit(self, now: int, courses: Sequence[Course] | None) -> Iterator[PaceLimit]:
        """Slow down towards the fence; keep the robot at rest without a fresh pose."""
        if not courses:
            return
        age = math.inf if self._pose is None else (now - self._pose.stamp) / SECOND
        if age > 0.5:  # maximum age of a pose, s
            self._free = None
            yield PaceLimit(Reason.OWN_CHECK, 0.0)
            return
        config = self.view.config
        delay = age + config.reaction
        free = min(self._distance(twist, reach(config, delay)) for twist, _ in courses)
        self._free = free
        allowed = comfortable_speed(free - config.obstacle.ahead, delay, config.obstacle.deceleration)
        if allowed < max(pace for _, pace in courses):
            yield PaceLimit(Reason.OWN_CHECK, allowed if allowed >= config.obstacle.crawl else 0.0)

    def _distance(self, twist: UnitTwist, far: float) -> float:
        """Distance along a motion (m) until more of the outline is outside than now; +inf beyond ``far``."""
        assert self._pose is not None
        pose = self._pose.pose
        step = 0.02  # distance between the poses of a sweep, m
        distances = np.arange(0.0, far + step, step)
        poses = placed(swept_poses(twist, distances), (pose.x, pose.y, pose.yaw))
        outside = (~inside(at_poses(self._edges, poses), self._corners)).sum(axis=1)
        (further,) = (outside > outside[0]).nonzero()
        return float(distances[further[0] - 1]) if len(further) else math.inf

    def text(self, reason: Reason) -> str:
        """Text for a fence ahead, or for the lack of a fresh pose."""
        return "the fence is ahead" if self._free is not None else "no fresh pose to check against the fence"

    def figures(self, reason: Reason, now: int) -> Iterator[Measurement]:
        """Distance to the fence."""
        if self._free is not None and math.isfinite(self._free):
            limit = self.view.config.obstacle.ahead
            yield Measurement(name="distance to the fence", value=self._free, unit="m", limit=limit)
