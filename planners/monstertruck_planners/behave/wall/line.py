"""Wall following by a line fitted to echoes: method 3, our own.

The wall is a line in odom that touches the arcs of the echoes of the last metres. The robot drives along the line at
the set distance; through a gap it follows the last line. A wall ahead is a second line: where both distances are met
the robot stops, turns on the spot until it is parallel to the new wall, and continues. Speeds change by cubic ramps
from the current speed and acceleration; the controller makes up the shortfall of measured speed (odometry) and yaw
rate (gyroscope). The code assumes a wall on the left; a wall on the right is mirrored.
"""

import math
from itertools import pairwise
from statistics import median
from typing import Any, ClassVar, Final, Literal, NamedTuple

import numpy as np

from monstertruck_kinematics.elementary import Array, clip
from monstertruck_kinematics.profiles import CubicRamp, TimedRamp, shortest_ramp
from monstertruck_kinematics.se2 import Pose2
from monstertruck_planners.behave.api import BehaviourStep, Inputs, RequestedMotion
from monstertruck_planners.behave.wall.config import WallLineConfig
from monstertruck_planners.behave.wall.echoes import (
    ECHO,
    TIGHT,
    Cone,
    EstimateFit,
    WallEstimate,
    deviation,
    refine,
    residuals,
    search,
)
from monstertruck_planners.behave.wall.monitor import NAMES, SonarMonitor
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import SonarRanges
from monstertruck_schemas.state import Odometry, Transforms
from monstertruck_schemas.topics import IMU, ODOMETRY, SONAR, TRANSFORMS, Topic

SIDE, DIAGONAL, FRONT, FAR = range(4)
"""Sonar numbers, as in ``NAMES``."""
KEPT_POSE_TIME: Final = 1.0
"""Length of the pose history (s): echoes are placed at the robot's pose of their time."""
FRONT_RANGE: Final = 1.2
"""Maximum front range for estimating a wall ahead (m)."""
AHEAD_DISTANCES: Final = 1.5, 0.8
"""Distance over which echoes are used for the wall ahead (m): on free ground, and along a wall; behind that wall may
lie the foot of the perpendicular to the next wall."""
NEARER: Final = 5.0
"""Standard deviations by which a diagonal echo must be nearer than the wall alongside to come from something ahead."""
LEAST_WALL_ECHOES: Final = 6
"""Minimum number of echoes of a wall."""
TOUCHING: Final = 0.16
"""Range for an immediate stop (m)."""
STRAY: Final = (0.3, 0.4)
"""Yaw rate error (rad/s) and its duration (s) that indicate a stalled motor."""
DISAGREES, AGREES = 0.2, 0.7
"""Fraction of echoes on the wall below which a sonar contradicts its neighbour, and above which the neighbour is
trusted."""

STANDSTILL: Final = TimedRamp(0.0, CubicRamp(0.0, 0.0, 1.0))

Fit = Literal["beside", "left", "right", "turned"]
"""Fitted lines: the wall alongside; walls ahead by left or right sonars; the wall that the robot turns to."""
Phase = Literal["settle", "search", "brake", "turn", "follow", "stop"]


class SonarMount(NamedTuple):
    """Mount of a sonar in base, with the wall on the left."""

    x: float
    y: float
    yaw: float

    @property
    def reach(self) -> float:
        """Distance along the axis from the robot's centre to range 0 (m)."""
        return self.x * math.cos(self.yaw) + self.y * math.sin(self.yaw)


class LineState(NamedTuple):
    """State between two steps; poses with the wall on the left."""

    phase: Phase = "settle"
    mounts: tuple[SonarMount, ...] = ()
    poses: tuple[tuple[int, Pose2, float], ...] = ()
    """Odometry poses of the last second, with stamps and speeds (m/s)."""
    pose: Pose2 = (0.0, 0.0, 0.0)
    """Pose of the body."""
    heard: int = -1
    """Stamp of the latest processed echoes."""
    echoes: Array = np.empty((0, len(ECHO)))
    monitor: SonarMonitor = SonarMonitor()
    wall: WallEstimate | None = None
    """Wall that the robot follows."""
    sure: bool = False
    """Whether the direction of ``wall`` is known well."""
    ahead: WallEstimate | None = None
    """Wall that the robot turns to."""
    faced: tuple[WallEstimate | None, WallEstimate | None] = (None, None)
    """Walls ahead by front and diagonal sonar, and by front and far sonar; along a wall only the second."""
    fits: tuple[Fit, ...] = ()
    """Pending line fits."""
    v: TimedRamp = STANDSTILL
    w: TimedRamp = STANDSTILL
    lag: tuple[float, float] = (0.0, 0.0)
    """Lag of the robot behind its ramps: distance (m) and angle (rad)."""
    bias: tuple[float, int] = (0.0, 0)
    """Gyroscope bias (rad/s) and the number of averaged samples."""
    before: float | None = None
    """Time of the last step (s)."""
    sent: tuple[tuple[float, float, float], ...] = ()
    """Time, speed and yaw rate of the ramps as requested during the last second."""
    travelled: float = 0.0
    turned: float = 0.0
    """Accumulated absolute turn (rad)."""
    marks: tuple[float, float] = (0.0, 0.0)
    """``travelled`` and ``turned`` when the phase began."""
    seen: float = 0.0
    """``travelled`` at the last echo of the wall."""
    sense: float = -1.0
    """Sense of the turn: 1 = left."""
    places: Array = np.empty((0, 4))
    """(n, 4) ``travelled`` and pose at the start of the lap and every 0.5 m since; empty before the first wall."""
    laps: int = 0
    strays: tuple[float | None, float | None] = (None, None)
    """Times since which yaw rate and speed differ from the request (s)."""
    equal: tuple[tuple[float, int, float], ...] = ((0.0, 0, 0.0),) * 4
    """Latest range of every sonar, its number of consecutive repeats, and ``travelled`` at the first of them."""


class WallLine:
    """Wall following by method 3.

    Args:
        config: settings.
    """

    reads: ClassVar[tuple[Topic[Any], ...]] = (SONAR, ODOMETRY, IMU, TRANSFORMS)

    def __init__(self, config: WallLineConfig) -> None:
        self._config = config
        self._names = NAMES[config.side]
        self._mirror = 1.0 if config.side == "left" else -1.0
        # 2: lines fitted per round of echoes, spread over the steps if there are enough, because fits block the event
        # loop
        self._fits = math.ceil(2 * (SONAR.rate or 0.0) / config.rate)

    def begin(self) -> LineState:
        """Return the state before the first step."""
        return LineState()

    def step(self, inputs: Inputs, state: LineState, t: float) -> BehaviourStep:
        """Run one step; see ``Behaviour``."""
        sonars, odometry = inputs.of(SONAR), inputs.of(ODOMETRY)
        if not state.mounts:
            mounts = self._mounts(inputs.of(TRANSFORMS))
            if isinstance(mounts, str):
                return BehaviourStep(None, state, state.phase, Reason.INPUT_CONTRADICTORY, mounts)
            state = state._replace(mounts=mounts)
        state = self._moved(state, odometry, inputs.of(IMU).angular_velocity.z * self._mirror, t)
        cone = self._cone(sonars)
        heard = sonars.stamp != state.heard
        state = self._estimate(self._hear(state, sonars, t) if heard else state, cone, heard=heard)
        fault = self._fault(state, odometry, t)
        if fault is None and heard and state.phase == "follow" and state.wall is not None:
            fault = self._disagreement(state, state.wall, cone)
        if fault is not None:
            return BehaviourStep(None, state, state.phase, *fault)
        due = t + self._config.lead
        state = self._advance(state, cone, due)
        if state.phase == "stop" and state.v.over(due):
            text = f"{state.laps} lap{'s' if state.laps > 1 else ''}, {state.travelled:.1f} m"
            return BehaviourStep(None, state, state.phase, Reason.BEHAVIOUR_DONE, text)
        v, w = state.v.at(due), state.w.at(due)
        state = state._replace(sent=(*(entry for entry in state.sent if entry[0] > t - KEPT_POSE_TIME), (due, v, w)))
        catch_up = 1.5  # correction speed per lag, 1/s
        v, w = v + catch_up * state.lag[0], w + catch_up * state.lag[1]
        motion = RequestedMotion(min(max(v, 0.0), 0.3), w * self._mirror)  # m/s
        error = None if state.wall is None else self.error(state)
        return BehaviourStep(motion, state, state.phase, values=_values(state, error))

    # Inputs

    def _mounts(self, transforms: Transforms) -> tuple[SonarMount, ...] | str:
        """Return the mounts of the sonars, or a message about a missing one."""
        found = {transform.child: transform for transform in transforms.transforms}
        mounts = []
        for name in self._names:
            mount = found.get(f"sonar_{name}")
            if mount is None:
                return f"state/transforms has no frame sonar_{name}: expected the mounts of {', '.join(self._names)}"
            x, y, _ = mount.translation
            yaw = 2.0 * math.atan2(mount.rotation[2], mount.rotation[3])
            mounts.append(SonarMount(x, y * self._mirror, yaw * self._mirror))
        return tuple(mounts)

    def _cone(self, sonars: SonarRanges) -> Cone:
        config = self._config
        # 1.3: maximum angle from the normal for a beam to return, rad
        return Cone(0.0, 1.3) if config.beam else Cone(sonars.field_of_view / 2, config.critical_angle)

    def _moved(self, state: LineState, odometry: Odometry, rate: float, t: float) -> LineState:
        """Update the state from odometry and gyroscope."""
        mirror = self._mirror
        pose = odometry.pose.x, odometry.pose.y * mirror, odometry.pose.yaw * mirror
        bias, count = state.bias
        if state.phase == "settle":
            bias, count = (bias * count + rate) / (count + 1), count + 1
        oldest = odometry.stamp - round(KEPT_POSE_TIME * SECOND)
        poses = tuple(entry for entry in state.poses if oldest <= entry[0] < odometry.stamp)
        poses = (*poses, (odometry.stamp, pose, odometry.twist.vx))
        pose, speed = _at(poses, odometry.stamp, self._config.play)
        distance = turn = 0.0
        if state.poses:
            distance, turn = math.dist(pose[:2], state.pose[:2]), abs(math.remainder(pose[2] - state.pose[2], math.tau))
        dt = 0.0 if state.before is None else t - state.before
        v, w = _asked(state, t)
        behind = state.lag[0] + (v - speed) * dt, state.lag[1] + (w - (rate - bias)) * dt
        lag = (0.05, 0.15)  # maximum corrected lag: distance, m, and angle, rad
        return state._replace(
            bias=(bias, count),
            poses=poses,
            pose=pose,
            travelled=state.travelled + distance,
            turned=state.turned + turn,
            lag=(clip(behind[0], -lag[0], lag[0]), clip(behind[1], -lag[1], lag[1])),
            before=t,
            strays=_strays(state.strays, (v, w), (speed, rate - bias), t),
        )

    def _hear(self, state: LineState, sonars: SonarRanges, t: float) -> LineState:
        """Place the echoes of one round in odom."""
        rows, equal = [], list(state.equal)
        for number, name in enumerate(self._names):
            echo = sonars.echo(name)
            if echo is None or not echo.answered or echo.range is None:
                continue
            value, count, first = equal[number]
            measured = sonars.range_min < echo.range < sonars.range_max
            same = measured and value == echo.range
            equal[number] = (value, count + 1, first) if same else (echo.range, 1, state.travelled)
            if not measured:
                continue
            (x, y, yaw), _ = _at(state.poses, echo.stamp, self._config.play)
            mount = state.mounts[number]
            c, s = math.cos(yaw), math.sin(yaw)
            place = x + c * mount.x - s * mount.y, y + s * mount.x + c * mount.y, yaw + mount.yaw
            rows.append((*place, echo.range, number, state.travelled, t))
        echoes = state.echoes[state.echoes[:, 5] > state.travelled - self._config.window]
        if rows:
            echoes = np.vstack([echoes, np.array(rows)])
        return state._replace(
            heard=sonars.stamp,
            echoes=echoes[-600:],
            equal=tuple(equal),
            monitor=state.monitor.observe(sonars, self._names, state.turned, t),
        )

    # Walls

    def _estimate(self, state: LineState, cone: Cone, *, heard: bool) -> LineState:
        """Refit lines after a round of echoes, two per round, longest waiting first."""
        wanted: tuple[Fit, ...] = ("beside", "right") if state.wall is not None else ("left", "right")
        if state.phase == "turn":
            wanted = ("turned",)
        fits = tuple(fit for fit in state.fits if fit in wanted)
        if heard:
            fits += tuple(fit for fit in wanted if fit not in fits)
        for fit in fits[: self._fits]:
            match fit:
                case "turned":
                    found = self._turned_to(state, cone)
                    state = state if found is None else state._replace(ahead=found.line)
                case "beside":
                    state = self._beside(state, cone)
                case "left":
                    state = self._nearer(state, (self._faced(state, cone, (DIAGONAL, FRONT)), state.faced[1]))
                case "right":
                    state = self._nearer(state, (state.faced[0], self._faced(state, cone, (FRONT, FAR))))
        return state._replace(fits=fits[self._fits :])

    def _beside(self, state: LineState, cone: Cone) -> LineState:
        """Return the state with a new fit of the wall alongside."""
        wall, echoes = state.wall, state.echoes
        beside = echoes[echoes[:, 4] <= DIAGONAL]
        if wall is None or not len(beside):
            return state
        if not self._opening(state, wall, cone):
            fit = refine(beside, wall, state.pose[:2], cone)
            # 0.008: standard deviation of the wall's direction above which the robot drives along it slowly, rad
            wall, state = fit.line, state._replace(wall=fit.line, sure=fit.sigma[0] < 0.008)
        fresh = beside[beside[:, 6] == echoes[-1, 6]]
        on_wall = fresh[np.abs(residuals(fresh, wall, cone)) < TIGHT]
        return state._replace(seen=float(on_wall[-1, 5])) if len(on_wall) else state

    def _opening(self, state: LineState, wall: WallEstimate, cone: Cone) -> bool:
        """Whether the side sonar looks through an opening: the diagonal sonar may then detect the far post."""
        if not cone.hears(state.pose[2] + state.mounts[SIDE].yaw, wall.normal):
            return False
        fresh = _fresh(state.echoes[state.echoes[:, 4] == SIDE], state)
        # 0.3: minimum range of the side sonar beyond the wall in an opening, m
        return not len(fresh) or bool((residuals(fresh, wall, cone) * deviation(fresh[:, 3])).min() > 0.3)

    def _nearer(self, state: LineState, faced: tuple[WallEstimate | None, WallEstimate | None]) -> LineState:
        """Return the state with the nearer of the walls ahead, by left and right sonars."""
        lines = [line for line in faced if line is not None]
        return state._replace(
            faced=faced, ahead=min(lines, key=lambda line: self._distance_to(state, line), default=None)
        )

    def _faced(self, state: LineState, cone: Cone, group: tuple[int, int]) -> WallEstimate | None:
        """Return a wall ahead, by the sonars of a range of numbers."""
        echoes, pose = state.echoes, state.pose
        own = (echoes[:, 4] >= group[0]) & (echoes[:, 4] <= group[1])
        rows = echoes[(echoes[:, 5] > state.travelled - _reach(state)) & own]
        fresh = _fresh(rows, state)
        if len(rows) < LEAST_WALL_ECHOES or not len(fresh) or fresh[:, 3].min() > FRONT_RANGE:
            return None
        fit = search(rows, pose[:2], cone)
        # 1.1: maximum angle between the direction of travel and the normal of a wall ahead, rad
        facing = abs(math.remainder(fit.line.normal - pose[2], math.tau)) < 1.1
        present = np.count_nonzero(np.abs(residuals(fresh, fit.line, cone)) < TIGHT) > 0.5 * len(fresh)
        return fit.line if facing and present and fit.explained >= max(LEAST_WALL_ECHOES, 0.5 * len(rows)) else None

    def _turned_to(self, state: LineState, cone: Cone) -> EstimateFit | None:
        """Fit the wall that the robot turns to: all echoes since it came near, except from the wall that it leaves."""
        echoes, at = state.echoes, state.pose[:2]
        late, sides = echoes[:, 5] > state.travelled - _reach(state), echoes[:, 4] < FRONT
        turning = echoes[:, 5] >= state.marks[0]
        rows = echoes[(late & ~sides) | ((late if state.wall is None else turning) & sides)]
        if state.wall is not None and len(rows):
            rows = rows[np.abs(residuals(rows, state.wall, cone)) > TIGHT]
        if len(rows) < LEAST_WALL_ECHOES:
            return None
        fit = search(rows, at, cone, state.ahead)
        return fit if fit.explained >= max(LEAST_WALL_ECHOES, 0.3 * len(rows)) else None

    def _distance_left(self, state: LineState, cone: Cone) -> float:
        """Return the distance until the robot reaches its following distance from the wall ahead (m)."""
        ahead, fresh = state.ahead, _fresh(state.echoes, state)
        left = math.inf if ahead is None else self._distance_to(state, ahead)
        for number in (DIAGONAL, FRONT, FAR):  # as if the echo came from right before the sonar
            rows = fresh[fresh[:, 4] == number][-3:]
            if number == DIAGONAL and state.wall is not None:
                rows = rows[residuals(rows, state.wall, cone) < -NEARER]
            if len(rows) < 2:
                continue
            range_now = median((rows[:, 3] - (state.travelled - rows[:, 5])).tolist())
            # 0.2: minimum range of every sonar that looks ahead, m: the robot stops there at the latest, because the
            # echo may not come from the wall that it drives to
            left = min(left, range_now - 0.2)
            if ahead is None and (number != FAR or state.wall is None):  # the echoes ahead form no line
                left = min(left, range_now + state.mounts[number].reach - self._keep(state))
        near = fresh[fresh[:, 4] >= DIAGONAL][-6:, 3]
        return min(left, 0.0) if np.count_nonzero(near < TOUCHING) >= 2 else left

    def _distance_to(self, state: LineState, line: WallEstimate) -> float:
        """Return the distance until the robot reaches its following distance from a wall (m)."""
        x, y, yaw = state.pose
        return (line.distance(x, y) - self._keep(state)) / max(math.cos(line.normal - yaw), 0.4)

    def _keep(self, state: LineState) -> float:
        """Return the following distance of the robot's centre from walls (m)."""
        mount = state.mounts[SIDE]
        return self._config.distance + mount.y

    # Faults

    def _fault(self, state: LineState, odometry: Odometry, t: float) -> tuple[Reason, str] | None:
        """Return the reason why the robot cannot continue, or None."""
        if (found := state.monitor.fault(state.turned, t)) is not None:
            return found
        # number of consecutive equal echoes of a stuck sonar, and the minimum distance that they span, m
        equal = 12, 0.1
        for name, (value, count, first) in zip(self._names, state.equal, strict=True):
            if count >= equal[0] and state.travelled - first >= equal[1]:
                distance = state.travelled - first
                return (
                    Reason.INPUT_CONTRADICTORY,
                    f"sonar {name} measured a constant {value:.3f} m over {distance:.2f} m",
                )
        turns, stands = state.strays
        if turns is not None and t - turns > STRAY[1]:
            text = (
                f"{state.w.at(t) * self._mirror:.2f} rad/s requested but the robot did not turn: check for a "
                "stalled motor"
            )
            return Reason.STUCK, text
        # 1.0: time without the requested motion until the robot is considered stuck, s
        if stands is not None and t - stands > 1.0:
            return Reason.STUCK, f"{state.v.at(t):.2f} m/s requested, {odometry.twist.vx:.2f} m/s driven"
        if state.phase == "turn" and state.turned - state.marks[1] < 0.05:  # a turn is starting up to this angle, rad
            for number in (DIAGONAL, FRONT, FAR):
                if 0.0 < (near := state.equal[number][0]) < TOUCHING:
                    return Reason.STUCK, f"sonar {self._names[number]} measures {near:.2f} m: too close to turn away"
        if state.phase == "turn" and state.turned - state.marks[1] > 1.2 * math.tau:
            return Reason.STUCK, "turned a full circle and found no wall to follow"
        if state.phase == "search" and state.travelled - state.marks[0] > self._config.search:
            return Reason.STUCK, f"no wall within {self._config.search:.0f} m"
        return None

    def _disagreement(self, state: LineState, wall: WallEstimate, cone: Cone) -> tuple[Reason, str] | None:
        """Return the fault of a sonar that does not hear the wall heard by its neighbour."""
        # (20, 1.2): minimum number of echoes per sonar, and distance along the wall, m, for a verdict: the diagonal
        # sonar looks through a door, or past the end of a pillar, before the side sonar
        least, distance = (20, 1.2)
        if state.travelled - state.marks[0] < distance:
            return None
        recent, shares = state.echoes[state.echoes[:, 5] > state.travelled - distance], []
        for number in (SIDE, DIAGONAL):
            rows = recent[recent[:, 4] == number]
            if len(rows) < least or not cone.hears(float(rows[-1, 2]), wall.normal):
                return None
            shares.append(np.count_nonzero(np.abs(residuals(rows, wall, cone)) < TIGHT) / len(rows))
        for number, (share, other) in enumerate((shares, shares[::-1])):
            if share < DISAGREES and other > AGREES:
                name = self._names[number]
                return Reason.INPUT_CONTRADICTORY, f"sonar {name} does not detect the wall that its neighbour measures"
        return None

    # Phases

    def _advance(self, state: LineState, cone: Cone, t: float) -> LineState:
        """Advance ramps and phases to ``t``, the time of the motion to request."""
        config = self._config
        match state.phase:
            case "settle":
                # 0.5: initial time at rest for measuring the gyroscope bias, s
                return self._to(state, "search") if t >= 0.5 else state
            case "search" | "follow":
                return self._drive(state, cone, t)
            case "brake":
                state = self._steer(state, t) if state.wall is not None else state
                if not state.v.over(t):
                    return state._replace(v=self._stopping(state.v, self._left(state, cone, t), t))
                if state.wall is not None and self._passed_by(state, state.wall, cone, t):
                    return self._to(state, "follow")
                state = self._to(state, "turn")
                sense = self._sense(state)
                return state._replace(sense=sense, w=self._ramp(state.w, sense * config.turn_rate, t))
            case "turn":
                return self._turn(state, cone, t)
            case "stop":
                return self._steer(state, t)

    def _passed_by(self, state: LineState, wall: WallEstimate, cone: Cone, t: float) -> bool:
        """Whether the obstacle was on the far side and has gone: front and diagonal sonar did not hear it.

        Echoes of those two may be the corner, although there are none from the robot's current position.
        """
        # 0.1: distance left at standstill along a wall, m, above which the obstacle has gone and was not a corner
        if self._left(state, cone, t) <= 0.1:
            return False
        lately = state.echoes[state.echoes[:, 5] > state.travelled - AHEAD_DISTANCES[1]]
        diagonal, front = lately[:, 4] == DIAGONAL, lately[:, 4] == FRONT
        ahead = (diagonal & (residuals(lately, wall, cone) < -NEARER)) | (front & (lately[:, 3] < FRONT_RANGE))
        return bool(np.count_nonzero(ahead) < 2)

    def _drive(self, state: LineState, cone: Cone, t: float) -> LineState:
        """Drive along the wall, or straight until there is one."""
        config = self._config
        slow = state.phase == "follow" and not state.sure
        state = state._replace(v=self._ramp(state.v, config.creep if slow else config.speed, t))
        if state.phase == "follow":
            if state.travelled - state.seen > config.door:
                state = self._to(state._replace(wall=None, faced=(None, None), places=state.places[:0]), "search")
            else:
                state = self._lap(state)
                if state.laps >= config.laps:
                    return self._steer(self._to(state._replace(v=self._ramp(state.v, 0.0, t)), "stop"), t)
        state = self._steer(state, t)
        left, speed = self._left(state, cone, t), state.v.at(t)
        if left == math.inf:
            return state
        brake = shortest_ramp(speed, state.v.acceleration(t), 0.0, config.braking, config.jerk)
        if left - speed / config.rate > brake.distance:
            return state
        # 0.6: remaining fraction of the gentle braking distance below which the robot brakes as hard as a ramp may
        if left < 0.6 * brake.distance:
            brake = shortest_ramp(speed, state.v.acceleration(t), 0.0, config.acceleration, config.jerk)
        return self._to(state._replace(v=self._stopping(TimedRamp(t, brake), left, t)), "brake")

    def _left(self, state: LineState, cone: Cone, t: float) -> float:
        """Return ``_distance_left`` at the position that the ramp reaches at ``t`` (m)."""
        return self._distance_left(state, cone) - state.lag[0] - state.v.at(t) * self._config.lead

    def _stopping(self, ramp: TimedRamp, left: float, t: float) -> TimedRamp:
        """Return a ramp to standstill, recomputed to cover the remaining distance if the limits allow."""
        config, speed, change = self._config, ramp.at(t), ramp.acceleration(t)
        if not 0.0 < speed * left < math.inf:  # no echo ahead any more: keep the active ramp
            return ramp
        shape = CubicRamp.to_rest(speed, left, change)
        acceleration, jerk = shape.peaks
        kept = shape.a0 == change and acceleration <= config.acceleration and jerk <= config.jerk
        return TimedRamp(t, shape) if kept else ramp

    def _turn(self, state: LineState, cone: Cone, t: float) -> LineState:
        """Turn on the spot until the robot is parallel to the new wall."""
        config, yaw = self._config, state.pose[2]
        if state.w.shape.v1 == 0.0 and state.w.over(t):
            return self._follow(state, cone)
        if state.ahead is None:
            return state
        rate, change = state.w.at(t), state.w.acceleration(t)
        sense = state.sense
        left = (sense * (state.ahead.heading - yaw) + 0.5) % math.tau - 0.5
        left -= sense * (state.lag[1] + rate * config.lead)
        if state.w.shape.v1 == 0.0:
            return state._replace(w=self._stopping(state.w, sense * left, t))
        brake = shortest_ramp(rate, change, 0.0, config.acceleration, config.jerk)
        if left - abs(rate) / config.rate > abs(brake.distance):
            return state
        return state._replace(w=self._stopping(TimedRamp(t, brake), sense * left, t))

    def _follow(self, state: LineState, cone: Cone) -> LineState:
        """Follow the wall that the robot has turned to."""
        wall = state.ahead
        if wall is None:
            return state
        kept = state.echoes[np.abs(residuals(state.echoes, wall, cone)) < TIGHT].copy()
        # -1: number for echoes of other sonars from this wall, received while it was ahead
        kept[:, 4] = np.where(kept[:, 4] <= DIAGONAL, kept[:, 4], -1)
        # 0.5: minimum distance along a wall for a lap to begin there, m
        if not len(state.places) or state.travelled - state.places[0, 0] < 0.5:
            state = state._replace(places=np.array([[state.travelled, *state.pose]]))
        return self._to(state, "follow")._replace(
            wall=wall, ahead=None, faced=(None, None), echoes=kept, seen=state.travelled
        )

    def _steer(self, state: LineState, t: float) -> LineState:
        """Set the yaw rate that reduces the distance error; 0 without a wall."""
        config, wall = self._config, state.wall
        target = 0.0
        if wall is not None:
            error = self.error(state)
            away = math.remainder(state.pose[2] - wall.heading, math.tau)
            stiff = config.stiffness
            target = state.v.at(t) * (max(min(error, stiff), -stiff) / stiff**2 - 2.0 * away / stiff)
        turns = 0.5  # maximum yaw rate along the wall, rad/s
        return state._replace(w=self._ramp(state.w, clip(target, -turns, turns), t))

    def error(self, state: LineState) -> float:
        """Return the side sonar's distance from the wall minus the set distance (m); the state must have a wall."""
        assert state.wall is not None
        x, y, yaw = state.pose
        mount = state.mounts[SIDE]
        c, s = math.cos(yaw), math.sin(yaw)
        return state.wall.distance(x + c * mount.x - s * mount.y, y + s * mount.x + c * mount.y) - self._config.distance

    def _sense(self, state: LineState) -> float:
        """Return the turn direction, -1 for right: always right between walls, the shorter turn from free ground."""
        if state.wall is not None or state.ahead is None:
            return -1.0
        return math.copysign(1.0, math.remainder(state.ahead.heading - state.pose[2], math.tau))

    def _lap(self, state: LineState) -> LineState:
        """Count laps by odometry: a lap is complete when the robot returns to any place that it drove past.

        The start need not be such a place: a robot that begins along a door post leaves it for the wall.
        """
        config, (x, y, yaw), places = self._config, state.pose, state.places
        if state.travelled - places[-1, 0] >= 0.5:  # distance between two places that may complete a lap, m
            places = np.vstack([places, (state.travelled, x, y, yaw)])
            state = state._replace(places=places)
        if state.travelled - places[0, 0] < config.lap_length:
            return state
        driven, bx, by, byaw = state.travelled - places[:, 0], *places[:, 1:].T
        passed = (x - bx) * np.cos(byaw) + (y - by) * np.sin(byaw) >= 0.0
        near = np.hypot(x - bx, y - by) <= config.lap_radius + 0.01 * driven
        back = (driven >= config.lap_length) & passed & near & (np.cos(yaw - byaw) >= math.cos(0.6))
        if back.any():
            place = state.travelled, *places[int(back.argmax()), 1:]
            return state._replace(laps=state.laps + 1, places=np.array([place]))
        return state

    def _to(self, state: LineState, phase: Phase) -> LineState:
        return state._replace(phase=phase, marks=(state.travelled, state.turned))

    def _ramp(self, ramp: TimedRamp, target: float, t: float) -> TimedRamp:
        """Return the active ramp if it ends at ``target``, else a new one from the current speed and acceleration."""
        config = self._config
        if abs(ramp.shape.v1 - target) < 1e-9:
            return ramp
        shape = shortest_ramp(ramp.at(t), ramp.acceleration(t), target, config.acceleration, config.jerk)
        return TimedRamp(t, shape)


def _strays(
    before: tuple[float | None, float | None], asked: tuple[float, float], measured: tuple[float, float], t: float
) -> tuple[float | None, float | None]:
    """Return the times since which yaw rate and speed differ from the request (s)."""
    (v, w), (speed, rate) = asked, measured
    slow = 0.2  # fraction of the requested speed below which the robot does not move
    stray = abs(w - rate) > STRAY[0], (v > 0.05 and speed < slow * v) or (abs(w) > 0.2 and abs(rate) < slow * abs(w))
    turns, stands = ((t if since is None else since) if now else None for now, since in zip(stray, before, strict=True))
    return turns, stands


def _asked(state: LineState, t: float) -> tuple[float, float]:
    """Return the speed and yaw rate requested for a time."""
    if not state.sent:
        return 0.0, 0.0
    times, speeds, rates = zip(*state.sent, strict=True)
    return float(np.interp(t, times, speeds)), float(np.interp(t, times, rates))


def _reach(state: LineState) -> float:
    """Return the distance over which echoes are used for the wall ahead (m)."""
    return AHEAD_DISTANCES[0] if state.wall is None else AHEAD_DISTANCES[1]


def _fresh(echoes: Array, state: LineState) -> Array:
    """Return the recent echoes."""
    # 0.35: validity of an echo from the space ahead of the robot, s
    return echoes[echoes[:, 6] > (state.before or 0.0) - 0.35]


def _at(poses: tuple[tuple[int, Pose2, float], ...], stamp: int, play: float) -> tuple[Pose2, float]:
    """Return pose and speed of the body at a time: position and speed come from the odometry ``play`` s earlier."""
    (x, y, _), speed = _between(poses, stamp - round(play * SECOND))
    return (x, y, _between(poses, stamp)[0][2]), speed


def _between(poses: tuple[tuple[int, Pose2, float], ...], stamp: int) -> tuple[Pose2, float]:
    """Interpolate pose and speed at a time; clamp to the latest or oldest entry."""
    if stamp >= poses[-1][0]:
        return poses[-1][1:]
    for (before, a, slow), (after, b, fast) in pairwise(poses):
        if before <= stamp < after:
            part = (stamp - before) / (after - before)
            turn = math.remainder(b[2] - a[2], math.tau)
            pose = a[0] + part * (b[0] - a[0]), a[1] + part * (b[1] - a[1]), a[2] + part * turn
            return pose, slow + part * (fast - slow)
    return poses[0][1:]


def _values(state: LineState, error: float | None) -> dict[str, float]:
    values = {"travelled": state.travelled, "laps": float(state.laps)}
    if error is not None:
        values["error"] = error
    if state.ahead is not None:
        values["ahead"] = state.ahead.distance(*state.pose[:2])
    return values
