"""Pure state machine of one exploration: equal observations give equal decisions.

It requests the next viewpoint, also while the robot drives, sends goals, keeps a blacklist of unreachable places,
drives home, and has the map saved. Every decision is reported with its reason.
"""

import math
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from monstertruck_kinematics.se2 import Pose2, placed
from monstertruck_planners.explore.config import ExplorerConfig
from monstertruck_planners.explore.exchange import ExploreAnswer, Point, Viewpoint
from monstertruck_schemas.event import Severity
from monstertruck_schemas.plan import ExplorationPhase
from monstertruck_schemas.reasons import Reason

MAPPING_TIME: Final = 1.5
"""Time after a goal until the map contains the view from there (s)."""
NEAR_START: Final = 1.0
"""Maximum distance of a robot that is back at a blocked start, for example at a wall (m)."""
AGAIN: Final = 2.0
"""Delay from a refused goal to the next (s); doubled after each failure while driving home."""
STUCK: Final = 3
"""Number of consecutive failed goals at one place until the robot drives back out of it."""
TRAIL: Final = 0.5
"""Distance between the poses kept for driving back (m)."""
PASSING: Final = frozenset({Reason.PLANNER_STARTING, Reason.NO_MAP, Reason.LEASE_EXPIRED})
"""Goal outcomes that do not depend on the place."""
BROKEN: Final = frozenset({Reason.WORKER_DIED, Reason.WORKER_TIMEOUT})
"""Refusals by a planner that does not start, for any goal; after planning, the place may be the cause."""
HOPELESS: Final = frozenset({Reason.DISARMED, Reason.ESTOPPED, Reason.BUSY})
"""Goal outcomes that would be the same at any other place."""


@dataclass(frozen=True, slots=True)
class Attempt:
    """Place that could not be reached or showed nothing new."""

    place: Point
    count: int
    until: float
    """End of the blacklisting (s); +inf: until the exploration ends."""


@dataclass(frozen=True, slots=True)
class Attempts:
    """Blacklist of an exploration.

    Args:
        period: time on the blacklist after a failed attempt (s).
        most: number of failed attempts until a place stays on the blacklist.
    """

    period: float
    most: int
    places: tuple[Attempt, ...] = ()

    def failed(self, place: Point, now: float, *, ignore_first: bool = False) -> "Attempts":
        """Return the list with one more failed attempt at a place; ``ignore_first``: the first has no effect."""
        # 0.5: places within this distance of each other are one place (m)
        before = next((attempt for attempt in self.places if math.dist(attempt.place, place) < 0.5), None)
        count = 1 if before is None else before.count + 1
        until = math.inf if count >= self.most else now if ignore_first and count == 1 else now + self.period
        others = tuple(attempt for attempt in self.places if attempt is not before)
        return replace(self, places=(*others, Attempt(place, count, until)))

    def banned(self, now: float) -> tuple[Point, ...]:
        """Return the places on the blacklist at ``now`` (s)."""
        return tuple(attempt.place for attempt in self.places if now < attempt.until)

    def released(self, now: float) -> "Attempts | None":
        """Return the list with all temporary entries expired, or None without any; used when no other place is left."""
        if not any(now < attempt.until < math.inf for attempt in self.places):
            return None
        return replace(
            self, places=tuple(replace(a, until=min(a.until, now)) if a.until < math.inf else a for a in self.places)
        )


@dataclass(frozen=True, slots=True)
class Choose:
    """Request the next viewpoint."""


@dataclass(frozen=True, slots=True)
class Go:
    """Send a goal."""

    pose: Pose2


@dataclass(frozen=True, slots=True)
class Cancel:
    """Cancel the current goal."""


@dataclass(frozen=True, slots=True)
class Save:
    """Request saving the map."""


@dataclass(frozen=True, slots=True)
class Notice:
    """Event to report."""

    reason: Reason
    severity: Severity
    text: str


Action = Choose | Go | Cancel | Save | Notice


@dataclass(frozen=True, slots=True)
class Observed:
    """Observations at one instant."""

    now: float
    """Time (s)."""
    pose: Pose2 | None
    """Pose of the base in the map frame; None if unknown or unreliable."""
    believed: Pose2 | None = None
    """Pose of the base, even if unreliable."""
    ended: Reason | None = None
    """Outcome of the latest goal; None while it is active, or without a goal."""
    ended_text: str = ""
    refused: bool = False
    """Whether the goal was refused, so ``ended`` is a refusal."""
    displaced: str = ""
    """Source whose goal replaced it."""
    paused: bool = False
    """Whether the goal is paused."""
    answer: ExploreAnswer | None = None
    """Answer to the last request, passed once."""
    charge: float | None = None
    """Battery charge, 0 to 1; None if not measured."""
    low: bool = False
    """Whether the battery voltage is low."""
    estopped: bool = False
    """Whether the emergency stop is latched."""
    critical: bool = False
    """Whether the charge is too low to drive: the gate stops the robot, and an unsaved map may be lost."""
    saved: str | None = None
    """Path of the map saved after the request; empty if it was not saved, None if pending."""
    save_failure: str = ""
    """Why the map was not saved."""
    failed: str = ""
    """Permanently failed services that goals need, and why they failed."""
    found: int = 0
    """Number of known points of interest."""


@dataclass(frozen=True, slots=True)
class Exploration:
    """An exploration and its progress."""

    number: int
    source: str
    home: Pose2
    returns: bool
    """Whether the robot drives home at the end."""
    budget: float
    """Maximum duration (s)."""
    begun: float
    now: float
    attempts: Attempts
    """Failed attempts at frontiers."""
    unreached: Attempts
    """Failed attempts at viewpoints."""
    find: int | None = None
    """Number of points of interest that ends the exploration; None for no limit."""
    found: int = 0
    """Number of known points of interest."""
    phase: ExplorationPhase = ExplorationPhase.LOOKING
    since: float = 0.0
    """Start of the phase (s)."""
    outcome: Reason = Reason.DRIVING
    text: str = ""
    final: Reason = Reason.DRIVING
    """Outcome after driving home."""
    final_text: str = ""
    target: Viewpoint | None = None
    pursued: float = 0.0
    """Start of driving to ``target`` (s)."""
    asked: float = -math.inf
    """Time of the last request for a decision (s)."""
    waiting: bool = False
    """Whether an answer is pending."""
    not_before: float = 0.0
    """Earliest time of the next request for a decision or of a goal for driving home (s)."""
    nothing: int = 0
    """Number of consecutive answers without a viewpoint."""
    newest: ExploreAnswer = field(default_factory=ExploreAnswer)
    travelled: float = 0.0
    """Distance travelled (m), summed over poses 3 cm apart."""
    counted: Pose2 | None = None
    """Last pose included in ``travelled``."""
    before: Pose2 | None = None
    trail: tuple[Pose2, ...] = ()
    """Recent poses, latest last."""
    near_home: tuple[Pose2, ...] = ()
    """First poses within ``NEAR_START`` of the start, 0.25 m apart."""
    stuck: int = 0
    """Number of consecutive failed goals at the place of the robot."""
    stuck_at: Pose2 | None = None
    """Pose of the robot at these failures."""
    blameless: tuple[Attempts, Attempts] | None = None
    """Values of ``attempts`` and ``unreached`` before these failures."""
    backing: bool = False
    """Whether the robot is driving back to an earlier pose."""
    charge: float | None = None
    """Battery charge at the start."""
    goals: int = 0
    failures: int = 0
    home_goals: int = 0
    blocked: int = 0
    """Number of blocked home goals, where the robot cannot stand."""
    looks: int = 0
    """Number of short drives since the robot lost its pose."""
    came_from: Pose2 | None = None
    """Start pose of the latest short drive; ``goes_back``: whether the robot must drive back there."""
    goes_back: bool = False

    @property
    def running(self) -> bool:
        """Whether the exploration has not ended."""
        return self.phase is not ExplorationPhase.IDLE


Step = tuple[Exploration, tuple[Action, ...]]


def begin(
    number: int, source: str, pose: Pose2, now: float, config: ExplorerConfig, *, home: bool, budget: float,
    find: int | None = None,
) -> Step:  # fmt: skip
    """Start an exploration."""
    none = Attempts(config.blacklist, config.attempts)
    run = Exploration(number, source, pose, home, budget, now, now, none, none, find, since=now)
    text = f"{config.kind}, for {budget:g} s at most{', then home' if home else ''}, requested by {source}"
    return run, (Notice(Reason.EXPLORATION_STARTED, Severity.INFO, text),)


def stop(run: Exploration, source: str, now: float) -> Step:
    """End the exploration at the current place."""
    run = replace(run, now=now)
    return _end(run, Reason.CANCELLED, f"stopped by {source}", Cancel(), Save())


def tick(run: Exploration, seen: Observed, config: ExplorerConfig) -> Step:
    """Advance the state machine with new observations."""
    run = _moved(replace(run, now=seen.now, found=seen.found), seen)
    if seen.answer is not None:
        run = replace(run, newest=_merged(run.newest, seen.answer), waiting=False)
    if not run.running:
        return run, ()
    if run.phase is ExplorationPhase.SAVING:
        return _saving(run, seen)
    if seen.displaced:
        return _end(run, Reason.CANCELLED, f"the goal of {seen.displaced} took over", Save())
    if (why := _stopped(seen)) is not None:
        return _end(run, *why, Cancel(), Save())
    if seen.paused:
        return run, ()
    if run.phase is ExplorationPhase.LOST:
        return _lost(run, seen, config)
    if seen.pose is None:
        lost = replace(_enter(run, ExplorationPhase.LOST), target=None, backing=False, looks=0, goes_back=False)
        return lost, (Cancel(), Notice(Reason.POSE_LOST, Severity.WARNING, "the robot waits at its position"))
    if run.phase is ExplorationPhase.RETURNING:
        return _returning(run, seen)
    if (why := _enough(run, seen, config)) is not None:
        return _finish(run, *why)
    return _driving(run, seen, config) if run.phase is ExplorationPhase.DRIVING else _looking(run, seen)


def _stopped(seen: Observed) -> tuple[Reason, str] | None:
    """Return why the exploration ends at the current place, or None."""
    if seen.estopped:
        return Reason.ESTOPPED, Reason.ESTOPPED.text
    if seen.critical:
        return Reason.BATTERY_CRITICAL, "the robot stays at its position"
    return (Reason.SERVICE_FAILED, seen.failed) if seen.failed else None


def _moved(run: Exploration, seen: Observed) -> Exploration:
    counted, distance = run.counted, 0.0
    if counted is None or seen.pose is None:
        counted = seen.pose
    # 0.03: minimum motion (m): the pose of a standing robot moves by some millimetres with every scan
    elif (moved := math.dist(counted[:2], seen.pose[:2])) >= 0.03:
        counted, distance = seen.pose, moved
    charge = seen.charge if run.charge is None else run.charge
    trail = run.trail
    if seen.pose is not None and (not trail or math.dist(trail[-1][:2], seen.pose[:2]) >= TRAIL) and not run.backing:
        trail = (*trail, seen.pose)[-8:]
    return replace(
        run, before=seen.pose, counted=counted, travelled=run.travelled + distance, charge=charge, trail=trail,
        near_home=_near_home(run, seen.pose),
    )  # fmt: skip


def _near_home(run: Exploration, pose: Pose2 | None) -> tuple[Pose2, ...]:
    """Return the first poses after the start; there the robot passed over ground it could not see behind itself."""
    places = run.near_home
    if pose is None or len(places) == 3 or math.dist(pose[:2], run.home[:2]) > NEAR_START:  # number of poses kept
        return places
    apart = min(math.dist(pose[:2], place[:2]) for place in (run.home, *places))
    return (*places, pose) if apart >= 0.25 else places  # minimum distance between the poses (m)


def _merged(before: ExploreAnswer, answer: ExploreAnswer) -> ExploreAnswer:
    """Return the new answer, with the previous path home if it has none; the previous answer after a failure."""
    if answer.failure is not None:
        return before
    return answer if answer.home is not None else replace(answer, home=before.home)


def _enough(run: Exploration, seen: Observed, config: ExplorerConfig) -> tuple[Reason, str] | None:
    """Return why the exploring ends now, or None."""
    if run.find is not None and seen.found >= run.find:
        return Reason.POINTS_FOUND, f"{seen.found} points of interest"
    if run.now - run.begun > run.budget:
        return Reason.BUDGET_SPENT, f"after {run.budget:g} s"
    if seen.low:
        return Reason.BATTERY_LOW, Reason.BATTERY_LOW.text
    home = run.newest.home
    if seen.charge is None or home is None or run.charge is None:
        return None
    needed = config.reserve * home * charge_per_metre(run, seen.charge, config)
    if seen.charge > needed:
        return None
    return Reason.CHARGE_SPENT, (
        f"battery {seen.charge:.0%}, of which {needed:.0%} are reserved for the {home:.1f} m home"
    )


def charge_per_metre(run: Exploration, charge: float, config: ExplorerConfig) -> float:
    """Return the fraction of the charge used per metre: measured after sufficient use, before that as configured."""
    used = (run.charge or 0.0) - charge
    # 0.05: minimum fraction of the charge used for a measured use per metre
    measured = used >= 0.05 and run.travelled > 0.0
    return used / run.travelled if measured else 1.0 / config.full_range


def _looking(run: Exploration, seen: Observed) -> Step:
    answer = seen.answer
    if run.now < run.not_before:
        return run, ()
    if answer is None:
        return (run, ()) if run.waiting else _ask(run)
    if answer.target is not None:
        return _go(run, answer.target)
    if answer.known == 0.0:
        if run.now - run.since > 30.0:  # timeout (s) for a first map
            return _finish(run, answer.failure or Reason.NO_MAP, answer.text or "no map to explore")
        return replace(run, not_before=run.now + 1.0), ()
    # Two consecutive evaluations without a frontier end the exploration.
    if run.nothing + 1 < 2:
        return replace(run, nothing=run.nothing + 1, not_before=run.now + MAPPING_TIME), ()
    attempts, unreached = run.attempts.released(run.now), run.unreached.released(run.now)
    if attempts is not None or unreached is not None:
        text = "only skipped targets are left: they are tried again"
        again = replace(run, attempts=attempts or run.attempts, unreached=unreached or run.unreached)
        again = replace(again, nothing=0, not_before=run.now)
        return again, (Notice(Reason.RECOVERING, Severity.INFO, text),)
    found = "" if run.find is None else f"; {seen.found} of {run.find} points of interest were found"
    return _finish(run, Reason.EXPLORED, f"{run.newest.known:.1f} m^2 of free ground{found}")


def _driving(run: Exploration, seen: Observed, config: ExplorerConfig) -> Step:
    assert run.target is not None
    if seen.ended is not None:
        if seen.ended in HOPELESS:
            return _finish(replace(run, returns=False), seen.ended, seen.ended_text)
        if seen.ended is Reason.CANCELLED:
            return _end(run, Reason.CANCELLED, f"the goal was cancelled: {seen.ended_text}", Save())
        broken = seen.refused and seen.ended in BROKEN
        if seen.ended in PASSING or broken:
            text = seen.ended_text if broken else seen.ended.text
            looking = replace(_enter(run, ExplorationPhase.LOOKING), text=text)
            return replace(looking, target=None, backing=False, not_before=run.now + AGAIN), ()
        reached = seen.ended is Reason.GOAL_REACHED
        if run.backing:
            looking = _enter(run, ExplorationPhase.LOOKING)
            return replace(looking, target=None, backing=False, not_before=run.now + MAPPING_TIME), ()
        target, run = run.target, _counted(run, seen, reached=reached)
        if run.stuck >= STUCK and (back := _back(run)) is not None:
            return back
        attempts, unreached = run.attempts.failed(target.frontier, run.now, ignore_first=not reached), run.unreached
        if not reached:
            unreached = unreached.failed(target.pose[:2], run.now)
        run = replace(run, target=None, attempts=attempts, unreached=unreached, failures=run.failures + (not reached))
        run = replace(_enter(run, ExplorationPhase.LOOKING), not_before=run.now + MAPPING_TIME, nothing=0)
        if reached:
            return run, ()
        text = f"not reached ({seen.ended.text}): skipped for {config.blacklist:g} s"
        return run, (Notice(seen.ended, Severity.INFO, text),)
    answer = seen.answer
    if answer is not None and not answer.kept and not run.backing:
        if answer.target is None:
            looking = replace(
                _enter(run, ExplorationPhase.LOOKING), target=None, nothing=0, not_before=run.now + MAPPING_TIME
            )
            return looking, (Cancel(),)
        return _go(run, answer.target)
    if not run.backing and not run.waiting and run.now - run.asked >= 1.0 / config.rate:
        return _ask(run)
    return run, ()


def _counted(run: Exploration, seen: Observed, *, reached: bool) -> Exploration:
    """Count the ended goal if it failed at the place of the previous failures."""
    if reached:
        return replace(run, stuck=0)
    assert seen.pose is not None
    here = run.stuck_at is not None and math.dist(run.stuck_at[:2], seen.pose[:2]) < 0.3
    if here and run.stuck > 0:
        return replace(run, stuck=run.stuck + 1)
    return replace(run, stuck=1, stuck_at=seen.pose, blameless=(run.attempts, run.unreached))


def _back(run: Exploration) -> Step | None:
    """Drive back along the trail, as no place is reachable from here; return None if there is no earlier pose.

    The failed places are not the cause, so the blacklist is restored.
    """
    assert run.before is not None
    assert run.blameless is not None
    here = run.before
    earlier = tuple(pose for pose in run.trail if math.dist(pose[:2], here[:2]) > TRAIL)
    if not earlier:
        return None
    attempts, unreached = run.blameless
    target = Viewpoint(earlier[-1], earlier[-1][:2])
    run = replace(run, attempts=attempts, unreached=unreached, trail=earlier[:-1], stuck=0, failures=run.failures + 1)
    run = replace(_enter(run, ExplorationPhase.DRIVING), target=target, backing=True, pursued=run.now, nothing=0)
    text = f"{STUCK} targets in a row were not reached from here: the robot drives back the way it came"
    return run, (Go(target.pose), Notice(Reason.RECOVERING, Severity.INFO, text))


def _go(run: Exploration, target: Viewpoint) -> Step:
    x, y, yaw = target.pose
    text = f"({x:.2f}, {y:.2f}, {yaw:.2f}), {target.path_length:.1f} m away, may reveal about {target.gain:.1f} m^2"
    run = replace(_enter(run, ExplorationPhase.DRIVING), target=target, pursued=run.now, nothing=0, goals=run.goals + 1)
    return run, (Go(target.pose), Notice(Reason.FRONTIER_CHOSEN, Severity.INFO, text))


def _ask(run: Exploration) -> Step:
    return replace(run, asked=run.now, waiting=True), (Choose(),)


def _lost(run: Exploration, seen: Observed, config: ExplorerConfig) -> Step:
    if seen.pose is not None:
        phase = ExplorationPhase.LOOKING if run.final is Reason.DRIVING else ExplorationPhase.RETURNING
        found = replace(_enter(run, phase), waiting=False, target=None, not_before=run.now + MAPPING_TIME, nothing=0)
        stop = () if run.target is None else (Cancel(),)
        return found, (*stop, Notice(Reason.POSE_FOUND, Severity.INFO, "goes on"))
    if run.now - run.since > config.lost:
        text = f"its pose was not found for {config.lost:g} s; the robot stays at its position"
        return _finish(replace(run, returns=False), Reason.POSE_LOST, text)
    if run.target is not None:
        if seen.ended is Reason.CANCELLED:
            return _end(run, Reason.CANCELLED, f"the goal was cancelled: {seen.ended_text}", Save())
        if seen.ended is None:
            return run, ()
        back = seen.ended is Reason.GOAL_REACHED and not run.goes_back
        return replace(run, target=None, goes_back=back, not_before=run.now + AGAIN), ()
    # A lost robot waits 5 s before it drives a short distance.
    if not config.around or seen.believed is None or run.now < max(run.since + 5.0, run.not_before):
        return run, ()
    if run.goes_back and run.came_from is not None:
        return replace(run, target=Viewpoint(run.came_from, run.came_from[:2])), (Go(run.came_from),)
    # poses in base that a lost robot visits in turn, driving back each time, to see more; never behind it, as no scan
    # has seen the ground there
    around = ((0.6, 0.0, 0.0), (0.6, 0.25, 0.8), (0.6, -0.25, -0.8))
    x, y, yaw = placed(np.array((around[run.looks % len(around)],)), seen.believed)[0].tolist()
    pose = x, y, math.remainder(yaw, math.tau)
    say = (
        () if run.looks else (Notice(Reason.RECOVERING, Severity.INFO, "its pose is unknown: the robot looks around"),)
    )
    run = replace(run, target=Viewpoint(pose, pose[:2]), looks=run.looks + 1, came_from=seen.believed)
    return run, (Go(pose), *say)


def _finish(run: Exploration, outcome: Reason, text: str) -> Step:
    """Stop choosing viewpoints: drive home, or end."""
    run = replace(run, final=outcome, final_text=text, target=None)
    if not run.returns:
        return _end(run, outcome, text, Cancel(), Save())
    severity = Severity.INFO if outcome.exit_code == 0 else Severity.WARNING
    returning = replace(_enter(run, ExplorationPhase.RETURNING), not_before=run.now, home_goals=0)
    return returning, (Cancel(), Notice(outcome, severity, f"{text}; drives home"))


def _returning(run: Exploration, seen: Observed) -> Step:
    """Handle the phase RETURNING; a goal is active if one was sent and has not ended."""
    if run.target is not None:
        if seen.ended is None:
            return run, ()
        if seen.ended is Reason.GOAL_REACHED:
            return _back_home(run, run.target.pose)
        if seen.ended is Reason.GOAL_BLOCKED and seen.pose is not None:
            if math.dist(seen.pose[:2], run.home[:2]) <= NEAR_START:
                return _back_home(run, seen.pose)
            run = replace(run, blocked=run.blocked + 1)
        if seen.ended in HOPELESS or seen.ended is Reason.CANCELLED or run.home_goals >= 6:
            text = f"{run.final_text}; not back at the start: {seen.ended_text or seen.ended.text}"
            return _end(run, seen.ended, text, Save())
        return replace(run, target=None, not_before=run.now + AGAIN * 2 ** (run.home_goals - 1)), ()
    if run.now < run.not_before:
        return run, ()
    places = (run.home, *run.near_home)
    pose = places[run.blocked % len(places)]
    return replace(run, target=Viewpoint(pose, pose[:2]), home_goals=run.home_goals + 1), (Go(pose),)


def _back_home(run: Exploration, pose: Pose2) -> Step:
    away = math.dist(pose[:2], run.home[:2])
    beside = f"{away:.1f} m from the start, which is not free in the map"
    where = "back at the start" if pose == run.home else beside
    return _end(run, run.final, f"{run.final_text}; {where}", Save())


def _saving(run: Exploration, seen: Observed) -> Step:
    if seen.saved is None and run.now - run.since < 30.0:  # timeout (s) for saving the map
        return run, ()
    kept = (
        f"map saved in {seen.saved}" if seen.saved else f"map not saved{seen.save_failure and ': '}{seen.save_failure}"
    )
    severity = Severity.INFO if run.final.exit_code == 0 else Severity.WARNING
    text = f"{run.final_text}; {kept}"
    ended = replace(_enter(run, ExplorationPhase.IDLE), outcome=run.final, text=text)
    driven = f"{ended.travelled:.1f} m and {ended.goals} goals in {ended.now - ended.begun:.0f} s"
    return ended, (Notice(run.final, severity, f"{text}; {driven}"),)


def _end(run: Exploration, outcome: Reason, text: str, *actions: Action) -> Step:
    return replace(_enter(run, ExplorationPhase.SAVING), final=outcome, final_text=text, target=None), actions


def _enter(run: Exploration, phase: ExplorationPhase) -> Exploration:
    return replace(run, phase=phase, since=run.now, text="")
