"""Behaviours as a service: started and stopped by remote call, one at a time; the gate is asked for their motion."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
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
from monstertruck_runtime.clock import SECOND, Clock, Schedule
from monstertruck_runtime.errors import InputError, NotFoundError, RequestRefusedError
from monstertruck_runtime.mailbox import latest
from monstertruck_runtime.ports import BusPort, EventSink, Publisher, Ready, RpcRegistry, Subscription
from monstertruck_runtime.requests import Sequences, does_not_drive, examine, planner_request, register_numbered
from monstertruck_schemas.base import Message, first_mistake
from monstertruck_schemas.event import Severity
from monstertruck_schemas.plan import BehaviourState, GoalPhase, GoalState, TrackerState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import BehaviourOrder, BehaviourRequest, DriveRequest, RequestedTwist
from monstertruck_schemas.roles import AccessRole, ServiceName
from monstertruck_schemas.state import GateMode, GateState, Odometry
from monstertruck_schemas.topics import BEHAVIOUR, GATE, GOAL, ODOMETRY, TRACKER, Writer

SOURCE: Final = ServiceName.BEHAVIOURS.value
"""Source of the drive requests."""
LEASE: Final = 0.3
"""Lease of each drive request, s."""
REPORT: Final = SECOND // 5
"""Period of reports without a change, ns."""
DISOBEYED: Final = 2.0
"""Seconds of requested but not executed motion after which a behaviour gives up."""
SETTLE: Final = 1.0
"""Seconds for which standstill is requested after the end."""
AT_REST: Final = 0.01
"""m/s, rad/s."""
IDLE_RATE: Final = 10.0
"""Steps a second of a service whose behaviours all have others."""


@dataclass(frozen=True, slots=True)
class BehaviourRun:
    """A behaviour that runs, or was the last."""

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
    travelled: float = 0.0
    disobeyed: int | None = None
    """Since when the gate does not carry out the requested motion, ns."""

    @property
    def running(self) -> bool:
        """Whether it runs."""
        return self.outcome is Reason.DRIVING


class BehaviourService:
    """Runs one of the configured behaviours at a time.

    Args:
        configs: by name.
        clock: time.
        bus: the topics that behaviours read.
        drive: ``plan/drive``, shared with the other planners.
        max_age: see ``GateConfig.max_request_age``.
        body: what they move.
    """

    name = SOURCE

    def __init__(
        self,
        configs: Mapping[str, BehaviourConfig],
        clock: Clock,
        bus: BusPort,
        drive: Publisher[DriveRequest],
        max_age: float,
        body: BehaviourBody,
    ) -> None:
        self.configs, self._clock, self._drive, self._max_age, self._body = configs, clock, drive, max_age, body
        reads = [BEHAVIOURS.implementation(config).reads for config in configs.values()]
        topics = {topic.name: topic for some in reads for topic in some}
        self._read: dict[str, Subscription[Any]] = {
            name: bus.subscribe(topic, latest()) for name, topic in topics.items()
        }
        self._gate: Subscription[GateState] = bus.subscribe(GATE, latest())
        self._odometry: Subscription[Odometry] = bus.subscribe(ODOMETRY, latest())
        self._goal: Subscription[GoalState] = bus.subscribe(GOAL, latest())
        self._tracker: Subscription[TrackerState] = bus.subscribe(TRACKER, latest())
        self._out: Publisher[BehaviourState] = bus.publisher(BEHAVIOUR, Writer.PLANNER)
        self._events: EventSink = bus.event_sink()
        self._sequences = Sequences(max_age)
        self._run: BehaviourRun | None = None
        self._program: tuple[str, str | None] | None = None
        """Which started it."""
        self._pose: Odometry | None = None
        self._reported: BehaviourState | None = None

    async def run(self, ready: Ready) -> None:
        """Serve until cancelled."""
        self._report(self._clock.now())
        ready()
        rate = max((config.rate for config in self.configs.values()), default=IDLE_RATE)
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
            self._report(now)

    # Requests

    def check(self, name: str, settings: Mapping[str, Any]) -> None:
        """Whether a behaviour could be started with these settings, were the robot ready to drive.

        Raises:
            NotFoundError: no such behaviour is configured.
            InputError: the settings are wrong, or not complete; the text names the first key.
            RequestRefusedError: the body cannot do that.
        """
        self._configured(name, settings)

    def _configured(self, name: str, settings: Mapping[str, Any]) -> tuple[BehaviourConfig, Behaviour]:
        """The settings of a run, and the behaviour with them. Raises as ``check`` does."""
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

    def take(self, request: BehaviourRequest) -> int:
        """Carry out a request; returns the number of the behaviour it started or stopped.

        Raises:
            NotFoundError: no such behaviour is configured.
            RequestRefusedError: the sender may not, or it cannot be done now.
        """
        now, starts = self._clock.now(), request.order is BehaviourOrder.START
        gate = self._gate.latest
        examine(request, gate, self._sequences, now, self._max_age if starts else None)
        return self._start(request, gate, now) if starts else self._stop(request, now)

    def _start(self, request: BehaviourRequest, gate: GateState | None, now: int) -> int:
        name, run = request.behaviour, self._run
        config, behaviour = self._configured(name, request.settings)
        if run is not None and run.running:
            raise RequestRefusedError(
                Reason.BUSY, f"the behaviour {run.name} of {run.source} is running, stop it first"
            )
        moves = gate is not None and gate.mode.accepts_motion
        if (other := self._other_planner(now)) is not None:
            raise RequestRefusedError(Reason.BUSY, other if moves else f"{other} as soon as the robot is armed")
        if (stale := self._stale(behaviour, now)) is not None:
            raise RequestRefusedError(Reason.INPUT_STALE, stale)
        if not moves:  # the last one: for this a client arms it
            raise does_not_drive(gate)
        number = 1 if run is None else run.number + 1
        self._run = BehaviourRun(number, name, config, behaviour, request.source, now, behaviour.begin())
        self._program, self._pose = request.program, self._odometry.latest
        self._events(Reason.BEHAVIOUR_STARTED, Severity.INFO, SOURCE, f"{name} started by {request.source}")
        self._report(now)
        return number

    def _stop(self, request: BehaviourRequest, now: int) -> int:
        run = self._run
        if run is not None and run.running and request.own and request.program != self._program:
            raise RequestRefusedError(Reason.NOT_FOUND, f"the behaviour {run.name} of {run.source} is running")
        if run is None or not run.running or request.behaviour not in ("", run.name):
            name = request.behaviour
            text = f"the behaviour {name} is not running" if name else "no behaviour is running"
            raise RequestRefusedError(Reason.NOT_FOUND, text)
        self._end(run, Reason.CANCELLED, f"stopped by {request.source}", now)
        self._report(now)
        return run.number

    def _other_planner(self, now: int) -> str | None:
        """What else asks for motion."""
        goal, tracker = self._goal.latest, self._tracker.latest
        if goal is not None and goal.phase is not GoalPhase.IDLE:
            return f"goal {goal.number} of {goal.source} is pursued, cancel it first"
        following = tracker is not None and now - tracker.received <= TRACKER.fresh_for() * SECOND
        if following and tracker is not None and tracker.outcome is Reason.DRIVING:
            return f"the path {tracker.path!r} is followed"
        return None

    # Steps

    def _step(self, run: BehaviourRun, now: int) -> None:
        run = self._moved(run)
        if (why := self._interrupted(run, now)) is not None:
            self._end(run, *why, now)
            return
        newest = {topic.name: self._read[topic.name].latest for topic in run.behaviour.reads}
        messages: dict[str, Message] = {name: message for name, message in newest.items() if message is not None}
        step: BehaviourStep = run.behaviour.step(Inputs(messages), run.state, (now - run.begun) / SECOND)
        run = replace(run, state=step.state, phase=step.phase, values=step.values)
        motion = step.motion or RequestedMotion()
        if not all(map(math.isfinite, motion)):
            self._end(run, Reason.NOT_FINITE, f"{run.name} asked for {motion}", now)
        elif step.outcome is not Reason.DRIVING:
            self._end(run, step.outcome, step.text, now)
        else:
            self._run = self._judged(run, motion, now)
            self._ask(motion, now)

    def _interrupted(self, run: BehaviourRun, now: int) -> tuple[Reason, str] | None:
        """Why the behaviour cannot go on."""
        gate = self._gate.latest
        if gate is None or not gate.mode.active:
            error = does_not_drive(gate)
            return error.refusal, str(error)
        if gate.mode is GateMode.STOPPING and Reason.STOPPED in gate.reasons:
            return Reason.CANCELLED, "the robot was ordered to stop"
        if (other := self._other_planner(now)) is not None:
            return Reason.BUSY, other
        if (stale := self._stale(run.behaviour, now)) is not None:
            return Reason.INPUT_STALE, stale
        if run.disobeyed is not None and now - run.disobeyed > DISOBEYED * SECOND:
            reason = next(iter(gate.reasons), Reason.NOT_OBEYED)
            return reason, f"the gate does not let it drive: {gate.why}"
        return None

    def _stale(self, behaviour: Behaviour, now: int) -> str | None:
        for topic in behaviour.reads:
            message = self._read[topic.name].latest
            if message is None:
                return f"nothing came on {topic.name}"
            if (age := (now - message.received) / SECOND) > topic.fresh_for():
                return f"nothing came on {topic.name} for {age:.2f} s"
        return None

    def _judged(self, run: BehaviourRun, motion: RequestedMotion, now: int) -> BehaviourRun:
        """Note since when the gate does not carry out motion that was requested."""
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
        """Ask for standstill until the robot is at rest, then send nothing."""
        run, odometry = self._run, self._odometry.latest
        if run is None or run.ended is None or now - run.ended > SETTLE * SECOND:
            return
        still = odometry is not None and max(abs(odometry.twist.vx), abs(odometry.twist.wz)) < AT_REST
        if not still:
            self._ask(RequestedMotion(), now)

    def _ask(self, motion: RequestedMotion, now: int) -> None:
        gate = self._gate.latest
        if gate is None or not gate.mode.active:
            return
        twist = RequestedTwist(vx=motion.vx, vy=motion.vy, wz=motion.wz)
        seq = self._drive.next_seq()
        self._drive.put(planner_request(seq, gate, now, SOURCE, LEASE, speed=0.0, front=0.0, twist=twist))

    def _report(self, now: int) -> None:
        state, before = self._state(now), self._reported
        changed = before is None or any(
            getattr(before, name) != getattr(state, name) for name in ("number", "running", "phase", "outcome")
        )
        if before is not None and not changed and (not state.running or now - before.stamp < REPORT):
            return
        self._reported = state.model_copy(update={"seq": self._out.next_seq()})
        self._out.put(self._reported)

    def _state(self, now: int) -> BehaviourState:
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
        )


def _with_settings(config: BehaviourConfig, settings: Mapping[str, Any]) -> BehaviourConfig:
    """Settings with those that are given for one run.

    Raises:
        InputError: one of them is wrong; the text names the first.
    """
    if not settings:
        return config
    if unknown := settings.keys() - type(config).model_fields.keys() | settings.keys() & {"kind", "rate"}:
        raise InputError(f"settings.{min(unknown)}: no setting of a run of {config.kind}")
    try:
        return type(config).model_validate({**config.model_dump(), **settings})
    except ValidationError as error:
        raise InputError(first_mistake(error, "settings")) from None


def register_behaviour_calls(rpc: RpcRegistry, service: BehaviourService) -> None:
    """Serve ``behave``, whose payload is a ``BehaviourRequest``, and ``behaviours``, the list of those configured.

    Args:
        rpc: where.
        service: what runs them.
    """

    async def behaviours(_: dict[str, Any]) -> dict[str, Any]:
        return {
            name: {"kind": config.kind, "doc": BEHAVIOURS[config.kind].doc} for name, config in service.configs.items()
        }

    register_numbered(rpc, "behave", BehaviourRequest, service.take)
    rpc.register("behaviours", behaviours, AccessRole.OBSERVER, recorded=False)
