"""Mission service: executes the steps of a mission through the goal, behaviour and exploration services."""

import asyncio
import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, TypeVar, assert_never

from monstertruck_kinematics.se2 import Pose2
from monstertruck_planners.behave.dock.config import Docks, chosen
from monstertruck_planners.behave.dock.estimate import staging_pose
from monstertruck_planners.behave.service import BehaviourService
from monstertruck_planners.explore.service import ExplorerService
from monstertruck_planners.goals.exchange import pose_of, require_place
from monstertruck_planners.goals.service import GoalService
from monstertruck_planners.missions.check import Abilities, dead_ends, lacking
from monstertruck_planners.missions.conditions import Facts, holds
from monstertruck_planners.missions.outline import lines, shown
from monstertruck_planners.missions.progress import (
    MissionProgress,
    Next,
    SavedProgress,
    StepEnd,
    after,
    enter,
    expired,
    judge,
    outcome,
    passed,
    watched,
)
from monstertruck_planners.tasks import R, TaskServer
from monstertruck_runtime.clock import SECOND, Clock, Schedule, minute_of_day
from monstertruck_runtime.errors import InputError, NotFoundError, RequestRefusedError, TruckError, disk_reason
from monstertruck_runtime.outside import contents_if_present, reading
from monstertruck_runtime.ports import EventSink, Publisher, Ready, RpcRegistry, Subscription
from monstertruck_runtime.requests import does_not_drive, inner_request
from monstertruck_runtime.small_files import put_aside, remove_file, replace_file
from monstertruck_runtime.threads import Offload
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.event import Severity
from monstertruck_schemas.health import SlamHealth
from monstertruck_schemas.mission import (
    AnyStep,
    BehaviourStepOfMission,
    BranchStep,
    ConditionStep,
    DockStep,
    ExploreStep,
    FallbackStep,
    FollowWallStep,
    GoToStep,
    LookStep,
    Mission,
    ParallelStep,
    PointStep,
    RecordStep,
    RepeatStep,
    ReturnStep,
    SequenceOfSteps,
    UndockStep,
    WaitStep,
    WaitUntilStep,
)
from monstertruck_schemas.plan import (
    BehaviourState,
    ExplorationState,
    GoalPhase,
    GoalState,
    MissionLine,
    MissionState,
    TaskState,
)
from monstertruck_schemas.points import PointKind, PointsOfInterest
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import (
    BehaviourOrder,
    BehaviourRequest,
    ExploreOrder,
    ExploreRequest,
    GoalControl,
    GoalOrder,
    GoalRequest,
    MissionOrder,
    MissionRequest,
    Waypoint,
)
from monstertruck_schemas.roles import ServiceName
from monstertruck_schemas.sensor import Battery
from monstertruck_schemas.state import GateState, Odometry
from monstertruck_schemas.topics import BATTERY, ODOMETRY
from monstertruck_schemas.zones import Zones

T = TypeVar("T", GoalState, ExplorationState, BehaviourState)

DrivingStep = (
    GoToStep
    | PointStep
    | LookStep
    | ExploreStep
    | BehaviourStepOfMission
    | FollowWallStep
    | DockStep
    | UndockStep
    | ReturnStep
)
"""Steps executed by other services."""

SOURCE: Final = ServiceName.MISSIONS.value
"""Source of a mission's goals, behaviours and explorations."""
OWN: Final = frozenset({SOURCE, ServiceName.EXPLORER.value})
"""Sources of goals sent by a mission or an exploration."""
MISSION_CHECK_RATE: Final = 5.0
"""Checks per second."""
CHANGES: Final = ("number", "running", "node", "attempt", "outcome", "resumable")
"""Report fields whose change triggers an immediate report."""
PASSING: Final = frozenset(
    {Reason.PLANNER_STARTING, Reason.NO_MAP, Reason.POSE_LOST, Reason.LEASE_EXPIRED, Reason.BUSY}
)
"""Temporary refusals; the request is repeated. The robot may be busy with the previous step: after a goal it brakes
along a path, after an exploration the map is saved."""
SILENT: Final = 10.0
"""Timeout of the reports on a step (s), which arrive twice a second; beyond, the step has failed."""


@dataclass(frozen=True, slots=True)
class MissionInputs:
    """Input topics."""

    gate: Subscription[GateState]
    pose: Subscription[Odometry]
    """Pose in the map frame."""
    goal: Subscription[GoalState]
    behaviour: Subscription[BehaviourState]
    explore: Subscription[ExplorationState]
    points: Subscription[PointsOfInterest] | None = None
    slam: Subscription[SlamHealth] | None = None
    battery: Subscription[Battery] | None = None
    """Battery charge; None if the robot does not estimate it."""
    lidar: bool = False
    """Whether a lidar sees obstacles."""
    zones: Subscription[Zones] | None = None
    """Zones; None if the robot has none."""


@dataclass(frozen=True, slots=True)
class MissionParts:
    """Services that execute the steps."""

    goals: GoalService
    behaviours: BehaviourService | None
    explorer: ExplorerService | None
    docks: Docks = field(default_factory=dict)


class MissionService:
    """Runs one mission at a time.

    Args:
        parts: services that execute the steps.
        clock: time source.
        file: stores the progress across restarts; None to store nothing.
        localised: whether the robot localises in a known map, so poses stay valid after a restart.
        offload: runs the writing of the file.
        max_age: see ``GateConfig.max_request_age``.
        inputs: input topics.
        state: publisher of ``plan/mission``.
        events: sink for steps and ends.
    """

    name = SOURCE
    noun = "mission"

    def __init__(
        self,
        parts: MissionParts,
        clock: Clock,
        *,
        file: Path | None,
        localised: bool,
        offload: Offload,
        max_age: float,
        inputs: MissionInputs,
        state: Publisher[MissionState],
        events: EventSink,
    ) -> None:
        self._parts, self._clock, self._file, self._offload = parts, clock, file, offload
        self._localised = localised
        self._in, self._events = inputs, events
        self.tasks = TaskServer[MissionRequest, MissionProgress, MissionState](
            self,
            clock,
            inputs.gate,
            max_age,
            state,
            changes=CHANGES,
            period=SECOND // 2,  # report period without a change (ns)
            others=(inputs.goal, inputs.behaviour, inputs.explore),
            own=OWN,
        )
        self._seq = 0
        self._source = ""
        self._progress: MissionProgress | None = None
        self._began = 0
        self._end: StepEnd | None = None
        self._waits = ""
        """Reason why the current step waits."""
        self._failed = ""
        """Reason why the last attempt at a step failed."""
        self._interrupted: SavedProgress | None = None
        self._writing = asyncio.Lock()
        self._keeping: asyncio.Task[None] | None = None
        """Writes the changes of the latest request."""
        self._blocked: int | None = None
        """Start of the current stop by an obstacle (ns)."""
        self._known: tuple[PointsOfInterest | None, frozenset[str], int] = (None, frozenset(), 0)
        """Latest points of interest, their names and the number of tags."""
        self._lines: tuple[MissionLine, ...] = ()
        """Steps of the mission in words."""
        self._noted: Pose2 | None = None
        """Pose of the robot that was last stored."""
        self._task: asyncio.Task[None] | None = None
        self._group: asyncio.TaskGroup | None = None

    async def run(self, ready: Ready) -> None:
        """Serve until cancelled; a mission running then can be resumed after a restart."""
        try:
            self._interrupted = await self._offload(self._load)
        except InputError as error:
            await self._say_damaged(str(error))
        if (saved := self._interrupted) is not None:
            self._lines = lines(saved.mission)
            text = f"{saved.mission.name} was interrupted {_where(saved)}; it can be resumed"
            self._events(Reason.MISSION_INCOMPLETE, Severity.WARNING, SOURCE, text)
        async with asyncio.TaskGroup() as self._group:
            self.tasks.report()
            ready()
            schedule = Schedule(self._clock, MISSION_CHECK_RATE)
            try:
                while True:
                    await schedule.next()
                    self._observe_obstacle()
                    self.tasks.report()
                    await self._note_place()
            finally:
                self._parts.goals.hold(SOURCE, on=False)

    # Requests

    @property
    def running(self) -> bool:
        """Whether a mission is running."""
        return self._task is not None and not self._task.done()

    @property
    def resumable(self) -> bool:
        """Whether a restart interrupted a mission."""
        return self._interrupted is not None

    def accept(self, request: MissionRequest) -> MissionProgress:
        """Check a mission and the pose of the robot; return the initial progress of the mission.

        Raises:
            RequestRefusedError: the pose is unknown, or the robot is not where the mission was interrupted.
            NotFoundError: steps need parts that the robot does not have.
            InputError: a start without a mission, or steps with settings that their behaviours refuse.
        """
        progress = self._progress_of(request)
        self._check(progress.mission)
        return progress

    def begin(self, accepted: MissionProgress, request: MissionRequest, number: int) -> None:
        """Run a mission from its current step."""
        assert self._group is not None
        self._source, self._progress = request.source, accepted
        self._began, self._end = self._clock.now(), None
        self._interrupted, self._failed, self._lines = None, "", lines(accepted.mission)
        text = f"{accepted.mission.name}, {len(accepted.mission.steps)} steps, requested by {request.source}"
        if accepted.number != "1":
            text += f", from step {accepted.number} on"
        self._events(Reason.MISSION_STARTED, Severity.INFO, SOURCE, text)
        self._keeping = self._group.create_task(self._save(accepted))
        self._task = self._group.create_task(self._do_all(accepted))

    def control(self, request: MissionRequest) -> None:
        """Stop the running mission, or give up the interrupted one."""
        if self._task is not None and self.running:
            self._stop(self._task, request.source)
        elif self._interrupted is not None:
            self._drop(self._interrupted, request.source)

    def register(self, rpc: RpcRegistry) -> None:
        """Serve ``mission``; answer once the request is stored for a restart."""
        self.tasks.register(rpc, "mission", MissionRequest, self.kept)

    async def kept(self) -> None:
        """Wait until the latest request is stored for a restart, or an event reports that it could not be written."""
        if self._keeping is not None:
            await asyncio.wait([self._keeping])

    def _stop(self, task: asyncio.Task[None], source: str) -> None:
        """End the mission that ``task`` runs; its end may have been reported already."""
        assert self._group is not None
        if self._end is not None:
            return
        self._finish(StepEnd(Reason.CANCELLED, f"stopped by {source}"))
        task.cancel()
        self._keeping = self._group.create_task(self._forget())

    def _drop(self, interrupted: SavedProgress, source: str) -> None:
        """Discard an interrupted mission that a client has given up."""
        assert self._group is not None
        self._interrupted = None
        self._events(Reason.CANCELLED, Severity.INFO, SOURCE, f"{interrupted.mission.name}: abandoned by {source}")
        self._keeping = self._group.create_task(self._forget())

    def _progress_of(self, request: MissionRequest) -> MissionProgress:
        resumed = self._interrupted if request.order is MissionOrder.RESUME else None
        if resumed is None and request.order is MissionOrder.RESUME:
            raise RequestRefusedError(Reason.NOT_FOUND, "no mission was interrupted")
        if resumed is None and request.mission is None:
            raise InputError("mission: missing")
        if (pose := self._pose()) is None:
            raise RequestRefusedError(Reason.NO_MAP, "no pose in a map yet")
        require_place(None if self._in.slam is None else self._in.slam.latest)
        if resumed is not None:
            # 1.0: distance (m) from the interruption beyond which the robot was moved or its odometry was reset
            if not self._localised and not request.moved and (away := resumed.away(pose)) > 1.0:
                text = f"the pose is {away:.1f} m from the one at which {resumed.mission.name} was interrupted"
                hint = (
                    "if you moved the robot, resume with `--moved`; otherwise its odometry has restarted "
                    "(`odometry.start`)"
                )
                raise RequestRefusedError(Reason.POSE_LOST, f"{text}: {hint}")
            return resumed.progress()
        assert request.mission is not None
        return MissionProgress(request.mission, pose)

    def _check(self, mission: Mission) -> None:
        """Check that all steps can be reached, and that the robot has the parts that they need.

        Raises:
            NotFoundError: parts are missing; lists every step and part.
            InputError: settings are wrong or steps cannot be reached, alone or as well.
        """
        if wrong := [*dead_ends(mission), *lacking(mission, self._abilities)]:
            lacks = all(mistake.lacks for mistake in wrong)
            raise (NotFoundError if lacks else InputError)("; ".join(f"step {one.number}: {one.text}" for one in wrong))

    @property
    def _abilities(self) -> Abilities:
        behaviours = self._parts.behaviours
        return Abilities(
            explorer=self._parts.explorer is not None,
            points=self._in.points is not None,
            charge=self._in.battery is not None,
            lidar=self._in.lidar,
            zones=self._in.zones is not None,
            docks=self._parts.docks,
            behaviour=None if behaviours is None else behaviours.check,
        )

    # Steps

    async def _do_all(self, progress: MissionProgress) -> None:
        """Run a mission from its current step."""
        self._parts.goals.hold(SOURCE, on=True)
        self._progress = progress
        following: Next = "step"
        try:
            while following not in ("done", "ended"):
                if following == "round":  # a mission that takes no time must not stall the loop
                    await self._clock.sleep(1.0 / MISSION_CHECK_RATE)
                following = await self._do_next(self._progress)
                if following not in ("done", "ended"):
                    await self._save(self._progress)
            self._finish(outcome(self._progress, following))
        except asyncio.CancelledError:
            if self._end is None:  # the daemon exits: the progress stays on disk
                await self._save(self._progress)
            raise
        finally:
            self._parts.goals.hold(SOURCE, on=False)
        assert self._group is not None
        self._keeping = self._group.create_task(self._forget())  # not awaited: the next mission may start

    async def _do_next(self, progress: MissionProgress) -> Next:
        """Run the current step and advance the mission."""
        facts = self._facts()
        self._progress, interrupted = watched(enter(progress, facts), facts)
        if interrupted:
            return "step"
        if self._progress.stack != progress.stack:
            await self._save(self._progress)  # a restart must not decide a branch again
        progress, self._waits = self._progress, ""
        self.tasks.report()
        at = f"step {progress.number} of {len(progress.mission.steps)}: {progress.doing}"
        self._events(Reason.MISSION_STEP, Severity.INFO, SOURCE, at)
        end, depth = await self._supervised(progress)
        if end is None:
            self._events(Reason.MISSION_STEP, Severity.INFO, SOURCE, f"{at}: interrupted by a watch")
            return "step"
        if not end.good:
            self._failed = end.text or end.reason.text
            self._events(end.reason, Severity.WARNING, SOURCE, f"{at}: {self._failed}")
        self._progress, following = after(self._progress, end, self._facts(), depth)
        return following

    def _finish(self, end: StepEnd) -> None:
        severity = Severity.INFO if end.reason.exit_code == 0 else Severity.WARNING
        self._end = end
        self._events(end.reason, severity, SOURCE, end.text)
        self.tasks.report()

    async def _supervised(self, progress: MissionProgress) -> tuple[StepEnd | None, int | None]:
        """Run the current step until it ends, exceeds a time limit or is interrupted by a watch.

        Returns:
            The outcome (None after an interruption), and the depth of the step that exceeded its limit (None for this
            one).
        """
        step = ReturnStep(do="return") if progress.returning else progress.step
        spent = 0.0
        work: asyncio.Task[StepEnd] | None = None
        try:
            while True:
                self._progress, interrupted = watched(progress, self._facts())
                if interrupted:
                    return None, None
                progress = self._progress
                if (over := expired(progress)) is not None:
                    return _over(over[1]), over[0]
                if step.limit is not None and spent >= step.limit:
                    return _over(step.limit), None
                work = work or asyncio.create_task(self._do(step, progress))
                before, paused = self._clock.now(), self._paused
                left = math.inf if step.limit is None else step.limit - spent
                await asyncio.wait((work,), timeout=min(1.0 / MISSION_CHECK_RATE, left))
                if not paused:
                    passing = (self._clock.now() - before) / SECOND
                    spent, progress = spent + passing, passed(progress, passing)
                if work.done():
                    self._progress = progress
                    return work.result(), None
        finally:
            if work is not None and not work.done():
                work.cancel()
                await asyncio.wait((work,))

    async def _do(self, step: AnyStep, progress: MissionProgress) -> StepEnd:
        try:
            match step:
                case WaitStep(seconds=seconds):
                    return await self._wait(seconds)
                case WaitUntilStep(when=when):
                    return await self._stand(lambda: None if holds(when, self._facts()) else 1.0 / MISSION_CHECK_RATE)
                case RecordStep(note=note):
                    self._events(Reason.MISSION_NOTE, Severity.INFO, SOURCE, note)
                    return StepEnd(Reason.OK)
                case ConditionStep():
                    return judge(step, self._facts())
                case BranchStep():  # the chosen side has no steps
                    return StepEnd(Reason.OK)
                case SequenceOfSteps() | FallbackStep() | RepeatStep() | ParallelStep():
                    raise AssertionError("entered before")
                case _:
                    return await self._drive(step, progress)
        except RequestRefusedError as error:
            return StepEnd(error.refusal, str(error))
        except TruckError as error:
            return StepEnd(error.reason, str(error))

    async def _drive(self, step: DrivingStep, progress: MissionProgress) -> StepEnd:
        match step:
            case GoToStep(x=x, y=y, yaw=yaw, via=via):
                return await self._go(lambda: (x, y, yaw), via)
            case PointStep():
                return await self._go(lambda: self._before(step))
            case LookStep(x=x, y=y):
                return await self._go(lambda: self._towards(x, y))
            case ExploreStep():
                return await self._explore(step)
            case BehaviourStepOfMission(name=name, settings=settings):
                return await self._behave(name, dict(settings), None)
            case FollowWallStep(name=name, distance=distance):
                return await self._behave(name, {}, distance)
            case DockStep(dock=name):
                return await self._dock(name)
            case UndockStep(dock=name):
                return await self._behave("undock", {"dock": name or ""}, None)
            case ReturnStep():
                return await self._go(lambda: progress.start)
            case _:
                assert_never(step)

    async def _dock(self, name: str | None) -> StepEnd:
        """Drive to the staging pose of a dock, and dock; the mission's check has found the dock."""
        known, dock = chosen(self._parts.docks, name or "")
        end = await self._go(lambda: staging_pose(dock))
        return await self._behave("dock", {"dock": known}, None) if end.good else end

    async def _wait(self, seconds: float) -> StepEnd:
        until = self._clock.now() + round(seconds * SECOND)
        return await self._stand(lambda: (until - self._clock.now()) / SECOND)

    async def _stand(self, left: Callable[[], float | None]) -> StepEnd:
        """Stand until ``left`` returns no remaining seconds.

        Raises:
            RequestRefusedError: the robot was disarmed.
        """
        while (seconds := left()) is not None and seconds > 0.0:
            if (other := self.tasks.other()) is not None:
                return StepEnd(Reason.CANCELLED, other)
            gate = self._in.gate.latest
            if gate is None or not gate.mode.active:
                raise does_not_drive(gate)
            await self._clock.sleep(min(seconds, 1.0 / MISSION_CHECK_RATE))
        return StepEnd(Reason.OK)

    def _before(self, step: PointStep) -> Pose2:
        """Return the pose in front of a point of interest.

        Raises:
            RequestRefusedError: no points of interest are known yet.
            NotFoundError: no point of interest has this name.
        """
        message = None if self._in.points is None else self._in.points.latest
        if message is None:
            raise RequestRefusedError(Reason.NO_MAP, "no points of interest yet")
        for point in message.points:
            if point.name == step.point:
                pose = point.before(step.distance)
                return pose.x, pose.y, pose.yaw
        raise NotFoundError(f"no point of interest {step.point!r} is known")

    def _towards(self, x: float, y: float) -> Pose2:
        """Return the current position of the robot with the heading towards a place.

        Raises:
            RequestRefusedError: the pose is unknown.
        """
        if (pose := self._pose()) is None:
            raise RequestRefusedError(Reason.NO_MAP, "no fresh pose")
        return pose[0], pose[1], math.atan2(y - pose[1], x - pose[0])

    async def _go(self, where: Callable[[], Pose2], via: tuple[tuple[float, float], ...] = ()) -> StepEnd:
        waypoints = tuple(Waypoint(x=a, y=b) for a, b in via)

        def start() -> GoalRequest | GoalControl:
            x, y, yaw = where()
            goal = Pose2D(x=x, y=y, yaw=math.remainder(yaw, math.tau))
            return GoalRequest(**self._header(), frame="map", goal=goal, waypoints=waypoints)

        def stop() -> GoalRequest | GoalControl:
            return GoalControl(**self._header(), order=GoalOrder.CANCEL, own=True)

        return await self._task_of(self._parts.goals.tasks, start, stop, self._in.goal)

    async def _explore(self, step: ExploreStep) -> StepEnd:
        assert self._parts.explorer is not None
        what: dict[str, Any] = {"home": step.home, "budget": step.budget, "find": step.find}

        def start() -> ExploreRequest:
            return ExploreRequest(**self._header(), order=ExploreOrder.START, **what)

        def stop() -> ExploreRequest:
            return ExploreRequest(**self._header(), order=ExploreOrder.STOP, own=True)

        return await self._task_of(self._parts.explorer.tasks, start, stop, self._in.explore)

    async def _behave(self, name: str, settings: dict[str, Any], distance: float | None) -> StepEnd:
        assert self._parts.behaviours is not None
        what: dict[str, Any] = {"behaviour": name, "settings": settings}

        def start() -> BehaviourRequest:
            return BehaviourRequest(**self._header(), order=BehaviourOrder.START, **what)

        def stop() -> BehaviourRequest:
            stopping: dict[str, Any] = {"order": BehaviourOrder.STOP, "behaviour": name, "own": True}
            return BehaviourRequest(**self._header(), **stopping)

        def enough(state: BehaviourState) -> StepEnd | None:
            if distance is None or state.travelled < distance:
                return None
            return StepEnd(Reason.BEHAVIOUR_DONE, f"{state.travelled:.2f} m")

        return await self._task_of(self._parts.behaviours.tasks, start, stop, self._in.behaviour, enough)

    async def _task_of(
        self,
        server: TaskServer[R, Any, Any],
        start: Callable[[], R],
        stop: Callable[[], R],
        reports: Subscription[T],
        enough: Callable[[T], StepEnd | None] = lambda _: None,
    ) -> StepEnd:
        """Have another service execute a task, and return its outcome.

        Args:
            server: task server of that service.
            start: creates the request.
            stop: creates the request that stops the task, sent on cancellation, on timeout, or after ``enough``.
            reports: reports of that service.
            enough: returns the outcome of a running task that is sufficiently complete, else None.

        Raises:
            TruckError: the task was refused.
        """
        number = await self._taken(lambda: server.take(start()))
        schedule, newest, silent = Schedule(self._clock, MISSION_CHECK_RATE), reports.latest, 0
        ended: StepEnd | None = None
        try:
            while (ended := _end_of(reports.latest, number, server.noun)) is None:
                state = reports.latest
                if state is not None and state.number == number and (done := enough(state)) is not None:
                    return done
                # Count checks, not time: while this process is suspended, as with the computer, no service can report.
                silent = silent + 1 if state is newest else 0
                newest = state
                if silent > SILENT * MISSION_CHECK_RATE:
                    return StepEnd(Reason.SERVICE_FAILED, f"no report of it for {SILENT:g} s")
                await schedule.next()
        finally:
            if ended is None:
                with contextlib.suppress(TruckError):
                    server.take(stop())
        return ended

    async def _taken(self, take: Callable[[], int]) -> int:
        """Call ``take`` and return its task number; repeat the request while it is refused for a temporary reason.

        Raises:
            TruckError: refused for another reason or for more than 3 minutes, or another source drives.
        """
        # 180.0: seconds of repeated requests; a planner compiles for a minute or two after an installation
        until, refused = self._clock.now() + 180.0 * SECOND, False
        while True:
            if (other := self.tasks.other()) is not None:
                raise RequestRefusedError(Reason.CANCELLED, other)
            try:
                number = take()
                self._waits = ""
                return number
            except RequestRefusedError as error:
                if error.refusal not in PASSING or self._clock.now() > until:
                    raise
                if refused:  # the first refusal may only be due to braking: not reported
                    self._waits = str(error)
                refused = True
            await self._clock.sleep(1.0)  # seconds until the next request

    @property
    def _paused(self) -> bool:
        """Whether the current goal is paused, which stops its time limits."""
        goal = self._in.goal.latest
        return goal is not None and goal.phase is GoalPhase.PAUSED

    def _facts(self) -> Facts:
        now, battery = self._clock.now(), None if self._in.battery is None else self._in.battery.latest
        fresh = battery is not None and now - battery.received <= BATTERY.fresh_for() * SECOND
        charge = battery.charge if battery is not None and fresh else None
        points = None if self._in.points is None else self._in.points.latest
        if points is not None and points is not self._known[0]:
            names = frozenset(point.name for point in points.points)
            self._known = points, names, sum(point.kind is PointKind.TAG for point in points.points)
        _, names, tags = self._known
        zones = None if self._in.zones is None else self._in.zones.latest
        return Facts(
            charge=None if charge is None else 100.0 * charge,
            elapsed=(now - self._began) / SECOND,
            points=names,
            tags=tags,
            obstacle=0.0 if self._blocked is None else (now - self._blocked) / SECOND,
            zones=frozenset(() if zones is None else zones.inside),
            minute=minute_of_day(now + self._clock.real_offset()),
        )

    def _observe_obstacle(self) -> None:
        """Record the start of a stop by an obstacle, or of a goal's wait for one."""
        gate, goal = self._in.gate.latest, self._in.goal.latest
        blocked = gate is not None and Reason.OBSTACLE_STOP in gate.reasons
        blocked = blocked or (goal is not None and goal.phase is GoalPhase.WAITING)
        if not blocked:
            self._blocked = None
        elif self._blocked is None:
            self._blocked = self._clock.now()

    def _header(self) -> dict[str, Any]:
        self._seq += 1
        return inner_request(self._seq, self._in.gate.latest, self._clock.now(), SOURCE)

    def _pose(self) -> Pose2 | None:
        pose = self._in.pose.latest
        if pose is None or self._clock.now() - pose.received > ODOMETRY.fresh_for() * SECOND:
            return None
        return pose_of(pose)

    # Persistence across restarts

    def _load(self) -> SavedProgress | None:
        """Load the interrupted mission; call in a thread.

        Raises:
            InputError: the file is damaged.
        """
        file = self._file
        expected = "the progress of a mission"
        # 1_000_000: maximum size of the saved progress (bytes)
        data = None if file is None else contents_if_present(file, expected, 1_000_000)
        if data is None:
            return None
        with reading(str(file), expected):
            return SavedProgress.model_validate_json(data)

    async def _say_damaged(self, why: str) -> None:
        if (file := self._file) is not None:
            where = await self._offload(lambda: put_aside(file))
            text = f"{why}; the interrupted mission cannot be resumed; {where}"
            self._events(Reason.FILE_DAMAGED, Severity.WARNING, SOURCE, text)

    async def _save(self, progress: MissionProgress) -> None:
        self._noted = self._pose() or self._noted
        text = SavedProgress.of(progress, self._source, self._noted).model_dump_json()
        await self._write(lambda file: replace_file(file, text))

    async def _note_place(self) -> None:
        """Store the pose of the robot while a mission runs."""
        pose, noted, progress = self._pose(), self._noted, self._progress
        running = progress is not None and self._end is None
        # 0.5: distance (m) until the pose is stored again
        if progress is None or not running or pose is None or noted is None or math.dist(pose[:2], noted[:2]) < 0.5:
            return
        await self._save(progress)

    async def _forget(self) -> None:
        await self._write(remove_file)

    async def _write(self, change: Callable[[Path], object]) -> None:
        if (file := self._file) is None:
            return
        try:
            async with self._writing:
                await self._offload(lambda: change(file))
        except OSError as error:
            self._events(disk_reason(error), Severity.WARNING, SOURCE, f"{file}: progress not saved: {error}")

    # Reports

    def state(self, now: int) -> MissionState:
        """Return the report on the latest mission."""
        header: dict[str, Any] = {"stamp": now, "received": now, "seq": 0, "frame": "map", "number": self.tasks.number}
        if self._interrupted is not None:
            saved, at = self._interrupted, self._interrupted.progress()
            return MissionState(
                **header, name=saved.mission.name, source=saved.source, resumable=True, step=at.index + 1,
                steps=len(saved.mission.steps), doing=at.doing, node=at.number, lines=shown(self._lines, at.number),
                failures=saved.failures, outcome=Reason.MISSION_INCOMPLETE, text=f"interrupted {_where(saved)}",
            )  # fmt: skip
        if (progress := self._progress) is None:
            return MissionState(**header)
        end = self._end
        return MissionState(
            **header, name=progress.mission.name, source=self._source, running=end is None, step=progress.index + 1,
            steps=len(progress.mission.steps), attempt=progress.attempt + 1, failures=progress.failures,
            doing=progress.doing, failed=self._failed, node=progress.number, lines=shown(self._lines, progress.number),
            outcome=Reason.DRIVING if end is None else end.reason, text=self._waits if end is None else end.text,
            elapsed=(now - self._began) / SECOND,
        )  # fmt: skip


def _end_of(state: TaskState | None, number: int, noun: str) -> StepEnd | None:
    """Return the outcome of task ``number`` from the latest report; None while it runs."""
    if state is None or state.number < number:
        return None
    if state.number > number:
        return StepEnd(Reason.CANCELLED, f"{state.source} started another {noun}")
    return None if state.running else StepEnd(state.outcome, state.text)


def _where(saved: SavedProgress) -> str:
    number = saved.progress().number
    return f"on the way back, after step {number} had failed" if saved.returning else f"at step {number}"


def _over(limit: float) -> StepEnd:
    return StepEnd(Reason.TIMEOUT, f"not finished within {limit:g} s")
