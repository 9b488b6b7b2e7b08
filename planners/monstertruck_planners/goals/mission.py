"""What to do about a goal: a pure state machine. Equal facts give equal decisions.

It plans, has the route followed, plans anew when something stands on it or the truck left it, and climbs the recovery
ladder when that does not help. Every decision is told with its reason.
"""

import math
from dataclasses import dataclass, replace
from typing import Final, Literal

from monstertruck_planners.goals.config import PlannerConfig
from monstertruck_planners.goals.exchange import Place, PlanAnswer, Pose
from monstertruck_schemas.event import Severity
from monstertruck_schemas.plan import GoalPhase
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import GoalOrder

HOPELESS: Final = frozenset(
    {
        Reason.GOAL_OUTSIDE,
        Reason.GOAL_BLOCKED,
        Reason.GOAL_UNREACHABLE,
        Reason.ROUTE_TIMEOUT,
        Reason.NOT_FINITE,
        Reason.BAD_INPUT,
        Reason.NO_MAP,
    }
)
"""Why a goal is refused if its first route fails; later on these may be passing trouble."""

MISSES: Final = 5
"""Routes that may end beside the goal."""

BLOCKS: Final = 2
"""Times a route may be blocked again before the truck has got on."""


@dataclass(frozen=True, slots=True)
class Plan:
    """Ask for a route or a way out."""

    what: Literal["route", "escape"] = "route"
    clear: bool = False
    """Forget older obstacles and the route so far..."""
    afresh: bool = False
    """...or only the latter."""


@dataclass(frozen=True, slots=True)
class Follow:
    """Have this driven."""

    answer: PlanAnswer


@dataclass(frozen=True, slots=True)
class Halt:
    """Come to rest."""


@dataclass(frozen=True, slots=True)
class Tell:
    """An event."""

    reason: Reason
    severity: Severity
    text: str


Action = Plan | Follow | Halt | Tell


@dataclass(frozen=True, slots=True)
class Facts:
    """What is known at one instant."""

    now: float
    """Seconds."""
    armed: bool
    """The gate lets the truck move."""
    at_rest: bool
    pose: Pose | None
    """Of the base, in the goal's frame."""
    answer: PlanAnswer | None = None
    """The newest plan, once."""
    outcome: Reason | None = None
    """What the tracker says of the present path; None before it says something."""
    along: float = 0.0
    """Metres driven on it."""
    left: float = math.inf
    """Metres of the route ahead."""
    blocked: bool = False
    """The newest scan shows something on the way ahead."""


@dataclass(frozen=True, slots=True)
class Mission:
    """One goal and how far it has come."""

    number: int
    goal: Pose
    source: str
    now: float
    via: tuple[Place, ...] = ()
    """Still to be passed."""
    phase: GoalPhase = GoalPhase.PLANNING
    outcome: Reason = Reason.DRIVING
    text: str = ""
    planned: Literal["route", "escape"] = "route"
    """What is being planned."""
    since: float = 0.0
    """Begin of the phase, s."""
    elapsed: float = 0.0
    unarmed: float = 0.0
    """Seconds it has waited for the truck to be armed."""
    best: float = 0.0
    """Metres of the present path driven when progress was last seen."""
    moved: float = 0.0
    """When progress was last seen, s."""
    seen: int = 0
    """Looks in a row that showed the way blocked."""
    blocks: int = 0
    nearest: float = math.inf
    """Least that was left of any route, m..."""
    troubled: float = math.inf
    """...and at the last trouble."""
    misses: int = 0
    rung: int = 0
    """Next step of the ladder."""
    routes: int = 0
    recoveries: int = 0

    @property
    def active(self) -> bool:
        """Whether it is still pursued."""
        return self.phase is not GoalPhase.IDLE


Step = tuple[Mission, tuple[Action, ...]]


def begin(number: int, goal: Pose, source: str, now: float, via: tuple[Place, ...] = ()) -> Step:
    """Take on a goal."""
    mission = Mission(number, goal, source, now, via, since=now, moved=now)
    x, y, yaw = goal
    by_way_of = f" by way of {len(via)} waypoints" if via else ""
    text = f"goal {number} of {source}: ({x:.2f}, {y:.2f}, {yaw:.2f}){by_way_of}"
    return mission, (Tell(Reason.GOAL_ACCEPTED, Severity.INFO, text), Plan(clear=True))


def order(mission: Mission, what: GoalOrder, source: str, now: float) -> Step:
    """Pause, resume or cancel; what does not fit is passed over."""
    by = f"goal {mission.number}, by {source}"
    if what is GoalOrder.CANCEL and mission.active:
        return _end(mission, Reason.CANCELLED, f"cancelled by {source}", Severity.INFO)
    if what is GoalOrder.PAUSE and mission.active and mission.phase is not GoalPhase.PAUSED:
        paused = _enter(replace(mission, now=now), GoalPhase.PAUSED)
        return paused, (Halt(), Tell(Reason.PAUSED, Severity.INFO, by))
    if what is GoalOrder.RESUME and mission.phase is GoalPhase.PAUSED:
        resumed = _enter(replace(mission, now=now, planned="route"), GoalPhase.PLANNING)
        return resumed, (Tell(Reason.RESUMED, Severity.INFO, by), Plan())
    return mission, ()


def displaced(mission: Mission, text: str) -> Step:
    """Somebody else's path is followed now: end without touching it."""
    ended, actions = _end(mission, Reason.CANCELLED, text, Severity.WARNING)
    return ended, tuple(action for action in actions if not isinstance(action, Halt))


def tick(mission: Mission, facts: Facts, config: PlannerConfig) -> Step:
    """One look at the facts."""
    passed, mission = facts.now - mission.now, replace(mission, now=facts.now)
    if mission.phase in (GoalPhase.IDLE, GoalPhase.PAUSED):
        return mission, ()
    if facts.armed or mission.phase is GoalPhase.PLANNING:
        mission = replace(mission, elapsed=mission.elapsed + passed, unarmed=0.0)
    else:
        mission = replace(mission, unarmed=mission.unarmed + passed, moved=facts.now)
    if mission.elapsed > config.timeout:
        return _end(mission, Reason.GOAL_TIMEOUT, f"not reached within {config.timeout:g} s")
    if mission.unarmed > config.unarmed_timeout:
        return _end(mission, Reason.DISARMED, f"not armed for {config.unarmed_timeout:g} s")
    match mission.phase:
        case GoalPhase.PLANNING:
            return (mission, ()) if facts.answer is None else _planned(mission, facts, facts.answer, config)
        case GoalPhase.WAITING:
            return _plan(mission, config) if facts.now - mission.since >= config.wait else (mission, ())
        case _:
            return _drive(mission, facts, config)


def _planned(mission: Mission, facts: Facts, answer: PlanAnswer, config: PlannerConfig) -> Step:
    if mission.planned == "escape":
        if not answer.ok:
            return _trouble(mission, answer.reason, f"no way to back out: {answer.text}", config)
        told = Tell(Reason.RECOVERING, Severity.INFO, f"goal {mission.number}: backs out {answer.length:.2f} m")
        return _set_off(mission, GoalPhase.BACKING_OUT), (Follow(answer), told)
    if not answer.ok:
        if mission.routes == 0 and answer.reason in HOPELESS:
            return _end(mission, answer.reason, answer.text)
        return _trouble(mission, answer.reason, answer.text, config)
    kind = "the rest of the route before" if answer.kept else "a new route"
    text = f"goal {mission.number}: {kind}, {answer.length:.2f} m"
    mission = replace(_set_off(mission, GoalPhase.DRIVING), routes=mission.routes + 1)
    if math.isinf(mission.troubled):
        mission = replace(mission, nearest=answer.length, troubled=answer.length)
    return mission, (Follow(answer), Tell(Reason.ROUTE_FOUND, Severity.INFO, text))


def _drive(mission: Mission, facts: Facts, config: PlannerConfig) -> Step:
    """Driving, or backing out."""
    if not facts.armed:
        return mission, ()
    backing = mission.phase is GoalPhase.BACKING_OUT
    if _at_waypoint(mission, facts.pose, config):
        left = len(mission.via) - 1
        told = Tell(Reason.WAYPOINT_PASSED, Severity.INFO, f"goal {mission.number}: waypoint passed, {left} left")
        return replace(mission, via=mission.via[1:]), (told,)
    if facts.outcome is Reason.GOAL_REACHED and facts.at_rest:
        return _plan(mission, config) if backing else _arrived(mission, facts, config)
    if facts.outcome is Reason.PATH_LOST:
        told = Tell(Reason.PATH_LOST, Severity.WARNING, f"goal {mission.number}: plans anew")
        return _with(_plan(mission, config), told)
    if facts.along > mission.best + config.progress:
        mission = replace(mission, best=facts.along, moved=facts.now)
    if not backing:
        mission = _got_on(mission, facts.left, config)
    mission = replace(mission, seen=mission.seen + 1 if facts.blocked else 0)
    if mission.seen >= config.sightings and not backing:
        text = "the newest scan shows something on the route"
        mission = replace(mission, blocks=mission.blocks + 1, seen=0)
        if mission.blocks > BLOCKS:
            return _trouble(mission, Reason.PATH_BLOCKED, text, config)
        told = Tell(Reason.PATH_BLOCKED, Severity.WARNING, f"goal {mission.number}: {text}; plans anew")
        return _with(_plan(mission, config), told)
    if facts.now - mission.moved > config.stuck:
        return _trouble(mission, Reason.STUCK, f"no progress for {config.stuck:g} s", config)
    return mission, ()


def _got_on(mission: Mission, left: float, config: PlannerConfig) -> Mission:
    """What begins anew as the truck gets on.

    The ladder does so only nearer to the goal than before its last step: driving to and fro between two ways that are
    both blocked is no progress.
    """
    mission = replace(mission, nearest=min(mission.nearest, left))
    if mission.best > config.recovered:
        mission = replace(mission, blocks=0)
    return replace(mission, rung=0) if mission.nearest < mission.troubled - config.recovered else mission


def _at_waypoint(mission: Mission, pose: Pose | None, config: PlannerConfig) -> bool:
    return bool(mission.via) and pose is not None and math.dist(pose[:2], mission.via[0][:2]) < config.waypoint_radius


def _arrived(mission: Mission, facts: Facts, config: PlannerConfig) -> Step:
    """The end of the route: is it the goal?"""
    assert facts.pose is not None
    away, turned = apart(facts.pose, mission.goal)
    off = f"{away:.3f} m and {turned:.3f} rad away"
    error = max(away / config.position_tolerance, turned / config.yaw_tolerance)
    if error <= (config.aim if mission.misses < config.corrections else 1.0):
        return _end(mission, Reason.GOAL_REACHED, off, Severity.INFO)
    if mission.misses >= MISSES:
        return _end(mission, Reason.GOAL_MISSED, off)
    mission = replace(mission, misses=mission.misses + 1)
    told = Tell(Reason.GOAL_MISSED, Severity.WARNING, f"goal {mission.number}: {off}; plans anew")
    return _with(_plan(mission, config, afresh=True), told)


def _trouble(mission: Mission, reason: Reason, text: str, config: PlannerConfig) -> Step:
    """Next step of the recovery ladder."""
    if mission.rung >= len(config.ladder):
        return _end(mission, reason, text or reason.text)
    rung = config.ladder[mission.rung]
    mission = replace(mission, rung=mission.rung + 1, recoveries=mission.recoveries + 1, troubled=mission.nearest)
    why = f"{reason.text}{f' ({text})' if text else ''}"
    told = Tell(Reason.RECOVERING, Severity.WARNING, f"goal {mission.number}: {why}: {rung.replace('_', ' ')}")
    match rung:
        case "wait":
            return _enter(mission, GoalPhase.WAITING), (told, Halt())
        case "back_out":
            planning = _enter(replace(mission, planned="escape"), GoalPhase.PLANNING)
            return planning, (told, Halt(), Plan("escape"))
        case _:
            return _with(_plan(mission, config, clear=rung == "clear"), told, Halt())


def _plan(mission: Mission, config: PlannerConfig, *, clear: bool = False, afresh: bool = False) -> Step:
    if mission.routes >= config.routes:
        return _end(mission, Reason.STUCK, f"{mission.routes} routes did not lead there")
    return _enter(replace(mission, planned="route"), GoalPhase.PLANNING), (Plan(clear=clear, afresh=afresh),)


def _set_off(mission: Mission, phase: GoalPhase) -> Mission:
    return replace(_enter(mission, phase), moved=mission.now, best=0.0, seen=0)


def _enter(mission: Mission, phase: GoalPhase) -> Mission:
    return replace(mission, phase=phase, since=mission.now)


def _with(step: Step, *before: Action) -> Step:
    mission, actions = step
    return mission, (*before, *actions)


def _end(mission: Mission, reason: Reason, text: str, severity: Severity = Severity.WARNING) -> Step:
    ended = replace(_enter(mission, GoalPhase.IDLE), outcome=reason, text=text)
    return ended, (Halt(), Tell(reason, severity, f"goal {mission.number}: {text}"))


def apart(a: Pose, b: Pose) -> tuple[float, float]:
    """Distance, m, and angle, rad, between two poses."""
    return math.dist(a[:2], b[:2]), abs(math.remainder(a[2] - b[2], math.tau))
