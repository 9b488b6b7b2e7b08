"""Exploration service: passes observations to the state machine and its decisions to the goal service."""

import asyncio
import math
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, Final

from monstertruck_kinematics.se2 import Pose2
from monstertruck_planners.explore import exploration
from monstertruck_planners.explore.exchange import ExploreAnswer, ExploreSetup, ExploreTask
from monstertruck_planners.explore.exploration import Action, Cancel, Choose, Exploration, Go, Notice, Observed, Save
from monstertruck_planners.goals.exchange import pose_of
from monstertruck_planners.goals.service import GoalService
from monstertruck_planners.tasks import TaskServer
from monstertruck_planners.zones.shapes import changed
from monstertruck_runtime.actors.actor import Actor
from monstertruck_runtime.clock import SECOND, Clock, Schedule
from monstertruck_runtime.errors import RequestRefusedError, TruckError
from monstertruck_runtime.mailbox import Mailbox
from monstertruck_runtime.ports import EventSink, Publisher, Ready, RpcRegistry, Subscription
from monstertruck_runtime.requests import inner_request
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.event import Event, Severity
from monstertruck_schemas.health import NO_PLACE, HealthTable, ServiceState, SlamHealth
from monstertruck_schemas.plan import ExplorationPhase, ExplorationState, GoalPhase, GoalState
from monstertruck_schemas.points import PointKind, PointsOfInterest
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import ExploreRequest, GoalControl, GoalOrder, GoalRequest
from monstertruck_schemas.roles import ServiceName
from monstertruck_schemas.sensor import Battery, BatteryLevel
from monstertruck_schemas.state import GateMode, GateState, Grid, Odometry
from monstertruck_schemas.topics import BATTERY, POSE, SLAM
from monstertruck_schemas.zones import Zones

SOURCE: Final = ServiceName.EXPLORER.value
"""Source of the goals."""
CHANGES: Final = ("number", "phase", "outcome", "goals", "failures")
"""Report fields whose change triggers an immediate report."""
LOW: Final = frozenset({BatteryLevel.LOW, BatteryLevel.CRITICAL})
TILES: Final = 4096
"""Maximum number of tiles kept since the latest whole map."""


@dataclass(frozen=True, slots=True)
class ExplorerInputs:
    """Input topics."""

    gate: Subscription[GateState]
    pose: Subscription[Odometry]
    goal: Subscription[GoalState]
    grid: Subscription[Grid]
    tiles: Mailbox[Grid]
    slam: Subscription[SlamHealth]
    battery: Subscription[Battery]
    events: Mailbox[Event]
    health: Subscription[HealthTable]
    points: Subscription[PointsOfInterest] | None = None
    zones: Subscription[Zones] | None = None


class ExplorerService:
    """Explores on request.

    Args:
        setup: explorer settings and robot data.
        clock: time source.
        actor: runs the exploring step; started with the first exploration.
        goals: goal service that drives the robot.
        save: requests saving the map; returns whether it can be saved. None if there is no map to save.
        max_age: see ``GateConfig.max_request_age``.
        inputs: input topics.
        state: publisher of ``plan/explore``.
        events: sink for decisions.
    """

    name = SOURCE
    noun = "exploration"
    resumable = False

    def __init__(
        self,
        setup: ExploreSetup,
        clock: Clock,
        actor: Actor,
        goals: GoalService,
        save: Callable[[], bool] | None,
        *,
        max_age: float,
        inputs: ExplorerInputs,
        state: Publisher[ExplorationState],
        events: EventSink,
    ) -> None:
        self._setup, self._config, self._clock, self._place = setup, setup.config, clock, actor
        self._goals, self._save = goals, save
        self._in, self._events = inputs, events
        # SECOND // 2: period of reports without a change, ns
        self.tasks = TaskServer[ExploreRequest, Pose2, ExplorationState](
            self, clock, inputs.gate, max_age, state, changes=CHANGES, period=SECOND // 2, others=(inputs.goal,)
        )
        self._run: Exploration | None = None
        self._tiles: deque[Grid] = deque(maxlen=TILES)
        self._whole: Grid | None = None
        self._sent_whole: Grid | None = None
        self._sent_tiles = 0
        self._sent_zones: Zones | None = None
        self._fresh = True
        self._deciding: asyncio.Task[ExploreAnswer] | None = None
        self._tasks: asyncio.TaskGroup | None = None
        self._actor: Actor | None = None
        self._seq = 0
        self._goal: int | None = None
        self._others = 0
        """Number of the latest goal when the exploration was started."""
        self._refused: tuple[Reason, str] | None = None
        self._placed = 0
        self._saves: int | None = None
        """Time of the request to save the map (ns)."""
        self._cannot_save = False

    async def run(self, ready: Ready) -> None:
        """Serve until cancelled."""
        async with self._place as actor, asyncio.TaskGroup() as tasks:
            self._actor, self._tasks, self._fresh = actor, tasks, True
            self.tasks.report()
            ready()
            schedule = Schedule(self._clock, 5.0)  # checks per second
            try:
                while True:
                    await schedule.next()
                    self._tick(self._clock.now())
            finally:
                self._goals.hold(SOURCE, on=False)

    # Requests

    @property
    def running(self) -> bool:
        """Whether an exploration is running."""
        return self._run is not None and self._run.running

    def accept(self, request: ExploreRequest) -> Pose2:
        """Return the start pose of an exploration.

        Raises:
            RequestRefusedError: the pose is unknown, or points of interest are requested and the robot keeps none.
        """
        if request.find is not None and self._in.points is None:
            raise RequestRefusedError(
                Reason.NOT_SUPPORTED, "this robot does not record points of interest: add a section `points`"
            )
        if (pose := self._pose(self._clock.now())) is None:
            raise RequestRefusedError(
                Reason.NO_MAP, "no pose in a map yet; `monstertruckd status` shows whether slam is ready"
            )
        return pose

    def begin(self, accepted: Pose2, request: ExploreRequest, number: int) -> None:
        """Start exploring from a pose."""
        self._fresh, self._goal, self._refused, self._saves = True, None, None, None
        self._deciding = None  # discard a pending answer to the previous exploration
        goal, config = self._in.goal.latest, self._config
        self._others = 0 if goal is None else goal.number
        self._do(
            exploration.begin(
                number,
                request.source,
                accepted,
                self._clock.now() / SECOND,
                config,
                home=config.home if request.home is None else request.home,
                budget=request.budget or config.budget,
                find=request.find,
            )
        )

    def control(self, request: ExploreRequest) -> None:
        """End the exploration; the map is saved first."""
        assert self._run is not None
        self._do(exploration.stop(self._run, request.source, self._clock.now() / SECOND))

    def register(self, rpc: RpcRegistry) -> None:
        """Serve ``explore``."""
        self.tasks.register(rpc, "explore", ExploreRequest)

    def state(self, now: int) -> ExplorationState:
        """Return the report on the latest exploration."""
        return state_of(self._run, self._config.kind, now)

    # Observations

    def _tick(self, now: int) -> None:
        self._keep_map()
        saved, failure = self._saved()
        run = self._run
        if run is not None and run.running:
            self._do(exploration.tick(run, self._observe(now, saved, failure), self._config))
        run = self._run
        self._goals.hold(SOURCE, on=run is not None and run.running and run.phase is not ExplorationPhase.SAVING)
        self.tasks.report()

    def _keep_map(self) -> None:
        whole = self._in.grid.latest
        if whole is not self._whole:
            self._whole = whole
            kept = [tile for tile in self._tiles if whole is None or tile.received > whole.received]
            self._tiles.clear()
            self._tiles.extend(kept)
            self._sent_tiles = 0
        for tile in self._in.tiles.drain():
            if self._whole is None or tile.received > self._whole.received:
                if len(self._tiles) == TILES:
                    self._sent_tiles = max(self._sent_tiles - 1, 0)
                self._tiles.append(tile)

    def _saved(self) -> tuple[str | None, str]:
        """Return where the map was saved since the request (empty if saving failed), and the reason of a failure."""
        saved, failure = None, ""
        for event in self._in.events.drain():
            if self._saves is None or event.received < self._saves:
                continue
            if event.reason is Reason.MAP_SAVED:
                saved = event.text
            elif event.reason is Reason.MAP_NOT_SAVED:
                saved, failure = "", event.text
        return "" if self._cannot_save and self._saves is not None else saved, failure

    def _observe(self, now: int, saved: str | None, save_failure: str) -> Observed:
        answer = None
        if self._deciding is not None and self._deciding.done():
            answer, self._deciding = self._deciding.result(), None
        (ended, text, displaced), goal = self._goal_end(), self._in.goal.latest
        gate = self._in.gate.latest
        battery = self._in.battery.latest
        fresh = battery is not None and now - battery.received <= BATTERY.fresh_for() * SECOND
        return Observed(
            now=now / SECOND,
            pose=self._pose(now),
            believed=self._believed(now),
            ended=ended,
            ended_text=text,
            displaced=displaced,
            estopped=gate is not None and gate.mode is GateMode.ESTOPPED,
            paused=goal is not None and goal.number == self._goal and goal.phase is GoalPhase.PAUSED,
            answer=answer,
            charge=battery.charge if battery is not None and fresh else None,
            low=battery is not None and fresh and battery.level in LOW,
            critical=battery is not None and fresh and battery.level is BatteryLevel.CRITICAL,
            saved=saved,
            save_failure=save_failure,
            refused=self._refused is not None,
            failed=self._failed(),
            found=self._found(),
        )

    def _failed(self) -> str:
        """Permanently failed services with details: the goal service, and any that make the gate block driving."""
        table, gate = self._in.health.latest, self._in.gate.latest
        blocked = gate is not None and Reason.SERVICE_FAILED in gate.reasons
        failed = () if table is None else [row for row in table.services if row.state is ServiceState.FAILED]
        names = [f"{row.name}: {row.detail}" for row in failed if blocked or row.name == ServiceName.GOALS]
        return "; ".join(names)

    def _found(self) -> int:
        """Number of known tags."""
        message = None if self._in.points is None else self._in.points.latest
        return 0 if message is None else sum(point.kind is PointKind.TAG for point in message.points)

    def _goal_end(self) -> tuple[Reason | None, str, str]:
        """Return outcome and text of the explorer's goal, and the source of the goal that replaced it."""
        goal = self._in.goal.latest
        newer = goal is not None and (self._goal is None or goal.number > self._goal)
        if goal is not None and goal.source != SOURCE and goal.number > self._others and newer:
            return None, "", goal.source
        if self._refused is not None:
            return *self._refused, ""
        if goal is None or goal.number != self._goal or goal.phase is not GoalPhase.IDLE:
            return None, "", ""
        return goal.outcome, goal.text, ""

    def _believed(self, now: int) -> Pose2 | None:
        """Return the fresh pose of the base in the map frame, even if it is unreliable."""
        pose = self._in.pose.latest
        return None if pose is None or now - pose.received > POSE.fresh_for() * SECOND else pose_of(pose)

    def _pose(self, now: int) -> Pose2 | None:
        """Return the pose of the base in the map frame while localised, else None."""
        pose, slam = self._believed(now), self._in.slam.latest
        if pose is None:
            return None
        if slam is None or slam.standing not in NO_PLACE or now - slam.received > SLAM.fresh_for() * SECOND:
            self._placed = now
        # 1.0: seconds without localisation until the robot is lost
        return pose if now - self._placed <= 1.0 * SECOND else None

    # Decisions

    def _do(self, step: tuple[Exploration, tuple[Action, ...]]) -> None:
        self._run, actions = step
        for action in actions:
            match action:
                case Notice(reason, severity, text):
                    self._events(reason, severity, SOURCE, text, exploration=self._run.number)
                case Choose():
                    self._choose(self._run)
                case Go(pose):
                    self._go(pose)
                case Cancel():
                    self._cancel()
                case Save():
                    self._saves, self._cannot_save = self._clock.now(), self._save is None or not self._save()
        if actions:
            self.tasks.report()

    def _choose(self, run: Exploration) -> None:
        assert self._tasks is not None
        assert run.before is not None
        newest = None if self._in.zones is None else self._in.zones.latest
        zones = newest if self._fresh else changed(newest, self._sent_zones)
        resent = self._fresh or zones is not None or self._whole is not self._sent_whole
        whole = self._whole if resent else None
        if whole is not None:
            self._sent_tiles = 0
        tiles = tuple(self._tiles)[self._sent_tiles :]
        now = self._clock.now() / SECOND
        task = ExploreTask(
            run.before,
            whole=whole,
            tiles=tiles,
            setup=self._setup if self._fresh else None,
            choose=True,
            current=run.target,
            pursued=now - run.pursued,
            banned=run.attempts.banned(now),
            avoided=run.unreached.banned(now),
            home=run.home,
            find=run.find is not None,
            zones=zones,
        )
        self._sent_zones = newest
        self._fresh, self._sent_whole, self._sent_tiles = False, self._whole, len(self._tiles)
        self._deciding = self._tasks.create_task(self._ask(task))

    async def _ask(self, task: ExploreTask) -> ExploreAnswer:
        """Return the worker's answer; if the worker failed and restarts, an answer with the failure."""
        assert self._actor is not None
        try:
            answer: ExploreAnswer = await self._actor.step(task)
        except TruckError as error:
            self._fresh, text = True, str(error)
            self._events(error.reason, Severity.ERROR, SOURCE, text)
            kept = task.current is not None
            return ExploreAnswer(task.current, kept=kept, failure=error.reason, text=text.partition("\n")[0])
        if answer.kept:  # the worker returns a copy of the target
            return replace(answer, target=task.current)
        return answer

    def _header(self) -> dict[str, Any]:
        self._seq += 1
        return inner_request(self._seq, self._in.gate.latest, self._clock.now(), SOURCE)

    def _go(self, pose: Pose2) -> None:
        x, y, yaw = pose
        self._refused = None
        try:
            self._goal = self._goals.tasks.take(
                GoalRequest(**self._header(), frame="map", goal=Pose2D(x=x, y=y, yaw=math.remainder(yaw, math.tau)))
            )
        except RequestRefusedError as error:
            self._refused = error.refusal, str(error)

    def _cancel(self) -> None:
        """Cancel the explorer's goal if it is still active."""
        goal = self._in.goal.latest
        if goal is None or self._goal != goal.number or goal.phase is GoalPhase.IDLE:
            self._goal = None
            return
        self._goal = None
        with suppress(RequestRefusedError):  # since that report it has ended, or another source has replaced it
            self._goals.tasks.take(GoalControl(**self._header(), order=GoalOrder.CANCEL, own=True))


def state_of(run: Exploration | None, kind: str, now: int) -> ExplorationState:
    """Return the report on an exploration, with sequence number 0."""
    if run is None:
        return ExplorationState(stamp=now, received=now, seq=0, frame="map", kind=kind)
    target = None if run.target is None else run.target.pose
    return ExplorationState(
        stamp=now,
        received=now,
        seq=0,
        frame="map",
        number=run.number,
        kind=kind,
        source=run.source,
        phase=run.phase,
        outcome=run.outcome,
        text=run.text,
        target=None if target is None else Pose2D(x=target[0], y=target[1], yaw=target[2]),
        frontiers=run.newest.frontiers,
        left_alone=run.newest.banned,
        known=run.newest.known,
        travelled=run.travelled,
        elapsed=run.now - run.begun,
        home=run.newest.home,
        goals=run.goals,
        failures=run.failures,
        find=run.find,
        found=run.found,
    )
