"""Wall following by a line fitted to echoes: method 3, our own.

The wall is a line in odom that touches the arcs of the echoes of the last metres. The robot drives along the line at
its distance, and through a gap along the line as it was. A wall ahead is a second line; where both distances are kept
the robot stands, turns on the spot until it is parallel to the new wall, and goes on. Speeds change by cubic ramps from
the present speed and acceleration; what odometry (speed) and gyroscope (yaw rate) lack of them is made up for.
All is written for a wall on the left; a wall on the right is the mirror image.
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
"""Sonars by number, as in ``NAMES``."""
KEPT_POSE_TIME: Final = 1.0
"""Seconds for which poses are kept: an echo is placed where the robot was then."""
FRONT_RANGE: Final = 1.2
"""Front range from which on a wall ahead is estimated, m."""
AHEAD_DISTANCES: Final = 1.5, 0.8
"""Distance over which echoes count for the wall ahead, m: on free ground, and along a wall, behind which the foot of
the perpendicular on the next one may lie."""
NEARER: Final = 5.0
"""Standard deviations by which an echo of the diagonal sonar is nearer than the wall beside: of something ahead."""
LEAST_WALL_ECHOES: Final = 6
"""Echoes that make a wall."""
TOUCHING: Final = 0.16
"""A range from which on the robot stops at once, m."""
STRAY: Final = (0.3, 0.4)
"""Yaw rate that is not the one requested, rad/s, and the seconds after which a motor counts as stalled."""
DISAGREES, AGREES = 0.2, 0.7
"""Share of them on the wall below which a sonar contradicts another one, whose share is above the second figure."""

STANDSTILL: Final = TimedRamp(0.0, CubicRamp(0.0, 0.0, 1.0))

Fit = Literal["beside", "left", "right", "turned"]
"""Lines that are fitted: the wall beside; one ahead by the sonars of either side; the one to which it turns."""
Phase = Literal["settle", "search", "brake", "turn", "follow", "stop"]


class SonarMount(NamedTuple):
    """Mount of a sonar in base, with the wall on the left."""

    x: float
    y: float
    yaw: float

    @property
    def reach(self) -> float:
        """Of the robot's middle from what is at range 0 on the axis, along the axis, m."""
        return self.x * math.cos(self.yaw) + self.y * math.sin(self.yaw)


class LineState(NamedTuple):
    """Between two steps; poses with the wall on the left."""

    phase: Phase = "settle"
    mounts: tuple[SonarMount, ...] = ()
    poses: tuple[tuple[int, Pose2, float], ...] = ()
    """Poses of the last second by the odometry, with their stamps and speeds, m/s."""
    pose: Pose2 = (0.0, 0.0, 0.0)
    """Where the body is."""
    heard: int = -1
    """Stamp of the newest echoes taken in."""
    echoes: Array = np.empty((0, len(ECHO)))
    monitor: SonarMonitor = SonarMonitor()
    wall: WallEstimate | None = None
    """Along which it drives."""
    sure: bool = False
    """Whether the direction of ``wall`` is known well."""
    ahead: WallEstimate | None = None
    """To which it turns."""
    faced: tuple[WallEstimate | None, WallEstimate | None] = (None, None)
    """Walls ahead by front and diagonal sonar, and by front and far one; along a wall the second alone."""
    fits: tuple[Fit, ...] = ()
    """Lines to be fitted to the echoes that came in."""
    v: TimedRamp = STANDSTILL
    w: TimedRamp = STANDSTILL
    lag: tuple[float, float] = (0.0, 0.0)
    """Distance, m, and angle, rad, that the robot is behind its ramps."""
    bias: tuple[float, int] = (0.0, 0)
    """Bias of the gyroscope, rad/s, and the number of samples of which it is the mean."""
    before: float | None = None
    """Time of the newest step, s."""
    sent: tuple[tuple[float, float, float], ...] = ()
    """Speed and yaw rate that the ramps had, and the time for which they were requested: of the last second."""
    travelled: float = 0.0
    turned: float = 0.0
    """Rad, both ways counted."""
    marks: tuple[float, float] = (0.0, 0.0)
    """``travelled`` and ``turned`` when the phase began."""
    seen: float = 0.0
    """``travelled`` at the last echo of the wall."""
    sense: float = -1.0
    """Sense of the turn: 1 = left."""
    places: Array = np.empty((0, 4))
    """(n, 4) ``travelled`` and pose where the lap began and every half a metre since; empty = no wall yet."""
    laps: int = 0
    strays: tuple[float | None, float | None] = (None, None)
    """Since when yaw rate and speed are not those requested, s."""
    equal: tuple[tuple[float, int, float], ...] = ((0.0, 0, 0.0),) * 4
    """Newest range of every sonar, how often it came in a row, and ``travelled`` when it came first."""


class WallLine:
    """Method 3.

    Args:
        config: settings.
    """

    reads: ClassVar[tuple[Topic[Any], ...]] = (SONAR, ODOMETRY, IMU, TRANSFORMS)

    def __init__(self, config: WallLineConfig) -> None:
        self._config = config
        self._names = NAMES[config.side]
        self._mirror = 1.0 if config.side == "left" else -1.0
        # 2: lines fitted for a round of echoes: one in a step where there are as many steps: the event loop waits for
        # them
        self._fits = math.ceil(2 * (SONAR.rate or 0.0) / config.rate)

    def begin(self) -> LineState:
        """Before the first step."""
        return LineState()

    def step(self, inputs: Inputs, state: LineState, t: float) -> BehaviourStep:
        """One step; see ``Behaviour``."""
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
        catch_up = 1.5  # speed by which a lag is made up for, of the lag, 1/s
        v, w = v + catch_up * state.lag[0], w + catch_up * state.lag[1]
        motion = RequestedMotion(min(max(v, 0.0), 0.3), w * self._mirror)  # m/s
        error = None if state.wall is None else self.error(state)
        return BehaviourStep(motion, state, state.phase, values=_values(state, error))

    # Inputs

    def _mounts(self, transforms: Transforms) -> tuple[SonarMount, ...] | str:
        """Mounts of the sonars, or what is missing."""
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
        # 1.3: greatest angle from the normal at which a beam comes back, rad
        return Cone(0.0, 1.3) if config.beam else Cone(sonars.field_of_view / 2, config.critical_angle)

    def _moved(self, state: LineState, odometry: Odometry, rate: float, t: float) -> LineState:
        """Take in odometry and gyroscope."""
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
        lag = (0.05, 0.15)  # greatest lag that is made up for: distance, m, and angle, rad
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
        """Fit lines again after a round of echoes, two in each round, the longest waiting first."""
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
        """With a new fit of the wall at its side."""
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
        """Whether the side sonar looks through an opening: what the diagonal one hears then may be its far post."""
        if not cone.hears(state.pose[2] + state.mounts[SIDE].yaw, wall.normal):
            return False
        fresh = _fresh(state.echoes[state.echoes[:, 4] == SIDE], state)
        # 0.3: range of the side sonar beyond the wall from which on it looks through an opening, m
        return not len(fresh) or bool((residuals(fresh, wall, cone) * deviation(fresh[:, 3])).min() > 0.3)

    def _nearer(self, state: LineState, faced: tuple[WallEstimate | None, WallEstimate | None]) -> LineState:
        """With the nearer one of the walls ahead by the sonars of either side."""
        lines = [line for line in faced if line is not None]
        return state._replace(
            faced=faced, ahead=min(lines, key=lambda line: self._distance_to(state, line), default=None)
        )

    def _faced(self, state: LineState, cone: Cone, group: tuple[int, int]) -> WallEstimate | None:
        """A wall ahead by the sonars from one number to another."""
        echoes, pose = state.echoes, state.pose
        own = (echoes[:, 4] >= group[0]) & (echoes[:, 4] <= group[1])
        rows = echoes[(echoes[:, 5] > state.travelled - _reach(state)) & own]
        fresh = _fresh(rows, state)
        if len(rows) < LEAST_WALL_ECHOES or not len(fresh) or fresh[:, 3].min() > FRONT_RANGE:
            return None
        fit = search(rows, pose[:2], cone)
        # 1.1: greatest angle between the direction of travel and the normal of a wall that is ahead, rad
        facing = abs(math.remainder(fit.line.normal - pose[2], math.tau)) < 1.1
        present = np.count_nonzero(np.abs(residuals(fresh, fit.line, cone)) < TIGHT) > 0.5 * len(fresh)
        return fit.line if facing and present and fit.explained >= max(LEAST_WALL_ECHOES, 0.5 * len(rows)) else None

    def _turned_to(self, state: LineState, cone: Cone) -> EstimateFit | None:
        """The wall that the robot turns to: of all echoes since it is near, but those of the wall it leaves."""
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
        """Distance until the robot stands before the wall ahead at the distance at which it follows walls, m."""
        ahead, fresh = state.ahead, _fresh(state.echoes, state)
        left = math.inf if ahead is None else self._distance_to(state, ahead)
        for number in (DIAGONAL, FRONT, FAR):  # as if what it hears were right before the sonar
            rows = fresh[fresh[:, 4] == number][-3:]
            if number == DIAGONAL and state.wall is not None:
                rows = rows[residuals(rows, state.wall, cone) < -NEARER]
            if len(rows) < 2:
                continue
            range_now = median((rows[:, 3] - (state.travelled - rows[:, 5])).tolist())
            # 0.2: range of every sonar that looks ahead at which the robot stands at the latest, m: what it hears there
            # may not be the wall to which it drives
            left = min(left, range_now - 0.2)
            if ahead is None and (number != FAR or state.wall is None):  # what is ahead makes no line
                left = min(left, range_now + state.mounts[number].reach - self._keep(state))
        near = fresh[fresh[:, 4] >= DIAGONAL][-6:, 3]
        return min(left, 0.0) if np.count_nonzero(near < TOUCHING) >= 2 else left

    def _distance_to(self, state: LineState, line: WallEstimate) -> float:
        """Distance until the robot stands at the distance at which it follows walls before one, m."""
        x, y, yaw = state.pose
        return (line.distance(x, y) - self._keep(state)) / max(math.cos(line.normal - yaw), 0.4)

    def _keep(self, state: LineState) -> float:
        """Distance of the robot's middle from walls, m."""
        mount = state.mounts[SIDE]
        return self._config.distance + mount.y

    # Faults

    def _fault(self, state: LineState, odometry: Odometry, t: float) -> tuple[Reason, str] | None:
        """Why it cannot go on."""
        if (found := state.monitor.fault(state.turned, t)) is not None:
            return found
        # equal echoes in a row, and the distance over which they came, m, from which on a sonar counts as stuck
        equal = 12, 0.1
        for name, (value, count, first) in zip(self._names, state.equal, strict=True):
            if count >= equal[0] and state.travelled - first >= equal[1]:
                distance = state.travelled - first
                return Reason.INPUT_CONTRADICTORY, f"sonar {name} measured {value:.3f} m all along {distance:.2f} m"
        turns, stands = state.strays
        if turns is not None and t - turns > STRAY[1]:
            text = f"{state.w.at(t) * self._mirror:.2f} rad/s asked for and not turned: does a motor stall?"
            return Reason.STUCK, text
        # 1.0: seconds without the requested motion, after which the robot counts as stuck
        if stands is not None and t - stands > 1.0:
            return Reason.STUCK, f"{state.v.at(t):.2f} m/s asked for, {odometry.twist.vx:.2f} m/s driven"
        if state.phase == "turn" and state.turned - state.marks[1] < 0.05:  # angle up to which a turn begins, rad
            for number in (DIAGONAL, FRONT, FAR):
                if 0.0 < (near := state.equal[number][0]) < TOUCHING:
                    return Reason.STUCK, f"sonar {self._names[number]} measures {near:.2f} m: too near to turn away"
        if state.phase == "turn" and state.turned - state.marks[1] > 1.2 * math.tau:
            return Reason.STUCK, "turned once around and found no wall to follow"
        if state.phase == "search" and state.travelled - state.marks[0] > self._config.search:
            return Reason.STUCK, f"no wall within {self._config.search:.0f} m"
        return None

    def _disagreement(self, state: LineState, wall: WallEstimate, cone: Cone) -> tuple[Reason, str] | None:
        """A sonar that does not hear the wall that the other one hears."""
        # (20, 1.2): least number of echoes of a sonar, over this distance along a wall, m, that tell whether it agrees
        # with the wall: the diagonal one looks through a door, or past the end of a pillar, before the other one
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
                return Reason.INPUT_CONTRADICTORY, f"sonar {name} does not measure the wall that its neighbour does"
        return None

    # Phases

    def _advance(self, state: LineState, cone: Cone, t: float) -> LineState:
        """Ramps and phases at ``t``, the time for which motion is requested now."""
        config = self._config
        match state.phase:
            case "settle":
                # 0.5: seconds at rest at the beginning, over which the gyroscope's bias is measured
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
        """Whether what it braked for was on the far side and has gone: front and diagonal sonar heard nothing of it.

        The echoes of those two may be the corner, although there are none from where the robot stands.
        """
        # 0.1: distance left at standstill beside a wall, m, from which on what the robot braked for has gone: it was no
        # corner
        if self._left(state, cone, t) <= 0.1:
            return False
        lately = state.echoes[state.echoes[:, 5] > state.travelled - AHEAD_DISTANCES[1]]
        diagonal, front = lately[:, 4] == DIAGONAL, lately[:, 4] == FRONT
        ahead = (diagonal & (residuals(lately, wall, cone) < -NEARER)) | (front & (lately[:, 3] < FRONT_RANGE))
        return bool(np.count_nonzero(ahead) < 2)

    def _drive(self, state: LineState, cone: Cone, t: float) -> LineState:
        """Along the wall, or straight on until there is one."""
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
        # 0.6: share of the distance of gentle braking that is left, below which it brakes as hard as a ramp may
        if left < 0.6 * brake.distance:
            brake = shortest_ramp(speed, state.v.acceleration(t), 0.0, config.acceleration, config.jerk)
        return self._to(state._replace(v=self._stopping(TimedRamp(t, brake), left, t)), "brake")

    def _left(self, state: LineState, cone: Cone, t: float) -> float:
        """``_distance_left`` of where the robot is at ``t`` by its ramp, m."""
        return self._distance_left(state, cone) - state.lag[0] - state.v.at(t) * self._config.lead

    def _stopping(self, ramp: TimedRamp, left: float, t: float) -> TimedRamp:
        """A ramp to standstill, computed again so that it covers what is left, if that is within the limits."""
        config, speed, change = self._config, ramp.at(t), ramp.acceleration(t)
        if not 0.0 < speed * left < math.inf:  # nothing is heard ahead any more: the ramp that runs stands
            return ramp
        shape = CubicRamp.to_rest(speed, left, change)
        acceleration, jerk = shape.peaks
        kept = shape.a0 == change and acceleration <= config.acceleration and jerk <= config.jerk
        return TimedRamp(t, shape) if kept else ramp

    def _turn(self, state: LineState, cone: Cone, t: float) -> LineState:
        """On the spot, until it is parallel to the new wall."""
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
        """Go on along the wall that the robot has turned to."""
        wall = state.ahead
        if wall is None:
            return state
        kept = state.echoes[np.abs(residuals(state.echoes, wall, cone)) < TIGHT].copy()
        # -1: number of an echo of another sonar that came from the wall beside, when that was ahead
        kept[:, 4] = np.where(kept[:, 4] <= DIAGONAL, kept[:, 4], -1)
        # 0.5: a lap does not begin where the robot followed a wall for less, m
        if not len(state.places) or state.travelled - state.places[0, 0] < 0.5:
            state = state._replace(places=np.array([[state.travelled, *state.pose]]))
        return self._to(state, "follow")._replace(
            wall=wall, ahead=None, faced=(None, None), echoes=kept, seen=state.travelled
        )

    def _steer(self, state: LineState, t: float) -> LineState:
        """Yaw rate by which the distance error decays; 0 without a wall."""
        config, wall = self._config, state.wall
        target = 0.0
        if wall is not None:
            error = self.error(state)
            away = math.remainder(state.pose[2] - wall.heading, math.tau)
            stiff = config.stiffness
            target = state.v.at(t) * (max(min(error, stiff), -stiff) / stiff**2 - 2.0 * away / stiff)
        turns = 0.5  # greatest yaw rate along the wall, rad/s
        return state._replace(w=self._ramp(state.w, clip(target, -turns, turns), t))

    def error(self, state: LineState) -> float:
        """Distance of the side sonar from the wall less the one wanted, m; of a state with a wall."""
        assert state.wall is not None
        x, y, yaw = state.pose
        mount = state.mounts[SIDE]
        c, s = math.cos(yaw), math.sin(yaw)
        return state.wall.distance(x + c * mount.x - s * mount.y, y + s * mount.x + c * mount.y) - self._config.distance

    def _sense(self, state: LineState) -> float:
        """-1 to turn right: always from one wall to the next, from free ground the shorter way."""
        if state.wall is not None or state.ahead is None:
            return -1.0
        return math.copysign(1.0, math.remainder(state.ahead.heading - state.pose[2], math.tau))

    def _lap(self, state: LineState) -> LineState:
        """Count laps by odometry: one is complete where the robot comes back to any place that it drove past.

        Where it began need not be such a place: a robot that begins along a door post leaves it for the wall.
        """
        config, (x, y, yaw), places = self._config, state.pose, state.places
        if state.travelled - places[-1, 0] >= 0.5:  # distance between two places at which a lap may be complete, m
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
        """The ramp that runs if it ends at ``target``, else a new one from the present speed and acceleration."""
        config = self._config
        if abs(ramp.shape.v1 - target) < 1e-9:
            return ramp
        shape = shortest_ramp(ramp.at(t), ramp.acceleration(t), target, config.acceleration, config.jerk)
        return TimedRamp(t, shape)


def _strays(
    before: tuple[float | None, float | None], asked: tuple[float, float], measured: tuple[float, float], t: float
) -> tuple[float | None, float | None]:
    """Since when yaw rate and speed are not those requested."""
    (v, w), (speed, rate) = asked, measured
    slow = 0.2  # share of the requested speed below which the robot does not move
    stray = abs(w - rate) > STRAY[0], (v > 0.05 and speed < slow * v) or (abs(w) > 0.2 and abs(rate) < slow * abs(w))
    turns, stands = ((t if since is None else since) if now else None for now, since in zip(stray, before, strict=True))
    return turns, stands


def _asked(state: LineState, t: float) -> tuple[float, float]:
    """Speed and yaw rate requested over a time."""
    if not state.sent:
        return 0.0, 0.0
    times, speeds, rates = zip(*state.sent, strict=True)
    return float(np.interp(t, times, speeds)), float(np.interp(t, times, rates))


def _reach(state: LineState) -> float:
    """Distance over which echoes count for the wall ahead, m."""
    return AHEAD_DISTANCES[0] if state.wall is None else AHEAD_DISTANCES[1]


def _fresh(echoes: Array, state: LineState) -> Array:
    """The echoes that came lately."""
    # 0.35: seconds for which an echo shows what is before the robot
    return echoes[echoes[:, 6] > (state.before or 0.0) - 0.35]


def _at(poses: tuple[tuple[int, Pose2, float], ...], stamp: int, play: float) -> tuple[Pose2, float]:
    """Pose and speed of the body at a time: its place and speed are those of the odometry ``play`` earlier."""
    (x, y, _), speed = _between(poses, stamp - round(play * SECOND))
    return (x, y, _between(poses, stamp)[0][2]), speed


def _between(poses: tuple[tuple[int, Pose2, float], ...], stamp: int) -> tuple[Pose2, float]:
    """Pose and speed at a time, between two that are known; the newest or oldest ones outside them."""
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
