"""Dock check: permits a slow approach to a dock while a behaviour docks or undocks.

The gate knows the docks of the configuration: positions, housings and staging distances. The behaviour reports the
exact pose of a dock in ``plan/behaviour``; the gate accepts the pose only within these bounds:

- the behaviour is running and has control, and its report is fresh;
- the robot is localised on the map, and the dock is within 0.3 m and 0.3 rad of its pose there;
- the robot is on the axis of the dock: at most ``docking.across`` to either side, at most ``docking.turn`` off in
  heading, not further out than the staging pose, and no more than ``docking.beyond`` past the docked pose. A robot that
  docks in reverse first faces the dock, and then backs off to turn around: either end may face the dock, up to
  ``turning`` beyond the staging pose.

Within these bounds the pace is at most ``docking.speed``, lidar returns inside the housing are ignored, and the
corridor counts as seen ground. All other rules stay in force, and contact is detected as for an operator on unseen
ground.
"""

import math
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import between, compose, interpolate
from monstertruck_planners.behave.dock.config import DockConfig
from monstertruck_planners.behave.dock.estimate import facing
from monstertruck_planners.goals.exchange import placeless
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.base import Message
from monstertruck_schemas.health import SlamHealth
from monstertruck_schemas.plan import BehaviourState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.roles import ServiceName
from monstertruck_schemas.state import Odometry
from monstertruck_schemas.topics import BEHAVIOUR, ODOMETRY, POSE, SLAM, Topic
from monstertruckd.gate.checks import Check, DockArea, GateView, PaceLimit, Tick
from monstertruckd.gate.motion import Course

FRESH: Final = SECOND
"""Maximum age of a behaviour's report (ns); a running one reports at 5 Hz."""


class DockCheck(Check):
    """Finds the dock area near the robot, and limits the speed there."""

    reasons = (Reason.DOCKING,)
    reads = (ODOMETRY, BEHAVIOUR, POSE, SLAM)

    def __init__(self, view: GateView, docks: Mapping[str, DockConfig]) -> None:
        super().__init__(view)
        self._docks = docks
        self._behaviour: BehaviourState | None = None
        self._trail: deque[Odometry] = deque(maxlen=64)  # odometry kept, more than 1 s: the age of a fresh scan
        self._located: Odometry | None = None
        """Latest pose in map."""
        self._slam: SlamHealth | None = None

    def observe(self, seen: Message | Tick, topic: Topic[Any] | None) -> None:
        """Process reports from behaviours and odometry; at a tick, find the area."""
        if isinstance(seen, Tick):
            self.view.dock = self._area(seen.now)
        elif isinstance(seen, BehaviourState):
            self._behaviour = seen
        elif isinstance(seen, SlamHealth):
            self._slam = seen
        elif isinstance(seen, Odometry) and topic is ODOMETRY:
            self._trail.append(seen)
        elif isinstance(seen, Odometry) and topic is POSE:
            self._located = seen

    def _area(self, now: int) -> DockArea | None:
        behaviour, scan = self._behaviour, self.view.samples.scans[0]
        if behaviour is None or not behaviour.running or behaviour.dock is None or not self._trail or scan is None:
            return None
        odometry = self._trail[-1]
        dock = self._docks.get(behaviour.dock.name)
        late = now - behaviour.received > FRESH or now - odometry.received > ODOMETRY.fresh_for() * SECOND
        if dock is None or late or self.view.planner != ServiceName.BEHAVIOURS.value:
            return None
        limits, pose = self.view.config.docking, behaviour.dock.pose
        at_dock = np.array((pose.x, pose.y, pose.yaw))
        here = _base(odometry)
        place = self._place(now)
        if place is None or not _agree(compose(place, between(here, at_dock)), dock):
            return None
        x, y, turn = between(at_dock, facing(here, dock)).tolist()
        far = dock.staging
        if dock.direction == "reverse":
            turn, far = math.remainder(turn, math.pi), far + dock.turning
        # The staging pose is reached within the tolerance of a goal.
        inside = -far - limits.across <= x <= limits.beyond
        if not inside or abs(y) > limits.across or abs(turn) > limits.turn:
            return None
        # A scan shows the dock from the robot's pose at its stamp.
        stamps = np.array([sample.stamp for sample in self._trail])
        poses = np.array([_base(sample) for sample in self._trail])
        there = interpolate(stamps, poses, np.array([min(scan.stamp, scan.received)]))[0]
        at_x, at_y, yaw = between(there, at_dock).tolist()
        body = self.view.footprint
        end = body.length / 2
        side = limits.across + body.half_length * math.sin(limits.turn) + body.half_width * math.cos(limits.turn)
        # Past ``beyond`` there is no area. 0.03: noise of lidar returns in front of the housing, m
        box = dock.housing
        housing = None if box is None else (end - 0.03, end + box.depth, box.width / 2)
        return DockArea((at_x, at_y, yaw), (-far - limits.across - end, math.inf, side), housing)

    def _place(self, now: int) -> Array | None:
        """Return the base pose in the map, shape (3,); None if the pose is old or unknown."""
        located = self._located
        if located is None or now - located.received > POSE.fresh_for() * SECOND or placeless(self._slam):
            return None
        return _base(located)

    def limit(self, now: int, courses: Sequence[Course] | None) -> Iterator[PaceLimit]:
        """Limit the pace near the dock."""
        if courses and self.view.dock is not None:
            speed = self.view.config.docking.speed
            if speed < max(pace for _, pace in courses):
                yield PaceLimit(Reason.DOCKING, speed)


def _agree(reported: Array, dock: DockConfig) -> bool:
    """Return whether a reported dock pose in the map agrees with the configured pose."""
    x, y, turn = between(facing(np.array((dock.x, dock.y, dock.yaw)), dock), reported).tolist()
    off = 0.3  # m and rad: errors of the localisation and of the configured pose
    return math.hypot(x, y) <= off and abs(turn) <= off


def _base(odometry: Odometry) -> Array:
    return np.array((odometry.pose.x, odometry.pose.y, odometry.pose.yaw))
