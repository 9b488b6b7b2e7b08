"""Goal service: passes requests and observations to the state machine and carries out its decisions."""

import asyncio
import math
from collections import deque
from typing import Any, Final

import numpy as np

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import Pose2, placed, points_placed, points_relative, poses_relative
from monstertruck_planners.collision import scan_points_at
from monstertruck_planners.goals import goal_run
from monstertruck_planners.goals.deformation import RouteDeformation, event_of
from monstertruck_planners.goals.exchange import (
    DeformAnswer,
    Finding,
    Place,
    PlanTask,
    RouteAnswer,
    SeenGround,
    SeenScan,
    Setup,
    level,
    placeless,
    pose_of,
    require_place,
    twist_of,
)
from monstertruck_planners.goals.goal_run import Action, Follow, GoalRun, Halt, Observations, Plan, Report
from monstertruck_planners.goals.path_publisher import (
    AT_REST,
    Followed,
    GoalInputs,
    GoalOutputs,
    PathPublisher,
    path_blocked,
    poses_ahead,
)
from monstertruck_planners.tasks import TaskServer
from monstertruck_planners.zones.shapes import ZoneLayer, changed, in_force
from monstertruck_runtime.actors.actor import Actor
from monstertruck_runtime.clock import SECOND, Clock, Schedule
from monstertruck_runtime.errors import RequestRefusedError, TruckError
from monstertruck_runtime.ports import Ready, RpcRegistry
from monstertruck_runtime.requests import parse_request
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.event import Severity
from monstertruck_schemas.plan import MAX_COORDINATE, GoalPhase, GoalState
from monstertruck_schemas.reasons import Reason, in_words
from monstertruck_schemas.req import GoalControl, GoalOrder, GoalRequest
from monstertruck_schemas.roles import ServiceName
from monstertruck_schemas.sensor import LaserScan
from monstertruck_schemas.state import GateMode, GateState, Grid, Ground, Odometry
from monstertruck_schemas.topics import ODOMETRY, SCAN
from monstertruck_schemas.zones import Zones

REPORT: Final = SECOND // 2
"""Report period without a change (ns)."""
CHANGES: Final = ("phase", "outcome", "number", "routes", "recoveries")
"""Report fields whose change triggers an immediate report."""
JUMP: Final = 0.5
"""Minimum distance between the poses of two ticks that is a jump (m); a jump drops the kept scans."""

Route = tuple[Pose2, tuple[Place, ...]]
"""Goal and its waypoints."""


class GoalService:
    """Drives to one goal at a time; a new goal replaces the current one and any path of another source.

    An emergency stop ends a goal; new goals are refused until its reset. While a route is planned and none is followed,
    the service requests standstill from the gate to keep the truck armed.

    Args:
        setup: configuration and truck data.
        clock: time source.
        actor: computes the routes.
        deceleration: deceleration of the tracker (m/s^2).
        max_age: see ``GateConfig.max_request_age``.
        inputs: input topics.
        outputs: output topics.
        deformation: local planning around obstacles; None to follow routes as planned.
    """

    name = ServiceName.GOALS.value
    noun = "goal"
    resumable = False

    def __init__(
        self,
        setup: Setup,
        clock: Clock,
        actor: Actor,
        *,
        deceleration: float,
        max_age: float,
        inputs: GoalInputs,
        outputs: GoalOutputs,
        deformation: RouteDeformation | None = None,
    ) -> None:
        self._setup, self._config, self._clock = setup, setup.config, clock
        self._in, self._out = inputs, outputs
        self._place, self._deformation = actor, deformation
        self.tasks = TaskServer[GoalRequest | GoalControl, Route, GoalState](
            self,
            clock,
            inputs.gate,
            max_age,
            outputs.state,
            changes=CHANGES,
            period=REPORT,
            others=() if inputs.behaviour is None else (inputs.behaviour,),
            replaces=True,
            drives=lambda _: True,
        )
        self._goal: GoalRun | None = None
        self._held: set[str] = set()
        self._paths = PathPublisher(clock, inputs, outputs, deceleration)
        self._planning: asyncio.Task[RouteAnswer] | None = None
        self._actor: Actor | None = None
        self._trouble: TruckError | None = None
        """Why the planner failed to start last time."""
        self._tasks: asyncio.TaskGroup | None = None
        self._fresh = True
        self._sent_grid: Grid | None = None
        self._sent_ground: Ground | None = None
        self._zones: Zones | None = None
        """Zones of the layer."""
        self._layer = ZoneLayer()
        self._sent_zones: Zones | None = None
        self._scanned: tuple[LaserScan, Odometry] | None = None
        self._points: Array = np.empty((0, 2))
        self._seen: deque[tuple[Pose2, Array]] = deque(maxlen=40)  # latest scans kept for the next plan
        """Poses and returns in base of scans since the last plan."""
        self._trail: deque[tuple[int, Pose2]] = deque()
        """Times (ns) and poses of recent ticks."""
        self._before: Pose2 | None = None

    async def run(self, ready: Ready) -> None:
        """Serve goals until cancelled.

        Raises:
            TruckError: the planner does not start; goals are refused until it does.
        """
        async with self._place as actor:
            try:
                await actor.start()
            except TruckError as error:
                self._trouble = error
                raise
            async with asyncio.TaskGroup() as tasks:
                self._actor, self._tasks, self._fresh, self._sent_grid = actor, tasks, True, None
                if self._deformation is not None:
                    tasks.create_task(self._deformation.run(self._on_deformed))
                self.tasks.report()
                ready()
                await self._serve()

    async def _serve(self) -> None:
        schedule = Schedule(self._clock, self._config.rate)
        while True:
            await schedule.next()
            self._take_requests()
            self._tick(self._clock.now())

    # Requests

    def _take_requests(self) -> None:
        """Carry out requests received by topic; report refusals as events."""
        requests: list[GoalRequest | GoalControl] = [*self._in.goals.drain(), *self._in.controls.drain()]
        for request in requests:
            try:
                self.tasks.take(request)
            except RequestRefusedError as error:
                name = request.order if isinstance(request, GoalControl) else self.noun
                self._out.events(error.refusal, Severity.WARNING, request.source, f"{name} refused: {error}")

    @property
    def running(self) -> bool:
        """Whether a goal is active."""
        return self._goal is not None and self._goal.active

    def accept(self, request: GoalRequest | GoalControl) -> Route:
        """Check a goal; its route is planned after ``begin``.

        Raises:
            RequestRefusedError: invalid goal, no planner, no pose, or the emergency stop is latched.
        """
        assert isinstance(request, GoalRequest)
        if self._actor is None and self._trouble is not None:
            why = str(self._trouble).partition("\n")[0]
            raise RequestRefusedError(self._trouble.reason, f"the planner does not start: {why}")
        if self._actor is None:
            text = "the planner is starting; the first time after an installation it compiles for a minute or two"
            raise RequestRefusedError(Reason.PLANNER_STARTING, text)
        pose = self._in.pose.latest
        if pose is None:
            raise RequestRefusedError(Reason.NO_MAP, "no pose yet")
        require_place(None if self._in.slam is None else self._in.slam.latest)
        if request.frame not in (pose.frame, "map"):
            frames = " or ".join(map(repr, dict.fromkeys((pose.frame, "map"))))
            raise RequestRefusedError(Reason.BAD_INPUT, f"goal in frame {request.frame!r}: expected {frames}")
        goal = (request.goal.x, request.goal.y, request.goal.yaw)
        via = tuple((place.x, place.y, place.yaw) for place in request.waypoints)
        numbers = [number for place in (goal, *via) for number in place if number is not None]
        if not all(map(math.isfinite, numbers)):
            raise RequestRefusedError(Reason.NOT_FINITE, "goal: expected finite numbers")
        if max(map(abs, numbers)) > MAX_COORDINATE:
            raise RequestRefusedError(Reason.BAD_INPUT, f"goal: expected at most {MAX_COORDINATE:g} m and rad")
        if _estopped(self._in.gate.latest):
            raise RequestRefusedError(Reason.ESTOPPED)
        self._require_outside_zones(goal, via)
        return goal, via

    def _require_outside_zones(self, goal: Pose2, via: tuple[Place, ...]) -> None:
        layer, margin = self._zone_layer(), self._setup.zone_margin
        if (name := layer.keepout(self._setup.footprint, goal, margin)) is not None:
            raise RequestRefusedError(Reason.KEEPOUT, f"goal: the robot would overlap the keepout zone {name}")
        for number, place in enumerate(via, 1):
            if (name := layer.keepout_at(place[:2])) is not None:
                text = f"waypoint {number} of {len(via)}: in the keepout zone {name}"
                raise RequestRefusedError(Reason.KEEPOUT, text)

    def _zone_layer(self) -> ZoneLayer:
        """Return the ground of the zones in force."""
        newest = None if self._in.zones is None else self._in.zones.latest
        if (news := changed(newest, self._zones)) is not None:
            self._zones, self._layer = news, ZoneLayer(in_force(news), self._layer)
        return self._layer

    def begin(self, accepted: Route, request: GoalRequest | GoalControl, number: int) -> None:
        """Replace the current goal by a new one."""
        if self._goal is not None and self._goal.active:
            self._do(goal_run.order(self._goal, GoalOrder.CANCEL, request.source, self._seconds()))
        self._paths.end_other("standstill")
        goal, via = accepted
        self._do(goal_run.begin(number, goal, request.source, self._seconds(), via))

    def control(self, request: GoalRequest | GoalControl) -> None:
        """Pause, resume or cancel the current goal."""
        assert isinstance(request, GoalControl)
        assert self._goal is not None
        if request.order is GoalOrder.RESUME and self._goal.phase is GoalPhase.PAUSED:
            self._paths.end_other("standstill")
        self._do(goal_run.order(self._goal, request.order, request.source, self._seconds()))

    def hold(self, who: str, *, on: bool) -> None:
        """Keep the truck armed between goals by requesting standstill, for services that send several goals.

        Ends a path of another source, such as the configured one. While a behaviour runs, its own requests keep the
        truck armed, so no standstill is requested.

        Args:
            who: name of the service.
            on: whether to hold; lasts until a call with False.
        """
        if on and who not in self._held:
            self._paths.end_other("standstill")
        (self._held.add if on else self._held.discard)(who)

    async def settled(self, number: int) -> GoalState:
        """Wait until the first route of a goal is found, and return the state of the goal.

        Raises:
            RequestRefusedError: no route was found, or another goal has replaced it.
        """
        while (state := self.tasks.reported) is None or (state.number == number and _undecided(state)):
            await self.tasks.next_report()
        if state.number != number:
            raise RequestRefusedError(Reason.CANCELLED, f"replaced by another goal of {state.source}")
        if state.routes == 0 and state.phase is GoalPhase.IDLE:
            raise RequestRefusedError(state.outcome, state.text)
        return state

    # Observations

    def _tick(self, now: int) -> None:
        self._keep_scan(now)
        run = self._goal
        if run is not None and run.active:
            if self._paths.displaced:
                self._do(goal_run.displaced(run, "the tracker follows another path"))
                if self._deformation is not None:
                    self._deformation.end()
            else:
                self._do(goal_run.tick(run, self._observe(now), self._config))
            if self._goal is not None and self._goal.active and self._goal.phase is not GoalPhase.PAUSED:
                self._paths.stand_still()
        elif self._held and self.tasks.other() is None:
            self._paths.stand_still()
        self.tasks.report()

    def _observe(self, now: int) -> Observations:
        odometry, gate, followed = self._odometry(now), self._in.gate.latest, self._paths.followed
        goal, zones = None if self._goal is None else self._goal.goal, self._zone_layer()
        zone = None if goal is None else zones.keepout(self._setup.footprint, goal, self._setup.zone_margin)
        answer = None
        # A truck that is still braking would roll past the start of a route, which is where it comes to rest.
        if self._planning is not None and self._planning.done() and self._paths.rest is None:
            answer, self._planning = self._planning.result(), None
        report = None if followed is None else followed.report(self._in.tracker.latest)
        along = 0.0 if report is None else report.along
        return Observations(
            now=now / SECOND,
            armed=gate is not None and gate.mode.active and odometry is not None,
            estopped=_estopped(gate),
            placeless=placeless(None if self._in.slam is None else self._in.slam.latest),
            zone=zone or "",
            at_rest=odometry is not None and abs(odometry.twist.vx) < AT_REST,
            pose=None if odometry is None else pose_of(odometry),
            answer=answer,
            outcome=None if report is None else self._outcome(report.outcome),
            along=along if followed is None else followed.before + along,
            left=self._left(followed, along),
            blocked=odometry is not None and followed is not None and self._blocked(followed, along, odometry, now),
            yields=self._deformation is not None and self._deformation.yields,
            unseen=gate is not None and followed is not None and Reason.UNSEEN_STOP in gate.reasons,
            held="" if gate is None else in_words(gate.hindrances),
        )

    def _left(self, followed: Followed | None, along: float) -> float:
        """Return the remaining length of the route (m); +inf without a route."""
        if self._deformation is not None and self._deformation.active:
            return self._deformation.left
        return math.inf if followed is None else max(float(followed.path.travelled[-1]) - along, 0.0)

    def _odometry(self, now: int) -> Odometry | None:
        odometry = self._in.pose.latest
        return odometry if odometry is not None and now - odometry.received <= ODOMETRY.fresh_for() * SECOND else None

    def _outcome(self, outcome: Reason) -> Reason:
        """Return the outcome of the tracker; DRIVING at the end of a deformed path that ends before its route."""
        on_the_way = self._deformation is not None and not self._deformation.complete
        return Reason.DRIVING if on_the_way and outcome in goal_run.ENDED else outcome

    def _blocked(self, followed: Followed, along: float, odometry: Odometry, now: int) -> bool:
        if self._deformation is not None and self._deformation.active:
            return self._deformation.blocked(now)
        pose = pose_of(odometry)
        zones = self._zone_layer().outside(self._setup.footprint, pose)
        reach = self._config.look_ahead + self._setup.footprint.circumscribed_radius
        edges = points_relative(zones.keepout_near(pose[:2], reach), pose)
        points = np.vstack((self._scan(odometry, now), edges))
        if not len(points):
            return False
        ahead = poses_ahead(followed.path, along, self._config.look_ahead, pose)
        return path_blocked(self._setup.footprint, ahead, points, pose)

    def _keep_scan(self, now: int) -> None:
        """Keep recent poses and scans for the next plan, so that it includes obstacles behind the truck."""
        odometry = self._odometry(now)
        pose = None if odometry is None else pose_of(odometry)
        if odometry is not None and pose is not None:
            self._keep_pose(odometry.stamp, pose)
        # 4 * SECOND: retention of poses (ns), to locate the seen ground, whose survey takes a second
        while self._trail and now - self._trail[0][0] > 4 * SECOND:
            self._trail.popleft()
        if pose is None or self._before is None or math.dist(pose[:2], self._before[:2]) > JUMP:
            self._seen.clear()
        self._before = pose
        if odometry is None or pose is None or (self._seen and not _moved_on(self._seen[-1][0], pose)):
            return
        if len(points := self._scan(odometry, now)):
            self._seen.append((pose, points))

    def _keep_pose(self, stamp: int, pose: Pose2) -> None:
        """Keep a pose; after a jump, move the earlier poses along, as the map frame has jumped and not the robot."""
        if self._trail and math.dist(pose[:2], self._trail[-1][1][:2]) > JUMP:
            stamps, poses = zip(*self._trail, strict=True)
            moved = placed(poses_relative(np.array(poses), poses[-1]), pose).tolist()
            self._trail = deque((at, (x, y, yaw)) for at, (x, y, yaw) in zip(stamps, moved, strict=True))
        self._trail.append((stamp, pose))

    def _ground_seen(self) -> SeenGround | None:
        """Return the latest survey of seen ground; None without one, without its pose, or if the gate needs none."""
        grid = None if self._in.seen is None else self._in.seen.latest
        scan = None if self._in.scan is None else self._in.scan.latest
        if self._setup.seen_for is None or grid is None or scan is None or not self._trail:
            return None
        at, pose = min(self._trail, key=lambda kept: abs(kept[0] - grid.stamp))
        if abs(at - grid.stamp) > (1.0 / self._config.rate + ODOMETRY.fresh_for()) * SECOND:
            return None
        return SeenGround(grid, pose, scan.field, scan.range_max)

    def _scan(self, odometry: Odometry, now: int) -> Array:
        """Return the points of the latest scan in the current base; none if it is stale or tilted."""
        scan = None if self._in.scan is None else self._in.scan.latest
        if scan is None or now - scan.received > SCAN.fresh_for() * SECOND:
            return np.empty((0, 2))
        if self._scanned is None or self._scanned[0] is not scan or self._scanned[1] is not odometry:
            points = np.empty((0, 2))
            if level(scan, self._config):
                points = scan_points_at(scan, self._setup.lidar, odometry.stamp, twist_of(odometry))
            self._scanned, self._points = (scan, odometry), points
        return self._points

    # Decisions

    def _do(self, step: tuple[GoalRun, tuple[Action, ...]]) -> None:
        self._goal, actions = step
        for action in actions:
            match action:
                case Report(reason, severity, text):
                    self._out.events(reason, severity, self.name, text, goal=self._goal.number)
                case Plan():
                    self._plan(self._goal, action)
                case Follow(answer):
                    self._follow(answer)
                case Halt():
                    self._halt()
        if actions:
            self.tasks.report()

    def _plan(self, run: GoalRun, plan: Plan) -> None:
        now = self._clock.now()
        odometry = self._odometry(now)
        assert self._tasks is not None
        if odometry is None:
            self._planning = self._tasks.create_task(_known(RouteAnswer(Reason.NO_MAP, "no fresh pose")))
            return
        pose = pose_of(odometry)
        grid = None if self._in.grid is None else self._in.grid.latest
        ground = None if self._in.ground is None else self._in.ground.latest
        if ground is not None and ground.frame != odometry.frame:
            ground = None
        zones = None if self._in.zones is None else self._in.zones.latest
        lidar = np.array([self._setup.lidar[:2]])
        seen = tuple(SeenScan(points_placed(points, at), points_placed(lidar, at)[0]) for at, points in self._seen)
        self._seen.clear()
        task = PlanTask(
            plan.what,
            pose,
            run.goal,
            points_placed(self._scan(odometry, now), pose),
            setup=self._setup if self._fresh else None,
            grid=grid if grid is not self._sent_grid or self._fresh else None,
            ground=ground if ground is not self._sent_ground or self._fresh else None,
            start=self._paths.rest,
            clear=plan.clear,
            afresh=plan.afresh,
            via=run.via,
            deviation=odometry.position_deviation,
            seen=seen,
            ground_seen=self._ground_seen(),
            zones=zones if self._fresh else changed(zones, self._sent_zones),
        )
        self._fresh, self._sent_grid, self._sent_ground, self._sent_zones = False, grid, ground, zones
        self._planning = self._tasks.create_task(self._ask(task))

    async def _ask(self, task: PlanTask) -> RouteAnswer:
        """Return the answer of the planner; if it failed and restarts, an answer with the failure."""
        assert self._actor is not None
        try:
            answer: RouteAnswer = await self._actor.step(task)
        except TruckError as error:
            self._fresh = True
            self._out.events(error.reason, Severity.ERROR, self.name, str(error))
            return RouteAnswer(error.reason, str(error).partition("\n")[0])
        return answer

    def _follow(self, answer: RouteAnswer) -> None:
        run, deformation = self._goal, self._deformation
        assert run is not None
        if deformation is not None:
            deformation.end()
            if run.planned == "route":
                deformation.begin(answer)
        assert answer.path is not None
        self._paths.follow(answer.path, f"goal-{run.number}")

    def _on_deformed(self, was: Finding, answer: DeformAnswer) -> None:
        """Follow the deformed route."""
        followed, run, deformation = self._paths.followed, self._goal, self._deformation
        assert deformation is not None
        if followed is None or run is None or run.phase is GoalPhase.BACKING_OUT:
            return
        before, name = followed.before + followed.along(self._in.tracker.latest), f"goal-{run.number}"
        if answer.path is not None:
            self._paths.follow(answer.path, f"{name}-deformed", before)
        elif answer.finding == "free" and was not in ("idle", "free"):
            self._paths.follow(deformation.rest, name, before)
        elif answer.finding in ("blocked", "yields") and was != answer.finding:
            self._paths.brake(f"{name}-{'held-up' if answer.finding == 'blocked' else 'yields'}")
        if (event := event_of(was, answer)) is not None:
            reason, severity, text = event
            self._out.events(reason, severity, self.name, f"goal {run.number}: {text}", goal=run.number)

    def _halt(self) -> None:
        if self._deformation is not None:
            self._deformation.end()
        self._paths.halt(f"halt-{0 if self._goal is None else self._goal.number}")

    def state(self, now: int) -> GoalState:
        """Return the report on the latest goal."""
        left = 0.0 if self._deformation is None else self._deformation.left
        return goal_state(self._goal, now, self._paths.followed, self._in, left)

    def _seconds(self) -> float:
        return self._clock.now() / SECOND

    def register(self, rpc: RpcRegistry) -> None:
        """Serve ``goal``, answered when the first route is known, and ``goal_control``."""

        async def goal(payload: dict[str, Any]) -> dict[str, Any]:
            number = self.tasks.take(parse_request(GoalRequest, payload))
            try:
                # 4.0: seconds a remote call waits for the first route; the goal continues after that
                async with self._clock.deadline(4.0):
                    state = await self.settled(number)
            except TimeoutError:
                return {"number": number, "planned": False}
            return {"number": number, "planned": True, "length": state.remaining}

        async def control(payload: dict[str, Any]) -> dict[str, Any]:
            self.tasks.take(parse_request(GoalControl, payload))
            return {}

        rpc.register("goal", goal)
        rpc.register("goal_control", control)


def _estopped(gate: GateState | None) -> bool:
    return gate is not None and gate.mode is GateMode.ESTOPPED


def _moved_on(before: Pose2, pose: Pose2) -> bool:
    turned = abs(math.remainder(pose[2] - before[2], math.tau))
    # 0.25: distance between kept scans (m)
    # 0.4: turn between kept scans (rad)
    return math.dist(before[:2], pose[:2]) > 0.25 or turned > 0.4


async def _known(answer: RouteAnswer) -> RouteAnswer:
    return answer


def _undecided(state: GoalState) -> bool:
    return state.phase is GoalPhase.PLANNING and state.routes == 0 and state.recoveries == 0


def goal_state(
    run: GoalRun | None, now: int, followed: Followed | None, inputs: GoalInputs, left: float = 0.0
) -> GoalState:
    """Return the report on a goal, with sequence number 0; the remaining length is at least ``left`` (m)."""
    odometry = inputs.pose.latest
    frame = "map" if odometry is None else odometry.frame
    if run is None:
        return GoalState(stamp=now, received=now, seq=0, frame=frame)
    x, y, yaw = run.goal
    remaining = 0.0
    if followed is not None and run.active:
        remaining = max(float(followed.path.travelled[-1]) - followed.along(inputs.tracker.latest), left, 0.0)
    return GoalState(
        stamp=now,
        received=now,
        seq=0,
        frame=frame,
        number=run.number,
        source=run.source,
        goal=Pose2D(x=x, y=y, yaw=yaw),
        phase=run.phase,
        outcome=run.outcome,
        text=run.text,
        waypoints=len(run.via) if run.active else 0,
        remaining=remaining,
        elapsed=run.elapsed,
        routes=run.routes,
        recoveries=run.recoveries,
    )
