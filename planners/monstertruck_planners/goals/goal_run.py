"""Pure state machine that drives to one goal: equal observations give equal decisions.

It plans a route and has it followed, replans when the route is blocked or the truck has left it, and tries the recovery
behaviours in turn if replanning does not help. Every decision is reported with its reason.
"""

import math
from dataclasses import dataclass, replace
from typing import Final, Literal, assert_never

from monstertruck_kinematics.se2 import Pose2
from monstertruck_planners.goals.config import PlannerConfig
from monstertruck_planners.goals.exchange import Place, RouteAnswer
from monstertruck_schemas.event import Severity
from monstertruck_schemas.plan import GoalPhase
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import GoalOrder

REFUSED: Final = frozenset(
    {
        Reason.GOAL_OUTSIDE,
        Reason.GOAL_BLOCKED,
        Reason.GOAL_UNREACHABLE,
        Reason.ROUTE_TIMEOUT,
        Reason.NOT_FINITE,
        Reason.BAD_INPUT,
        Reason.NO_MAP,
        Reason.UNSEEN_STOP,
        Reason.KEEPOUT,
    }
)
"""Reasons that refuse a goal if its first route fails; later they may be temporary."""

ENDED: Final = frozenset({Reason.GOAL_REACHED, Reason.GOAL_MISSED})
"""Tracker outcomes at the end of a path."""

LEFT: Final = frozenset({Reason.PATH_LOST, Reason.CUSP_MISSED, Reason.UNSEEN_STOP})
"""Tracker outcomes when the truck leaves a path; the goal run replans from there."""


MISSES: Final = 5
"""Maximum number of routes that end outside the goal tolerance."""

BLOCKS: Final = 2
"""Maximum number of blocked routes without progress of the truck."""


@dataclass(frozen=True, slots=True)
class Plan:
    """Request a route or an escape path."""

    what: Literal["route", "escape"] = "route"
    clear: bool = False
    """Discard older obstacles and the current route."""
    afresh: bool = False
    """Discard only the current route."""


@dataclass(frozen=True, slots=True)
class Follow:
    """Drive this path."""

    answer: RouteAnswer


@dataclass(frozen=True, slots=True)
class Halt:
    """Stop the truck."""


@dataclass(frozen=True, slots=True)
class Report:
    """Event to report."""

    reason: Reason
    severity: Severity
    text: str


Action = Plan | Follow | Halt | Report


@dataclass(frozen=True, slots=True)
class Observations:
    """Observations at one instant."""

    now: float
    """Time (s)."""
    armed: bool
    """Whether the gate lets the truck move."""
    at_rest: bool
    pose: Pose2 | None
    """Pose of the base in the frame of the goal."""
    answer: RouteAnswer | None = None
    """New answer of the planner, passed once."""
    outcome: Reason | None = None
    """Tracker outcome on the current path; None until there is one."""
    along: float = 0.0
    """Distance travelled on the current path (m)."""
    left: float = math.inf
    """Remaining length of the route (m)."""
    blocked: bool = False
    """Whether the latest scan shows an obstacle on the path ahead."""
    yields: bool = False
    """Whether the truck stands to let a person pass."""
    unseen: bool = False
    """Whether the gate stops the truck before ground that no sensor has seen."""
    estopped: bool = False
    """Whether the emergency stop is latched."""
    placeless: str = ""
    """Why the pose is invalid; empty if it is valid."""
    zone: str = ""
    """Name of the keepout zone that the robot would reach into at the goal; empty if there is none."""
    held: str = ""
    """Description of the reason why the truck is not armed."""


@dataclass(frozen=True, slots=True)
class GoalRun:
    """A goal and its progress."""

    number: int
    goal: Pose2
    source: str
    now: float
    via: tuple[Place, ...] = ()
    """Waypoints still to pass."""
    phase: GoalPhase = GoalPhase.PLANNING
    outcome: Reason = Reason.DRIVING
    text: str = ""
    planned: Literal["route", "escape"] = "route"
    """Kind of path being planned."""
    since: float = 0.0
    """Start of the phase (s)."""
    elapsed: float = 0.0
    unarmed: float = 0.0
    """Time waited for the truck to be armed (s)."""
    best: float = 0.0
    """Distance travelled on the current path at the last observed progress (m)."""
    moved: float = 0.0
    """Time of the last observed progress (s)."""
    blocked_scans: int = 0
    """Number of consecutive scans that showed the path blocked."""
    blocks: int = 0
    nearest: float = math.inf
    """Minimum remaining length of all routes so far (m)."""
    recovery_distance: float = math.inf
    """Value of ``nearest`` when the last recovery behaviour began (m)."""
    partial: bool = False
    """Whether the current route ends before the goal, as the whole route is too long for one path."""
    misses: int = 0
    error: float = math.inf
    """Minimum goal error before a correction, as the larger fraction of the two tolerances."""
    next_recovery: int = 0
    """Index of the next recovery behaviour."""
    routes: int = 0
    recoveries: int = 0

    @property
    def active(self) -> bool:
        """Whether the goal is still active."""
        return self.phase is not GoalPhase.IDLE


Step = tuple[GoalRun, tuple[Action, ...]]


def begin(number: int, goal: Pose2, source: str, now: float, via: tuple[Place, ...] = ()) -> Step:
    """Start a goal."""
    run = GoalRun(number, goal, source, now, via, since=now, moved=now)
    x, y, yaw = goal
    through = f" by way of {len(via)} waypoints" if via else ""
    text = f"goal {number} of {source}: ({x:.2f}, {y:.2f}, {yaw:.2f}){through}"
    return run, (Report(Reason.GOAL_ACCEPTED, Severity.INFO, text), Plan(clear=True))


def order(run: GoalRun, what: GoalOrder, source: str, now: float) -> Step:
    """Pause, resume or cancel; ignore an order that does not fit the phase."""
    by = f"goal {run.number}, by {source}"
    if what is GoalOrder.CANCEL and run.active:
        return _end(run, Reason.CANCELLED, f"cancelled by {source}", Severity.INFO)
    if what is GoalOrder.PAUSE and run.active and run.phase is not GoalPhase.PAUSED:
        paused = _enter(replace(run, now=now), GoalPhase.PAUSED)
        return paused, (Halt(), Report(Reason.PAUSED, Severity.INFO, by))
    if what is GoalOrder.RESUME and run.phase is GoalPhase.PAUSED:
        resumed = _enter(replace(run, now=now, planned="route"), GoalPhase.PLANNING)
        return resumed, (Report(Reason.RESUMED, Severity.INFO, by), Plan())
    return run, ()


def displaced(run: GoalRun, text: str) -> Step:
    """End the goal without stopping the truck, because it follows the path of another source."""
    ended, actions = _end(run, Reason.CANCELLED, text, Severity.WARNING)
    return ended, tuple(action for action in actions if not isinstance(action, Halt))


def tick(run: GoalRun, observed: Observations, config: PlannerConfig) -> Step:
    """Advance the state machine with new observations."""
    passed, phase, run = observed.now - run.now, run.phase, replace(run, now=observed.now)
    if phase is GoalPhase.IDLE:
        return run, ()
    if observed.estopped:
        return _end(run, Reason.ESTOPPED, Reason.ESTOPPED.text)
    if phase is GoalPhase.PAUSED:
        return run, ()
    if observed.placeless or observed.zone:
        reason = Reason.POSE_LOST if observed.placeless else Reason.KEEPOUT
        return _end(run, reason, observed.placeless or f"the goal lies in the keepout zone {observed.zone}")
    if observed.armed or phase is GoalPhase.PLANNING:
        run = replace(run, elapsed=run.elapsed + passed, unarmed=0.0)
    else:
        run = replace(run, unarmed=run.unarmed + passed, moved=observed.now)
    if run.elapsed > config.timeout:
        return _end(run, Reason.GOAL_TIMEOUT, f"not reached within {config.timeout:g} s")
    if run.unarmed > config.unarmed_timeout:
        if observed.pose is None:
            return _end(run, Reason.NO_MAP, f"no fresh pose for {config.unarmed_timeout:g} s")
        why = f": {observed.held}" if observed.held else ""
        return _end(run, Reason.DISARMED, f"not armed for {config.unarmed_timeout:g} s{why}")
    match phase:
        case GoalPhase.PLANNING:
            return (run, ()) if observed.answer is None else _planned(run, observed, observed.answer, config)
        case GoalPhase.WAITING:
            return _plan(run, config) if observed.now - run.since >= config.wait else (run, ())
        case GoalPhase.DRIVING | GoalPhase.BACKING_OUT:
            return _drive(run, observed, config)
        case _:
            assert_never(phase)


def _planned(run: GoalRun, observed: Observations, answer: RouteAnswer, config: PlannerConfig) -> Step:
    if run.planned == "escape":
        if answer.path is None:
            return _recover(run, answer.reason, f"no path to back out: {answer.text}", config)
        report = Report(Reason.RECOVERING, Severity.INFO, f"goal {run.number}: backs out {answer.length:.2f} m")
        return _set_off(run, GoalPhase.BACKING_OUT), (Follow(answer), report)
    if answer.path is None:
        if run.routes == 0 and answer.reason in REFUSED:
            return _end(run, answer.reason, answer.text)
        return _recover(run, answer.reason, answer.text, config)
    # 0.01: with a shorter route (m) the truck is already at the goal
    if answer.length < 0.01 and not run.via and observed.pose is not None:
        return _arrived(replace(run, routes=run.routes + 1), observed, config)
    kind = "the rest of the previous route" if answer.kept else "a new route"
    text = f"goal {run.number}: {kind}, {answer.text or f'{answer.length:.2f} m'}"
    run = replace(_set_off(run, GoalPhase.DRIVING), routes=run.routes + 1, partial=not answer.complete)
    if math.isinf(run.recovery_distance):
        run = replace(run, nearest=answer.length, recovery_distance=answer.length)
    return run, (Follow(answer), Report(Reason.ROUTE_FOUND, Severity.INFO, text))


def _drive(run: GoalRun, observed: Observations, config: PlannerConfig) -> Step:
    """Handle the phases DRIVING and BACKING_OUT."""
    if not observed.armed:
        return run, ()
    backing = run.phase is GoalPhase.BACKING_OUT
    if _at_waypoint(run, observed.pose, config):
        left = len(run.via) - 1
        report = Report(Reason.WAYPOINT_PASSED, Severity.INFO, f"goal {run.number}: waypoint passed, {left} left")
        return replace(run, via=run.via[1:]), (report,)
    if observed.outcome in ENDED and observed.at_rest:
        return _plan(run, config) if backing or run.partial else _arrived(run, observed, config)
    if observed.outcome is not None and observed.outcome in LEFT:
        report = Report(observed.outcome, Severity.WARNING, f"goal {run.number}: plans again")
        return _with(_plan(run, config), report)
    if observed.along > run.best + config.progress or observed.yields:
        run = replace(run, best=max(run.best, observed.along), moved=observed.now)
    if not backing:
        run = _progressed(run, observed.left, config)
    run = replace(run, blocked_scans=run.blocked_scans + 1 if observed.blocked or observed.unseen else 0)
    if run.blocked_scans >= config.blocked_scans and (observed.unseen or not backing):
        reason, text = Reason.PATH_BLOCKED, "the latest scan shows an obstacle on the route"
        if observed.unseen:
            if not run.via and observed.pose is not None and _error(observed.pose, run.goal, config) <= 1.0:
                return _arrived(replace(run, misses=MISSES), observed, config)
            reason, text = Reason.UNSEEN_STOP, "the route leads onto ground that no sensor has seen"
        run = replace(run, blocks=run.blocks + 1, blocked_scans=0)
        if run.blocks > BLOCKS:
            return _recover(run, reason, text, config)
        report = Report(reason, Severity.WARNING, f"goal {run.number}: {text}; plans again")
        return _with(_plan(run, config), report)
    if observed.now - run.moved > config.stuck:
        return _recover(run, Reason.STUCK, f"no progress for {config.stuck:g} s", config)
    return run, ()


def _progressed(run: GoalRun, left: float, config: PlannerConfig) -> GoalRun:
    """Reset counters as the truck makes progress.

    The recovery behaviours restart only when the truck is nearer to the goal than when the last one began: driving back
    and forth between two blocked routes is not progress.
    """
    run = replace(run, nearest=min(run.nearest, left))
    if run.best > config.recovered:
        run = replace(run, blocks=0)
    return replace(run, next_recovery=0) if run.nearest < run.recovery_distance - config.recovered else run


def _at_waypoint(run: GoalRun, pose: Pose2 | None, config: PlannerConfig) -> bool:
    return bool(run.via) and pose is not None and math.dist(pose[:2], run.via[0][:2]) < config.waypoint_radius


def _arrived(run: GoalRun, observed: Observations, config: PlannerConfig) -> Step:
    """Check the goal tolerance at the end of the route: end the goal, or correct the pose."""
    assert observed.pose is not None
    away, turned = apart(observed.pose, run.goal)
    off = f"{away:.3f} m and {turned:.3f} rad away"
    error = _error(observed.pose, run.goal, config)
    before = max(config.aim, min(run.error, 1.0))
    wanted = 1.0 if run.misses >= MISSES else config.aim if run.misses < config.corrections else before
    if run.via:
        off = f"{len(run.via)} waypoint{'s' if len(run.via) > 1 else ''} not passed"
    elif error <= wanted:
        return _end(run, Reason.GOAL_REACHED, off, Severity.INFO)
    if run.misses >= MISSES:
        return _end(run, Reason.GOAL_MISSED, off)
    run = replace(run, misses=run.misses + 1, error=min(run.error, error))
    report = Report(Reason.GOAL_MISSED, Severity.WARNING, f"goal {run.number}: {off}; plans again")
    return _with(_plan(run, config, afresh=True), report)


def _recover(run: GoalRun, reason: Reason, text: str, config: PlannerConfig) -> Step:
    """Start the next recovery behaviour."""
    if run.next_recovery >= len(config.recovery):
        return _end(run, reason, text or reason.text)
    behaviour = config.recovery[run.next_recovery]
    run = replace(run, next_recovery=run.next_recovery + 1, recoveries=run.recoveries + 1)
    run = replace(run, recovery_distance=run.nearest)
    why = f"{reason.text}{f' ({text})' if text else ''}"
    report = Report(Reason.RECOVERING, Severity.WARNING, f"goal {run.number}: {why}: {behaviour.replace('_', ' ')}")
    match behaviour:
        case "wait":
            return _enter(run, GoalPhase.WAITING), (report, Halt())
        case "back_out":
            planning = _enter(replace(run, planned="escape"), GoalPhase.PLANNING)
            return planning, (report, Halt(), Plan("escape"))
        case "clear" | "replan":
            return _with(_plan(run, config, clear=behaviour == "clear"), report, Halt())
        case _:
            assert_never(behaviour)


def _plan(run: GoalRun, config: PlannerConfig, *, clear: bool = False, afresh: bool = False) -> Step:
    if run.routes >= config.routes:
        return _end(run, Reason.STUCK, f"{run.routes} routes did not reach it")
    return _enter(replace(run, planned="route"), GoalPhase.PLANNING), (Plan(clear=clear, afresh=afresh),)


def _set_off(run: GoalRun, phase: GoalPhase) -> GoalRun:
    return replace(_enter(run, phase), moved=run.now, best=0.0, blocked_scans=0)


def _enter(run: GoalRun, phase: GoalPhase) -> GoalRun:
    return replace(run, phase=phase, since=run.now)


def _with(step: Step, *before: Action) -> Step:
    run, actions = step
    return run, (*before, *actions)


def _end(run: GoalRun, reason: Reason, text: str, severity: Severity = Severity.WARNING) -> Step:
    ended = replace(_enter(run, GoalPhase.IDLE), outcome=reason, text=text)
    return ended, (Halt(), Report(reason, severity, f"goal {run.number}: {text}"))


def _error(pose: Pose2, goal: Pose2, config: PlannerConfig) -> float:
    """Return the error of a pose at a goal, as the larger fraction of the two tolerances."""
    away, turned = apart(pose, goal)
    return max(away / config.position_tolerance, turned / config.yaw_tolerance)


def apart(a: Pose2, b: Pose2) -> tuple[float, float]:
    """Return the distance (m) and the angle (rad) between two poses."""
    return math.dist(a[:2], b[:2]), abs(math.remainder(a[2] - b[2], math.tau))
