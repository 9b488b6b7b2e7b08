"""Service that runs one behaviour at a time, started and stopped by remote calls; it requests motion from the gate."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Any, Final

from pydantic import ValidationError

from monstertruck_kinematics.elementary import KinematicsError
from monstertruck_planners.behave.api import (
    Behaviour,
    BehaviourBody,
    BehaviourConfig,
    BehaviourStep,
    Inputs,
    RequestedMotion,
)
from monstertruck_planners.behave.catalog import BEHAVIOURS
from monstertruck_planners.tasks import TaskServer
from monstertruck_runtime.clock import SECOND, Clock, Schedule
from monstertruck_runtime.errors import InputError, NotFoundError, RequestRefusedError
from monstertruck_runtime.mailbox import latest
from monstertruck_runtime.ports import BusPort, EventSink, Publisher, Ready, RpcRegistry, Subscription
from monstertruck_runtime.requests import does_not_drive, planner_request
from monstertruck_schemas.base import Message, first_mistake
from monstertruck_schemas.event import Severity
from monstertruck_schemas.plan import BehaviourState, DockTarget, GoalState, TrackerState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import BehaviourRequest, DriveRequest, RequestedTwist
from monstertruck_schemas.roles import AccessRole, ServiceName
from monstertruck_schemas.state import GateMode, GateState, Odometry
from monstertruck_schemas.topics import BEHAVIOUR, GATE, GOAL, ODOMETRY, TRACKER, Topic, Writer

SOURCE: Final = ServiceName.BEHAVIOURS.value
"""Source of the drive requests."""
CHANGES: Final = ("number", "running", "phase", "outcome")
"""Fields of the report whose change is reported at once."""


@dataclass(frozen=True, slots=True)
class BehaviourRun:
    """Current or latest run of a behaviour."""

    number: int
    name: str
    config: BehaviourConfig
    behaviour: Behaviour
    source: str
    begun: int
    state: Any
    phase: str = ""
    outcome: Reason = Reason.DRIVING
    text: str = ""
    ended: int | None = None
    values: Mapping[str, float] | None = None
    dock: DockTarget | None = None
    travelled: float = 0.0
    disobeyed: int | None = None
    """Time since which the gate has not executed the requested motion, ns."""

    @property
    def running(self) -> bool:
        """Whether the behaviour is running."""
        return self.outcome is Reason.DRIVING


class BehaviourService:
    """Runs one of the configured behaviours at a time.

    Args:
        configs: configurations by name.
        clock: time.
        bus: the topics that behaviours read.
        drive: ``plan/drive``, shared with the other planners.
        max_age: see ``GateConfig.max_request_age``.
        body: robot body that the behaviours move.
    """

    name = SOURCE
    noun = "behaviour"
    resumable = False

    def __init__(
        self,
        configs: Mapping[str, BehaviourConfig],
        clock: Clock,
        bus: BusPort,
        drive: Publisher[DriveRequest],
        max_age: float,
        body: BehaviourBody,
    ) -> None:
        self.configs, self._clock, self._drive, self._body = configs, clock, drive, body
        reads = [_reads(BEHAVIOURS.implementation(config)) for config in configs.values()]
        topics = {topic.name: topic for some in reads for topic in some}
        self._read: dict[str, Subscription[Any]] = {
            name: bus.subscribe(topic, latest()) for name, topic in topics.items()
        }
        self._gate: Subscription[GateState] = bus.subscribe(GATE, latest())
        self._odometry: Subscription[Odometry] = bus.subscribe(ODOMETRY, latest())
        self._goal: Subscription[GoalState] = bus.subscribe(GOAL, latest())
        self._tracker: Subscription[TrackerState] = bus.subscribe(TRACKER, latest())
        self._events: EventSink = bus.event_sink()
        self.tasks = TaskServer[BehaviourRequest, tuple[BehaviourConfig, Behaviour], BehaviourState](
            self,
            clock,
            self._gate,
            max_age,
            bus.publisher(BEHAVIOUR, Writer.PLANNER),
            changes=CHANGES,
            period=SECOND // 5,  # period of reports without a change, ns
            others=(self._goal,),
            drives=attrgetter("accepts_motion"),
        )
        self._run: BehaviourRun | None = None
        self._pose: Odometry | None = None

    async def run(self, ready: Ready) -> None:
        """Serve until cancelled."""
        self.tasks.report()
        ready()
        # 10.0: steps a second of a service whose behaviours all have others
        rate = max((config.rate for config in self.configs.values()), default=10.0)
        schedule, due = Schedule(self._clock, rate), 0.0
        while True:
            await schedule.next()
            now, run = self._clock.now(), self._run
            if run is not None and run.running:
                due += run.config.rate / rate
                if due >= 1.0 - 1e-9:
                    due -= 1.0
                    self._step(run, now)
            else:
                due = 0.0
                self._settle(now)
            self.tasks.report()

    # Requests

    def check(self, name: str, settings: Mapping[str, Any]) -> None:
        """Check whether a behaviour with these settings could start if the robot were ready to drive.

        Raises:
            NotFoundError: no such behaviour is configured.
            InputError: the settings are wrong or incomplete; the text names the first key.
            RequestRefusedError: the body cannot execute the behaviour.
        """
        self._configured(name, settings)

    def _configured(self, name: str, settings: Mapping[str, Any]) -> tuple[BehaviourConfig, Behaviour]:
        """Return the settings of a run, and the behaviour with them. Raises the errors of ``check``."""
        if name not in self.configs:
            raise NotFoundError(f"no behaviour {name!r}: expected one of {', '.join(self.configs) or 'none'}")
        config = _with_settings(self.configs[name], settings)
        implementation = BEHAVIOURS.implementation(config)
        fit = getattr(implementation, "fit", None)
        try:
            return config, implementation(config) if fit is None else fit(config, self._body)
        except KinematicsError as error:
            raise RequestRefusedError(Reason.IMPOSSIBLE_MOTION, str(error)) from error
        except ValueError as error:
            raise InputError(f"settings: {error}") from error

    @property
    def running(self) -> bool:
        """Whether a behaviour runs."""
        return self._run is not None and self._run.running

    def accept(self, request: BehaviourRequest) -> tuple[BehaviourConfig, Behaviour]:
        """Return the settings of a run, and the behaviour with these settings.

        Raises:
            NotFoundError: no such behaviour is configured.
            InputError: the settings are wrong or incomplete; the text names the first key.
            RequestRefusedError: the body cannot execute it, the robot follows a path, or an input of the behaviour is
                missing.
        """
        config, behaviour = self._configured(request.behaviour, request.settings)
        now, gate = self._clock.now(), self._gate.latest
        if (path := self._path(now)) is not None:
            moves = gate is not None and gate.mode.accepts_motion
            raise RequestRefusedError(Reason.BUSY, path if moves else f"{path} as soon as the robot is armed")
        if (stale := self._stale(behaviour, now)) is not None:
            raise RequestRefusedError(Reason.INPUT_STALE, stale)
        return config, behaviour

    def begin(self, accepted: tuple[BehaviourConfig, Behaviour], request: BehaviourRequest, number: int) -> None:
        """Start a behaviour."""
        name, (config, behaviour) = request.behaviour, accepted
        now = self._clock.now()
        self._run = BehaviourRun(number, name, config, behaviour, request.source, now, behaviour.begin())
        self._pose = self._odometry.latest
        self._events(Reason.BEHAVIOUR_STARTED, Severity.INFO, SOURCE, f"{name} started by {request.source}")

    def control(self, request: BehaviourRequest) -> None:
        """Stop the behaviour if its name matches."""
        assert self._run is not None
        if request.behaviour not in ("", self._run.name):
            raise RequestRefusedError(Reason.NOT_FOUND, f"the behaviour {request.behaviour} is not running")
        self._end(self._run, Reason.CANCELLED, f"stopped by {request.source}", self._clock.now())

    def _path(self, now: int) -> str | None:
        """Describe the path that the robot follows; None without one."""
        tracker = self._tracker.latest
        following = tracker is not None and now - tracker.received <= TRACKER.fresh_for() * SECOND
        if following and tracker is not None and tracker.outcome is Reason.DRIVING:
            return f"the tracker follows the path {tracker.path!r}"
        return None

    # Steps

    def _step(self, run: BehaviourRun, now: int) -> None:
        run = self._moved(run)
        if (why := self._interrupted(run, now)) is not None:
            self._end(run, *why, now)
            return
        messages: dict[str, Message] = {}
        for topic in _reads(run.behaviour):
            message = self._read[topic.name].latest
            if message is not None and now - message.received <= topic.fresh_for() * SECOND:
                messages[topic.name] = message
        step: BehaviourStep = run.behaviour.step(Inputs(messages), run.state, (now - run.begun) / SECOND)
        run = replace(run, state=step.state, phase=step.phase, values=step.values, dock=step.dock)
        motion = step.motion or RequestedMotion()
        if not all(map(math.isfinite, motion)):
            self._end(run, Reason.NOT_FINITE, f"{run.name} requested {motion}", now)
        elif step.outcome is not Reason.DRIVING:
            self._end(run, step.outcome, step.text, now)
        else:
            self._run = self._judged(run, motion, now)
            self._ask(motion, now)

    def _interrupted(self, run: BehaviourRun, now: int) -> tuple[Reason, str] | None:
        """Return the reason that prevents the behaviour from continuing."""
        gate = self._gate.latest
        if gate is None or not gate.mode.active:
            error = does_not_drive(gate)
            return error.refusal, str(error)
        if gate.mode is GateMode.STOPPING and Reason.STOPPED in gate.reasons:
            return Reason.CANCELLED, "the robot was ordered to stop"
        if (other := self.tasks.other() or self._path(now)) is not None:
            return Reason.BUSY, other
        if (stale := self._stale(run.behaviour, now)) is not None:
            return Reason.INPUT_STALE, stale
        # 2.0: maximum time of requested but not executed motion (s); the behaviour then gives up
        if run.disobeyed is not None and now - run.disobeyed > 2.0 * SECOND:
            reason = next(iter(gate.reasons), Reason.NOT_OBEYED)
            return reason, f"the gate does not let it drive: {gate.why}"
        return None

    def _stale(self, behaviour: Behaviour, now: int) -> str | None:
        for topic in behaviour.reads:
            message = self._read[topic.name].latest
            if message is None:
                return f"no message received on {topic.name}"
            if (age := (now - message.received) / SECOND) > topic.fresh_for():
                return f"no message received on {topic.name} for {age:.2f} s"
        return None

    def _judged(self, run: BehaviourRun, motion: RequestedMotion, now: int) -> BehaviourRun:
        """Note the time since which the gate has not executed requested motion."""
        gate = self._gate.latest
        obeyed = gate is not None and gate.mode is GateMode.DRIVING and gate.holder == SOURCE
        if obeyed and gate is not None and gate.twist is not None:
            obeyed = any((gate.twist.vx, gate.twist.vy, gate.twist.wz))
        if obeyed or max(map(abs, motion)) < 1e-3:
            return replace(run, disobeyed=None)
        return run if run.disobeyed is not None else replace(run, disobeyed=now)

    def _moved(self, run: BehaviourRun) -> BehaviourRun:
        odometry, before = self._odometry.latest, self._pose
        self._pose = odometry
        if odometry is None or before is None:
            return run
        distance = math.hypot(odometry.pose.x - before.pose.x, odometry.pose.y - before.pose.y)
        return replace(run, travelled=run.travelled + distance)

    def _end(self, run: BehaviourRun, outcome: Reason, text: str, now: int) -> None:
        self._run = replace(run, outcome=outcome, text=text or outcome.text, ended=now)
        good = outcome in (Reason.BEHAVIOUR_DONE, Reason.CANCELLED)
        severity = Severity.INFO if good else Severity.WARNING
        self._events(outcome, severity, SOURCE, f"{run.name} ended: {text or outcome.text}")
        self._ask(RequestedMotion(), now)

    def _settle(self, now: int) -> None:
        """Request standstill until the robot is at rest, then send nothing."""
        run, odometry = self._run, self._odometry.latest
        # 1.0: duration of the standstill requests after the end (s)
        if run is None or run.ended is None or now - run.ended > 1.0 * SECOND:
            return
        still = odometry is not None and max(abs(odometry.twist.vx), abs(odometry.twist.wz)) < 0.01  # m/s, rad/s
        if not still:
            self._ask(RequestedMotion(), now)

    def _ask(self, motion: RequestedMotion, now: int) -> None:
        gate = self._gate.latest
        if gate is None or not gate.mode.active:
            return
        twist = RequestedTwist(vx=motion.vx, vy=motion.vy, wz=motion.wz)
        seq = self._drive.next_seq()
        # 0.3: lease of each drive request, s
        self._drive.put(planner_request(seq, gate, now, SOURCE, 0.3, speed=0.0, front=0.0, twist=twist))

    def state(self, now: int) -> BehaviourState:
        """Report on the latest behaviour."""
        run = self._run
        if run is None:
            return BehaviourState(stamp=now, received=now, seq=0, frame="odom")
        return BehaviourState(
            stamp=now,
            received=now,
            seq=0,
            frame="odom",
            number=run.number,
            behaviour=run.name,
            kind=run.config.kind,
            source=run.source,
            running=run.running,
            phase=run.phase,
            outcome=run.outcome,
            text=run.text,
            elapsed=((now if run.ended is None else run.ended) - run.begun) / SECOND,
            travelled=run.travelled,
            values=dict(run.values or {}),
            dock=run.dock,
        )

    def register(self, rpc: RpcRegistry) -> None:
        """Serve ``behave`` and ``behaviours``, which lists the configured behaviours."""

        async def behaviours(_: dict[str, Any]) -> dict[str, Any]:
            return {name: {"kind": one.kind, "doc": BEHAVIOURS[one.kind].doc} for name, one in self.configs.items()}

        self.tasks.register(rpc, "behave", BehaviourRequest)
        rpc.register("behaviours", behaviours, AccessRole.OBSERVER, recorded=False)


def _reads(behaviour: Any) -> tuple[Topic[Any], ...]:
    """Return all topics that a behaviour or its class reads or may read."""
    return (*behaviour.reads, *getattr(behaviour, "may_read", ()))


def _with_settings(config: BehaviourConfig, settings: Mapping[str, Any]) -> BehaviourConfig:
    """Return the settings, with those given for one run.

    Raises:
        InputError: a given setting is wrong; the text names the first.
    """
    if not settings:
        return config
    if unknown := settings.keys() - type(config).model_fields.keys() | settings.keys() & {"kind", "rate"}:
        raise InputError(f"settings.{min(unknown)}: not a setting of {config.kind} for one run")
    try:
        return type(config).model_validate({**config.model_dump(), **settings})
    except ValidationError as error:
        raise InputError(first_mistake(error, "settings")) from None
