"""Route deformation: passes every scan to the deforming step and its answers to the goal service."""

from collections.abc import Callable
from typing import Final

from monstertruck_kinematics.se2 import Pose2, integrate
from monstertruck_planners.goals.exchange import (
    DeformAnswer,
    DeformTask,
    Finding,
    RouteAnswer,
    Setup,
    level,
    pose_of,
    twist_of,
)
from monstertruck_planners.pose_path import PosePath
from monstertruck_planners.zones.shapes import changed
from monstertruck_runtime.actors.actor import Actor
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import WorkerError
from monstertruck_runtime.mailbox import Mailbox
from monstertruck_runtime.ports import EventSink, Subscription
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.roles import ServiceName
from monstertruck_schemas.sensor import LaserScan
from monstertruck_schemas.state import Grid, Odometry
from monstertruck_schemas.topics import ODOMETRY
from monstertruck_schemas.zones import Zones

DEFORM_RETRY: Final = 10.0
"""Delay until a deforming step that did not start is started again (s)."""


class RouteDeformation:
    """Keeps the current route and the last answer of the deforming step.

    Args:
        setup: settings and truck data.
        clock: time source.
        actor: runs the deforming step.
        scan: mailbox of all scans.
        pose: pose of the truck in the frame of the routes.
        grid: map; None for the configured map.
        zones: zones of the map; None without zones.
        odometry: pose of the truck in the odometry frame; None if ``pose`` is in that frame.
        events: event sink.
    """

    name = ServiceName.GOALS.value

    def __init__(
        self,
        setup: Setup,
        clock: Clock,
        actor: Actor,
        *,
        scan: Mailbox[LaserScan],
        pose: Subscription[Odometry],
        grid: Subscription[Grid] | None,
        events: EventSink,
        zones: Subscription[Zones] | None = None,
        odometry: Subscription[Odometry] | None = None,
    ) -> None:
        self._setup, self._local, self._clock, self._actor = setup, setup.config.local, clock, actor
        self._scan, self._pose, self._grid, self._events = scan, pose, grid, events
        self._zones, self._odometry = zones, odometry
        self._fresh = True
        self._sent_grid: Grid | None = None
        self._sent_zones: Zones | None = None
        self._number = 0
        self._route: RouteAnswer | None = None
        self._sent_route = 0
        self._answer: DeformAnswer | None = None
        self._since = 0
        """Time when an obstacle began to block the route (ns)."""
        self._furthest = 0.0
        self._onward = 0
        """Time of the last progress along the route (ns)."""

    async def run(self, report: Callable[[Finding, DeformAnswer], None]) -> None:
        """Pass every scan on until cancelled; while one is processed, newer ones replace each other.

        Args:
            report: called with the previous finding and the answer.
        """
        async with self._actor as actor:
            await self._started(actor)
            self._fresh = True
            while True:
                task = self._task(await self._scan.next())
                if task is None:
                    continue
                try:
                    answer: DeformAnswer = await actor.step(task)
                except WorkerError as error:
                    self._fresh = True
                    self._events(error.reason, Severity.ERROR, self.name, str(error))
                    continue
                if self._route is not None and answer.number == self._number:
                    was = self._finding
                    self._note(answer)
                    report(was, answer)

    async def _started(self, actor: Actor) -> None:
        """Start the deforming step; until then routes are driven as planned, and replanned if blocked."""
        while True:
            try:
                await actor.start()
            except WorkerError as error:
                self._events(error.reason, Severity.ERROR, self.name, f"routes are not deformed: {error}")
                await self._clock.sleep(DEFORM_RETRY)
            else:
                return

    def begin(self, route: RouteAnswer) -> None:
        """Start driving a new route."""
        self._number += 1
        self._route, self._answer = route, None
        self._furthest, self._onward = 0.0, self._clock.now()

    def end(self) -> None:
        """Stop driving the route."""
        self._route = self._answer = None

    @property
    def _finding(self) -> Finding:
        return "idle" if self._answer is None else self._answer.finding

    @property
    def deformed(self) -> bool:
        """Whether the driven path differs from the route."""
        return self._finding not in ("idle", "free")

    @property
    def active(self) -> bool:
        """Whether the deformation decides which path is driven along the current route."""
        return self._answer is not None

    @property
    def complete(self) -> bool:
        """Whether the driven path leads to the end of the route."""
        return self._answer is None or self._answer.complete

    @property
    def held_up(self) -> bool:
        """Whether there is currently no path round the obstacle."""
        return self._finding == "blocked"

    @property
    def yields(self) -> bool:
        """Whether the truck lets a person pass."""
        return self._finding == "yields"

    def blocked(self, now: int) -> bool:
        """Whether the route is blocked: no path round the obstacle for some time, or a detour that takes too long."""
        return (self.held_up and now - self._since > self._local.blocked_timeout * SECOND) or (
            self.deformed and now - self._onward > self._local.detour * SECOND
        )

    @property
    def left(self) -> float:
        """Remaining length of the route (m); 0 without a route."""
        if self._answer is None:
            return 0.0
        travelled = self._path.travelled
        return float(travelled[-1] - travelled[self._answer.place])

    @property
    def rest(self) -> PosePath:
        """Remaining route from the truck."""
        assert self._answer is not None
        count = len(self._path.poses)
        return self._path.part(min(self._answer.place, count - 2), count)

    @property
    def _path(self) -> PosePath:
        assert self._route is not None
        assert self._route.path is not None
        return self._route.path

    def _task(self, scan: LaserScan) -> DeformTask | None:
        odometry = self._pose.latest
        if not level(scan, self._setup.config):
            return None
        if odometry is None or self._clock.now() - odometry.received > ODOMETRY.fresh_for() * SECOND:
            return None
        grid = None if self._grid is None else self._grid.latest
        zones = None if self._zones is None else self._zones.latest
        route = None
        if self._route is not None and (self._fresh or self._sent_route != self._number):
            route, self._sent_route = self._path, self._number
        task = DeformTask(
            scan,
            pose_of(odometry),
            setup=self._setup if self._fresh else None,
            grid=grid if self._fresh or grid is not self._sent_grid else None,
            route=route,
            number=self._number,
            drivable=self._route is None or self._route.drivable,
            deviation=odometry.position_deviation,
            stamp=odometry.stamp,
            twist=twist_of(odometry),
            zones=zones if self._fresh else changed(zones, self._sent_zones),
            odometry=self._in_odometry(odometry),
        )
        self._fresh, self._sent_grid, self._sent_zones = False, grid, zones
        return task

    def _in_odometry(self, pose: Odometry) -> Pose2 | None:
        """Return the pose of the base in the odometry frame when it had ``pose``."""
        latest = None if self._odometry is None else self._odometry.latest
        if latest is None:
            return None
        return integrate(pose_of(latest), *twist_of(latest), (pose.stamp - latest.stamp) / SECOND)

    def _note(self, answer: DeformAnswer) -> None:
        now = self._clock.now()
        if answer.finding == "blocked" and not self.held_up:
            self._since = now
        along = float(self._path.travelled[answer.place])
        if answer.finding == "free" or along > self._furthest + 0.05:  # minimum progress along the route (m)
            self._furthest, self._onward = max(along, self._furthest), now
        self._answer = answer


def event_of(was: Finding, answer: DeformAnswer) -> tuple[Reason, Severity, str] | None:
    """Return reason, severity and text of the event for a changed finding; None if unchanged."""
    text = answer.text or answer.reason.text
    match answer.finding:
        case "blocked" if was != "blocked":
            return answer.reason, Severity.WARNING, f"no way round the obstacle on the route ({text})"
        case "yields" if was != "yields":
            return Reason.YIELDS, Severity.INFO, Reason.YIELDS.text
        case "new" if was in ("idle", "free", "blocked", "yields"):
            partly = answer.reason is Reason.PATH_PARTIAL
            how = f"only so far ({text})" if partly else "round the obstacle on it"
            return Reason.ROUTE_DEFORMED, Severity.INFO, f"the route is deformed, {how}"
        case "free" if was not in ("idle", "free"):
            return Reason.ROUTE_FREE, Severity.INFO, "back on the route"
    return None
