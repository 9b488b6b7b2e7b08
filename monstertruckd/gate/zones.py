"""Zone check: keeps the footprint out of keepout zones, and limits the speed in speed zones."""

import math
from collections.abc import Iterator, Sequence
from typing import Any, Final

import numpy as np

from monstertruck_kinematics.se2 import Pose2, points_relative
from monstertruck_planners.collision import UnitTwist, beyond, first_contact, swept_poses
from monstertruck_planners.goals.exchange import placeless, pose_of
from monstertruck_planners.zones.config import ZonesConfig
from monstertruck_planners.zones.shapes import Boundary, ZoneLayer
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.base import Message
from monstertruck_schemas.event import Measurement
from monstertruck_schemas.health import SlamHealth
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.state import Odometry
from monstertruck_schemas.topics import POSE, SLAM, ZONES, Topic
from monstertruck_schemas.zones import Zones
from monstertruckd.gate.approach import comfortable_speed, reach
from monstertruckd.gate.checks import Check, GateView, PaceLimit, Tick
from monstertruckd.gate.motion import Course
from monstertruckd.gate.obstacles import LEAVING

STEP: Final = 0.03
"""Distance between the poses of a sweep (m)."""
OLDEST: Final = 0.5
"""Maximum age of a pose (s)."""


def entry_speed(room: float, delay: float, deceleration: float, limit: float) -> float:
    """Maximum speed of a body that brakes after ``delay`` s and is down to ``limit`` within ``room`` metres, m/s."""
    lag = deceleration * delay
    return max(math.sqrt(lag**2 + limit**2 + 2 * deceleration * max(room, 0.0)) - lag, limit)


class ZoneCheck(Check):
    """Stops the robot before and inside keepout zones, and limits its speed in speed zones.

    Points on the boundaries of zones are treated like returns of the lidar: the swept footprint must not reach them.
    With zones, a robot without a known pose does not move; an operator can move it slowly with the second control.

    Args:
        config: settings of the zones.
        view: read access to the gate's state.
    """

    reasons = (Reason.KEEPOUT, Reason.ZONE_SLOW)
    reads = (POSE, SLAM, ZONES)

    def __init__(self, config: ZonesConfig, view: GateView) -> None:
        super().__init__(view)
        self._config = config
        self._zones: Zones | None = None
        self._layer: ZoneLayer | None = None
        self._slam: SlamHealth | None = None
        self._odometry: Odometry | None = None
        self._judged: tuple[Odometry, ZoneLayer] | None = None
        """Pose and zones of the next three values."""
        self._held: tuple[str, ...] = ()
        """Keepout zones around the robot's position."""
        self._left: tuple[int, ...] = ()
        """Index of each keepout zone that the robot is in and leaves."""
        self._slowest = math.inf
        """Lowest limit of the speed zones that the robot is in (m/s)."""
        self._ahead: float | None = None
        """Distance to a keepout zone ahead (m); None if none is near."""
        self._blocked = False
        """Whether a keepout zone ahead allows no motion."""
        self._unknown = ""
        """Reason why the zones cannot be checked."""

    def observe(self, seen: Message | Tick, topic: Topic[Any] | None) -> None:
        """Take poses, zones and the health of the localisation; at a tick, find the zones that the robot is in."""
        if isinstance(seen, Tick):
            self._judge(seen.now)
        elif isinstance(seen, Zones):
            self._zones = seen
        elif isinstance(seen, SlamHealth):
            self._slam = seen
        elif isinstance(seen, Odometry) and topic is POSE:
            self._odometry = seen

    def _judge(self, now: int) -> None:
        if self._zones is None:
            self._unknown = "the zones of the map are not known yet: see `monstertruckd status`"
            return
        zones = [zone for zone in self._zones.zones if zone.off_until is None or now >= zone.off_until]
        if self._layer is None or [shape.zone for shape in self._layer.shapes] != zones:
            self._layer = ZoneLayer(zones, self._layer)
        odometry, layer = self._odometry, self._layer
        self._unknown = self._lost(now) if zones else ""
        if odometry is None or self._unknown or not zones:
            self._judged, self._held, self._left, self._slowest = None, (), (), math.inf
        elif self._judged is None or self._judged[0] is not odometry or self._judged[1] is not layer:
            self._judged = odometry, layer
            footprint, pose = self.view.footprint, pose_of(odometry)
            reached = {shape.zone.name: limit for shape, limit in layer.reached(footprint, pose)}
            inside = [(i, shape.zone) for i, shape in enumerate(layer.shapes) if reached.get(shape.zone.name) == 0.0]
            self._held = tuple(zone.name for _, zone in inside if zone.inside == "stop")
            self._left = tuple(index for index, zone in inside if zone.inside == "leave")
            near = layer.reached(footprint, pose, self._config.margin)
            self._slowest = min((limit for _, limit in near if limit > 0.0), default=math.inf)

    def _lost(self, now: int) -> str:
        """Why the pose in map is not usable; empty if it is."""
        if self._odometry is None or now - self._odometry.stamp > OLDEST * SECOND:
            return "no fresh pose in the map, so zones cannot be checked"
        why = placeless(self._slam)
        return f"zones cannot be checked: {why}" if why else ""

    def reason(self, now: int) -> Iterator[Reason]:
        """Stop the robot inside a keepout zone."""
        if self._held:
            yield Reason.KEEPOUT

    def limit(self, now: int, courses: Sequence[Course] | None) -> Iterator[PaceLimit]:
        """Return the limits at the robot's position and ahead of it."""
        self._ahead = None
        if not courses:
            self._blocked = False
            return
        if self._unknown:
            slow = self.view.config.obstacle.confirmed_speed
            yield PaceLimit(Reason.KEEPOUT, slow if self.view.confirmed else 0.0)
        elif self._judged is not None:
            if self._left:
                yield PaceLimit(Reason.KEEPOUT, self._config.leave_speed)
            if math.isfinite(self._slowest):
                yield PaceLimit(Reason.ZONE_SLOW, self._slowest)
            yield from self._before(now, *self._judged, courses)

    def _before(self, now: int, odometry: Odometry, layer: ZoneLayer, courses: Sequence[Course]) -> Iterator[PaceLimit]:
        config, pose = self.view.config, pose_of(odometry)
        delay = max(now - odometry.stamp, 0) / SECOND + config.reaction
        far = reach(config, delay)
        around = far + self.view.footprint.circumscribed_radius + self._config.margin
        near = self._relative(layer.near(pose[:2], around), pose)
        if not len(near.points):
            self._blocked = False
            return
        fastest = max(pace for _, pace in courses)
        twists = {twist for twist, _ in courses}
        if self.view.samples.steering_fresh(now):
            twists.add(self.view.motion.along(courses[0][0], self.view.samples.angles))
        free, slow = math.inf, math.inf
        for twist in twists:
            ahead, entering = self._sweep(twist, near, far, delay)
            free, slow = min(free, ahead), min(slow, entering)
        self._ahead = free if math.isfinite(free) else None
        allowed = comfortable_speed(free - config.obstacle.ahead, delay, config.obstacle.deceleration)
        crawl = config.obstacle.crawl
        self._blocked = allowed < (2 * crawl if self._blocked else crawl)
        if self._blocked:
            yield PaceLimit(Reason.KEEPOUT, 0.0)
        elif allowed < fastest:
            yield PaceLimit(Reason.KEEPOUT, allowed)
        if slow < fastest:
            yield PaceLimit(Reason.ZONE_SLOW, slow)

    def _relative(self, near: Boundary, pose: Pose2) -> Boundary:
        """Boundaries in base, without the boundaries of zones that the robot leaves."""
        kept = near.of(~np.isin(near.zones, self._left))
        return kept._replace(points=points_relative(kept.points, pose))

    def _sweep(self, twist: UnitTwist, near: Boundary, far: float, delay: float) -> tuple[float, float]:
        """Distance to a keepout zone along a motion (m), and maximum speed before the speed zones on it (m/s)."""
        footprint, margin = self.view.footprint, self._config.margin
        distances = np.linspace(0.0, far, math.ceil(far / STEP * max(footprint.corner_speed(twist), 1.0)) + 1)
        poses = swept_poses(twist, distances)
        keepout = near.limits == 0.0
        contact = first_contact(footprint, poses, near.points[keepout], margin, LEAVING * distances)
        free = math.inf if contact is None else float(distances[contact - 1])
        slow, speed = math.inf, near.of(~keepout)
        if len(speed.points):
            x, y = beyond(footprint, poses, speed.points)
            touched = (x < margin) & (y < margin)
            reached = touched.any(axis=0)
            rooms = distances[np.maximum(touched.argmax(axis=0) - 1, 0)]
            deceleration = self.view.config.obstacle.deceleration
            for limit in np.unique(speed.limits[reached]).tolist():
                room = float(rooms[reached & (speed.limits == limit)].min())
                slow = min(slow, entry_speed(room, delay, deceleration, limit))
        return free, slow

    def text(self, reason: Reason) -> str:
        """The zone around the robot, the lack of a pose, or a zone ahead."""
        if reason is not Reason.KEEPOUT:
            return reason.text
        if self._held:
            first = self._held[0]
            return (
                f"in the keepout zone {', '.join(self._held)}: switch it off (`monstertruckd zone off "
                f"{first}`) to drive out"
            )
        if self._left:
            return "in a keepout zone; the robot drives out slowly"
        return self._unknown or "a keepout zone is ahead"

    def figures(self, reason: Reason, now: int) -> Iterator[Measurement]:
        """Distance to the keepout zone ahead."""
        if reason is Reason.KEEPOUT and self._ahead is not None:
            limit = self.view.config.obstacle.ahead
            yield Measurement(name="distance to the zone", value=self._ahead, unit="m", limit=limit)
