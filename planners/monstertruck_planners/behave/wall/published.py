"""The two published methods of following a wall by sonars, step by step as their author describes them.

Only the times that were set by hand are replaced: the approach ends by the ranges, the lap by odometry. Ramps keep
their published weakness: one that a change of phase cuts short jumps to the end value it would have had.
The code assumes a wall on the left; a wall on the right is mirrored.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Final, Literal, NamedTuple, Self

import numpy as np

from monstertruck_kinematics.elementary import KinematicsError
from monstertruck_kinematics.profiles import CubicRamp, TimedRamp
from monstertruck_planners.behave.api import BehaviourBody, BehaviourStep, Inputs, RequestedMotion
from monstertruck_planners.behave.wall.config import WallConfig, WallPdConfig, WallSwitchingConfig
from monstertruck_planners.behave.wall.monitor import NAMES, SonarMonitor
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.state import Odometry
from monstertruck_schemas.topics import ODOMETRY, SONAR, Topic

DIAGONAL: Final = math.radians(45)
"""Angle between the side sonar and the diagonal one."""
FOLLOWING: Final = ("follow", "free")
"""Phases that may start a lap: the robot drives along the wall."""

Phase = Literal["approach", "follow", "turn_away", "free", "turn_back", "stop"]


class Ranges(NamedTuple):
    """Ranges of the sonars, m, as seen with the wall on the left."""

    side: float
    diagonal: float
    front: float
    far: float
    """Diagonal range on the other side."""


def wall_angle(diagonal: float, side: float, offset: float = 0.0) -> float:
    """Heading away from the wall, rad: atan((a cos th - b)/(a sin th + offset)) with th = 45 degrees.

    Args:
        diagonal: a, m.
        side: b, m.
        offset: of the diagonal sonar ahead of the side one, m; the source leaves it out, exactly only when parallel.
    """
    return math.atan2(diagonal * math.cos(DIAGONAL) - side, diagonal * math.sin(DIAGONAL) + offset)


def wall_distance(diagonal: float, side: float, offset: float = 0.0) -> float:
    """Perpendicular distance from the side sonar to the wall, m."""
    return side * math.cos(wall_angle(diagonal, side, offset))


def tightest_curvature(body: BehaviourBody) -> float:
    """Return the maximum curvature of a body's path, 1/m; inf where it turns on the spot.

    Raises:
        KinematicsError: it cannot turn.
    """
    chassis = body.chassis
    try:
        chassis.possible((0.0, 0.0, 1.0))
    except KinematicsError:
        twist = chassis.possible((1.0, 0.0, 4.0))  # curvature that no body with steered axles reaches, 1/m
    else:
        return math.inf
    angles, _ = chassis.limited_steering(chassis.steering_for(twist, chassis.straight), body.max_angle)
    vx, _, wz = chassis.along(twist, *chassis.reached(angles))
    return abs(wz / vx)


def ramp(begin: float, start: float, end: float, duration: float) -> TimedRamp:
    """Ramp from ``start`` to ``end`` without acceleration at both ends."""
    return TimedRamp(begin, CubicRamp(start, end, duration))


@dataclass(frozen=True, slots=True)
class WallState:
    """State between two steps."""

    phase: Phase = "approach"
    v: TimedRamp | None = None
    w: TimedRamp | None = None
    error: float | None = None
    """Distance error of the last sample, m."""
    sonars: SonarMonitor = field(default_factory=SonarMonitor)
    pose: tuple[float, float, float] | None = None
    turned: float = 0.0
    """Accumulated absolute turn, rad."""
    travelled: float = 0.0
    begun: tuple[float, float, float] | None = None
    """Pose where following began."""
    since: float = 0.0
    """Distance since then or since the last lap, m."""
    laps: int = 0
    turned_before: float = 0.0
    """``turned`` when the current phase began, rad."""
    before: tuple[Ranges, ...] = ()
    """Ranges at the last two steps."""
    gaps: tuple[float | None, float | None] = (None, None)
    """Values of ``travelled`` at which side and diagonal sonar began to look into a gap."""
    echoes: tuple[tuple[float, float, float], ...] = ()
    """Latest echoes on the wall: x and y by odometry, with the wall on the left, and their ``travelled``, m."""
    asked: float = 0.0
    """Requested speed at the step before, m/s."""
    moving_since: float | None = None
    """Time since which motion is requested but not measured, s."""


class _Wall(ABC):
    """Base of both methods: input checks, odometry, laps, mirroring."""

    reads: ClassVar[tuple[Topic[Any], ...]] = (SONAR, ODOMETRY)

    def __init__(self, config: WallConfig, tightest: float = math.inf) -> None:
        self._shared = config
        self._tightest = tightest
        self._names = NAMES[config.side]
        self._mirror = 1.0 if config.side == "left" else -1.0

    @classmethod
    def fit(cls, config: Any, body: BehaviourBody) -> Self:
        """Return the behaviour for a body; a body that cannot turn on the spot turns away along its tightest arc.

        Raises:
            KinematicsError: the body cannot turn.
        """
        return cls(config, tightest_curvature(body))

    def begin(self) -> WallState:
        """Return the state before the first step."""
        return WallState()

    def step(self, inputs: Inputs, state: WallState, t: float) -> BehaviourStep:
        """Run one step; see ``Behaviour``."""
        sonars, odometry = inputs.of(SONAR), inputs.of(ODOMETRY)
        state = _moved(state, odometry)
        state = replace(state, sonars=state.sonars.observe(sonars, self._names, state.turned, t))
        fault = state.sonars.fault(state.turned, t)
        state = _stall_timed(state, odometry.twist.vx, t)
        # 1.0: a motor is stalled after this time of requested but not measured motion, s
        if fault is None and state.moving_since is not None and t - state.moving_since >= 1.0:
            fault = Reason.STUCK, f"{state.asked:.2f} m/s requested, {odometry.twist.vx:.2f} m/s driven"
        if fault is None and state.phase == "turn_away" and state.turned - state.turned_before > math.tau:
            fault = Reason.STUCK, "turned a full circle and found no wall to follow"
        if fault is not None:
            return BehaviourStep(None, state, state.phase, *fault)
        hold, furthest = self._shared.hold, sonars.range_max
        ranges = Ranges(*(state.sonars.range(name, hold, furthest, t) for name in self._names))
        state = self._lap(state, t)
        if state.phase == "stop":
            return self._stopping(state, ranges, t)
        state, v, w = self._drive(state, ranges, t)
        if math.isfinite(self._tightest) and abs(w) > v * self._tightest:
            if state.phase == "turn_away":
                v = abs(w) / self._tightest
            w = math.copysign(v * self._tightest, w)
        return self._answer(replace(state, asked=v), v, w, ranges)

    @abstractmethod
    def _drive(self, state: WallState, ranges: Ranges, t: float) -> tuple[WallState, float, float]:
        """Return the next state, speed (m/s) and yaw rate (rad/s), with the wall on the left."""

    def _distance(self, ranges: Ranges) -> float:
        return ranges.side

    def _answer(self, state: WallState, v: float, w: float, ranges: Ranges) -> BehaviourStep:
        values = {"distance": self._distance(ranges), "travelled": state.travelled, "laps": float(state.laps)}
        return BehaviourStep(RequestedMotion(v, w * self._mirror), state, state.phase, values=values)

    def _to(
        self, state: WallState, phase: Phase, t: float, v: tuple[float, float], w: tuple[float, float]
    ) -> WallState:
        """Change the phase, with ramps of v and w from and to nominal values."""
        duration = self._shared.ramp
        begun = state.pose if state.begun is None and phase in FOLLOWING else state.begun
        return replace(
            state,
            phase=phase,
            v=ramp(t, *v, duration),
            w=ramp(t, *w, duration),
            error=None,
            before=(),
            gaps=(None, None),
            echoes=(),
            turned_before=state.turned,
            begun=begun,
            since=0.0 if state.begun is None else state.since,
        )

    def _lap(self, state: WallState, t: float) -> WallState:
        """Count a lap when the robot has returned to its start; begin to stop after the last lap."""
        config, begun, pose = self._shared, state.begun, state.pose
        if begun is None or pose is None or state.phase == "stop" or state.since < config.lap_length:
            return state
        if math.dist(begun[:2], pose[:2]) > config.lap_radius:
            return state
        # 1.2: greatest difference of the heading from that at the lap's beginning, rad: the robot weaves
        if math.cos(begun[2] - pose[2]) < math.cos(1.2):
            return state
        state = replace(state, laps=state.laps + 1, since=0.0)
        if state.laps < config.laps:
            return state
        return self._to(state, "stop", t, (config.speed, 0.0), (0.0, 0.0))

    def _stopping(self, state: WallState, ranges: Ranges, t: float) -> BehaviourStep:
        assert state.v is not None
        if t - state.v.begin < self._shared.ramp:
            return self._answer(state, state.v.at(t), 0.0, ranges)
        text = f"{state.laps} lap, {state.travelled:.1f} m" if state.laps == 1 else f"{state.laps} laps"
        return BehaviourStep(None, state, state.phase, Reason.BEHAVIOUR_DONE, text)


class WallPd(_Wall):
    """Method 1: omega = k_p error + k_d (error - previous error).

    Args:
        config: gains and ranges.
        tightest: see ``tightest_curvature``.
    """

    def __init__(self, config: WallPdConfig, tightest: float = math.inf) -> None:
        super().__init__(config, tightest)
        self._config = config

    def _distance(self, ranges: Ranges) -> float:
        return wall_distance(ranges.diagonal, ranges.side, self._config.offset)

    def _drive(self, state: WallState, ranges: Ranges, t: float) -> tuple[WallState, float, float]:
        config = self._config
        blocked = ranges.front < config.trigger or ranges.far < config.safety
        if state.phase == "approach":
            if blocked:
                state = self._to(state, "turn_away", t, (config.speed, 0.0), (0.0, -config.turn_rate))
            elif self._sees(ranges):
                state = self._to(state, "follow", t, (config.speed, config.speed), (0.0, 0.0))
            else:
                return _approach(state, config, t)
        elif state.phase == "follow" and blocked:
            state = self._to(state, "turn_away", t, (config.speed, 0.0), (0.0, -config.turn_rate))
        elif state.phase == "turn_away" and self._sees(ranges) and self._aligned(ranges) and ranges.front > config.free:
            state = self._to(state, "follow", t, (0.0, config.speed), (0.0, 0.0))
        assert state.v is not None
        assert state.w is not None
        if state.phase == "turn_away":
            return state, state.v.at(t), state.w.at(t)
        v = state.v.at(t)
        state = self._mapped(self._gaps(state, ranges), ranges)
        if state.gaps != (None, None):
            return replace(state, error=None), v, self._along_line(state)
        error = self._distance(ranges) - config.distance
        if config.lead:
            error += v * config.lead * math.sin(wall_angle(ranges.diagonal, ranges.side, config.offset))
        change = 0.0 if state.error is None else error - state.error
        return replace(state, error=error), v, config.k_p * error + config.k_d * change

    def _mapped(self, state: WallState, ranges: Ranges) -> WallState:
        """Add the echoes of the sonars that measure the wall, by odometry."""
        if state.pose is None or not self._config.gap:
            return state
        x, y, yaw, now = state.pose[0], state.pose[1] * self._mirror, state.pose[2] * self._mirror, state.travelled
        # 0.8: distance over which echoes make the line of a wall past whose gap it drives, m
        echoes = [echo for echo in state.echoes if now - echo[2] < 0.8]
        reach, offset = ranges.diagonal * math.cos(DIAGONAL), self._config.offset
        for gap, ahead, aside in zip(state.gaps, (0.0, offset + reach), (ranges.side, reach), strict=True):
            if gap is None:
                c, s = math.cos(yaw), math.sin(yaw)
                echoes.append((x + c * ahead - s * aside, y + s * ahead + c * aside, now))
        return replace(state, echoes=tuple(echoes))

    def _along_line(self, state: WallState) -> float:
        """Yaw rate along the line through the latest echoes, rad/s; straight on if there are too few."""
        if state.pose is None or len(state.echoes) < 4:  # least number of echoes of such a line
            return 0.0
        x, y, yaw = state.pose[0], state.pose[1] * self._mirror, state.pose[2] * self._mirror
        points = np.array(state.echoes)[:, :2]
        middle = points.mean(axis=0)
        along = np.linalg.eigh(np.cov((points - middle).T))[1][:, 1]
        along *= math.copysign(1.0, along @ (math.cos(yaw), math.sin(yaw)))
        error = float(along[0] * (middle[1] - y) - along[1] * (middle[0] - x)) - self._config.distance
        away = math.remainder(math.atan2(along[1], along[0]) - yaw, math.tau)
        # yaw rate per distance error from it, rad/s/m, and per heading error, 1/s: critically damped at 0.2 m/s
        line_gains = 5.0, 2.0
        return line_gains[0] * error + line_gains[1] * away

    def _gaps(self, state: WallState, ranges: Ranges) -> WallState:
        """Find the sonars that look into a gap: from a jump of the range until the wall or the maximum gap length.

        A drop of the range without a known gap ends a niche beside which the robot started; the echoes of the niche are
        discarded. If the diagonal range at the start is much longer than along a wall, that sonar looks into a gap as
        well.
        """
        before, (side, diagonal), now = state.before, state.gaps, state.travelled
        # growth of the range of the side sonar over two steps, and of the diagonal one over one, by which it begins to
        # look into a gap, m
        jump = 0.06, 0.15
        niche = side is None and bool(before) and before[-1].side - ranges.side > jump[1]
        # Distance behind the edge of a gap over which the side sonar may measure the gap's own side wall, m.
        gap_edge = 0.1
        if before and ranges.side - min(sample.side for sample in before) > jump[0]:
            side = now if side is None else side
        elif side is not None and ranges.side < self._config.seen and now - side > gap_edge:
            side = None
        known = before[-1].diagonal if before else ranges.side / math.cos(DIAGONAL)
        if ranges.diagonal - known > jump[1]:
            diagonal = now
        # 0.05: diagonal range times cos 45 degrees less side range below which it ends, m
        elif ranges.diagonal * math.cos(DIAGONAL) - ranges.side < 0.05:
            diagonal = None
        gaps = tuple(
            since if since is not None and now - since < self._config.gap else None for since in (side, diagonal)
        )
        echoes = () if niche else state.echoes
        return replace(state, before=(*before[-1:], ranges), gaps=(gaps[0], gaps[1]), echoes=echoes)

    def _aligned(self, ranges: Ranges) -> bool:
        """Whether the robot has turned far enough from the wall ahead."""
        config = self._config
        return config.aligned is None or wall_angle(ranges.diagonal, ranges.side, config.offset) >= config.aligned

    def _sees(self, ranges: Ranges) -> bool:
        """Whether side and diagonal sonar measure the wall."""
        return ranges.side < self._config.seen and ranges.diagonal < self._config.seen / math.cos(DIAGONAL)


class WallSwitching(_Wall):
    """Method 2: free, obstacle, and a correction while the wall is too far.

    Args:
        config: ranges.
        tightest: see ``tightest_curvature``.
    """

    def __init__(self, config: WallSwitchingConfig, tightest: float = math.inf) -> None:
        super().__init__(config, tightest)
        self._config = config

    def _drive(self, state: WallState, ranges: Ranges, t: float) -> tuple[WallState, float, float]:
        config = self._config
        v, w = config.speed, config.turn_rate
        obstacle = min(ranges.front, ranges.diagonal, ranges.side) < config.obstacle
        far = config.distance + config.beyond
        match state.phase:
            case "approach" if obstacle:
                state = self._to(state, "turn_away", t, (v, 0.0), (0.0, -w))
            case "approach":
                return _approach(state, config, t)
            case "turn_away" if not obstacle:
                state = self._to(state, "free", t, (0.0, v), (-w, 0.0))
            case "free" if obstacle:
                state = self._to(state, "turn_away", t, (v, 0.0), (0.0, -w))
            case "free" if ranges.side > far:
                state = self._to(state, "turn_back", t, (v, v), (0.0, w))
            case "turn_back" if obstacle:
                state = self._to(state, "turn_away", t, (v, 0.0), (0.0, -w))
            case "turn_back" if ranges.side <= config.distance:
                state = self._to(state, "free", t, (v, v), (w, 0.0))
            case _:
                pass
        assert state.v is not None
        assert state.w is not None
        return state, state.v.at(t), state.w.at(t)


def _approach(state: WallState, config: WallConfig, t: float) -> tuple[WallState, float, float]:
    """Drive to the wall: by an arc of ``approach_turn`` first, then straight."""
    turn = config.turn_rate if config.approach_turn > 0 else 0.0
    v = state.v or ramp(t, 0.0, config.speed, config.ramp)
    w = state.w or ramp(t, 0.0, turn, config.ramp)
    if w.shape.v1 != 0.0 and state.turned >= config.approach_turn:
        w = ramp(t, config.turn_rate, 0.0, config.ramp)
    return replace(state, v=v, w=w), v.at(t), w.at(t)


def _moved(state: WallState, odometry: Odometry) -> WallState:
    pose = (odometry.pose.x, odometry.pose.y, odometry.pose.yaw)
    if state.pose is None:
        return replace(state, pose=pose)
    distance = math.dist(pose[:2], state.pose[:2])
    turn = abs(math.remainder(pose[2] - state.pose[2], math.tau))
    return replace(
        state, pose=pose, travelled=state.travelled + distance, since=state.since + distance, turned=state.turned + turn
    )


def _stall_timed(state: WallState, speed: float, t: float) -> WallState:
    """Note the time since which the robot stands although motion is requested."""
    at_rest = 0.01  # m/s
    stalled = state.asked > at_rest * 5 and abs(speed) < at_rest
    if not stalled:
        return replace(state, moving_since=None)
    return state if state.moving_since is not None else replace(state, moving_since=t)
